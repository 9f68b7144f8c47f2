from studies.table3.study import STUDY

STUDY.main()
