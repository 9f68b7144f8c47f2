from studies.work_precision.study import main

main()
