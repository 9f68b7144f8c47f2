"""Define the result of a run and its views."""
