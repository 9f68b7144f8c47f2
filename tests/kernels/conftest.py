import pytest

from twoloop.mechanisms import planar
from twoloop.run import static_form


@pytest.fixture
def large(monkeypatch):
    """What sets from how many coordinates on the static form is taken: here by all."""

    def set_to(n):
        monkeypatch.setattr(static_form, "LARGE", n)
        monkeypatch.setattr(planar, "LARGE", n)

    set_to(0)
    return set_to
