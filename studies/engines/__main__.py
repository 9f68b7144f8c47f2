from studies.engines.study import STUDY

STUDY.main()
