"""Many runs in parallel, as a table whose rows are saved."""
