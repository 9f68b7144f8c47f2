"""diffrax."""
