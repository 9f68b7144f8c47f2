"""Rows with the results of solver runs: their exchange format, cost at equal error, and the leaderboard."""
