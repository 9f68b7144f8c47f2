"""`python -m studies.symbolic_size`."""

from studies.symbolic_size.study import main

main()
