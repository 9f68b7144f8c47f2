from studies.validation.study import STUDY

STUDY.main()
