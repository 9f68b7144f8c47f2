"""The public face, run as the design prints it."""

import pydoc

import numpy as np
import pytest

import twoloop
from tests.problems import pendulum_state, worst
from tests.processes import run_python

IMPORTS = """
import numpy as np
from twoloop import ConstrainedSystem, solve_dae, consistent_state, RungeKutta, Newmark
from twoloop.mechanisms import four_bar
"""

FOUR_BAR = """
# a ready mechanism
problem = four_bar()                        # .system .q0 .v0 .t_span .energy(t, q, v) .name .parameters
result = solve_dae(problem.system, problem.t_span, problem.q0, problem.v0, rtol=1e-8, atol=1e-8)
"""

PENDULUM = """
# one's own, in plain Python (arrays in, arrays out; M(t,q) q'' + C_q^T lam = Q(t,q,v), C(t,q) = 0)
system = ConstrainedSystem.from_python(
    n_q=2, n_c=1,
    mass=lambda t, q: np.eye(2),
    force=lambda t, q, v: np.array([0.0, -9.81]),
    constraint=lambda t, q: np.array([0.5 * (q @ q - 1.0)]),
    jacobian=lambda t, q: q[None, :],
    constraint_rate=None,                   # C_t(t, q); None: the constraints do not depend on time
    gamma=lambda t, q, v: np.array([-(v @ v)]),   # Q_d(t, q, v), so that C_q a = Q_d; None: by differences of C_q and C_t
    compile=False,                          # True: numba compiles the functions
    name="pendulum")
result = solve_dae(system, (0.0, 10.0), q0, v0, method="SunRadau5", rtol=1e-8, atol=1e-8,
                   t_eval=None, first_step=None, max_step=np.inf, max_steps=None,
                   dense_output=False, events=None, progress=None)
"""  # noqa: E501


def check_result(result, n_q, n_c):
    n_t = result.t.size
    assert result.q.shape == result.v.shape == result.a.shape == (n_q, n_t)
    assert result.lam.shape == (n_c, n_t)
    assert result.status == 0
    assert result.success
    assert result.message
    for name in (
        "n_accepted",
        "n_rejected_error",
        "n_rejected_convergence",
        "n_outer",
        "n_inner",
        "n_evaluations",
        "n_partitions",
        "n_factorizations",
    ):
        assert isinstance(getattr(result.stats, name), int), name
    assert result.stats.cpu_time > 0.0
    assert result.h.shape == (result.stats.n_accepted,)
    assert result.sol is None
    assert result.t_events is None


def test_a_ready_mechanism_as_printed():
    names = {}
    exec(IMPORTS + FOUR_BAR, names)
    problem, result = names["problem"], names["result"]
    check_result(result, 9, 8)
    assert result.t[-1] == problem.t_span[1] == 100.0
    assert isinstance(problem.name, str)
    assert isinstance(problem.parameters, dict)
    energy = problem.energy(result.t, result.q, result.v)
    assert worst(energy, energy[0]) < 1e-5


def test_ones_own_mechanism_as_printed():
    names = {"q0": np.array([-1.0, 0.0]), "v0": np.zeros(2)}
    exec(IMPORTS + PENDULUM, names)
    result = names["result"]
    check_result(result, 2, 1)
    q, v, _ = pendulum_state(10.0)
    assert worst(result.q[:, -1], q) < 1e-6
    assert worst(result.v[:, -1], v) < 1e-6


def test_all_that_is_promised_can_be_imported():
    for name in twoloop.__all__:
        assert getattr(twoloop, name).__doc__, name


def test_an_import_compiles_no_kernels():
    compiled = {"twoloop.kernels.lanes", "twoloop.kernels.evaluation.calls", "twoloop.kernels.advance"}
    run_python(f"import sys, twoloop; sys.exit(len({compiled} & set(sys.modules)))")


@pytest.mark.parametrize("name", twoloop.__all__)
def test_help_leaves_the_names_of_types_as_they_are(name):
    text = pydoc.render_doc(getattr(twoloop, name), renderer=pydoc.plaintext)
    assert "_array_like" not in text and "Union[" not in text
    if name == "solve_dae":
        signature = text.splitlines()[2]
        assert "q0: 'ArrayLike'" in signature and "t_eval: 'ArrayLike | None' = None" in signature
