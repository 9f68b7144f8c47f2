"""What comes out: the result, and what can be made of it."""
