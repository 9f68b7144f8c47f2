from studies.symbolic_size import main

main()
