"""The flexible beam on a moving base of Sect. 4.2, with the elements of `ancf_element`.

The beam of Hussein, Negrut & Shabana (2008), doi 10.1007/s11071-007-9328-9: pinned to a base that moves along x.
Coordinates: 6 per node (see `ancf_element`), 6 (n + 1) for n elements, from the base to the tip.

The element locks: its director is constant over the thickness, so the transverse stress is not relieved in bending,
and (lambda + 2 mu) acts in place of E. At Poisson's ratio 0.3 the bending stiffness is (lambda + 2 mu)/E = 1.346 times
that of the Euler-Bernoulli beam, for any mesh. This is part of the benchmark and is kept.
"""

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from twoloop.bodies.points import LinearPoints
from twoloop.checks.arguments import check_number, check_positive, check_size
from twoloop.kernels.compile.callbacks import callback
from twoloop.mechanisms import ancf_element as element
from twoloop.mechanisms.ancf_element import elastic_energy, elastic_tangent
from twoloop.problem.callbacks import callbacks_in
from twoloop.problem.description import Drawing, Joint
from twoloop.problem.problem import Array, Problem
from twoloop.problem.system import ConstrainedSystem

__all__ = ["ancf_beam", "elastic_tangent", "midpoint_deflection", "moderately_stiff_beam", "tip_height"]
__all__ += ["very_flexible_beam"]

GRAVITY = 9.81  # m/s^2
N_DRAWN = 8  # segments drawn per element
LARGEST = 1e50  # bound of the parameters in SI units, so that products of a few of them are finite
STARTS = {"node": "only the base node moving (start='node')", "beam": "all of it moving (start='beam')"}

# p: the parameters of the elements, then those of the base's motion
AMPLITUDE, FREQUENCY, N_PARAMETERS = range(element.N_ELEMENT_PARAMETERS, element.N_ELEMENT_PARAMETERS + 3)


@callback("constraint")
def constraint(t, q, p, C):
    C[0] = q[0] - p[AMPLITUDE] * math.sin(p[FREQUENCY] * t)
    C[1] = q[1]


@callback("jacobian")
def jacobian(t, q, p, Cq):
    Cq[0, 0] = 1.0
    Cq[1, 1] = 1.0


@callback("constraint_rate")
def constraint_rate(t, q, p, Ct):
    Ct[0] = -p[AMPLITUDE] * p[FREQUENCY] * math.cos(p[FREQUENCY] * t)


@callback("gamma")
def gamma(t, q, v, p, Qd):
    Qd[0] = -p[AMPLITUDE] * p[FREQUENCY] ** 2 * math.sin(p[FREQUENCY] * t)


@dataclass(frozen=True, eq=False)
class Energy:
    """Kinetic, elastic and gravitational energy of a beam, J, as a function of t, q and v."""

    M: Array
    p: Array

    def __call__(self, t: Any, q: ArrayLike, v: ArrayLike) -> Any:
        """Evaluate for one state, or for many given as columns."""
        q, v = np.asarray(q), np.asarray(v)
        weight = self.p[element.FALL] * self.M[1::6].sum(axis=0)
        return 0.5 * (v * (self.M @ v)).sum(axis=0) + elastic_energy(q, self.p) + weight @ q


def ancf_beam(
    n_elements: int = 4,
    start: str = "node",
    *,
    youngs_modulus: float,
    amplitude: float,
    angular_frequency: float,
    poisson_ratio: float = 0.3,
    density: float = 7200.0,
    length: float = 1.0,
    height: float = 0.02,
    width: float = 0.02,
    gravity: float = GRAVITY,
) -> Problem:
    """A beam pinned to a base that moves by amplitude sin(angular_frequency t) along x, with gravity along -y.

    It is initially straight along +x. Constraints:
    C_1 = r_x(base) - amplitude sin(angular_frequency t), C_2 = r_y(base).
    The base does work on the beam: d(energy)/dt = lam . C_t.

    Parameters
    ----------
    n_elements : int
        Number of equal elements n; the problem has 6 (n + 1) coordinates.
    start : {"node", "beam"}
        Velocities at t = 0, where the base already moves. "node": only the base node moves. "beam": the whole beam
        moves with the base.
    youngs_modulus : float
        N/m^2.
    amplitude : float
        Amplitude of the base, m; may be negative.
    angular_frequency : float
        Angular frequency of the base, rad/s.
    poisson_ratio : float
        Between -1 and 1/2, exclusive.
    density : float
        kg/m^3.
    length, height, width : float
        Dimensions of the beam, m; height is in the plane of motion.
    gravity : float
        m/s^2, at least 0.

    Returns
    -------
    Problem
        `system` has a constant mass matrix and the exact tangent of its force, `elastic_tangent` of this module.

    Raises
    ------
    TypeError, ValueError
        If an argument is out of range.

    Examples
    --------
    >>> from twoloop.mechanisms import ancf_beam
    >>> problem = ancf_beam(youngs_modulus=2e6, amplitude=0.1, angular_frequency=20.0)
    >>> problem.system.n_q, problem.system.n_c
    (30, 2)
    """
    n_elements = check_size("n_elements", n_elements, 1)
    if not isinstance(start, str) or start not in STARTS:
        raise ValueError(
            f"start must be 'node' (the base node moves, the others rest) or 'beam' (all of it moves with the base); "
            f"given {start!r}. The base moves at t = 0: nothing else is consistent with it"
        )
    parameters = {
        "youngs_modulus": youngs_modulus,
        "amplitude": amplitude,
        "angular_frequency": angular_frequency,
        "poisson_ratio": poisson_ratio,
        "density": density,
        "length": length,
        "height": height,
        "width": width,
        "gravity": gravity,
    }
    for name, value in parameters.items():
        if name in ("amplitude", "gravity", "poisson_ratio"):
            if not math.isfinite(check_number(name, value)):
                raise ValueError(f"{name} must be finite; given {value!r}")
        else:
            check_positive(name, value)
        if abs(value) > LARGEST:
            raise ValueError(f"{name} must be at most {LARGEST:g}; given {value!r}")
    if gravity < 0.0:
        raise ValueError(f"gravity must be at least 0, it acts along -y; given {gravity!r}")
    if not -1.0 < poisson_ratio < 0.5:
        raise ValueError(f"poisson_ratio must lie between -1 and 0.5, ends excluded; given {poisson_ratio!r}")

    l = length / n_elements
    area = height * width
    lame = youngs_modulus * poisson_ratio / ((1.0 + poisson_ratio) * (1.0 - 2.0 * poisson_ratio))
    shear = 0.5 * youngs_modulus / (1.0 + poisson_ratio)
    p = np.zeros(N_PARAMETERS)
    p[element.LENGTH] = l
    p[[element.STIFFNESS, element.LAME, element.SHEAR]] = (lame + 2.0 * shear) * area, lame * area, shear * area
    p[[element.SECOND, element.FOURTH]] = height**2 / 12.0, height**4 / 80.0
    p[[element.MASS, element.FALL]] = density * area, gravity
    p[[AMPLITUDE, FREQUENCY]] = amplitude, angular_frequency

    name = f"ANCF beam, {n_elements} elements, E = {youngs_modulus:g} N/m^2, start={start!r}"
    system = ConstrainedSystem(
        n_q=6 * (n_elements + 1),
        n_c=2,
        **callbacks_in(vars(element)),
        **callbacks_in(globals()),
        force_by_q=elastic_tangent,
        parameters=p,
        constant_mass=True,
        bandwidth=11,  # neighbouring nodes
        joints=[Joint("base", (0, 1), (0, 1))],
        name=name,
    )
    q0 = np.zeros((n_elements + 1, 6))
    q0[:, 0] = l * np.arange(n_elements + 1)
    q0[:, [2, 5]] = 1.0
    v0 = np.zeros((n_elements + 1, 6))
    v0[: 1 if start == "node" else None, 0] = amplitude * angular_frequency
    M = system.mass(0.0, q0.ravel())

    return Problem(
        name=name,
        system=system,
        q0=q0.ravel(),
        v0=v0.ravel(),
        t_span=(0.0, 2.0),
        energy=Energy(M, p),
        drawing=_centre_line(n_elements, l),
        parameters={"n_elements": n_elements, "start": start, **parameters},
        note=f"start assumed, the paper's text does not tell it: straight along x, gravity across it, {STARTS[start]}",
        source="L. Zhang and Zhang, Nonlinear Dynamics (2016), Sect. 4.2; Hussein, Negrut and Shabana (2008)",
        tags=("open chain", "flexible", "planar", "driven", "stiff"),
        purpose="A flexible body on a driven base: frequencies from those wanted to those that only cost steps.",
        conserved=False,
        coordinates=tuple(
            f"{part} of node {node}"
            for node in range(n_elements + 1)
            for part in ("x (m)", "y (m)", "x slope", "y slope", "x director", "y director")
        ),
    )


def _centre_line(n_elements: int, l: float) -> Drawing:
    """Return the centre line as `N_DRAWN` segments per element: cubic, and linear in the coordinates."""
    n = n_elements * N_DRAWN
    matrix = np.zeros((n + 1, 2, 6 * (n_elements + 1)))
    for k in range(n + 1):
        element = min(k // N_DRAWN, n_elements - 1)
        xi = k / N_DRAWN - element
        shapes = {
            0: 1.0 - 3.0 * xi**2 + 2.0 * xi**3,
            2: l * (xi - 2.0 * xi**2 + xi**3),
            6: 3.0 * xi**2 - 2.0 * xi**3,
            8: l * (xi**3 - xi**2),
        }
        for place, shape in shapes.items():
            for axis in range(2):
                matrix[k, axis, 6 * element + place + axis] = shape
    points = LinearPoints(matrix, np.zeros(matrix.shape[:2]))
    return Drawing(points, tuple(pairwise(range(n + 1))), (n,))


def very_flexible_beam(n_elements: int = 4, start: str = "node") -> Problem:
    """The paper's beam of 2e6 N/m^2 on a base that moves by -0.02 m sin(10 pi t); see `ancf_beam`.

    With 4 elements the frequencies of the straight beam are 0 (rotation about the pin), 1.771, 6.220, 14.75, ...,
    3358.5 rad/s. The lowest bending frequency is 19 % above the Euler-Bernoulli value of 1.4836 rad/s: locking
    increases the bending stiffness by (lambda + 2 mu)/E = 1.346, the coarse mesh by 1.059, and 1.194^2 = 1.346 x 1.059.
    The large motion is not converged either: with 4, 8 and 16 elements the tip's height at 1 s is 0.301, 0.001 and
    -0.091 m.

    Examples
    --------
    >>> from twoloop.mechanisms import very_flexible_beam
    >>> problem = very_flexible_beam()
    >>> problem.system.n_q, problem.system.n_c, problem.t_span[1]
    (30, 2, 2.0)
    """
    return ancf_beam(n_elements, start, youngs_modulus=2e6, amplitude=-0.02, angular_frequency=10.0 * math.pi)


def moderately_stiff_beam(n_elements: int = 4, start: str = "node") -> Problem:
    """The paper's beam of 2e8 N/m^2 on a base that moves by -0.01 m sin(2 pi t); see `ancf_beam`.

    Its frequencies are ten times those of `very_flexible_beam`, up to 33585 rad/s.

    Examples
    --------
    >>> from twoloop.mechanisms import moderately_stiff_beam
    >>> problem = moderately_stiff_beam()
    >>> problem.system.n_q, problem.system.n_c, problem.t_span[1]
    (30, 2, 2.0)
    """
    return ancf_beam(n_elements, start, youngs_modulus=2e8, amplitude=-0.01, angular_frequency=2.0 * math.pi)


def tip_height(q: ArrayLike) -> Any:
    """Return the y coordinate of the last node, m, of q (n_q,) or (n_q, n_t)."""
    return np.asarray(q)[-5]


def midpoint_deflection(q: ArrayLike) -> Any:
    """Return the distance of the beam's midpoint from the chord base-tip, m, of q (n_q,) or (n_q, n_t).

    Positive to the left of the direction from the base to the tip.

    Raises
    ------
    ValueError
        If the number of elements is odd, so that there is no node at the midpoint.
    """
    q = np.asarray(q)
    n_elements = len(q) // 6 - 1
    if n_elements % 2 == 1:
        raise ValueError(f"q must be of an even number of elements, with a node in the middle; given {n_elements}")
    x, y = q[-6] - q[0], q[-5] - q[1]
    middle = 3 * n_elements
    return (x * (q[middle + 1] - q[1]) - y * (q[middle] - q[0])) / np.hypot(x, y)
