import numpy as np
import pytest

from tests.problems import unconstrained, without_tangent, worst
from twoloop import ConstrainedSystem, consistent_state, solve_dae
from twoloop.kernels.algebra import lapack
from twoloop.kernels.data import flags
from twoloop.mechanisms.ancf_beam import very_flexible_beam
from twoloop.methods.newmark import Newmark
from twoloop.methods.runge_kutta import RungeKutta
from twoloop.methods.tableaux import gauss, radau_iia
from twoloop.run import workspace as workspace_module
from twoloop.run.run import Run

NEWTON = RungeKutta(radau_iia(3), outer="newton")


def chain(n=12, stiffness=1e4, damping=0.0, lumped=False, bandwidth=3):
    """Masses on springs of rest length 1 whose ends slide on two unit circles; coordinates x_0, y_0, x_1, ...

    Consistent masses (1/6, 4/6, 1/6) unless lumped. Returns the system, q0 and v0.
    """
    distance = float(n + 1)
    mass = np.eye(2 * n) if lumped else (4.0 * np.eye(2 * n) + np.eye(2 * n, k=2) + np.eye(2 * n, k=-2)) / 6.0

    def force(t, q, v):
        Q = np.zeros(2 * n)
        for k in range(n):
            Q[2 * k + 1] -= 9.81
        for k in range(n - 1):
            dx, dy = q[2 * k + 2] - q[2 * k], q[2 * k + 3] - q[2 * k + 1]
            ux, uy = v[2 * k + 2] - v[2 * k], v[2 * k + 3] - v[2 * k + 1]
            length = np.sqrt(dx * dx + dy * dy)
            pull = (stiffness * (length - 1.0) + damping * (dx * ux + dy * uy) / length) / length
            Q[2 * k] += pull * dx
            Q[2 * k + 1] += pull * dy
            Q[2 * k + 2] -= pull * dx
            Q[2 * k + 3] -= pull * dy
        return Q

    def constraint(t, q):
        x, y = q[2 * n - 2] - distance, q[2 * n - 1]
        return np.array([0.5 * (q[0] * q[0] + q[1] * q[1] - 1.0), 0.5 * (x * x + y * y - 1.0)])

    def jacobian(t, q):
        Cq = np.zeros((2, 2 * n))
        Cq[0, 0], Cq[0, 1] = q[0], q[1]
        Cq[1, 2 * n - 2], Cq[1, 2 * n - 1] = q[2 * n - 2] - distance, q[2 * n - 1]
        return Cq

    system = ConstrainedSystem.from_python(
        n_q=2 * n,
        n_c=2,
        mass=mass,
        force=force,
        constraint=constraint,
        jacobian=jacobian,
        gamma=lambda t, q, v: (
            -np.array([v[0] * v[0] + v[1] * v[1], v[2 * n - 2] * v[2 * n - 2] + v[2 * n - 1] * v[2 * n - 1]])
        ),
        bandwidth=bandwidth,
        name="chain",
    )
    guess = np.zeros((n, 2))
    guess[:, 0] = np.linspace(0.8, distance - 0.8, n)
    guess[:, 1] = -0.6 + 0.3 * np.sin(np.linspace(0.0, 3.0, n))
    q0, v0 = consistent_state(system, 0.0, guess.ravel(), np.zeros(2 * n))
    return system, q0, v0


def both(system, *args, monkeypatch, **options):
    """The run with banded linear algebra and the same with dense."""
    results = []
    for dense in (False, True):
        with monkeypatch.context() as patch:
            patch.setattr(workspace_module, "banded_pays", lambda *sizes, answer=not dense: answer)
            results.append(solve_dae(system, *args, **options))
    assert all(result.success for result in results), [result.message for result in results]
    return results


def test_other_integers_than_32_bit_are_refused(monkeypatch):
    monkeypatch.setitem(lapack.scipy.linalg.cython_lapack.__pyx_capi__, "dgbtrf", "void (npy_int64 *, npy_int64 *)")
    with pytest.raises(ImportError, match=r"cython_lapack\.dgbtrf must take 32-bit integers; it is 'void \(npy_int64"):
        lapack.addresses()


@pytest.mark.parametrize("lumped", [False, True])
@pytest.mark.parametrize("damping", [0.0, 20.0])
def test_newton_gives_the_same_run_as_dense(monkeypatch, lumped, damping):
    system, q0, v0 = chain(lumped=lumped, damping=damping)
    banded, dense = both(system, (0.0, 0.2), q0, v0, NEWTON, step_size=2e-3, monkeypatch=monkeypatch)
    assert worst(banded.q, dense.q) < 1e-11 and worst(banded.v, dense.v) < 1e-8
    assert banded.stats.n_outer <= 1.2 * dense.stats.n_outer and banded.stats.n_evaluations <= dense.stats.n_evaluations


@pytest.mark.parametrize("tableau", [gauss(2), radau_iia(3)], ids=lambda tableau: tableau.name)
def test_error_estimate_is_that_of_dense(monkeypatch, tableau):
    system, q0, v0 = chain(damping=2.0)
    method = RungeKutta(tableau, outer="newton")
    banded, dense = both(system, (0.0, 0.2), q0, v0, method, 1e-6, 1e-6, monkeypatch=monkeypatch)
    assert worst(banded.q[:, -1], dense.q[:, -1]) < 1e-5
    assert abs(banded.stats.n_accepted - dense.stats.n_accepted) <= 0.1 * dense.stats.n_accepted


def test_ends_that_turn_fast(monkeypatch):
    """The term that banded Newton leaves out costs no steps at a tolerance."""
    system, q0, v0 = chain(stiffness=100.0)
    v0[[1, 3, -3, -1]] = 20.0  # m/s, on circles of 1 m
    start = consistent_state(system, 0.0, q0, v0)
    banded, dense = both(system, (0.0, 0.5), *start, NEWTON, 1e-6, 1e-6, monkeypatch=monkeypatch)
    assert abs(banded.stats.n_accepted - dense.stats.n_accepted) <= 2
    assert banded.stats.n_outer <= 1.1 * dense.stats.n_outer and worst(banded.q[:, -1], dense.q[:, -1]) < 1e-5


@pytest.mark.parametrize("method", [RungeKutta(radau_iia(3)), Newmark()], ids=lambda method: method.name)
def test_mass_gives_the_same_run_as_dense(monkeypatch, method):
    system, q0, v0 = chain(stiffness=100.0)
    banded, dense = both(system, (0.0, 1.0), q0, v0, method, step_size=5e-3, monkeypatch=monkeypatch)
    assert worst(banded.q, dense.q) < 1e-11 and worst(banded.lam, dense.lam) < 1e-8
    assert banded.stats.n_evaluations == pytest.approx(dense.stats.n_evaluations, rel=0.02)


def test_order_on_nonlinear_constraints(monkeypatch):
    system, q0, v0 = chain(stiffness=100.0)
    reference = solve_dae(system, (0.0, 0.4), q0, v0, RungeKutta(gauss(5)), 1e-13, 1e-13).q[:, -1]
    monkeypatch.setattr(workspace_module, "banded_pays", lambda *sizes: True)
    errors = [
        worst(solve_dae(system, (0.0, 0.4), q0, v0, NEWTON, step_size=h).q[:, -1], reference) for h in (0.02, 0.01)
    ]
    assert errors[0] / errors[1] > 25.0 and errors[1] < 1e-6


def test_chosen_by_size():
    def chosen(system, q0, v0):
        run = Run(system, NEWTON.plan(system.n_q, 1e-6, 1e-6, True), 0.0, q0, v0, 1e-6, np.full(system.n_q, 1e-6), 1e-3)
        return int(run.functions.flags[flags.BANDWIDTH])

    for n_elements, bandwidth in ((4, -1), (8, -1), (16, 11)):
        problem = very_flexible_beam(n_elements)
        assert chosen(problem.system, problem.q0, problem.v0) == bandwidth
    assert chosen(*chain(20)) == -1 and chosen(*chain(28)) == 3 and chosen(*chain(28, lumped=True)) == 3
    assert chosen(*chain(28, bandwidth=None)) == -1


def test_beam_gives_the_same_run_as_dense(monkeypatch):
    problem = without_tangent(very_flexible_beam(8))
    banded, dense = both(
        problem.system, (0.0, 0.02), problem.q0, problem.v0, NEWTON, step_size=1e-3, monkeypatch=monkeypatch
    )
    assert worst(banded.q, dense.q) < 1e-10 and banded.stats.n_outer <= 1.1 * dense.stats.n_outer


def test_cost_grows_like_the_number_of_coordinates():
    """Evaluations of a step, those for the derivatives too, stay about the same where dense would need n_q of them."""
    counts = []
    for n in (16, 64):
        problem = without_tangent(very_flexible_beam(n))
        result = solve_dae(problem.system, (0.0, 2e-3), problem.q0, problem.v0, NEWTON, step_size=1e-4)
        assert result.success, result.message
        counts.append(result.stats.n_evaluations)
    assert counts[1] < 2.5 * counts[0]


@pytest.mark.parametrize("wrong", [0, 2])
def test_bandwidth_too_small(wrong):
    system, q0, v0 = chain(bandwidth=wrong)
    message = "bandwidth of 'chain' must be at least 3: the derivative of force by q has the entry .*; given"
    with pytest.raises(ValueError, match=f"{message} {wrong}"):
        solve_dae(system, (0.0, 0.1), q0, v0)


def test_bandwidth_of_the_mass():
    mass, rows = np.array([[2.0, 0.0, 0.5], [0.0, 1.0, 0.0], [0.5, 0.0, 1.0]]), {"constraint": lambda t, q: q[:1]}
    rows |= {"n_c": 1, "jacobian": lambda t, q: np.eye(1, 3)}
    system = unconstrained(lambda t, q, v: -q, 3, mass=mass, **rows, bandwidth=1, name="far")
    with pytest.raises(
        ValueError, match=r"bandwidth of 'far' must be at least 2: M has the entry \(2, 0\) = 0.5; given"
    ):
        solve_dae(system, (0.0, 0.1), np.zeros(3), np.zeros(3))


def test_bandwidth_of_velocities_and_constraints():
    def system(force, constraint, jacobian):
        return unconstrained(force, 4, n_c=1, constraint=constraint, jacobian=jacobian, bandwidth=1)

    q0 = np.array([0.0, 0.2, 0.3, 1.0])
    far = system(lambda t, q, v: np.array([-v[3], 0.0, 0.0, 0.0]), lambda t, q: q[:1], lambda t, q: np.eye(1, 4))
    with pytest.raises(ValueError, match=r"derivative of force by v has the entry \(0, 3\) = -1"):
        solve_dae(far, (0.0, 0.1), q0, np.zeros(4))
    far = system(
        lambda t, q, v: -q, lambda t, q: np.array([q[0] * q[3]]), lambda t, q: np.array([[q[3], 0.0, 0.0, q[0]]])
    )
    with pytest.raises(ValueError, match=r"second derivative of constraint 0 by q has the entry \(3, 0\) = 1"):
        solve_dae(far, (0.0, 0.1), q0, np.zeros(4))
