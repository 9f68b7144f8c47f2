from studies.honesty.study import main

main()
