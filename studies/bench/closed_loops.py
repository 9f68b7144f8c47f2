"""Build the mechanisms with closed loops that physics engines run, of bodies and joints."""

import math
import sys
from collections.abc import Callable, Iterable
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from twoloop.bodies import PlanarModel, SpatialModel
from twoloop.bodies.model_problem import ModelProblem
from twoloop.bodies.rotation import rotation_matrix
from twoloop.mechanisms import andrews as ready_andrews
from twoloop.mechanisms import four_bar as ready_four_bar
from twoloop.problem.problem import Array

numbers = sys.modules[ready_andrews.__module__]  # those of the squeezer


def _linkage(name: str, crank: float, rocker: float, base: float, angle: float) -> PlanarModel:
    """Build a four-bar linkage of uniform rods of 1 kg/m, whose coupler is 2 m long; the crank turns at 8 rad/s."""
    O, C = np.zeros(2), np.array([base, 0.0])
    A = crank * np.array([math.cos(angle), math.sin(angle)])
    AC, d = C - A, float(np.linalg.norm(C - A))
    x = (4.0 - rocker * rocker + d * d) / (2.0 * d)
    B = A + (x * AC + math.sqrt(4.0 - x * x) * np.array([-AC[1], AC[0]])) / d  # to the left of the way from A to C
    model = PlanarModel(name=name)
    model.rod("crank", O, A, mass=crank, angular_velocity=8.0)
    model.rod("coupler", A, B, mass=2.0)
    model.rod("rocker", B, C, mass=rocker)
    pins = [("ground", "crank", O), ("crank", "coupler", A), ("coupler", "rocker", B), ("rocker", "ground", C)]
    return _pinned(model, pins)


def _pinned(model: PlanarModel, pins: Iterable[tuple[str, str, Any]]) -> PlanarModel:
    """Add hinges between two bodies at places, and return the model."""
    for a, b, at in pins:
        model.revolute(a, b, at=at)
    return model


def four_bar() -> ModelProblem:
    """Build the four-bar of the paper, 1, 2 and 1.5 m on 3 m, as the library starts it."""
    known = ready_four_bar()
    q, v = known.q0.reshape(3, 3), known.v0.reshape(3, 3)
    model = PlanarModel(name="four-bar")
    lengths = (1.0, 2.0, 1.5)
    for k, long in enumerate(lengths):
        motion = {"velocity": v[k, :2], "angular_velocity": v[k, 2]}
        model.body(f"bar {k + 1}", mass=long, inertia=long**3 / 12.0, position=q[k, :2], angle=q[k, 2], **motion)
    ends = [
        state[:2] + 0.5 * long * np.array([math.cos(state[2]), math.sin(state[2])])
        for long, state in zip(lengths, q, strict=True)
    ]
    names = ["ground", "bar 1", "bar 2", "bar 3", "ground"]
    pins = zip(names, names[1:], [(0.0, 0.0), ends[0], ends[1], (3.0, 0.0)], strict=False)
    return _pinned(model, pins).problem((0.0, 10.0))


def crank_rocker() -> ModelProblem:
    """Build a four-bar whose crank turns round: 0.5, 2 and 1.5 m on 1.8 m."""
    return _linkage("crank-rocker", 0.5, 1.5, 1.8, 0.5).problem((0.0, 10.0))


def parallelogram() -> ModelProblem:
    """Build a parallelogram, 1, 2 and 1 m on 2 m: the bars line up twice a turn, where it could fold."""
    return _linkage("parallelogram", 1.0, 1.0, 2.0, 0.5 * math.pi).problem((0.0, 2.0))


def parallelogram_motion(times: Array) -> tuple[Array, Array, float]:
    """Return q and v (9, n_t) of the parallelogram that does not fold, and the difference of two solutions.

    All bars turn alike, with a moment of inertia of 2/3 + 2 kg m^2 and the weight of 3 kg at the end of a bar of 1 m.
    """

    def rates(t: float, y: Array) -> list[float]:
        return [y[1], -3.0 * 9.81 * math.cos(y[0]) / (2.0 / 3.0 + 2.0)]

    span, start = (0.0, float(times[-1])), [0.5 * math.pi, 8.0]
    runs = [solve_ivp(rates, span, start, each, t_eval=times, rtol=1e-12, atol=1e-12).y for each in ("DOP853", "LSODA")]
    (angle, rate), zero = runs[0], np.zeros_like(times)
    c, s = np.cos(angle), np.sin(angle)
    q = np.array([0.5 * c, 0.5 * s, angle, 1.0 + c, s, zero, 2.0 + 0.5 * c, 0.5 * s, angle - math.pi])
    v = np.array([-0.5 * s, 0.5 * c, 1.0 + zero, -s, c, zero, -0.5 * s, 0.5 * c, 1.0 + zero]) * rate
    return q, v, float(np.abs(runs[0] - runs[1]).max())


def six_bar() -> ModelProblem:
    """Build Watt's linkage: a four-bar whose coupler, a triangle, moves a second loop."""
    O, A, B, C, D_, E, F = (0.0, 0.0), (0.0, 0.5), (1.6, 1.1), (2.0, 0.0), (0.7, 1.6), (2.6, 1.9), (3.2, 0.0)
    model = PlanarModel(name="Watt's six-bar")
    model.rod("crank", O, A, mass=0.5, angular_velocity=-6.0)
    model.body("coupler", mass=2.0, inertia=0.4, position=(0.77, 1.07))
    for name, start, end in (("rocker", B, C), ("arm", D_, E), ("post", E, F)):
        model.rod(name, start, end, mass=1.0)
    pins = [("ground", "crank", O), ("crank", "coupler", A), ("coupler", "rocker", B), ("rocker", "ground", C)]
    pins += [("coupler", "arm", D_), ("arm", "post", E), ("post", "ground", F)]
    return _pinned(model, pins).problem((0.0, 5.0))


def slider_crank() -> ModelProblem:
    """Build a slider-crank with two coupler rods between the same pins: the second adds a redundant row."""
    crank, rod, angle = 0.5, 1.2, 0.5
    pin = crank * np.array([math.cos(angle), math.sin(angle)])
    end = np.array([pin[0] + math.sqrt(rod**2 - pin[1] ** 2), 0.0])
    model = PlanarModel(name="slider-crank, two rods")
    model.rod("crank", (0.0, 0.0), pin, mass=1.0, angular_velocity=8.0)
    model.rod("rod", pin, end, mass=1.5)
    model.rod("second rod", pin, end, mass=0.5)
    model.body("slider", mass=0.8, inertia=0.02, position=end)
    model.revolute("ground", "crank", at=(0.0, 0.0))
    for each in ("rod", "second rod"):
        model.revolute("crank", each, at=pin)
        model.revolute(each, "slider", at=end)
    model.prismatic("ground", "slider", at=end, axis=(1.0, 0.0))
    return model.problem((0.0, 5.0))


def closed_chain(n: int = 50) -> ModelProblem:
    """Build a chain of 1 kg and 2 m, hung between two points 1.6 m apart and released from an arc above these."""
    # half the angle of the arc, whose chord and length have the ratio 0.8 of n equal chords
    half = brentq(lambda each: math.sin(each) - 0.8 * n * math.sin(each / n), 0.1, 3.0)
    radius = 0.8 / math.sin(half)
    angles = np.linspace(-half, half, n + 1)
    points = np.column_stack([radius * np.sin(angles), radius * (np.cos(angles) - math.cos(half))])
    model = PlanarModel(name=f"closed chain of {n}")
    for k, (one, other) in enumerate(pairwise(points)):
        model.rod(f"bar {k}", one, other, mass=1.0 / n)
    names = ["ground", *(f"bar {k}" for k in range(n)), "ground"]
    return _pinned(model, zip(names, names[1:], points, strict=False)).problem((0.0, 0.5))


def squeezer() -> ModelProblem:
    """Build Andrews' squeezing mechanism, of seven bodies, three loops, a spring and a constant torque."""
    known = ready_andrews()
    beta, theta, gamma, phi, delta, omega, epsilon = known.q0
    A, B, C = np.array([numbers.XA, numbers.YA]), np.array([numbers.XB, numbers.YB]), np.array([numbers.XC, numbers.YC])
    pin = _turned(beta, numbers.RR, 0.0)
    shared = pin + _turned(beta + theta, -numbers.D, 0.0)
    fourth, sixth = A + _turned(delta, numbers.ZT, 0.0), A + _turned(epsilon, 0.0, -numbers.U)
    model = PlanarModel(gravity=(0.0, 0.0), name="Andrews' squeezer")
    centres = (
        (_turned(beta, numbers.RA, 0.0), beta),
        (pin + _turned(beta + theta, -numbers.DA, 0.0), beta + theta),
        (B + _turned(gamma, numbers.SB, -numbers.SA), gamma),
        (fourth + _turned(phi + delta, 0.0, -numbers.EE), phi + delta),
        (A + _turned(delta, numbers.TA, numbers.TB), delta),
        (sixth + _turned(omega + epsilon, numbers.FF, 0.0), omega + epsilon),
        (A + _turned(epsilon, -numbers.UB, -numbers.UA), epsilon),
    )
    for k, (mass, inertia, (place, angle)) in enumerate(
        zip(known.parameters["masses"], known.parameters["inertias"], centres, strict=True), 1
    ):
        model.body(f"K{k}", mass=mass, inertia=inertia, position=place, angle=angle)
    pins = [("ground", "K1", (0.0, 0.0)), ("K1", "K2", pin), ("K2", "K3", shared), ("K2", "K4", shared)]
    pins += [("K2", "K6", shared), ("K3", "ground", B), ("K4", "K5", fourth), ("K5", "ground", A)]
    pins += [("K6", "K7", sixth), ("K7", "ground", A)]
    end = B + _turned(gamma, numbers.SD, -numbers.SC)
    _pinned(model, pins).spring("ground", C, "K3", end, stiffness=numbers.SPRING, length=numbers.LENGTH)
    model.torque("K1", numbers.TORQUE)
    return model.problem((0.0, 0.03))


def _turned(angle: float, x: float, y: float) -> Array:
    return np.array([math.cos(angle) * x - math.sin(angle) * y, math.sin(angle) * x + math.cos(angle) * y])


UPRIGHT = np.eye(3)
ASKEW = rotation_matrix(np.array([0.5, 0.7, -0.1, 0.5]))  # about no axis of the frame


def rssr(Q: Array = UPRIGHT) -> ModelProblem:
    """Build a spatial four-bar with two hinges and two ball joints."""
    model = SpatialModel(gravity=Q @ [0.0, 0.0, -9.81], name="RSSR")
    O, P, S, T = np.array([(0.0, 0.0, 0.0), (0.3, 0.0, 0.0), (0.9, 0.0, 1.0), (0.9, 0.0, 0.3)]) @ Q.T
    model.rod("crank", O, P, radius=0.02, mass=0.8, angular_velocity=6.0 * Q[:, 2])
    for part, start, end in (("coupler", P, S), ("rocker", T, S)):
        model.rod(part, start, end, radius=0.02, mass=0.8)
    model.revolute("ground", "crank", at=O, axis=Q[:, 2])
    model.spherical("crank", "coupler", at=P)
    model.spherical("coupler", "rocker", at=S)
    model.revolute("rocker", "ground", at=T, axis=Q[:, 1])
    return model.problem((0.0, 5.0))


def bricard(Q: Array = UPRIGHT) -> ModelProblem:
    """Build Bricard's loop of six hinges, with five bars of 1 kg and 1 m: one of its rows is redundant."""
    C = np.array([[0, 0, 0], [1, 0, 0], [1, -1, 0], [1, -1, 1], [0, -1, 1], [0, 0, 1]], dtype=float) @ Q.T
    axes = np.eye(3)[[1, 2, 0, 1, 2, 0]] @ Q.T
    model = SpatialModel(gravity=Q @ [0.0, -9.81, 0.0], name="Bricard")
    for k in range(5):
        R = np.column_stack([C[k + 1] - C[k], axes[k], np.cross(C[k + 1] - C[k], axes[k])])
        moments = np.array([0.02, 1.01, 1.01]) / 12.0
        model.body(f"bar {k + 1}", mass=1.0, inertia=moments, position=0.5 * (C[k] + C[k + 1]), rotation=R)
    for k in range(6):
        a, b = (f"bar {j}" if 1 <= j <= 5 else "ground" for j in (k, k + 1))
        model.revolute(a, b, at=C[k], axis=axes[k])
    return model.problem((0.0, 10.0))


def governor(Q: Array = UPRIGHT) -> ModelProblem:
    """Build Watt's flyball governor: arms hinged to a turning shaft, links from these to a sleeve that slides on it."""
    model = SpatialModel(gravity=Q @ [0.0, 0.0, -9.81], name="flyball governor")
    x, y, z = Q.T
    model.rod("shaft", np.zeros(3), z, radius=0.02, mass=1.0, angular_velocity=9.0 * z)
    angle, long = math.radians(35.0), 0.4
    drop, out = long * math.cos(angle), long * math.sin(angle)
    model.box("sleeve", (0.1, 0.1, 0.1), mass=2.0, position=(1.0 - 2.0 * drop) * z, rotation=Q)
    model.revolute("ground", "shaft", at=np.zeros(3), axis=z)
    model.prismatic("shaft", "sleeve", at=(1.0 - 2.0 * drop) * z, axis=z)
    for name, side in (("right", 1.0), ("left", -1.0)):
        top, elbow = side * 0.05 * x + z, side * (0.05 + out) * x + (1.0 - drop) * z
        low = side * 0.05 * x + (1.0 - 2.0 * drop) * z
        model.rod(f"{name} arm", top, elbow, radius=0.02, mass=1.5)
        model.rod(f"{name} link", elbow, low, radius=0.01, mass=0.3)
        model.revolute("shaft", f"{name} arm", at=top, axis=y)
        model.revolute(f"{name} arm", f"{name} link", at=elbow, axis=y)
        model.revolute(f"{name} link", "sleeve", at=low, axis=y)
    return model.problem((0.0, 5.0))


def stewart(Q: Array = UPRIGHT) -> ModelProblem:
    """Build a platform on six legs, each two bodies that slide on one another, with a spring from base to platform."""
    model = SpatialModel(gravity=Q @ [0.0, 0.0, -9.81], name="Stewart platform")
    moving = {"velocity": Q @ [0.3, 0.1, 0.0], "rotation": Q}
    model.body("platform", mass=4.0, inertia=(0.4, 0.4, 0.8), position=Q[:, 2], **moving)
    for k in range(6):
        low, high = (math.radians(60.0 * (k // 2 * 2) + side * (1 if k % 2 else -1)) for side in (10.0, 50.0))
        foot = Q @ [math.cos(low), math.sin(low), 0.0]
        top = Q @ [0.5 * math.cos(high), 0.5 * math.sin(high), 1.0]
        along = (top - foot) / np.linalg.norm(top - foot)
        model.rod(f"cylinder {k}", foot, foot + 0.55 * (top - foot), radius=0.03, mass=0.6)
        model.rod(f"piston {k}", foot + 0.45 * (top - foot), top, radius=0.02, mass=0.4)
        across = np.cross(along, Q[:, 2])
        across /= np.linalg.norm(across)
        model.universal("ground", f"cylinder {k}", at=foot, axes=(across, np.cross(along, across)))
        model.prismatic(f"cylinder {k}", f"piston {k}", at=0.5 * (foot + top), axis=along)
        model.spherical(f"piston {k}", "platform", at=top)
        long = 1.05 * float(np.linalg.norm(top - foot))
        model.spring("ground", foot, "platform", top, stiffness=600.0, length=long)
    return model.problem((0.0, 3.0))


SPATIAL = (rssr, bricard, governor, stewart)
MECHANISMS = (*(four_bar, crank_rocker, parallelogram, six_bar, slider_crank, squeezer, closed_chain), *SPATIAL)
LIGHTER = {", a body 1e2 times lighter": 1e2, ", a body 1e4 times lighter": 1e4}  # how names end
LIGHT = {closed_chain: 25, stewart: 0, bricard: 2}  # number of the body that is lighter, else the second one


def _lightened(build: Callable[[], ModelProblem], ending: str) -> Callable[[], ModelProblem]:
    def make() -> ModelProblem:
        given = build()
        model: Any = given.model
        model.name = given.name + ending
        model.bodies[LIGHT.get(build, 1)].inertia[:] /= LIGHTER[ending]  # mass and moments
        return model.problem(given.t_span)

    make.__name__ = build.__name__ + ending.replace(", ", "_").replace(" ", "_")
    return make


# without the parallelogram, whose known motion is that of its own masses
LIGHTENED = tuple(_lightened(each, by) for each in MECHANISMS if each is not parallelogram for by in LIGHTER)
