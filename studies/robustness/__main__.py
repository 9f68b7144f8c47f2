from studies.robustness.study import main

main()
