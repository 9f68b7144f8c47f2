from studies.scale.study import STUDY

STUDY.main()
