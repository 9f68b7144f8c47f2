"""What a user writes: systems, callbacks in plain Python, joints, events, drawings, and the problem of them all."""
