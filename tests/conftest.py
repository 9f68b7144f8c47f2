"""Hypothesis without deadlines (the first call may compile) and always with the same examples; shared problems."""

import pytest
from hypothesis import settings

from tests.problems import LINKAGES

settings.register_profile("twoloop", deadline=None, derandomize=True, max_examples=25)
settings.load_profile("twoloop")


@pytest.fixture(scope="session")
def default_four_bar():
    return LINKAGES["default"]


@pytest.fixture(scope="session")
def collinear_four_bar():
    return LINKAGES["collinear"]
