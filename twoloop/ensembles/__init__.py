"""Many runs of one system: one setup used again and again, or thousands at once with parameters and starts of each."""
