"""Runs of one mechanism side by side, one in each lane of vectors: their memory, their course, and a file a method."""
