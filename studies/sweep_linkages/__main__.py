from studies.sweep_linkages.study import main

main()
