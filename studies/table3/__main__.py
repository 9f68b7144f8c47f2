from studies.table3.study import main

main()
