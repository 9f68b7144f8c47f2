"""Test the dense, sparse and lane-wise factorisations, and the choice of rows, against NumPy."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.problems import called, entry
from twoloop.generate.elimination import RANK_TOL, SINGULAR_MASS, START_LIMITS
from twoloop.kernels.lanes import layout
from twoloop.kernels.lanes.layout import ACTIVE, LANES, N_FIELDS
from twoloop.kernels.linalg import dense as linalg
from twoloop.kernels.linalg import markowitz_lu as elimination
from twoloop.kernels.linalg import markowitz_lu as factors
from twoloop.kernels.linalg.rank import STAYS_SINGULAR, choose_rows, workspace_size

# not positive definite, and singular or not finite
UNFIT = [[[1.0, 2.0], [2.0, 4.0]], [[0.0, 0.0], [0.0, 1.0]], [[np.nan, 1.0], [1.0, 1.0]]]


@pytest.mark.parametrize("A", [*UNFIT, [[-1.0, 0.0], [0.0, 1.0]]])
def test_matrices_without_factors_are_refused(A):
    assert not called(linalg.ldl_factor, np.array(A)) and not called(linalg.invert_definite, np.array(A))
    if A in UNFIT:
        assert not called(linalg.lu_factor, np.array(A), np.zeros(2, dtype=np.int64)) > 1e-14


N = 5


@pytest.mark.parametrize("imaginary", [False, True])
def test_systems_are_solved_with_rows_exchanged_as_each_lane_needs(imaginary):
    random = np.random.default_rng(7)
    matrices, x = random.standard_normal((2, LANES, N, N)), random.standard_normal((2, LANES, N))
    matrices[:, 1::2, 0, 0] = 0.0  # no pivot without an exchange
    matrices[:, 2, :, 0] *= 1e-9
    parts = 2 if imaginary else 1
    A = matrices[0] + 1j * matrices[1] * (parts - 1)
    right = np.einsum("kij,kj->ki", A, x[0] + 1j * x[1] * (parts - 1))
    matrix, pivots = N_FIELDS, N_FIELDS + 2 * N * N
    room = np.zeros((pivots + 3 * N, LANES))
    room[ACTIVE] = 1.0
    room[matrix : matrix + 2 * N * N] = np.concatenate([A.real, A.imag], axis=1).reshape(LANES, -1).T
    room[pivots + N :] = np.concatenate([right.real, right.imag], axis=1).T
    flat, apart = room.ravel(), N * N * (parts - 1)
    called(layout.factor_matrices, flat, matrix, pivots, N, apart)
    called(layout.solve_systems, flat, matrix, pivots, N, apart, pivots + N)
    found = room[pivots + N :].reshape(2, N, LANES)[:parts]
    assert np.abs(found - x[:parts].transpose(0, 2, 1)).max() < 1e-4 and (room[ACTIVE] == 1.0).all()
    assert np.delete(np.abs(found - x[:parts].transpose(0, 2, 1)), 2, axis=2).max() < 1e-11


def test_a_singular_matrix_is_noted_in_its_lane_alone():
    room = np.zeros((N_FIELDS + N * N + N, LANES))
    room[ACTIVE] = 1.0
    room[N_FIELDS : N_FIELDS + N * N] = np.eye(N).reshape(-1, 1)
    room[N_FIELDS + 6, 3] = 0.0
    called(layout.factor_matrices, room.ravel(), N_FIELDS, N_FIELDS + N * N, N, 0)
    assert np.flatnonzero(room[ACTIVE] != 1.0).tolist() == [3]


make_program, factor = entry(factors.make_program), entry(factors.factor)
solve, solve_transposed = entry(factors.solve), entry(factors.solve_transposed)
determinant_sign = entry(factors.determinant_sign)


def sparse_rows(rng, r, n, share):
    """G (r + 1, n), its last row zero, its pattern, and columns of a regular square."""
    pattern = rng.uniform(size=(r, n)) < share
    columns = rng.permutation(n)[:r]
    pattern[np.arange(r), columns] = True
    G = np.zeros((r + 1, n))
    G[:r] = pattern * rng.normal(size=(r, n))
    G[np.arange(r), columns] += 3.0
    return G, pattern.astype(float), np.sort(columns)


def program(G, pattern, columns):
    r = len(columns)
    index, values = np.zeros(elimination.index_size(r), dtype=np.int64), np.zeros(elimination.values_size(r))
    return make_program(G, pattern, np.arange(r), columns, index, values), index, values


@pytest.mark.slow  # compiles for seconds
@settings(max_examples=15)
@given(st.integers(1, 40), st.integers(0, 5), st.sampled_from([0.05, 0.1, 0.3, 1.0]), st.integers(0, 2**32 - 1))
def test_factors_solve(r, n_free, share, seed):
    rng = np.random.default_rng(seed)
    G, pattern, columns = sparse_rows(rng, r, r + n_free, share)
    A, x = G[:r, columns], rng.normal(size=r)
    allowed = 1e-12 * np.linalg.cond(A) * np.abs(x).max()
    regular, index, values = program(G, pattern, columns)
    if not regular:  # by the numbers drawn
        assert np.linalg.cond(A) > 1e9
        return
    for _ in range(2):  # the second time with other numbers in the same places
        assert factor(G.reshape(-1), index, values) > 0.0
        row_order, column_order = index[elimination.N_HEAD : elimination.N_HEAD + 2 * r].reshape(2, r)
        places = np.searchsorted(columns, column_order)
        b = (A @ x)[row_order]
        solve(index, values, b)
        assert np.abs(b - x[places]).max() < allowed
        b = (A.T @ x)[places]
        solve_transposed(index, values, b)
        assert np.abs(b - x[row_order]).max() < allowed and determinant_sign(index, values) == np.sign(np.linalg.det(A))
        G *= 2.0
        A = G[:r, columns]


@pytest.mark.parametrize("share", [0.1, 1.0])
@pytest.mark.slow
def test_singular_matrices_have_no_program(share):
    G, pattern, columns = sparse_rows(np.random.default_rng(2), 12, 12, share)
    G[3], pattern[3] = G[7], pattern[7]
    assert not program(G, pattern, columns)[0]


RANDOM = np.random.default_rng(12)
ROWS = RANDOM.standard_normal((5, 8))


def chosen(mass, G):
    """What the kernel says of M and G: the bound that pivots keep, rows that count and that help, and the factor."""
    room, found = np.full(workspace_size(*G.shape), np.nan), np.zeros(2 + 3 * len(G), dtype=np.int64)
    place = choose_rows(
        np.ascontiguousarray(mass), np.ascontiguousarray(G), RANK_TOL, SINGULAR_MASS, START_LIMITS, room, found
    )
    n_kept, n_added, *places = found.tolist()
    return place, places[:n_kept], places[len(G) : len(G) + n_added], room[0]


@pytest.mark.parametrize("near", [1.0, 1e-1, 1e-6])  # with the last, the rows are orthogonalised one by one
@pytest.mark.parametrize("position", [3, 5])
def test_the_bound_is_below_the_least_eigenvalue_of_rows_that_do_not_depend_on_earlier_ones(near, position):
    G = np.vstack([ROWS[:3], ROWS[0] + near * ROWS[3], ROWS[4]])
    mass = np.diag(10.0 ** np.linspace(-1.0, 1.0, 8)) + 0.01 * np.ones((8, 8))
    S = G @ np.linalg.solve(mass, G.T)
    size = np.sqrt(np.diag(S))
    expected = int((np.linalg.eigvalsh(S / np.outer(size, size))[0] < START_LIMITS).sum())
    place, kept, *_ = chosen(mass, np.insert(G, position, 0.5 * (ROWS[1] - ROWS[2]), axis=0))
    assert place == expected and kept == [k for k in range(6) if k != position]
    assert near == 1.0 or expected > chosen(mass, ROWS[:4])[0]


@pytest.mark.parametrize("n_weak", [0, 1, 3])
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
