from studies.conformance.study import STUDY

STUDY.main()
