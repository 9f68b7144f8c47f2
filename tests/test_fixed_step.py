"""Fixed steps: equal, counted from the start, never changed in silence."""

import numpy as np
import pytest

from tests.problems import START, SWING, pendulum_state, run, swing, worst
from twoloop import RungeKutta, Status, solve_dae
from twoloop.mechanisms import four_bar
from twoloop.methods.tableaux import gauss, radau_iia, sun_radau_iib


def test_fixed_steps_are_all_equal_and_times_exact_multiples():
    result = solve_dae(SWING, (0.25, 2.25), *START, step_size=0.01)
    assert (result.h[:-1] == 0.01).all() and result.h[-1] == pytest.approx(0.01, abs=1e-12) and result.h.size == 200
    assert worst(result.t[:-1], 0.25 + 0.01 * np.arange(200)) <= np.spacing(2.25)  # no accumulated rounding
    assert result.t[-1] == 2.25


def test_the_last_fixed_step_is_shortened():
    result = swing(1.05, step_size=0.02, method="Gauss6")
    np.testing.assert_allclose(result.h, [0.02] * 52 + [0.01], atol=1e-12)
    assert result.t[-1] == 1.05 and worst(result.q[:, -1], pendulum_state(1.05)[0]) < 1e-6


@pytest.mark.parametrize("method", ["SunRadau5", "Newmark", "BDF", "DOP853", "PaperIRK"])
def test_a_fixed_step_that_cannot_converge_says_so_and_does_not_change(default_four_bar, method):
    result = run(default_four_bar, step_size=2.0, method=method)
    assert result.status == Status.NOT_CONVERGED and not result.success and "step_size = 2" in result.message
    assert "smaller step_size" in result.message and (result.h == 2.0).all()
    assert result.stats.n_rejected_convergence <= 2  # once more with a new partition


@pytest.mark.parametrize("method", ["auto", "DOP853"])
def test_a_fixed_step_estimates_nothing(default_four_bar, method):
    options = {"method": method, "step_size": 0.01}
    coarse, fine = (run(default_four_bar, 1.0, rtol=tol, atol=tol, **options) for tol in (1e-3, 1e-12))
    assert (coarse.q == fine.q).all() and coarse.stats.n_rejected_error == 0
    if method == "DOP853":
        assert coarse.stats.n_evaluations == 12 * 100 + 1  # its stages, and the start


def test_symmetric_gauss_with_fixed_steps_does_not_drift_while_the_partition_stays():
    problem = four_bar(lengths=(1.0, 1.2, 0.5), ground=1.0, theta3=np.pi, branch=1)

    def drift(tableau):
        result = run(problem, 100.0, method=RungeKutta(tableau), step_size=0.01)
        assert result.stats.n_partitions == 1
        energy = problem.energy(result.t, result.q, result.v)
        return abs(energy[-500:].mean() - energy[500:1000].mean())

    assert drift(gauss(3)) < 1e-11
    assert drift(sun_radau_iib(3)) > 1e-10  # symplectic as a tableau, but not symmetric
    assert drift(radau_iia(3)) > 1e-6


def test_a_fixed_step_tries_a_new_partition_before_it_gives_up():
    result = swing(method="Gauss8", step_size=0.1)
    assert result.success and result.stats.n_partitions > 1 and np.all(result.h == pytest.approx(0.1))


@pytest.mark.parametrize("offset", [0.0, 1e-9, -1e-9])
@pytest.mark.parametrize("t0", [0.0, 1e4, -3.0])
def test_a_fixed_step_lands_on_output_times_near_its_grid(offset, t0):
    h = 1.0 / 30.0
    times = t0 + np.array([10, 20, 30]) * h + offset
    result = solve_dae(SWING, (t0, t0 + 2.0), *START, "Gauss8", step_size=h, t_eval=times)
    assert result.success and result.stats.n_accepted == 60 and result.h.sum() == pytest.approx(2.0, abs=1e-9)
    assert np.abs(result.q - pendulum_state(times - t0)[0]).max() < 1e-6


def test_one_step_over_a_span_that_is_rounded(default_four_bar):
    """0.2 + 0.02 - 0.2 is less than 0.02 in floating-point numbers."""
    problem = default_four_bar
    result = solve_dae(problem.system, (0.2, 0.2 + 0.02), problem.q0, problem.v0, "Gauss6", step_size=0.02)
    assert 0.2 + 0.02 - 0.2 < 0.02 and result.success and len(result.h) == 1


@pytest.mark.slow
def test_rounding_does_not_add_up_in_fixed_steps():
    """Energies at the ends of runs of 10^4 steps and more; without the rests they are off by 1.8e-13 J."""
    problem = four_bar(lengths=(1.0, 1.2, 0.5), ground=1.0, theta3=np.pi, branch=1)
    changes = []
    for k in range(6):
        h = 0.01 * (1.0 + 0.003 * k)
        times = 10 * h * np.arange(2000)
        options = {"method": RungeKutta(gauss(8)), "step_size": h, "t_eval": times}
        result = run(problem, times[-1], **options)
        assert result.stats.n_partitions == 1
        energy = problem.energy(result.t, result.q.astype(np.longdouble), result.v.astype(np.longdouble))
        changes.append(energy[-100:].mean() - energy[:100].mean())
    assert np.sqrt(np.mean(np.square(changes))) < 7e-14
