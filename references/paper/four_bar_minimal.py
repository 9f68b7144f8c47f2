"""The four-bar linkage with one degree of freedom: a reference independent of the absolute coordinates.

The three angles of a closed loop move along a curve. Its tangent is the cross product of the two gradients of the loop
closure, N = (L2 L3 sin(th3 - th2), L3 L1 sin(th1 - th3), L1 L2 sin(th2 - th1)), which vanishes only if all three bars
are collinear, so that no angle has to be chosen as the independent one. With th' = N u and the kinetic energy
m(th) u^2 / 2, the motion is one scalar equation for u.
"""

import math
from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.integrate import solve_ivp

from twoloop.checks.arguments import check_positive
from twoloop.kernels.compile.caches import compiled_when_called
from twoloop.problem.problem import Array

RTOL, ATOL = 1e-13, 1e-14
STEPS = 400  # smallest number of steps per half period, so that the interpolant is as accurate as the steps
LONGEST = 1000.0  # s; a linkage not at rest by then started too near an equilibrium
MOST_EVALUATIONS = 200_000  # evaluations of the equation of motion per integration; about 10 s


class MinimalFourBar:
    """Motion of a four-bar linkage of uniform rods, released from rest under gravity; `period` is its period, s.

    It swings back and forth between two positions of rest. Half a period is integrated (DOP853, rtol 1e-13) and all
    other times are mapped to it, so the error grows only with the number of periods times the error of the period:
    after 100 s about 1e-12.

    The arguments are the parameters of `twoloop.mechanisms.four_bar`; the density may differ between the rods.

    Raises ValueError if the linkage cannot be assembled, starts in equilibrium or at a singular position, does not come
    to rest within `LONGEST`, or needs more than `MOST_EVALUATIONS`.
    """

    def __init__(
        self, lengths: ArrayLike, ground: float, theta3: float, branch: int, density: ArrayLike, gravity: float
    ):
        self._lengths = np.array(lengths, dtype=float)
        for value in np.atleast_1d(density).tolist():
            check_positive("density", value)
        self._masses = np.array(density) * self._lengths
        self._gravity = gravity
        start = np.append(_assemble(self._lengths, ground, theta3, branch), 0.0)
        push = self.rate(0.0, start)[3]
        if not abs(push) > 1e-9:
            raise ValueError(f"the linkage must not start in equilibrium; its initial u' is {push:.3g}")
        half = self._swing(start)
        self.period = 2.0 * float(half.t_events[0][0])
        self._dense = half.sol

    @classmethod
    def from_parameters(cls, parameters: Mapping[str, Any]) -> "MinimalFourBar":
        """Return the linkage of `four_bar(...).parameters`: L1, L2, L3, L, theta3, branch, density, gravity."""
        p = parameters
        return _linkage((p["L1"], p["L2"], p["L3"]), p["L"], p["theta3"], p["branch"], p["density"], p["gravity"])

    def states(self, times: ArrayLike) -> tuple[Array, Array]:
        """Return absolute coordinates and velocities (9, n_t) at any times (n_t,), s.

        The coordinates are [x1 y1 th1 x2 y2 th2 x3 y3 th3], m and rad. The angles are continuous from the start.
        """
        folded = np.mod(np.atleast_1d(times), self.period)
        reversed_ = folded > 0.5 * self.period
        folded[reversed_] = self.period - folded[reversed_]
        state = self._dense(folded)
        return absolute(self._lengths, state[:3], self.tangent(state) * np.where(reversed_, -state[3], state[3]))

    def _swing(self, start: Array) -> Any:
        """Integrate from rest to the next position of rest."""

        def rest(t, y):  # type: ignore[no-untyped-def]
            return y[3]

        rest.terminal = True  # type: ignore[attr-defined]
        rest.direction = -math.copysign(1.0, self.rate(0.0, start)[3])  # type: ignore[attr-defined]

        def run(t_end: float, rtol: float, atol: float, **options: Any) -> Any:
            span = 0.0, t_end
            return solve_ivp(_counted(self.rate), span, start, "DOP853", rtol=rtol, atol=atol, events=rest, **options)

        rough = run(LONGEST, 1e-8, 1e-8)
        if rough.status == -1:
            raise ValueError(f"the linkage's equation of motion cannot be integrated: {rough.message}")
        if rough.status != 1:
            raise ValueError(
                f"the linkage does not come to rest within {LONGEST:g} s: it starts too near an equilibrium"
            )
        end = float(rough.t[-1])
        fine = run(1.1 * end, RTOL, ATOL, max_step=end / STEPS, dense_output=True)
        if fine.status != 1:
            raise ValueError(f"the linkage comes to rest at {end:g} s with loose tolerances, and not with tight ones")
        return fine

    def coordinates(self, state: Array) -> Array:
        """Return absolute coordinates (9,) of a state [th1, th2, th3, u]."""
        return absolute(self._lengths, state[:3], self.tangent(state) * state[3])[0]

    def tangent(self, state: Array) -> Array:
        """Return the rates of the three angles of a state divided by u."""
        return tangent_of(self._lengths, state[:3])

    def rate(self, t: float, state: Array, torque: float = 0.0) -> Array:
        """Return (th', u') from Lagrange's equation for u, with a torque on the first bar.

        x and y are the displacements of the centres along the tangent.
        """
        return _rate(self._lengths, self._masses, self._gravity, state, torque)  # type: ignore[no-any-return]


_linkage = lru_cache(maxsize=64)(MinimalFourBar)  # integrated once


@compiled_when_called(error_model="numpy")
def _rate(L, masses, gravity, state, torque):  # type: ignore[no-untyped-def]
    rate, n, n_s = np.zeros(4), np.zeros(3), np.zeros(3)
    for i in range(3):  # the tangent, and its derivative along itself
        j, k = (i + 1) % 3, (i + 2) % 3
        n[i] = L[j] * L[k] * math.sin(state[k] - state[j])
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        n_s[i] = L[j] * L[k] * math.cos(state[k] - state[j]) * (n[k] - n[j])
    inertia = coupling = lifted = 0.0
    x = y = x_s = y_s = 0.0  # of the end of the bar before, per unit of the tangent; _s: the derivatives along it
    for i in range(3):
        c, s = math.cos(state[i]), math.sin(state[i])
        dx, dy = -L[i] * s * n[i], L[i] * c * n[i]
        dx_s, dy_s = -L[i] * (s * n_s[i] + c * n[i] ** 2), L[i] * (c * n_s[i] - s * n[i] ** 2)
        mid_x, mid_y = x + 0.5 * dx, y + 0.5 * dy
        about = L[i] ** 2 / 12.0
        inertia += masses[i] * (mid_x**2 + mid_y**2 + about * n[i] ** 2)
        coupling += masses[i] * (mid_x * (x_s + 0.5 * dx_s) + mid_y * (y_s + 0.5 * dy_s) + about * n[i] * n_s[i])
        lifted += masses[i] * mid_y
        x, y, x_s, y_s = x + dx, y + dy, x_s + dx_s, y_s + dy_s
        rate[i] = n[i] * state[3]
    rate[3] = (torque * n[0] - coupling * state[3] ** 2 - gravity * lifted) / inertia
    return rate


def _counted(rate: Callable[[float, Array], Array]) -> Callable[[float, Array], Array]:
    """Return the function with a limit on its evaluations, because SciPy's integrator might never stop."""
    count = 0

    def counted(t: float, state: Array) -> Array:
        nonlocal count
        count += 1
        if count > MOST_EVALUATIONS:
            raise ValueError(
                f"the linkage has not come to rest after {MOST_EVALUATIONS} evaluations of its equation of motion, at "
                f"t = {t:g} s: it starts too near an equilibrium, or gravity and lengths are of very different scales"
            )
        value = rate(t, state)
        if not np.isfinite(value).all():
            raise ValueError(f"the linkage's equation of motion gives values that are not finite at t = {t:g} s")
        return value

    return counted


def absolute(lengths: Array, angles: Array, rates: Array) -> tuple[Array, Array]:
    """Return absolute coordinates and velocities (9,) or (9, n) of a chain of bars with these angles and rates."""
    q, v = np.empty((9, *angles.shape[1:])), np.empty((9, *angles.shape[1:]))
    q[0::3], q[1::3] = _centres(lengths, np.cos(angles)), _centres(lengths, np.sin(angles))
    v[0::3] = _centres(lengths, -np.sin(angles) * rates)
    v[1::3] = _centres(lengths, np.cos(angles) * rates)
    q[2::3], v[2::3] = angles, rates
    return q, v


def _centres(lengths: Array, directions: Array) -> Array:
    """Return one coordinate of the centres of a chain of bars with these direction cosines (3,) or (3, n)."""
    bars = lengths.reshape(-1, *(1,) * (directions.ndim - 1)) * directions
    return np.cumsum(bars, axis=0) - 0.5 * bars


def tangent_of(lengths: Array, angles: Array) -> Array:
    """Return the direction in which the angles can move, (3,) or (3, n)."""
    L1, L2, L3 = lengths
    th1, th2, th3 = angles
    return np.array([L2 * L3 * np.sin(th3 - th2), L3 * L1 * np.sin(th1 - th3), L1 * L2 * np.sin(th2 - th1)])


def _assemble(lengths: Array, ground: float, theta3: float, branch: int) -> Array:
    """Return the three angles; joint 1-2 is the intersection of the circles about O and joint 2-3."""
    L1, L2, L3 = lengths
    joint = complex(ground, 0.0) - L3 * complex(math.cos(theta3), math.sin(theta3))
    distance = abs(joint)
    projection = (distance**2 + L1**2 - L2**2) / (2.0 * distance)
    if not abs(projection) < L1:
        raise ValueError(
            f"bars 1 and 2 cannot reach joint 2-3, which is {distance:.6g} m from O, with theta3 = {theta3:g}"
        )
    crank = complex(projection, branch * math.sqrt(L1**2 - projection**2)) * joint / distance
    coupler = joint - crank
    return np.array([math.atan2(crank.imag, crank.real), math.atan2(coupler.imag, coupler.real), theta3])
