from studies.symbolic_size.study import STUDY

STUDY.main()
