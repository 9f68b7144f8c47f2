"""`python -m studies.honesty`."""

from studies.honesty.study import main

main()
