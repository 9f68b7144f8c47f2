"""The dense factorisations against numpy, on random matrices with and without zeros."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.problems import entry
from twoloop.kernels.algebra import linalg

lu_factor, lu_solve = entry(linalg.lu_factor), entry(linalg.lu_solve)
ldl_factor, ldl_solve = entry(linalg.ldl_factor), entry(linalg.ldl_solve)
ldl_solve_rows, invert_definite = entry(linalg.ldl_solve_rows), entry(linalg.invert_definite)
sizes = st.integers(1, 12)
seeds = st.integers(0, 2**32 - 1)


def sparse(rng, n):
    """A random matrix with zeros, not near singular."""
    A = rng.normal(size=(n, n)) * (rng.uniform(size=(n, n)) > 0.4)
    return np.ascontiguousarray((A + 3.0 * np.eye(n))[rng.permutation(n)])


@given(sizes, seeds)
def test_lu_solves(n, seed):
    rng = np.random.default_rng(seed)
    A, x = sparse(rng, n), rng.normal(size=n)
    factors, b, pivots = A.copy(), A @ x, np.zeros(n, dtype=np.int64)
    ratio = lu_factor(factors, pivots)
    lu_solve(factors, pivots, b)
    assert 0.0 < ratio <= 1.0 and np.abs(b - x).max() < 1e-13 * np.linalg.cond(A) * max(1.0, np.abs(x).max())


@given(sizes, seeds)
def test_ldl_solves_reads_the_upper_triangle_only_and_inverts(n, seed):
    rng = np.random.default_rng(seed)
    B, x = sparse(rng, n), rng.normal(size=(n, 3))
    A = B @ B.T + np.eye(n)
    factors, inverse, right, b = np.triu(A), A.copy(), A @ x, A @ x[:, 0]
    assert ldl_factor(factors) and invert_definite(inverse)
    ldl_solve(factors, b)
    ldl_solve_rows(factors, right)
    allowed = 1e-13 * np.linalg.cond(A) * max(1.0, np.abs(x).max())
    assert np.abs(b - x[:, 0]).max() < allowed and np.abs(right - x).max() < allowed
    assert np.abs(inverse @ A - np.eye(n)).max() < 1e-13 * n * np.linalg.cond(A)


@pytest.mark.parametrize("A", [[[1.0, 2.0], [2.0, 4.0]], [[0.0, 0.0], [0.0, 1.0]], [[np.nan, 1.0], [1.0, 1.0]]])
def test_lu_says_singular_or_not_finite_by_zero(A):
    assert not lu_factor(np.array(A), np.zeros(2, dtype=np.int64)) > 1e-14


def test_lu_ratio_measures_the_pivots():
    assert lu_factor(np.diag([1.0, 1e-5, 0.1]), np.zeros(3, dtype=np.int64)) == pytest.approx(1e-5)


@pytest.mark.parametrize(
    "A", [[[1.0, 2.0], [2.0, 1.0]], [[0.0, 0.0], [0.0, 1.0]], [[-1.0, 0.0], [0.0, 1.0]], [[np.nan, 0.0], [0.0, 1.0]]]
)
def test_ldl_refuses_what_is_not_positive_definite(A):
    assert not ldl_factor(np.array(A)) and not invert_definite(np.array(A))
