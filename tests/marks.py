"""Cases that take long or repeat what another one shows: `make test` leaves them out, `make test-all` runs them."""

import pytest


def slow(*case):
    """A case of `pytest.mark.parametrize` that is slow."""
    return pytest.param(*case, marks=pytest.mark.slow)


def slow_but(quick, cases):
    """Cases, all of which are slow but the quick ones."""
    return [case if case in quick else slow(case) for case in cases]
