from studies.honesty.study import STUDY

STUDY.main()
