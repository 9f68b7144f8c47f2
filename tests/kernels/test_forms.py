"""Test the linear algebra of systems with many rows or a bandwidth: runs are those of the dense forms; refusals."""

import numpy as np
import pytest

import twoloop.run.workspace as workspace_module
from tests.general.mechanisms import error, mechanism
from tests.problems import pendulum, some_of, violations, without_tangent, worst
from twoloop import ConstrainedSystem, consistent_state, solve_dae
from twoloop.kernels.linalg import band as lapack
from twoloop.mechanisms.ancf_beam import very_flexible_beam
from twoloop.methods.paper import Newmark
from twoloop.methods.runge_kutta import RungeKutta
from twoloop.methods.tableaux import radau_iia

# every kind of row and of mass: redundant rows, driven ones, rows of velocities, a mass that varies and one without
# inverse, Gamma by differences
KINDS = (
    "redundant slider-crank",
    "top with its centre",
    "pushed knife edge",
    "wobbling disc, redundant",
    "driven slider-crank, redundant",
    "massless coordinate",
    "driven crank",
)


@pytest.fixture
def both(monkeypatch):
    """The same run without and with a form of the linear algebra, which the function `choice` chooses by the size."""

    def solved(choice, *start, **options):
        runs = []
        for answer in (False, True):
            monkeypatch.setattr(workspace_module, choice, lambda *sizes, answer=answer: answer)
            runs.append(solve_dae(*start, **options))
            assert runs[-1].success, runs[-1].message
        return runs

    return solved


# --- the sparse augmented matrix
@pytest.mark.filterwarnings("ignore::twoloop.ConstraintWarning")
@pytest.mark.parametrize(("name", "method"), some_of(KINDS, ["Gauss12", "DOP853", "Adams"], 1))
def test_known_motions(both, name, method):
    m = mechanism(name)
    dense, sparse = both("sparse_pays", m.system(), (0.0, 0.5 * m.end), *m.start, method, 1e-10, 1e-10)
    assert worst(dense.a[:, 0], sparse.a[:, 0]) < 1e-9 * max(1.0, np.abs(dense.a[:, 0]).max())
    assert worst(dense.lam[:, 0], sparse.lam[:, 0]) < 1e-9 * max(1.0, np.abs(dense.lam[:, 0]).max())
    assert error(m, sparse) < max(3.0 * error(m, dense), 1e-8)
    assert sparse.stats.n_evaluations < 1.5 * dense.stats.n_evaluations  # at 1e-10 rounding decides on some iterations


def test_an_entry_that_comes_later_is_found(both):
    """The last mass is first tied by the ground, then from x = 0.05 on, by a row that begins to depend on y."""

    def bent(q):
        return max(q[0] - 0.05, 0.0)

    system = pendulum(
        constant_mass=True,
        force=lambda t, q, v: np.array([1.0, 0.0]),
        constraint=lambda t, q: np.array([q[1] - bent(q) ** 4]),
        jacobian=lambda t, q: np.array([[-4.0 * bent(q) ** 3, 1.0]]),
        gamma=lambda t, q, v: np.array([12.0 * bent(q) ** 2 * v[0] ** 2]),
    )
    one, other = both("sparse_pays", system, (0.0, 2.0), [0.0, 0.0], [0.0, 0.0], "Adams", 1e-9, 1e-9)
    assert worst(one.q[:, -1], other.q[:, -1]) < 1e-7 and max(violations(system, other)) < 1e-9


# --- bands
NEWTON = RungeKutta(radau_iia(3), outer="newton")


def chain(n=12, stiffness=1e4, damping=0.0, lumped=False, bandwidth=3):
    """Masses on springs of rest length 1 whose ends slide on two unit circles; coordinates x_0, y_0, x_1, ...

    Consistent masses (1/6, 4/6, 1/6) unless lumped. Returns the system, q0 and v0.
    """
    ends, centres = [0, 1, 2 * n - 2, 2 * n - 1], np.array([0.0, 0.0, n + 1.0, 0.0])
    mass = np.eye(2 * n) if lumped else (4.0 * np.eye(2 * n) + np.eye(2 * n, k=2) + np.eye(2 * n, k=-2)) / 6.0

    def force(t, q, v):
        d, u = np.diff(q.reshape(n, 2), axis=0), np.diff(v.reshape(n, 2), axis=0)
        length = np.sqrt((d * d).sum(axis=1))
        pull = (stiffness * (length - 1.0) + damping * (d * u).sum(axis=1) / length) / length
        Q = np.tile([0.0, -9.81], (n, 1))
        Q[:-1] += pull[:, None] * d
        Q[1:] -= pull[:, None] * d
        return Q.ravel()

    def jacobian(t, q):
        Cq = np.zeros((2, 2 * n))
        Cq[[0, 0, 1, 1], ends] = q[ends] - centres
        return Cq

    system = ConstrainedSystem.from_python(
        n_q=2 * n,
        n_c=2,
        mass=mass,
        force=force,
        constraint=lambda t, q: 0.5 * (((q[ends] - centres) ** 2).reshape(2, 2).sum(axis=1) - 1.0),
        jacobian=jacobian,
        gamma=lambda t, q, v: -(v[ends] ** 2).reshape(2, 2).sum(axis=1),
        bandwidth=bandwidth,
        name="chain",
    )
    guess = np.column_stack([np.linspace(0.8, n + 0.2, n), 0.3 * np.sin(np.linspace(0.0, 3.0, n)) - 0.6]).ravel()
    return system, *consistent_state(system, 0.0, guess, np.zeros(2 * n))


def test_other_integers_than_32_bit_are_refused(monkeypatch):
    monkeypatch.setitem(lapack.scipy.linalg.cython_lapack.__pyx_capi__, "dgbtrf", "void (npy_int64 *, npy_int64 *)")
    with pytest.raises(ImportError, match=r"cython_lapack\.dgbtrf must take 32-bit integers; it is 'void \(npy_int64"):
        lapack.lapack_addresses()


@pytest.mark.parametrize("of_chain", [{"damping": 20.0}, {"lumped": True}, {"stiffness": 100.0}], ids=str)
def test_bands_give_the_same_run_as_dense(both, of_chain):
    (system, q0, v0), is_soft = chain(**of_chain), "stiffness" in of_chain
    method, step, t1 = (Newmark(), 5e-3, 1.0) if is_soft else (NEWTON, 2e-3, 0.2)
    dense, banded = both("banded_pays", system, (0.0, t1), q0, v0, method, step_size=step)
    assert worst(banded.q, dense.q) < 1e-11 and max(worst(banded.v, dense.v), worst(banded.lam, dense.lam)) < 1e-8
    assert banded.stats.n_outer <= 1.2 * dense.stats.n_outer
    assert banded.stats.n_evaluations <= 1.02 * dense.stats.n_evaluations


def test_cost_grows_like_the_number_of_coordinates():
    """Evaluations of a step, those for the derivatives too, stay about the same where dense would need n_q of them."""
    counts = []
    for n in (8, 32):
        problem = without_tangent(very_flexible_beam(n))
        result = solve_dae(problem.system, (0.0, 2e-3), problem.q0, problem.v0, NEWTON, step_size=1e-4)
        assert result.success, result.message
        counts.append(result.stats.n_evaluations)
    assert counts[1] < 2.5 * counts[0]


def test_bandwidth_too_small(wrong=2):
    system, q0, v0 = chain(bandwidth=wrong)
    message = "bandwidth of 'chain' must be at least 3: the derivative of force by q has the entry .*; given"
    with pytest.raises(ValueError, match=f"{message} {wrong}"):
        solve_dae(system, (0.0, 0.1), q0, v0)
