"""Define the planar four-bar linkage of Sect. 4.1: nine coordinates, eight constraints, one degree of freedom.

Coordinates [x1 y1 th1 x2 y2 th2 x3 y3 th3]: the centres and angles of three uniform rods that form a chain from the
ground joint O = (0, 0) via the joints 1-2 and 2-3 to the ground joint A = (L, 0). All angles are measured from the x
axis along the chain. Eq. (35) of the paper is printed with the cosine of th3 instead of the sine.
"""

import math
from functools import partial
from numbers import Real

import numpy as np

from twoloop.bodies.energy import planar_energy
from twoloop.bodies.frames import GROUND, body_points
from twoloop.bodies.geometry import merged
from twoloop.checks.arguments import check_finite, check_vector
from twoloop.kernels.compile.callbacks import callback
from twoloop.problem.callbacks import callbacks_in
from twoloop.problem.description import Drawing, Joint, body_names
from twoloop.problem.problem import Array, Problem, Reference
from twoloop.problem.system import ConstrainedSystem

GRAVITY = 9.81  # m/s^2
DENSITY = 1.0  # kg/m
DEFAULT_LENGTHS = (1.0, 2.0, 1.5)
DEFAULT_GROUND = 3.0

# p = [L1, L2, L3, L]: the parameters of every callback below


@callback("mass")
def mass(t, q, p, M):
    for i in range(3):
        m = DENSITY * p[i]
        M[3 * i, 3 * i] = m
        M[3 * i + 1, 3 * i + 1] = m
        M[3 * i + 2, 3 * i + 2] = m * p[i] ** 2 / 12.0


@callback("force")
def force(t, q, v, p, Q):
    for i in range(3):
        Q[3 * i + 1] = -DENSITY * p[i] * GRAVITY


@merged
def fill_rows(q, v, p, C, Cq, Qd):
    """Evaluate those of C, C_q and gamma that are not None."""
    x = 0.0  # joint at the start of bar k
    y = 0.0
    for k in range(3):
        dx = p[k] * math.cos(q[3 * k + 2])
        dy = p[k] * math.sin(q[3 * k + 2])
        if C is not None:
            C[2 * k] = q[3 * k] - x - 0.5 * dx
            C[2 * k + 1] = q[3 * k + 1] - y - 0.5 * dy
        x += dx
        y += dy
        if Cq is not None:
            Cq[2 * k, 3 * k] = 1.0
            Cq[2 * k + 1, 3 * k + 1] = 1.0
            Cq[2 * k, 3 * k + 2] = 0.5 * dy
            Cq[2 * k + 1, 3 * k + 2] = -0.5 * dx
            for i in range(k + 1, 3):
                Cq[2 * i, 3 * k + 2] = dy
                Cq[2 * i + 1, 3 * k + 2] = -dx
            Cq[6, 3 * k + 2] = dx
            Cq[7, 3 * k + 2] = -dy
        if Qd is not None:
            w2 = v[3 * k + 2] ** 2
            Qd[2 * k] -= 0.5 * dx * w2
            Qd[2 * k + 1] -= 0.5 * dy * w2
            for i in range(k + 1, 3):
                Qd[2 * i] -= dx * w2
                Qd[2 * i + 1] -= dy * w2
            Qd[6] += dy * w2
            Qd[7] += dx * w2
    if C is not None:
        C[6] = y  # (35), corrected
        C[7] = x - p[3]  # (36)


@callback("constraint")
def constraint(t, q, p, C):
    fill_rows(q, q, p, C, None, None)


@callback("jacobian")
def jacobian(t, q, p, Cq):
    fill_rows(q, q, p, None, Cq, None)


@callback("gamma")
def gamma(t, q, v, p, Qd):
    fill_rows(q, v, p, None, None, Qd)


@callback("kinematics")
def kinematics(t, q, v, p, C, Cq, Ct, Qd):
    fill_rows(q, v, p, C, Cq, Qd)


def four_bar(
    lengths: tuple[float, float, float] = DEFAULT_LENGTHS,
    ground: float = DEFAULT_GROUND,
    theta3: float = 0.0,
    branch: int = -1,
) -> Problem:
    """Return a four-bar linkage of uniform rods of 1 kg/m under gravity 9.81 m/s^2, released from rest.

    The default geometry is *assumed*: the paper's Table 2 is missing from the text that we worked from. It agrees with
    the motion described there: bar 3 starts horizontally, and its centre returns to y = 0 without crossing it.

    Parameters
    ----------
    lengths : (float, float, float)
        Lengths of the bars from O to A, m.
    ground : float
        Distance of the ground joints O and A, m.
    theta3 : float
        Initial angle of bar 3, from joint 2-3 to A, rad.
    branch : {-1, 1}
        1: joint 1-2 lies above the line from O to joint 2-3; -1: below.

    Returns
    -------
    Problem
        It has a reference at 10 s for the default geometry.

    Raises
    ------
    TypeError, ValueError
        If an argument is out of range, or bars 1 and 2 cannot reach joint 2-3.

    Examples
    --------
    >>> from twoloop.mechanisms import four_bar
    >>> problem = four_bar()
    >>> problem.system.n_q, problem.system.n_c, problem.t_span[1]
    (9, 8, 100.0)
    """
    lengths_array = check_vector("lengths", lengths, 3)
    if not (lengths_array > 0.0).all():
        raise ValueError(f"lengths must be positive; given {tuple(lengths_array.tolist())}")
    ground, theta3 = check_finite("ground", ground), check_finite("theta3", theta3)
    if not ground > 0.0:
        raise ValueError(f"ground must be positive; given {ground!r}")
    if isinstance(branch, bool) or not isinstance(branch, Real) or branch not in (-1, 1):
        raise ValueError(
            f"branch must be 1 (joint 1-2 above the line from O to joint 2-3) or -1 (below); given {branch!r}"
        )
    q0 = _assemble(lengths_array, ground, theta3, branch)
    is_default = (*lengths_array.tolist(), ground, theta3, branch) == (*DEFAULT_LENGTHS, DEFAULT_GROUND, 0.0, -1)
    L1, L2, L3 = lengths_array.tolist()
    masses = DENSITY * lengths_array
    points = np.array([[0.0, 0.0], [0.5 * L1, 0.0], [-0.5 * L3, 0.0], [ground, 0.0]])
    system = ConstrainedSystem(
        n_q=9,
        n_c=8,
        **callbacks_in(globals()),
        parameters=[L1, L2, L3, ground],
        constant_mass=True,
        joints=_joints(L2, L3, ground),
        name="four-bar",
    )
    return Problem(
        name=f"four-bar {L1:g}, {L2:g}, {L3:g} m on {ground:g} m",
        system=system,
        q0=q0,
        v0=np.zeros(9),
        t_span=(0.0, 100.0),
        energy=partial(planar_energy, masses, masses * lengths_array**2 / 12.0, GRAVITY),
        conserved=True,
        drawing=Drawing(partial(body_points, (GROUND, 0, 2, GROUND), points), ((0, 1), (1, 2), (2, 3)), (1, 2)),
        parameters={
            "L1": L1,
            "L2": L2,
            "L3": L3,
            "L": ground,
            "theta3": theta3,
            "branch": branch,
            "density": DENSITY,
            "gravity": GRAVITY,
        },
        note="geometry assumed: the paper's Table 2 is missing from the text that we worked from"
        if is_default
        else "geometry chosen for this project",
        reference=_DEFAULT_REFERENCE if is_default else None,
        source="L. Zhang and Zhang, Nonlinear Dynamics (2016), Sect. 4.1",
        tags=("closed chain", "rigid", "planar"),
        purpose="One loop that is released from rest and swings; which coordinates are independent must change.",
        coordinates=body_names("bar 1", "bar 2", "bar 3"),
    )


def _joints(L2: float, L3: float, ground: float) -> list[Joint]:
    """Return the four pins, each acting on the bar that starts there; A acts on bar 3.

    A row of C locates a bar, or A, through the whole chain from O, so a pin corresponds to a difference of rows.
    """
    E = np.eye(8)
    E[2:6, 0:4] -= np.eye(4)  # pins 1-2 and 2-3: difference to the previous bar
    E[6:, :] = 0.0
    E[6, [4, 7]] = E[7, [5, 6]] = 1.0  # pin A: the end of bar 3, x and y
    bars = [((3 * i, 3 * i + 1), (3 * i + 2,)) for i in range(3)]
    return [
        Joint("O", (0, 1), *bars[0], point=(0.0, 0.0), in_space=True, equations=E),
        Joint("1-2", (2, 3), *bars[1], point=(-0.5 * L2, 0.0), equations=E),
        Joint("2-3", (4, 5), *bars[2], point=(-0.5 * L3, 0.0), equations=E),
        Joint("A", (6, 7), *bars[2], point=(ground, 0.0), in_space=True, equations=E),
    ]


def _assemble(lengths: Array, ground: float, theta3: float, branch: int) -> Array:
    """Return the nine coordinates at the start, from the triangle of bars 1 and 2."""
    L1, L2, L3 = lengths.tolist()
    x = ground - L3 * math.cos(theta3)  # joint 2-3
    y = -L3 * math.sin(theta3)
    distance = math.hypot(x, y)
    if not abs(L1 - L2) < distance < L1 + L2:
        raise ValueError(
            f"the linkage cannot be assembled with theta3 = {theta3:g}: joint 2-3 is {distance:.6g} m from O, and "
            f"bars 1 and 2 (lengths {L1:g} and {L2:g} m) span distances between {abs(L1 - L2):g} and {L1 + L2:g} m, "
            "ends excluded. Change lengths, ground or theta3"
        )
    corner = math.acos((L1**2 + distance**2 - L2**2) / (2.0 * L1 * distance))
    theta1 = math.atan2(y, x) + branch * corner
    theta2 = math.atan2(y - L1 * math.sin(theta1), x - L1 * math.cos(theta1))
    q = np.zeros(9)
    x = y = 0.0
    for i, (length, angle) in enumerate(zip((L1, L2, L3), (theta1, theta2, theta3), strict=True)):
        dx, dy = 0.5 * length * math.cos(angle), 0.5 * length * math.sin(angle)
        q[3 * i : 3 * i + 3] = x + dx, y + dy, angle
        x, y = x + 2.0 * dx, y + 2.0 * dy
    return q


_DEFAULT_REFERENCE = Reference(
    t=10.0,
    q=np.array(
        [
            *(0.4655397991275497159, 0.1824080465009168962, 0.3734352752626592493),
            *(1.5353585493399318297, -0.4319567411710029097, -0.9219357319797583370),
            *(2.5698187502123821138, -0.6143647876719198059, 0.9599328424023562726),
        ]
    ),
    v=np.array(
        [
            *(-0.1890158742421557267, 0.4824042240163405336, 1.0362255277000930739),
            *(-0.6180230129644702497, 0.7827971352095650157, -0.3012041251749048317),
            *(-0.4290071387223145229, 0.3003929111932244821, -0.6982938269427819115),
        ]
    ),
    source=(
        "minimal-coordinate and nine-coordinate extrapolation in 200-bit arithmetic, agreeing to 2e-28 "
        "(project's published value, 10 s); derived again in the tests from a one-coordinate equation"
    ),
    period=2.2489859198258701651,
    digits={"q": 15.5, "v": 15.5},
    verified="extrapolation of the two formulations in 200-bit arithmetic; one coordinate, by SciPy: 11 digits",
)
