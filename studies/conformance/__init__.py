"""Which solvers pass the check of `twoloop.testing`: ours, rivals by our adapters, rivals as their authors show."""
