"""Rows that count, bounds that their pivots keep, and units in which entries are of like size: as NumPy has them."""

import numpy as np
import pytest

from twoloop.checks.rank import least_solution, orthogonalised, surely_above
from twoloop.checks.scales import column_scales
from twoloop.generate.choices import BOUNDS, LEAST, RANK, SINGULAR_MASS
from twoloop.kernels.algebra.pivots import STAYS_SINGULAR, choose, room_size

RANDOM = np.random.default_rng(12)
ROWS = RANDOM.standard_normal((5, 8))
DEPENDENT = np.vstack([ROWS[:2], ROWS[0] - 3.0 * ROWS[1], np.zeros(8), ROWS[2:], ROWS.sum(axis=0)])


@pytest.mark.parametrize(("rows", "kept"), [(ROWS, range(5)), (DEPENDENT, (0, 1, 4, 5, 6)), (ROWS.T, range(5))])
def test_the_first_rows_that_no_others_add_up_to(rows, kept):
    basis, factors, which = orthogonalised(rows, 1e-9)
    assert which == list(kept) and np.allclose(basis @ basis.T, np.eye(len(which)), atol=1e-14)
    assert np.allclose(factors @ basis, rows[which], atol=1e-14) and not np.triu(factors, 1).any()


@pytest.mark.parametrize(
    "rows", [ROWS, DEPENDENT, DEPENDENT.T, ROWS * 10.0 ** np.arange(-4, 1)[:, None], np.zeros((2, 8))], ids=str
)
def test_the_least_solution_is_that_of_the_pseudo_inverse(rows):
    values = RANDOM.standard_normal(len(rows))
    x, left = least_solution(rows, values)
    expected = np.linalg.pinv(rows, rcond=1e-10) @ values
    size = np.abs(expected).max(initial=1.0)
    assert np.allclose(x, expected, atol=1e-9 * size) and np.allclose(left, values - rows @ expected, atol=1e-9 * size)


@pytest.mark.parametrize("size", [1e-6, 1.0, 1e8])
@pytest.mark.parametrize("rows", [ROWS, DEPENDENT, ROWS * 10.0 ** np.arange(-4, 1)[:, None], 0.0 * ROWS], ids=str)
def test_what_is_surely_above_a_share_of_the_largest_singular_value_is(rows, size):
    values, rank = np.linalg.svd(rows, compute_uv=False), np.linalg.matrix_rank(rows)
    ratio = values[rank - 1] / np.linalg.norm(rows) if rank else 0.0
    for share in np.geomspace(1e-6, 1.0, 40):
        surely = surely_above(share, size * rows, rank)
        assert not (surely and share > ratio * (1.0 + 1e-9))
        assert surely or rank < len(rows) or share > ratio * (1.0 - 1e-3)
    assert not surely_above(1e-6, np.full((2, 3), np.nan), 2)


@pytest.mark.parametrize(("near", "known"), [(1e-14, True), (1e-11, False), (1e-9, False), (1e-7, True)])
def test_where_a_direction_may_count_or_not_there_is_no_least_solution(near, known):
    rows = np.vstack([ROWS[:3], ROWS[0] + near * ROWS[3]]) / 4.0
    found = least_solution(rows, np.ones(4))
    assert (found is not None) is known


def chosen(mass, G):
    """What the kernel says of M and G: the bound that pivots keep, rows that count and that help, and the factor."""
    room, found = np.full(room_size(*G.shape), np.nan), np.zeros(2 + 3 * len(G), dtype=np.int64)
    place = choose(np.ascontiguousarray(mass), np.ascontiguousarray(G), RANK, SINGULAR_MASS, BOUNDS, room, found)
    n_kept, n_added, *places = found.tolist()
    return place, places[:n_kept], places[len(G) : len(G) + n_added], room[0]


def least_pivot(mass, G):
    return LEAST[chosen(mass, G)[0]]


@pytest.mark.parametrize("near", [1.0, 1e-1, 1e-3, 1e-6])
def test_the_least_pivot_is_the_power_of_ten_below_the_least_eigenvalue(near):
    G = np.vstack([ROWS[:3], ROWS[0] + near * ROWS[3]])
    mass = np.diag(10.0 ** np.linspace(-1.0, 1.0, 8)) + 0.01 * np.ones((8, 8))
    S = G @ np.linalg.solve(mass, G.T)
    size = np.sqrt(np.diag(S))
    expected = LEAST[int((np.linalg.eigvalsh(S / np.outer(size, size))[0] < BOUNDS).sum())]
    assert least_pivot(mass, G) == expected and (near == 1.0 or expected < least_pivot(mass, ROWS[:4]))


def test_one_row_has_the_largest_least_pivot():
    assert least_pivot(np.eye(8), 0.3 * ROWS[:1]) == LEAST[0] == 0.01


@pytest.mark.parametrize("n_weak", [0, 1, 2, 3])
def test_rows_that_help_a_mass_to_an_inverse_are_as_many_as_it_lacks(n_weak):
    Q = np.linalg.qr(RANDOM.standard_normal((8, 8)))[0]
    values = np.where(np.arange(8) < n_weak, 1e-14, 10.0 ** np.linspace(-3.0, 2.0, 8))
    mass = Q * values @ Q.T
    sparse = np.zeros((2, 8))
    sparse[0, :2], sparse[1] = 1.0, Q[:, 7]  # few entries, and none that helps
    place, kept, added, scale = chosen(0.5 * (mass + mass.T), np.vstack([ROWS, sparse]))
    assert kept == list(range(7)) and place >= 0 and len(added) == n_weak and 6 not in added
    assert added[:1] == [5][:n_weak]  # that of the fewest entries comes first
    more = mass + scale * np.vstack([ROWS, sparse])[added].T @ np.vstack([ROWS, sparse])[added]
    assert np.linalg.eigvalsh(more)[0] > 1e-10 * np.linalg.eigvalsh(more)[-1]


def test_a_mass_that_no_row_helps_stays_singular():
    mass = np.diag([1.0, 1.0, 0.0])
    assert chosen(mass, np.array([[1.0, 0.0, 0.0]]))[0] == STAYS_SINGULAR
    assert chosen(mass, np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 2.0]]))[2] == [1]


def test_units_that_were_multiplied_into_a_matrix_are_found():
    units, norms = 10.0 ** RANDOM.uniform(-3.0, 3.0, 8), 10.0 ** RANDOM.uniform(-3.0, 3.0, 5)
    signs = RANDOM.choice((-1.0, 1.0), (5, 8))
    found = column_scales(norms[:, None] * signs / units, np.ones(8))
    assert np.ptp(np.log(found / units)) < 1e-12 and np.median(np.log(found)) == pytest.approx(0.0, abs=1e-12)
    without = column_scales(np.where(np.arange(8) == 3, 0.0, signs), np.full(8, 2.5))
    assert without[3] == 2.5
