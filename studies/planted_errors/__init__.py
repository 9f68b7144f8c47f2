"""Faults planted one at a time: which of our checks catches each, and which none does."""

from studies.planted_errors.study import main as main
