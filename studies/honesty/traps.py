"""Traps: systems and starts on which a solver goes wrong unless it notices, each on two mechanisms.

One set of compiled callbacks serves those on chains of point masses, that of `sharp_callbacks` with a force of its own:
what makes the trap stands in the parameters.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from studies.bench.cli import StudyError
from studies.bench.random_linkages import end_of
from studies.bench.sharp_callbacks import CHAIN, chain_force, chain_jacobian
from studies.bench.sharp_forces import FRICTIONS, GUSTS, T_END, Sharp, families, made
from studies.bench.sharp_mechanisms import Mechanism, bars, row, slider_in_space
from studies.bench.sharp_mechanisms import chain as chain_of
from studies.bench.sharp_motion import CHECK, RTOL, march, motion, off
from studies.bench.store import Array
from studies.planted_errors.faults import python_copy
from twoloop import ConstrainedSystem
from twoloop.kernels.compile.callbacks import callback
from twoloop.mechanisms import Problem, four_bar, n_four_bar

NEVER = 1e30  # s
# what a trap is made of: a start or derivative that checks of input find, a model or setting, a force that is sharp,
# such a one with other numbers, on which no method was repaired, one that a solver may step over
INPUT, MISTAKE, FORCE, HELD_OUT, SHORT = "input", "mistake", "force", "held out", "short"
AGREE = 1e-8  # m or rad: how far two methods may differ in the motion under a force
SEED = 13  # of the numbers of the forces
HELD_OUT_SEED = 20261126  # of those held out: the day; a run on code changed since draws by a new one
GROWN = 100.0  # how much errors may grow in a motion that is held out: as much as in the first set
FORCES = (  # families of `sharp_forces`
    "drag",
    *(f"tanh friction, width {width:g}" for width in FRICTIONS),
    *(f"gust of {1e3 * width:g} ms" for width in GUSTS),
    *("softplus stop", "chirp", "switching drive", "square wave", "noise by interpolation"),
)
UNKNOWN_IN_SPACE = FORCES[-4:]  # two methods do not agree to AGREE there: the truth is not known
KINK = "drive with a kink"
QUICK_FORCES = ("drag", "gust of 30 ms", KINK)
# places in the parameters behind lengths and masses, of what makes the trap: a spring that holds the last point, and
# where it is at rest; begin and end of a force along x and its size, when the force becomes NaN, when it raises, a
# wrong entry of C_q
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
    # q0, v0: (n_q,)
    q0: Array
    v0: Array
    t_end: float
    # the same without the mistake: its motion is the right answer. None: there is none, and whoever reports success is
    # wrong.
    sane: ConstrainedSystem | None = None
    breaks: tuple[float, ...] = ()  # times at which the right motion is computed in pieces
    # positions(t) -> q, where they are known
    positions: Callable[[float], Array] | None = field(default=None, repr=False)
    tolerance: float = 1e-8
    time_limit: float = 10.0
    # `step_size`, `first_step` or `max_step`, for solvers whose adapter takes them
    steps: Mapping[str, float] = field(default_factory=dict)
    # the system as it is for a solver that never evaluates it where the trap lies
    unnoticed: ConstrainedSystem | None = None
    group: str = MISTAKE  # INPUT, MISTAKE, FORCE, HELD_OUT or SHORT
    # impulse, singular: whether velocities jump, or C_q loses rank on the way
    impulse: bool = False
    singular: bool = False
    n_drawn: int = 1  # how many forces were drawn until the motion under one was known


def start(n: int) -> tuple[Array, Array]:
    """The chain out of the vertical, at rest."""
    angles = np.linspace(0.6, 0.2, n)
    q = np.empty(2 * n)
    q[::2], q[1::2] = np.cumsum(np.sin(angles)), -np.cumsum(np.cos(angles))
    return q, np.zeros(2 * n)


def traps(quick: bool) -> list[Trap]:
    """All traps: mistakes on chains of two and of three points, positions on two linkages each, and sharp forces."""
    made = [trap for n in ((2,) if quick else (2, 3)) for trap in of_chain(n)]
    return made + ([] if quick else list(of_linkages())) + list(under_forces(quick))


def of_linkages() -> Iterator[Trap]:
    """Singular positions, dead points, and positions where the two assemblies of a linkage nearly meet."""
    for n in (1, 2):
        problem = n_four_bar(n)
        trap = of_motion("singular position crossed", problem, lambda t, known=problem.motion: known(t)[0])  # type: ignore[misc]
        yield replace(trap, singular=True)
    for ground in (2.0, 1.9):  # bars 1 and 2 come into line: the angle of bar 3 does not determine theirs
        problem = four_bar((0.8, 1.2, 1.0), ground)
        yield of_motion("dead point", problem, partial(end_of, problem))
    for excess in (1e-4, -1e-7):  # longest and shortest less the other two: 0 at a change point
        problem = four_bar((0.5, 1.5, 1.0), 2.0 + excess, theta3=1.0)
        yield of_motion("assemblies nearly meet", problem, partial(end_of, problem))


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


def masses(sharp: Sharp) -> Mechanism:
    """Two masses on springs, the sum of whose places is given."""
    return row(sharp, np.array([3.0, 8.0]), np.array([1.0, 1.5]), 0.2, 0.0)


def end_under_force(mechanism: Mechanism) -> Array:
    """Positions at the end by two methods of SciPy in independent coordinates; NaN where they are not compared.

    Raises StudyError if the two do not agree.
    """
    ends = [
        mechanism.positions(T_END, march(mechanism, method, tolerance, mechanism.y0)[T_END])
        for method, tolerance in (("DOP853", RTOL), ("LSODA", CHECK))
    ]
    if not off(ends[1], ends[0]) <= AGREE:
        raise StudyError(f"no right answer for {mechanism.sharp.family} on {mechanism.name}: two methods differ")
    return ends[0]


def forces(quick: bool) -> list[tuple[str, Callable[[Sharp], Mechanism]]]:
    """Sharp forces, each on a pendulum and two linkages; a kinked drive on what keeps a freedom under it."""
    if quick:
        return [(family, pendulum) for family in QUICK_FORCES]
    every = [(family, bodies) for family in FORCES for bodies in (pendulum, bars, slider_in_space)]
    for family in UNKNOWN_IN_SPACE:
        every.remove((family, slider_in_space))
    return [*every, (KINK, pendulum), (KINK, masses)]


def under_forces(quick: bool) -> Iterator[Trap]:
    """The traps that are made of these."""
    for family, bodies in forces(quick):
        drawn = families()[family](np.random.default_rng([SEED, [*FORCES, KINK].index(family)]))
        mechanism = bodies(drawn)
        yield of_force(mechanism, FORCE, partial(end_under_force, mechanism))


def held_out(quick: bool) -> Iterator[Trap]:
    """The same forces and mechanisms with other numbers, each drawn until two methods agree and errors do not grow."""
    for place, (family, bodies) in enumerate(forces(quick)):
        g, n_drawn = np.random.default_rng([HELD_OUT_SEED, place]), 0
        while True:
            n_drawn += 1
            mechanism = bodies(families()[family](g))
            try:
                known = motion(mechanism)
            except (RuntimeError, ValueError):  # SciPy's method fails
                continue
            if known.apart <= AGREE and known.growth <= GROWN:
                break
        yield of_force(mechanism, HELD_OUT, partial(known.q.__getitem__, -1), n_drawn)


def of_force(mechanism: Mechanism, group: str, end: Callable[[], Array], n_drawn: int = 1) -> Trap:
    """The trap of a mechanism under a force, whose end is known."""
    sharp = mechanism.sharp
    about: dict[str, Any] = {"group": group, "impulse": sharp.driven and bool(sharp.breaks), "n_drawn": n_drawn}
    given = mechanism.system, mechanism.q0, mechanism.v0, T_END, mechanism.system
    return Trap(sharp.family, mechanism.name, *given, positions=lambda t: end(), **about)
