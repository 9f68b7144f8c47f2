from studies.ensembles.study import STUDY

STUDY.main()
