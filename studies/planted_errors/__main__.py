from studies.planted_errors.study import main

main()
