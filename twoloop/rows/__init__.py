"""Rows of runs of solvers, as they are shipped and exchanged: their format, costs at equal error, the leaderboard."""
