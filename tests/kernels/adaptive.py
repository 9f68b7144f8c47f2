"""Test what holds for each method of variable steps: a class whose subclasses name their method and the bounds."""

from functools import cache

import numpy as np
import pytest

from references.paper.four_bar_minimal import MinimalFourBar
from tests import problems
from twoloop import solve_dae

linkages = pytest.mark.parametrize("linkage", problems.LINKAGES)
PUSHED = np.array([20.0, -9.81])  # force from 1 s on, where it jumps


def four_bar_run(method, tol, end=10.0, linkage="default", **options):
    """The run by the general kernels, and its largest error in q over all stored states."""
    problem = problems.LINKAGES[linkage]
    result = problems.run(problem, end, method=method, rtol=tol, atol=tol, compiled=False, **options)
    assert result.success, result.message
    return result, problems.worst(result.q, MinimalFourBar.from_parameters(problem.parameters).states(result.t)[0])


shared_run = cache(four_bar_run)  # for runs that several tests look at


def jumping():
    return problems.pendulum(force=lambda t, q, v: PUSHED if t > 1.0 else PUSHED * [0.0, 1.0])


@cache
def at_the_jump():
    """q and v of the pendulum where its force jumps."""
    before = problems.swing(1.0, method="Gauss8", rtol=1e-12, atol=1e-12)
    return before.q[:, -1], before.v[:, -1]


def after_the_jump(end, method, tol):
    """A run that begins where the force jumps."""
    return solve_dae(problems.pendulum(force=lambda t, q, v: PUSHED), (1.0, end), *at_the_jump(), method, tol, tol)


class AdaptiveMethod:
    """The tests that subclasses inherit."""

    method: str
    tolerances: tuple[float, ...] = (1e-4, 1e-6, 1e-8, 1e-10)
    far: float  # largest error over the tolerance
    gain: float  # largest error at a tolerance over that at the one before
    more_steps = np.inf  # most steps at a tolerance over those at the one before
    partitions = 1  # fewer than those of a run
    counter = "n_evaluations"
    prices: tuple[tuple[float, int], ...]  # tolerance and bound of the counter, 1.3 times what was counted at first
    drift_end = 50.0
    drift: tuple[tuple[float, float], ...]  # tolerance and largest residual of the equations of motion
    kept: tuple[float, float]  # largest violation of the constraints on positions and on velocities
    swing_end, first_step, more_after, far_after = 2.0, 1.0, 1.3, 3e2  # of a first step that is too large
    refused = (1, np.inf)  # least and most steps that are refused then
    jump_end = 2.0
    jump: tuple[tuple[float, float], ...] = ((1e-8, 1e-4),)  # tolerance and largest error after the jump
    pivot_tolerances, pivot_far, pivot_kept = (1e-6, 1e-9, 1e-12), 1e3, 1e-13
    oblique_tol, oblique_far = 1e-10, (1e-8, 1e-7, 1e-6)  # x, v, lam

    @linkages
    def test_errors_and_steps_follow_the_tolerance(self, linkage):
        runs = [shared_run(self.method, tol, linkage=linkage) for tol in self.tolerances]
        assert all(result.stats.n_partitions > self.partitions for result, _ in runs)
        errors = np.array([error for _, error in runs])
        assert (errors < self.far * np.array(self.tolerances)).all() and (errors[1:] < self.gain * errors[:-1]).all()
        steps = np.array([result.stats.n_accepted for result, _ in runs])
        assert (steps[1:] / steps[:-1] < self.more_steps).all()

    def test_price_of_ten_seconds(self):
        for tol, bound in self.prices:
            assert getattr(shared_run(self.method, tol)[0].stats, self.counter) < bound

    @linkages
    def test_it_does_not_drift_off_the_constraints(self, linkage):
        system = problems.LINKAGES[linkage].system
        for tol, residual in self.drift:
            result, _ = shared_run(self.method, tol, self.drift_end, linkage)
            position, velocity = problems.violations(system, result)
            assert (
                position < self.kept[0]
                and velocity < self.kept[1]
                and problems.force_residual(system, result) < residual
            )

    def test_a_first_step_that_is_too_large_is_refused(self):
        for tol in self.tolerances:
            usual, result = (
                problems.swing(self.swing_end, method=self.method, rtol=tol, atol=tol, first_step=h)
                for h in (None, self.first_step)
            )
            assert result.success, result.message
            refused = result.stats.n_rejected_error + result.stats.n_rejected_convergence
            assert self.refused[0] <= refused < self.refused[1]
            assert result.stats.n_accepted < self.more_after * usual.stats.n_accepted
            assert problems.worst(result.q, problems.pendulum_state(result.t)[0]) < self.far_after * tol

    def test_a_force_that_jumps_is_passed(self):
        truth = after_the_jump(self.jump_end, "Gauss8", 1e-12)
        for tol, far in self.jump:
            result = problems.swing(self.jump_end, jumping(), method=self.method, rtol=tol, atol=tol)
            assert result.success, result.message
            assert problems.worst(result.q[:, -1], truth.q[:, -1]) < far

    @pytest.mark.slow
    def test_a_moving_pivot(self):
        system, times = problems.moving_pivot(compile=True), np.linspace(0.1, 10.0, 100)
        q, v = problems.moving_pivot_state(times)
        start, errors = problems.moving_pivot_state(0.0), []
        for tol in self.pivot_tolerances:
            result = solve_dae(system, (0.0, 10.0), *start, self.method, tol, tol, t_eval=times, compiled=False)
            assert result.success and result.stats.n_partitions > 5
            assert (
                max(problems.violations(system, result)) < self.pivot_kept
                and problems.force_residual(system, result) < 1e-8
            )
            errors.append((problems.worst(result.q, q), problems.worst(result.v, v)))
            assert errors[-1][0] < self.pivot_far * tol and errors[-1][1] < 10.0 * self.pivot_far * tol
        assert (np.diff(np.log10(errors), axis=0) < -1.0).all()

    def test_a_full_mass_matrix_that_varies_and_forces_that_depend_on_velocities(self):
        tol = self.oblique_tol
        result = solve_dae(problems.oblique_pendulum(), (0.0, 5.0), *problems.oblique_start(), self.method, tol, tol)
        found = *problems.oblique_to_point(result), result.lam
        for values, known, far in zip(found, problems.oblique_point(result.t), self.oblique_far, strict=True):
            assert problems.worst(values, known) < far

    def test_errors_of_positions_count_where_velocities_are_small(self):
        """A slow oscillator: velocities err by a thousandth of what positions do."""
        w = 1e-3
        system = problems.unconstrained(lambda t, q, v: -w * w * q)
        options = {"method": self.method, "rtol": 1e-6, "atol": 1e-6, "compiled": False}
        result = solve_dae(system, (0.0, 300.0 / w), [1.0], [0.0], **options)
        assert abs(result.q[0, -1] - np.cos(300.0)) < 0.3 * self.far * 1e-6
