from studies.beam.study import main

main()
