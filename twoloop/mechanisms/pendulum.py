"""The planar pendulum in Cartesian coordinates with its closed-form solution: IFToMM's A01 and SUNDIALS' example."""

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import ellipj, ellipk

from twoloop.checks.arguments import check_finite
from twoloop.mechanisms.quadratic import QuadraticSystem, fixed, point
from twoloop.mechanisms.ready import ready
from twoloop.problem.problem import Array, Condition, Problem, Reference

CVODE_GRAVITY = 13.7503716360407456549801915596211144  # (2 K(m = 1/2))^2: a quarter of the period is 1/2


@dataclass(frozen=True)
class Swing:
    """Motion of a pendulum of length L released from the horizontal, by Jacobi's elliptic functions.

    With k^2 = 1/2 and u = sqrt(g / L) t, the angle from the downward vertical is 2 arcsin(k sn(K - u)) (Whittaker,
    Analytical Dynamics, Sect. 44).
    """

    length: float
    gravity: float
    side: int

    def __call__(self, t: float) -> tuple[Array, Array]:
        """Return the states q, v (2,) at t."""
        pace, m = math.sqrt(self.gravity / self.length), 0.5
        sn, cn, dn, _ = ellipj(ellipk(m) - pace * t, m)
        # sin and cos of twice arcsin(k sn), whose cosine is dn
        sine, cosine = 2.0 * math.sqrt(m) * sn * dn, 1.0 - 2.0 * m * sn * sn
        rate = -2.0 * math.sqrt(m) * pace * cn
        q = self.length * np.array([self.side * sine, -cosine])
        return q, self.length * rate * np.array([self.side * cosine, sine])

    @property
    def period(self) -> float:
        """4 K(1/2) sqrt(L / g), s."""
        return float(4.0 * ellipk(0.5) * math.sqrt(self.length / self.gravity))


def _pendulum(name: str, gravity: float, side: int, end: float, **known: object) -> Problem:
    rows = QuadraticSystem(np.eye(2), np.array([0.0, -gravity]))
    rows.link("link", 0, fixed(0.0, 0.0), 1.0)
    motion = Swing(1.0, gravity, side)
    q, v = motion(end)
    lam = np.array([v @ v - gravity * q[1]])
    return ready(
        *(rows, name, np.array([float(side), 0.0]), np.zeros(2), end),
        conserved=True,
        drawing=rows.drawing(point(0)),
        parameters={"length": 1.0, "mass": 1.0, "gravity": gravity},
        reference=Reference(
            t=end,
            q=q,
            v=v,
            lam=lam,
            period=motion.period,
            source="closed form, Jacobi's elliptic functions (SciPy)",
            digits={"q": 13.0, "v": 13.0, "lam": 12.0},
            verified="the equation for the angle, extrapolated in extended precision: 13 digits in q and v",
        ),
        motion=motion,
        tags=("open chain", "rigid", "planar"),
        coordinates=("x (m)", "y (m)"),
        **known,  # type: ignore[arg-type]
    )


def pendulum(start: float = -1.0) -> Problem:
    """The pendulum A01 of IFToMM's library of benchmarks: 1 kg on 1 m, released from the horizontal.

    Parameters
    ----------
    start : {-1, 1}
        Initial x, m: -1 as in MBSbenchmarksInOpenSim, 1 as in the specification of the library.

    Raises
    ------
    TypeError, ValueError
        If `start` is neither -1 nor 1.

    Examples
    --------
    >>> from twoloop.mechanisms import pendulum
    >>> problem = pendulum()
    >>> problem.system.n_q, problem.system.n_c, problem.t_span[1]
    (2, 1, 10.0)
    """
    if check_finite("start", start) not in (-1.0, 1.0):
        raise ValueError(f"start must be -1 or 1 (m, x of the bob at the start); given {start!r}")
    return _pendulum(
        "A01 pendulum",
        9.81,
        int(start),
        10.0,
        source="IFToMM library of benchmarks, A01; RehabEngGroup/MBSbenchmarksInOpenSim, A01_SimplePendulum.rst",
        purpose="The simplest constrained motion, known in closed form at all times: what is wrong here is the method.",
        note="The library's pass rule asks for 2000 s.",
        condition=Condition(
            t_end=2000.0,
            n_outputs=4000,
            coordinates=(0, 1),
            velocities=(),
            threshold=1e-3,
            low=1e-1,
            high=1e-3,
            source=(
                "lim.ii.udc.es/mbsbenchmark, A01_specification (duration, outputs, threshold, limits); the formula of "
                "the error is recalled from Gonzalez et al. (2006)"
            ),
        ),
    )


def projection_pendulum() -> Problem:
    """The pendulum of SUNDIALS' projection example: its period is exactly 2 s, so that it returns after 30 s.

    Examples
    --------
    >>> from twoloop.mechanisms import projection_pendulum
    >>> problem = projection_pendulum()
    >>> problem.system.n_q, problem.system.n_c, problem.t_span[1]
    (2, 1, 30.0)
    """
    return _pendulum(
        "projection pendulum",
        CVODE_GRAVITY,
        1,
        30.0,
        source="LLNL/sundials, examples/cvode/serial/cvPendulum_dns.c",
        purpose=(
            "Whether constraints kept by projection also keep the phase: after 15 periods the end is the start. CVODE "
            "at a tolerance of 1e-9 is printed with an error of 1.8e-6 in y with projection, of 1.7e-3 without."
        ),
    )
