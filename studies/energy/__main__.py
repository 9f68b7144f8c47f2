from studies.energy import main

main()
