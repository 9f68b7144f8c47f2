"""Mechanisms beyond full-rank holonomic ones: redundant rows, singular masses, non-holonomic rows, changing rank."""
