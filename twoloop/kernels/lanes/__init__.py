"""Runs of one mechanism side by side, one in each SIMD lane: their memory, their loop, and a file for each method."""
