from studies.engines.study import main

main()
