"""Code for one mechanism: traced callbacks, Taylor series, symbolic elimination, machine code."""
