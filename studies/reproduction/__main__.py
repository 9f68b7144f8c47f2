from studies.reproduction.study import main

main()
