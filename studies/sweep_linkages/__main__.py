from studies.sweep_linkages import main

main()
