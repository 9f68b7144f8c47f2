"""Test all ready mechanisms: drawings, derivatives, references by a second route, nine digits, imports."""

import math
import pickle
import warnings
from functools import cache, partial

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from references.paper.four_bar_minimal import MinimalFourBar
from tests.general.mechanisms import ELSEWHERE
from tests.marks import slow, slow_but
from tests.mechanisms.make_references import converged, digits
from tests.mechanisms.motions import closed_forms, known_motions
from tests.mechanisms.motions.integrate import by_scipy
from tests.problems import LINKAGES, row_errors, run, slope, worst
from tests.processes import run_python
from twoloop import ConstraintWarning, mechanisms
from twoloop.bodies.rotation import euler_parameters, euler_rates
from twoloop.kernels.compile.callbacks import KINDS
from twoloop.mechanisms import four_bar
from twoloop.mechanisms.spatial import angular_momentum

COMPUTED, CLOSED = known_motions(), closed_forms()
PROBLEMS = {name: problem for name, (problem, *_) in {**COMPUTED, **CLOSED}.items()}
PROBLEMS["driven slider-crank"] = mechanisms.driven_slider_crank()
EVERY = {**PROBLEMS, "four-bar": mechanisms.four_bar(), "beam": mechanisms.very_flexible_beam()}
# of these tests/general/test_accuracy.py has the whole motions by the same equations, for seconds
LONG = ("spatial slider-crank", "A05 governor", "A04 Bricard", "closed chain of 10", "closed chain of 20")
DAMPED = ("SUNDIALS slider-crank", "A05 governor")
every = pytest.mark.parametrize("problem", EVERY.values(), ids=EVERY)
SINGULAR = [name for name, problem in PROBLEMS.items() if "singular" in problem.tags]
REGULAR = [name for name in PROBLEMS if name not in SINGULAR]
# the others run in tests/general/test_accuracy.py, against the motions from which their references are
RUN_HERE = [name for name in REGULAR if name not in COMPUTED or (name in ELSEWHERE and "chain" in name)]


@cache
def end_of(name, method):
    """The run to the reference at 1e-10."""
    problem = PROBLEMS[name]
    with warnings.catch_warnings(action="ignore", category=ConstraintWarning):
        result = run(problem, problem.reference.t, method=method, rtol=1e-10, atol=1e-10)
    assert result.success, result.message
    return result


@pytest.mark.parametrize("name", PROBLEMS)
def test_the_start_is_consistent(name):
    problem = PROBLEMS[name]
    assert problem.q0.shape == problem.v0.shape == (problem.system.n_q,)
    assert np.abs(problem.system.constraint(0.0, problem.q0)).max(initial=0.0) < 1e-14
    rates = problem.system.velocity_constraint(0.0, problem.q0, problem.v0)
    assert np.abs(rates).max(initial=0.0) < 2e-14 * max(1.0, np.abs(problem.v0).max())


@pytest.mark.parametrize("name", PROBLEMS)
def test_it_says_what_it_is(name):
    problem = PROBLEMS[name]
    assert problem.source and problem.purpose and problem.parameters
    assert {"open chain", "closed chain"} & set(problem.tags) and {"planar", "spatial"} & set(problem.tags)
    assert len(problem.coordinates) == len(set(problem.coordinates)) == problem.system.n_q
    reference = problem.reference
    assert reference.source and reference.verified and set(reference.digits) >= {"q", "v"}
    assert reference.q.shape == reference.v.shape == (problem.system.n_q,)
    if problem.published is not None:
        assert "computed for this project" not in problem.published.source
        assert problem.published.digits["q"] < reference.digits["q"]


@pytest.mark.parametrize("name", slow_but(COMPUTED.keys() - LONG, COMPUTED))
def test_references_by_equations_in_few_coordinates(name):
    """In double precision by SciPy; the numbers themselves are from extended precision, by extrapolation."""
    problem, (rate, start, states), t_end = COMPUTED[name]
    reference = problem.reference
    assert reference.t == t_end and min(reference.digits["q"], reference.digits["v"]) >= 12.0
    q, v = states(t_end, by_scipy(rate, start, t_end))
    assert digits(np.array(q, dtype=float), reference.q) > 10.5 and digits(np.array(v, dtype=float), reference.v) > 9.5


@pytest.mark.slow
@pytest.mark.parametrize("name", COMPUTED)
def test_references_again_in_extended_precision(name):
    _, motion, end = COMPUTED[name]
    (q, v), _ = converged(motion, end)
    assert digits(np.array(q, dtype=float), PROBLEMS[name].reference.q) > 13.0
    assert digits(np.array(v, dtype=float), PROBLEMS[name].reference.v) > 12.5


@pytest.mark.parametrize("name", COMPUTED)
def test_references_obey_the_mechanisms_own_equations(name):
    """On all rows, with the multipliers stored; the acceleration is then unique where the mass is regular."""
    problem = PROBLEMS[name]
    system, reference = problem.system, problem.reference
    assert np.abs(system.constraint(reference.t, reference.q)).max(initial=0.0) < 1e-14
    assert np.abs(system.velocity_constraint(reference.t, reference.q, reference.v)).max() < 1e-13 * max(
        1.0, np.abs(reference.v).max()
    )
    assert reference.lam.shape == (system.n_c + system.n_a,)


@pytest.mark.parametrize("name", CLOSED)
def test_closed_forms_by_an_equation(name):
    problem, (rate, start, states) = CLOSED[name]
    times = np.linspace(0.1, 1.0, 10) * problem.t_span[1]
    for t, y in zip(times, by_scipy(rate, start, times[-1], times).T, strict=True):
        for exact, expected in zip(problem.motion(t), states(t, y), strict=True):
            assert digits(exact, np.array(expected, dtype=float)) > 10.5
    assert problem.reference.q == pytest.approx(problem.motion(problem.t_span[1])[0], abs=0.0)


def test_driven_slider_crank_by_other_means():
    """The law of cosines, differences in time, and the power of the drive, whose torque is -lam of the last row."""
    problem = mechanisms.driven_slider_crank()
    t = problem.reference.t
    q, v, lam = problem.reference.q, problem.reference.v, problem.reference.lam
    angle = 0.5 + 4.0 * t + 0.3 * np.sin(3.0 * t)
    reach = 0.5 * np.cos(angle) + np.sqrt(1.44 - 0.25 * np.sin(angle) ** 2)
    assert q[[2, 6, 7]] == pytest.approx([angle, reach, 0.0], abs=1e-14)
    assert v == pytest.approx(slope(lambda s: problem.motion(t + s)[0]), abs=1e-10)
    power = slope(lambda s: problem.energy(t + s, *problem.motion(t + s)))
    assert -lam[-1] * v[2] == pytest.approx(power, rel=1e-9)


def test_andrews_as_published_is_the_state_a_picosecond_later():
    problem = mechanisms.andrews()
    known, printed = problem.reference, problem.published
    assert 9.5 < digits(printed.q, known.q) < 10.5 and digits(printed.q - 1.005e-12 * known.v, known.q) > 12.5
    assert digits(printed.lam, known.lam) > printed.digits["lam"] and digits(printed.v, known.v) > printed.digits["v"]


# by idaSlCrank_dns.c: t, crank angle, slider position, rod angle
PRINTED = (
    (1.0, 1.3154, 1.0015, -0.50497),
    (2.0, 0.57904, 1.3803, -0.27715),
    (4.0, -1.2064, 1.0623, 0.48609),
    (6.0, -1.108, 1.1176, 0.46386),
    (7.25, -0.070713, 1.4981, 0.035334),
    (8.0, 0.64422, 1.3536, -0.305),
)


def test_sundials_slider_crank_as_printed():
    (rate, start, known), problem = COMPUTED["SUNDIALS slider-crank"][1], mechanisms.sundials_slider_crank()
    times = np.array([row[0] for row in PRINTED])
    for row, y in zip(PRINTED, by_scipy(rate, start, times[-1], times).T, strict=True):
        assert np.abs(np.array(row[1:]) - np.array(known(row[0], y)[0], dtype=float)).max() < 4.4e-5
    assert np.abs(problem.published.q - problem.reference.q).max() < 4.4e-5


@pytest.mark.parametrize("problem", [mechanisms.heavy_top(), mechanisms.n_four_bar(2)], ids=["top", "windows"])
def test_printed_values_hold_the_digits_said(problem):
    printed = ~np.isnan(problem.published.q)
    assert printed.any()
    assert digits(problem.published.q[printed], problem.reference.q[printed]) >= problem.published.digits["q"]


@pytest.mark.parametrize("method", ["Gauss12", slow("DOP853")])
@pytest.mark.parametrize("name", RUN_HERE)
def test_nine_digits(name, method):
    result, known = end_of(name, method), PROBLEMS[name].reference
    assert digits(result.q[:, -1], known.q) > 9.0 and digits(result.v[:, -1], known.v) > 7.5
    assert digits(result.lam[:, -1], known.lam) > 7.0


@pytest.mark.parametrize("name", [name for name in REGULAR if name in RUN_HERE or PROBLEMS[name].invariants])
def test_invariants(name):
    problem, result = PROBLEMS[name], end_of(name, "Gauss12")
    invariants = dict(problem.invariants) | ({"energy": problem.energy} if problem.conserved else {})
    for quantity in invariants.values():
        values = quantity(result.t, result.q, result.v)
        assert values.shape == result.t.shape
        assert values[0] == pytest.approx(quantity(0.0, problem.q0, problem.v0), rel=1e-14)
        assert np.ptp(values) < 1e-9 * max(1.0, np.abs(values).max())


@every
@pytest.mark.parametrize("seed", [0, 1])
def test_rows_and_powers_are_derivatives(problem, seed):
    """Of the constraints, and of the energy along q'' = a without constraints: dE/dt = v . (M a - Q) for any a."""
    system, random = problem.system, np.random.default_rng(seed)
    t, q = random.uniform(0.0, 3.0), problem.q0 + 0.1 * random.normal(size=problem.q0.size)
    v, a = random.normal(size=(2, problem.q0.size))
    assert max(row_errors(system, t, q, v)) < 1e-9
    if problem.name not in DAMPED:
        rate = slope(lambda s: problem.energy(t + s, q + s * v + 0.5 * s * s * a, v + s * a))
        assert rate == pytest.approx(v @ (system.mass(t, q) @ a - system.force(t, q, v)), rel=1e-10, abs=1e-10)


def test_the_governor_only_loses_energy():
    result = end_of("A05 governor", "Gauss12")
    energy = mechanisms.governor().energy(result.t, result.q, result.v)
    assert np.diff(energy).max() < 1e-9 and energy[0] - energy[-1] > 1e-3


SPRINGS = {"Andrews' squeezing mechanism": 1, "SUNDIALS slider-crank": 1, "A05 governor": 2}


def bar_lengths(problem, q):
    points = problem.drawing.at(q)
    return np.array([np.linalg.norm(points[i] - points[j]) for i, j in problem.drawing.bars])


@pytest.mark.parametrize("name", [name for name in EVERY if name not in ("beam", "projection pendulum")])
def test_bars_are_rigid_but_for_springs(name):
    problem = EVERY[name]
    change = np.abs(bar_lengths(problem, problem.reference.q) - bar_lengths(problem, problem.q0))
    assert (change > 1e-9).sum() == SPRINGS.get(name, 0)
    assert np.abs(problem.reference.q - problem.q0).max() > 1e-3  # it did move


@every
def test_many_states_at_once_are_those_one_by_one(problem):
    q = np.column_stack([problem.q0, problem.q0 + 0.1])
    points = problem.drawing.at(q)
    assert points.shape[1] == (2 if "planar" in problem.tags else 3)
    for k in range(2):
        np.testing.assert_allclose(points[..., k], problem.drawing.at(q[:, k]), rtol=0.0, atol=1e-14)


@every
def test_problems_can_be_sent_to_other_processes(problem):
    received, t, v = pickle.loads(pickle.dumps(problem)), 0.3, problem.v0 + 0.1
    assert vars(received).keys() == vars(problem).keys() and received.parameters == problem.parameters
    assert repr(received.system.joints) == repr(problem.system.joints) == repr(received.joints)
    for kind in set(problem.system.given) - {"kinematics"}:
        state = {"q": problem.q0, "v": v, "lam": np.ones(problem.system.n_c)}
        arguments = [state[name] for name in KINDS[kind].state]
        np.testing.assert_array_equal(
            getattr(received.system, kind)(t, *arguments), getattr(problem.system, kind)(t, *arguments)
        )
    np.testing.assert_array_equal(received.drawing.at(problem.q0), problem.drawing.at(problem.q0))
    assert received.energy(0.0, received.q0, received.v0) == problem.energy(0.0, problem.q0, problem.v0)
    assert received.system.description.coordinates == problem.coordinates == received.coordinates


lengths = st.floats(0.3, 3.0)
angles = st.floats(-math.pi, math.pi)
branches = st.sampled_from([-1, 1])


@given(lengths, lengths, lengths, lengths, angles, branches)
def test_assembled_linkages_satisfy_their_constraints_on_the_branch_asked_for(L1, L2, L3, ground, theta3, branch):
    joint23 = ground - L3 * np.exp(1j * theta3)
    assume(abs(L1 - L2) * 1.02 + 0.02 < abs(joint23) < 0.98 * (L1 + L2))
    problem = four_bar(lengths=(L1, L2, L3), ground=ground, theta3=theta3, branch=branch)
    q = problem.q0
    assert np.abs(problem.system.constraint(0.0, q)).max() < 1e-12 and q[8] == theta3 and (problem.v0 == 0.0).all()
    joint12 = 2.0 * complex(q[0], q[1])
    side = (joint23.conjugate() * joint12).imag  # positive: to the left of the line from O to joint 2-3
    assert math.copysign(1.0, side) == branch


# the embedded estimate of RadauIIA5 is of order 3, and its steps continue unextrapolated
MINIMAL = [("default", "SunRadau5", 1e-10), ("collinear", "Gauss12", 1e-10), slow("collinear", "RadauIIA5", 1e-11)]


@pytest.mark.parametrize(("linkage", "method", "tol"), MINIMAL)
def test_linkages_agree_with_the_minimal_form_to_nine_digits(linkage, method, tol):
    problem, times = LINKAGES[linkage], np.linspace(0.0, 10.0, 41)
    result = run(problem, method=method, rtol=tol, atol=tol, t_eval=times)
    assert result.success
    q, v = MinimalFourBar.from_parameters(problem.parameters).states(times)
    assert worst(result.q, q) < 1e-9 and worst(result.v, v) < 5e-9
    if problem.reference is not None:
        assert worst(result.q[:, -1], problem.reference.q) < 5e-10
        assert worst(result.v[:, -1], problem.reference.v) < 1e-9


def test_momentum_of_a_free_body():
    spin, R = np.array([0.4, -0.3, 0.7]), Rotation.random(random_state=5).as_matrix()
    e, moments = euler_parameters(R), np.array([1.0, 2.0, 2.5])
    q, v = np.append([0.1, 0.2, 0.3], e), np.append([1.0, -2.0, 0.5], euler_rates(e, spin))
    point, axis = np.array([0.5, 0.0, -1.0]), np.array([0.0, 0.6, 0.8])
    moment = 2.0 * np.cross(q[:3] - point, v[:3]) + R @ (moments * (R.T @ spin))
    momentum = partial(angular_momentum, np.array([[2.0, *moments]]), point, axis)
    assert momentum(0.0, q, v) == pytest.approx(axis @ moment)
    assert momentum(0.0, np.array([q, q]).T, np.array([v, v]).T) == pytest.approx([axis @ moment] * 2)


@pytest.mark.slow
def test_a_first_run_imports_no_models_and_no_step_that_it_does_not_come_to():
    """Of an implicit method, whose machine code takes a third of a cold first run, and of SciPy's optimisation."""
    source = """
import sys
from twoloop import solve_dae
from twoloop.mechanisms import four_bar
problem = four_bar()
print(solve_dae(problem.system, (0.0, 0.5), problem.q0, problem.v0).success, *sys.modules)
"""
    success, *modules = run_python(source).stdout.split()
    assert success == "True" and "twoloop.kernels.steps.explicit_step" in modules
    unused = ("steps.newton_step", "steps.diagonal_step", "paper.fixed_point_step", "paper.paper_step")
    assert not {*modules} & {f"twoloop.kernels.{name}" for name in unused}
    assert not {*modules} & {"twoloop.bodies.model_problem", "twoloop.bodies.assembly", "scipy.optimize"}
