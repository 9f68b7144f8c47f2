"""Starts: consistent at every scale and offset, put right where there is one assembly, refused where there are two."""

import itertools
import math
import re

import numpy as np
import pytest

from tests.derivative_cases import UNITS, lever, linkage, slider_crank
from tests.problems import pendulum, unconstrained, worst
from twoloop import ConstraintWarning, consistent_state, solve_dae
from twoloop.checks.consistency import check_start
from twoloop.mechanisms import (
    andrews,
    bricard,
    four_bar,
    heavy_top,
    n_four_bar,
    spatial_four_bar,
    spatial_slider_crank,
)

REST = np.zeros(2)
STRETCHED = math.acos(0.25)  # theta_3 at which bars 1 and 2 of this linkage are in line
CRANK = 8


def rod(length, offset=0.0):
    """A pendulum of any length whose pivot may be far away."""
    return pendulum(
        constant_mass=True,
        constraint=lambda t, q: np.array([0.5 * ((q[0] - offset) ** 2 + q[1] ** 2 - length**2)]),
        jacobian=lambda t, q: np.array([[q[0] - offset, q[1]]]),
    )


def on_rod(length, offset, part, angle):
    return np.array([offset + length * (1.0 + part) * math.cos(angle), length * (1.0 + part) * math.sin(angle)])


def accepted(system, q, v):
    try:
        check_start(system, 0.0, np.asarray(q, dtype=float), np.asarray(v, dtype=float))
    except ValueError as error:
        assert "is not consistent" in str(error)
        return False
    return True


@pytest.mark.parametrize("length", [1e-9, 1e-6, 1e-3, 1.0, 1e3, 1e6])
@pytest.mark.parametrize("far", [0.0, 3e5])
@pytest.mark.parametrize("angle", [0.3, 0.0])
def test_positions_are_judged_by_the_rod_and_not_by_where_it_hangs(length, far, angle):
    system = rod(length, far * length)
    for part in (0.0, 1e-10, 1e-9):
        assert accepted(system, on_rod(length, far * length, part, angle), REST), part
    for part in (1e-7, 1e-5, 1e-3, 1.0):
        assert not accepted(system, on_rod(length, far * length, part, angle), REST), part


@pytest.mark.parametrize("length", [1e-9, 1e-6, 1e-3, 1.0, 1e3, 1e6])
@pytest.mark.parametrize("far", [0.0, 3e5])
def test_velocities_are_judged_by_what_is_fast_there(length, far):
    system, q = rod(length, far * length), on_rod(length, far * length, 0.0, 0.3)
    speed = math.sqrt(9.81 * length)
    along, across = np.array([-math.sin(0.3), math.cos(0.3)]), np.array([math.cos(0.3), math.sin(0.3)])
    for part in (0.0, 1e-10):
        assert accepted(system, q, speed * (along + part * across)), part
        assert accepted(system, q, speed * part * across), (
            part
        )  # at a turning point: what gravity can bring about counts
    for part in (1e-6, 1e-3):
        assert not accepted(system, q, speed * (along + part * across)), part


@pytest.mark.parametrize(
    "case",
    [slider_crank(unit) for unit in UNITS.values()]
    + [slider_crank(1.0, offset=3e5), lever(1e-6, 1e3), lever(1e-3, 1.0), linkage(1e-3)],
    ids=lambda case: case.name,
)
def test_every_coordinate_counts_in_its_own_unit(case):
    system, q = case.system(), np.array(case.q)
    rest = np.zeros(case.n_q)
    assert accepted(system, q, rest)
    for j in range(case.n_q):
        size = min(abs(q[j]), 100.0)
        for part, fine in ((1e-13, True), (1e-6, False), (1e-3, False)):
            moved = q.copy()
            moved[j] += part * size
            assert accepted(system, moved, rest) == fine, (j, part)


def test_redundant_rows_name_what_they_depend_on():
    rows = np.array([[1.0, 0.0, 0.0], [0.0, 1e-3, 0.0], [2.0, -0.5e-3, 0.0]])
    functions = {"constraint": lambda t, q: rows @ q, "jacobian": lambda t, q: rows}
    system = unconstrained(lambda t, q, v: np.zeros(3), 3, n_c=3, **functions)
    with pytest.warns(ConstraintWarning, match=r"rank 2 of 3.*row\(s\) \[\d\] depend on the others \(row ") as caught:
        solve_dae(system, (0.0, 1.0), np.zeros(3), np.zeros(3))
    equations = ("row 2 = 2 row 0 - 0.5 row 1", "row 1 = 4 row 0 - 2 row 2", "row 0 = 0.25 row 1 + 0.5 row 2")
    assert any(equation in str(caught[0].message) for equation in equations)


# --- consistent_state
def test_a_kept_crank_keeps_its_angle_and_its_speed():
    problem = four_bar(theta3=0.4)
    guess = problem.q0 + 0.02 * np.sin(np.arange(9.0))
    speeds = np.zeros(9)
    speeds[CRANK] = 10.0
    q, v = consistent_state(problem.system, 0.0, guess, speeds, keep=[CRANK])
    assert q[CRANK] == guess[CRANK] and v[CRANK] == 10.0 and np.abs(problem.system.constraint(0.0, q)).max() < 1e-14
    assert np.abs(problem.system.velocity_constraint(0.0, q, v)).max() < 1e-13
    free = consistent_state(problem.system, 0.0, guess, speeds)[1]
    assert abs(free[CRANK] - 10.0) > 0.5  # without keep it changes


def test_it_says_how_far_it_moved():
    state = consistent_state(pendulum(), 0.0, [0.6, -0.7], [1.0, 0.0], keep=[0])
    q, v = state
    assert len(state) == 2 and worst(q, [0.6, -0.8]) < 1e-15 and worst(v, [1.0, 0.75]) < 1e-15
    assert state.moved_q.coordinate == state.moved_v.coordinate == 1 and abs(state.moved_q.change + 0.1) < 1e-15
    assert abs(state.moved_v.change - 0.75) < 1e-15
    still = consistent_state(pendulum(), 0.0, q, v)
    assert max(abs(still.moved_q.change), abs(still.moved_v.change)) < 1e-15


@pytest.mark.parametrize("theta3", [0.0, 0.4, 1.0])
def test_the_sign_tells_the_two_assemblies_apart(theta3):
    states = []
    for branch in (-1, 1):
        problem = four_bar(theta3=theta3, branch=branch)
        states.append(consistent_state(problem.system, 0.0, problem.q0, problem.v0, keep=[CRANK]))
    assert states[0].dependent == states[1].dependent == tuple(range(8))
    assert states[0].determinant_sign == -states[1].determinant_sign != 0
    assert min(state.margin for state in states) > 0.01


def test_a_guess_near_a_position_without_rank_is_refused():
    flat = np.array([0.5, 0.0, 0.0, 2.0, 0.0, 0.0, 2.5, 0.0, np.pi])  # a parallelogram folded into one line
    system = four_bar((1.0, 2.0, 1.0), 2.0, theta3=2.0).system
    with pytest.raises(ValueError, match=r"does not say on which assembly.*or farther from a dead centre"):
        consistent_state(system, 0.0, flat + 0.01 * np.cos(np.arange(9.0)), np.zeros(9))


@pytest.mark.parametrize("keep", [[2, 8], range(9)])
def test_keeping_too_much_is_refused(keep, default_four_bar):
    problem = default_four_bar
    with pytest.raises(ValueError, match=r"keep leaves too little freedom.*rank \d of 8"):
        consistent_state(problem.system, 0.0, problem.q0, np.arange(9.0), keep=keep)
    # what is consistent needs no freedom
    q, v = consistent_state(problem.system, 0.0, problem.q0, problem.v0, keep=keep)
    assert (q == problem.q0).all() and (v == problem.v0).all()


@pytest.mark.parametrize("unit", UNITS.values())
@pytest.mark.parametrize("method", ["SunRadau5", "DOP853", "Adams", "PaperIRK"])
def test_every_state_of_a_run_is_a_start(unit, method):
    problem = four_bar((unit, 2.0 * unit, 1.5 * unit), 3.0 * unit)
    end = 2.0 * math.sqrt(unit)
    times = np.linspace(0.0, end, 11)
    result = solve_dae(problem.system, (0.0, end), problem.q0, problem.v0, method, 1e-3, 1e-3 * unit, t_eval=times)
    assert result.success
    for t, q, v in zip(result.t, result.q.T, result.v.T, strict=True):
        check_start(problem.system, t, q, v)


def test_velocities_off_by_rounding_of_the_fastest_are_no_violation_and_larger_ones_are():
    """Beside a singular position, where a row moves by next to nothing and a correction is many times what is off."""
    problem = n_four_bar(1)
    solution = solve_dae(
        problem.system, (0.0, 1e-3), problem.q0, problem.v0, rtol=1e-12, atol=1e-12, dense_output=True
    ).sol
    for t in (1e-9, 1e-7, 1e-4):
        state = solution(t)
        check_start(problem.system, t, state.q, state.v)
        with pytest.raises(ValueError, match="v0 is not consistent"):
            check_start(problem.system, t, state.q, state.v + 1e-7 * problem.system.jacobian(t, state.q)[0])


# --- guesses that are a little off


def off(found, q):
    return float(np.abs(found[0] - q).max())


MECHANISMS = {
    "four-bar": four_bar,
    "andrews": andrews,
    "top": heavy_top,
    "spatial four-bar": spatial_four_bar,
    "spatial slider-crank": spatial_slider_crank,
}


@pytest.mark.parametrize("name", MECHANISMS)
def test_mechanisms_a_little_off(name):
    problem, rng = MECHANISMS[name](), np.random.default_rng(2)
    t = problem.t_span[0]
    for disturbed in (1e-8, 1e-6, 1e-5):
        for _ in range(5):
            size = disturbed * max(float(np.median(np.abs(problem.q0))), 1e-2)
            guess = problem.q0 + size * rng.uniform(-1.0, 1.0, problem.q0.size)
            assert off(consistent_state(problem.system, t, guess, problem.v0), problem.q0) < 1e3 * size


@pytest.mark.parametrize("mechanism", [bricard, lambda: n_four_bar(3)], ids=["bricard", "n_four_bar"])
def test_rounding_that_exceeds_what_counts_as_converged_is_no_failure(mechanism):
    problem = mechanism()
    rng, system = np.random.default_rng(2), problem.system
    for disturbed in (1e-8, 1e-7, 1e-6, 1e-5):
        guess = problem.q0 + disturbed * rng.uniform(-1.0, 1.0, system.n_q)
        assert off(consistent_state(system, 0.0, guess, problem.v0), problem.q0) < 10.0 * disturbed


@pytest.mark.parametrize("beside", [1e-3, 1e-4, 1e-6])
def test_two_assemblies_within_reach_are_refused_unless_one_says_otherwise(beside):
    problems = [four_bar((0.8, 1.2, 1.0), 2.0, theta3=STRETCHED - beside, branch=branch) for branch in (-1, 1)]
    rough = problems[0].q0 + 0.02 * np.array([1.0, -1.0, 0.5, 1.0, 0.3, -1.0, 0.2, 0.4, 0.0])
    rest, system = np.zeros(9), problems[0].system
    assert consistent_state(system, 0.0, problems[0].q0, rest, keep=[CRANK]).margin < 0.1  # known well enough
    words = "does not say on which assembly.*check_assembly=False takes the one" + ".*loses rank" * (beside < 1e-3)
    with pytest.raises(ValueError, match=words):
        consistent_state(system, 0.0, rough, rest, keep=[CRANK])
    found = consistent_state(system, 0.0, rough, rest, keep=[CRANK], check_assembly=False)
    assert min(off(found, problem.q0) for problem in problems) < 1e-6
    # a guess that is much nearer to one than that is to the other says which
    near = problems[0].q0 + 1e-3 * (rough - problems[0].q0) * np.sqrt(beside)
    assert off(consistent_state(system, 0.0, near, rest, keep=[CRANK]), problems[0].q0) < 1e-3


@pytest.mark.parametrize("beside", [0.3, 1e-2, 1e-4, 1e-6])
def test_loss_of_rank_is_said_where_it_is_so(beside):
    problems = [four_bar((0.8, 1.2, 1.0), 2.0, theta3=STRETCHED - beside, branch=branch) for branch in (-1, 1)]
    between = 0.52 * problems[0].q0 + 0.48 * problems[1].q0
    with pytest.raises(ValueError, match="q ") as caught:
        consistent_state(problems[0].system, 0.0, between, np.zeros(9), keep=[CRANK])
    said = re.search(r"nearly loses rank.*smallest singular value is (\S+) of the largest", str(caught.value))
    values = [
        np.linalg.svd(problems[0].system.jacobian(0.0, q)[:, :CRANK], compute_uv=False)
        for q in (between, problems[0].q0, problems[1].q0)
    ]
    least = min(value[-1] / value[0] for value in values)
    assert said is None or (float(said[1]) < 0.01 and least < 0.01)
    if beside <= 1e-6:
        assert said is not None


def test_runs_say_what_was_measured_where_steps_went_across():
    said = []
    for n, method, tolerance in itertools.product((1, 2), ("auto", "DOP853", "Taylor"), (1e-5, 1e-7, 1e-8)):
        problem = n_four_bar(n)  # which runs go across hangs on rounding
        run = problem.system, (0.0, 2.0), problem.q0, problem.v0, method, tolerance, tolerance
        message = solve_dae(*run, compiled=False).message
        for part in re.findall(r"Near t = [^(]*\([^)]*\)", message):
            said.append((float(re.search(r"comes down to (\S+) of the largest", part)[1]), "lose rank" in part))
    assert said
    assert all(ratio <= 0.01 if lost else ratio >= 0.01 for ratio, lost in said), said


def test_a_state_of_a_solution_starts_a_run_where_constraints_are_differences_of_large_terms():
    """Their rounding is beyond that of what their derivatives multiply; a start that is off is refused all the same."""
    problem = n_four_bar(40)
    system, options = problem.system, {"rtol": 1e-12, "atol": 1e-12, "dense_output": True}
    solution = solve_dae(system, (0.0, 1e-3), problem.q0, problem.v0, **options).sol
    off = 1e-7 * np.random.default_rng(7).standard_normal(system.n_q)
    for t in np.geomspace(1e-7, 9e-4, 8).tolist():
        state = solution(t)
        check_start(system, t, state.q, state.v, derivatives=False)
        with pytest.raises(ValueError, match="not consistent"):
            check_start(system, t, state.q + off, state.v, derivatives=False)
