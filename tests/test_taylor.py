"""The Taylor series of the motion: every operation that it knows, every kind of mechanism, and what it refuses."""

import math

import numpy as np
import pytest

from tests.large_systems import spatial_chain
from tests.problems import quick, unconstrained
from twoloop import Taylor, mechanisms, solve_dae
from twoloop.bodies import PlanarModel

FORCES = {
    "sine and cosine": lambda t, q, v: math.sin(q) * math.cos(2.0 * q),
    "tangent": lambda t, q, v: -math.tan(0.3 * q),
    "square root": lambda t, q, v: -math.sqrt(1.0 + q * q),
    "hypot": lambda t, q, v: -math.hypot(q, v),
    "exponential": lambda t, q, v: -math.exp(0.5 * q),
    "logarithm": lambda t, q, v: -math.log(3.0 + q),
    "arctangent": lambda t, q, v: -math.atan(2.0 * q),
    "hyperbolic": lambda t, q, v: -math.sinh(0.3 * q) + 0.1 * math.cosh(0.2 * v) - math.tanh(q),
    "quotient": lambda t, q, v: (1.0 - q) / (4.0 + q + v),
    "powers": lambda t, q, v: -(q**3) + (5.0 + q) ** -2 - 0.1 * (4.0 + q) ** 2.5 + 0.01 * (4.0 + v) ** 1.7,
    "time": lambda t, q, v: -q + math.sin(3.0 * t) / (1.0 + 0.1 * t * t),
    "velocity": lambda t, q, v: -q - 0.2 * v * v * math.sin(v),
}


def one_coordinate(law):
    return unconstrained(lambda t, q, v: np.array([law(t, q[0], v[0])]), name="one coordinate")


@pytest.mark.parametrize("name", quick(FORCES, 4))
def test_every_operation_gives_the_motion_of_another_method(name):
    system = one_coordinate(FORCES[name])
    ends = [
        solve_dae(system, (0.0, 2.0), [0.4], [0.7], method, 1e-12, 1e-12).q[0, -1]
        for method in ("Taylor", Taylor(order=11), "DOP853")
    ]
    assert abs(ends[0] - ends[2]) < 1e-10 and abs(ends[1] - ends[2]) < 1e-10


PROBLEMS = {
    "loop": (mechanisms.four_bar, 1e-10),
    "varying mass": (mechanisms.andrews, 1e-9),
    "redundant rows": (mechanisms.redundant_slider_crank, 1e-9),
    "60 rows of rank 59": (mechanisms.bricard, 1e-10),
    "drive": (mechanisms.driven_crank, 1e-10),
    "singular mass": (mechanisms.heavy_top, 1e-9),
    "non-holonomic row": (mechanisms.knife_edge, 1e-10),
    "both kinds of row": (mechanisms.rolling_disc, 1e-10),
    "spatial loop": (mechanisms.spatial_four_bar, 1e-10),
}


@pytest.mark.filterwarnings("ignore::twoloop.ConstraintWarning")
@pytest.mark.parametrize("name", quick(PROBLEMS, 3))
def test_every_kind_of_mechanism_ends_at_its_reference(name):
    make, allowed = PROBLEMS[name]
    problem = make()
    known = problem.reference
    result = solve_dae(problem.system, (0.0, known.t), problem.q0, problem.v0, "Taylor", 1e-12, 1e-12)
    assert result.success, result.message
    assert np.nanmax(np.abs(result.q[:, -1] - known.q)) < allowed
    for t, q in zip(result.t, result.q.T, strict=True):
        assert np.abs(problem.system.constraint(t, q)).max(initial=0.0) < 1e-12
    balance = problem.system.mass(known.t, result.q[:, -1]) @ result.a[:, -1]
    balance += problem.system.rows(known.t, result.q[:, -1]).T @ result.lam[:, -1]
    force = problem.system.force(known.t, result.q[:, -1], result.v[:, -1])
    assert np.abs(balance - force).max() < 1e-9 * max(1.0, np.abs(force).max())


@pytest.mark.parametrize("compiled", [False, True])
def test_a_sum_of_parameters_that_is_zero_in_one_system_alone_is_divided_by_in_no_formula(compiled):
    """Formulas in the parameters of all chains divide by a sum of components of axes, which is zero here."""
    system, q, v = spatial_chain(1)
    runs = [solve_dae(system, (0.0, 0.3), q, v, m, 1e-9, 1e-9, compiled=compiled) for m in ("Taylor", "DOP853")]
    assert all(run.success for run in runs) and np.abs(runs[0].q[:, -1] - runs[1].q[:, -1]).max() < 1e-7


@pytest.mark.parametrize("compiled", [False, True])
def test_the_error_follows_the_tolerance(compiled):
    problem = mechanisms.four_bar()
    start = problem.system, (0.0, 10.0), problem.q0, problem.v0, "Taylor"
    for tolerance in (1e-4, 1e-6, 1e-8, 1e-10, 1e-12):
        result = solve_dae(*start, tolerance, tolerance, compiled=compiled)
        assert np.abs(result.q[:, -1] - problem.reference.q).max() < 5.0 * tolerance


def test_a_callback_that_branches_is_refused_by_name_and_auto_goes_on_without():
    system = one_coordinate(lambda t, q, v: -100.0 * q if q < 0.0 else -1.0)
    with pytest.raises(ValueError, match=r"force of 'one coordinate': it branches .* Take 'Adams' or 'DOP853'"):
        solve_dae(system, (0.0, 1.0), [0.1], [0.0], "Taylor")
    assert solve_dae(system, (0.0, 1.0), [0.1], [0.0]).success


@pytest.mark.parametrize("compiled", quick([True, False]))
@pytest.mark.parametrize("span", [1e-9, 1e-3, 10.0])
def test_the_first_step_is_as_long_as_the_series_at_the_start_allows(span, compiled):
    problem = mechanisms.heavy_top()
    given = problem.system, (0.0, span), problem.q0, problem.v0, "Taylor", 1e-8, 1e-8
    result = solve_dae(*given, compiled=compiled)
    if span < 0.01:
        assert result.h.tolist() == [span]
    else:
        assert result.h[0] > 0.5 * result.h[1]


@pytest.mark.parametrize("compiled", quick([True, False]))
def test_a_kink_is_seen_after_the_run_came_near_a_singular_position(compiled):
    """A slider-crank with a rod a little longer than its crank, and a drag that is rough where the crank turns back."""
    rod = 1.001
    foot = (0.6 + np.sqrt(rod**2 - 0.64), 0.0)
    model = PlanarModel()
    model.rod("crank", (0.0, 0.0), (0.6, 0.8), mass=1.0)
    model.rod("rod", (0.6, 0.8), foot, mass=1.0)
    model.body("slider", mass=1.0, inertia=1.0, position=foot)
    for a, b, at in (("ground", "crank", (0.0, 0.0)), ("crank", "rod", (0.6, 0.8)), ("rod", "slider", foot)):
        model.revolute(a, b, at=at)
    model.prismatic("ground", "slider", at=foot, axis=(1.0, 0.0))
    model.force("crank", (0.3, 0.4), lambda t, q, v: np.array([-0.5 * np.sqrt(v[0] ** 2 + 1e-12) * v[0], 0.0]))
    model.spring("ground", (0.0, 2.0), "crank", (0.6, 0.8), stiffness=60.0, length=0.3)
    problem = model.problem((0.0, 4.0))
    start = problem.system, problem.t_span, problem.q0, problem.v0
    known = solve_dae(*start, method="DOP853", rtol=1e-12, atol=1e-12, max_step=0.004)
    result = solve_dae(*start, method="Taylor", rtol=1e-10, atol=1e-10, compiled=compiled)
    assert known.success and result.success
    assert np.abs(result.q[:, -1] - known.q[:, -1]).max() < 1e-8  # 1e-5 where steps after it were not checked


@pytest.mark.parametrize(("order", "size"), [(19, 0.1), (6, 0.02)])
def test_fixed_steps_from_rest_converge_though_the_first_terms_vanish(order, size):
    """Velocity and acceleration are zero at the start: a comparison with the first terms took this for divergence."""
    model = PlanarModel(gravity=(0.0, 0.0))
    model.rod("rod", (0.0, 0.0), (0.0, -1.0), mass=3.0)  # moment of inertia about the pin: 1
    model.revolute("ground", "rod", at=(0.0, 0.0))
    model.torque("rod", lambda t, q, v: np.sin(t))
    problem = model.problem((0.0, 2.0))
    result = solve_dae(problem.system, problem.t_span, problem.q0, problem.v0, Taylor(order=order), step_size=size)
    assert result.success, result.message
    assert abs(result.v[2, -1] - (1.0 - math.cos(2.0))) < 1e-8
