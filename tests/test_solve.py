"""solve_dae: output times, step sizes, limits, statistics, partial results, plain and compiled Python, prices."""

from dataclasses import replace

import numpy as np
import pytest

from references.paper.four_bar_minimal import MinimalFourBar
from tests import problems
from tests.problems import START, pendulum, pendulum_state, quick, run, swing, unconstrained, violations, worst
from twoloop import ConstraintWarning, RungeKutta, Status, paper_irk, solve_dae
from twoloop.methods.presets import PRESETS
from twoloop.methods.tableaux import sun_radau_iib


def test_first_step_is_tried_first():
    assert swing(first_step=1e-3).h[0] == 1e-3
    # of a run of which it is less than a hundredth, as no longer step is tried
    refused = solve_dae(pendulum(), (0.0, 60.0), *START, first_step=0.5, rtol=1e-10, atol=1e-10)
    assert refused.h[0] < 0.5 and refused.stats.n_rejected_error + refused.stats.n_rejected_convergence > 0


@pytest.mark.parametrize("method", quick(["Adams", "SunRadau5", "PaperIRK", "Newmark", "BDF", "DOP853"], 3))
def test_max_step_is_respected(method):
    free = swing(method=method, rtol=1e-5, atol=1e-5)
    bound = 0.5 * free.h.max()
    bounded = swing(method=method, rtol=1e-5, atol=1e-5, max_step=bound)
    assert bounded.h.max() <= bound * (1.0 + 1e-12) and bounded.stats.n_accepted >= free.stats.n_accepted


def test_max_steps_ends_the_run_with_what_there_is():
    whole, part = swing(), swing(max_steps=7)
    assert part.status == Status.MAX_STEPS and not part.success and part.stats.n_accepted == len(part.h) == 7
    assert part.t.size == 8 and (part.q == whole.q[:, :8]).all() and "max_steps = 7" in part.message
    assert f"t = {part.t[-1]:.6g}"[:8] in part.message
    assert swing(max_steps=whole.stats.n_accepted).success  # just enough


def crossing_lines():
    """A point on two lines, x^2 = y^2 and z = 0: no independent coordinate exists where they cross, at t = 1."""
    return unconstrained(
        lambda t, q, v: np.zeros(3),
        3,
        n_c=2,
        constraint=lambda t, q: np.array([0.5 * (q[0] ** 2 - q[1] ** 2), q[2]]),
        jacobian=lambda t, q: np.array([[q[0], -q[1], 0.0], [0.0, 0.0, 1.0]]),
        gamma=lambda t, q, v: np.array([v[1] ** 2 - v[0] ** 2, 0.0]),
    )


CROSSING = ((0.0, 2.0), [-1.0, -1.0, 0.0], [1.0, 1.0, 0.0])


def test_an_output_time_on_a_singular_position_is_warned_of():
    with pytest.warns(ConstraintWarning) as caught:
        result = solve_dae(crossing_lines(), *CROSSING, t_eval=[0.5, 1.0, 2.0])
    assert ["at 1 of " in str(each.message) for each in caught] == [True, True] and result.success
    assert worst(result.q, np.array([[-0.5, 0.0, 1.0], [-0.5, 0.0, 1.0], [0.0, 0.0, 0.0]])) < 1e-8
    assert np.isnan(result.a[:, 1]).all() and np.isfinite(result.a[:, [0, 2]]).all()


@pytest.mark.parametrize("method", quick(["DOP853", "SunRadau5", "Gauss12", "PaperIRK", "Newmark", "BDF"], 3))
def test_counts_are_consistent(default_four_bar, method):
    result = run(default_four_bar, 3.0, method=method, rtol=1e-6, atol=1e-6)
    stats = result.stats
    assert len(result.h) == stats.n_accepted == result.t.size - 1
    attempts = stats.n_accepted + stats.n_rejected_error + stats.n_rejected_convergence
    assert stats.n_outer >= attempts and stats.n_evaluations >= attempts
    if method == "DOP853":
        assert stats.n_inner >= stats.n_accepted  # ends of steps alone are put on the constraints
    else:
        assert stats.n_inner >= stats.n_evaluations - attempts - 1  # every evaluation but those at ends of steps
    assert 1 <= stats.n_partitions <= stats.n_factorizations and stats.n_factorizations > stats.n_inner
    assert stats.cpu_time > 0.0


@pytest.mark.parametrize("method", quick(["SunRadau5", "Gauss12", "PaperIRK", "PaperNewmark"]))
def test_what_happened_before_each_step_adds_up_to_the_counts(default_four_bar, method, monkeypatch):
    options = {"method": method, "rtol": 1e-5, "atol": 1e-5}
    t_end = 20.0 if method == "Gauss12" else 3.0  # a hundredth of which is longer than its steps
    whole = run(default_four_bar, t_end, **options)
    monkeypatch.setattr("twoloop.run.loop.BUFFER_STEPS", 7)  # many chunks: nothing may be lost between them
    stats = whole.stats
    assert whole.rejected_error.sum() == stats.n_rejected_error
    assert whole.rejected_convergence.sum() == stats.n_rejected_convergence
    assert stats.n_rejected_error + stats.n_rejected_convergence > 0
    assert 0 < whole.partitioned.sum() == stats.n_partitions - 1
    for k in (1, 2, 7, 8, 20):  # a run stopped after k steps has counted what the log says of them
        short = run(default_four_bar, t_end, **options, max_steps=k)
        for name in ("rejected_error", "rejected_convergence"):
            assert getattr(short, name).shape == (k,) and (getattr(short, name) == getattr(whole, name)[:k]).all()
            assert getattr(whole, name)[:k].sum() == getattr(short.stats, f"n_{name}")
        assert (short.partitioned == whole.partitioned[:k]).all()


def test_evaluations_are_calls_of_the_force():
    calls = []

    def force(t, q, v):
        calls.append(t)
        return np.array([0.0, -9.81])

    result = swing(1.0, pendulum(force=force))
    # each twenty begins twice, those of short steps at first; checks at start and end, among them repeated calls
    looks = 2000 + 100 + 40 + 5 + 50 + 256
    assert 0 <= len(calls) - result.stats.n_evaluations <= looks and min(calls) >= 0.0 and max(calls) <= 1.0 + 1e-12


@pytest.mark.parametrize("method", ["auto", "DOP853", "Taylor"])
def test_a_closure_that_changes_is_followed(method):
    gravity = [9.81]
    system = pendulum(force=lambda t, q, v: np.array([0.0, -gravity[0]]))
    heavy = swing(system=system, method=method)
    gravity[0] = 1.0
    light = swing(system=system, method=method)
    assert worst(heavy.q[:, -1], pendulum_state(2.0)[0]) < 1e-6 and worst(light.q[:, -1], heavy.q[:, -1]) > 0.1
    gravity[0] = 9.81
    assert (swing(system=system, method=method).q == heavy.q).all()


# --- tolerances of the loops and prices. Bounds are about 1.3 times what was counted when they were written
def test_the_inner_loop_corrects_before_it_tests(default_four_bar):
    """A test before would leave violations of the order of the tolerance, and not of about its square."""
    result = run(default_four_bar, method=RungeKutta(sun_radau_iib(3), inner_tol=1e-3), rtol=1e-7, atol=1e-7)
    assert violations(default_four_bar.system, result)[0] < 2e-6
    assert worst(result.q[:, -1], default_four_bar.reference.q) < 1e-4
    assert run(default_four_bar).stats.n_inner < 2.0 * run(default_four_bar).stats.n_evaluations


def test_price_and_accuracy_of_the_papers_method_over_100_s(default_four_bar):
    result = run(default_four_bar, 100.0, method=paper_irk(1e-9, 1e-9), rtol=1e-5, atol=1e-5)
    assert result.success and result.stats.n_evaluations < 210_000
    assert np.median(result.h) > 0.02  # "in most time", Sect. 4.1
    assert violations(default_four_bar.system, result)[0] < 1e-9
    energy = default_four_bar.energy(result.t, result.q, result.v)
    assert worst(energy, energy[0]) < 1e-2
    expected = MinimalFourBar.from_parameters(default_four_bar.parameters).states([100.0])[0][:, 0]
    assert worst(result.q[:, -1], expected) < 1e-2


VARIES = ("Adams", True)  # keeps no constant step


@pytest.mark.parametrize(
    ("method", "fixed"),
    [(name, fixed) for name in sorted(PRESETS) for fixed in (False, True) if (name, fixed) != VARIES],
)
def test_states_solve_the_equations_of_motion_on_the_constraints(default_four_bar, method, fixed):
    problem = default_four_bar
    options = {"step_size": 0.01} if fixed else {"rtol": 1e-6, "atol": 1e-6}
    result = run(problem, 0.3, method=method, **options)
    assert problems.force_residual(problem.system, result) < 1e-10 and max(violations(problem.system, result)) < 1e-9
    for t, q, v, a in zip(result.t, result.q.T, result.v.T, result.a.T, strict=True):
        assert worst(problem.system.jacobian(t, q) @ a, problem.system.gamma(t, q, v)) < 1e-10


@pytest.mark.parametrize("order", range(4, 17, 2))
def test_gauss_presets_have_the_order_of_their_name(order):
    tableau = PRESETS[f"Gauss{order}"].tableau
    assert tableau.order == order and tableau.stages == order // 2


def test_the_papers_criterion_over_all_coordinates_needs_fewer_steps_at_a_loose_tolerance(default_four_bar):
    """Criterion (32), tolerance 1e-3: over y_i alone the outer loop stops too early, and steps become small."""
    problem = default_four_bar
    steps = {}
    for outer_test in ("all", "independent"):
        method = replace(paper_irk(1e-9, 1e-3), outer_test=outer_test)
        result = solve_dae(problem.system, (0.0, 20.0), problem.q0, problem.v0, method, rtol=1e-5, atol=1e-5)
        assert result.success, result.message
        steps[outer_test] = len(result.h)
    assert steps["all"] < 0.8 * steps["independent"]


def test_progress_draws_a_bar(capsys):
    pytest.importorskip("rich")
    quiet = swing()
    assert capsys.readouterr().out == ""
    shown = swing(progress=True)
    assert "100%" in capsys.readouterr().out and (shown.q == quiet.q).all()


def test_input_is_not_changed(default_four_bar):
    q0, v0, times = default_four_bar.q0.copy(), default_four_bar.v0.copy(), np.array([0.5, 1.0])
    solve_dae(default_four_bar.system, (0.0, 1.0), q0, v0, t_eval=times)
    assert (q0 == default_four_bar.q0).all() and (v0 == 0.0).all() and (times == [0.5, 1.0]).all()
