"""Traps: systems and starts on which a solver goes wrong unless it notices.

All traps on chains of point masses share the compiled callbacks of `sharp_callbacks`, with a force of its own: the
parameters say what the trap is.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain, product
from typing import Any

import numpy as np

from studies.bench.random_linkages import KINDS as LINKAGES
from studies.bench.random_linkages import draw, end_of
from studies.bench.sharp_callbacks import CHAIN, chain_force, chain_jacobian
from studies.bench.sharp_forces import FRICTIONS, GUSTS, T_END, Sharp, families, gust, made, pulse
from studies.bench.sharp_mechanisms import Mechanism, bars, row, slider_in_space
from studies.bench.sharp_mechanisms import chain as chain_of
from studies.bench.sharp_motion import Motion, motion
from studies.bench.store import Array
from studies.planted_errors.faults import python_copy
from twoloop import ConstrainedSystem
from twoloop.kernels.compile.callbacks import callback
from twoloop.mechanisms import Problem, four_bar, n_four_bar

NEVER = 1e30  # s
# groups of traps: a start or a derivative that checks of the input find; a mistake in a model or a setting, or a hard
# motion; a sharp force; a force so short that a solver may step over it; a random linkage; singular positions
GROUPS = ("input", "mistake", "force", "short", "linkage", "singular")
INPUT, MISTAKE, FORCE, SHORT, LINKAGE, SINGULAR = GROUPS
AGREE = 1e-8  # m or rad: how far two methods may differ in the motion under a force
SEED = 20261126  # of all draws: the day. Draw by a new seed when the methods have been changed to pass these
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
SHAPES = {"gust": gust, "pulse": pulse}  # a gust exp(-(t / b)^2) has tails; a pulse is zero before and behind
WIDTHS = (1e-4, 3e-4, 1e-3, 3e-3, 1e-2)  # s: b of a gust, duration of a pulse
N_DRAWS, N_QUICK, QUICK_WIDTHS = 8, 2, (1e-3,)  # of each width on each mechanism
N_LINKAGES, LINKAGE_END = 100, 5.0  # of each kind; s
SIZES, ENDS = tuple(range(1, 7)), (5.0, 10.0, 20.0)  # of A02 in both sets of coordinates; s
TOLERANCES = tuple(10.0 ** (-0.5 * k) for k in range(12, 23))  # of A02: 1e-6 to 1e-11
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
    group: str = MISTAKE  # one of the groups above
    # impulse, singular: whether velocities jump, or C_q loses rank on the way
    impulse: bool = False
    singular: bool = False
    sensitivity: float = 1.0  # growth of an error at the start; where it is above 1, so much more error is allowed
    n_drawn: int = 1  # how many were drawn until the motion of one was known


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
        trap = of_motion(kind, drawn.problem, lambda t, q=drawn.q: q)  # type: ignore[misc]
        about: dict[str, Any] = {"mechanism": f"linkage {k}", "n_drawn": n_drawn, "group": LINKAGE}
        yield replace(trap, t_end=LINKAGE_END, sensitivity=max(1.0, drawn.sensitivity), **about)


def singular_positions() -> Iterator[Trap]:
    """Yield IFToMM's A02, which passes singular positions, in all SIZES, both coordinates, ENDS and TOLERANCES."""
    for coordinates, n, t_end, tolerance in product(("tips", "bodies"), SIZES, ENDS, TOLERANCES):
        problem = n_four_bar(n, coordinates)
        trap = of_motion(SINGULAR, problem, lambda t, known=problem.motion: known(t)[0])  # type: ignore[misc]
        name = f"{problem.name}, {t_end:g} s, {tolerance:.2g}"
        yield replace(trap, t_end=t_end, tolerance=tolerance, mechanism=name, singular=True, group=SINGULAR)


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


def forces(quick: bool) -> list[tuple[str, Callable[[Sharp], Mechanism]]]:
    """Sharp forces, each on a pendulum and two linkages; a kinked drive on what keeps a freedom under it."""
    if quick:
        return [(family, pendulum) for family in QUICK_FORCES]
    every = [(family, bodies) for family in FORCES for bodies in (pendulum, bars, slider_in_space)]
    for family in UNKNOWN_IN_SPACE:
        every.remove((family, slider_in_space))
    return [*every, (KINK, pendulum), (KINK, masses)]


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


def two_points(sharp: Sharp) -> Mechanism:
    """Make a chain of two points of 1 kg on links of 1 m."""
    two = np.ones(2)
    return chain_of(sharp, two, two, np.array([1.0, 0.5]), 0.0 * two)


def name_of(shape: str, width: float) -> str:
    """Name the trap of a short force."""
    return f"{shape} of {1e3 * width:g} ms"


def short_forces(quick: bool) -> Iterator[Trap]:
    """Yield each width of a gust and of a pulse on each mechanism, at random times."""
    widths = enumerate(QUICK_WIDTHS if quick else WIDTHS)
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
