"""`python -m studies.table3`."""

from studies.table3.study import main

main()
