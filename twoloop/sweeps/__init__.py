"""Many runs of one mechanism, in processes, with rows that are kept."""
