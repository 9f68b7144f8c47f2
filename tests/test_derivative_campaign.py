"""Every single error planted into derivatives is found, and no correct system is refused, at any scale."""

import math

import numpy as np
import pytest

from tests import problems
from tests.bodies.runs import by_hand
from tests.derivative_cases import UNITS, Case, lever, linkage, shaken_pendulum, slider_crank, sprung_rod
from tests.mechanisms.motions.jets import Jet, sin, sqrt
from tests.problems import quick, unconstrained, worst
from twoloop import ConstrainedSystem, Status, consistent_state, solve_dae
from twoloop.checks.derivatives import check_derivatives, wrong_derivative
from twoloop.mechanisms import four_bar, moderately_stiff_beam, very_flexible_beam

CHANGES = {"sign": lambda x: -x, "1e-6": lambda x: 1.000001 * x, "1e-3": lambda x: 1.001 * x}
CHANGES |= {"dropped": lambda x: 0.0}
FEW, MORE = ("1e-6", "dropped"), ("sign", "1e-6", "dropped")
# entries that are not zero: of the linkage's C_q, which has many, one in each kind of place
ENTRIES = {
    slider_crank: {"jacobian": [(0, 0), (0, 1), (0, 2), (1, 0), (1, 1)], "gamma": [0, 1]},
    shaken_pendulum: {"jacobian": [(0, 0), (0, 1)], "constraint_rate": [0], "gamma": [0]},
    linkage: {"jacobian": [(0, 0), (2, 2), (4, 2), (6, 8), (7, 5)], "gamma": [0, 5, 7]},
    sprung_rod: {"jacobian": [(0, 0), (0, 1)], "gamma": [0], "reaction_by_q": [(0, 1), (1, 1)]},
}
ENTRIES[sprung_rod] |= {"force_by_q": [(0, 0), (1, 0), (1, 1)], "force_by_v": [(0, 0), (1, 1)]}
TABLE_T, TABLE_X = np.linspace(0.0, 1.0, 11), np.cos(np.linspace(0.0, 1.0, 11))
MIXED = {
    "lever": (lambda: lever(1e-6, 1e3), {"jacobian": [(0, 2), (1, 2), (2, 0), (2, 1), (2, 3)], "gamma": [0, 1, 2]}),
    "far": (lambda: slider_crank(1.0, offset=3e5), {"jacobian": [(0, 0), (0, 2), (1, 1)], "gamma": [0, 1]}),
    "fast": (
        lambda: shaken_pendulum(1.0, omega=1e6, amplitude=1e-4),
        {"jacobian": [(0, 0), (0, 1)], "constraint_rate": [0], "gamma": [0]},
    ),
}


def planted():
    for make, kinds in ENTRIES.items():
        for name, unit in UNITS.items():
            marks, changes = ((), FEW) if name == "mm" else (pytest.mark.slow, MORE)
            yield pytest.param(make(unit), kinds, changes, id=f"{make.__name__}, {name}", marks=marks)
    for name, (make, kinds) in MIXED.items():
        # 3e5 m away the derivatives by an angle are known to 6 digits only
        yield pytest.param(make(), kinds, ("1e-3", "dropped") if name == "far" else FEW, id=name)


@pytest.mark.parametrize(("case", "kinds", "changes"), list(planted()))
def test_every_planted_error_is_found_and_named(case, kinds, changes):
    q = np.array(case.q)
    check_derivatives(case.system(), case.t, q)
    for kind, entries in kinds.items():
        for entry in entries:
            for name in changes:
                if name == "dropped" and kind == "constraint_rate":
                    continue  # below: whether the rate or the drive is forgotten
                with pytest.raises(ValueError, match=f"^{kind} of ") as caught:
                    check_derivatives(case.planted(kind, entry, CHANGES[name]), case.t, q)
                shown = entry if isinstance(entry, int) else f"({entry[0]}, {entry[1]})"
                assert f"entry {shown} is" in str(caught.value), (name, str(caught.value))


@pytest.mark.parametrize("unit", UNITS.values())
def test_a_forgotten_rate_is_found(unit):
    case = shaken_pendulum(unit)
    with pytest.raises(ValueError, match=r"^constraint_rate of .*entry 0 is"):
        check_derivatives(case.planted("constraint_rate", 0, lambda x: 0.0), case.t, np.array(case.q))


@pytest.mark.parametrize("unit", UNITS.values())
@pytest.mark.parametrize("kind", ["jacobian", "gamma"])
def test_terms_that_vanish_at_the_start_are_found_later(unit, kind):
    right = slider_crank(unit, crank=0.0, offset_of_guide=0.0)
    if kind == "gamma":  # a sign that does not show where sin(q_0) = 0
        part = lambda t, q, v: np.array([0.0, 2.0 * unit * v[0] ** 2 * math.sin(q[0])])  # noqa: E731
        wrong = right.system(gamma=lambda t, q, v: right.functions["gamma"](t, q, v) - part(t, q, v))
    else:  # with its gamma differenced
        part = lambda q: np.array([[2.0 * unit * math.sin(q[0]), 0.0, 0.0], np.zeros(3)])  # noqa: E731
        wrong = right.system(jacobian=lambda t, q: right.functions["jacobian"](t, q) + part(q), gamma=None)
    start = np.array(right.q)
    if kind == "jacobian":
        check_derivatives(wrong, 0.0, start)
    later, v = np.array(slider_crank(unit, crank=0.4, offset_of_guide=0.0).q), np.array([3.0, -1.0, -unit])
    assert wrong_derivative(right.system(), 1.0, later, v) is None
    assert wrong_derivative(wrong, 1.0, later, v).startswith(f"{kind} of '{right.name}' is not")


@pytest.mark.parametrize("method", quick(["auto", "DOP853", "RadauIIA5", "Gauss8"]))
def test_terms_that_are_wrong_at_high_speeds_only_end_the_run(method):
    """They look right at every velocity that is tried at the start."""
    wrong = problems.pendulum(gamma=lambda t, q, v: np.array([-min(v[0] ** 2 + v[1] ** 2, 4.0)]), compile=True)
    result = solve_dae(wrong, (0.0, 1.0), [1.0, 0.0], [0.0, 0.0], method, rtol=1e-8, atol=1e-8)
    assert result.status is Status.WRONG_DERIVATIVE and "gamma of" in result.message


def nasty(name, constraint, jacobian, q, t=0.0, **rest):
    return Case(name, len(q), {"constraint": constraint, "jacobian": jacobian, **rest}, q, t)


AFTER_START = {"omega": 3.0, "only_after_start": True}
CORRECT = [
    *(make(unit) for make in ENTRIES for unit in UNITS.values()),
    *(make() for make, _ in MIXED.values()),
    shaken_pendulum(1.0, omega=2e4, t=5.0),
    shaken_pendulum(1.0, omega=1e6, amplitude=1e-4, t=100.0),
    shaken_pendulum(1.0, offset=3e5),
    shaken_pendulum(1.0, t=1.7e9),
    shaken_pendulum(1e-3, omega=1e-6, t=1e6),
    shaken_pendulum(1.0, **AFTER_START),
    nasty("kink at the place", lambda t, q: [abs(q[0]) - q[1]], lambda t, q: [[np.sign(q[0]), -1.0]], [0.0, 0.0]),
    *(nasty(f"kink {near:g} away", lambda t, q: [q[1] - abs(q[0])], lambda t, q: [[-np.sign(q[0]), 1.0]], [near, near])
      for near in (1e-1, 1e-4, 1e-8, 1e-12)),
    nasty("a root near its end", lambda t, q: [math.sqrt(1.0 - q[0] ** 2) - q[1]],
          lambda t, q: [[-q[0] / math.sqrt(1.0 - q[0] ** 2), -1.0]], [0.9999999, math.sqrt(1.0 - 0.9999999**2)]),
    nasty("a root at its end", lambda t, q: [math.sqrt(q[0]) ** 3 - q[1]],
          lambda t, q: [[1.5 * math.sqrt(q[0]), -1.0]], [0.0, 0.0]),
    nasty("a table that ends at the start", lambda t, q: [q[0] - np.interp(t, TABLE_T, TABLE_X)],
          lambda t, q: [[1.0]], [1.0], constraint_rate=lambda t, q: [-(TABLE_X[1] - TABLE_X[0]) / 0.1]),
    nasty("large numbers cancel", lambda t, q: [(q[0] + 1e8) - (q[1] + 1e8)], lambda t, q: [[1.0, -1.0]], [0.3, 0.3]),
    nasty("solved by iteration, to ten digits", lambda t, q: [round(math.sin(q[0]), 10) - q[1]],
          lambda t, q: [[math.cos(q[0]), -1.0]], [0.3, math.sin(0.3)]),
    nasty("nothing but zero at the start", lambda t, q: [math.sin(q[0]) * q[1] + q[2]],
          lambda t, q: [[math.cos(q[0]) * q[1], math.sin(q[0]), 1.0]], [0.0, 0.0, 0.0],
          gamma=lambda t, q, v: [math.sin(q[0]) * q[1] * v[0] ** 2 - 2.0 * math.cos(q[0]) * v[0] * v[1]]),
]  # fmt: skip


def ready():
    beams = very_flexible_beam(), moderately_stiff_beam(2, "beam")
    for problem in (four_bar(), four_bar((0.8, 1.2, 1.0), 2.0, 0.0, -1), *beams):
        yield pytest.param(problem.system, 0.0, problem.q0, problem.v0, id=problem.name)
    flat = np.array([0.5, 0.0, 0.0, 2.0, 0.0, 0.0, 2.5, 0.0, np.pi])  # C_q has a row of rounding errors there
    yield pytest.param(four_bar((1.0, 2.0, 1.0), 2.0, theta3=2.0).system, 0.0, flat, np.zeros(9), id="without rank")
    for t in (0.0, 5.0):
        yield pytest.param(problems.moving_pivot(), t, *problems.moving_pivot_state(t), id=f"moving pivot at {t}")
    yield pytest.param(problems.oblique_pendulum(), 0.0, *problems.oblique_start(), id="oblique")
    state = problems.double_pendulum_state(np.array([0.5, 1.0]), np.array([1.0, 0.0]))
    yield pytest.param(problems.double_pendulum(), 0.0, *state, id="double pendulum")
    yield pytest.param(problems.pendulum(), 0.0, *problems.START, id="pendulum")
    for case in CORRECT:
        yield pytest.param(case.system(), case.t, case.q, np.ones(case.n_q), id=case.name)


@pytest.mark.parametrize(("system", "t", "q", "v"), list(ready()))
def test_correct_systems_are_accepted(system: ConstrainedSystem, t, q, v):
    check_derivatives(system, t, np.array(q, dtype=float))
    assert system.checked and wrong_derivative(system, t, np.array(q, dtype=float), np.array(v, dtype=float)) is None


# --- random formulas with exact derivatives, by jets: all accepted, and nearly all planted errors found
TIME = 0.3


def bell(x):
    b = np.exp(-(x.x**2))
    return x.through(b, -2.0 * x.x * b, (4.0 * x.x**2 - 2.0) * b)


def formula(rng, n, depth):
    """A random function of (t, q), with factors from 1e-3 to 1e3."""
    factor = 10.0 ** (rng.uniform(-3.0, 3.0) if rng.random() < 0.3 else rng.uniform(-1.0, 1.0))
    if depth == 0:
        j, offset = rng.integers(n), 10.0 ** rng.uniform(-2.0, 3.0) * (rng.random() < 0.2)
        return lambda t, q: factor * (q[j] + offset)
    a, b, kind = formula(rng, n, depth - 1), formula(rng, n, depth - 1), rng.integers(6)
    return (
        lambda t, q: a(t, q) + b(t, q),
        lambda t, q: a(t, q) * b(t, q),
        lambda t, q: sin(a(t, q) + factor * t),
        lambda t, q: sin(factor * a(t, q)) + b(t, q),
        lambda t, q: bell(a(t, q)) + b(t, q),
        lambda t, q: sqrt(a(t, q) * a(t, q) + 1e-3),
    )[kind]


def random_system(rng):
    """Functions of a system, and a position."""
    n = int(rng.integers(2, 5))
    rows = [formula(rng, n, 3) for _ in range(int(rng.integers(1, n + 1)))]
    q = 10.0 ** (rng.uniform(-3.0, 3.0, n) if rng.random() < 0.3 else rng.uniform(-1.5, 1.0, n))
    q = q * rng.choice((-1.0, 1.0), n) * (rng.random(n) > 0.1)

    def along(t, q, dt, dq):
        return [row(Jet(t, dt), [Jet(x, d) for x, d in zip(q, dq, strict=True)]) for row in rows]

    still = np.zeros(n)
    functions = {
        "constraint": lambda t, q: np.array([x.x for x in along(t, q, 0.0, still)]),
        "jacobian": lambda t, q: np.array([[x.u for x in along(t, q, 0.0, unit)] for unit in np.eye(n)]).T,
        "constraint_rate": lambda t, q: np.array([x.u for x in along(t, q, 1.0, still)]),
        "gamma": lambda t, q, v: -np.array([x.w for x in along(t, q, 1.0, v)]),
    }
    return functions, q


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("trials", quick([5, 200]))
def test_random_systems_are_accepted_and_their_errors_found(trials):
    rng = np.random.default_rng(7)
    planted = found = 0
    for _ in range(trials):
        functions, q = random_system(rng)
        case = Case("random", len(q), functions, q, TIME)
        system = case.system()
        check_derivatives(system, TIME, q)
        assert wrong_derivative(system, TIME, q, np.ones(len(q))) is None
        kind = rng.choice(["jacobian", "constraint_rate", "gamma"])
        right = functions[kind]
        value = right(TIME, q) if kind != "gamma" else right(TIME, q, np.linspace(1.0, 1.4, len(q)))
        entries = list(zip(*np.nonzero(np.abs(value) > 1e-6 * np.abs(value).max()), strict=True))
        if not entries:
            continue
        entry = entries[rng.integers(len(entries))]
        planted += 1
        try:
            check_derivatives(case.planted(kind, entry, lambda x: 1.001 * x), TIME, q)
        except ValueError as error:
            found += str(error).startswith(kind)
    assert planted > trials / 2
    assert found >= 0.9 * planted, f"{found} of {planted}"


# --- what a system does not give, by differences: C_q of C, Gamma of C_q and C_t, as accurate as the tolerance asks
def without_jacobian(problem):
    system = problem.system
    given = {kind: function for kind, function in system.given.items() if kind not in ("jacobian", "kinematics")}
    return ConstrainedSystem(
        n_q=system.n_q, n_c=system.n_c, **given, parameters=system.parameters, constant_mass=True, name="differenced"
    )


@pytest.mark.parametrize("problem", quick([very_flexible_beam(), four_bar()]), ids=lambda problem: problem.name)
def test_it_agrees_with_the_formula(problem):
    system = without_jacobian(problem)
    for q in problem.q0 + np.random.default_rng(0).normal(size=(10, problem.q0.size)):
        assert worst(system.jacobian(0.3, q), problem.system.jacobian(0.3, q)) < 2e-13


@pytest.mark.parametrize("root", [False, True], ids=["square", "root"])
@pytest.mark.parametrize(
    ("length", "offset"), [(1.0, 0.0), (1e-3, 0.0), (1e-6, 0.0), (1e6, 0.0), (1.0, 3e5), (1e-3, 1e3)]
)
def test_each_coordinate_has_a_displacement_of_its_own(root, length, offset):
    # a pendulum about (offset, 0); with the root its constraint bends on the scale of the length
    def constraint(t, q):
        squares = (q[0] - offset) ** 2 + q[1] ** 2
        return np.array([math.sqrt(squares) - length if root else 0.5 * (squares - length**2)])

    q = np.array([offset + 0.6 * length, 0.8 * length])
    arm = np.array([q[0] - offset, q[1]])
    expected = arm / np.hypot(*arm) if root else arm
    system = problems.pendulum(constraint=constraint, jacobian=None, gamma=False)
    assert worst(system.jacobian(0.0, q), expected) < 5e-11 * np.abs(expected).max()


AMPLITUDE = 1e-3  # m


def opaque(x):
    """The same numbers; what cannot be traced, so that no derivative of it is known."""
    return np.maximum(x, -np.inf)


def shaken_at(speed, gamma=True, noise=0.0):
    """A pendulum of 1 m whose pivot is shaken horizontally with the angular frequency `speed`."""
    case = shaken_pendulum(1.0, omega=speed, amplitude=AMPLITUDE)
    changed = {
        "force": lambda t, q, v: np.array([0.0, -9.81]),
        "jacobian": lambda t, q: opaque(case.functions["jacobian"](t, q) + noise * np.sin(1e13 * (q[0] + t))),
    }
    return case.system(**changed if gamma else changed | {"gamma": None})


def start_of(system, speed):
    return consistent_state(system, 0.0, [-1.0, 0.0], [AMPLITUDE * speed, 0.0])


@pytest.mark.parametrize("method", quick(["DOP853", "Gauss12", "BDF"]))
@pytest.mark.parametrize("speed", [1.0, 1e3, 2.0 * np.pi * 16e3])
def test_a_fast_drive(speed, method):
    exact, differenced = shaken_at(speed), shaken_at(speed, gamma=False)
    span = (0.0, min(3.0, 30.0 / speed))
    q0, v0 = start_of(exact, speed)
    given = solve_dae(exact, span, q0, v0, method, 1e-8, 1e-8)
    run = solve_dae(differenced, span, q0, v0, method, 1e-8, 1e-8, t_eval=[span[1]])
    assert given.success and run.success, run.message
    # equal at the tolerance, relative to the largest value over the run
    assert worst(run.a[:, -1], given.a[:, -1]) < 1e-7 * np.abs(given.a).max()
    assert worst(run.lam[:, -1], given.lam[:, -1]) < 1e-7 * np.abs(given.lam).max()
    assert run.stats.n_accepted < 1.3 * given.stats.n_accepted + 5


def test_what_cannot_reach_the_tolerance_is_a_status():
    system = shaken_at(10.0, gamma=False, noise=1e-9)
    q0, v0 = start_of(shaken_at(10.0), 10.0)
    run = solve_dae(system, (0.0, 1.0), q0, v0, check_derivatives=False)
    assert run.status is Status.NOT_CONVERGED
    assert "gamma by differences" in run.message and "Give gamma, or loosen rtol" in run.message and run.t[0] == 0.0


def test_differences_of_constraints_that_hardly_bend_are_judged_by_rounding():
    """Nothing turns and nothing pushes: gamma is zero, and what differences leave of it is rounding."""
    angle, radius = 0.7, 0.4
    rolling = lambda t, q: np.array([[1.0, 0.0, 0.0, -np.cos(q[2])], [0.0, 1.0, 0.0, -np.sin(q[2])]])  # noqa: E731
    wheel = unconstrained(
        lambda t, q, v: np.array([0.0, 0.0, 0.1 * np.sin(t), -v[3] if v[3] > 5.0 else 0.0]),
        **{"n_q": 4, "n_c": 1, "n_a": 2, "mass": np.diag([1.0, 1.0, 0.2, 0.1])},
        constraint=lambda t, q: np.array([q[2] - np.interp(t, [1.0, 2.0], [angle, 1.0])]),
        jacobian=lambda t, q: np.array([[0.0, 0.0, 1.0, 0.0]]),
        constraint_rate=lambda t, q: np.array([angle - 1.0 if 1.0 <= t < 2.0 else 0.0]),
        nonholonomic=lambda t, q: rolling(t, q) * np.array([1.0, 1.0, 1.0, radius]),
    )
    v0 = [3.0 * radius * np.cos(angle), 3.0 * radius * np.sin(angle), 0.0, 3.0]
    result = solve_dae(wheel, (0.0, 3.0), [0.0, 0.0, angle, 0.0], v0)
    assert result.success and abs(result.q[3, -1] - 9.0) < 1e-7


@pytest.mark.parametrize("t0", quick([1e6, 0.0, 1e5]))
def test_a_late_start_leaves_room_for_differences_on_one_side(t0):
    """A drive of a kilohertz, with lengths of differences that are a few spacings of time at a start as late."""
    size, rate, end = 1e-3, 6e3, 0.02
    system = problems.pendulum(
        gamma=False,
        constant_mass=True,
        constraint=lambda t, q: np.array([0.5 * ((q[0] - place(t)) ** 2 + q[1] ** 2 - 1.0)]),
        jacobian=lambda t, q: np.array([[q[0] - place(t), q[1]]]),
        constraint_rate=lambda t, q: np.array([-(q[0] - place(t)) * size * rate * np.cos(rate * (t - t0))]),
    )
    place = lambda t: size * np.sin(rate * (t - t0)) if t > -1.0 else 0.0  # noqa: E731
    start = [np.sin(0.5), -np.cos(0.5)], [size * rate, 0.0]
    result = solve_dae(system, (t0, t0 + end), *start, "RadauIIA5", rtol=1e-5, atol=1e-5)
    exact = lambda t, a, _: size * rate**2 * np.sin(rate * t) * np.cos(a) - 9.81 * np.sin(a)  # noqa: E731
    angle = by_hand(exact, [0.5, 0.0], [end])[0, -1]
    assert result.success and abs(result.q[1, -1] + np.cos(angle)) < 1e-4
