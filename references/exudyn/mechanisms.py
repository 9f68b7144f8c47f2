"""The four-bar linkage and published mechanisms as Exudyn models with Exudyn's bodies, joints, springs and gravity.

Only masses, inertias, geometry and the initial state are shared with twoloop. Spatial bodies have Euler parameters,
like those of this project, except for the bars of A04, whose rotation matrices are computed from them.
"""

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np

from references.driver import STORED
from references.exudyn.model import GROUND, PRISMATIC, REVOLUTE, SPHERICAL, UNIVERSAL, Model, check_steps, frame, run
from references.lines import CannotRun, Line
from twoloop.bodies.rotation import euler_parameters, rotated_rate, rotation_matrix
from twoloop.mechanisms import bricard, n_four_bar
from twoloop.mechanisms.natural import BRICARD_AXES, BRICARD_CORNERS, BRICARD_FRAMES
from twoloop.mechanisms.planar import PlanarBodies
from twoloop.mechanisms.spatial import BALL, CUBE, DAMPING, DENSITY, HEIGHT, LENGTH, SLACK, STIFFNESS, WIDTH, box
from twoloop.problem.problem import Array, Problem
from twoloop.result.result import Result

X, Y, Z = np.eye(3)
REDUNDANT = ("A02", "A04")  # prefixes of names of mechanisms with rows that are dependent, always or at some positions


def solve_exudyn(
    problem: Problem,
    t_end: float,
    n_steps: int,
    solver: str = "GeneralizedAlpha",
    *,
    spectral_radius: float | None = None,
    store_every: int = 1,
    time_limit: float | None = None,
) -> Result:
    """Run a mechanism with one of Exudyn's implicit solvers with a fixed step.

    Parameters
    ----------
    problem : Problem
        One of those named in `MODELS`, A02, or of `twoloop.mechanisms.four_bar`. Its parameters and initial state are
        used, not its system.
    t_end, n_steps : float, int
        End, s, of a run that starts at 0, and its number of steps.
    solver : {"GeneralizedAlpha", "TrapezoidalIndex2", "HHT"}
        `SOLVERS` has a description of each for tables.

        "GeneralizedAlpha": J. Chung and G. M. Hulbert, J. Appl. Mech. 60 (1993) 371-375, on index 3 by M. Arnold and
        O. Bruels, Multibody Syst. Dyn. 18 (2007) 185-202.

        "HHT": H. M. Hilber, T. J. R. Hughes and R. L. Taylor, Earthq. Eng. Struct. Dyn. 5 (1977) 283-292, with MSC
        Adams' alpha of -0.3. Exudyn has no option for it, so the coefficients of its solver are overwritten.
    spectral_radius : float, optional
        For "GeneralizedAlpha" only, from 0 (most damping) to 1 (none). None: 0.9, Exudyn's default. With 1 the index-3
        form is weakly unstable: on the four-bar linkage the run fails within seconds for any step.
    store_every : int
        Number of steps between stored states; `n_steps` must be a multiple of it.
    time_limit : float, optional
        Wall-clock limit of the run, s, checked after every step.

    Returns
    -------
    Result
        In our coordinates. `a` is Exudyn's, but NaN of A02 by its tips and of A04, whose coordinates Exudyn does not
        have. `lam` is NaN: Exudyn's joint forces are not our multipliers. `h` is empty unless every step is stored.
        Statistics: steps (n_accepted), Newton iterations (n_outer) and Jacobians (n_factorizations); cpu_time is that
        of the solver, its initialisation included.
    """
    if not isinstance(problem, Problem) or not has_model(problem):
        error, given = (ValueError, problem.name) if isinstance(problem, Problem) else (TypeError, problem)
        raise error(f"problem must be a four-bar linkage, of A02 or one of {', '.join(MODELS)}; given {given!r}")
    steps = check_steps(problem, t_end, n_steps, solver, store_every, time_limit, spectral_radius)
    model = MODELS.get(problem.name, _n_four_bar if problem.name.startswith("A02") else _four_bar)(problem)
    model.mbs.Assemble()
    convert = None
    if problem.name == bricard().name:
        convert = _with_matrices
    elif problem.name.startswith("A02") and problem.q0.size != 3 * len(model.bodies):
        convert = _with_tips
    return run(model, steps, convert, problem.name.startswith(REDUNDANT))


def has_model(problem: Problem) -> bool:
    """Return True if there is a model of a problem."""
    return problem.name in MODELS or problem.name.startswith("A02") or "L3" in problem.parameters


def _four_bar(problem: Problem) -> Model:
    p = problem.parameters
    model, lengths = Model((0.0, -p["gravity"], 0.0)), [p[f"L{i + 1}"] for i in range(3)]
    masses = [p["density"] * length for length in lengths]
    model.add_bodies(masses, [m * length**2 / 12.0 for m, length in zip(masses, lengths, strict=True)], problem)
    model.pin(GROUND, (0.0, 0.0), 0, (-0.5 * lengths[0], 0.0))
    for i in range(2):
        model.pin(i, (0.5 * lengths[i], 0.0), i + 1, (-0.5 * lengths[i + 1], 0.0))
    model.pin(2, (0.5 * lengths[2], 0.0), GROUND, (p["L"], 0.0))
    return model


def _heavy_top(problem: Problem) -> Model:
    p = problem.parameters
    model = Model((0.0, 0.0, -p["gravity"]))
    model.add_bodies([p["mass"]], [p["inertia"]], problem)
    model.joint(GROUND, 0, (0.0, 0.0, 0.0), np.eye(3), SPHERICAL)
    return model


def _spatial_slider_crank(problem: Problem) -> Model:
    p = problem.parameters
    model = Model((0.0, 0.0, -9.81))
    masses, inertias = ([p[kind][name] for name in ("crank", "rod", "slider")] for kind in ("masses", "inertias"))
    model.add_bodies(masses, inertias, problem)
    (centre, rod), (slider, _) = model.places[1:]
    model.joint(GROUND, 0, p["A"], frame(X), REVOLUTE)
    model.joint(0, 1, centre - 0.5 * p["rod"] * rod[:, 0], np.eye(3), SPHERICAL)
    second_axis = rod[:, 1]
    model.joint(1, 2, slider, np.column_stack([second_axis, X, np.cross(second_axis, X)]), UNIVERSAL)
    model.joint(GROUND, 2, slider, np.eye(3), PRISMATIC)
    return model


def _governor(problem: Problem) -> Model:
    model = Model((0.0, 0.0, -problem.parameters["gravity"]))
    bar, cube = DENSITY * LENGTH * WIDTH**2, DENSITY * CUBE**3
    centre = (0.5 * bar + BALL) * LENGTH / (bar + BALL)  # centre of mass of rod and ball, from the hinge
    axial, transverse, _ = box(bar, LENGTH, WIDTH, WIDTH)
    transverse += bar * (centre - 0.5 * LENGTH) ** 2 + BALL * (LENGTH - centre) ** 2
    inertias = [box(bar, WIDTH, WIDTH, LENGTH), box(cube, CUBE, CUBE, CUBE), *2 * [(axial, transverse, transverse)]]
    model.add_bodies((bar, cube, bar + BALL, bar + BALL), inertias, problem)
    model.joint(GROUND, 0, (0.0, 0.0, 0.0), frame(Z), REVOLUTE)
    model.joint(0, 1, (0.0, 0.0, HEIGHT), np.roll(frame(Z), 1, axis=1), PRISMATIC)  # along z
    for body, side in ((2, 0.5 * CUBE), (3, -0.5 * CUBE)):
        hinge = np.array([side, 0.0, LENGTH])
        model.joint(0, body, hinge, frame(Y), REVOLUTE)
        middle = hinge + 0.5 * LENGTH * model.places[body][1][:, 0]
        model.spring(1, (side, 0.0, HEIGHT), body, middle, STIFFNESS, DAMPING, SLACK)
    return model


def _bricard(problem: Problem) -> Model:
    model = Model((0.0, -problem.parameters["gravity"], 0.0))
    width = problem.parameters["width"] ** 2 / 12.0
    for (begin, end), R in zip(pairwise(BRICARD_CORNERS), BRICARD_FRAMES, strict=True):
        q = np.concatenate([0.5 * (begin + end), euler_parameters(R)])
        model.body(1.0, (2.0 * width, 1.0 / 12.0 + width, 1.0 / 12.0 + width), q, np.zeros(7))
    for hinge, (corner, axis) in enumerate(zip(BRICARD_CORNERS, BRICARD_AXES, strict=True)):
        next_ = hinge if hinge < 5 else GROUND
        model.joint(hinge - 1 if hinge else GROUND, next_, corner, frame(axis), REVOLUTE)
    return model


def _with_matrices(q: Array, v: Array, a: Array) -> tuple[Array, Array, Array]:
    """Return the bars by centres and rotation matrices instead of Euler parameters."""
    places, rates = [], []
    for x, u in zip(q.reshape(5, 7, -1), v.reshape(5, 7, -1), strict=True):
        places += [x[:3], *np.array([rotation_matrix(e).T for e in x[3:].T]).reshape(-1, 9).T[None]]
        rates += [u[:3], *(np.array(rotated_rate.py_func(*x[3:], *u[3:], *axis)) for axis in np.eye(3))]
    return np.concatenate(places), np.concatenate(rates), np.full((60, q.shape[1]), np.nan)


def _with_tips(q: Array, v: Array, a: Array) -> tuple[Array, Array, Array]:
    """Return the tips of the n + 1 cranks instead of the 2 n + 1 bars."""
    n, n_t = len(q) // 6, q.shape[1]
    x, u = (array.reshape(-1, 3, n_t)[: n + 1, :2] for array in (q, v))
    ground = np.column_stack([np.arange(n + 1.0), np.zeros(n + 1)])
    tips, rates = ((2.0 * x - ground[:, :, None]).reshape(-1, n_t), (2.0 * u).reshape(-1, n_t))
    return tips, rates, np.full_like(tips, np.nan)


def _n_four_bar(problem: Problem) -> Model:
    n = problem.parameters["n"]
    start = n_four_bar(n, "bodies")
    model = Model((0.0, -problem.parameters["gravity"], 0.0))
    model.add_bodies((2 * n + 1) * [1.0], (2 * n + 1) * [1.0 / 12.0], start)
    for i in range(n + 1):
        model.pin(i, (-0.5, 0.0), GROUND, (float(i), 0.0))
    for j in range(n):
        model.pin(n + 1 + j, (-0.5, 0.0), j, (0.5, 0.0))
        model.pin(n + 1 + j, (0.5, 0.0), j + 1, (0.5, 0.0))
    return model


def _slider_crank(problem: Problem) -> Model:
    p = problem.parameters
    model = Model((0.0, -p["gravity"], 0.0))
    model.add_bodies(p["masses"], p["inertias"], problem)
    model.pin(0, (-0.5 * p["crank"], 0.0), GROUND, (0.0, 0.0))
    model.pin(1, (-0.5 * p["rod"], 0.0), 0, (0.5 * p["crank"], 0.0))
    model.pin(2, (0.0, 0.0), 1, (0.5 * p["rod"], 0.0))
    model.hold(2, 1)
    model.hold(2, 2)
    return model


MODELS: dict[str, Callable[[Problem], Model]] = {
    "redundant slider-crank": _slider_crank,  # without the redundant row
    "heavy top": _heavy_top,
    "spatial slider-crank": _spatial_slider_crank,
    "A04 Bricard": _bricard,
    "A05 governor": _governor,
}


def solve_by_step(problem: Problem, t_end: float, *, step: float, **options: Any) -> Result:
    """As `solve_exudyn`, with steps of about `step`, s, of which about `STORED` are stored; raises CannotRun."""
    if not has_model(problem):
        raise CannotRun(f"Exudyn needs a model of its own for every mechanism; there is none of {problem.name!r}")
    store_every = max(1, round(t_end / step) // STORED)
    n_steps = store_every * round(round(t_end / step) / store_every)
    return solve_exudyn(problem, t_end, n_steps, store_every=store_every, **options)


def solve_pinned(
    problem: Problem,
    bodies: PlanarBodies,
    n_steps: int,
    solver: str = "GeneralizedAlpha",
    time_limit: float | None = None,
) -> Result:
    """Run planar bodies with pins by one of Exudyn's implicit solvers with a fixed step, and store the final state.

    The initial state and time span of the problem are used, not its system; and masses, inertias, gravity and pins of
    the bodies. Otherwise as in `references.exudyn.mechanisms.solve_exudyn`.
    """
    steps = check_steps(problem, problem.t_span[1], n_steps, solver, n_steps, time_limit)
    model = Model((0.0, -bodies.gravity, 0.0))
    model.add_bodies(bodies.masses, bodies.inertias, problem)
    for pin in bodies.pins:
        model.pin(*pin)
    model.mbs.Assemble()
    return run(model, steps)


def _line(name: str, options: dict[str, Any], **fields: Any) -> Line:
    fields.update(traces=True, setting="h", of_problem=True, stores_steps=True)
    return Line(name, "exudyn", "Exudyn", solve_by_step, options, **fields)


RADII = (1.0, 0.6)  # spectral radii besides Exudyn's default of 0.9; 1 fails on index 3
ALPHA = "Exudyn, GeneralizedAlpha"
LINES = (
    _line(ALPHA, {}),
    *(_line(f"{ALPHA} {r:g}", {"spectral_radius": r}, compared=r < 1.0, fixed={"spectral_radius": r}) for r in RADII),
    _line("Exudyn, TrapezoidalIndex2", {"solver": "TrapezoidalIndex2"}, keeps=False),  # positions are off by its errors
    _line("Exudyn, HHT", {"solver": "HHT"}, compared=False),
)
