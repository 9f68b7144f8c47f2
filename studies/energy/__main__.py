"""`python -m studies.energy`."""

from studies.energy.study import main

main()
