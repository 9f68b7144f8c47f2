"""Forces and impulses of contact, with rows that depend on one another, against the conditions that define them."""

import numpy as np
import pytest

from twoloop.impacts.laws import Rubs, Undetermined, coulomb

NO_RUBS = Rubs(np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros(0, dtype=np.int64))


@pytest.mark.parametrize("joints", [0, 1, 2])
def test_stops_that_depend_on_one_another_keep_their_conditions(joints):
    """Up to four stops in two directions, whose rates need not fit together, with joints that friction holds."""
    numbers, found = np.random.default_rng(3), 0
    for _ in range(200):
        n = int(numbers.integers(1, 5))
        W = np.vstack([numbers.normal(size=(n, 2)) @ np.eye(2, 4), numbers.normal(size=(joints, 4))])
        D, c = W @ W.T, numbers.normal(size=n + joints)
        most = numbers.uniform(0.1, 2.0, joints)
        try:
            x, _ = coulomb(D, c, most, NO_RUBS)
        except Undetermined:
            continue
        found += 1
        opens, close = D @ x + c, 1e-7 * (1.0 + np.abs(x).max())
        assert (
            (x[:n] >= 0.0).all() and (opens[:n] >= -close).all() and (x[:n] * opens[:n] <= close * (1.0 + x[:n])).all()
        )
        assert (np.abs(x[n:]) <= most * (1.0 + 1e-9)).all()
        slides = np.abs(opens[n:]) > close
        np.testing.assert_allclose(x[n:][slides], (-np.sign(opens[n:]) * most)[slides], rtol=1e-6)
    assert found > 100
