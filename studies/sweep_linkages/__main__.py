"""`python -m studies.sweep_linkages`."""

from studies.sweep_linkages.study import main

main()
