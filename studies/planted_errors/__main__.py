from studies.planted_errors import main

main()
