"""Tableaux: Table 1, order conditions by all rooted trees, simplifying assumptions, symplecticity, stability."""

from functools import cache
from itertools import combinations_with_replacement

import numpy as np
import pytest
from scipy.integrate import DOP853

from twoloop.methods import dop853
from twoloop.methods.tableaux import gauss, lobatto_iiie, radau_iia, sun_radau_iib

FAMILIES = {"gauss": gauss, "radau_iia": radau_iia, "sun_radau_iib": sun_radau_iib, "lobatto_iiie": lobatto_iiie}
ORDERS = {
    "gauss": lambda s: 2 * s,
    "radau_iia": lambda s: 2 * s - 1,
    "sun_radau_iib": lambda s: max(2, 2 * s - 1),  # one stage: the midpoint rule
    "lobatto_iiie": lambda s: 2 * s - 2,
}
# B(p), C(eta), D(zeta) of s stages
ASSUMPTIONS = {
    "gauss": lambda s: (2 * s, s, s),
    "radau_iia": lambda s: (2 * s - 1, s, s - 1),
    "sun_radau_iib": lambda s: (2 * s - 1, s - 1, s - 1),
    "lobatto_iiie": lambda s: (2 * s - 2, s - 2, s - 2),
}
SMALL = [(family, s) for family in FAMILIES for s in range(2 if family == "lobatto_iiie" else 1, 6)]
LARGE = [(family, s) for family in FAMILIES for s in (3, 6, 8, 10)]


@cache
def trees(n):
    """All rooted trees with n vertices; a tree is the sorted tuple of the trees that hang on its root."""
    if n == 1:
        return ((),)
    return tuple(sorted({tuple(sorted(forest)) for forest in forests(n - 1, n - 1)}))


@cache
def forests(n, largest):
    """All multisets of trees of at most `largest` vertices that have n vertices together."""
    if n == 0:
        return ((),)
    if largest == 0:
        return ()
    found = []
    for copies in range(n // largest + 1):
        for some in combinations_with_replacement(trees(largest), copies):
            found += [some + rest for rest in forests(n - copies * largest, largest - 1)]
    return tuple(found)


def size(tree):
    return 1 + sum(size(branch) for branch in tree)


def density(tree):
    value = size(tree)
    for branch in tree:
        value *= density(branch)
    return value


def stage_weights(tree, A):
    value = np.ones(len(A))
    for branch in tree:
        value = value * (A @ stage_weights(branch, A))
    return value


def order_defect(tableau, n):
    """Largest violation of an order condition with n vertices."""
    return max(abs(tableau.b @ stage_weights(tree, tableau.A) - 1.0 / density(tree)) for tree in trees(n))


def pruned(tree):
    """The trees that are left when one leaf is taken off, one for each leaf."""
    found = []
    for k, branch in enumerate(tree):
        rest = tree[:k] + tree[k + 1 :]
        found += [tuple(sorted((*rest, one)) if one is not None else rest) for one in (pruned(branch) or [None])]
    return found


def defect_up_to_conjugacy(tableau, p):
    """Least violation of the conditions of order p + 1 by chi o Phi o chi^-1, with chi = identity + O(h^p) a B-series.

    For a method of order p conjugation by the B-series beta changes the coefficient of a tree by the sum of beta over
    the tree less a leaf, and, where it has one branch only, by minus the beta of that branch.
    """
    place = {tree: k for k, tree in enumerate(trees(p))}
    change = np.zeros((len(trees(p + 1)), len(place)))
    defect = np.zeros(len(change))
    for k, tree in enumerate(trees(p + 1)):
        defect[k] = tableau.b @ stage_weights(tree, tableau.A) - 1.0 / density(tree)
        for rest in pruned(tree):
            change[k, place[rest]] += 1.0
        if len(tree) == 1:
            change[k, place[tree[0]]] -= 1.0
    return np.abs(change @ np.linalg.lstsq(change, defect, rcond=None)[0] - defect).max()


@pytest.mark.parametrize("s", [2, 3, 4])
def test_sun_is_conjugate_to_a_method_of_one_order_more_and_radau_iia_is_not(s):
    # why Sun's error of order h^(2s-1) does not add up while its variables stay the same
    p = 2 * s - 1
    for tableau in (sun_radau_iib(s), radau_iia(s)):
        assert order_defect(tableau, p) < 1e-14 < 1e-5 < order_defect(tableau, p + 1)
    assert defect_up_to_conjugacy(sun_radau_iib(s), p) < 1e-14 and defect_up_to_conjugacy(radau_iia(s), p) > 1e-6


def test_the_trees_are_all_there():
    assert [len(trees(n)) for n in range(1, 11)] == [1, 1, 2, 4, 9, 20, 48, 115, 286, 719]  # OEIS A000081


def test_three_stages_of_sun_are_table_1():
    r = np.sqrt(6.0)
    tableau = sun_radau_iib(3)
    A = [
        [(16 - r) / 72, (328 - 167 * r) / 1800, (-2 + 3 * r) / 450],
        [(328 + 167 * r) / 1800, (16 + r) / 72, (-2 - 3 * r) / 450],
        [(85 - 10 * r) / 180, (85 + 10 * r) / 180, 1 / 18],
    ]
    np.testing.assert_allclose(tableau.A, A, rtol=0, atol=1e-15)
    np.testing.assert_allclose(tableau.b, [(16 - r) / 36, (16 + r) / 36, 1 / 9], rtol=0, atol=1e-15)
    np.testing.assert_allclose(tableau.c, [(4 - r) / 10, (4 + r) / 10, 1], rtol=0, atol=1e-15)


def test_two_stages_of_sun_are_the_known_rationals():
    tableau = sun_radau_iib(2)
    np.testing.assert_allclose(tableau.A, [[3 / 8, -1 / 24], [7 / 8, 1 / 8]], rtol=0, atol=1e-15)
    np.testing.assert_allclose(tableau.b, [3 / 4, 1 / 4], rtol=0, atol=1e-15)


@pytest.mark.parametrize(("family", "s"), SMALL)
def test_order_is_what_the_tableau_says_and_no_higher(family, s):
    tableau = FAMILIES[family](s)
    assert tableau.order == ORDERS[family](s) and tableau.stages == s
    assert np.abs(tableau.A.sum(axis=1) - tableau.c).max() < 1e-15
    for n in range(1, tableau.order + 1):
        assert order_defect(tableau, n) < 2e-15, n
    assert order_defect(tableau, tableau.order + 1) > 1e-8


@pytest.mark.parametrize(("family", "s"), LARGE)
def test_simplifying_assumptions_hold(family, s):
    tableau = FAMILIES[family](s)
    A, b, c = tableau.A, tableau.b, tableau.c
    assert (np.diff(c) > 0.0).all() and (b > 0.0).all()
    p, eta, zeta = ASSUMPTIONS[family](s)
    for k in range(1, p + 1):
        assert abs(b @ c ** (k - 1) - 1.0 / k) < 1e-14
    for k in range(1, eta + 1):
        assert np.abs(A @ c ** (k - 1) - c**k / k).max() < 1e-14
    for k in range(1, zeta + 1):
        assert np.abs((b * c ** (k - 1)) @ A - b * (1.0 - c**k) / k).max() < 1e-14


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("s", [2, 3, 4, 5, 8, 10])
def test_all_families_but_radau_iia_are_symplectic_to_rounding(family, s):
    tableau = FAMILIES[family](s)
    bA = tableau.b[:, None] * tableau.A
    symplectic = np.abs(bA + bA.T - np.outer(tableau.b, tableau.b)).max() < 1e-14
    assert symplectic == tableau.symplectic == (family != "radau_iia")


@pytest.mark.parametrize("s", [2, 3, 4, 5])
@pytest.mark.parametrize("family", [gauss, lobatto_iiie])
def test_gauss_and_lobatto_iiie_are_symmetric(family, s):
    tableau = family(s)
    assert np.abs(tableau.A + tableau.A[::-1, ::-1] - tableau.b).max() < 1e-14


def stability(tableau, z):
    ones = np.ones(tableau.stages)
    return 1.0 + z * tableau.b @ np.linalg.solve(np.eye(tableau.stages) - z * tableau.A, ones)


@pytest.mark.parametrize("s", [2, 3, 4])
def test_sun_damps_nothing_and_radau_iia_everything_stiff(s):
    for y in (0.3, 3.0, 100.0):
        assert abs(abs(stability(sun_radau_iib(s), 1j * y)) - 1.0) < 1e-12
        assert abs(stability(sun_radau_iib(s), 1j * y) - stability(gauss(s), 1j * y)) < 1e-12  # the same function
    assert abs(stability(radau_iia(s), -1e8)) < 1e-6
    assert np.abs(radau_iia(s).A[-1] - radau_iia(s).b).max() < 1e-15  # stiffly accurate


@pytest.mark.parametrize("name", ["A", "B", "C", "E3", "E5"])
def test_dop853_is_that_of_scipy(name):
    known = getattr(DOP853, name)
    assert np.array_equal(getattr(dop853, name), known[:12]) and not np.any(known[12:])
