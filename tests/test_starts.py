"""Starts: consistent at every scale and offset, put right where there is one assembly, refused where there are two."""

import copy
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.derivative_cases import UNITS, lever, linkage, slider_crank
from tests.problems import pendulum, pendulum_state, quick, unconstrained, worst
from twoloop import consistent_state, solve_dae
from twoloop.bodies import SpatialModel
from twoloop.checks.consistency import check_start
from twoloop.mechanisms import andrews, bricard, four_bar, heavy_top, n_four_bar, spatial_four_bar

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


@pytest.mark.parametrize("length", quick([1e-9, 1e-3, 1e6, 1e-6, 1.0, 1e3], 3))
@pytest.mark.parametrize("far", [0.0, 3e5])
@pytest.mark.parametrize("angle", [0.3, 0.0])
def test_positions_are_judged_by_the_rod_and_not_by_where_it_hangs(length, far, angle):
    system = rod(length, far * length)
    for part in (0.0, 1e-10, 1e-9):
        assert accepted(system, on_rod(length, far * length, part, angle), REST), part
    for part in (1e-7, 1e-5, 1e-3, 1.0):
        assert not accepted(system, on_rod(length, far * length, part, angle), REST), part


@pytest.mark.parametrize("length", quick([1e-9, 1e-3, 1e6, 1e-6, 1.0, 1e3], 3))
@pytest.mark.parametrize("far", [0.0, 3e5])
def test_velocities_are_judged_by_what_is_fast_there(length, far):
    system, q = rod(length, far * length), on_rod(length, far * length, 0.0, 0.3)
    speed = math.sqrt(9.81 * length)
    along, across = np.array([-math.sin(0.3), math.cos(0.3)]), np.array([math.cos(0.3), math.sin(0.3)])
    for part in (0.0, 1e-10):
        assert accepted(system, q, speed * (along + part * across)), part
        # at a turning point what gravity can bring about counts
        assert accepted(system, q, speed * part * across), part
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


def test_a_guess_near_a_position_without_rank_is_refused():
    flat = np.array([0.5, 0.0, 0.0, 2.0, 0.0, 0.0, 2.5, 0.0, np.pi])  # a parallelogram folded into one line
    system = four_bar((1.0, 2.0, 1.0), 2.0, theta3=2.0).system
    with pytest.raises(ValueError, match=r"does not say on which assembly.*or farther from a dead centre"):
        consistent_state(system, 0.0, flat + 0.01 * np.cos(np.arange(9.0)), np.zeros(9))


@pytest.mark.parametrize("unit", quick(UNITS.values(), 2))
@pytest.mark.parametrize("method", quick(["Adams", "SunRadau5", "DOP853", "PaperIRK"]))
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
    start, tight = (problem.q0, problem.v0), {"rtol": 1e-12, "atol": 1e-12}
    solution = solve_dae(problem.system, (0.0, 1e-3), *start, **tight, dense_output=True).sol
    for t in (1e-9, 1e-7, 1e-4):
        state = solution(t)
        check_start(problem.system, t, state.q, state.v)
        with pytest.raises(ValueError, match="v0 is not consistent"):
            check_start(problem.system, t, state.q, state.v + 1e-7 * problem.system.jacobian(t, state.q)[0])
    v0 = state.v + 1e-7 * problem.system.jacobian(t, state.q)[0]
    assert solve_dae(problem.system, (t, 1e-3), state.q, v0, atol=1e-4).success  # there it is harmless


def off(found, q):
    return float(np.abs(found[0] - q).max())


@pytest.mark.parametrize("make", quick([four_bar, andrews, heavy_top, spatial_four_bar], 3))
def test_mechanisms_a_little_off(make):
    problem, rng = make(), np.random.default_rng(2)
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
    words = "does not say on which assembly.*check_assembly=False. takes the one" + ".*loses rank" * (beside < 1e-3)
    with pytest.raises(ValueError, match=words):
        consistent_state(system, 0.0, rough, rest, keep=[CRANK])
    found = consistent_state(system, 0.0, rough, rest, keep=[CRANK], check_assembly=False)
    assert min(off(found, problem.q0) for problem in problems) < 1e-6
    # a guess that is much nearer to one than that is to the other says which
    near = problems[0].q0 + 1e-3 * (rough - problems[0].q0) * np.sqrt(beside)
    assert off(consistent_state(system, 0.0, near, rest, keep=[CRANK]), problems[0].q0) < 1e-3


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


# --- starts next to where entries of C_q vanish by the position alone, as of bars beside upright: no error hides there
def test_velocities_are_judged_beside_what_rounding_of_the_positions_makes_of_them():
    """Forty parallel bars a little away from where an entry of C_q of each vanishes."""
    system, refused = n_four_bar(40).system, []
    along = np.arange(41.0)
    for angle in np.geomspace(1e-8, 1e-4, 80).tolist():
        q = np.column_stack([along + np.sin(angle), np.full(41, np.cos(angle))]).ravel()
        v = np.tile([np.cos(angle), -np.sin(angle)], 41)
        try:
            check_start(system, 0.0, q, v, derivatives=False)
        except ValueError as error:
            refused.append(str(error))
        v[1::2] += 1e-7 * np.cos(along)  # along the bars
        with pytest.raises(ValueError, match="v0 is not consistent"):
            check_start(system, 0.0, q, v, derivatives=False)
    assert not refused


def hanging(angle, wrong=1.0):
    """Three points one below the other on rods of 1 m, next to upright; gamma may be wrong in its vertical terms."""

    def parts(x):
        return np.diff(np.vstack([np.zeros(2), x.reshape(3, 2)]), axis=0)

    def jacobian(t, q):
        rows, d = np.zeros((3, 3, 2)), parts(q)
        for i in range(3):
            rows[i, i] = d[i]
            rows[i, i - 1] -= d[i] if i > 0 else 0.0
        return rows.reshape(3, 6)

    system = unconstrained(
        lambda t, q, v: np.tile([0.0, -9.81], 3),
        6,
        n_c=3,
        constraint=lambda t, q: 0.5 * (parts(q) ** 2).sum(axis=1) - 0.5,
        jacobian=jacobian,
        gamma=lambda t, q, v: -(parts(v) ** 2) @ np.array([1.0, wrong]),
    )
    down = np.array([math.sin(angle), -math.cos(angle)])
    below = np.arange(1.0, 4.0)[:, None]
    return system, (below * down).ravel(), (below * [-down[1], down[0]]).ravel()


@pytest.mark.parametrize("angle", quick([0.0, 1e-9, 1e-6, 0.3, 1e-11, 1e-8, 1e-4, 1e-2], 4))
def test_what_vanishes_by_the_position_alone_hides_no_error(angle):
    system, q, v = hanging(angle)
    assert accepted(system, q, v)
    for off in (1e-6, 1e-3, 1.0):
        assert not accepted(system, q, v + off * q)  # along the rods
        assert not accepted(system, (1.0 + off) * q, v)
    for wrong in (1.01, 2.0):
        with pytest.raises(ValueError, match="gamma of"):
            check_start(hanging(angle, wrong)[0], 0.0, q, v)


@pytest.mark.parametrize("turned", quick([1e-9, 1e-7, 1e-5, 1e-3]))
def test_an_inertia_that_is_rounding_of_zero_makes_no_velocity_consistent(turned):
    """Euler parameters have one in the direction of their norm, and rounding may leave M an inverse of 1e16."""
    random = np.random.default_rng(8)
    for _ in range(12):  # which M has an inverse then hangs on the processor
        model, end = SpatialModel(name="rod"), (0.5, 0.0, 0.0) + turned * random.standard_normal(3)
        model.rod("rod", (0.0, 0.0, 0.0), tuple(end), mass=1.0, radius=0.05)
        model.spherical("ground", "rod", at=(0.0, 0.0, 0.0))
        problem = model.problem(t_span=(0.0, 1.0))
        assert accepted(problem.system, problem.q0, problem.v0)
        for row in problem.system.jacobian(0.0, problem.q0):
            assert not accepted(problem.system, problem.q0, problem.v0 + 1e-3 * row)


def test_a_mass_array_is_constant_and_copied():
    matrix = np.eye(2)
    system = pendulum(mass=matrix)
    matrix[:] = 0.0
    assert system.constant_mass and (system.mass(0.0, np.zeros(2)) == np.eye(2)).all()


@given(st.lists(st.floats(-0.1, 0.1), min_size=9, max_size=9), st.lists(st.floats(-3, 3), min_size=9, max_size=9))
def test_a_guess_is_projected_and_can_be_started_from(shift, speeds):
    problem = four_bar()
    q, v = consistent_state(problem.system, 0.0, problem.q0 + shift, speeds)
    assert np.abs(problem.system.constraint(0.0, q)).max() < 1e-13
    assert np.abs(problem.system.velocity_constraint(0.0, q, v)).max() < 1e-12 and worst(q, problem.q0) < 1.0
    assert solve_dae(problem.system, (0.0, 0.01), q, v).success


def test_what_cannot_be_projected_says_how_far_it_is():
    empty = pendulum(
        constraint=lambda t, q: np.array([q @ q + 1.0]), jacobian=lambda t, q: 2.0 * q[None, :]
    )  # no real position at all
    with pytest.raises(ValueError, match=r"q cannot be projected.*'pendulum'.*max\|C\| is .*nearer"):
        consistent_state(empty, 0.0, [1.0, 1.0], [0.0, 0.0])


def bead(**changed):
    """A bead of mass p[0] on a circle of radius p[1]."""
    functions = {
        "mass": lambda t, q, p: np.array([[p[0], 0.0], [0.0, p[0]]]),
        "force": lambda t, q, v, p: np.array([0.0, -9.81 * p[0]]),
        "constraint": lambda t, q, p: np.array([0.5 * (q[0] * q[0] + q[1] * q[1] - p[1] * p[1])]),
    }
    return pendulum(**{"gamma": False, "parameters": [2.0, 1.0], **functions, **changed})


@pytest.mark.parametrize("compile", [False, pytest.param(True, marks=pytest.mark.slow)])  # those of ensembles do, too
def test_plain_functions_take_parameters_last(compile):
    system = bead(compile=compile)
    other = system.with_parameters([2.0, 0.5])
    assert system.parameters.tolist() == [2.0, 1.0] and other.parameters.tolist() == [2.0, 0.5]
    for each, radius in ((system, 1.0), (other, 0.5), (copy.deepcopy(other), 0.5)):
        result = solve_dae(each, (0.0, 1.0), [radius, 0.0], [0.0, 0.0], rtol=1e-9, atol=1e-9)
        expected = pendulum_state(np.sqrt(1.0 / radius), angle=0.5 * np.pi)[0]
        assert result.success and np.allclose(result.q[:, -1], radius * expected, atol=1e-7) and result.system is each
    assert other.functions[:3] == system.functions[:3]  # nothing is compiled again


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
