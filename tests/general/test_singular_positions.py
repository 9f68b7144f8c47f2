"""Test where C_q loses rank on the way: the motion goes on where it is smooth, on the same branch, by every method."""

import warnings

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tests.general.mechanisms import SINGULAR, WINDOWS, error, first_singular_time, mechanism, run
from tests.general.systems import CUSP_TIME, cusp
from tests.marks import slow
from tests.problems import run as run_problem
from tests.problems import worst
from twoloop import DOP853, ConstraintWarning, Integrator, Status, solve_dae
from twoloop.bodies import PlanarModel
from twoloop.mechanisms import n_four_bar

OTHERS = [name for name in SINGULAR if name not in {f"A02, N = {n}" for n in WINDOWS}]
CROSSED = [
    *((name, DOP853("restored") if name in OTHERS else "DOP853", 1e-9) for name in ("A02, N = 2", *OTHERS)),
    *(("A02, N = 1", "RadauIIA5", 1e-7), ("A02, N = 40", "auto", 1e-11), ("A02 of bodies, N = 40", "auto", 1e-8)),
    *(slow("A02, N = 2", method, 1e-7) for method in ("SunRadau5", "RadauIIA5", "BDF")),
]


@pytest.mark.parametrize(("name", "method", "tolerance"), CROSSED)
def test_the_motion_across_the_singular_positions(name, method, tolerance):
    """A02 for 10 s, in which the cranks pass the ground line some ten times: on another branch no digit is right."""
    result = run(name, method, tolerance)[0]
    assert result.success, result.message
    assert error(mechanism(name), result) < 1e-4


def rhombus(a, b, gravity=(0.0, 0.0)):
    """Four equal bars of 1 m and 1.3 kg, two of them pinned to the ground: without gravity they turn by themselves."""
    model, tips = PlanarModel(gravity=gravity), [np.array([np.cos(x), np.sin(x)]) for x in (a, b)]
    far = tips[0] + tips[1]
    for name, start, end in zip("ABCD", (0 * far, 0 * far, *tips), (*tips, far, far), strict=True):
        model.rod(name, start, end, mass=1.3)
    for bodies, at in (("gA", 0 * far), ("gB", 0 * far), ("AC", tips[0]), ("BD", tips[1]), ("CD", far)):
        model.revolute(*("ground" if body == "g" else body for body in bodies), at=at)
    return model.problem((0.0, 6.0)).system


def turns(_, y):
    """The two angles: 5/3 a'' + cos(a - b) b'' = -sin(a - b) b'^2, and likewise with a and b exchanged."""
    away, turned = y[0] - y[1], np.sin(y[0] - y[1]) * np.array([-(y[3] ** 2), y[2] ** 2])
    return np.append(y[2:], np.linalg.solve([[5 / 3, np.cos(away)], [np.cos(away), 5 / 3]], turned))


def placed(y):
    """Positions and velocities of the four bars at the two angles and their rates."""
    a, b, one, other = *y[:2], *(np.array([np.cos(x), np.sin(x)]) for x in y[:2])
    q = np.concatenate([0.5 * one, [a], 0.5 * other, [b], one + 0.5 * other, [b], other + 0.5 * one, [a]])
    da, db, one, other = *y[2:], *(w * np.array([-np.sin(x), np.cos(x)]) for x, w in zip(y[:2], y[2:], strict=True))
    v = np.concatenate([0.5 * one, [da], 0.5 * other, [db], one + 0.5 * other, [db], other + 0.5 * one, [da]])
    return q, v


FOLDED, OPTIONS = (0.4, 0.4, 1.0, -2.0), ({}, {"compiled": False}, {"method": "DOP853"})
STARTS = (0.7, 2.3, 1.9, -1.1), (-1.2, 0.5, -0.4, 2.6), (0.4, 0.4 + np.pi, 1.0, -2.0)


@pytest.mark.filterwarnings("ignore:the run begins in:twoloop.ConstraintWarning")
@pytest.mark.parametrize(("y0", "options"), [(FOLDED, {}), *(slow(y0, each) for y0 in STARTS for each in OPTIONS)])
def test_a_rhombus_turns_through_its_singular_positions_as_its_two_angles_do(y0, options):
    """Where two bars cover the other two, constraints lose rank: tight tolerances stopped runs, as did starts there."""
    system, exact = rhombus(*y0[:2]), solve_ivp(turns, (0.0, 6.0), y0, "DOP853", rtol=1e-13, atol=1e-13).y[:, -1]
    for tolerance, times in ((1e-4, None), (1e-7, None), (1e-10, [0.0, 3.0, 6.0])):
        result = solve_dae(system, (0.0, 6.0), *placed(y0), rtol=tolerance, atol=tolerance, t_eval=times, **options)
        assert result.success, result.message
        ends = np.append(result.q[:, -1], result.v[:, -1]), np.concatenate(placed(exact))
        np.testing.assert_allclose(*ends, rtol=0.0, atol=1e3 * tolerance)
        np.testing.assert_allclose(result.a[[2, 5], 0], turns(0.0, y0)[2:], rtol=0.0, atol=1e-8)
    assert not result.certify().faults


STEPS = [("Taylor", 0.01), ("Taylor", 0.0025), ("Lobatto16", 0.01), slow("Gauss8", 0.005), slow("DOP853", 0.0173)]


@pytest.mark.parametrize(("method", "step_size"), [*STEPS, slow("SunRadau5", 0.01), slow("RadauIIA5", 0.01)])
def test_steps_of_constant_size_across_singular_positions(method, step_size):
    """Taylor series about states beside these positions diverged, but were used: an error of 0.9, with success."""
    m, end = mechanism("A02, N = 1"), 3.0
    result = solve_dae(m.system(), (0.0, end), *m.start, method=method, step_size=step_size)
    assert result.success, result.message
    assert worst(result.q[:, -1], m.state(end)[0]) < (1e-4 if "Radau" in method else 1e-7)


@pytest.mark.parametrize(
    ("n", "method", "tol"),
    [(1, "DOP853", 1e-6), (2, "auto", 1e-10), slow(1, "RadauIIA5", 1e-6), slow(2, "DOP853", 1e-10)],
)
def test_the_end_on_a_singular_position_is_right_or_the_run_says_so(n, method, tol):
    m, end = mechanism(f"A02, N = {n}"), first_singular_time(n)
    with warnings.catch_warnings(record=True, action="always", category=ConstraintWarning) as said:
        result = solve_dae(m.system(), (0.0, end), *m.start, method, tol, tol)
    q, v = m.state(end)
    if result.success:
        assert worst(result.q[:, -1], q) < 1e3 * tol and (worst(result.v[:, -1], v) < 1e3 * tol or len(said) == 1)
        assert ("The run ends where the constraints lose rank" in result.message) is bool(said)
    else:
        said = "s ahead: end a little before that position, or beyond.", "Not to be trusted beyond t = "
        assert any(words in result.message for words in said)


@pytest.mark.parametrize("method", ["DOP853", slow("SunRadau5"), slow("Gauss12")])
def test_a_cusp_ends_the_run_and_is_named(method):
    m = cusp()
    result = solve_dae(m.system(), (0.0, m.end), *m.start, method=method, max_steps=20_000)
    assert result.status in (Status.RANK_LOST, Status.STEP_TOO_SMALL), result.message
    assert CUSP_TIME - 0.05 < result.t[-1] < CUSP_TIME + 1e-6 and f"{result.t[-1]:.10g}" in result.message
    times = result.t[result.t < 0.95 * CUSP_TIME]
    assert np.abs(result.q[:, : times.size] - m.states(times)[0]).max() < 1e-6


def parallelogram(angle, speed, gravity=-9.81, torque=None):
    """Two cranks with a coupler that stays level; it may turn where all lie in line."""
    model, base = PlanarModel(gravity=(0.0, gravity)), np.array([2.0, 0.0])
    tip = np.array([np.cos(angle), np.sin(angle)])
    model.body("crank", mass=1.0, inertia=1.0 / 12.0, position=0.5 * tip, angle=angle, angular_velocity=speed)
    model.body("coupler", mass=1.5, inertia=0.2, position=tip + np.array([1.0, 0.0]))
    model.body("rocker", mass=1.0, inertia=1.0 / 12.0, position=0.5 * tip + base, angle=angle)
    bodies, pins = ("ground", "crank", "coupler", "rocker"), ((0.0, 0.0), tip, tip + base, base)
    for k in range(4):
        model.revolute(bodies[k], bodies[k - 3], at=pins[k])
    if torque is not None:
        model.torque("crank", torque)
    return model.problem((0.0, 30.0))


@pytest.mark.parametrize("method", ["TRBDF2", slow("ESDIRK4")])
def test_steps_that_test_positions_alone_do_not_creep_onto_another_branch(method):
    """There rounding makes accelerations: they turned the motion, with positions within the tolerance."""
    numbers = np.random.default_rng(4)
    for tolerance in (1e-3, 1e-4, 1e-5) * 4:
        problem = parallelogram(numbers.uniform(0.3, 1.2), numbers.choice([-7.0, -2.0, -0.5, 0.5, 2.0, 7.0]))
        result = solve_dae(problem.system, problem.t_span, problem.q0, problem.v0, method, tolerance, tolerance)
        assert np.abs(result.q[5]).max() < 1e-6, result


MORE = [("ESDIRK4", 1e-3), ("BDF", 1e-3), ("RadauIIA5", 1e-3), ("Adams", 1e-6), ("Taylor", 1e-6)]


@pytest.mark.filterwarnings("ignore:the run (begins|ends) where:twoloop.ConstraintWarning")
@pytest.mark.parametrize(("method", "tolerance"), [("auto", 1e-3), ("TRBDF2", 1e-6), *(slow(*each) for each in MORE)])
def test_no_run_that_begins_beside_a_singular_position_succeeds_on_another_branch_without_a_word(method, tolerance):
    """Both branches are within the tolerance there. Rounding decides which runs turn; all of these say so."""
    for angle, speed in ((4.3e-6, -5.0), (3.5e-5, -0.134), (1.3e-6, -0.0715), (1e-6, -5.0), (1e-5, -1.0), (4e-6, 3.0)):
        problem = parallelogram(angle, speed)
        for end in (2.0 * angle / abs(speed), 0.5):
            result = solve_dae(problem.system, (0.0, end), problem.q0, problem.v0, method, tolerance, tolerance)
            turned = np.abs(result.v[5]).max() > max(0.1 * abs(speed), 30.0 * tolerance)
            assert not (result.success and turned) or "lose rank" in result.message, result


@pytest.mark.filterwarnings("ignore:the run begins where:twoloop.ConstraintWarning")
@pytest.mark.parametrize(
    ("angle", "speed", "tolerance"),
    [(-0.01, 3.0, 1e-11), (-2e-6, 3.0, 1e-8), (0.000173, -4.5, 1e-11), (-4.8e-5, 1.1, 1e-9)],
)
def test_a_run_that_begins_shortly_before_a_singular_position_crosses_it(angle, speed, tolerance):
    """With tightened tolerances, steps before the position became too short, and no polynomial across it had room.

    Where the polynomial begins at the start, its velocities are the user's: rounding errors do not count there.
    """
    problem, end = parallelogram(angle, speed), 1.0
    result = solve_dae(problem.system, (0.0, end), problem.q0, problem.v0, rtol=tolerance, atol=tolerance)
    pull = 2.5 * 9.81 / (2.0 / 3.0 + 1.5)  # moment of the weights over the moment of inertia, in the crank's angle
    one, strict = (lambda t, y: [y[1], -pull * np.cos(y[0])]), {"rtol": 1e-13, "atol": 1e-13}
    exact = solve_ivp(one, (0.0, end), (angle, speed), "DOP853", **strict).y[0, -1]
    assert result.success, result.message
    assert abs(result.q[2, -1] - exact) < 100.0 * tolerance and abs(result.q[5, -1]) < 100.0 * tolerance


@pytest.mark.parametrize("tolerance", [1e-6, slow(1e-8), 1e-10])
def test_a_polynomial_from_the_start_does_not_lose_a_gust_that_steps_have_met(tolerance):
    """Steps resolved the gust; the polynomial across the position began before it, and had no node in it."""
    inertia, width, torque = 2.0 / 3.0 + 1.5, 2e-4, -5000.0
    problem = parallelogram(-0.03, 3.0, 0.0, lambda t, q, v: torque * np.exp(-(((t - 0.006) / width) ** 2)))
    result = solve_dae(problem.system, (0.0, 10.0), problem.q0, problem.v0, rtol=tolerance, atol=tolerance)
    assert result.success, result.message
    assert abs(result.v[2, -1] - 3.0 - torque * width * np.sqrt(np.pi) / inertia) < 300.0 * tolerance


@pytest.mark.filterwarnings("ignore:the constraints of:twoloop.ConstraintWarning")
@pytest.mark.parametrize(("speed", "tolerance"), [(0.0, 1e-6), (1e-3, 1e-3)])
def test_a_start_in_a_singular_position_is_named_where_several_branches_have_its_velocities(speed, tolerance):
    system, start = rhombus(*FOLDED[:2], gravity=(0.0, -9.81)), placed((*FOLDED[:2], speed, -2.0 * speed))
    result = solve_dae(system, (0.0, 1e-5), *start, rtol=tolerance, atol=tolerance)
    assert result.status == Status.ROWS_CONTRADICT and "a singular position" in result.message, result.message
    with pytest.raises(ValueError, match="must not be a singular position"):
        Integrator(system, rtol=tolerance, atol=tolerance).start(0.0, *start)


NEAR_START = "the run begins where the constraints nearly lose rank"


@pytest.mark.parametrize(
    ("angle", "tolerance", "near"), [(1e-4, 1e-3, True), (1e-4, 1e-6, False), slow(0.1, 1e-3, False)]
)
def test_a_start_that_the_tolerances_do_not_tell_from_a_singular_position_is_told(angle, tolerance, near):
    problem, far = parallelogram(angle, 1.0), parallelogram(0.5, 1.0)
    starts = (problem.q0, problem.v0), (far.q0, far.v0), (problem.q0, problem.v0), (problem.q0, problem.v0)
    for start, beside in zip(starts, (near, False, near, near), strict=True):
        with warnings.catch_warnings(record=True, action="always", category=ConstraintWarning) as said:
            result = solve_dae(problem.system, (0.0, 0.1), *start, rtol=tolerance, atol=tolerance)
        assert result.success, result.message
        assert [NEAR_START in str(each.message) for each in said] == [True] * beside
        assert (NEAR_START[1:] in result.message) is beside
    integrator = Integrator(problem.system, method="RadauIIA5", rtol=tolerance, atol=tolerance)
    with warnings.catch_warnings(record=True, action="always", category=ConstraintWarning) as said:
        integrator.start(0.0, problem.q0, problem.v0)
    assert [NEAR_START in str(each.message) for each in said] == [True] * near


@pytest.mark.parametrize(("turn", "tolerance"), [(0.002, 1e-11), (0.0155, 1e-10), slow(0.0067, 1e-11)])
def test_a_swing_that_turns_back_beside_a_singular_position_crosses_it_slowly_and_twice(turn, tolerance):
    """At 1e-11, two in three of such runs stopped: too few nodes are far from the position."""
    pull = 15.0 / 13.0 * 9.81  # two cranks with their coupler are a pendulum
    y0 = -1.0, np.sqrt(2.0 * pull * (np.sin(turn) + np.sin(1.0)))
    exact = solve_ivp(lambda t, y: (y[1], -pull * np.cos(y[0])), (0.0, 3.0), y0, "DOP853", rtol=1e-13, atol=1e-13).y
    result = run_problem(parallelogram(*y0), 3.0, rtol=tolerance, atol=tolerance)
    assert result.success and worst(result.q[[2, 5], -1], [exact[0, -1], 0.0]) < 100.0 * tolerance, result.message


ANGLE, SPEED = 2.3, 1.7  # of a parallelogram that turns uniformly, at first


def turning(method, tolerance, end, **options):
    """The run until `end`, the largest errors of its velocities over the tolerances, and what was said."""
    problem = parallelogram(ANGLE, SPEED, gravity=0.0)
    with warnings.catch_warnings(record=True, action="always", category=ConstraintWarning) as said:
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
    [("DOP853", 1e-10), ("auto", 1e-9), slow("Adams", 1e-8), slow("Taylor", 1e-9), slow("RadauIIA5", 1e-6)],
)
def test_an_end_beside_a_singular_position_is_right_or_the_run_says_so(method, tolerance):
    """There rounding of positions makes velocities, and no step need be short. At 5 mrad, steps have to end beyond."""
    for beside in (-3e-8, -1e-7, 2e-7, -5e-7, 1e-6, -3e-6, 1e-5, 5e-3, 0.03):
        result, errors, said = turning(method, tolerance, beside_singular(beside))
        assert result.success or beside < 1e-3, result.message
        assert errors[-1] < 1e3 or said or not result.success, (beside, result)
        assert all("The run ends where the constraints" in result.message for _ in said if result.success)


@pytest.mark.parametrize(("n", "coordinates", "tolerance", "end"), [(2, "tips", 3e-7, 20.0), (1, "bodies", 1e-6, 1.2)])
def test_samples_within_one_step_across_a_singular_position_are_as_accurate_as_its_ends(n, coordinates, tolerance, end):
    """The first passage is within one ordinary step: samples erred by 28,000 and 390 tolerances, its ends by 1."""
    problem, times = n_four_bar(n, coordinates), np.linspace(0.6, 0.9, 151)
    with warnings.catch_warnings(action="ignore", category=ConstraintWarning):
        result = run_problem(problem, end, rtol=tolerance, atol=tolerance, t_eval=times)
    exact = np.array([np.concatenate(problem.motion(t)) for t in times]).T
    assert np.abs(np.concatenate([result.q, result.v]) - exact).max() < 30.0 * tolerance


AGAIN = [(5, "bodies", 1e-5), (4, "bodies", 2e-11), (2, "tips", 1e-11)]
AGAIN += [slow(5, "tips", 1e-9), slow(3, "bodies", 1e-6), slow(1, "tips", 1e-10)]


@pytest.mark.parametrize(("n", "coordinates", "tolerance"), AGAIN)
def test_errors_do_not_grow_beyond_singular_positions(n, coordinates, tolerance):
    """Near the upright position errors grow a hundredfold in half a turn: up to 388 tolerances if nothing is done."""
    problem, times = n_four_bar(n, coordinates), np.linspace(0.0, 20.0, 7)
    own = {"rtol": tolerance, "atol": tolerance}
    with warnings.catch_warnings(action="ignore", category=ConstraintWarning):
        result = run_problem(problem, 20.0, **own)
        sampled = run_problem(problem, 20.0, t_eval=times, **own)
        watched = run_problem(problem, 20.0, events=lambda t, q, v: q[0], **own)
    exact = np.array([problem.motion(t)[0] for t in times]).T
    assert np.abs(result.q[:, -1] - exact[:, -1]).max() < 60.0 * tolerance
    assert np.abs(sampled.q - exact).max() < 100.0 * tolerance
    assert result.t[0] == 0.0 and np.all(np.diff(result.t) > 0.0) and len(result.h) == result.stats.n_accepted
    assert np.array_equal(watched.t, result.t)
    upright = watched.t_events[0]  # or hanging: each time is found once
    assert len(upright) == 20 and np.all(np.diff(upright) > 0.5)
    assert np.abs([problem.motion(t)[0][0] for t in upright]).max() < 60.0 * tolerance


@pytest.mark.parametrize("n", [4, 6])
def test_a_run_of_few_steps_begins_again_even_after_its_first_third(n):
    """Long steps jump over the first positions, and the third one is noticed: else 113 and 104 tolerances."""
    problem = n_four_bar(n, "bodies")
    with warnings.catch_warnings(action="ignore", category=ConstraintWarning):
        result = run_problem(problem, 3.0, rtol=1e-5, atol=1e-5)
    assert np.abs(result.q[:, -1] - problem.motion(3.0)[0]).max() < 3e-5


def test_a_run_whose_states_are_in_files_does_not_begin_again(tmp_path):
    problem, own = n_four_bar(2, "bodies"), {"rtol": 1e-7, "atol": 1e-7}
    with warnings.catch_warnings(action="ignore", category=ConstraintWarning):
        stored, plain = run_problem(problem, 10.0, store=tmp_path / "run", **own), run_problem(problem, 10.0, **own)
    assert np.all(np.diff(stored.t) > 0.0) and np.abs(stored.q[:, -1] - problem.motion(10.0)[0]).max() < 1e-5
    assert stored.t[1] > 1.05 * plain.t[1]  # its first steps have the tolerances given


SIDES = 10.0 ** np.arange(-9.0, -2.0, 0.5)
ROUNDED = "interpolated and off the constraints"
CLOSE_TIMES = beside_singular(np.concatenate([-SIDES[::-1], SIDES]))


@pytest.mark.parametrize("method", ["DOP853", slow("Taylor"), slow("BDF"), slow("RadauIIA5")])
def test_beside_a_singular_position_no_state_between_steps_is_made_by_rounding(method):
    """Where it would be, it is that of the polynomials, and the warning counts it."""
    result, errors, said = turning(method, 1e-6, beside_singular(0.1), t_eval=CLOSE_TIMES)
    system, states = parallelogram(ANGLE, SPEED).system, zip(result.t, result.q.T, result.v.T, strict=True)
    off = sum(np.abs(system.velocity_constraint(*state)).max() > 1e-13 for state in states)  # by more than rounding
    assert result.success and errors.max() < 1e3
    counted = [words for words in said if ROUNDED in words]
    assert off <= (int(counted[0].split("at ")[1].split(" of")[0]) if counted else 0) < len(CLOSE_TIMES)
    dense, _, _ = turning(method, 1e-6, beside_singular(0.1), dense_output=True)
    with warnings.catch_warnings(record=True, action="always", category=ConstraintWarning) as said:
        assert (dense.sol(CLOSE_TIMES).v == result.v).all()
    assert [str(each.message) for each in said] == counted


@pytest.mark.parametrize("method", ["auto", slow("DOP853"), slow("Adams")])
def test_a_sample_beside_a_singular_position_is_right_or_the_step_says_so(method):
    problem = parallelogram(ANGLE, SPEED, gravity=0.0)
    for angle in (2e-8, -5e-8, -1e-7, 2e-7, -3e-7, 5e-7, 1e-6):
        integrator = Integrator(problem.system, method, 1e-8, 1e-8)
        integrator.start(0.0, problem.q0, problem.v0)
        with warnings.catch_warnings(record=True, action="always", category=ConstraintWarning) as said:
            try:
                state = integrator.step(beside_singular(angle))
            except RuntimeError:
                continue
        assert said or errors_of_velocities(np.array([state.t]), state.v[:, None], 1e-8)[0] < 1e3


def cranks(n, unit=1.0, torque=0.0):
    """A bar on parallel cranks of 1 m, with lengths in `unit`; the bar only translates."""
    model = PlanarModel(gravity=(0.0, -9.81 * unit))
    model.rod("bar", (0.6 * unit, 0.8 * unit), ((n - 0.4) * unit, 0.8 * unit), mass=2.0)
    for i in range(n):
        model.rod(f"crank {i}", (i * unit, 0.0), ((i + 0.6) * unit, 0.8 * unit), mass=1.0, angular_velocity=-1.0)
        model.revolute("ground", f"crank {i}", at=(i * unit, 0.0))
        model.revolute(f"crank {i}", "bar", at=((i + 0.6) * unit, 0.8 * unit))
    model.torque("crank 0", torque * unit**2)
    return model.problem((0.0, 0.9))


@pytest.mark.filterwarnings("ignore:the constraints of:twoloop.ConstraintWarning")
@pytest.mark.parametrize(("method", "tolerance"), [("RadauIIA9", 5e-10), ("DOP853", 1e-6), slow("RadauIIA5", 3e-10)])
def test_states_beside_a_singular_position_are_those_of_the_polynomial_across_it(method, tolerance):
    """Before, steps that approached the ground line gave the bar a spin."""
    problem = cranks(3)
    result, system = run_problem(problem, 0.5, method=method, rtol=tolerance, atol=tolerance), problem.system
    assert result.success, result.message
    assert np.abs(result.v[2]).max() < 1e-9 and np.abs(result.a[2]).max() < 1e-6
    for t, q, v in zip(result.t, result.q.T, result.v.T, strict=True):
        np.testing.assert_allclose(system.constraint(t, q), 0.0, atol=1e-13)
        np.testing.assert_allclose(system.velocity_constraint(t, q, v), 0.0, atol=1e-12)


@pytest.mark.filterwarnings("ignore:the constraints of:twoloop.ConstraintWarning")
@pytest.mark.parametrize(("unit", "torque"), [(1.0, 50.0), (1e3, 0.0), slow(1e3, 10.0)])
@pytest.mark.parametrize(("method", "tolerance"), [("auto", 1e-4), ("DOP853", 1e-6)])
def test_forces_balance_beside_a_singular_position(method, tolerance, unit, torque):
    """With a torque on one crank, forces of joints grow without bound towards the ground line."""
    problem, atol = cranks(2, unit, torque), tolerance * np.tile([unit, unit, 1.0], 3)
    result, system = run_problem(problem, 0.9, method=method, rtol=tolerance, atol=atol), problem.system
    assert result.success, result.message
    for t, q, v, a, lam in zip(result.t, result.q.T, result.v.T, result.a.T, result.lam.T, strict=True):
        force, reaction = system.force(t, q, v), system.rows(t, q).T @ lam
        allowed = np.tile([1e-5 * np.abs(reaction).max(), 1e-5 * unit * np.abs(reaction).max()], (3, 1))[:, [0, 0, 1]]
        assert (np.abs(system.mass(t, q) @ a + reaction - force) <= allowed.ravel()).all()
