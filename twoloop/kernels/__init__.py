"""Compiled code only: one file a loop."""
