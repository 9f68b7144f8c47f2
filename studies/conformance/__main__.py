from studies.conformance.study import main

main()
