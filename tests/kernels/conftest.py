import pytest

from twoloop.mechanisms import planar
from twoloop.run import workspace


@pytest.fixture
def large(monkeypatch):
    """What sets from how many coordinates on the fixed-order form is taken: here by all."""

    def set_to(n):
        monkeypatch.setattr(workspace, "LARGE", n)
        monkeypatch.setattr(planar, "LARGE", n)

    set_to(0)
    return set_to


@pytest.fixture
def both(large):
    """What makes the same twice: by the dense forms, and by the fixed-order form."""

    def made(make):
        found = []
        for least in (10**9, 0):
            large(least)
            found.append(make())
        return found

    return made
