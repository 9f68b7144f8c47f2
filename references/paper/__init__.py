"""What the paper is judged by: its step in NumPy, its idea alone, a stand-in for ADAMS, the linkage in one angle."""
