"""CyRK: Runge-Kutta methods in C++, driven from compiled code."""
