"""Mechanisms in minimal coordinates."""
