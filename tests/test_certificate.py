"""`result.certify()`: what passes is right, and what passed over something, was altered or is of other equations fails.

Wrong runs are made so that they stay wrong whatever the methods learn: a run of one system is given another one.
"""

import math
import warnings
from dataclasses import replace

import numpy as np
import pytest

from tests.compiled import PENDULUM
from tests.problems import at_one, quick, run
from twoloop import CertificateWarning, ConstrainedSystem, Newmark, Statistics, callback, mechanisms, solve_dae
from twoloop.bodies import PlanarModel

END, COLUMNS = 3.0, ("t", "q", "v", "a", "lam")


@callback("force")
def force(t, q, v, p, Q):
    rate = q[0] * v[1] - q[1] * v[0]
    tangential = p[0] * math.exp(-(((t - p[1]) / p[2]) ** 2)) - p[3] * math.tanh(rate / p[4])
    Q[0], Q[1] = -tangential * q[1], tangential * q[0] - 9.81


def swing(gust=0.0, t_gust=1.5, width=1.0, friction=0.0, below=1.0):
    """A pendulum under a gust along its path, and dry friction that is smooth below a speed."""
    return ConstrainedSystem(**{**PENDULUM, "force": force}, parameters=[gust, t_gust, width, friction, below])


def swung(method="auto", tolerance=1e-6, system=None, **options):
    start = [math.sin(1.0), -math.cos(1.0)]
    return solve_dae(system or swing(), (0.0, END), start, [0.0, 0.0], method, tolerance, tolerance, **options)


def silently(result, **tolerances):
    """The certificate of a run that is right: without a warning."""
    with warnings.catch_warnings(action="error", category=CertificateWarning):
        return result.certify(**tolerances)


def refused(result, **tolerances):
    with pytest.warns(CertificateWarning, match="Not passed"):
        certificate = result.certify(**tolerances)
    assert not certificate and certificate.defect > certificate.limit and str(certificate).startswith("Not passed")
    return certificate


METHODS = ["auto", "Taylor", "Adams", "Gauss8", "SunRadau5", "RadauIIA9", "TRBDF2", "ESDIRK4", "BDF", "PaperIRK"]


@pytest.mark.parametrize(("method", "tolerance"), quick([(name, tol) for tol in (1e-4, 1e-10) for name in METHODS], 6))
def test_right_runs_pass(default_four_bar, method, tolerance):
    certificate = silently(run(default_four_bar, 1.0, method=method, rtol=tolerance, atol=tolerance))
    assert certificate and certificate.passed and 0.0 < certificate.defect <= certificate.limit
    assert certificate.gap < 1.0 / 700.0 and certificate.unseen == () and str(certificate) == certificate.message


@pytest.mark.filterwarnings("ignore::twoloop.ConstraintWarning")
@pytest.mark.parametrize("name", ["redundant_slider_crank", "rolling_disc", "driven_crank", "n_four_bar"])
@pytest.mark.parametrize("method", quick(["auto", "RadauIIA9"]))
def test_redundant_nonholonomic_driven_and_across_a_singular_position(name, method):
    assert silently(run(getattr(mechanisms, name)(), 1.0, method=method, dense_output=True))


@pytest.mark.parametrize("method", ["auto", "TRBDF2"])
def test_velocities_that_were_not_tested_do_not_count(method):
    result = run(mechanisms.moderately_stiff_beam(), 0.1, method=method, rtol=1e-4, atol=1e-4)
    assert result.untested.any() and silently(result)
    assert not silently(replace(result, untested=None)).passed  # vibrations that the run passed over


@pytest.mark.parametrize(
    "options",
    [{}, {"dense_output": True}, {"t_eval": np.linspace(0.0, END, 31)}, {"t_eval": [0.0, END]}, {"max_steps": 15}],
    ids=["steps", "dense", "t_eval", "ends", "ended early"],
)
@pytest.mark.parametrize("method", quick(["auto", "Adams", "RadauIIA9", "ESDIRK4"]))
def test_a_gust_that_a_run_does_not_know(method, options):
    result = swung(method, **options)
    assert silently(result)
    t_gust = float(0.5 * (result.t[0] + result.t[-1]))
    certificate = refused(replace(result, system=swing(20.0, t_gust, 0.03)))
    assert certificate.t < t_gust + 0.06 and (len(result.t) == 2 or certificate.t > t_gust - 1.0)


@pytest.mark.parametrize("tolerance", quick([1e-6, 1e-10]))
def test_what_lasts_as_long_as_the_gap_is_seen_wherever_it_is(tolerance):
    result = swung(tolerance=tolerance)
    gap = silently(result).gap
    assert gap < END / 700.0
    for t_gust in np.linspace(0.2, 2.6, 12) ** 1.1:
        assert refused(replace(result, system=swing(20.0, t_gust, 0.5 * gap))).defect > 1e3


def test_a_stored_state_that_was_altered(default_four_bar):
    for options in ({}, {"t_eval": np.linspace(0.0, 1.0, 21)}, {"dense_output": True, "t_eval": [0.0, 0.51, 1.0]}):
        result = run(default_four_bar, 1.0, **options)
        k = len(result.t) // 2
        v = result.v.copy()
        v[2, k] *= 1.0 + 1e-4
        assert result.t[k] - 0.11 <= refused(replace(result, v=v)).t <= result.t[k]


@pytest.mark.parametrize("shift", [-0.01, 2e-4, 0.01])
def test_times_that_are_not_those_of_the_dense_solution(default_four_bar, shift):
    result = run(default_four_bar, 1.0, dense_output=True)
    assert silently(result)
    faults = refused(replace(result, t=result.t + shift)).faults
    assert any("the dense solution goes from t = 0 to 1, and the result from" in fault for fault in faults)


def test_constant_steps_are_measured_by_the_tolerance_that_is_asked_for(default_four_bar):
    result = run(default_four_bar, 1.0, method="Gauss4", step_size=0.05)
    refused(result)  # of 1e-8, which no step was held to
    assert silently(result, rtol=1e-3, atol=1e-3)
    assert silently(run(default_four_bar, 1.0, method="Gauss8", step_size=0.01))
    assert silently(run(default_four_bar, 1.0, method=Newmark(beta=0.5, error_tol=3e-8)))  # its error is that^(2/3)


def test_a_run_that_an_event_ended(default_four_bar):
    for options in ({}, {"dense_output": True}, {"t_eval": np.linspace(0.0, 5.0, 51)}):
        assert silently(run(default_four_bar, 5.0, events=at_one(True), **options))


@pytest.mark.parametrize("method", ["auto", "DOP853"])
def test_rounding_errors_of_accelerations_in_an_equilibrium_are_none_of_the_result(method):
    model = PlanarModel(gravity=(0.0, -9.81))
    for k in range(2):
        model.rod(str(k), (0.0, -k), (0.0, -k - 1.0), mass=2.0 - k)
        model.revolute(str(k - 1) if k else "ground", str(k), at=(0.0, -k))
    p = model.problem((0.0, 0.5))
    assert silently(solve_dae(p.system, p.t_span, p.q0, p.v0, method, 1e-10, 1e-10))


@pytest.mark.parametrize(("method", "tolerance"), [("TRBDF2", 1e-6), ("ESDIRK4", 1e-6), ("auto", 1e-4), ("auto", 1e-9)])
def test_small_errors_that_add_up_and_fields_that_are_wrong(method, tolerance):
    result = swung(method, tolerance, swing(0.2, 1.5, 9.0))  # a steady force of 2 % of the weight more
    right = swung(method, tolerance)
    assert silently(right) and not silently(replace(right, **{name: getattr(right, name)[..., :9] for name in COLUMNS}))
    for wrong in (
        replace(result, system=right.system),
        replace(right, lam=2.0 * right.lam),
        replace(right, a=(1.0 + 60.0 * tolerance) * right.a),
        replace(right, a=result.a),
    ):
        with pytest.warns(CertificateWarning, match="Not passed"):
            assert wrong.certify().faults
    with pytest.warns(CertificateWarning, match="small errors add up|missed a feature"):
        assert (
            replace(result, system=right.system, a=math.nan * result.a, lam=math.nan * result.lam).certify().error > 99
        )


def test_a_result_of_another_solver(default_four_bar):
    t = np.linspace(0.0, 0.5, 11)
    result = run(default_four_bar, 0.5, rtol=1e-10, atol=1e-10, t_eval=t)
    foreign = replace(result, h=np.empty(0), stats=Statistics(), rtol=None, atol=None, untested=None, method="")
    with pytest.raises(ValueError, match=r"does not contain any .*: give rtol and atol"):
        foreign.certify()
    assert silently(foreign, rtol=1e-8, atol=np.full(9, 1e-8))
    q = foreign.q.copy()
    q[0, 5] = np.nan
    assert silently(replace(foreign, q=q), rtol=1e-8, atol=1e-8).unseen == ((t[4], t[6]),)


def test_a_step_that_grows_errors_is_not_taken_for_a_wrong_one():
    """An inverted pendulum, stored at its ends alone: an error grows ten thousandfold."""
    start = [1e-3, math.sqrt(1.0 - 1e-6)]
    result = solve_dae(swing(), (0.0, 2.5), start, [0.0, 0.0], "RadauIIA9", 1e-4, 1e-4, t_eval=[0.0, 2.5])
    assert silently(result).defect < 200.0
