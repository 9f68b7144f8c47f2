"""Methods that a user can choose: frozen options, one file for each family, and the plan of a run."""
