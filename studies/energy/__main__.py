from studies.energy.study import STUDY

STUDY.main()
