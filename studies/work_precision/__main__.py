from studies.work_precision import main

main()
