from studies.conformance import main

main()
