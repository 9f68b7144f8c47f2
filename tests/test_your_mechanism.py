"""The code of docs/your_mechanism.md, as printed: one slider-crank, three times."""

import numpy as np
import pytest

from tests.test_pages import blocks
from twoloop import solve_dae


@pytest.fixture(scope="module")
def names():
    known = {}
    for block in blocks("docs/your_mechanism.md"):
        exec(block, known)
        known.setdefault("results", []).append(known["result"])
    return known


def test_all_three_are_one_mechanism(names):
    systems = names["plain"], names["compiled"], names["problem"].system
    generic = np.random.default_rng(2)
    for _ in range(5):
        q, v = generic.normal(size=3), generic.normal(size=3)
        for kind, state in (("mass", [q]), ("force", [q, v]), ("constraint", [q]), ("jacobian", [q])):
            first, *others = (system.evaluate(kind, 0.0, *state) for system in systems)
            assert all(np.abs(other - first).max() < 1e-13 * max(1.0, np.abs(first).max()) for other in others)
    ends = [solve_dae(s, (0.0, 2.0), names["q0"], names["v0"], rtol=1e-8, atol=1e-8).q[:, -1] for s in systems]
    assert np.ptp(ends, axis=0).max() < 1e-5
    assert names["problem"].q0 == pytest.approx(names["q0"], abs=1e-14)
    assert np.ptp(names["energy"]) < 1e-5


def test_what_the_page_says_of_the_others(names):
    assert names["problem"].conserved
    assert not names["start"].conserved
    assert names["heavier"].system.given == names["problem"].system.given
    assert names["heavier"].parameters["m3"] == 3.0
    assert np.ptp(names["swing"].energy(names["swung"].t, names["swung"].q, names["swung"].v)) < 1e-4
