from studies.beam.study import STUDY

STUDY.main()
