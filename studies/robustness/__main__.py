from studies.robustness import main

main()
