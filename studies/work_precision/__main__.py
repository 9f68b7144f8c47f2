"""`python -m studies.work_precision`."""

from studies.work_precision.study import main

main()
