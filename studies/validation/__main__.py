"""`python -m studies.validation`."""

from studies.validation.study import main

main()
