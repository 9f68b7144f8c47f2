"""Define spatial models by Euler parameters: heavy top, slider-crank, four-bar and governor."""

import math
from functools import partial
from typing import Any

import numpy as np

from twoloop.bodies.rotation import half_spin, rotated
from twoloop.bodies.spatial.model import SpatialModel
from twoloop.mechanisms.registry import ready_model
from twoloop.problem.problem import Array, Problem, Reference

GRAVITY = 9.81  # m/s^2, along -z


def angular_momentum(bodies: Array, point: Array, axis: Array, t: Any, q: Array, v: Array) -> Any:
    """Return the angular momentum about an axis of space through a point, kg m^2/s, for one state or many.

    Parameters
    ----------
    bodies : ndarray (n, 4)
        Mass, kg, and principal moments of inertia, kg m^2, of each body.
    point, axis : ndarray (3,)
        m, and a unit vector.
    q, v : ndarray (n_q,) or (n_q, n_t)
    """
    q, v = (np.asarray(x).reshape(-1, 7, *np.shape(x)[1:]) for x in (q, v))
    total: Any = 0.0
    for (mass, *inertia), state, rate in zip(bodies, q, v, strict=True):
        spin = 2.0 * np.stack(half_spin.py_func(*state[3:], *rate[3:]))
        arm = state[:3] - point.reshape(3, *(1,) * (state.ndim - 1))
        spin_momentum = rotated.py_func(*state[3:], *(np.array(inertia) * spin.T).T)
        moment = np.cross(arm, rate[:3], axis=0) * mass + np.array(spin_momentum)
        total = total + np.tensordot(axis, moment, axes=1)
    return total


def heavy_top() -> Problem:
    """Return the heavy top of the benchmark for Lie-group integrators: its axis initially level, spinning at 150 rad/s.

    Examples
    --------
    >>> from twoloop.mechanisms import heavy_top
    >>> problem = heavy_top()
    >>> problem.system.n_q, problem.system.n_c, problem.t_span[1]
    (7, 4, 0.2)
    """
    mass, length = 15.0, 1.0  # kg; m from the fixed point to the centre of mass, along y
    inertia = (0.234375, 0.46875, 0.234375)  # kg m^2 about the centre of mass
    spin = np.array([0.0, 150.0, -4.61538])  # rad/s at the start
    model, position = SpatialModel((0.0, 0.0, -GRAVITY), name="heavy top"), np.array([0.0, length, 0.0])
    motion = {"velocity": np.cross(spin, position), "angular_velocity": spin}
    model.body("top", mass=mass, inertia=inertia, position=position, **motion)
    model.spherical("top", "ground", at=(0.0, 0.0, 0.0))
    momentum = partial(angular_momentum, np.array([[mass, *inertia]]), np.zeros(3), np.array([0.0, 0.0, 1.0]))
    return ready_model(
        *(model, 0.2),
        conserved=True,
        parameters={"mass": mass, "length": length, "inertia": inertia, "spin": tuple(spin), "gravity": GRAVITY},
        note="The inertia is about the centre of mass, as in Exudyn's model; some give it about the fixed point.",
        published=Reference(
            t=0.2,
            q=np.array([np.nan, np.nan, np.nan, -0.70828, 0.43878, 0.54573, 0.0894]),
            v=np.full(7, np.nan),
            source="jgerstmayr/EXUDYN, TestModels/heavyTop.py, a comment",
            digits={"q": 5.0},
            verified="Euler's equations about the fixed point",
        ),
        source=(
            "jgerstmayr/EXUDYN, TestModels/heavyTop.py; Bruels and Cardona, J. Comput. Nonlinear Dynam. 5 (2010) 031002"
        ),
        tags=("open chain", "rigid", "spatial"),
        purpose=(
            "A mass matrix of rank 6 of 7, and a fast spin beside a slow precession; energy and the angular momentum "
            "about the vertical are kept by the true motion."
        ),
        invariants={"vertical angular momentum (kg m^2/s)": momentum},
    )


def spatial_slider_crank() -> Problem:
    """Return the slider-crank of IFToMM's library under gravity, its crank initially upright and rotating at 6 rad/s.

    Examples
    --------
    >>> from twoloop.mechanisms import spatial_slider_crank
    >>> problem = spatial_slider_crank()
    >>> problem.system.n_q, problem.system.n_c, problem.t_span[1]
    (21, 20, 5.0)
    """
    crank, length = 0.08, 0.3  # m, of crank and rod
    A = np.array([0.0, 0.1, 0.12])  # m, hinge of the crank
    rate = 6.0  # initial rate of the crank about x, rad/s
    masses = {"crank": 0.12, "rod": 0.5, "slider": 2.0}  # kg
    inertias = {"crank": (1e-4, 1e-4, 1e-5), "rod": (4e-4, 4e-3, 4e-3), "slider": (1e-4, 1e-4, 1e-4)}  # kg m^2
    x = np.array([1.0, 0.0, 0.0])
    up = np.array([0.0, 0.0, crank])
    B, B_v = A + up, np.cross(rate * x, up)
    C = np.array([math.sqrt(length**2 - B[1] ** 2 - B[2] ** 2), 0.0, 0.0])
    rod = C - B
    C_v = (rod @ B_v) / rod[0] * x
    along = rod / length
    cross = np.cross(along, x)  # axis of the cross fixed to the rod, perpendicular to the slider's x
    cross /= np.linalg.norm(cross)
    R = np.column_stack([along, cross, np.cross(along, cross)])
    # spin = along x along' + w along, with w such that (spin x cross) . x = 0
    w_perpendicular = np.cross(rod, C_v - B_v) / length**2
    normal = np.cross(cross, x)
    spin = w_perpendicular - (w_perpendicular @ normal) / (along @ normal) * along
    model = SpatialModel((0.0, 0.0, -GRAVITY), name="spatial slider-crank")
    for name, place, R_body, velocity, w in (
        ("crank", A + 0.5 * up, np.eye(3), 0.5 * B_v, rate * x),
        ("rod", 0.5 * (B + C), R, 0.5 * (B_v + C_v), spin),
        ("slider", C, np.eye(3), C_v, 0.0 * x),
    ):
        pose = {"position": place, "rotation": R_body, "velocity": velocity, "angular_velocity": w}
        model.body(name, mass=masses[name], inertia=inertias[name], **pose)
    model.revolute("crank", "ground", at=A, axis=x)
    model.spherical("rod", "crank", at=B)
    model.universal("rod", "slider", at=C, axes=(cross, x))
    model.prismatic("ground", "slider", at=(0.0, 0.0, 0.0), axis=x)
    return ready_model(
        *(model, 5.0),
        conserved=True,
        parameters={"crank": crank, "rod": length, "A": tuple(A), "masses": masses, "inertias": inertias},
        note=(
            "The cross of the joint at the slider is such that the rod starts with the angular velocity (1.92, -0.96, "
            "0.48) rad/s of the benchmark."
        ),
        source=(
            "IFToMM library of benchmarks, spatial rigid slider-crank; jgerstmayr/EXUDYN, "
            "TestModels/sliderCrank3Dbenchmark.py; Haug, Computer-Aided Kinematics and Dynamics (1989), Sect. 12.6"
        ),
        tags=("closed chain", "rigid", "spatial"),
        purpose="A spatial loop with four kinds of joint and one degree of freedom, by Euler parameters.",
    )


def _round_bar(mass: float, length: float, radius: float) -> tuple[float, float, float]:
    """Return the principal moments of a round bar along its first axis, kg m^2."""
    across = mass * (length**2 / 12.0 + radius**2 / 4.0)
    return 0.5 * mass * radius**2, across, across


def _frame(along: Array, up: Array) -> Array:
    """Return a rotation matrix whose first column is along a bar, and the second perpendicular to `up` and it."""
    x = along / np.linalg.norm(along)
    y = np.cross(up, x)
    y = y / np.linalg.norm(y)
    return np.column_stack([x, y, np.cross(x, y)])


def spatial_four_bar() -> Problem:
    """Return the RSSR linkage under gravity, its crank initially level and rotating at 5 rad/s.

    Crank and rocker are on non-parallel hinges, the coupler on two ball joints: the crank rotates about z through the
    origin, the rocker about y through D. The rotation of the coupler about its own axis is a second, decoupled degree
    of freedom.

    Examples
    --------
    >>> from twoloop.mechanisms import spatial_four_bar
    >>> problem = spatial_four_bar()
    >>> problem.system.n_q, problem.system.n_c, problem.t_span[1]
    (21, 19, 2.0)
    """
    crank, rocker = 0.3, 0.7  # m
    D = np.array([0.9, 0.0, 0.3])  # m
    theta, phi = 0.0, 0.5 * math.pi  # initial angles of crank (from x) and rocker (from x, towards z)
    rate = 5.0  # initial rate of the crank, rad/s
    masses = {"crank": 0.6, "coupler": 1.0, "rocker": 0.8}  # kg
    radius = 0.02  # m, of all three round bars
    P = crank * np.array([math.cos(theta), math.sin(theta), 0.0])
    P_v = crank * rate * np.array([-math.sin(theta), math.cos(theta), 0.0])
    arm = rocker * np.array([math.cos(phi), 0.0, math.sin(phi)])
    arm_turned = rocker * np.array([-math.sin(phi), 0.0, math.cos(phi)])
    bar = D + arm - P
    phi_rate = (bar @ P_v) / (bar @ arm_turned)
    S, S_v = D + arm, phi_rate * arm_turned
    length = float(np.linalg.norm(bar))
    spin = np.cross(bar, S_v - P_v) / length**2  # no rotation about its own axis
    up, y = np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0])
    model = SpatialModel((0.0, 0.0, -GRAVITY), name="spatial four-bar")
    for name, long, place, R, velocity, w in (
        ("crank", crank, 0.5 * P, _frame(P, up), 0.5 * P_v, rate * up),
        ("coupler", length, 0.5 * (P + S), _frame(bar, y), 0.5 * (P_v + S_v), spin),
        ("rocker", rocker, D + 0.5 * arm, _frame(arm, y), 0.5 * S_v, -phi_rate * y),  # from x to z is negative about y
    ):
        pose = {"position": place, "rotation": R, "velocity": velocity, "angular_velocity": w}
        model.body(name, mass=masses[name], inertia=_round_bar(masses[name], long, radius), **pose)
    model.revolute("crank", "ground", at=(0.0, 0.0, 0.0), axis=up)
    model.spherical("coupler", "crank", at=P)
    model.spherical("rocker", "coupler", at=S)
    model.revolute("rocker", "ground", at=D, axis=y)
    return ready_model(
        *(model, 2.0),
        conserved=True,
        parameters={"crank": crank, "coupler": length, "rocker": rocker, "D": tuple(D), "masses": masses},
        note="Dimensions and start were chosen for this project.",
        source="textbook mechanism (RSSR)",
        tags=("closed chain", "rigid", "spatial"),
        purpose=(
            "A spatial loop by Euler parameters, 21 coordinates and 19 constraints, with a singular mass matrix and a "
            "freedom, the coupler's turn about its axis, that nothing else feels."
        ),
    )


# IFToMM's A05, Watt's flyball governor whose coupler rods are stiff spring-dampers
DENSITY = 3000.0  # kg/m^3
LENGTH, WIDTH, CUBE = 1.0, 0.01, 0.1  # m: shaft and rods; slider
BALL = 5.0  # kg, at the end of each rod
ANGLE = math.radians(30.0)  # initial angle of the rods below the horizontal
HEIGHT = 0.5  # m, initial height of the slider
STIFFNESS, DAMPING, SLACK = 8e5, 4e4, 0.5  # N/m, N s/m, m
RATE = 2.0 * math.pi  # initial angular velocity, rad/s


def box(mass: float, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return the principal moments of a box, kg m^2."""
    return mass * (y * y + z * z) / 12.0, mass * (x * x + z * z) / 12.0, mass * (x * x + y * y) / 12.0


def governor() -> Problem:
    """Return the stiff flyball governor: springs of 8e5 N/m, dampers of 4e4 N s/m, initial angular velocity 2 pi rad/s.

    Two models of Exudyn are a different problem, with springs of 4000 N/m and 0.16 of that angular velocity.

    Examples
    --------
    >>> from twoloop.mechanisms import governor
    >>> problem = governor()
    >>> problem.system.n_q, problem.system.n_c, problem.t_span[1]
    (28, 24, 10.0)
    """
    z, y = np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0])
    spin = RATE * z
    model, turning = SpatialModel(-GRAVITY * z, name="A05 governor"), {"angular_velocity": spin}
    bar, cube = DENSITY * LENGTH * WIDTH**2, DENSITY * CUBE**3
    moments = box(bar, WIDTH, WIDTH, LENGTH), box(cube, CUBE, CUBE, CUBE)
    still: dict[str, Any] = {"velocity": (0.0, 0.0, 0.0), **turning}
    model.body("shaft", mass=bar, inertia=moments[0], position=0.5 * LENGTH * z, **still)
    model.body("slider", mass=cube, inertia=moments[1], position=HEIGHT * z, **still)
    model.revolute("shaft", "ground", at=(0.0, 0.0, 0.0), axis=z)
    model.prismatic("shaft", "slider", at=HEIGHT * z, axis=z)
    centre = (0.5 * bar + BALL) * LENGTH / (bar + BALL)  # centre of mass of rod and ball, from the hinge
    axial, across, _ = box(bar, LENGTH, WIDTH, WIDTH)
    across += bar * (centre - 0.5 * LENGTH) ** 2 + BALL * (LENGTH - centre) ** 2
    for name, side in (("rod A", 1.0), ("rod B", -1.0)):
        along = np.array([side * math.cos(ANGLE), 0.0, -math.sin(ANGLE)])
        hinge = np.array([side * 0.5 * CUBE, 0.0, LENGTH])
        position = hinge + centre * along
        R = np.column_stack([along, side * y, np.cross(along, side * y)])
        pose = {"position": position, "rotation": R, "velocity": np.cross(spin, position), **turning}
        model.body(name, mass=bar + BALL, inertia=(axial, across, across), **pose)
        model.revolute(name, "shaft", at=hinge, axis=y)
        ends = np.array([side * 0.5 * CUBE, 0.0, HEIGHT]), name, hinge + 0.5 * LENGTH * along
        model.spring("slider", *ends, stiffness=STIFFNESS, damping=DAMPING, length=SLACK)
    bodies = np.array([[bar, *moments[0]], [cube, *moments[1]], *2 * [[bar + BALL, axial, across, across]]])
    return ready_model(
        *(model, 10.0),
        parameters={"stiffness": STIFFNESS, "damping": DAMPING, "rate": RATE, "gravity": GRAVITY},
        source=(
            "IFToMM library of benchmarks, A05; RehabEngGroup/MBSbenchmarksInOpenSim, A05_FlyballGovernor.rst; "
            "jgerstmayr/EXUDYN, Examples/stiffFlyballGovernorKT.py"
        ),
        tags=("closed chain", "rigid", "spatial", "stiff", "dissipative"),
        purpose=(
            "Stiffness by force elements: dampers of time constants of 0.1 ms beside an oscillation of about a second. "
            "The angular momentum about the shaft is kept, and the energy never grows."
        ),
        conserved=False,
        invariants={"angular momentum about the shaft (kg m^2/s)": partial(angular_momentum, bodies, np.zeros(3), z)},
    )
