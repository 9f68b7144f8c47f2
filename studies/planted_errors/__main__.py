"""`python -m studies.planted_errors`."""

from studies.planted_errors.study import main

main()
