"""Code for one mechanism: its callbacks traced, Taylor series, straight-line code, machine code."""
