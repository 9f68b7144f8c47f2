"""Collocation at nine Lobatto nodes, the first of which is the end of the step before: its coefficients, order 16.

Polynomials of degree 8 through values at the nodes are written in Legendre's, whose coefficients, integrals and
derivatives at the end are known (Hairer & Wanner, Solving ODEs II, IV.5, on Lobatto IIIA).
"""

from functools import cache
from math import comb
from typing import NamedTuple

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

Array = NDArray[np.float64]
N = 9


class Tables(NamedTuple):
    """For nodes c_0 = 0 < ... < c_8 = 1; rows belong to values at the nodes, the first to that at the beginning.

    Attributes
    ----------
    nodes : (8,)
        Of those that are not known.
    velocities, positions : (9, 8)
        Single and double integrals from 0 to each node.
    spectrum : (9, 8)
        Coefficients of the Legendre polynomials 1 to 8 on [0, 1], which are 1 at its end.
    end : (9, 8)
        Coefficients of the powers 1 to 8 of the time from the end.
    """

    nodes: Array
    velocities: Array
    positions: Array
    spectrum: Array
    end: Array


@cache
def tables() -> Tables:
    """The coefficients, right to rounding."""
    x = _nodes()
    values = np.array([[_legendre(k, z) for z in x] for k in range(N + 2)], dtype=np.longdouble)
    weights = 2 / (N * (N - 1) * values[N - 1] ** 2)
    norms = np.array([np.longdouble(2) / (2 * k + 1) for k in range(N)])
    norms[N - 1] = np.longdouble(2) / (N - 1)  # what the quadrature gives of the square of the last one
    coefficients = values[:N] * weights / norms[:, None]  # (k, node): Legendre coefficients of the Lagrange polynomials
    once = _integrals(values)  # (k, node): from -1
    integral = np.array([_integrals_of(k, values) for k in range(N)])
    single = coefficients.T @ once[:N] / 2
    double = coefficients.T @ integral / 4
    powers = [[comb(n, k) * comb(n + k, k) for n in range(N)] for k in range(1, N)]
    end = coefficients.T @ np.array(powers, dtype=np.longdouble).T
    made = ((x[1:] + 1) / 2, single[:, 1:], double[:, 1:], coefficients[1:].T, end)
    return Tables(*(each.astype(np.float64) for each in made))


def _nodes() -> NDArray[np.longdouble]:
    """-1, the zeros of P_8', 1."""
    inner = legendre.legroots(legendre.legder([0] * (N - 1) + [1])).astype(np.longdouble)
    derivative = legendre.legder(np.array([0] * (N - 1) + [1], dtype=np.longdouble))
    for _ in range(3):
        inner = inner - legendre.legval(inner, derivative) / legendre.legval(inner, legendre.legder(derivative))
    return np.concatenate([[np.longdouble(-1)], np.sort(inner), [np.longdouble(1)]])


def _legendre(k: int, z: np.longdouble) -> np.longdouble:
    return legendre.legval(z, np.array([0] * k + [1], dtype=np.longdouble))


def _integrals(values: NDArray[np.longdouble]) -> NDArray[np.longdouble]:
    """Integrals from -1 of P_0, ..., P_9: (P_k+1 - P_k-1) / (2 k + 1)."""
    first = values[1] + 1
    rest = [(values[k + 1] - values[k - 1]) / (2 * k + 1) for k in range(1, N + 1)]
    return np.array([first, *rest])


def _integrals_of(k: int, values: NDArray[np.longdouble]) -> NDArray[np.longdouble]:
    """Double integrals from -1 of P_k."""
    once = _integrals(values)
    if k == 0:
        return once[1] + once[0]
    return (once[k + 1] - once[k - 1]) / (2 * k + 1)
