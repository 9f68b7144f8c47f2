"""Several runs of one mechanism at once, each in its own SIMD lane: memory, integration loop, a module per method."""
