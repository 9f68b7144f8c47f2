from studies.robustness.study import STUDY

STUDY.main()
