"""What a user chooses: frozen options, one file a family, and what a method hands to a run."""
