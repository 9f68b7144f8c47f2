"""A spinning symmetric heavy top by Euler parameters: the mass matrix 4 G^T J G has rank 3 of 4.

Data of the benchmark (`jgerstmayr/EXUDYN` main/pythonDev/TestModels/heavyTop.py; Bruels and Cardona; Terze, Mueller and
Zlatar 2016): 15 kg, the centre of mass at (0, 1, 0) from the fixed point, axis along y, 150 rad/s, gravity along -z.
"""

import numpy as np
from scipy.special import ellipj, ellipkinc

from tests.general.mechanism import G, Mechanism, known, of_functions, of_problem
from tests.mechanisms.motions import spatial
from twoloop.mechanisms import heavy_top

M, LENGTH, ACROSS, AXIAL = 15.0, 1.0, 0.234375, 0.46875  # about the centre of mass
ABOUT_POINT = np.array([ACROSS + M * LENGTH**2, AXIAL, ACROSS + M * LENGTH**2])
SPIN = (0.0, 150.0, -4.61538)  # angular velocity at the start, along body axes, which lie along those of space
PRINTED = np.array([-0.70828, 0.43878, 0.54573, 0.0894])  # Euler parameters at 0.2 s, "RK4"
END, KNOWN = 0.1, 0.3  # of runs, and how far the motion is known


def _G(e):
    """Body angular velocity = 2 G(e) e'."""
    return np.array([[-e[1], e[0], e[3], -e[2]], [-e[2], -e[3], e[0], e[1]], [-e[3], e[2], -e[1], e[0]]])


def _axis(e):
    """The second column of the rotation matrix."""
    return np.array(
        [
            2.0 * (e[1] * e[2] - e[0] * e[3]),
            e[0] * e[0] - e[1] * e[1] + e[2] * e[2] - e[3] * e[3],
            2.0 * (e[2] * e[3] + e[0] * e[1]),
        ]
    )


def _axis_by_e(e):
    return 2.0 * np.array([[-e[3], e[2], e[1], -e[0]], [e[0], -e[1], e[2], -e[3]], [e[1], e[0], e[3], e[2]]])


# --- the models
def _rotation(inertia):
    """Mass matrix and inertia forces of the Euler parameters."""
    J = np.diag(inertia)

    def mass(e):
        return 4.0 * _G(e).T @ J @ _G(e)

    def force(e, v):
        return -8.0 * _G(v).T @ J @ _G(e) @ v

    return mass, force


def top_of_euler_parameters():
    """q = e (4,): the fixed point is built in, and the normalisation is the only row."""
    mass, force = _rotation(ABOUT_POINT)
    weight = np.array([0.0, 0.0, -M * G * LENGTH])
    return Mechanism(
        name="top of Euler parameters",
        system=of_functions(
            name="top of Euler parameters",
            n_q=4,
            n_c=1,
            mass=lambda t, q: mass(q),
            force=lambda t, q, v: force(q, v) + _axis_by_e(q).T @ weight,
            constraint=lambda t, q: np.array([0.5 * (q @ q - 1.0)]),
            jacobian=lambda t, q: q.reshape(1, 4),
            gamma=lambda t, q, v: np.array([-(v @ v)]),
        ),
        end=END,
        state=_motion(),
        rank=1,
        energy=lambda q, v: 0.5 * v @ mass(q) @ v - weight @ _axis(q),
    )


def top_with_centre():
    """The ready mechanism: q = (r, e) (7,)."""
    return of_problem(heavy_top(), known(spatial.heavy_top(), KNOWN), END)


def _motion():
    state = known(spatial.heavy_top(), KNOWN)

    def of_parameters(t):
        q, v = state(t)
        return q[3:], v[3:]

    return of_parameters


def height(t):
    """Height of the centre of mass over the fixed point at t, by Jacobi's elliptic functions.

    With u = height / LENGTH, u'^2 is a cubic in u whose lower roots are the turning points (Whittaker; Goldstein).
    """
    a, c = ABOUT_POINT[0], ABOUT_POINT[1]
    precession, axial = a * SPIN[2], c * SPIN[1]  # angular momenta about the vertical and about the axis
    energy = 0.5 * a * SPIN[2] ** 2  # without that of the spin; the axis is horizontal at the start
    fall = M * G * LENGTH
    square = np.polynomial.Polynomial([1.0, 0.0, -1.0]) * np.polynomial.Polynomial([2.0 * energy, -2.0 * fall]) / a
    square -= np.polynomial.Polynomial([precession, -axial]) ** 2 / a**2
    low, high, outer = np.sort(square.roots().real)
    k2 = (high - low) / (outer - low)
    pace = np.sqrt(0.5 * fall / a * (outer - low))
    # the axis starts to sink from u = 0, a turning point
    start = ellipkinc(np.arcsin(min(1.0, np.sqrt((0.0 - low) / (high - low)))), k2)
    return LENGTH * (low + (high - low) * ellipj(start + pace * np.asarray(t), k2)[0] ** 2)
