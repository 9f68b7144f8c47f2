"""Traps: systems and starts on which a solver goes wrong unless it notices.

All traps on chains of point masses share the compiled callbacks of `sharp_mechanisms`, with a force of its own: the
parameters define the trap.
"""

import math
import signal
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from decimal import Decimal, localcontext
from functools import partial
from itertools import chain, count, pairwise, product
from types import SimpleNamespace
from typing import Any

import numpy as np

from studies.bench.linkages import FOLDS, REGULAR, draw, end_of, moved
from studies.bench.linkages import KINDS as LINKAGES
from studies.bench.sharp_forces import FRICTIONS, GUSTS, T_END, Sharp, families, gust, made, pulse
from studies.bench.sharp_mechanisms import (
    CHAIN,
    Mechanism,
    Motion,
    bars,
    chain_force,
    chain_jacobian,
    motion,
    row,
    slider_in_space,
)
from studies.bench.sharp_mechanisms import chain as chain_of
from studies.bench.store import Array
from studies.planted_errors.faults import python_copy
from twoloop import ConstrainedSystem, Result, Status, ensemble, solve_dae, solve_with_stops, sweep
from twoloop.bodies import PlanarModel
from twoloop.kernels.compile.callbacks import callback
from twoloop.mechanisms import Problem, four_bar, n_four_bar

NEVER = 1e30  # s
# groups of traps: a start or a derivative that checks of the input find; a mistake in a model or a setting, or a hard
# motion; a sharp force; a force so short that a solver may step over it; a random linkage; singular positions of A02,
# and of linkages that fold; both again, from many starts and in large sizes; impacts at several stops; little inertia;
# certificates; exceptions of signal handlers; forces that depend on the number of calls
GROUPS = INPUT, MISTAKE, FORCE, SHORT, LINKAGE, SINGULAR, FOLD, MANY, STOPS, INERTIA, CERTIFICATE, SIGNAL, CALLS = (
    *("input", "mistake", "force", "short", "linkage", "singular", "fold", "many folds", "stops", "inertia"),
    *("certificate", "signal", "calls"),
)
AGREE = 1e-8  # m or rad: how far two methods may differ in the motion under a force
SEED = 20261130  # of all draws: the day. Draw by a new seed when the methods have been changed to pass these
GROWN = 100.0  # how much errors may grow in a motion under a force, up to which two methods can agree on it
FORCES = (  # families of `sharp_forces`
    "drag",
    *(f"tanh friction, width {width:g}" for width in FRICTIONS),
    *(f"gust of {1e3 * width:g} ms" for width in GUSTS),
    *("softplus stop", "chirp", "switching drive", "square wave", "noise by interpolation"),
)
UNKNOWN_IN_SPACE = FORCES[-4:]  # two methods do not agree to AGREE there
KINK = "drive with a kink"
QUICK_FORCES = ("drag", "gust of 30 ms", KINK)
# a gust exp(-(t / b)^2) has tails; a pulse is zero before and behind
SHAPES: dict[str, Callable[[float], Any]] = {"gust": gust, "pulse": pulse}
WIDTHS = (1e-4, 3e-4, 1e-3, 3e-3, 1e-2)  # s: b of a gust, duration of a pulse
N_DRAWS, N_QUICK, QUICK_WIDTHS = 8, 2, (1e-3,)  # of each width on each mechanism
N_LINKAGES, LINKAGE_END = 100, 5.0  # of each kind; s
SIZES, ENDS = tuple(range(1, 7)), (5.0, 10.0, 20.0)  # of A02 in both sets of coordinates; s
TOLERANCES = tuple(10.0 ** (-0.5 * k) for k in range(12, 23))  # of A02: 1e-6 to 1e-11
N_STARTS, FOLD_TOLERANCES = 5, tuple(10.0**-k for k in range(4, 12))  # of each linkage that folds
MORE_STARTS = dict.fromkeys(FOLDS, 20) | {"rhombus": 95}
MORE_SIZES, LONGER = (10, 20, 40), 100.0  # of A02; s, the time limit of its runs
N_BALLS, N_LONG, N_SIGNALS, N_CALLS, LASTING = 4, 2, 4, 5, 3.0  # draws of each kind; s
STOP_TOLERANCES, INERTIA_TOLERANCES, CERTIFICATE_TOLERANCES = (1e-5, 1e-8, 1e-11), (1e-8, 1e-10), (1e-4, 1e-6, 1e-8)
LEAST_IMPACTS, NUDGE = 15, 1e-9  # of balls; m/s, by which velocities are changed to see how errors grow
LONG_BARS = ("parallelogram", "deltoid", *list(REGULAR)[:2])
DECADES = (1.0, -7.0), (2.0, -3.0)  # least and largest, of lengths and moments of inertia
DIGITS = 40  # of impacts
WAIT, LATEST = 2.0, 0.08  # s: how long an exception of a signal handler is waited for; the latest time of a signal
ANGLES = [{"theta3": 0.02 * k} for k in range(20)]  # of the runs of a sweep
INSTANTS = np.linspace(0.0, LASTING, 500)  # of a dense output
# places in the parameters behind lengths and masses: a spring that holds the last point, and where it is at rest;
# begin, end and size of a force along x; when the force becomes NaN, when it raises; a wrong entry of C_q
SPRING, REST, BEGIN, END, PUSH, NAN, RAISES, WRONG = range(8)
SANE = (0.0, 0.0, NEVER, NEVER, 0.0, NEVER, NEVER, 0.0)


@callback("force")
def force(t, q, v, p, Q):  # type: ignore[no-untyped-def]
    n = q.size
    if t > p[n + RAISES]:
        raise ValueError("the trap's callback raises")
    chain_force(t, q, v, p, Q)
    Q[n - 2] -= p[n + SPRING] * (q[n - 2] - p[n + REST])
    if p[n + BEGIN] < t <= p[n + END]:
        Q[n - 2] += p[n + PUSH]
    if t > p[n + NAN]:
        Q[n - 2] = math.nan


@callback("jacobian")
def jacobian(t, q, p, Cq):  # type: ignore[no-untyped-def]
    chain_jacobian(t, q, p, Cq)
    Cq[0, 1] += p[q.size + WRONG]


def fails(Q: Array, t: float, *state: Array) -> Array:
    """An error of Python after 1 s, in place of the force Q."""
    if t > 1.0:
        raise KeyError("the trap's callback raises")
    return Q


@dataclass(frozen=True)
class Trap:
    """What is wrong, on one mechanism."""

    name: str
    mechanism: str
    system: ConstrainedSystem
    q0: Array  # (n_q,)
    v0: Array  # (n_q,)
    t_end: float
    # the same without the mistake: its motion is the right answer. None: there is none, and whoever reports success is
    # wrong.
    sane: ConstrainedSystem | None = None
    breaks: tuple[float, ...] = ()  # times at which the right motion is computed in pieces
    positions: Callable[[float], Array] | None = field(default=None, repr=False)  # positions(t) -> q, if known
    tolerance: float = 1e-8
    time_limit: float = 10.0
    # `step_size`, `first_step` or `max_step`, for solvers whose adapter takes them
    steps: Mapping[str, float] = field(default_factory=dict)
    unnoticed: ConstrainedSystem | None = None  # the system for a solver that never evaluates it where the trap lies
    group: str = MISTAKE  # one of the groups above
    impulse: bool = False  # whether velocities jump
    singular: bool = False  # whether C_q loses rank on the way
    sensitivity: float = 1.0  # growth of an error at the start; where it is above 1, so much more error is allowed
    n_drawn: int = 1  # how many were drawn until the motion of one was known
    solve: Callable[..., Any] = solve_dae
    error: Callable[[Any], float] | None = None  # error(result), where the positions at the end do not tell it


def start(n: int) -> tuple[Array, Array]:
    """The chain out of the vertical, at rest."""
    angles = np.linspace(0.6, 0.2, n)
    q = np.empty(2 * n)
    q[::2], q[1::2] = np.cumsum(np.sin(angles)), -np.cumsum(np.cos(angles))
    return q, np.zeros(2 * n)


def traps(quick: bool, groups: Sequence[str] | None = None) -> Iterator[Trap]:
    """Yield all traps, or those of some groups."""
    sizes = (2,) if quick else (2, 3)
    made: dict[str, Callable[[], Iterator[Trap]]] = {
        MISTAKE: lambda: chain((trap for n in sizes for trap in of_chain(n)), () if quick else of_linkages()),
        LINKAGE: lambda: random_linkages(0 if quick else N_LINKAGES),
        SINGULAR: lambda: iter(()) if quick else singular_positions(),
        FOLD: lambda: iter(()) if quick else folds(),
        MANY: lambda: iter(()) if quick else many_folds(),
        STOPS: lambda: several_stops(1 if quick else N_BALLS),
        INERTIA: lambda: little_inertia(0 if quick else N_LONG),
        CERTIFICATE: lambda: iter(()) if quick else certificates(),
        SIGNAL: lambda: signals(1 if quick else N_SIGNALS),
        CALLS: lambda: changing_torques(1 if quick else N_CALLS),
        FORCE: lambda: under_forces(quick),
        SHORT: lambda: short_forces(quick),
    }
    for group, make in made.items():
        if groups is None or group in groups or (group == MISTAKE and INPUT in groups):
            yield from (trap for trap in make() if groups is None or trap.group in groups)


def of_linkages() -> Iterator[Trap]:
    """Yield dead points, and positions where the two assemblies of a linkage nearly meet."""
    for ground in (2.0, 1.9):  # bars 1 and 2 come into line: the angle of bar 3 does not determine theirs
        problem = four_bar((0.8, 1.2, 1.0), ground)
        yield of_motion("dead point", problem, partial(end_of, problem))
    for excess in (1e-4, -1e-7):  # longest and shortest less the other two: 0 at a change point
        problem = four_bar((0.5, 1.5, 1.0), 2.0 + excess, theta3=1.0)
        yield of_motion("assemblies nearly meet", problem, partial(end_of, problem))


def random_linkages(n: int) -> Iterator[Trap]:
    """Yield n four-bar linkages of each kind with a known motion, released from rest."""
    for (place, kind), k in product(enumerate(LINKAGES), range(n)):
        g, drawn, n_drawn = np.random.default_rng([SEED, place, k]), None, 0
        while drawn is None:
            drawn, n_drawn = draw(kind, g, LINKAGE_END), n_drawn + 1
        problem, q, growth = drawn
        about: dict[str, Any] = {"mechanism": f"linkage {k}", "n_drawn": n_drawn, "sensitivity": max(1.0, growth)}
        trap = of_motion(kind, problem, lambda t, q=q: q)  # type: ignore[misc]
        yield replace(trap, t_end=LINKAGE_END, **about, group=LINKAGE)


def singular_positions() -> Iterator[Trap]:
    """Yield IFToMM's A02, which passes singular positions, in all SIZES, both coordinates, ENDS and TOLERANCES."""
    for coordinates, n, t_end, tolerance in product(("tips", "bodies"), SIZES, ENDS, TOLERANCES):
        problem = n_four_bar(n, coordinates)
        trap = of_motion(SINGULAR, problem, lambda t, known=problem.motion: known(t)[0])  # type: ignore[misc]
        name = f"{problem.name}, {t_end:g} s, {tolerance:.2g}"
        yield replace(trap, t_end=t_end, tolerance=tolerance, mechanism=name, singular=True, group=SINGULAR)


def folds(group: str = FOLD) -> Iterator[Trap]:
    """Yield linkages that fold on the way, from N_STARTS random starts or from MANY more, at FOLD_TOLERANCES."""
    for place, name in enumerate(FOLDS):
        starts = range(N_STARTS) if group == FOLD else range(N_STARTS, N_STARTS + MORE_STARTS[name])
        for k, tolerance in product(starts, FOLD_TOLERANCES):
            known = moved(name, (SEED, place, k)) | {"mechanism": f"{name}, start {k}, {tolerance:g}", "error": None}
            yield Trap("linkage that folds", **known, tolerance=tolerance, singular=True, group=group)


def many_folds() -> Iterator[Trap]:
    """Yield linkages that fold from MORE_STARTS, and A02 in MORE_SIZES over its published time."""
    yield from folds(MANY)
    for coordinates, n, tolerance in product(("tips", "bodies"), MORE_SIZES, FOLD_TOLERANCES):
        problem = n_four_bar(n, coordinates)
        trap = of_motion(SINGULAR, problem, lambda t, known=problem.motion: known(t)[0])  # type: ignore[misc]
        about: dict[str, Any] = {"tolerance": tolerance, "mechanism": f"{problem.name}, {tolerance:g}", "group": MANY}
        yield replace(trap, t_end=problem.t_span[1], singular=True, time_limit=LONGER, **about)


def several_stops(n: int) -> Iterator[Trap]:
    """Yield n draws of balls on a rail, one of them light, that collide often, with a wall and without."""
    for (in_line, wall), k in product(((2, True), (3, False), (3, True), (4, False)), range(n)):
        g, n_drawn, growth = np.random.default_rng([SEED, in_line, wall, k]), 0, np.inf
        while growth > GROWN:
            masses, x = g.uniform(0.4, 2.0, in_line), np.cumsum(g.uniform(0.2, 1.0, in_line))
            masses[g.integers(1 - wall, in_line - 1)] *= 10.0 ** g.uniform(-3.0, -1.0)
            v, restitutions, n_drawn = g.uniform(-1.5, 1.5, in_line), g.uniform(0.3, 0.9, in_line), n_drawn + 1
            ends = [collided(masses, restitutions, x, v + d, wall) for d in NUDGE * np.eye(in_line + 1, in_line, -1)]
            if ends[0][1] >= LEAST_IMPACTS:
                growth = max(float(np.abs(end - ends[0][0]).max()) for end, _ in ends) / NUDGE
        model = PlanarModel((0.0, 0.0), name=f"{in_line} balls{' and a wall' * wall}")
        for j, mass in enumerate(masses):
            model.body(f"ball {j}", mass=mass, inertia=1.0, position=(x[j], 0.0), velocity=(v[j], 0.0))
            model.prismatic("ground", f"ball {j}", at=(x[j], 0.0), axis=(1.0, 0.0))
            if j or wall:
                foot, on = (x[j - 1], f"ball {j - 1}") if j else (0.0, "ground")
                given = {"normal": (1.0, 0.0), "restitution": restitutions[j]}
                model.stop(f"ball {j}", (x[j], 0.0), on, (foot, 0.0), **given)
        problem, end = model.problem((0.0, LASTING)), np.kron(ends[0][0], [1.0, 0.0, 0.0])
        about: dict[str, Any] = {"positions": lambda t, end=end: end, "sensitivity": max(1.0, growth)}
        about |= {"solve": partial(solve_with_stops, stops=model.stops), "n_drawn": n_drawn, "group": STOPS}
        yield from of_problem("impacts at several stops", k, problem, STOP_TOLERANCES, **about)


def of_problem(name: str, k: int, problem: Any, tolerances: Iterable[float], **about: Any) -> Iterator[Trap]:
    """Yield the k-th draw of a trap at some tolerances."""
    for tolerance in tolerances:
        place, start = f"{problem.name}, draw {k}, {tolerance:g}", (problem.q0, problem.v0, problem.t_span[1])
        yield Trap(name, place, problem.system, *start, **about, tolerance=tolerance)


def collided(masses: Array, restitutions: Array, x0: Array, v0: Array, wall: bool) -> tuple[Array, int]:
    """Return the places of balls at the end, impact by impact, to so many DIGITS, and the number of impacts."""
    with localcontext(prec=DIGITS):
        least, left, n, none = Decimal(10) ** (5 - DIGITS), Decimal(LASTING), 0, [Decimal(0)] * wall
        x, v, e, inertia = (list(map(Decimal, given.tolist())) for given in (x0, v0, restitutions[not wall :], masses))
        x, v, inverse = none + x, none + v, none + [1 / mass for mass in inertia]
        while True:
            rates = [b - a for a, b in pairwise(v)]
            closing = [((x[k + 1] - x[k]) / -rate, k) for k, rate in enumerate(rates) if rate < -least]
            wait, k = min(closing, default=(left, 0))
            if wait >= left:
                return np.array([float(a + left * w) for a, w in zip(x, v, strict=True)])[wall:], n
            x, left, n = [a + wait * w for a, w in zip(x, v, strict=True)], left - wait, n + 1
            impulse = -(1 + e[k]) * rates[k] / (inverse[k] + inverse[k + 1])
            v[k], v[k + 1] = v[k] - impulse * inverse[k], v[k + 1] + impulse * inverse[k + 1]


def little_inertia(n: int) -> Iterator[Trap]:
    """Yield n draws of each linkage with long bars that have almost all of their mass in the middle."""
    for (place, name), k in product(enumerate(LONG_BARS), range(n)):
        size, inertia = 10.0 ** np.random.default_rng([SEED, place, k]).uniform(*DECADES)
        for tolerance in INERTIA_TOLERANCES:
            known = moved(name, (SEED, place, k), float(size), float(inertia))
            known |= {"mechanism": f"{name}, draw {k}, {tolerance:g}", "tolerance": tolerance, "sensitivity": 1.0}
            yield Trap("little inertia", **known, group=INERTIA)


COLUMNS, SOUND = ("t", "q", "v", "a", "lam"), "right result"
FAULTS: dict[str, Callable[[Result], dict[str, Any]]] = {  # what they change of a result
    SOUND: lambda result: {},
    "gravity 1 % off": lambda result: {},
    "multipliers doubled": lambda result: {"lam": 2.0 * result.lam},
    "accelerations 2 % off": lambda result: {"a": 1.02 * result.a},
    "second half missing": lambda result: {x: getattr(result, x)[..., : len(result.t) // 2] for x in COLUMNS},
}


def certificates() -> Iterator[Trap]:
    """Yield results of linkages that do not fold: certificates have to refuse the faulty and to pass the right ones."""

    def solve(system: Any, *start: Any, fault: str, ran: Any, **options: Any) -> Result:
        result = solve_dae(ran if "gravity" in fault else system, *start, **options)
        if result.success:
            result = replace(result, system=system, **FAULTS[fault](result))
            if not (certificate := result.certify()):
                raise RuntimeError(certificate.message)
        return result

    for (place, name), fault, tolerance in product(enumerate(REGULAR), FAULTS, CERTIFICATE_TOLERANCES):
        known, ran = moved(name, (SEED, place)), moved(name, (SEED, place), heavier=1.01)["system"]
        known |= {"error": None if fault == SOUND else lambda result: np.inf, "tolerance": tolerance}
        known |= {"mechanism": f"{name}, {tolerance:g}", "solve": partial(solve, fault=fault, ran=ran)}
        yield Trap(fault, **known, time_limit=60.0, group=CERTIFICATE)


class Rung(ArithmeticError):
    """Raised by the handler of a signal."""


WORK: dict[str, Callable[..., Any]] = {  # during which a signal comes
    "solve_dae": solve_dae,
    "dense output": lambda *run, **more: solve_dae(*run, **more, dense_output=True).sol(INSTANTS),  # type: ignore[misc]
    "ensemble": lambda system, span, *x, **more: ensemble(system, span, *np.tile(x, 20).reshape(2, 20, -1), **more),
    "sweep": lambda system, span, *start, **more: sweep(
        lambda theta3: replace(four_bar(theta3=theta3), system=system), ANGLES, t_span=span, parallel="threads", **more
    ),
}


def rung(work: Callable[..., Any], after: float, *run: Any, **options: Any) -> Any:
    """Work until the exception of a signal arrives, and say whether it does."""

    def ring(number: int, frame: Any) -> None:
        raise Rung

    before, late, error = signal.signal(signal.SIGALRM, ring), time.monotonic() + WAIT, np.inf
    try:
        signal.setitimer(signal.ITIMER_REAL, after)
        while time.monotonic() < late:
            work(*run, **options)
    except Rung:
        error = 0.0
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)  # a signal without a handler would end this process later
        signal.signal(signal.SIGALRM, before)
    return SimpleNamespace(status=Status.REACHED_END, message="", success=True, error=error)


def signals(n: int) -> Iterator[Trap]:
    """Yield n exceptions of a signal handler, at random times, during each kind of WORK."""
    problem, g = four_bar(), np.random.default_rng(SEED)
    for (name, work), plain, k in product(WORK.items(), (False, True), range(n)):
        about: dict[str, Any] = {"solve": partial(rung, work, g.uniform(1e-4, LATEST)), "group": SIGNAL}
        given = python_copy(problem.system) if plain else problem.system, problem.q0, problem.v0, LASTING
        place = f"four-bar{' of Python functions' * plain}, draw {k}"
        yield Trap(f"signal during {name}", place, *given, **about, error=lambda result: result.error)


CHANGES: dict[str, Callable[[int, int, np.random.Generator], float]] = {  # of a force, by call, period and generator
    "noise": lambda n, period, g: g.standard_normal(),
    "counter": lambda n, period, g: 0.01 * n,
    "every call another sign": lambda n, period, g: (-1.0) ** n,
    "relay": lambda n, period, g: (-1.0) ** (n // period),
    "some calls": lambda n, period, g: float(n % period == 0),
}


def changing_torques(n: int) -> Iterator[Trap]:
    """Yield n draws of each kind of torque that depends on the number of calls; `float` prevents that it is traced."""

    def turned(torque: Callable[..., Any]) -> Problem:
        model = PlanarModel()
        model.rod("rod", (0.0, 0.0), (1.0, 0.0), mass=1.0)
        model.revolute("ground", "rod", at=(0.0, 0.0))
        model.torque("rod", torque)
        return model.problem((0.0, LASTING))

    def torque(change: Callable[..., float], drag: Callable[[Any], Any], g: np.random.Generator) -> Callable[..., Any]:
        calls, size, period = count(1), 10.0 ** g.uniform(-2.0, 1.0), round(10.0 ** g.uniform(0.3, 2.0))
        return lambda t, q, v: size * change(next(calls), period, g) - 0.1 * drag(v[2])

    still = turned(lambda t, q, v: 0.0)
    for (kind, (name, change)), python, k in product(enumerate(CHANGES.items()), (True, False), range(n)):
        changing = torque(change, float if python else np.positive, np.random.default_rng([SEED, kind, python, k]))
        solve = lambda _, *start, f=changing, **options: solve_dae(turned(f).system, *start, **options)  # noqa: E731
        run = still.system, still.q0, still.v0, LASTING
        place = f"pendulum, {'Python' if python else 'traced'}, draw {k}"
        yield Trap(f"torque that changes: {name}", place, *run, solve=solve, group=CALLS)


def of_motion(name: str, problem: Problem, positions: Callable[[float], Array]) -> Trap:
    """A trap that lies in the motion, which is known."""
    return Trap(name, problem.name, problem.system, problem.q0, problem.v0, 5.0, problem.system, positions=positions)


def of_chain(n: int) -> list[Trap]:
    """The traps on one chain."""
    q0, v0 = start(n)

    def system(
        rows: int = 0, last: float = 1.0, drive: tuple[float, float] = (0.0, 0.0), **changed: float
    ) -> ConstrainedSystem:
        """A metre between points of 1 kg, the `last` but one; the first `rows` of the constraints twice."""
        own = np.array(SANE)
        for name, value in changed.items():
            own[globals()[name]] = value
        p = np.concatenate([np.ones(2 * n - 1), [last], own, made("", 4, drive, drives=True).parameters])
        functions = CHAIN | {"force": force, "jacobian": jacobian}
        about: dict[str, Any] = {"parameters": p, "constant_mass": True, "name": f"chain of {n}"}
        return ConstrainedSystem(n_q=2 * n, n_c=n + rows, **functions, **about)

    def trap(name: str, given: ConstrainedSystem, sane: ConstrainedSystem | None, t_end: float = 2.0, **more: object):  # type: ignore[no-untyped-def]
        return Trap(name, f"chain of {n}", given, **({"q0": q0, "v0": v0} | more), t_end=t_end, sane=sane)  # type: ignore[arg-type]

    shorter = lambda Q, t, *state: Q if t <= 1.0 else Q[:-1]  # noqa: E731
    across = np.zeros(2 * n)
    across[:2] = 1e-2 * q0[:2]
    fast = system(drive=(0.01, 1e3))
    moving = np.zeros(2 * n)
    moving[::2] = 0.01 * 1e3  # all points with the pivot
    push, pulse = system(BEGIN=0.7, END=NEVER, PUSH=20.0), system(BEGIN=1.0, END=1.001, PUSH=1e3)
    spring, heavy = system(SPRING=1e7, REST=q0[-2]), system(last=1e10)
    return [
        trap("inconsistent positions", system(), None, q0=q0 + across / 10.0, group=INPUT),
        trap("inconsistent velocities", system(), None, v0=across, group=INPUT),
        trap("NaN in the force after 1 s", system(NAN=1.0), None),
        trap("exception in a callback after 1 s", system(RAISES=1.0), None),
        trap("exception in a Python callback after 1 s", python_copy(system(), force=fails), None),
        trap("wrong shape from a Python callback after 1 s", python_copy(system(), force=shorter), None),
        trap("one wrong entry of C_q", system(WRONG=1e-3), system(), group=INPUT),
        trap("force that jumps", push, push, breaks=(0.7,)),
        trap("pulse of 1 ms", pulse, pulse, breaks=(1.0, 1.001), unnoticed=system()),
        trap("pulse of 1 ms, max_step half of it", pulse, pulse, breaks=(1.0, 1.001), steps={"max_step": 5e-4}),
        trap("redundant row", system(rows=1), system()),
        trap("pivot driven at 1000 rad/s", fast, fast, 1.0, v0=moving),
        trap("spring of 1e7 N/m", spring, spring, 1.0),
        trap("masses 1 to 1e10", heavy, heavy, 1.0),
        trap("tolerance of 1e-17", system(), system(), tolerance=1e-17),
        trap("time limit of 0.5 s", system(), None, 1e5, time_limit=0.5),
        trap("first step of 1 s", system(), system(), steps={"first_step": 1.0}),
        trap("fixed steps of 0.5 s", system(), system(), steps={"step_size": 0.5}),
    ]


def pendulum(sharp: Sharp) -> Mechanism:
    """A point of 1 kg on a link of 1 m, released 1 rad from the vertical."""
    one = np.ones(1)
    return chain_of(sharp, one, one, one, 0.0 * one)


def forces(quick: bool) -> list[tuple[str, Callable[[Sharp], Mechanism]]]:
    """Sharp forces, each on a pendulum and two linkages; a kinked drive on what keeps a freedom under it."""
    if quick:
        return [(family, pendulum) for family in QUICK_FORCES]
    every = [(family, bodies) for family in FORCES for bodies in (pendulum, bars, slider_in_space)]
    for family in UNKNOWN_IN_SPACE:
        every.remove((family, slider_in_space))
    masses = lambda sharp: row(sharp, np.array([3.0, 8.0]), np.array([1.0, 1.5]), 0.2, 0.0)  # noqa: E731
    return [*every, (KINK, pendulum), (KINK, masses)]  # two masses on springs, the sum of whose places is given


def known_motion(
    bodies: Callable[[Sharp], Mechanism], force: Callable[[np.random.Generator], Sharp], seed: list[int]
) -> tuple[Mechanism, Motion, int]:
    """Draw forces until the motion under one is known to AGREE and errors grow by GROWN at most; count the draws."""
    g, n_drawn = np.random.default_rng(seed), 0
    while True:
        n_drawn += 1
        mechanism = bodies(force(g))
        try:
            known = motion(mechanism)
        except (RuntimeError, ValueError):  # SciPy's method fails
            continue
        if known.apart <= AGREE and known.growth <= GROWN:
            return mechanism, known, n_drawn


def under_forces(quick: bool) -> Iterator[Trap]:
    """Yield the sharp forces on their mechanisms, with random parameters."""
    for place, (family, bodies) in enumerate(forces(quick)):
        yield of_force(FORCE, *known_motion(bodies, families()[family], [SEED, place]))


def name_of(shape: str, width: float) -> str:
    """Name the trap of a short force."""
    return f"{shape} of {1e3 * width:g} ms"


def short_forces(quick: bool) -> Iterator[Trap]:
    """Yield each width of a gust and of a pulse on each mechanism, at random times."""
    widths = enumerate(QUICK_WIDTHS if quick else WIDTHS)
    two = np.ones(2)
    two_points = lambda sharp: chain_of(sharp, two, two, np.array([1.0, 0.5]), 0.0 * two)  # noqa: E731
    mechanisms = enumerate((pendulum,) if quick else (pendulum, bars, two_points))
    draws = range(N_QUICK if quick else N_DRAWS)
    for shape, (place, width), (k, bodies), n in product(SHAPES, widths, mechanisms, draws):
        seed = [SEED, place, k, n] + [1] * (shape == "pulse")
        mechanism, known, _ = known_motion(bodies, partial(SHAPES[shape](width), name_of(shape, width)), seed)
        yield replace(of_force(SHORT, mechanism, known, 1), mechanism=f"{mechanism.name}, draw {n}")


def of_force(group: str, mechanism: Mechanism, known: Motion, n_drawn: int) -> Trap:
    """Make the trap of a mechanism under a force, whose motion is known."""
    sharp, end = mechanism.sharp, known.q[-1]
    about: dict[str, Any] = {"group": group, "impulse": sharp.driven and bool(sharp.breaks), "n_drawn": n_drawn}
    given = mechanism.system, mechanism.q0, mechanism.v0, T_END, mechanism.system
    return Trap(sharp.family, mechanism.name, *given, positions=lambda t: end, **about)
