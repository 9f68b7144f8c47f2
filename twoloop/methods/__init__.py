"""Methods that a user can choose: one file of option classes for each family, and the plan of a run."""
