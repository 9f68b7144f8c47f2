"""`python -m studies.beam`."""

from studies.beam.study import main

main()
