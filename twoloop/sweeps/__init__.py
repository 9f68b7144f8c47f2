"""Many runs of one mechanism in parallel, with rows that are saved."""
