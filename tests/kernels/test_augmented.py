"""Test M a + G^T lam = r, G a = c in every form: the sparse augmented matrix against the dense forms and NumPy."""

import numpy as np
import pytest

import twoloop.run.workspace as workspace_module
from tests.chains import chain
from tests.general.mechanisms import error, mechanism
from tests.problems import pendulum, some_of, violations, worst
from twoloop import solve_dae
from twoloop.kernels.algebra.sparse import MANY, sparse_pays
from twoloop.kernels.data import flags
from twoloop.mechanisms import n_four_bar
from twoloop.methods.dop853 import DOP853
from twoloop.run.run import Run

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
def choose(monkeypatch):
    """What makes every run take the form that is asked for."""
    return lambda sparse: monkeypatch.setattr(workspace_module, "sparse_pays", lambda *sizes: sparse)


@pytest.fixture
def both(choose):
    """What makes the same run twice: by the dense forms and by the sparse matrix."""

    def solved(*start, **options):
        runs = []
        for sparse in (False, True):
            choose(sparse)
            runs.append(solve_dae(*start, **options))
            assert runs[-1].success
        return runs

    return solved


def started(problem, method=DOP853()):  # noqa: B008
    n = problem.system.n_q
    plan = method.plan(n, 1e-8, 1e-8, False)
    return Run(problem.system, plan, 0.0, problem.q0, problem.v0, 1e-8, np.full(n, 1e-8), None)


def form(run):
    return int(run.functions.flags[flags.FORM])


@pytest.mark.filterwarnings("ignore::twoloop.ConstraintWarning")
@pytest.mark.parametrize(("name", "method"), some_of(KINDS, ["Gauss12", "DOP853", "Adams"], 1))
def test_known_motions(both, name, method):
    m = mechanism(name)
    dense, sparse = both(m.system(), (0.0, 0.5 * m.end), *m.start, method, 1e-10, 1e-10)
    assert worst(dense.a[:, 0], sparse.a[:, 0]) < 1e-9 * max(1.0, np.abs(dense.a[:, 0]).max())
    assert worst(dense.lam[:, 0], sparse.lam[:, 0]) < 1e-9 * max(1.0, np.abs(dense.lam[:, 0]).max())
    assert error(m, sparse) < max(3.0 * error(m, dense), 1e-8)
    assert sparse.stats.n_evaluations < 1.5 * dense.stats.n_evaluations  # at 1e-10 rounding decides on some iterations


def test_chosen_where_rows_and_degrees_of_freedom_are_many():
    assert sparse_pays(2 * MANY, MANY, True) and sparse_pays(500, 499, False)
    assert not sparse_pays(500, MANY - 1, True) and not sparse_pays(500, 499, True)
    assert form(started(chain(MANY, False))) == flags.AUGMENTED
    assert form(started(chain(MANY - 1, False))) == flags.NULL_SPACE
    assert form(started(n_four_bar(2))) == flags.NULL_SPACE and form(started(n_four_bar(20))) == flags.AUGMENTED


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
    one, other = both(system, (0.0, 2.0), [0.0, 0.0], [0.0, 0.0], "Adams", 1e-9, 1e-9)
    assert worst(one.q[:, -1], other.q[:, -1]) < 1e-7 and max(violations(system, other)) < 1e-9
