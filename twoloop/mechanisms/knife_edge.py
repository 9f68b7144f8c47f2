"""Define a knife edge on an inclined plane: one non-holonomic row, with a closed-form solution.

Bloch, Nonholonomic Mechanics and Control (2003), Sect. 1.6. x points down the slope, phi is the angle of the blade.
"""

import math
from functools import partial
from typing import Any

import numpy as np

from twoloop.bodies.frames import body_points
from twoloop.kernels.compile.callbacks import callback
from twoloop.problem.callbacks import callbacks_in
from twoloop.problem.description import Drawing, Joint
from twoloop.problem.problem import Array, Problem, Reference
from twoloop.problem.system import ConstrainedSystem

GRAVITY = 9.81
MASS, INERTIA, SLOPE, SPIN = 1.3, 0.2, 0.4, 1.7  # kg, kg m^2, rad, rad/s
PULL = GRAVITY * math.sin(SLOPE)
BLADE = [[-0.3, 0.0], [0.3, 0.0], [0.0, 0.0]]  # its ends and its middle, m

# p = [m, J, m g sin(slope)]


@callback("mass")
def mass(t, q, p, M):
    M[0, 0] = M[1, 1] = p[0]
    M[2, 2] = p[1]


@callback("force")
def force(t, q, v, p, Q):
    Q[0] = p[2]


@callback("nonholonomic")
def nonholonomic(t, q, p, A):
    A[0, 0], A[0, 1] = math.sin(q[2]), -math.cos(q[2])


@callback("nonholonomic_gamma")
def nonholonomic_gamma(t, q, v, p, Qa):
    Qa[0] = -v[2] * (v[0] * math.cos(q[2]) + v[1] * math.sin(q[2]))


def energy(t: Any, q: Array, v: Array) -> Any:
    """Return the kinetic energy plus the potential on the slope, J, for one state or many."""
    return 0.5 * (MASS * (v[0] ** 2 + v[1] ** 2) + INERTIA * v[2] ** 2) - MASS * PULL * q[0]


def motion(t: float) -> tuple[Array, Array]:
    """Return the states q, v (3,) at t: a cycloid across the slope."""
    s, c = math.sin(SPIN * t), math.cos(SPIN * t)
    scale = PULL / (2.0 * SPIN**2)
    q = np.array([scale * s * s, scale * (SPIN * t - s * c), SPIN * t])
    return q, np.array([PULL / SPIN * s * c, PULL / SPIN * s * s, SPIN])


def knife_edge() -> Problem:
    """Return a knife edge that initially points down its slope, at rest except for its constant spin of 1.7 rad/s.

    Examples
    --------
    >>> from twoloop.mechanisms import knife_edge
    >>> problem = knife_edge()
    >>> problem.system.n_q, problem.system.n_c, problem.t_span[1]
    (3, 0, 10.0)
    """
    system = ConstrainedSystem(
        n_q=3,
        n_c=0,
        n_a=1,
        **callbacks_in(globals()),
        parameters=[MASS, INERTIA, MASS * PULL],
        constant_mass=True,
        joints=[Joint("blade", (0,), (0, 1), (2,))],
        name="knife edge",
    )
    q0, v0 = motion(0.0)
    q, v = motion(10.0)
    return Problem(
        name="knife edge",
        system=system,
        q0=q0,
        v0=v0,
        t_span=(0.0, 10.0),
        energy=energy,
        conserved=True,
        drawing=Drawing(partial(body_points, (0, 0, 0), np.array(BLADE)), ((0, 1),), (2,)),
        parameters={"mass": MASS, "inertia": INERTIA, "slope": SLOPE, "spin": SPIN, "gravity": GRAVITY},
        note="Mass, inertia, slope and spin were chosen for this project.",
        reference=Reference(
            t=10.0,
            q=q,
            v=v,
            lam=np.array([2.0 * MASS * PULL * math.sin(SPIN * 10.0)]),
            source="closed form (Bloch)",
            digits={"q": 14.0, "v": 14.0, "lam": 13.0},
            verified="the equation for the speed along the blade, extrapolated in extended precision: 15 digits",
        ),
        motion=motion,
        source="Bloch, Nonholonomic Mechanics and Control (2003), 1.6; SolveDAE/solve_dae, examples/daes/knife_edge.py",
        tags=("open chain", "rigid", "planar", "non-holonomic"),
        purpose="A single non-holonomic row and no holonomic one: nothing holds the positions but the velocities.",
        coordinates=("x (m)", "y (m)", "phi (rad)"),
    )
