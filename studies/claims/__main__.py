from studies.claims import main

main()
