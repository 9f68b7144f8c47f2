from studies.validation.study import main

main()
