from studies.table3 import main

main()
