"""Which solvers pass the check of `twoloop.testing`: ours, rivals by our adapters, rivals as their authors show."""

from studies.conformance.study import main as main
