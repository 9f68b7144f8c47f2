"""The spatial rigid slider-crank of IFToMM's library: crank about x, ball joint, rod, cross, slider along x."""

import math

import numpy as np

from twoloop.bodies.spatial_model import SpatialModel
from twoloop.mechanisms.ready import ready_model
from twoloop.problem.problem import Problem

GRAVITY = 9.81  # m/s^2, along -z
CRANK, ROD = 0.08, 0.3  # m
A = np.array([0.0, 0.1, 0.12])  # m, hinge of the crank
RATE = 6.0  # initial rate of the crank about x, rad/s
MASSES = {"crank": 0.12, "rod": 0.5, "slider": 2.0}  # kg
INERTIAS = {"crank": (1e-4, 1e-4, 1e-5), "rod": (4e-4, 4e-3, 4e-3), "slider": (1e-4, 1e-4, 1e-4)}  # kg m^2


def spatial_slider_crank() -> Problem:
    """The mechanism under gravity, its crank initially upright and rotating at 6 rad/s.

    Examples
    --------
    >>> from twoloop.mechanisms import spatial_slider_crank
    >>> problem = spatial_slider_crank()
    >>> problem.system.n_q, problem.system.n_c, problem.t_span[1]
    (21, 20, 5.0)
    """
    x = np.array([1.0, 0.0, 0.0])
    up = np.array([0.0, 0.0, CRANK])
    B, B_v = A + up, np.cross(RATE * x, up)
    C = np.array([math.sqrt(ROD**2 - B[1] ** 2 - B[2] ** 2), 0.0, 0.0])
    rod = C - B
    C_v = (rod @ B_v) / rod[0] * x
    along = rod / ROD
    cross = np.cross(along, x)  # axis of the cross fixed to the rod, perpendicular to the slider's x
    cross /= np.linalg.norm(cross)
    R = np.column_stack([along, cross, np.cross(along, cross)])
    # spin = along x along' + w along, with w such that (spin x cross) . x = 0
    turn = np.cross(rod, C_v - B_v) / ROD**2
    normal = np.cross(cross, x)
    spin = turn - (turn @ normal) / (along @ normal) * along
    model = SpatialModel((0.0, 0.0, -GRAVITY), name="spatial slider-crank")
    for name, place, turned, velocity, rate in (
        ("crank", A + 0.5 * up, np.eye(3), 0.5 * B_v, RATE * x),
        ("rod", 0.5 * (B + C), R, 0.5 * (B_v + C_v), spin),
        ("slider", C, np.eye(3), C_v, 0.0 * x),
    ):
        pose = {"position": place, "rotation": turned, "velocity": velocity, "angular_velocity": rate}
        model.body(name, mass=MASSES[name], inertia=INERTIAS[name], **pose)
    model.revolute("crank", "ground", at=A, axis=x)
    model.spherical("rod", "crank", at=B)
    model.universal("rod", "slider", at=C, axes=(cross, x))
    model.prismatic("ground", "slider", at=(0.0, 0.0, 0.0), axis=x)
    return ready_model(
        *(model, 5.0),
        conserved=True,
        parameters={"crank": CRANK, "rod": ROD, "A": tuple(A), "masses": MASSES, "inertias": INERTIAS},
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
