"""Runs of one mechanism, one in each SIMD lane: layout of memory, integration loop, and a module for each method."""
