from studies.beam import main

main()
