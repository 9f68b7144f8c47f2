"""Factors by a program against numpy, and how long the programs of growing mechanisms are."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.chains import chain
from tests.problems import entry
from twoloop.kernels.algebra import elimination, factors
from twoloop.methods.dop853 import DOP853
from twoloop.run.run import Run

make_program, factor = entry(factors.make_program), entry(factors.factor)
solve, solve_transposed, sign_of = entry(factors.solve), entry(factors.solve_transposed), entry(factors.sign_of)


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
        row_order, column_order = (
            index[elimination.N_HEAD : elimination.N_HEAD + r],
            index[elimination.N_HEAD + r : elimination.N_HEAD + 2 * r],
        )
        places = np.searchsorted(columns, column_order)
        b = (A @ x)[row_order]
        solve(index, values, b)
        assert np.abs(b - x[places]).max() < allowed
        b = (A.T @ x)[places]
        solve_transposed(index, values, b)
        assert np.abs(b - x[row_order]).max() < allowed and sign_of(index, values) == np.sign(np.linalg.det(A))
        G *= 2.0
        A = G[:r, columns]


def test_dense_factors_where_entries_are_many():
    G, pattern, columns = sparse_rows(np.random.default_rng(1), elimination.WIDEST + 6, elimination.WIDEST + 6, 1.0)
    regular, index, values = program(G, pattern, columns)
    assert regular and index[elimination.DENSE] == 1 and factor(G.reshape(-1), index, values) > 0.0
    assert sign_of(index, values) == np.linalg.slogdet(G[:-1, columns])[0]


@pytest.mark.parametrize("share", [0.1, 1.0])
def test_singular_matrices_have_no_program(share):
    G, pattern, columns = sparse_rows(np.random.default_rng(2), 12, 12, share)
    G[3], pattern[3] = G[7], pattern[7]
    assert not program(G, pattern, columns)[0]


def work_of(n, closed=False):
    problem = chain(n, closed)
    n_q = problem.system.n_q
    plan = DOP853().plan(n_q, 1e-8, 1e-8, False)
    return Run(problem.system, plan, 0.0, problem.q0, problem.v0, 1e-8, np.full(n_q, 1e-8), None).work


def operations(index):
    """Entries of the factors, and subtractions that make them."""
    r, n_slots = index[elimination.SIZE], index[elimination.N_SLOTS]
    begin, end = (
        index[elimination.N_HEAD + 3 * r : elimination.N_HEAD + 4 * r],
        index[elimination.N_HEAD + 4 * r : elimination.N_HEAD + 5 * r],
    )
    in_column = elimination.N_HEAD + 6 * r + 1 + n_slots
    lower = index[in_column + index[elimination.FIRST_LOWER] : in_column + n_slots]
    return int(n_slots), int((end - begin)[lower].sum())


@pytest.mark.parametrize("closed", [False, True])
def test_programs_of_a_chain_grow_as_its_length(closed):
    """Entries and subtractions for each body of 20 bodies and of 160, of C_qd and of the augmented matrix."""
    small, large = (
        [operations(index) for index in (work.index, work.index_a)]
        for work in (work_of(20, closed), work_of(160, closed))
    )
    for few, many in zip(small, large, strict=True):
        assert many[0] / 160 <= 1.2 * few[0] / 20 and many[1] / 160 <= 1.3 * few[1] / 20
    assert large[1][0] <= 16 * 160 and large[1][1] <= 16 * 160
