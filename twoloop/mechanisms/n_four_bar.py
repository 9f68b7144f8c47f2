"""Define IFToMM's A02, the N-four-bar mechanism: N windows, 2N + 1 uniform bars of 1 m and 1 kg.

The cranks are upright at the start. The rank of C_q drops by N whenever the cranks lie on the ground line, where N + 1
branches of motion meet. On the synchronous branch all couplers stay level.
"""

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.special import ellipj, ellipk

from twoloop.checks.arguments import check_size
from twoloop.mechanisms.planar import GROUND, PlanarBodies
from twoloop.mechanisms.quadratic import QuadraticSystem, fixed, point
from twoloop.mechanisms.registry import ready
from twoloop.problem.description import body_names
from twoloop.problem.problem import Array, Condition, Problem, Reference

GRAVITY = 9.81
SETS = ("tips", "bodies")


@dataclass(frozen=True)
class Synchronous:
    """Evaluate the motion with parallel cranks, by Jacobi's elliptic functions.

    phi'' = -w^2 cos(phi), w^2 = g 3 (3n + 1) / (2 (4n + 1)), from phi = pi/2 at -1 rad/s: a rotating pendulum.
    """

    n: int
    coordinates: str

    def crank(self, t: float) -> tuple[float, float]:
        """Return the angle of the cranks from the ground line and its rate."""
        w = math.sqrt(GRAVITY * 3.0 * (3 * self.n + 1) / (2.0 * (4 * self.n + 1)))
        k = 2.0 * w / math.sqrt(1.0 + 4.0 * w * w)
        _, _, dn, amplitude = ellipj(ellipk(k * k) - w * t / k, k * k)
        return 2.0 * float(amplitude) - 0.5 * math.pi, -2.0 * w / k * float(dn)

    def __call__(self, t: float) -> tuple[Array, Array]:
        """Return the states q, v (n_q,) at t."""
        angle, rate = self.crank(t)
        z, w = complex(math.cos(angle), math.sin(angle)), rate * complex(-math.sin(angle), math.cos(angle))
        if self.coordinates == "tips":
            x, u = np.arange(self.n + 1) + z, np.full(self.n + 1, w)
            return np.column_stack([x.real, x.imag]).ravel(), np.column_stack([u.real, u.imag]).ravel()
        x = np.concatenate([np.arange(self.n + 1) + 0.5 * z, np.arange(self.n) + 0.5 + z])
        u = np.concatenate([np.full(self.n + 1, 0.5 * w), np.full(self.n, w)])
        turned = np.arange(2 * self.n + 1) <= self.n
        q = np.column_stack([x.real, x.imag, np.where(turned, angle, 0.0)])
        return q.ravel(), np.column_stack([u.real, u.imag, np.where(turned, rate, 0.0)]).ravel()


def n_four_bar(n: int = 2, coordinates: str = "tips") -> Problem:
    """Return the N-four-bar mechanism of IFToMM's library of benchmarks, A02.

    Parameters
    ----------
    n : int
        Number of windows.
    coordinates : {"tips", "bodies"}
        "tips": x and y of the tips of the n + 1 cranks, with one row for the length of each of the 2n + 1 bars.
        "bodies": centre and angle of each bar, cranks first, with two rows per joint.

    Raises
    ------
    TypeError, ValueError
        If n is not a positive integer, or `coordinates` is unknown.

    Examples
    --------
    >>> from twoloop.mechanisms import n_four_bar
    >>> problem = n_four_bar()
    >>> problem.system.n_q, problem.system.n_c, problem.t_span[1]
    (6, 5, 10.0)
    """
    n = check_size("n", n, 1)
    if not isinstance(coordinates, str) or coordinates not in SETS:
        raise ValueError(f"coordinates must be one of {', '.join(SETS)}; given {coordinates!r}")
    name = f"A02, N = {n}{' (bodies)' if coordinates == 'bodies' else ''}"
    rows = _of_tips(n) if coordinates == "tips" else _of_bodies(n)
    motion = Synchronous(n, coordinates)
    q0, v0 = motion(0.0)
    q, v = motion(10.0)
    tips = [point(2 * i) for i in range(n + 1)]
    drawing = rows.drawing(*tips) if isinstance(rows, QuadraticSystem) else rows.drawing
    # B0 is the tip of the first crank, twice as far from the ground joint as the centre of that crank
    return ready(
        *(rows, name, q0, v0, 10.0),
        conserved=True,
        drawing=drawing,
        parameters={"n": n, "length": 1.0, "mass": 1.0, "gravity": GRAVITY},
        note="Solved along the synchronous branch; the length of the usual run is that of MBSbenchmarksInOpenSim.",
        reference=Reference(
            t=10.0,
            q=q,
            v=v,
            source="closed form of the synchronous branch, Jacobi's elliptic functions (SciPy)",
            digits={"q": 13.0, "v": 13.0},
            verified="the equation for the angle, extrapolated in extended precision: 13 digits in q and v",
        ),
        published=_printed(q.size) if (n, coordinates) == (2, "tips") else None,
        motion=motion,
        source=(
            "IFToMM library of benchmarks, A02; RehabEngGroup/MBSbenchmarksInOpenSim, A02_N_FourBarMechanism.rst; "
            "jgerstmayr/EXUDYN, fourBarMechanismIftomm.py"
        ),
        tags=("closed chain", "rigid", "planar", "singular"),
        purpose=(
            "Whether a solver crosses positions where the constraints lose rank, several times a run, and stays on its "
            "branch; multipliers are not unique there."
        ),
        condition=Condition(
            t_end=20.0,
            n_outputs=400,
            coordinates=(0, 1),
            velocities=(0, 1),
            threshold=1e-3,
            low=1e-1,
            high=1e-3,
            source=(
                "lim.ii.udc.es/mbsbenchmark, A02_specification, for N = 40 (duration, outputs, threshold, limits, "
                "position and velocity of B0); the formula of the error is recalled from Gonzalez et al. (2006)"
            ),
        )
        if coordinates == "tips"
        else None,
        coordinates=_names(n, coordinates),
    )


def _printed(n_q: int) -> Reference:
    """Return the tip of the first crank as printed by Exudyn at h = 1.25e-4; its error, estimated from 2h, is 7e-7."""
    q = np.full(n_q, np.nan)
    q[:2] = 0.3284573768, 0.9445187937
    return Reference(
        t=10.0,
        q=q,
        v=np.full(n_q, np.nan),
        source="jgerstmayr/EXUDYN, fourBarMechanismIftomm.py, generalised-alpha, second order",
        digits={"q": 5.8},
        verified="extrapolated with the value printed for the double step: within 5e-8 of the closed form",
    )


def _of_tips(n: int) -> QuadraticSystem:
    n_q = 2 * (n + 1)
    mass, weight = np.eye(n_q) / 3.0, np.zeros(n_q)
    weight[1::2] = -0.5 * GRAVITY
    for i in range(n):  # a uniform bar between points of velocities a, b has the energy m (a^2 + a b + b^2) / 6
        for j in (2 * i, 2 * i + 1):
            mass[j, j] += 1.0 / 3.0
            mass[j + 2, j + 2] += 1.0 / 3.0
            mass[j, j + 2] = mass[j + 2, j] = 1.0 / 6.0
        weight[[2 * i + 1, 2 * i + 3]] -= 0.5 * GRAVITY
    rows = QuadraticSystem(mass, weight)
    tips = [point(2 * i) for i in range(n + 1)]
    for i, tip in enumerate(tips):
        rows.distance(tip, fixed(i, 0.0), 1.0)
    for left, right in pairwise(tips):
        rows.distance(right, left, 1.0)
    return rows


def _of_bodies(n: int) -> PlanarBodies:
    rows = PlanarBodies(_bars(n), np.ones(2 * n + 1), np.full(2 * n + 1, 1.0 / 12.0), GRAVITY)
    for i in range(n + 1):
        rows.pin(i, (-0.5, 0.0), GROUND, (float(i), 0.0))
    for j in range(n):
        rows.pin(n + 1 + j, (-0.5, 0.0), j, (0.5, 0.0))
    for j in range(n):
        rows.pin(n + 1 + j, (0.5, 0.0), j + 1, (0.5, 0.0))
    return rows


def _names(n: int, coordinates: str) -> tuple[str, ...]:
    if coordinates == "tips":
        return tuple(f"{axis} of B{i} (m)" for i in range(n + 1) for axis in "xy")
    return body_names(*_bars(n))


def _bars(n: int) -> list[str]:
    return [f"crank {i}" for i in range(n + 1)] + [f"coupler {j}" for j in range(n)]
