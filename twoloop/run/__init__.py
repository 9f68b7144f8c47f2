"""Integration of one run: its arrays, its loop in chunks, the solution between steps, and the message at its end."""
