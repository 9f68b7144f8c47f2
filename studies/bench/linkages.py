"""Draw linkages at random, with their motion in one or two angles, computed without code of the integrators.

Four-bar linkages move by `references.paper.four_bar_minimal`; linkages that fold, with bars on top of each other, by
Lagrange's equations. SciPy's DOP853 integrates both at 1e-13.
"""

import sys
from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

from references.paper.four_bar_minimal import MinimalFourBar
from studies.bench.store import Array
from twoloop.bodies import PlanarModel, SpatialModel
from twoloop.mechanisms import Problem, four_bar

equations = sys.modules[four_bar.__module__]  # the module, whose name its function has taken in the package


GRASHOF, OTHER, NEAR = "a bar can turn round", "no bar can", "near a change point"
KINDS = (GRASHOF, OTHER, NEAR)
LENGTHS = (0.3, 2.0)  # m, of bars and ground
APART = 0.05  # m, least |shortest + longest - the others| of the first two kinds ...
CLOSE = (-8.0, -2.0)  # ... and the decades of those of the third
NUDGE = 1e-7  # rad of the initial angle, by which the sensitivity of the end is found
PLACES = np.array([0, 1, 3, 4, 6, 7])  # the coordinates that are lengths


def four_lengths(kind: str, generator: np.random.Generator) -> Array:
    """Lengths of the three bars and of the ground, in random order."""
    while True:
        s = np.sort(generator.uniform(*LENGTHS, 4))
        excess = s[1] + s[2] - s[0] - s[3]  # positive: Grashof's condition holds
        if kind == NEAR:
            s[3] += excess - generator.choice([-1.0, 1.0]) * 10.0 ** generator.uniform(*CLOSE)
            if s[3] < s[2]:
                continue
        elif abs(excess) < APART or (excess > 0.0) != (kind == GRASHOF):
            continue
        return generator.permutation(s)


def end_of(problem: Problem, t_end: float, theta3: float | None = None) -> Array:
    """Positions at t_end by the minimal coordinate; whole turns by which its angles differ at the start are removed."""
    p = problem.parameters if theta3 is None else problem.parameters | {"theta3": theta3}
    q = MinimalFourBar.from_parameters(p).states([0.0, t_end])[0]
    turns = np.round((problem.q0 - q[:, 0]) / (2.0 * np.pi))
    turns[PLACES] = 0.0
    return q[:, 1] + 2.0 * np.pi * turns


def draw(kind: str, generator: np.random.Generator, t_end: float) -> tuple[Problem, Array, float] | None:
    """Return a linkage at rest in a random position, its positions (9,) at the end, and the growth of an error.

    None: it cannot be assembled, or its motion is not known. The growth is that of an error of the angle of bar 3.
    """
    *bars, ground = four_lengths(kind, generator).tolist()
    theta3, branch = float(generator.uniform(-np.pi, np.pi)), int(generator.choice([-1, 1]))
    try:
        problem = four_bar((bars[0], bars[1], bars[2]), ground, theta3, branch)
        q, nudged = end_of(problem, t_end), end_of(problem, t_end, theta3 + NUDGE)
    except ValueError:
        return None
    return problem, q, float(np.abs(nudged - q).max()) / NUDGE


MASS, INERTIA, GRAVITY = 1.0, 0.1, 9.81  # of each bar and of the slider
CHECKED = 20  # states of a run whose accelerations are compared
T_END, MOST_GROWN, STEP = 3.0, 10.0, 1e-4  # s; how much an error may grow, by which neighbour (rad, rad/s) it is found
CIRCLE, RADIUS = np.exp(2j * np.pi * np.arange(16) / 16), 0.08  # complex angles about one, which give derivatives
LINE = np.array([0.9, 0.0, np.sqrt(0.19)])  # of a slider that leaves the plane of its crank
Joints = tuple[dict[str, Any], tuple[Any, ...], Any]  # places, angles of the bars, what is a multiple of pi at a fold


class Linkage(NamedTuple):
    """Bars named by their joints, of which O, D and E stand on the ground; BB slides on a line through O."""

    n: int  # angles that determine it
    joints: Callable[..., Joints]
    bars: str
    in_space: bool = False  # with hinges, three rows of each loop of which are redundant, or a rod without mass
    gravity: float = GRAVITY  # the rhombus lies flat: it would be chaotic


def _to(angle: Any) -> Any:
    return np.array([np.cos(angle), np.sin(angle), 0.0 * angle])


def _two(a: Any, b: Any) -> Joints:
    """Return a rhombus, or its first two bars, a double pendulum, which does not fold."""
    return {"O": 0.0 * _to(a), "A": _to(a), "B": _to(b), "C": _to(a) + _to(b)}, (a, b, b, a), a - b


def _four(x: Any, base: float, coupler: float, angles: tuple[Any, Any], fold: Any) -> Joints:
    A, D = _to(x), base * _to(0.0 * x)
    places = {"O": 0.0 * D, "A": A, "B": A + coupler * _to(angles[0]), "D": D, "E": 0.5 * D, "F": A + 0.5 * D}
    return places, (x, *angles, x), fold


def _antiparallelogram(x: Any) -> Joints:
    s, c, k = np.sin(0.5 * x), np.cos(0.5 * x), 2.7 / 0.7  # (coupler + crank) / (coupler - crank)
    rocker = -x - 2.0 * np.arctan((k - 1.0) * s * c / (c * c + k * s * s))
    return _four(x, 1.7, 1.7, (x + rocker, rocker), x)


def _deltoid(x: Any) -> Joints:
    half = np.arcsin(np.sin(0.5 * x) / 1.4)  # of the angle between coupler and rocker
    return _four(x, 1.0, 1.4, (0.5 * x - half, 0.5 * x + half), 0.5 * x)


def _slider(x: Any, rod: float) -> Joints:
    leans = -x if rod == 1.0 else -np.arcsin(np.sin(x) / rod)
    places = {"O": 0.0 * _to(x), "A": _to(x), "B": _to(x) + rod * _to(leans)}
    return places, (x, leans, 0.0 * x), x + 0.5 * np.pi


def _slider_off_plane(x: Any) -> Joints:
    slider = np.multiply.outer(LINE, 2.0 * LINE[0] * np.cos(x))
    return {"O": 0.0 * _to(x), "A": _to(x), "B": slider}, (x, 0.0 * x), x + 0.5 * np.pi


FOLDS = {
    "rhombus": Linkage(2, _two, "OA OB AC BC", gravity=0.0),
    "parallelogram": Linkage(1, lambda x: _four(x, 2.1, 2.1, (0.0 * x, x), x), "OA AB DB"),
    "three cranks": Linkage(1, lambda x: _four(x, 1.6, 1.6, (0.0 * x, x), x), "OA AFB DB EF"),
    "antiparallelogram": Linkage(1, _antiparallelogram, "OA AB DB"),
    "deltoid": Linkage(1, _deltoid, "OA AB DB"),
    "deltoid in space": Linkage(1, _deltoid, "OA AB DB", True),
    "slider-crank": Linkage(1, partial(_slider, rod=1.0), "OA AB BB"),
    "spatial slider-crank": Linkage(1, _slider_off_plane, "OA BB", True),
}
REGULAR = {
    "double pendulum": Linkage(2, _two, "OA AC"),
    "long slider-crank": Linkage(1, partial(_slider, rod=1.8), "OA AB BB"),
    "long slider-crank in space": Linkage(1, partial(_slider, rod=1.8), "OA AB BB", True),
}


@lru_cache
def moved(
    name: str, seed: tuple[int, ...], size: float = 1.0, inertia: float = INERTIA, heavier: float = 1.0
) -> dict[str, Any]:
    """Draw starts until a linkage folds on the way, if it can; return the data of a trap, with the end of the motion.

    `size`: factor on lengths. `heavier`: factor on the gravity of the system, not of the motion.
    """
    (n, joints, names, in_space, gravity), generator = (FOLDS | REGULAR)[name], np.random.default_rng(seed)
    bars, n_drawn, growth = names.split(), 0, np.inf
    mass, force = (np.tile(each, len(bars)) for each in ([MASS] * 3 + [inertia], [0.0, -MASS * gravity, 0.0, 0.0]))

    def poses(x: Array) -> Array:
        places, angles, _ = joints(*x)
        centres = (0.5 * size * (places[bar[0]] + places[bar[-1]]) for bar in bars)
        return np.concatenate([[*centre, angle] for centre, angle in zip(centres, angles, strict=False)])

    def accelerated(x: Array, w: Array) -> tuple[Array, Array, Array]:
        """Return accelerations of angles and of poses, and the derivatives of these by the angles, by Cauchy."""
        directions = np.column_stack([np.eye(n), w / np.linalg.norm(w)])[:, :, None]
        values = poses(x[:, None, None] + RADIUS * directions * CIRCLE) / len(CIRCLE)
        J, bent = (values @ CIRCLE**-1).real[:, :n] / RADIUS, (values @ CIRCLE**-2).real[:, n] * 2.0 / RADIUS**2
        bent *= w @ w
        a = np.linalg.solve(J.T * mass @ J, J.T @ (force - mass * bent))
        return a, J @ a + bent, J

    def end(y: Array, tolerance: float = 1e-7) -> Array:
        rates = lambda t, y: np.append(y[n:], accelerated(*np.split(y, 2))[0])  # noqa: E731
        return solve_ivp(rates, (0.0, T_END), y, "DOP853", rtol=tolerance, atol=tolerance).y[:n, -1]

    while growth > MOST_GROWN:
        x, w = generator.uniform(-np.pi, np.pi, n), generator.choice([-1.0, 1.0], n) * generator.uniform(1.0, 6.0, n)
        y, n_drawn = np.append(x, w), n_drawn + 1
        last = end(y)
        if name in REGULAR or np.floor(joints(*x)[2] / np.pi) != np.floor(joints(*last)[2] / np.pi):
            errors = [poses(end(y + d)) - poses(last) for d in STEP * np.eye(2 * n)]
            growth = float(np.abs(errors).max()) / STEP / size
    d, axis, moments = (3, {"axis": (0.0, 0.0, 1.0)}, [inertia] * 3) if in_space else (2, {}, inertia)
    model: Any = (SpatialModel if in_space else PlanarModel)([0.0, -heavier * gravity, 0.0][:d], name=name)
    first, rate, last = (each.reshape(-1, 4) for each in (poses(x), accelerated(x, w)[2] @ w, poses(end(y, 1e-13))))
    for bar, pose, moves in zip(bars, first, rate, strict=True):
        turns = {} if in_space else {"angle": pose[3]}
        turns["angular_velocity"] = [0.0, 0.0, moves[3]] if in_space else moves[3]
        model.body(bar, mass=MASS, inertia=moments, position=pose[:d], velocity=moves[:d], **turns)
    places = {joint: size * at[:d] for joint, at in joints(*x)[0].items()}
    for joint, at in places.items():
        holders = [*(["ground"] if joint in "ODE" else []), *(bar for bar in bars if joint in bar)]
        for other in holders[1:]:
            model.revolute(holders[0], other, at=at, **axis)
    if "BB" in bars:
        model.prismatic("ground", "BB", at=places["B"], axis=LINE if len(bars) == 2 else np.eye(3)[0, :d])
    if len(bars) == 2 and in_space:
        model.distance("OA", places["A"], "BB", places["B"])
    half, none = 0.5 * (last - first)[:, 3], np.zeros(len(bars))
    q = np.column_stack([last[:, :3], np.cos(half), none, none, np.sin(half)]) if in_space else last[:, [0, 1, 3]]

    def error_of_a(result: Any) -> float:
        """Return the largest error of accelerations in the plane, over the largest one, of states of a run."""
        chosen = np.unique(np.linspace(0, len(result.t) - 1, CHECKED).astype(int))
        states = (each.T[chosen, 2::3][:, :n] for each in (result.q, result.v))
        a = np.array([accelerated(*state)[1] for state in zip(*states, strict=True)])
        known = a.reshape(len(chosen), -1, 4)[:, :, [0, 1, 3]].reshape(len(chosen), -1).T
        return float(np.abs(result.a[:, chosen] - known).max() / max(1.0, np.abs(known).max()))

    problem = model.problem((0.0, T_END))
    found = {"system": problem.system, "q0": problem.q0, "v0": problem.v0, "t_end": T_END, "mechanism": name}
    found |= {"positions": lambda t: q.ravel(), "sensitivity": max(1.0, growth), "n_drawn": n_drawn}
    return found | {"error": error_of_a}
