"""Chains of point masses, of any length."""

import numpy as np

from twoloop.mechanisms import Problem
from twoloop.mechanisms.quadratic import QuadraticSystem, fixed, point

GRAVITY = 9.81


def chain(n: int, closed: bool) -> Problem:
    """Point masses of 1/n kg on n links of 1/n m from rest: an arc; `closed`: a link more pins the other end.

    The arc bends by 1 rad in all, so that nothing is symmetric or straight; the mechanism is the one of
    `twoloop.mechanisms.closed_chain` but for its shape and size.
    """
    links = n + 1 if closed else n
    angles = np.linspace(-0.2, -1.2, links)
    nodes = np.cumsum(np.column_stack([np.cos(angles), np.sin(angles)]) / links, axis=0)
    weight = np.zeros(2 * n)
    weight[1::2] = -GRAVITY / n
    rows = QuadraticSystem(np.eye(2 * n) / n, weight)
    for i in range(n):
        rows.link(f"link {i + 1}", 2 * i, point(2 * i - 2) if i > 0 else fixed(0.0, 0.0), 1.0 / links)
    if closed:
        rows.link(f"link {links}", 2 * n - 2, fixed(*nodes[-1]), 1.0 / links)
    name = f"{'closed' if closed else 'open'} chain"
    system, q0 = rows.system(name, bandwidth=2), nodes[:n].ravel()
    return Problem(name, system, q0, np.zeros(2 * n), (0.0, 1.0), rows.energy, conserved=True)
