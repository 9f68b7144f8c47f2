"""Ready problems, each with its invariants and, where one exists, a reference."""

from twoloop.mechanisms.ancf_beam import ancf_beam, moderately_stiff_beam, very_flexible_beam
from twoloop.mechanisms.four_bar import four_bar
from twoloop.mechanisms.problem import Problem, Reference

__all__ = ["Problem", "Reference", "ancf_beam", "four_bar", "moderately_stiff_beam", "very_flexible_beam"]
