"""python -m studies.conformance."""

from studies.conformance.study import main

main()
