"""`python -m studies.robustness`."""

from studies.robustness.study import main

main()
