"""Runs of one mechanism, one in each SIMD lane: their memory, their loop, and a file for each method."""
