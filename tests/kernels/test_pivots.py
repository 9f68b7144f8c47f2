"""Rows that count, bounds that their pivots keep, and units in which entries are of like size: as NumPy has them."""

import numpy as np
import pytest

from twoloop.checks.rank import largest_solution, orthogonalised
from twoloop.checks.scales import column_scales
from twoloop.generate.choices import BOUNDS, LEAST, _least_pivot

RANDOM = np.random.default_rng(12)
ROWS = RANDOM.standard_normal((5, 8))
DEPENDENT = np.vstack([ROWS[:2], ROWS[0] - 3.0 * ROWS[1], np.zeros(8), ROWS[2:], ROWS.sum(axis=0)])


@pytest.mark.parametrize(("rows", "kept"), [(ROWS, range(5)), (DEPENDENT, (0, 1, 4, 5, 6)), (ROWS.T, range(5))])
def test_the_first_rows_that_no_others_add_up_to(rows, kept):
    basis, factors, which = orthogonalised(rows, 1e-9)
    assert which == list(kept)
    assert np.allclose(basis @ basis.T, np.eye(len(which)), atol=1e-14)
    assert np.allclose(factors @ basis, rows[which], atol=1e-14) and not np.triu(factors, 1).any()


@pytest.mark.parametrize("rows", [ROWS, DEPENDENT, ROWS * 10.0 ** np.arange(-4, 1)[:, None]], ids=str)
def test_no_solution_is_larger(rows):
    inverse, bound = np.linalg.pinv(rows, rcond=1e-10), largest_solution(rows)
    assert max(np.linalg.norm(inverse, 2), 1.0) <= bound <= max(np.linalg.norm(inverse), 1.0) * 10.0


@pytest.mark.parametrize("near", [1.0, 1e-1, 1e-3, 1e-6])
def test_the_least_pivot_is_the_power_of_ten_below_the_least_eigenvalue(near):
    G = np.vstack([ROWS[:3], ROWS[0] + near * ROWS[3]])
    mass = np.diag(10.0 ** np.linspace(-1.0, 1.0, 8)) + 0.01 * np.ones((8, 8))
    S = G @ np.linalg.solve(mass, G.T)
    size = np.sqrt(np.diag(S))
    least = np.linalg.eigvalsh(S / np.outer(size, size))[0]
    expected = LEAST[int((least < BOUNDS).sum())]
    assert _least_pivot(mass, G, "some") == expected
    assert near == 1.0 or expected < _least_pivot(mass, ROWS[:4], "some")


def test_one_row_has_the_largest_least_pivot():
    assert _least_pivot(np.eye(8), 0.3 * ROWS[:1], "some") == LEAST[0] == 0.01


def test_units_that_were_multiplied_into_a_matrix_are_found():
    units, norms = 10.0 ** RANDOM.uniform(-3.0, 3.0, 8), 10.0 ** RANDOM.uniform(-3.0, 3.0, 5)
    signs = RANDOM.choice((-1.0, 1.0), (5, 8))
    found = column_scales(norms[:, None] * signs / units, np.ones(8))
    assert np.ptp(np.log(found / units)) < 1e-12
    assert np.median(np.log(found)) == pytest.approx(0.0, abs=1e-12)
    without = column_scales(np.where(np.arange(8) == 3, 0.0, signs), np.full(8, 2.5))
    assert without[3] == 2.5
