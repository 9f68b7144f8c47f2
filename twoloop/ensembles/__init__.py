"""Many runs of one system: one after another with one setup, or thousands at once with their own parameters."""
