"""All ready mechanisms: what they say of themselves, derivatives, references by a second route, nine digits."""

import warnings
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from tests.general.mechanisms import ELSEWHERE
from tests.mechanisms.make_references import converged, digits
from tests.mechanisms.motions import closed_forms, known_motions
from tests.mechanisms.motions.integrate import by_scipy
from tests.problems import row_errors, run, slope
from twoloop import ConstraintWarning, mechanisms
from twoloop.mechanisms.sundials_slider_crank import PRINTED

COMPUTED, CLOSED = known_motions(), closed_forms()
PROBLEMS = {name: problem for name, (problem, *_) in {**COMPUTED, **CLOSED}.items()}
PROBLEMS["driven slider-crank"] = mechanisms.driven_slider_crank()
EVERY = {**PROBLEMS, "four-bar": mechanisms.four_bar(), "beam": mechanisms.very_flexible_beam()}
# of these tests/general/test_accuracy.py has the whole motions by the same equations, for seconds
LONG = ("spatial slider-crank", "A05 governor", "A04 Bricard")
DAMPED = ("SUNDIALS slider-crank", "A05 governor")
every = pytest.mark.parametrize("problem", EVERY.values(), ids=EVERY)
SINGULAR = [name for name, problem in PROBLEMS.items() if "singular" in problem.tags]
REGULAR = [name for name in PROBLEMS if name not in SINGULAR]
# the others run in tests/general/test_accuracy.py, against the motions from which their references are
RUN_HERE = [name for name in REGULAR if name not in COMPUTED or (name in ELSEWHERE and "chain" in name)]


def of(name):
    return PROBLEMS[name]


@cache
def end_of(name, method):
    """The run to the reference at 1e-10."""
    problem = of(name)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConstraintWarning)
        result = run(problem, problem.reference.t, method=method, rtol=1e-10, atol=1e-10)
    assert result.success, result.message
    return result


@pytest.mark.parametrize("name", PROBLEMS)
def test_the_start_is_consistent(name):
    problem = of(name)
    assert problem.q0.shape == problem.v0.shape == (problem.system.n_q,)
    assert np.abs(problem.system.constraint(0.0, problem.q0)).max(initial=0.0) < 1e-14
    rates = problem.system.velocity_constraint(0.0, problem.q0, problem.v0)
    assert np.abs(rates).max(initial=0.0) < 2e-14 * max(1.0, np.abs(problem.v0).max())


@pytest.mark.parametrize("name", PROBLEMS)
def test_it_says_what_it_is(name):
    problem = of(name)
    assert problem.source and problem.purpose and problem.parameters
    assert {"open chain", "closed chain"} & set(problem.tags) and {"planar", "spatial"} & set(problem.tags)
    assert len(problem.coordinates) == len(set(problem.coordinates)) == problem.system.n_q
    reference = problem.reference
    assert reference.source and reference.verified and set(reference.digits) >= {"q", "v"}
    assert reference.q.shape == reference.v.shape == (problem.system.n_q,)
    if problem.published is not None:
        assert "computed for this project" not in problem.published.source
        assert problem.published.digits["q"] < reference.digits["q"]


def test_a_tag_must_be_known():
    with pytest.raises(ValueError, match=r"tags must be of open chain.*given 'curly'"):
        replace(mechanisms.pendulum(), tags=("curly",))


# --- references by a second route
@pytest.mark.parametrize("name", [pytest.param(each, marks=[pytest.mark.slow] * (each in LONG)) for each in COMPUTED])
def test_references_by_equations_in_few_coordinates(name):
    """In double precision by SciPy; the numbers themselves are from extended precision, by extrapolation."""
    problem, (rate, start, known), end = COMPUTED[name]
    reference = problem.reference
    assert reference.t == end and min(reference.digits["q"], reference.digits["v"]) >= 12.0
    q, v = known(end, by_scipy(rate, start, end))
    assert digits(np.array(q, dtype=float), reference.q) > 10.5 and digits(np.array(v, dtype=float), reference.v) > 9.5


@pytest.mark.slow
@pytest.mark.parametrize("name", COMPUTED)
def test_references_again_in_extended_precision(name):
    _, motion, end = COMPUTED[name]
    (q, v), _ = converged(motion, end)
    assert digits(np.array(q, dtype=float), of(name).reference.q) > 13.0
    assert digits(np.array(v, dtype=float), of(name).reference.v) > 12.5


@pytest.mark.parametrize("name", COMPUTED)
def test_references_obey_the_mechanisms_own_equations(name):
    """On all rows, with the multipliers stored; the acceleration is then unique where the mass is regular."""
    problem = of(name)
    system, known = problem.system, problem.reference
    assert np.abs(system.constraint(known.t, known.q)).max(initial=0.0) < 1e-14
    assert np.abs(system.velocity_constraint(known.t, known.q, known.v)).max() < 1e-13 * max(1.0, np.abs(known.v).max())
    assert known.lam.shape == (system.n_c + system.n_a,)


@pytest.mark.parametrize("name", CLOSED)
def test_closed_forms_by_an_equation(name):
    problem, (rate, start, known) = CLOSED[name]
    times = np.linspace(0.1, 1.0, 10) * problem.t_span[1]
    for t, y in zip(times, by_scipy(rate, start, times[-1], times).T, strict=True):
        for given, wanted in zip(problem.motion(t), known(t, y), strict=True):
            assert digits(given, np.array(wanted, dtype=float)) > 10.5
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


# --- published values
def test_andrews_as_published_is_the_state_a_picosecond_later():
    problem = mechanisms.andrews()
    known, printed = problem.reference, problem.published
    assert 9.5 < digits(printed.q, known.q) < 10.5 and digits(printed.q - 1.005e-12 * known.v, known.q) > 12.5
    assert digits(printed.lam, known.lam) > printed.digits["lam"] and digits(printed.v, known.v) > printed.digits["v"]


def test_sundials_slider_crank_as_printed():
    (rate, start, known), problem = COMPUTED["SUNDIALS slider-crank"][1], mechanisms.sundials_slider_crank()
    times = np.array([row[0] for row in PRINTED])
    for row, y in zip(PRINTED, by_scipy(rate, start, times[-1], times).T, strict=True):
        assert np.abs(np.array(row[1:]) - np.array(known(row[0], y)[0], dtype=float)).max() < 4.4e-5
    assert np.abs(problem.published.q - problem.reference.q).max() < 4.4e-5


@pytest.mark.parametrize(
    "problem", [mechanisms.heavy_top(), mechanisms.n_four_bar(2)], ids=lambda problem: problem.name
)
def test_printed_values_hold_the_digits_said(problem):
    printed = ~np.isnan(problem.published.q)
    assert printed.any()
    assert digits(problem.published.q[printed], problem.reference.q[printed]) >= problem.published.digits["q"]


# --- runs
@pytest.mark.parametrize("method", ["Gauss12", "DOP853"])
@pytest.mark.parametrize("name", RUN_HERE)
def test_nine_digits(name, method):
    result, known = end_of(name, method), of(name).reference
    assert digits(result.q[:, -1], known.q) > 9.0 and digits(result.v[:, -1], known.v) > 7.5
    assert digits(result.lam[:, -1], known.lam) > 7.0


@pytest.mark.parametrize("name", [name for name in REGULAR if name in RUN_HERE or of(name).invariants])
def test_invariants(name):
    problem, result = of(name), end_of(name, "Gauss12")
    kept = dict(problem.invariants) | ({"energy": problem.energy} if problem.conserved else {})
    for quantity in kept.values():
        values = quantity(result.t, result.q, result.v)
        assert values.shape == result.t.shape
        assert values[0] == pytest.approx(quantity(0.0, problem.q0, problem.v0), rel=1e-14)
        assert np.ptp(values) < 1e-9 * max(1.0, np.abs(values).max())


@every
def test_energy_takes_one_state_or_many(problem):
    times = np.array([0.0, 0.1, 0.2])
    q, v = (x[:, None] + 0.1 * np.sin(np.arange(3.0 * x.size)).reshape(-1, 3) for x in (problem.q0, problem.v0))
    many, each = problem.energy(times, q, v), [problem.energy(*state) for state in zip(times, q.T, v.T, strict=True)]
    assert many.shape == (3,) and many == pytest.approx(each, rel=1e-12, abs=1e-12)


@every
@pytest.mark.parametrize("seed", range(5))
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


def test_the_condition_of_a_benchmark():
    problem = mechanisms.n_four_bar(2)
    times = np.linspace(0.0, problem.condition.t_end, problem.condition.n_outputs)
    q, v = (np.array(each).T for each in zip(*(problem.motion(t) for t in times), strict=True))
    assert problem.condition.error(q, v, q, v) == 0.0
    assert problem.condition.error(1.01 * q, 1.01 * v, q, v) == pytest.approx(0.01, rel=1e-2)
    assert problem.condition.error(q + 1e-3 * (np.arange(6) > 1)[:, None], v, q, v) == 0.0  # only B0 counts
