"""What a user writes: systems, callbacks in plain Python, joints, events, drawings, and problems."""
