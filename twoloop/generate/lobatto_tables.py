"""Coefficients of Lobatto IIIA with nine nodes, the first of which is the end of the previous step.

A polynomial of degree 8 through values at the nodes is expanded in Legendre polynomials, whose integrals and
derivatives at the ends are known (Hairer & Wanner, Solving ODEs II, IV.5). The order is 16.
"""

from functools import cache
from math import comb
from typing import NamedTuple

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

Array = NDArray[np.float64]
Extended = NDArray[np.longdouble]
N = 9


class Tables(NamedTuple):
    """Tables for nodes c_0 = 0 < ... < c_8 = 1; row k multiplies the value at node k.

    Attributes
    ----------
    nodes, between : (8,)
        Nodes 1 to 8, and the midpoints between neighbouring nodes.
    velocities, positions : (9, 8)
        Single and double integrals from 0 to each of the nodes 1 to 8.
    values_between, velocities_between, positions_between : (9, 8)
        Values of the polynomial, and the same integrals, at the midpoints.
    spectrum : (9, 8)
        Coefficients of the Legendre polynomials 1 to 8 on [0, 1], which are 1 at its end.
    begin, end : (9, 8)
        Coefficients of the powers 1 to 8 of the time from the beginning, and from the end.
    """

    nodes: Array
    between: Array
    velocities: Array
    positions: Array
    values_between: Array
    velocities_between: Array
    positions_between: Array
    spectrum: Array
    begin: Array
    end: Array


@cache
def tables() -> Tables:
    """Return the coefficients, computed in extended precision and rounded once."""
    x = _nodes()
    between: Extended = (x[1:] + x[:-1]) / np.longdouble(2)
    values = _legendre(x)
    weights = 2 / (N * (N - 1) * values[N - 1] ** 2)
    norms = np.array([np.longdouble(2) / (2 * k + 1) for k in range(N)])
    norms[N - 1] = np.longdouble(2) / (N - 1)  # the quadrature is not exact for the square of the last polynomial
    coefficients = values[:N] * weights / norms[:, None]  # (k, node): Legendre coefficients of the Lagrange polynomials
    powers = [
        np.array([[sign ** (n + k) * comb(n, k) * comb(n + k, k) for n in range(N)] for k in range(1, N)]).T
        for sign in (-1, 1)
    ]
    exact = (
        *((each + 1) / 2 for each in (x[1:], between)),
        *_integrals(coefficients, x[1:])[1:],
        *_integrals(coefficients, between),
        coefficients[1:].T,
        *(coefficients.T @ each.astype(np.longdouble) for each in powers),
    )
    return Tables(*(each.astype(np.float64) for each in exact))


def _nodes() -> Extended:
    """Return -1, the zeros of P_8', and 1."""
    inner = legendre.legroots(legendre.legder([0] * (N - 1) + [1])).astype(np.longdouble)
    derivative = legendre.legder(np.array([0] * (N - 1) + [1], dtype=np.longdouble))
    for _ in range(3):
        inner = inner - legendre.legval(inner, derivative) / legendre.legval(inner, legendre.legder(derivative))
    return np.concatenate([[np.longdouble(-1)], np.sort(inner), [np.longdouble(1)]])


def _legendre(z: Extended) -> Extended:
    """Evaluate P_0 to P_10, one row each."""
    return np.array([legendre.legval(z, np.array([0] * k + [1], dtype=np.longdouble)) for k in range(N + 2)])


def _integrals(coefficients: Extended, z: Extended) -> tuple[Extended, Extended, Extended]:
    """Evaluate the Lagrange polynomials on [0, 1], and their single and double integrals from 0; a row a node."""
    values = _legendre(z)
    # the integral of P_k from -1 is (P_k+1 - P_k-1) / (2 k + 1)
    once = np.array([values[1] + 1, *((values[k + 1] - values[k - 1]) / (2 * k + 1) for k in range(1, N + 1))])
    twice = np.array([once[1] + once[0], *((once[k + 1] - once[k - 1]) / (2 * k + 1) for k in range(1, N))])
    return coefficients.T @ values[:N], coefficients.T @ once[:N] / 2, coefficients.T @ twice / 4
