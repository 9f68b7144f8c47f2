"""One file an outer loop: a step of a method, and what it is made of."""
