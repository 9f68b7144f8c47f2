from studies.symbolic_size.study import main

main()
