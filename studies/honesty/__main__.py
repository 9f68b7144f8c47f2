from studies.honesty import main

main()
