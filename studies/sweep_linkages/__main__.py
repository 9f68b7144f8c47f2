from studies.sweep_linkages.study import STUDY

STUDY.main()
