"""Define the flexible beam on a moving base of Sect. 4.2: planar shear-deformable elements in absolute coordinates.

The beam of Hussein, Negrut & Shabana (2008), doi 10.1007/s11071-007-9328-9: pinned to a base that moves along x. The
elements of Omar & Shabana (2001), J. Sound Vib. 243(3), 565-576. Coordinates of a node: [r_x r_y, (dr/dx)_x (dr/dx)_y,
(dr/dy)_x (dr/dy)_y], position and the slopes along the two material axes; e (12,) of an element: node A, then B. There
are 6 (n + 1) coordinates for n elements, from the base to the tip. In an element of length l, with xi = x/l and the
thickness coordinate y, r = sum S_i e_i with

    S_1 = 1 - 3 xi^2 + 2 xi^3    S_2 = l (xi - 2 xi^2 + xi^3)    S_3 = (1 - xi) y
    S_4 = 3 xi^2 - 2 xi^3        S_5 = l (xi^3 - xi^2)           S_6 = xi y

so that dr/dx = s + y k and dr/dy = d: the slope s of the centre line is quadratic in xi, the director d linear, and
its rate k = (d_B - d_A)/l constant. Green-Lagrange strains with the plane-strain law [lambda + 2 mu, lambda, mu] over
the whole volume; the integral over y is done in closed form and the one along xi at 5 Gauss points, both exact, so
that the numbers are those of the usual 5 x 3 points.

The element locks: its director is constant over the thickness, so the transverse stress is not relieved in bending,
and (lambda + 2 mu) acts in place of E. At Poisson's ratio 0.3 the bending stiffness is (lambda + 2 mu)/E = 1.346 times
that of the Euler-Bernoulli beam, for any mesh. This is part of the benchmark and is kept.
"""

import math
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from twoloop.bodies.frames import linear_points
from twoloop.checks.arguments import check_number, check_positive, check_size
from twoloop.kernels.compile.callbacks import callback
from twoloop.kernels.data.common import compiled
from twoloop.problem.callbacks import callbacks_in
from twoloop.problem.description import Drawing, Joint
from twoloop.problem.problem import Array, Problem
from twoloop.problem.system import ConstrainedSystem

# indices in p: length of an element; lambda + 2 mu, lambda and mu times the area of the cross-section, N; means of y^2
# and y^4 over the thickness; mass of a unit of length, kg/m; gravity along -y, m/s^2
LENGTH, STIFFNESS, LAME, SHEAR, SECOND, FOURTH, MASS, FALL, N_ELEMENT_PARAMETERS = range(9)


def _gauss_points() -> Array:
    """Return for each of 5 Gauss points on [0, 1]: weight, and factors of (r_B - r_A)/l, s_A, s_B and d_B."""
    x, w = np.polynomial.legendre.leggauss(5)
    xi = 0.5 * (1.0 + x)
    return np.column_stack([0.5 * w, 6.0 * xi * (1.0 - xi), (1.0 - xi) * (1.0 - 3.0 * xi), xi * (3.0 * xi - 2.0), xi])


POINTS = _gauss_points()


@compiled
def _resultants(s, k, d, p):
    """Return derivatives of the energy per unit length, where r_x = s + y k and r_y = d.

    eps_11 = axial + y s.k + y^2 kk, eps_22 = thick, 2 eps_12 = s.d + y k.d; their parts have the resultants n0, n1,
    n2, m0, g0, g1.
    """
    j2, j4 = p[SECOND], p[FOURTH]
    axial = 0.5 * (s[0] * s[0] + s[1] * s[1] - 1.0)
    kk = 0.5 * (k[0] * k[0] + k[1] * k[1])
    thick = 0.5 * (d[0] * d[0] + d[1] * d[1] - 1.0)
    mean = axial + j2 * kk
    n0 = p[STIFFNESS] * mean + p[LAME] * thick
    n1 = p[STIFFNESS] * j2 * (s[0] * k[0] + s[1] * k[1])
    n2 = p[STIFFNESS] * (j2 * axial + j4 * kk) + p[LAME] * j2 * thick
    m0 = p[STIFFNESS] * thick + p[LAME] * mean
    g0 = p[SHEAR] * (s[0] * d[0] + s[1] * d[1])
    g1 = p[SHEAR] * j2 * (k[0] * d[0] + k[1] * d[1])
    return n0, n1, n2, m0, g0, g1


@compiled
def element_force(e, p, Q):
    """Add the elastic force of one element with coordinates e (12,), -dU/de, to Q (12,)."""
    l = p[LENGTH]
    c = (e[6] - e[0]) / l, (e[7] - e[1]) / l
    k = (e[10] - e[4]) / l, (e[11] - e[5]) / l
    for g in range(5):
        w = POINTS[g, 0] * l
        s1, s2, s5, xi = POINTS[g, 1], POINTS[g, 2], POINTS[g, 3], POINTS[g, 4]
        s = s1 * c[0] + s2 * e[2] + s5 * e[8], s1 * c[1] + s2 * e[3] + s5 * e[9]
        d = (1.0 - xi) * e[4] + xi * e[10], (1.0 - xi) * e[5] + xi * e[11]
        n0, n1, n2, m0, g0, g1 = _resultants(s, k, d, p)
        for x in range(2):
            Fs = w * (n0 * s[x] + n1 * k[x] + g0 * d[x])
            Fd = w * (m0 * d[x] + g0 * s[x] + g1 * k[x])
            Fk = w * (n1 * s[x] + n2 * k[x] + g1 * d[x]) / l
            Q[x] += s1 * Fs / l
            Q[2 + x] -= s2 * Fs
            Q[4 + x] -= (1.0 - xi) * Fd - Fk
            Q[6 + x] -= s1 * Fs / l
            Q[8 + x] -= s5 * Fs
            Q[10 + x] -= xi * Fd + Fk


@compiled
def element_tangent(e, p, K):
    """Add the derivative of the elastic force of one element with coordinates e (12,) to K (12, 12), symmetric."""
    l = p[LENGTH]
    stiffness, lame, shear = p[STIFFNESS], p[LAME], p[SHEAR]
    j2, j4 = p[SECOND], p[FOURTH]
    k = (e[10] - e[4]) / l, (e[11] - e[5]) / l
    for g in range(5):
        w = -POINTS[g, 0] * l
        xi = POINTS[g, 4]
        # contributions of the vectors r_A, s_A, r_B, s_B to s, and of d_A, d_B to k and d
        places = (0, 2, 6, 8)
        in_s = (-POINTS[g, 1] / l, POINTS[g, 2], POINTS[g, 1] / l, POINTS[g, 3])
        in_k = (-1.0 / l, 1.0 / l)
        in_d = (1.0 - xi, xi)
        sx = sy = 0.0
        for i in range(4):
            sx, sy = sx + in_s[i] * e[places[i]], sy + in_s[i] * e[places[i] + 1]
        s, d = (sx, sy), (in_d[0] * e[4] + in_d[1] * e[10], in_d[0] * e[5] + in_d[1] * e[11])
        n0, n1, n2, m0, g0, g1 = _resultants(s, k, d, p)
        for x in range(2):
            for y in range(2):
                # second derivatives of the energy of a unit of length by component x of one vector and y of another
                one = w if x == y else 0.0
                ss = one * n0 + w * (stiffness * (s[x] * s[y] + j2 * k[x] * k[y]) + shear * d[x] * d[y])
                sk = one * n1 + w * stiffness * j2 * (s[x] * k[y] + k[x] * s[y])
                sd = one * g0 + w * (lame * s[x] * d[y] + shear * d[x] * s[y])
                kk = one * n2 + w * (stiffness * (j2 * s[x] * s[y] + j4 * k[x] * k[y]) + shear * j2 * d[x] * d[y])
                kd = one * g1 + w * j2 * (lame * k[x] * d[y] + shear * d[x] * k[y])
                dk = one * g1 + w * j2 * (lame * d[x] * k[y] + shear * k[x] * d[y])
                dd = one * m0 + w * (stiffness * d[x] * d[y] + shear * (s[x] * s[y] + j2 * k[x] * k[y]))
                for i in range(4):
                    I = places[i] + x
                    for j in range(4):
                        K[I, places[j] + y] += in_s[i] * in_s[j] * ss
                    for j in range(2):
                        J, value = 4 + 6 * j + y, in_s[i] * (in_k[j] * sk + in_d[j] * sd)
                        K[I, J] += value
                        K[J, I] += value
                for i in range(2):
                    for j in range(2):
                        value = in_k[i] * (in_k[j] * kk + in_d[j] * kd) + in_d[i] * (in_k[j] * dk + in_d[j] * dd)
                        K[4 + 6 * i + x, 4 + 6 * j + y] += value


@callback("mass")
def mass(t, q, p, M):
    l = p[LENGTH]
    m = p[MASS] * l
    places = (0, 2, 6, 8)  # r_A, s_A, r_B, s_B
    # cubic Hermite polynomials over one another, and the linear ones of d_A, d_B; the two kinds do not couple
    hermite = (
        (156.0, 22.0 * l, 54.0, -13.0 * l),
        (22.0 * l, 4.0 * l * l, 13.0 * l, -3.0 * l * l),
        (54.0, 13.0 * l, 156.0, -22.0 * l),
        (-13.0 * l, -3.0 * l * l, -22.0 * l, 4.0 * l * l),
    )
    for first in range(0, q.size - 6, 6):
        for k in range(2):
            for i in range(4):
                for j in range(4):
                    M[first + places[i] + k, first + places[j] + k] += m * hermite[i][j] / 420.0
            A, B = first + 4 + k, first + 10 + k
            M[A, A] += m * p[SECOND] / 3.0
            M[A, B] += m * p[SECOND] / 6.0
            M[B, A] += m * p[SECOND] / 6.0
            M[B, B] += m * p[SECOND] / 3.0


@callback("force")
def force(t, q, v, p, Q):
    l = p[LENGTH]
    weight = p[MASS] * l * p[FALL]
    for first in range(0, q.size - 6, 6):
        Q[first + 1] -= weight / 2.0
        Q[first + 3] -= weight * l / 12.0
        Q[first + 7] -= weight / 2.0
        Q[first + 9] += weight * l / 12.0
        element_force(q[first : first + 12], p, Q[first : first + 12])


@callback("force_by_q")
def elastic_tangent(t, q, v, p, K):
    """Add the derivative dQ/dq of `force` to K (n_q, n_q): symmetric, couples neighbouring nodes only."""
    for first in range(0, q.size - 6, 6):
        element_tangent(q[first : first + 12], p, K[first : first + 12, first : first + 12])


def elastic_energy(q: Array, p: Array) -> Any:
    """Return the elastic energy of a chain of equal elements, J, for q (n_q,) or (n_q, n_t)."""
    nodes = q.reshape(-1, 3, 2, *q.shape[1:])
    (rA, sA, dA), (rB, sB, dB) = np.moveaxis(nodes[:-1], 1, 0), np.moveaxis(nodes[1:], 1, 0)
    l, j2, j4 = p[LENGTH], p[SECOND], p[FOURTH]

    def dot(a: Array, b: Array) -> Array:
        return (a * b).sum(axis=1)

    k = (dB - dA) / l
    kk = 0.5 * dot(k, k)
    total = 0.0
    for weight, s1, s2, s5, xi in POINTS:
        s = s1 * (rB - rA) / l + s2 * sA + s5 * sB
        d = (1.0 - xi) * dA + xi * dB
        axial, thick = 0.5 * (dot(s, s) - 1.0), 0.5 * (dot(d, d) - 1.0)
        squares = axial**2 + j2 * (dot(s, k) ** 2 + 2.0 * axial * kk) + j4 * kk**2 + thick**2
        shear = dot(s, d) ** 2 + j2 * dot(k, d) ** 2
        density = 0.5 * (p[STIFFNESS] * squares + p[SHEAR] * shear) + p[LAME] * thick * (axial + j2 * kk)
        total = total + weight * l * density.sum(axis=0)
    return total


__all__ = ["ancf_beam", "elastic_tangent", "midpoint_deflection", "moderately_stiff_beam", "tip_height"]
__all__ += ["very_flexible_beam"]

GRAVITY = 9.81  # m/s^2
N_DRAWN = 8  # segments drawn per element
MAX_PARAMETER = 1e50  # bound of the parameters in SI units, so that products of a few of them are finite
STARTS = {"node": "only the base node moving (start='node')", "beam": "all of it moving (start='beam')"}

# p: the parameters of the elements, then those of the base's motion
AMPLITUDE, FREQUENCY, N_PARAMETERS = range(N_ELEMENT_PARAMETERS, N_ELEMENT_PARAMETERS + 3)


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


def _energy(M: Array, p: Array, t: Any, q: ArrayLike, v: ArrayLike) -> Any:
    """Return the kinetic, elastic and gravitational energy of a beam, J, at one state, or at many given as columns."""
    q, v = np.asarray(q), np.asarray(v)
    weight = p[FALL] * M[1::6].sum(axis=0)
    return 0.5 * (v * (M @ v)).sum(axis=0) + elastic_energy(q, p) + weight @ q


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
    """Return a beam pinned to a base that moves by amplitude sin(angular_frequency t) along x, with gravity along -y.

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
        if abs(value) > MAX_PARAMETER:
            raise ValueError(f"{name} must be at most {MAX_PARAMETER:g}; given {value!r}")
    if gravity < 0.0:
        raise ValueError(f"gravity must be at least 0, it acts along -y; given {gravity!r}")
    if not -1.0 < poisson_ratio < 0.5:
        raise ValueError(f"poisson_ratio must lie between -1 and 0.5, ends excluded; given {poisson_ratio!r}")

    l = length / n_elements
    area = height * width
    lame = youngs_modulus * poisson_ratio / ((1.0 + poisson_ratio) * (1.0 - 2.0 * poisson_ratio))
    shear = 0.5 * youngs_modulus / (1.0 + poisson_ratio)
    p = np.zeros(N_PARAMETERS)
    p[LENGTH] = l
    p[[STIFFNESS, LAME, SHEAR]] = (lame + 2.0 * shear) * area, lame * area, shear * area
    p[[SECOND, FOURTH]] = height**2 / 12.0, height**4 / 80.0
    p[[MASS, FALL]] = density * area, gravity
    p[[AMPLITUDE, FREQUENCY]] = amplitude, angular_frequency

    name = f"ANCF beam, {n_elements} elements, E = {youngs_modulus:g} N/m^2, start={start!r}"
    system = ConstrainedSystem(
        n_q=6 * (n_elements + 1),
        n_c=2,
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
        energy=partial(_energy, M, p),
        drawing=_centre_line(n_elements, l),
        parameters={"n_elements": n_elements, "start": start, **parameters},
        note=f"start assumed, as the paper does not state it: straight along x, gravity across it, {STARTS[start]}",
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
    points = partial(linear_points, matrix, np.zeros(matrix.shape[:2]))
    return Drawing(points, tuple(pairwise(range(n + 1))), (n,))


def very_flexible_beam(n_elements: int = 4, start: str = "node") -> Problem:
    """Return the paper's beam of 2e6 N/m^2 on a base that moves by -0.02 m sin(10 pi t); see `ancf_beam`.

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
    """Return the paper's beam of 2e8 N/m^2 on a base that moves by -0.01 m sin(2 pi t); see `ancf_beam`.

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
