"""heyoka, CyRK and CVODE on a mechanism in minimal coordinates, where no constraints can drift.

One or two angles with Lagrange's equations derived by hand, from the parameters of a problem only, for mechanisms whose
loops close in closed form. Each equation is written once, for floats (`math`), values of straight-line code, and
expressions (heyoka has functions of the same names). The solvers have the options that are best in redundant
coordinates (`heyoka.taylor`, `cyrk.ode`, `sundials.cvode_c`), and the same timing of a second use of the integrator.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, wraps
from inspect import signature
from types import SimpleNamespace
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from references.cyrk import ode
from references.driver import POSITIVE, Task, check_task, imported
from references.equations.straight_line import Program
from references.heyoka import taylor
from references.lines import CannotRun, Line
from references.paper.four_bar_minimal import MinimalFourBar, absolute, tangent_of
from references.sundials import cvode_c
from twoloop.checks.arguments import check_positive
from twoloop.mechanisms import Problem
from twoloop.problem.problem import Array
from twoloop.result.result import Result

Rates = tuple[Any, ...]  # of [angles, their rates]

INSTANTS = 1000  # per half period, at which the distance from dead centres of a four-bar is determined
NEAREST = 1e-2  # sine of the angle between the two other bars that counts as a dead centre


class NoMinimalCoordinates(CannotRun, ValueError):
    """Raised for a problem without equations in minimal coordinates."""


@dataclass(frozen=True)
class Minimal:
    """A mechanism in minimal coordinates."""

    # (functions, y) -> y' of y = [angles, their rates]; functions: `math`, or another module with sin, cos, sqrt
    rates: Callable[[Any, Any], Rates]
    start: tuple[float, ...]  # initial y
    states: Callable[[Array], tuple[Array, Array]]  # y (2 n, n_t) -> q, v (n_q, n_t) in the problem's coordinates


def minimal(problem: Problem) -> Minimal:
    """Return the equations of a problem in minimal coordinates.

    Raises NoMinimalCoordinates if there are none, or a four-bar has no angle that stays away from its dead centres.
    """
    if not has_minimal(problem):
        given = problem.system.name
        raise NoMinimalCoordinates(f"equations in minimal coordinates exist for {', '.join(MAKE)}; given {given!r}")
    return MAKE[_kind(problem)](problem)


def has_minimal(problem: Problem) -> bool:
    """Return whether there are equations for the mechanism; a four-bar may still be refused by `minimal`."""
    return _kind(problem) in MAKE


def _kind(problem: Problem) -> str:
    """Return the name of the mechanism without its size, which follows a comma."""
    return problem.system.name.partition(",")[0]


def _pendulum(problem: Problem) -> Minimal:
    """One angle from the downward vertical: th'' = -g / L sin th."""
    pull = problem.parameters["gravity"] / problem.parameters["length"]

    def rates(functions: Any, y: Any) -> Rates:
        return y[1], -pull * functions.sin(y[0])

    return _chain(problem, rates)


def _double_pendulum(problem: Problem) -> Minimal:
    """Two angles from the downward vertical; equal masses and lengths.

    Lagrange: 2 th1'' + c th2'' = -s th2'^2 - 2 g/L sin th1 and c th1'' + th2'' = s th1'^2 - g/L sin th2, with c and s
    of th1 - th2.
    """
    pull = problem.parameters["gravity"] / problem.parameters["length"]

    def rates(functions: Any, y: Any) -> Rates:
        sin, cos = functions.sin, functions.cos
        s, c = sin(y[0] - y[1]), cos(y[0] - y[1])
        first = -s * (y[3] * y[3]) - 2.0 * pull * sin(y[0])
        second = s * (y[2] * y[2]) - pull * sin(y[1])
        determinant = 2.0 - c * c
        return y[2], y[3], (first - c * second) / determinant, (2.0 * second - c * first) / determinant

    return _chain(problem, rates)


def _chain(problem: Problem, equations: Callable[[Any, Any], Rates]) -> Minimal:
    """Return links of equal length in a chain from the origin, by their angles from the downward vertical."""
    length = problem.parameters["length"]

    def states(y: Array) -> tuple[Array, Array]:
        angles, rates = np.split(y, 2)
        s, c = length * np.sin(angles), length * np.cos(angles)
        q, v = (np.cumsum(components, axis=1).swapaxes(0, 1) for components in ([s, -c], [c * rates, s * rates]))
        return q.reshape(y.shape), v.reshape(y.shape)

    links, speeds = (np.diff(x.reshape(-1, 2), axis=0, prepend=0.0) for x in (problem.q0, problem.v0))
    turns = (-links[:, 1] * speeds[:, 0] + links[:, 0] * speeds[:, 1]) / (links**2).sum(axis=1)
    start = (*np.arctan2(links[:, 0], -links[:, 1]).tolist(), *turns.tolist())
    return Minimal(equations, start, states)


def _slider_crank(problem: Problem) -> Minimal:
    """One angle, that of the crank; the rod's is asin(-a sin th), as a < 1.

    Both ends of the spring are at half the height of the pin, so its length is half the distance of the slider.
    """
    a, J1, m2, J2, k, c, l0, F = (problem.parameters[name] for name in ("a", "J1", "m2", "J2", "k", "c", "l0", "F"))

    def rates(functions: Any, y: Any) -> Rates:
        sin, cos, sqrt = functions.sin, functions.cos, functions.sqrt
        s, w = sin(y[0]), y[1]
        cc, s2 = cos(y[0]), -a * s
        c2 = sqrt(1.0 - s2 * s2)
        rod = -a * cc / c2  # first derivatives by the angle, of the rod angle and slider position; then second ones
        slide = -s2 * rod - a * s
        rod_2 = (s2 * (rod * rod) + a * s) / c2
        slide_2 = -c2 * (rod * rod) - s2 * rod_2 - a * cc
        length = 0.5 * (c2 + a * cc)
        inertia = J1 + m2 * (slide * slide) + J2 * (rod * rod)
        coupling = m2 * slide * slide_2 + J2 * rod * rod_2
        spring = -0.5 * slide * (k * (length - l0) + 0.5 * c * slide * w)
        push = F * (slide - s2 * rod)
        return w, (spring + push - coupling * (w * w)) / inertia

    def states(y: Array) -> tuple[Array, Array]:
        s, cc = np.sin(y[0]), np.cos(y[0])
        tilt = np.arcsin(-a * s)
        rod = -a * cc / np.cos(tilt)
        slide = -np.sin(tilt) * rod - a * s
        return np.array([y[0], np.cos(tilt) + a * cc, tilt]), y[1] * np.array([np.ones_like(s), slide, rod])

    return Minimal(rates, (float(problem.q0[0]), float(problem.v0[0])), states)


def _four_bar(problem: Problem) -> Minimal:
    """One angle, that of a bar such that the two others are never collinear on the motion.

    The others, of lengths La and Lb, follow from R = La e_a + Lb e_b = (L, 0) - Lk e_k: the component of La e_a along R
    is (R^2 + La^2 - Lb^2) / (2 R^2) times R, and the perpendicular one is a root of constant sign.
    """
    p = problem.parameters
    lengths, ground, density, gravity = (p["L1"], p["L2"], p["L3"]), p["L"], p["density"], p["gravity"]
    reference = MinimalFourBar.from_parameters(p)
    angles = reference.states(np.linspace(0.0, 0.5 * reference.period, INSTANTS))[0][2::3]
    between = [np.sin(angles[b] - angles[a]) for _, a, b in OTHERS]
    best = max(range(3), key=lambda k: np.abs(between[k]).min())
    bar, a, b = OTHERS[best]
    if np.ptp(np.sign(between[best])) or np.abs(between[best]).min() < NEAREST:
        raise NoMinimalCoordinates(f"every angle of {problem.name!r} reaches its dead centre on this motion")
    side = -math.copysign(1.0, between[best][0])  # e_a is to the left of R if e_b is to the right
    Lk, La, Lb = lengths[bar], lengths[a], lengths[b]
    masses = [density * length for length in lengths]
    # centre of bar i = sum of HALVES[i] L e; factors of the three bars in the order k, a, b
    arms = [[masses[i], *(HALVES[i][j] * lengths[j] for j in (bar, a, b))] for i in range(3)]
    Jk, Ja, Jb = (masses[i] * lengths[i] ** 2 / 12.0 for i in (bar, a, b))

    def rates(functions: Any, y: Any) -> Rates:
        sin, cos, sqrt = functions.sin, functions.cos, functions.sqrt
        ck, sk, w = cos(y[0]), sin(y[0]), y[1]
        x, z = ground - Lk * ck, -Lk * sk
        square = x * x + z * z
        parallel = 0.5 * (square + (La * La - Lb * Lb)) / square
        normal = side * sqrt(La * La / square - parallel * parallel)
        ax, az = parallel * x - normal * z, parallel * z + normal * x
        ca, sa, cb, sb = ax / La, az / La, (x - ax) / Lb, (z - az) / Lb
        sine = sb * ca - cb * sa
        # derivatives of the two angles by the independent one: first and second, from the loop closure
        na = -Lk * (sb * ck - cb * sk) / (La * sine)
        nb = Lk * (sa * ck - ca * sk) / (Lb * sine)
        ra, rb = na * na, nb * nb
        wx, wz = Lk * ck + La * ra * ca + Lb * rb * cb, Lk * sk + La * ra * sa + Lb * rb * sb
        da, db = (wx * cb + wz * sb) / (La * sine), -(wx * ca + wz * sa) / (Lb * sine)
        # first and second derivatives of the bars' vectors e
        kx, kz, ax, az, bx, bz = -sk, ck, -sa * na, ca * na, -sb * nb, cb * nb
        kxx, kzz = -ck, -sk
        axx, azz = -ca * ra - sa * da, -sa * ra + ca * da
        bxx, bzz = -cb * rb - sb * db, -sb * rb + cb * db
        inertia, coupling, weight = Jk + Ja * ra + Jb * rb, Ja * na * da + Jb * nb * db, 0.0
        for m, k, a, b in arms:  # and of the centres
            dx, dz = k * kx + a * ax + b * bx, k * kz + a * az + b * bz
            inertia = inertia + m * (dx * dx + dz * dz)
            coupling = coupling + m * (dx * (k * kxx + a * axx + b * bxx) + dz * (k * kzz + a * azz + b * bzz))
            weight = weight + gravity * m * dz
        return w, -(weight + coupling * (w * w)) / inertia

    def turns(angle: Array) -> dict[int, Array]:
        """Return the three angles, continuous in the independent one: R rotates only if its bar exceeds the ground."""
        direction = np.exp(1j * angle)
        chord = ground - Lk * direction
        parallel = 0.5 * (np.abs(chord) ** 2 + La**2 - Lb**2) / np.abs(chord) ** 2
        of_a = chord * (parallel + 1j * side * np.sqrt(La**2 / np.abs(chord) ** 2 - parallel**2))
        chord_angle = np.angle(chord) if Lk < ground else angle + np.angle(-chord / direction) + math.pi
        first = chord_angle + np.angle(of_a / chord)
        return {bar: angle, a: first, b: first + np.angle((chord - of_a) / of_a)}

    at_start = turns(np.array(problem.q0[3 * bar + 2]))
    whole = [2.0 * math.pi * round((problem.q0[3 * i + 2] - float(at_start[i])) / (2.0 * math.pi)) for i in range(3)]

    def states(y: Array) -> tuple[Array, Array]:
        turned = turns(y[0])
        angles = np.array([turned[i] + whole[i] for i in range(3)])
        tangent = tangent_of(np.array(lengths), angles)
        return absolute(np.array(lengths), angles, tangent / tangent[bar] * y[1])

    return Minimal(rates, (float(problem.q0[3 * bar + 2]), float(problem.v0[3 * bar + 2])), states)


def _n_four_bar(problem: Problem) -> Minimal:
    """One angle, that of all cranks from the ground line: th'' = -w^2 cos th, on the branch with level couplers.

    n + 1 uniform bars turn about their ends and n do not turn; at positions where C_q loses rank nothing happens here.
    """
    n, length, gravity = (problem.parameters[name] for name in ("n", "length", "gravity"))
    inertia, weight = (n + 1) / 3.0 + n, 0.5 * (n + 1) + n  # of bars of equal mass, over mass times length (squared)
    pull = weight * gravity / (inertia * length)
    by_tips = len(problem.q0) == 2 * (n + 1)
    crank = 1.0 if by_tips else 0.5  # of its length, to the point whose coordinates are q

    def rates(functions: Any, y: Any) -> Rates:
        return y[1], -pull * functions.cos(y[0])

    def states(y: Array) -> tuple[Array, Array]:
        arm, turned = length * np.exp(1j * y[0]), y[1] * 1j * length * np.exp(1j * y[0])
        bars = [(crank * arm + length * i, crank * turned, y[0], y[1]) for i in range(n + 1)]
        if not by_tips:
            level = np.zeros_like(y[0])
            bars += [(arm + length * (i + 0.5), turned, level, level) for i in range(n)]
        size = 2 if by_tips else 3  # coordinates of each
        q = [part for x, _, angle, _ in bars for part in (x.real, x.imag, angle)[:size]]
        v = [part for _, u, _, rate in bars for part in (u.real, u.imag, rate)[:size]]
        return np.array(q), np.array(v)

    tip, speed = problem.q0[:2] / (crank * length), problem.v0[:2] / (crank * length)
    angle = math.atan2(tip[1], tip[0]) if by_tips else float(problem.q0[2])  # with whole turns
    return Minimal(rates, (angle, float(tip[0] * speed[1] - tip[1] * speed[0])), states)


def minimal_motion(problem: Problem, t_end: float) -> tuple[Callable[[Array], tuple[Array, Array]], float]:
    """Return states(t) -> q, v of a problem, by SciPy's DOP853 in minimal coordinates, and how far LSODA's q are off.

    Raises NoMinimalCoordinates as `minimal`.
    """
    equations = minimal(problem)
    times = np.linspace(0.0, t_end, 1 + 3 * INSTANTS)
    options: dict[str, Any] = {"rtol": 1e-13, "atol": 1e-13, "dense_output": True, "max_step": t_end / INSTANTS}
    motion = (lambda t, y: equations.rates(math, y)), (0.0, t_end), equations.start
    solutions = [solve_ivp(*motion, method=method, **options).sol for method in ("DOP853", "LSODA")]
    q, other = (equations.states(solution(times))[0] for solution in solutions)
    return (lambda t: equations.states(solutions[0](t))), float(np.abs(q - other).max())


OTHERS = ((0, 1, 2), (1, 0, 2), (2, 0, 1))  # a bar and the two others
HALVES = ((0.5, 0.0, 0.0), (1.0, 0.5, 0.0), (1.0, 1.0, 0.5))  # path to the centre of a bar, in lengths of the bars
MAKE: dict[str, Callable[[Problem], Minimal]] = {"four-bar": _four_bar, "A01 pendulum": _pendulum}
MAKE |= {"projection pendulum": _pendulum, "double pendulum": _double_pendulum, "SUNDIALS slider-crank": _slider_crank}
MAKE |= {"A02": _n_four_bar}


FUNCTIONS = ("sin", "cos", "sqrt")  # that equations in minimal coordinates have
_KNOWN: dict[int, tuple[Problem, Minimal]] = {}


def _adapter(integrate: Callable[..., Any]) -> Callable[..., Result]:
    """Turn integrate(equations, task, ...) into solve(problem, t_end, ..., t_eval, time_limit) -> `Result`.

    The run starts at 0 with the problem's initial state. The result is in the problem's coordinates, `a` and `lam` from
    eq. (6). Raises NoMinimalCoordinates, a ValueError, if there are no equations for the problem.
    """

    @wraps(integrate)
    def solve(
        problem: Problem, t_end: float, *tolerances: float, t_eval: Any = None, time_limit: Any = None, **options: Any
    ) -> Result:
        if not isinstance(problem, Problem):
            raise TypeError(f"problem must be a Problem of twoloop.mechanisms; given {problem!r}")
        given = signature(integrate).bind(None, None, *tolerances, **options).arguments
        for name in POSITIVE & given.keys():
            check_positive(name, given[name])
        start = problem.system, (0.0, t_end), problem.q0, problem.v0
        task = check_task(*start, t_eval, time_limit, derivatives=False)
        if id(problem) not in _KNOWN:  # integrators are cached with the equations
            _KNOWN[id(problem)] = problem, minimal(problem)
        equations = _KNOWN[id(problem)][1]
        name, times, rows, failure, counts = integrate(equations, task, *tolerances, **options)
        states = np.concatenate(equations.states(rows.T)) if len(rows) else np.empty((2 * task.system.n_q, 0))
        return task.result(name, times, states, failure, **counts)

    return solve


@_adapter
def solve_heyoka_minimal(equations: Minimal, task: Task, tol: float = 1e-8) -> tuple[Any, ...]:
    """Integrate a mechanism in minimal coordinates by heyoka's Taylor integrator.

    From rest with level links, three of four terms of a pendulum's series vanish. At some orders these include the two
    from which heyoka determines its step: the first step is then much too long, and the run succeeds with a wrong
    state. Another tolerance avoids this; it is not handled here.
    """
    integrator = _integrator(equations, float(tol))
    *run, steps = taylor.integrate(integrator, np.array(equations.start), task, task.t1)
    return *run, {"n_accepted": steps}


@_adapter
def solve_cvode_minimal(equations: Minimal, task: Task, rtol: float = 1e-8, atol: float = 1e-8) -> tuple[Any, ...]:
    """Integrate a mechanism in minimal coordinates by CVODE's Adams methods, driven from C."""
    functions = cvode_c.Functions(_right_hand_side(equations, cvode_c.right_hand_side))
    arguments = functions, np.array(equations.start), task, "Adams", rtol, atol, task.longest(None)
    return "CVODE, Adams,", *cvode_c.integrate(*arguments)


@_adapter
def solve_cyrk_minimal(
    equations: Minimal, task: Task, rtol: float = 1e-8, atol: float = 1e-8, *, method: str = "DOP853"
) -> tuple[Any, ...]:
    """Integrate a mechanism in minimal coordinates by one of CyRK's explicit methods, "DOP853" or "Vern8"."""
    functions = _right_hand_side(equations, ode.right_hand_side), None
    arguments = functions, np.array(equations.start), task, method, rtol, atol, task.longest(None)
    return f"CyRK, {method},", *ode.integrate(*arguments)


@lru_cache(maxsize=256)
def _integrator(equations: Minimal, tol: float) -> Any:
    package = imported("heyoka")
    symbols = package.make_vars(*(f"y{i}" for i in range(len(equations.start))))
    motion = list(zip(symbols, equations.rates(package, symbols), strict=True))
    return taylor.build_integrator(motion, list(equations.start), 0.0, tol, unrolled=True)


@lru_cache(maxsize=64)
def _right_hand_side(equations: Minimal, make: Callable[[Any, int], Any]) -> Any:
    """Return the right-hand side as `make` returns it for a solver of a compiled (t, y, rate) -> None."""
    n = len(equations.start)
    program = Program(n // 2)
    functions = SimpleNamespace(**program.functions(FUNCTIONS))
    return make(program.compiled(enumerate(equations.rates(functions, program.inputs[1:]))), n)


# in minimal coordinates, where these have a closed form: no solvers of a DAE, and in no ranking
FAMILY = "minimal coordinates"
OWN: dict[str, Any] = {"compared": False, "of_problem": True, "traces": True}
LINES = (
    Line(*(f"heyoka, {FAMILY}", "heyoka", FAMILY, solve_heyoka_minimal), one_tolerance=True, builds_each=True, **OWN),
    *(
        Line(f"CyRK, {method}, {FAMILY}", "cyrk", FAMILY, solve_cyrk_minimal, {"method": method}, **OWN)
        for method in ("DOP853", "Vern8")
    ),
    Line(f"CVODE from C, {FAMILY}", "scikit-sundae", FAMILY, solve_cvode_minimal, **OWN),
)
