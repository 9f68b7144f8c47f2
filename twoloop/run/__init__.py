"""One run: its arrays, its loop in chunks, the solution between steps, and what is said of how it ended."""
