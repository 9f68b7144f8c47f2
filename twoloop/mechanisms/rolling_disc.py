"""Define a thin disc rolling without slipping on a horizontal plane: one holonomic and two non-holonomic rows.

Coordinates: x, y, z of the centre, yaw, lean from the vertical, spin. The disc touches the plane (z = R cos(lean)), and
the contact point has zero velocity along x and y.
"""

import math
from itertools import pairwise
from typing import Any

import numpy as np

from twoloop.kernels.compile.callbacks import callback
from twoloop.mechanisms.registry import stored_reference
from twoloop.problem.callbacks import callbacks_in
from twoloop.problem.description import Drawing
from twoloop.problem.problem import Array, Problem
from twoloop.problem.system import ConstrainedSystem

GRAVITY = 9.81
MASS, RADIUS = 2.0, 0.4  # kg, m
ACROSS, AXIAL = 0.25 * MASS * RADIUS**2, 0.5 * MASS * RADIUS**2  # moments of inertia about a diameter and the axis
N_RIM = 24  # points of the drawing
ANGLES = (0.1, 0.3, 0.0)  # yaw, lean, spin at the start, rad
AHEAD, UPRIGHT, TURN = 0.6, 1.5, -9.0  # angular velocity about the direction ahead, the upright diameter, the axis


@callback("mass")
def mass(t, q, p, M):
    s, c = math.sin(q[4]), math.cos(q[4])
    M[0, 0] = M[1, 1] = M[2, 2] = MASS
    M[3, 3] = ACROSS * c * c + AXIAL * s * s
    M[4, 4] = ACROSS
    M[5, 5] = AXIAL
    M[3, 5] = M[5, 3] = -AXIAL * s


@callback("force")
def force(t, q, v, p, Q):
    s, c = math.sin(q[4]), math.cos(q[4])
    yaw, lean, spin = v[3], v[4], v[5]
    coupling = 2.0 * s * c * (AXIAL - ACROSS)
    Q[2] = -MASS * GRAVITY
    Q[3] = -coupling * lean * yaw + AXIAL * c * lean * spin
    Q[4] = 0.5 * coupling * yaw * yaw - AXIAL * c * yaw * spin
    Q[5] = AXIAL * c * lean * yaw


@callback("constraint")
def constraint(t, q, p, C):
    C[0] = q[2] - RADIUS * math.cos(q[4])


@callback("jacobian")
def jacobian(t, q, p, Cq):
    Cq[0, 2], Cq[0, 4] = 1.0, RADIUS * math.sin(q[4])


@callback("gamma")
def gamma(t, q, v, p, Qd):
    Qd[0] = -RADIUS * math.cos(q[4]) * v[4] ** 2


@callback("nonholonomic")
def nonholonomic(t, q, p, A):
    sy, cy, s, c = math.sin(q[3]), math.cos(q[3]), math.sin(q[4]), math.cos(q[4])
    A[0, 0] = A[1, 1] = 1.0
    A[0, 3], A[0, 4], A[0, 5] = -RADIUS * cy * s, -RADIUS * c * sy, RADIUS * cy
    A[1, 3], A[1, 4], A[1, 5] = -RADIUS * sy * s, RADIUS * c * cy, RADIUS * sy


@callback("nonholonomic_gamma")
def nonholonomic_gamma(t, q, v, p, Qa):
    sy, cy, s, c = math.sin(q[3]), math.cos(q[3]), math.sin(q[4]), math.cos(q[4])
    yaw, lean, spin = v[3], v[4], v[5]
    squares = yaw * yaw + lean * lean
    Qa[0] = RADIUS * (2.0 * cy * c * lean * yaw - sy * s * squares + spin * sy * yaw)
    Qa[1] = RADIUS * (2.0 * sy * c * lean * yaw + cy * s * squares - spin * cy * yaw)


def energy(t: Any, q: Array, v: Array) -> Any:
    """Return the kinetic energy plus the potential of gravity, J, for one state or many."""
    ahead, upright, turn = v[4], v[3] * np.cos(q[4]), v[5] - v[3] * np.sin(q[4])
    spin = ACROSS * (ahead**2 + upright**2) + AXIAL * turn**2
    return 0.5 * (MASS * (v[0] ** 2 + v[1] ** 2 + v[2] ** 2) + spin) + MASS * GRAVITY * q[2]


def rim(q: Array) -> Array:
    """Return points fixed to the rim, and the contact point: (N_RIM + 1, 3) or (N_RIM + 1, 3, n_t)."""
    sy, cy, s, c = np.sin(q[3]), np.cos(q[3]), np.sin(q[4]), np.cos(q[4])
    ahead = np.stack([cy, sy, np.zeros_like(cy)])
    upright = np.stack([s * sy, -s * cy, c])
    angles = [q[5] + 2.0 * np.pi * k / N_RIM for k in range(N_RIM)]
    turned = [RADIUS * (np.cos(angle) * ahead + np.sin(angle) * upright) for angle in angles]
    return np.stack([q[:3] + arm for arm in (*turned, -RADIUS * upright)])


def rolling_disc() -> Problem:
    """Return a disc of 2 kg and 0.4 m radius that initially leans by 0.3 rad, and wobbles as it rolls.

    Examples
    --------
    >>> from twoloop.mechanisms import rolling_disc
    >>> problem = rolling_disc()
    >>> problem.system.n_q, problem.system.n_c, problem.t_span[1]
    (6, 1, 2.0)
    """
    yaw, lean, _ = ANGLES
    turn = UPRIGHT / math.cos(lean)
    sy, cy = math.sin(yaw), math.cos(yaw)
    x = RADIUS * (AHEAD * math.cos(lean) * sy - TURN * cy)
    y = RADIUS * (-AHEAD * math.cos(lean) * cy - TURN * sy)
    system = ConstrainedSystem(n_q=6, n_c=1, n_a=2, **callbacks_in(globals()), name="rolling disc")
    return Problem(
        name="rolling disc",
        system=system,
        q0=np.array([0.0, 0.0, RADIUS * math.cos(lean), *ANGLES]),
        v0=np.array([x, y, -RADIUS * math.sin(lean) * AHEAD, turn, AHEAD, TURN + turn * math.sin(lean)]),
        t_span=(0.0, 2.0),
        energy=energy,
        conserved=True,
        drawing=Drawing(rim, (*pairwise((*range(N_RIM), 0)), (0, N_RIM // 2), (N_RIM // 4, 3 * N_RIM // 4)), (N_RIM,)),
        parameters={"mass": MASS, "radius": RADIUS, "gravity": GRAVITY, "angles": ANGLES},
        note="Mass, radius and start were chosen for this project.",
        reference=stored_reference("rolling disc"),
        source="textbook problem; Bloch, Nonholonomic Mechanics and Control (2003), Sect. 1.4",
        tags=("open chain", "rigid", "spatial", "non-holonomic"),
        purpose="Holonomic and non-holonomic rows together, a mass matrix that varies, and energy that is conserved.",
        coordinates=("x (m)", "y (m)", "z (m)", "yaw (rad)", "lean (rad)", "spin (rad)"),
    )
