"""Implicit Runge-Kutta, Newmark and BDF steps of the paper (Zhang & Zhang, 2016), with an outer and an inner loop."""
