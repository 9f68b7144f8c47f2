"""Procedures of the paper of 2016: implicit Runge-Kutta, Newmark and BDF steps with an outer and an inner loop."""
