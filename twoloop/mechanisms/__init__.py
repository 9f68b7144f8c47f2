"""Ready problems, each with its invariants and, where one exists, a reference."""

from twoloop.mechanisms.four_bar import four_bar
from twoloop.mechanisms.problem import Problem, Reference

__all__ = ["Problem", "Reference", "four_bar"]
