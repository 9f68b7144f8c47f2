from studies.validation import main

main()
