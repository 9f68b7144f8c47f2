"""A planar slider-crank in absolute coordinates, with a redundant row; free, and driven at a prescribed crank angle.

Bodies x, y, angle of crank, rod and slider. The redundant row says once more, and not linearly, that the crank pin is
as far from the slider as the rod is long.
"""

import numpy as np

from tests.general.mechanism import G, Mechanism, one_coordinate

CRANK, ROD = 0.5, 1.2
MASSES = np.array([1.0, 1.5, 0.8])
INERTIAS = np.array([1.0 * CRANK**2 / 12.0, 1.5 * ROD**2 / 12.0, 0.02])
MASS = np.array([MASSES, MASSES, INERTIAS]).T.copy().ravel()
WEIGHT = np.array([np.zeros(3), -G * MASSES, np.zeros(3)]).T.copy().ravel()
START = (0.5, 8.0)  # angle of the crank and its rate
REDUNDANT = 8  # together with the rows 2 to 6, any one of which follows from the others

# --- the rows


def constraint(t, q):
    C = np.zeros(9)
    C[0] = q[0] - 0.5 * CRANK * np.cos(q[2])
    C[1] = q[1] - 0.5 * CRANK * np.sin(q[2])
    C[2] = q[3] - 0.5 * ROD * np.cos(q[5]) - CRANK * np.cos(q[2])
    C[3] = q[4] - 0.5 * ROD * np.sin(q[5]) - CRANK * np.sin(q[2])
    C[4] = q[6] - q[3] - 0.5 * ROD * np.cos(q[5])
    C[5] = q[7] - q[4] - 0.5 * ROD * np.sin(q[5])
    C[6] = q[7]
    C[7] = q[8]
    C[8] = 0.5 * ((q[6] - CRANK * np.cos(q[2])) ** 2 + (q[7] - CRANK * np.sin(q[2])) ** 2 - ROD**2)
    return C


def jacobian(t, q):
    Cq = np.zeros((9, 9))
    Cq[0, 0] = Cq[1, 1] = Cq[2, 3] = Cq[3, 4] = Cq[4, 6] = Cq[5, 7] = Cq[6, 7] = Cq[7, 8] = 1.0
    Cq[4, 3] = Cq[5, 4] = -1.0
    Cq[0, 2], Cq[1, 2] = 0.5 * CRANK * np.sin(q[2]), -0.5 * CRANK * np.cos(q[2])
    Cq[2, 2], Cq[3, 2] = CRANK * np.sin(q[2]), -CRANK * np.cos(q[2])
    Cq[2, 5], Cq[3, 5] = 0.5 * ROD * np.sin(q[5]), -0.5 * ROD * np.cos(q[5])
    Cq[4, 5], Cq[5, 5] = 0.5 * ROD * np.sin(q[5]), -0.5 * ROD * np.cos(q[5])
    Cq[8, 6], Cq[8, 7] = q[6] - CRANK * np.cos(q[2]), q[7] - CRANK * np.sin(q[2])
    Cq[8, 2] = CRANK * (q[6] * np.sin(q[2]) - q[7] * np.cos(q[2]))
    return Cq


def gamma(t, q, v):
    crank, rod = CRANK * v[2] ** 2, 0.5 * ROD * v[5] ** 2
    Qd = np.zeros(9)
    Qd[0], Qd[1] = -0.5 * crank * np.cos(q[2]), -0.5 * crank * np.sin(q[2])
    Qd[2], Qd[3] = -rod * np.cos(q[5]) - crank * np.cos(q[2]), -rod * np.sin(q[5]) - crank * np.sin(q[2])
    Qd[4], Qd[5] = -rod * np.cos(q[5]), -rod * np.sin(q[5])
    x, y = q[6] - CRANK * np.cos(q[2]), q[7] - CRANK * np.sin(q[2])
    u, w = v[6] + CRANK * np.sin(q[2]) * v[2], v[7] - CRANK * np.cos(q[2]) * v[2]
    Qd[8] = -(u**2) - w**2 - crank * (x * np.cos(q[2]) + y * np.sin(q[2]))
    return Qd


def with_drive(kind, drive):
    """One of the functions above and, in a last row, that of the drive: angle of the crank = drive(t)[0]."""

    def constraint_driven(t, q):
        return np.append(constraint(t, q), q[2] - drive(t)[0])

    def jacobian_driven(t, q):
        return np.vstack([jacobian(t, q), np.eye(9)[2]])

    def constraint_rate(t, q):
        return np.append(np.zeros(9), -drive(t)[1])

    def gamma_driven(t, q, v):
        return np.append(gamma(t, q, v), drive(t)[2])

    rows = [constraint_driven, jacobian_driven, constraint_rate, gamma_driven]
    return rows[["constraint", "jacobian", "constraint_rate", "gamma"].index(kind)]


# --- the motion, from the triangle


def kinematics(angle):
    """All coordinates and their first two derivatives by the crank angle."""
    pin = CRANK * np.exp(1j * angle)
    tilt = -np.arcsin(pin.imag / ROD)
    slope = -pin.real / (ROD * np.cos(tilt))
    bend = (pin.imag / ROD + np.sin(tilt) * slope**2) / np.cos(tilt)
    half = 0.5 * ROD * np.exp(1j * tilt)
    half_u, half_w = 1j * slope * half, (1j * bend - slope**2) * half

    def body(z, turn):
        return [z.real, z.imag, turn]

    q = body(0.5 * pin, angle) + body(pin + half, tilt) + body(pin + 2.0 * half, 0.0)
    u = body(0.5j * pin, 1.0) + body(1j * pin + half_u, slope) + body(1j * pin + 2.0 * half_u, 0.0)
    w = body(-0.5 * pin, 0.0) + body(-pin + half_w, bend) + body(-pin + 2.0 * half_w, 0.0)
    return np.array(q), np.array(u), np.array(w)


def energy(q, v):
    return 0.5 * v @ (MASS * v) - WEIGHT @ q


FUNCTIONS = {
    "mass": np.diag(MASS),
    "force": lambda t, q, v: WEIGHT.copy(),
    "constraint": constraint,
    "jacobian": jacobian,
    "gamma": gamma,
}


def redundant_slider_crank():
    return Mechanism(
        name="redundant slider-crank",
        sizes={"n_q": 9, "n_c": 9},
        functions=FUNCTIONS,
        end=2.0,
        state=one_coordinate(kinematics, MASS, WEIGHT, START, 2.0),
        rank=8,
        energy=energy,
        compile=True,
    )


def drive(t):
    """Angle of the driven crank and its first two derivatives."""
    return 0.5 + 4.0 * t + 0.3 * np.sin(3.0 * t), 4.0 + 0.9 * np.cos(3.0 * t), -2.7 * np.sin(3.0 * t)


def driven_slider_crank(redundant):
    """No freedom is left: the motion is the drive's. With redundant=True there are ten rows for nine coordinates."""

    def state(t):
        angle, rate, _ = drive(t)
        q, u, _ = kinematics(angle)
        return q, u * rate

    kinds = ("constraint", "jacobian", "constraint_rate", "gamma")
    rows = {kind: with_drive(kind, drive) for kind in kinds}
    if not redundant:
        kept = [i for i in range(10) if i != REDUNDANT]
        rows = {kind: (lambda *x, f=function: f(*x)[kept]) for kind, function in rows.items()}
    return Mechanism(
        name=f"driven slider-crank{', redundant' if redundant else ''}",
        sizes={"n_q": 9, "n_c": 10 if redundant else 9},
        functions={**FUNCTIONS, **rows},
        end=2.0,
        state=state,
        rank=9,
    )


def driven_acceleration(t):
    """Accelerations of the driven slider-crank."""
    angle, rate, acceleration = drive(t)
    _, u, w = kinematics(angle)
    return u * acceleration + w * rate**2
