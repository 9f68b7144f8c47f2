"""Hypothesis without deadlines (the first call may compile) and always with the same examples; shared problems."""

import pytest
from hypothesis import settings

from twoloop.mechanisms import four_bar

settings.register_profile("twoloop", deadline=None, derandomize=True, max_examples=25)
settings.load_profile("twoloop")


@pytest.fixture(scope="session")
def default_four_bar():
    return four_bar()


@pytest.fixture(scope="session")
def collinear_four_bar():
    """The second geometry: bars 1 and 2 come into line, where theta_3 alone does not determine the rest."""
    return four_bar(lengths=(0.8, 1.2, 1.0), ground=2.0, theta3=0.0, branch=-1)
