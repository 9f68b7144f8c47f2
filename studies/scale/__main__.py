from studies.scale.study import main

main()
