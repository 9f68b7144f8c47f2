"""Lobatto16: its coefficients, and what attacks on it found."""

import numpy as np
import pytest

from tests.problems import quick
from twoloop import ConstrainedSystem, ConstraintWarning, solve_dae
from twoloop.bodies import PlanarModel
from twoloop.generate import collocation_code
from twoloop.mechanisms import four_bar, spatial_four_bar


def free(force, n=1):
    """A system of n coordinates without constraints, of unit mass."""
    return ConstrainedSystem.from_python(n_q=n, n_c=0, mass=np.eye(n), force=force)


def end(system, t_end, q0, v0=None, **options):
    v0 = np.zeros(len(q0)) if v0 is None else v0
    result = solve_dae(system, (0.0, t_end), np.array(q0), np.array(v0), **options)
    assert result.success, result.message
    return result


@pytest.mark.parametrize("degree", range(9))
def test_the_coefficients_are_exact_for_polynomials(degree):
    tables = collocation_code.tables()
    values = np.concatenate([[0.0], tables.nodes]) ** degree
    once, twice = degree + 1, (degree + 1) * (degree + 2)
    for name, x in (("", tables.nodes), ("_between", tables.between)):
        integrals = {"velocities": x ** (degree + 1) / once, "positions": x ** (degree + 2) / twice}
        for kind, integral in integrals.items():
            assert np.abs(values @ getattr(tables, kind + name) - integral).max() < 1e-14
    assert np.abs(values @ tables.values_between - tables.between**degree).max() < 1e-13
    expansion = values @ tables.end  # about the end: (1 + x)^degree
    x = np.linspace(-1.0, 1.0, 7)
    sums = 1.0 + sum(c * x ** (k + 1) for k, c in enumerate(expansion))
    assert np.abs(sums - (1.0 + x) ** degree).max() < 1e-9


def test_at_the_end_of_the_step_integrals_are_exact_to_degree_15():
    tables = collocation_code.tables()
    nodes = np.concatenate([[0.0], tables.nodes])
    for degree in range(16):
        assert abs(nodes**degree @ tables.velocities[:, -1] - 1.0 / (degree + 1)) < 1e-14


SHARP = {  # forces whose corners and peaks the first estimate of the error did not see
    "soft stop": lambda t, q, v: -q - 3.0 * (q + np.sqrt(q * q + 1.0)),
    "softer": lambda t, q, v: -q - 3.0 * (q + np.sqrt(q * q + 0.01)),
    "peak": lambda t, q, v: -q + 0.3 / (1.0 + 9.0 * (q - 0.5) ** 2),
    "drag": lambda t, q, v: -q - 0.1 * v * np.sqrt(v * v) + np.cos(0.7 * t),
}


@pytest.mark.parametrize("name", quick(SHARP, 2))
@pytest.mark.parametrize("tolerance", [1e-5, 1e-8])
def test_errors_over_corners_and_peaks_are_those_of_other_methods(name, tolerance):
    system = free(SHARP[name])
    exact = end(system, 60.0, [1.0], method="DOP853", rtol=1e-12, atol=1e-12).q[0, -1]
    other = abs(end(system, 60.0, [1.0], method="DOP853", rtol=tolerance, atol=tolerance).q[0, -1] - exact)
    own = abs(end(system, 60.0, [1.0], method="Lobatto16", rtol=tolerance, atol=tolerance).q[0, -1] - exact)
    assert own < 10.0 * other + 100.0 * tolerance


@pytest.mark.parametrize("atol", quick([[1.0, 1e-10], [1e-2, 1e-10], [1e3, 1e-6]]))
def test_what_follows_from_a_coordinate_of_loose_tolerance_keeps_its_own(atol):
    """The first coordinate is iterated, and the second follows from it alone."""
    system = free(lambda t, q, v: np.array([-9.81 * np.sin(q[0]), 5.0 * np.sin(3.0 * q[0])]), 2)
    options = {"rtol": 1e-12, "atol": np.array(atol)}
    exact = end(system, 10.0, [2.0, 0.0], rtol=1e-12, atol=1e-12).q[1, -1]
    found = end(system, 10.0, [2.0, 0.0], method="Lobatto16", **options).q[1, -1]
    assert abs(found - exact) < 1e3 * atol[1]


@pytest.mark.parametrize("atol", [[1e-300, 1e-3], [1e-30, 1e-30]])
def test_tolerances_that_are_relative_serve_at_rest(atol):
    system = free(lambda t, q, v: np.array([-9.81 * np.sin(q[0]), -q[1]]), 2)
    found = end(system, 5.0, [1.0, 1.0], rtol=1e-6, atol=np.array(atol))
    exact = end(system, 5.0, [1.0, 1.0], rtol=1e-11, atol=1e-11)
    assert np.abs(found.q[:, -1] - exact.q[:, -1]).max() < 1e-3


STIFF = {
    "damped": (lambda t, q, v: -1e3 * v - 0.1 * q, 50.0),
    "held": (lambda t, q, v: -1e6 * (q - np.sin(t)) - 2e3 * v, 10.0),
    "friction": (lambda t, q, v: -9.81 * np.sin(q) - 2.0 * v / np.sqrt(v * v + 1e-4), 10.0),
}


@pytest.mark.parametrize("name", STIFF)
@pytest.mark.parametrize("tolerance", quick([1e-6, 1e-3, 1e-9]))
def test_stiff_motion_is_left_to_newton(name, tolerance):
    force, t_end = STIFF[name]
    assert len(end(free(force), t_end, [1.0], rtol=tolerance, atol=tolerance).h) < 700


def test_fast_rotation_takes_few_sweeps():
    """Velocities limit the convergence, so that each sweep evaluates accelerations twice; else there are 446 sweeps."""
    system = free(lambda t, q, v: np.array([60.0 * v[1] - q[0], -60.0 * v[0] - q[1]]), 2)
    exact = end(system, 2.0, [1.0, 0.5], [0.0, 3.0], method="DOP853", rtol=1e-12, atol=1e-12)
    result = end(system, 2.0, [1.0, 0.5], [0.0, 3.0], method="Lobatto16", rtol=1e-5, atol=1e-5)
    assert result.stats.n_outer < 340 and np.abs(result.q[:, -1] - exact.q[:, -1]).max() < 1e-5


@pytest.mark.parametrize("step_size", [0.05, 0.5])
def test_a_fixed_step_that_does_not_converge_ends_the_run(step_size):
    problem = four_bar()
    result = solve_dae(problem.system, (0.0, 1.0), problem.q0, problem.v0, method="Lobatto16", step_size=step_size)
    assert result.success == (step_size < 0.1) and np.all(np.isfinite(result.q))


def test_fixed_steps_are_of_high_order():
    problem = four_bar()
    run = problem.system, (0.0, 2.0), problem.q0, problem.v0
    exact = solve_dae(*run, rtol=1e-13, atol=1e-13).q[:, -1]
    errors = [np.abs(solve_dae(*run, method="Lobatto16", step_size=h).q[:, -1] - exact).max() for h in (0.1, 0.05)]
    assert errors[1] < errors[0] / 2.0**8


def test_between_steps_of_a_system_without_constraints():
    """Where nothing but the steps says where the motion goes."""
    system, t = free(lambda t, q, v: -9.81 * np.sin(q)), np.linspace(0.0, 10.0, 301)
    exact = end(system, 10.0, [1.0], method="DOP853", rtol=1e-12, atol=1e-12, t_eval=t)
    for tolerance in (1e-3, 1e-6, 1e-9):
        found = end(system, 10.0, [1.0], rtol=tolerance, atol=tolerance, t_eval=t)
        assert np.abs(found.q - exact.q).max() < 10.0 * tolerance
        assert np.abs(found.v - exact.v).max() < 100.0 * tolerance
    events = [lambda t, q, v: q[0]]
    crossings = end(system, 10.0, [1.0], rtol=1e-3, atol=1e-3, events=events).t_events[0]
    assert len(crossings) == len(end(system, 10.0, [1.0], method="DOP853", events=events).t_events[0])


def test_steps_do_not_depend_on_how_many_are_asked_for():
    """Ends of steps in a row are put on the constraints together: which of them is a matter of the run alone."""
    problem = four_bar()
    run = problem.system, (0.0, 5.0), problem.q0, problem.v0
    whole = solve_dae(*run)
    for n in (1, 7, 8, 13):
        part = solve_dae(*run, max_steps=n)
        assert np.array_equal(part.q, whole.q[:, : n + 1]) and np.array_equal(part.lam, whole.lam[:, : n + 1])


@pytest.mark.parametrize("make", [four_bar, spatial_four_bar])
def test_states_in_a_row_are_on_the_constraints(make):
    problem = make()
    result = solve_dae(problem.system, problem.t_span, problem.q0, problem.v0, method="Lobatto16", rtol=1e-4, atol=1e-4)
    for t, q, v in zip(result.t, result.q.T, result.v.T, strict=True):
        assert np.abs(problem.system.constraint(t, q)).max() < 1e-12
        assert np.abs(problem.system.jacobian(t, q) @ v).max() < 1e-11 * (1.0 + np.abs(v).max())


def two_rods(angle):
    """A slider-crank with two rods between the same pins: either row of the second one's end is redundant."""
    pin = np.array([0.5 * np.cos(angle), 0.5 * np.sin(angle)])
    end = np.array([pin[0] + np.sqrt(1.2**2 - pin[1] ** 2), 0.0])
    model = PlanarModel(name="slider-crank, two rods")
    model.rod("crank", (0.0, 0.0), pin, mass=1.0, angular_velocity=8.0)
    model.body("slider", mass=0.8, inertia=0.02, position=end)
    model.revolute("ground", "crank", at=(0.0, 0.0))
    for name in ("rod", "second rod"):
        model.rod(name, pin, end, mass=1.0)
        model.revolute("crank", name, at=pin)
        model.revolute(name, "slider", at=end)
    model.prismatic("ground", "slider", at=end, axis=(1.0, 0.0))
    return model.problem((0.0, 5.0))


@pytest.mark.parametrize("angle", quick([0.5, 0.2, 2.0, 4.0]))
def test_the_rows_that_count_stay_independent_at_dead_centres(angle):
    """With the row along the rods, these would depend on one another where the crank and the rods are in line."""
    problem = two_rods(angle)
    run = problem.system, problem.t_span, problem.q0, problem.v0
    with pytest.warns(ConstraintWarning, match="have rank 11 of 12"):
        exact = solve_dae(*run, method="DOP853", rtol=1e-11, atol=1e-11)
    for tolerance in (1e-4, 1e-7, 1e-10):
        with pytest.warns(ConstraintWarning, match="have rank 11 of 12"):
            result = solve_dae(*run, rtol=tolerance, atol=tolerance)
        assert result.success and result.stats.n_rejected_convergence == 0
        assert np.abs(result.q[:, -1] - exact.q[:, -1]).max() < 100.0 * tolerance


def test_without_code_it_says_so():
    problem = four_bar()
    run = problem.system, (0.0, 1.0), problem.q0, problem.v0
    with pytest.raises(ValueError, match=r"needs code made for .* given compiled=False"):
        solve_dae(*run, method="Lobatto16", compiled=False)
    branches = free(lambda t, q, v: -q if q[0] > 0.0 else -2.0 * q)
    with pytest.raises(ValueError, match=r"cannot be had; .* Take method='auto'"):
        solve_dae(branches, (0.0, 1.0), np.ones(1), np.zeros(1), method="Lobatto16")


def test_a_coordinate_at_rest_whose_tolerance_is_relative_does_not_end_the_run():
    """Tolerances of a coordinate that stays zero are none at all: another method goes on."""
    problem = four_bar()
    run = problem.system, (0.0, 1.0), problem.q0, problem.v0
    result, exact = solve_dae(*run, rtol=1e-6, atol=1e-30), solve_dae(*run, rtol=1e-11, atol=1e-11)
    assert result.success, result.message
    assert np.abs(result.q[:, -1] - exact.q[:, -1]).max() < 1e-4


def test_between_long_steps_over_a_soft_stop():
    """The force has rounding errors of its own there, above those to which parts of a step are iterated."""
    A, w, c = 20.52135, 0.00212, 0.29102
    system = free(lambda t, q, v: -A / w * (q - c + np.sqrt((q - c) ** 2 + w * w)) - 0.1 * q - 0.057 * v)
    t, start = np.linspace(0.0, 20.0, 801), ([0.108], [-0.179])
    exact = end(system, 20.0, *start, method="DOP853", rtol=1e-12, atol=1e-12, t_eval=t)
    for tolerance in (1e-6, 1e-9):
        found = end(system, 20.0, *start, rtol=tolerance, atol=tolerance, t_eval=t)
        assert np.abs(found.q - exact.q).max() < 100.0 * tolerance
