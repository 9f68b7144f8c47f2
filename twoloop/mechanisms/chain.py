"""Planar chains of equal masses on massless links, in Cartesian coordinates: the double pendulum and a closed chain."""

import math

import numpy as np
from scipy.optimize import brentq

from twoloop.checks.arguments import check_size
from twoloop.mechanisms.quadratic import QuadraticSystem, fixed, point
from twoloop.mechanisms.ready import ready
from twoloop.problem.problem import Array, Problem

GRAVITY = 9.81
N_MOST = 20
SLACK = 0.8  # distance of the pins of a closed chain relative to the total length of its links


def _masses(n: int) -> QuadraticSystem:
    """Return n masses of 1 / n kg, without rows."""
    weight = np.zeros(2 * n)
    weight[1::2] = -GRAVITY / n
    return QuadraticSystem(np.eye(2 * n) / n, weight)


def _names(n: int) -> tuple[str, ...]:
    return tuple(f"{axis}{i + 1} (m)" for i in range(n) for axis in "xy")


def double_pendulum() -> Problem:
    """Two masses of 1/2 kg on two links of 1 m, released from rest with both links level.

    The motion is chaotic, which costs about one digit over the usual run of 3 s.

    Examples
    --------
    >>> from twoloop.mechanisms import double_pendulum
    >>> problem = double_pendulum()
    >>> problem.system.n_q, problem.system.n_c, problem.t_span[1]
    (4, 2, 3.0)
    """
    rows = _masses(2)
    rows.link("link 1", 0, fixed(0.0, 0.0), 1.0)
    rows.link("link 2", 2, point(0), 1.0)
    return ready(
        *(rows, "double pendulum", np.array([1.0, 0.0, 2.0, 0.0]), np.zeros(4), 3.0),
        conserved=True,
        drawing=rows.drawing(point(2)),
        parameters={"n": 2, "length": 1.0, "mass": 0.5, "gravity": GRAVITY},
        source="textbook problem; the start was chosen for this project",
        tags=("open chain", "rigid", "planar"),
        purpose="Two degrees of freedom without a closed form: errors grow with the motion, which is chaotic.",
        coordinates=_names(2),
    )


def closed_chain(n: int = 4) -> Problem:
    """A chain of n equal masses pinned at both ends: n + 1 links, n - 1 degrees of freedom.

    The total length of the links is 1 m, the distance of the pins 0.8 m. The chain is released from a regular polygon
    through the pins whose first two links are exchanged, so that the motion is not symmetric.

    Parameters
    ----------
    n : int
        Number of masses, 2 to 20.

    Returns
    -------
    Problem
        With a reference for n = 2, 4, 5, 10 and 20.

    Raises
    ------
    TypeError, ValueError
        If n is not an integer from 2 to 20.

    Examples
    --------
    >>> from twoloop.mechanisms import closed_chain
    >>> problem = closed_chain()
    >>> problem.system.n_q, problem.system.n_c, problem.t_span[1]
    (8, 5, 1.0)
    """
    n = check_size("n", n, 2)
    if n > N_MOST:
        raise ValueError(f"n must be at most {N_MOST}, as far as the chain was checked; given {n}")
    rows, length = _masses(n), 1.0 / (n + 1)
    for i in range(n):
        rows.link(f"link {i + 1}", 2 * i, point(2 * i - 2) if i > 0 else fixed(0.0, 0.0), length)
    rows.link(f"link {n + 1}", 2 * n - 2, fixed(SLACK, 0.0), length)
    name = f"closed chain of {n}"
    return ready(
        *(rows, name, _shape(n)[1:-1].ravel(), np.zeros(2 * n), 1.0),
        system=rows.system(name, bandwidth=2),
        conserved=True,
        drawing=rows.drawing(point(2 * (n // 2))),
        parameters={"n": n, "length": length, "mass": 1.0 / n, "gravity": GRAVITY},
        note="Masses, lengths and start were chosen for this project.",
        source="a question of users: SolveDAE/solve_dae, issue 46; moorepants/learn-multibody-dynamics, issue 239",
        tags=("closed chain", "rigid", "planar"),
        purpose=(
            "A loop of any length, on which solvers are reported to abort from five links on; the number of degrees of "
            "freedom grows with n, and so does the chaos."
        ),
        coordinates=_names(n),
    )


def _shape(n: int) -> Array:
    """Return the initial positions of pins and masses (n + 2, 2)."""
    links = n + 1
    # an arc of `links` equal chords with span SLACK: sin(links a) / (links sin(a)) = SLACK
    a = brentq(lambda a: math.sin(links * a) / (links * math.sin(a)) - SLACK, 1e-6, math.pi / links, xtol=1e-15)
    angles = (2.0 * np.arange(links) - n) * a
    angles[:2] = angles[1::-1]
    steps = np.column_stack([np.cos(angles), np.sin(angles)]) / links
    return np.vstack([np.zeros(2), np.cumsum(steps, axis=0)])
