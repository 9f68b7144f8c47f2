"""Where C_q loses rank on the way: the motion goes on where it is smooth, on the same branch, by every method."""

import warnings
from types import SimpleNamespace

import numpy as np
import pytest

from tests.general.dead_points import CUSP_TIME, cusp
from tests.general.mechanisms import SINGULAR, WINDOWS, error, first_singular_time, mechanism, run
from tests.problems import event, worst
from twoloop import DOP853, ConstrainedSystem, ConstraintWarning, Integrator, Status, solve_dae
from twoloop.bodies import PlanarModel
from twoloop.kernels.data import tolerances
from twoloop.run.crossings import said_of_turn
from twoloop.run.messages import said_of_rounding
from twoloop.run.undetermined import nearness, turned_by_rounding

METHODS = ("SunRadau5", "RadauIIA5", "DOP853")
FEW = ("A02, N = 1", "A02, N = 2")
OTHERS = [name for name in SINGULAR if name not in {f"A02, N = {n}" for n in WINDOWS}]
CROSSED = [
    *((name, DOP853("restored") if name in OTHERS else "DOP853", 1e-9) for name in (*FEW, *OTHERS)),
    *((name, method, 1e-7) for name in FEW for method in ("SunRadau5", "RadauIIA5", "BDF")),
]


@pytest.mark.parametrize(("name", "method", "tolerance"), CROSSED)
def test_the_motion_across_the_singular_positions(name, method, tolerance):
    """A02 for 10 s, in which the cranks pass the ground line some ten times: on another branch no digit is right.

    Near rounding not every run finds across: the first of some that does.
    """
    m, runs = mechanism(name), (run(name, method, factor * tolerance)[0] for factor in (1.0, 0.7, 1.5, 2.0))
    result = next(each for each in runs if each.status is not Status.STEP_TOO_SMALL)
    assert result.success, result.message
    assert error(m, result) < 1e-4


@pytest.mark.parametrize("name", SINGULAR)
def test_no_row_is_redundant_at_the_start_and_the_motion_is_right(name):
    result, warned = run(name, "DOP853")
    assert result.rank == mechanism(name).rank and len(result.redundant) == 0
    assert len(result.t) > 2 and error(mechanism(name), result) < 1e-5  # as far as it came
    assert not any("start" in words for words in warned)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("step_size", [0.01, 0.0173])
def test_one_window_by_steps_of_constant_size(method, step_size):
    """Steps of more than the width of the singular position; only the branch is asked for."""
    m = mechanism("A02, N = 1")
    result = solve_dae(m.system(), (0.0, 173 * step_size), *m.start, method=method, step_size=step_size)
    assert result.success, result.message
    couplers = result.q[2:] - result.q[:2] - np.array([[1.0], [0.0]])
    assert np.abs(couplers).max() < 1e-3  # on the other branch the coupler turns


@pytest.mark.parametrize("n", [1, 2])
@pytest.mark.parametrize("method", ["auto", "DOP853", "RadauIIA5"])
@pytest.mark.parametrize("tol", [1e-6, 1e-10])
def test_the_end_on_a_singular_position_is_right_or_the_run_says_so(n, method, tol):
    """Velocities are not determined there."""
    m, end = mechanism(f"A02, N = {n}"), first_singular_time(n)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always", ConstraintWarning)
        result = solve_dae(m.system(), (0.0, end), *m.start, method, tol, tol)
    q, v = m.state(end)
    if result.success:
        assert worst(result.q[:, -1], q) < 1e3 * tol and (worst(result.v[:, -1], v) < 1e3 * tol or len(said) == 1)
        assert ("The run ends where the constraints lose rank" in result.message) is bool(said)
    else:
        said = "s ahead: end a little before that position, or beyond.", "Not to be trusted beyond t = "
        assert any(words in result.message for words in said)


@pytest.mark.parametrize("method", ["SunRadau5", "Gauss12", "DOP853"])
def test_a_cusp_ends_the_run_and_is_named(method):
    """Where the motion cannot go on, the run says so: the time, the row, and nothing beyond."""
    m = cusp()
    result = solve_dae(m.system(), (0.0, m.end), *m.start, method=method, max_steps=20_000)
    assert result.status in (Status.RANK_LOST, Status.STEP_TOO_SMALL), result.message
    assert CUSP_TIME - 0.05 < result.t[-1] < CUSP_TIME + 1e-6 and f"{result.t[-1]:.10g}" in result.message
    before = result.t < 0.95 * CUSP_TIME
    q, _ = m.states(result.t[before])
    assert np.abs(result.q[:, before] - q).max() < 1e-6


@pytest.mark.parametrize("method", ["DOP853", "auto"])
def test_states_stay_as_they_were_stored_when_a_step_goes_across(method):
    """With a terminal event chunks are short, and one may end, half full, at a singular position."""
    m, never = mechanism("A02, N = 1"), event(lambda t, q, v: 1.0, terminal=True)
    crossed = 0
    for tol in (1e-3, 1e-4, 3e-5, 1e-6, 1e-8):
        runs = [
            solve_dae(m.system(), (0.0, 10.0), *m.start, method, tol, tol, events=events, check_derivatives=False)
            for events in (None, never)
        ]
        assert runs[0].status is runs[1].status
        crossed += "across" in runs[1].message
        assert (runs[0].t == runs[1].t).all() and (runs[0].q == runs[1].q).all() and (np.diff(runs[1].t) > 0.0).all()
    assert crossed > 0


def parallelogram(angle, speed, gravity=-9.81):
    """Two cranks with a coupler that stays level; it may turn where all lie in line."""
    model, tip, base = (
        PlanarModel(gravity=(0.0, gravity)),
        np.array([np.cos(angle), np.sin(angle)]),
        np.array([2.0, 0.0]),
    )
    model.body("crank", mass=1.0, inertia=1.0 / 12.0, position=0.5 * tip, angle=angle, angular_velocity=speed)
    model.body("coupler", mass=1.5, inertia=0.2, position=tip + np.array([1.0, 0.0]))
    model.body("rocker", mass=1.0, inertia=1.0 / 12.0, position=0.5 * tip + base, angle=angle)
    pins = (0.0, 0.0), tip, tip + base, base
    for one, other, at in zip(
        ("ground", "crank", "coupler", "rocker"), ("crank", "coupler", "rocker", "ground"), pins, strict=True
    ):
        model.revolute(one, other, at=at)
    return model.problem((0.0, 30.0)), lambda q: q[5]


def equal_slider_crank(angle, speed):
    """A rod as long as the crank: its angle is the opposite one, unless the slider stays on the crank's bearing."""
    model, tip = PlanarModel(), np.array([np.cos(angle), np.sin(angle)])
    pin = 2.0 * tip[0], 0.0
    model.body("crank", mass=1.0, inertia=1.0 / 12.0, position=0.5 * tip, angle=angle, angular_velocity=speed)
    model.body("rod", mass=1.0, inertia=1.0 / 12.0, position=0.5 * (tip + pin), angle=-angle)
    model.body("slider", mass=1.0, inertia=1.0, position=pin)
    for one, other, at in (("ground", "crank", (0.0, 0.0)), ("crank", "rod", tip), ("rod", "slider", pin)):
        model.revolute(one, other, at=at)
    model.prismatic("ground", "slider", at=pin, axis=(1.0, 0.0))
    return model.problem((0.0, 30.0)), lambda q: q[5] + q[2]


@pytest.mark.parametrize(("make", "method"), [(parallelogram, "TRBDF2"), (equal_slider_crank, "ESDIRK4")])
def test_steps_that_test_positions_alone_do_not_creep_onto_another_branch(make, method):
    """There rounding makes accelerations: they turned the motion, with positions within the tolerance."""
    numbers = np.random.default_rng(4)
    for tolerance in (1e-3, 1e-4, 1e-5, 1e-6) * 8:
        problem, off = make(numbers.uniform(0.3, 1.2), numbers.choice([-7.0, -2.0, -0.5, 0.5, 2.0, 7.0]))
        result = solve_dae(problem.system, problem.t_span, problem.q0, problem.v0, method, tolerance, tolerance)
        assert np.abs(off(result.q)).max() < 1e-6, result


@pytest.mark.filterwarnings("ignore:the run (begins|ends) where:twoloop.ConstraintWarning")
@pytest.mark.parametrize(
    ("method", "tolerance"),
    [
        *((method, 1e-3) for method in ("auto", "ESDIRK4", "TRBDF2", "BDF", "RadauIIA5")),
        *((method, 1e-6) for method in ("TRBDF2", "Adams", "Taylor")),
    ],
)
def test_no_run_that_begins_beside_a_singular_position_succeeds_on_another_branch_without_a_word(method, tolerance):
    """Both branches are within the tolerance there, and the pivots of the start are small themselves.

    Rounding decides which of a hundred such runs turn; all say so in their message and by a warning.
    """
    for angle, speed in ((4.3e-6, -5.0), (3.5e-5, -0.134), (1.3e-6, -0.0715), (1e-6, -5.0), (1e-5, -1.0), (4e-6, 3.0)):
        problem, _ = parallelogram(angle, speed)
        for end in (2.0 * angle / abs(speed), 0.5):
            result = solve_dae(problem.system, (0.0, end), problem.q0, problem.v0, method, tolerance, tolerance)
            turned = np.abs(result.v[5]).max() > max(0.1 * abs(speed), 30.0 * tolerance)
            assert not (result.success and turned) or "lose rank" in result.message, result


NEAR_START = "the run begins where the constraints nearly lose rank"


@pytest.mark.parametrize(("angle", "tolerance", "near"), [(1e-4, 1e-3, True), (1e-4, 1e-6, False), (0.1, 1e-3, False)])
def test_a_start_that_the_tolerances_do_not_tell_from_a_singular_position_is_told(angle, tolerance, near):
    """At every call, and by whatever makes the run."""

    def single(*start):
        return solve_dae(problem.system, (0.0, 0.1), *start, rtol=tolerance, atol=tolerance)

    problem, far = parallelogram(angle, 1.0)[0], parallelogram(0.5, 1.0)[0]
    starts = (problem.q0, problem.v0), (far.q0, far.v0), (problem.q0, problem.v0), (problem.q0, problem.v0)
    for start, beside in zip(starts, (near, False, near, near), strict=True):
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always", ConstraintWarning)
            result = single(*start)
        assert result.success, result.message
        assert [NEAR_START in str(each.message) for each in said] == [True] * beside
        assert (NEAR_START[1:] in result.message) is beside
    integrator = Integrator(problem.system, method="RadauIIA5", rtol=tolerance, atol=tolerance)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always", ConstraintWarning)
        integrator.start(0.0, problem.q0, problem.v0)
    assert [NEAR_START in str(each.message) for each in said] == [True] * near


ANGLE, SPEED = 2.3, 1.7  # of a parallelogram that turns uniformly, at first


def turning(method, tolerance, end, **options):
    """The run until `end`, the largest errors of its velocities over the tolerances, and what was said."""
    problem, _ = parallelogram(ANGLE, SPEED, gravity=0.0)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always", ConstraintWarning)
        result = solve_dae(problem.system, (0.0, end), problem.q0, problem.v0, method, tolerance, tolerance, **options)
    return result, errors_of_velocities(result.t, result.v, tolerance), [str(each.message) for each in said]


def errors_of_velocities(t, v, tolerance):
    angle = ANGLE + SPEED * t
    over, up, turn, none = -SPEED * np.sin(angle), SPEED * np.cos(angle), np.full(len(t), SPEED), np.zeros(len(t))
    exact = np.array([0.5 * over, 0.5 * up, turn, over, up, none, 0.5 * over, 0.5 * up, turn])
    return np.abs(v - exact).max(axis=0) / (tolerance * (1.0 + SPEED))


def beside_singular(angle):
    """When the parallelogram is so many radians beyond its singular position."""
    return (np.pi + angle - ANGLE) / SPEED


@pytest.mark.parametrize(
    ("method", "tolerance"),
    [("DOP853", 1e-4), ("DOP853", 1e-6), ("Adams", 1e-8), ("auto", 1e-9), ("Taylor", 1e-9), ("RadauIIA5", 1e-6)],
)
def test_an_end_beside_a_singular_position_is_right_or_the_run_says_so(method, tolerance):
    """There rounding of positions makes velocities, and no step need be short."""
    for beside in (-3e-8, -1e-7, 2e-7, -5e-7, 1e-6, -3e-6, 1e-5):
        result, errors, said = turning(method, tolerance, beside_singular(beside))
        assert errors[-1] < 1e3 or said or not result.success, (beside, result)
        assert all("The run ends where the constraints" in result.message for _ in said if result.success)


@pytest.mark.parametrize(("method", "tolerance"), [("DOP853", 1e-6), ("Adams", 1e-8), ("auto", 1e-10)])
def test_nothing_is_said_of_an_end_farther_away(method, tolerance):
    for beside in (-1e-3, -1e-2, -1e-1):
        result, errors, said = turning(method, tolerance, beside_singular(beside))
        assert result.success and not said and errors[-1] < 100.0, (beside, result)


SIDES = 10.0 ** np.arange(-9.0, -2.0, 0.5)
ROUNDED = "interpolated and off the constraints"
CLOSE_TIMES = beside_singular(np.concatenate([-SIDES[::-1], SIDES]))


def off_the_constraints(t, q, v):
    """At how many of these states velocities are off by more than rounding."""
    system = parallelogram(ANGLE, SPEED)[0].system
    return sum(np.abs(system.velocity_constraint(*each)).max() > 1e-13 for each in zip(t, q.T, v.T, strict=True))


@pytest.mark.parametrize("method", ["DOP853", "Taylor", "BDF", "RadauIIA5"])
def test_beside_a_singular_position_no_state_between_steps_is_made_by_rounding(method):
    """Where it would be, it is that of the polynomials, and the warning counts it."""
    result, errors, said = turning(method, 1e-6, beside_singular(0.1), t_eval=CLOSE_TIMES)
    off = off_the_constraints(result.t, result.q, result.v)
    assert result.success and errors.max() < 1e3
    counted = [words for words in said if ROUNDED in words]
    assert off <= (int(counted[0].split("at ")[1].split(" of")[0]) if counted else 0) < len(CLOSE_TIMES)
    dense, _, _ = turning(method, 1e-6, beside_singular(0.1), dense_output=True)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always", ConstraintWarning)
        assert (dense.sol(CLOSE_TIMES).v == result.v).all()
    assert [str(each.message) for each in said] == counted


def test_events_beside_a_singular_position_have_velocities_that_are_not_made_by_rounding():
    events = [event(lambda t, q, v, at=at: t - at) for at in CLOSE_TIMES]
    result, _, _ = turning("DOP853", 1e-6, beside_singular(0.1), events=events)
    for t, v in zip(result.t_events, result.v_events, strict=True):
        assert len(t) == 1 and errors_of_velocities(t, v.T, 1e-6).max() < 1e3


def test_steps_of_constant_size_that_end_beside_a_singular_position_do_not_succeed_with_what_rounding_makes():
    """With steps that have to end there."""
    for angle in (2e-8, -1e-7, 2e-7, -5e-7):
        h = beside_singular(angle) / 50
        for options in ({}, {"t_eval": h * np.arange(61)}):
            result, errors, _ = turning("DOP853", 1e-6, 60 * h, step_size=h, **options)
            assert errors.max() < 1e3 or not result.success, result
        result, errors, said = turning("DOP853", 1e-6, 49 * h, step_size=h)
        assert result.success and errors.max() < 100.0 and not said


@pytest.mark.parametrize("method", ["DOP853", "Adams", "auto"])
def test_a_sample_beside_a_singular_position_is_right_or_the_step_says_so(method):
    problem, _ = parallelogram(ANGLE, SPEED, gravity=0.0)
    for angle in (2e-8, -5e-8, -1e-7, 2e-7, -3e-7, 5e-7, 1e-6):
        integrator = Integrator(problem.system, method, 1e-8, 1e-8)
        integrator.start(0.0, problem.q0, problem.v0)
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always", ConstraintWarning)
            try:
                state = integrator.step(beside_singular(angle))
            except RuntimeError:
                continue
        assert said or errors_of_velocities(np.array([state.t]), state.v[:, None], 1e-8)[0] < 1e3


def in_units(angle, size=1.0):
    """A state of the parallelogram, in units of which so many make a metre."""
    problem, _ = parallelogram(np.pi + angle, 1.0)
    units = np.array([size, size, 1.0] * 3)
    system = problem.system
    scaled = ConstrainedSystem.from_python(
        n_q=9,
        n_c=8,
        mass=system.mass(0.0, problem.q0) / units / units[:, None],
        force=lambda t, q, v: np.zeros(9),
        constraint=lambda t, q: system.constraint(t, q / units),
        jacobian=lambda t, q: system.jacobian(t, q / units) / units,
    )
    return scaled, problem.q0 * units, problem.v0 * units, units


def test_what_rounding_makes_of_velocities_grows_with_the_nearness_and_not_with_the_units():
    errors = {}
    for size in (1.0, 1e3):
        for angle in (1e-3, 1e-4, 1e-5):
            system, q, v, units = in_units(angle, size)
            errors[angle, size] = (turned_by_rounding(system, 0.0, q, v, 8) / units).max()
        assert errors[1e-4, size] / errors[1e-3, size] == pytest.approx(100.0, rel=0.3)
        assert errors[1e-5, size] / errors[1e-4, size] == pytest.approx(100.0, rel=0.3)
    assert errors[1e-4, 1e3] == pytest.approx(errors[1e-4, 1.0], rel=0.3)
    assert 1e-9 < errors[1e-4, 1.0] < 1e-7  # as measured


def test_an_end_where_callbacks_end_too_is_still_reported():
    """A root that ends beside the position; nothing can be told of the velocities there."""

    def fails_beyond(t, q):
        if abs(q[2] - problem.q0[2]) > 1e-9:
            raise ValueError("beyond the dead centre")
        return problem.system.jacobian(t, q)

    problem, _ = parallelogram(np.pi + 1e-5, 1.0)
    system = SimpleNamespace(rows=fails_beyond, velocity_constraint=problem.system.velocity_constraint)
    assert np.isnan(turned_by_rounding(system, 0.0, problem.q0, problem.v0, 8)).all()


def test_steps_that_went_on_from_velocities_made_by_rounding_are_not_to_be_trusted():
    for angle, trusted in ((1e-3, True), (1e-7, False)):
        problem, _ = parallelogram(np.pi + angle, 1.0)
        state = np.concatenate([problem.q0, problem.v0, np.zeros(17)])
        tolerance = np.full(tolerances.ATOL + 9, 1e-6)
        run = SimpleNamespace(system=problem.system, rank=8, rtol=1e-6, near=nearness(1e-6), tolerances=tolerance)
        said = said_of_rounding(run, [(0.3, state), (0.4, state)], 1.0)
        assert (said == "") is trusted and said.startswith("" if trusted else "Not to be trusted beyond t = 0.3:")
        assert said_of_rounding(run, [(0.3, state), (0.4, state)], 0.2) == ""  # an event ended the run before


def test_a_turn_on_the_way_across_is_told_from_a_motion_that_goes_on():
    problem, _ = parallelogram(0.0, 0.0)
    system, q = problem.system, problem.q0
    across = np.array([0.0, 0.5, 1.0, 0.0, 1.0, 0.0, 0.0, 0.5, 1.0])  # velocities of the parallelogram
    turning = across + np.array([0.0, 0.0, 0.0, 0.0, -1.0, -1.0, 0.0, -1.0, -2.0])  # and of the other branch
    assert np.abs(system.jacobian(0.0, q) @ np.stack([across, turning], axis=1)).max() < 1e-15
    went_on, turned = (np.concatenate([q, each, np.zeros(17)]) for each in (across, turning))
    atol = np.full(9, 1e-3)
    assert said_of_turn(system, [[(0.0, went_on), (1e-4, went_on)]], (1.0, went_on), 8, 1e-3, atol) == ""
    for crossings in ([[(0.0, went_on), (1e-4, turned)]], [[(0.0, went_on)], [(5e-5, turned), (1e-4, turned)]]):
        said = said_of_turn(system, crossings, (1.0, turned), 8, 1e-3, atol)
        assert said.startswith("Not to be trusted beyond t = 0:") and "up to 2 within 0.0001 s" in said
