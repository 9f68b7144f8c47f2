from studies.engines import main

main()
