"""Define Andrews' squeezing mechanism: seven bodies in a plane, three loops, driven by a constant torque.

Equations in the seven angles beta, Theta, gamma, Phi, delta, Omega, epsilon as in Hairer & Wanner, Solving Ordinary
Differential Equations II, Sect. VII.7, and in the Test Set for IVP Solvers, "andrews". IFToMM's A03.
"""

import math
from typing import Any

import numpy as np

from twoloop.kernels.compile.callbacks import callback
from twoloop.mechanisms.registry import stored_reference
from twoloop.problem.callbacks import callbacks_in
from twoloop.problem.description import Drawing
from twoloop.problem.problem import Array, Problem, Reference
from twoloop.problem.system import ConstrainedSystem

# kg, kg m^2, m, N/m, N m
M1, M2, M3, M4, M5, M6, M7 = 0.04325, 0.00365, 0.02373, 0.00706, 0.07050, 0.00706, 0.05498
I1, I2, I3, I4, I5, I6, I7 = 2.194e-6, 4.410e-7, 5.255e-6, 5.667e-7, 1.169e-5, 5.667e-7, 1.912e-5
XA, YA, XB, YB, XC, YC = -0.06934, -0.00227, -0.03635, 0.03273, 0.014, 0.072
D, DA, E, EA, RR, RA, SS, SA, SB, SC, SD = (
    0.028, 0.0115, 0.02, 0.01421, 0.007, 0.00092, 0.035, 0.01874, 0.01043, 0.018, 0.02,
)  # fmt: skip
TA, TB, U, UA, UB, ZF, ZT, FA = 0.02308, 0.00916, 0.04, 0.01228, 0.00449, 0.02, 0.04, 0.01421
SPRING, LENGTH, TORQUE = 4530.0, 0.07785, 0.033
EE, FF = E - EA, ZF - FA  # distances of the centres of bodies 4 and 6 from the joint shared by both loops

PARAMETERS = {
    "masses": (M1, M2, M3, M4, M5, M6, M7),
    "inertias": (I1, I2, I3, I4, I5, I6, I7),
    "spring": SPRING,
    "length": LENGTH,
    "torque": TORQUE,
}


@callback("mass")
def mass(t, q, p, M):
    c2, s4, s6 = math.cos(q[1]), math.sin(q[3]), math.sin(q[5])
    M[0, 0] = M1 * RA**2 + M2 * (RR**2 - 2.0 * DA * RR * c2 + DA**2) + I1 + I2
    M[0, 1] = M[1, 0] = M2 * (DA**2 - DA * RR * c2) + I2
    M[1, 1] = M2 * DA**2 + I2
    M[2, 2] = M3 * (SA**2 + SB**2) + I3
    M[3, 3] = M4 * EE**2 + I4
    M[3, 4] = M[4, 3] = M4 * (EE**2 + ZT * EE * s4) + I4
    M[4, 4] = M4 * (ZT**2 + 2.0 * ZT * EE * s4 + EE**2) + M5 * (TA**2 + TB**2) + I4 + I5
    M[5, 5] = M6 * FF**2 + I6
    M[5, 6] = M[6, 5] = M6 * (FF**2 - U * FF * s6) + I6
    M[6, 6] = M6 * (FF**2 - 2.0 * U * FF * s6 + U**2) + M7 * (UA**2 + UB**2) + I6 + I7


@callback("force")
def force(t, q, v, p, Q):
    s, c = math.sin(q[2]), math.cos(q[2])
    x, y = SD * c + SC * s, SD * s - SC * c  # vector from B to the end of the spring
    dx, dy = x + XB - XC, y + YB - YC
    length = math.hypot(dx, dy)
    pull = -SPRING * (length - LENGTH) / length
    Q[0] = TORQUE - M2 * DA * RR * v[1] * (v[1] + 2.0 * v[0]) * math.sin(q[1])
    Q[1] = M2 * DA * RR * v[0] ** 2 * math.sin(q[1])
    Q[2] = pull * (x * dy - y * dx)
    Q[3] = M4 * ZT * EE * v[4] ** 2 * math.cos(q[3])
    Q[4] = -M4 * ZT * EE * v[3] * (v[3] + 2.0 * v[4]) * math.cos(q[3])
    Q[5] = -M6 * U * FF * v[6] ** 2 * math.cos(q[5])
    Q[6] = M6 * U * FF * v[5] * (v[5] + 2.0 * v[6]) * math.cos(q[5])


@callback("constraint")
def constraint(t, q, p, C):
    x = RR * math.cos(q[0]) - D * math.cos(q[0] + q[1])  # joint shared by the three loops
    y = RR * math.sin(q[0]) - D * math.sin(q[0] + q[1])
    C[0] = x - SS * math.sin(q[2]) - XB
    C[1] = y + SS * math.cos(q[2]) - YB
    C[2] = x - E * math.sin(q[3] + q[4]) - ZT * math.cos(q[4]) - XA
    C[3] = y + E * math.cos(q[3] + q[4]) - ZT * math.sin(q[4]) - YA
    C[4] = x - ZF * math.cos(q[5] + q[6]) - U * math.sin(q[6]) - XA
    C[5] = y - ZF * math.sin(q[5] + q[6]) + U * math.cos(q[6]) - YA


@callback("jacobian")
def jacobian(t, q, p, Cq):
    dx, dy = D * math.sin(q[0] + q[1]), -D * math.cos(q[0] + q[1])
    for k in range(0, 6, 2):
        Cq[k, 0] = dx - RR * math.sin(q[0])
        Cq[k, 1] = dx
        Cq[k + 1, 0] = dy + RR * math.cos(q[0])
        Cq[k + 1, 1] = dy
    Cq[0, 2] = -SS * math.cos(q[2])
    Cq[1, 2] = -SS * math.sin(q[2])
    Cq[2, 3] = -E * math.cos(q[3] + q[4])
    Cq[2, 4] = Cq[2, 3] + ZT * math.sin(q[4])
    Cq[3, 3] = -E * math.sin(q[3] + q[4])
    Cq[3, 4] = Cq[3, 3] - ZT * math.cos(q[4])
    Cq[4, 5] = ZF * math.sin(q[5] + q[6])
    Cq[4, 6] = Cq[4, 5] - U * math.cos(q[6])
    Cq[5, 5] = -ZF * math.cos(q[5] + q[6])
    Cq[5, 6] = Cq[5, 5] - U * math.sin(q[6])


@callback("gamma")
def gamma(t, q, v, p, Qd):
    one, two = v[0] ** 2, (v[0] + v[1]) ** 2
    x = RR * one * math.cos(q[0]) - D * two * math.cos(q[0] + q[1])  # minus the acceleration of the shared joint
    y = RR * one * math.sin(q[0]) - D * two * math.sin(q[0] + q[1])
    three, five, seven = v[2] ** 2, v[4] ** 2, v[6] ** 2
    four, six = (v[3] + v[4]) ** 2, (v[5] + v[6]) ** 2
    Qd[0] = x - SS * three * math.sin(q[2])
    Qd[1] = y + SS * three * math.cos(q[2])
    Qd[2] = x - E * four * math.sin(q[3] + q[4]) - ZT * five * math.cos(q[4])
    Qd[3] = y + E * four * math.cos(q[3] + q[4]) - ZT * five * math.sin(q[4])
    Qd[4] = x - ZF * six * math.cos(q[5] + q[6]) - U * seven * math.sin(q[6])
    Qd[5] = y - ZF * six * math.sin(q[5] + q[6]) + U * seven * math.cos(q[6])


def energy(t: Any, q: Array, v: Array) -> Any:
    """Return kinetic energy, spring energy and the potential -TORQUE beta of the torque, J, for one state or many."""
    q, v = np.asarray(q), np.asarray(v)
    kinetic = np.empty(q.shape[1:])
    for place in np.ndindex(*q.shape[1:]):
        M = np.zeros((7, 7))
        mass(0.0, np.ascontiguousarray(q[(slice(None), *place)]), np.zeros(0), M)
        kinetic[place] = 0.5 * v[(slice(None), *place)] @ M @ v[(slice(None), *place)]
    s, c = np.sin(q[2]), np.cos(q[2])
    length = np.hypot(SD * c + SC * s + XB - XC, SD * s - SC * c + YB - YC)
    return kinetic + 0.5 * SPRING * (length - LENGTH) ** 2 - TORQUE * q[0]


# pairs of the joints below: crank, coupler, the triangle of body 3, the spring, and the two bars of each other loop
BARS = ((0, 1), (1, 2), (2, 3), (2, 4), (3, 4), (4, 5), (2, 6), (6, 7), (2, 8), (8, 7))


def joints(q: Array) -> Array:
    """Return the positions of the joints: (9, 2) or (9, 2, n_t)."""

    def along(angle: Any) -> Array:
        return np.stack([np.cos(angle), np.sin(angle)])

    def across(angle: Any) -> Array:
        return np.stack([np.sin(angle), -np.cos(angle)])

    def fixed(x: float, y: float) -> Array:
        return np.stack([np.full_like(q[0], x), np.full_like(q[0], y)])

    origin, a, b, c = fixed(0.0, 0.0), fixed(XA, YA), fixed(XB, YB), fixed(XC, YC)
    crank = RR * along(q[0])
    shared = crank - D * along(q[0] + q[1])
    spring = b + SD * along(q[2]) + SC * across(q[2])
    return np.stack([origin, crank, shared, b, spring, c, a + ZT * along(q[4]), a, a + U * across(q[6])])


def andrews() -> Problem:
    """Return Andrews' squeezing mechanism released from rest, as published, over 0.03 s.

    Examples
    --------
    >>> from twoloop.mechanisms import andrews
    >>> problem = andrews()
    >>> problem.system.n_q, problem.system.n_c, problem.t_span[1]
    (7, 6, 0.03)
    """
    q0 = np.array(
        [
            *(-0.0617138900142764496358948458001, 0.0, 0.455279819163070380255912382449),
            *(0.222668390165885884674473185609, 0.487364979543842550225598953530),
            *(-0.222668390165885884674473185609, 1.23054744454982119249735015568),
        ]
    )
    system = ConstrainedSystem(n_q=7, n_c=6, **callbacks_in(globals()), name="Andrews")
    return Problem(
        name="Andrews' squeezing mechanism",
        system=system,
        q0=q0,
        v0=np.zeros(7),
        t_span=(0.0, 0.03),
        energy=energy,
        conserved=True,
        drawing=Drawing(joints, BARS, (1, 2, 6, 8)),
        parameters=PARAMETERS,
        note="The energy counts the potential of the constant torque and is conserved.",
        reference=stored_reference("Andrews' squeezing mechanism"),
        published=PUBLISHED,
        source=(
            "Test Set for IVP Solvers, 'andrews'; Hairer & Wanner, Solving Ordinary Differential Equations II, VII.7; "
            "IFToMM library of benchmarks, A03"
        ),
        tags=("closed chain", "rigid", "planar"),
        purpose=(
            "Three coupled loops, a mass matrix that varies, and angular velocities of 1000 rad/s: the benchmark of "
            "DAE solvers that most have run."
        ),
        coordinates=tuple(f"{name} (rad)" for name in ("beta", "Theta", "gamma", "Phi", "delta", "Omega", "epsilon")),
    )


PUBLISHED = Reference(
    t=0.03,
    q=np.array(
        [
            *(15.81077119629904, -15.75637105984298, 0.04082224013073101, -0.5347301163226948),
            *(0.5244099658805304, 0.5347301163226948, 1.048080741042263),
        ]
    ),
    v=np.array(
        [
            *(1139.920302151208, -1424.379294994111, 11.03291221937134, 19.29337464421385),
            *(0.5735699284790808, -19.29337464421385, 0.3231791658026955),
        ]
    ),
    lam=np.array(
        [
            *(199.1753333731910, -29.75531228015052, 23.06654119098399, 31.45271365475927),
            *(22.64249232082739, 11.61740700019673),
        ]
    ),
    source="Test Set for IVP Solvers, andsoln (PSIDE on a Cray C90, tolerances 1e-14), printed with 16 digits",
    digits={"q": 9.6, "v": 7.3, "lam": 5.9},
    verified="one degree of freedom, in extended precision: the printed state is that at t + 1.0e-12 s",
)
