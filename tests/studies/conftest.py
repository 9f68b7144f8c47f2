"""Figures of made-up rows are made, and not saved: that takes longer than all else."""

import matplotlib.pyplot as plt
import pytest

from studies import figures


@pytest.fixture
def unsaved(monkeypatch):
    """Leave figures unsaved within a test."""
    monkeypatch.setattr(figures, "save", lambda figure, output, name: plt.close(figure))
