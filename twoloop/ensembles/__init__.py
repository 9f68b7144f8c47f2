"""Many runs of one system: the same again and again, or thousands at once with parameters and starts of their own."""
