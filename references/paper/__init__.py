"""References for the paper: its step in NumPy, an ablation, a substitute for ADAMS, the minimal four-bar."""
