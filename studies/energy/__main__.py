from studies.energy.study import main

main()
