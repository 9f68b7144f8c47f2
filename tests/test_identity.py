"""Copied, deep-copied, pickled and sent to another process, a system keeps its own functions, or says why it cannot."""

import copy
import multiprocessing
import pickle

import numpy as np
import pytest

from tests.test_callbacks import PENDULUM
from twoloop import ConstrainedSystem, callback, solve_dae
from twoloop.mechanisms import four_bar
from twoloop.problem.adapters import PythonFunctions

Q, V = [-0.6, -0.8], [0.4, -0.3]
LOADS = np.diag([2.0, 3.0])


def mass(t, q):
    return np.eye(2)


def light(t, q, v):
    return np.array([0.0, -9.81])


def heavy(t, q, v):
    return np.array([0.0, -98.1])


def constraint(t, q):
    return np.array([0.5 * (q[0] * q[0] + q[1] * q[1] - 1.0)])


def jacobian(t, q):
    return q.reshape((1, 2))


def made(force=light, **changed):
    functions = {"mass": mass, "force": force, "constraint": constraint, "jacobian": jacobian}
    return ConstrainedSystem.from_python(n_q=2, n_c=1, **{**functions, "name": "own", **changed})


SYSTEMS = {
    "plain": made,
    "plain, array mass": lambda: made(mass=LOADS),
    "compile=True": lambda: made(compile=True),
    "compile=True, array mass": lambda: made(mass=LOADS, compile=True),
    "compiled": lambda: ConstrainedSystem(**PENDULUM, parameters=[3.0], constant_mass=True, name="own"),
    "four-bar": lambda: four_bar().system,
}


def observed(system):
    """What tells one system from another; at the top level, for other processes."""
    q = np.linspace(0.1, 0.9, system.n_q)
    arrays = [system.mass(0.0, q), system.force(0.0, q, q), system.constraint(0.0, q), system.jacobian(0.0, q)]
    flags = system.functions.flags.tolist()
    return [array.tolist() for array in arrays], flags, system.name, system.constant_mass, system.called_in_python


OTHERS = []


def observed_beside_others(system):
    """In a process where more and more systems are, whose numbers a foreign one must not meet."""
    OTHERS.extend(made(force=heavy) for _ in range(5))
    return observed(system), [other.force(0.0, Q, V).tolist() for other in OTHERS]


@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.parametrize(
    "copied",
    [copy.copy, copy.deepcopy, lambda system: pickle.loads(pickle.dumps(system))],
    ids=["copy", "deepcopy", "pickle"],
)
def test_a_copy_works_when_the_original_is_gone(name, copied):
    system = SYSTEMS[name]()
    expected = observed(system)
    other = copied(system)
    del system
    assert observed(other) == expected
    if other.called_in_python:
        assert int(other.functions.p[0]) in PythonFunctions.registry


@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_systems_keep_their_functions_in_other_processes(method):
    systems = [make() for make in SYSTEMS.values()]
    problem = four_bar()
    result = solve_dae(problem.system, (0.0, 0.1), problem.q0, problem.v0)
    with multiprocessing.get_context(method).Pool(1) as pool:
        for k, system in enumerate(systems, 1):  # all but the first arrive where others are already
            there, others = pool.apply(observed_beside_others, (system,))
            assert there == observed(system) and others == [[0.0, -98.1]] * 5 * k
        assert pool.apply(energy_at_the_end, (result,)) == (result.energy[-1], "four-bar")


def energy_at_the_end(result):
    return result.energy[-1], result.system.name


def test_a_compiled_callback_within_a_function_travels_with_its_source():
    factor = 3.0

    @callback("force")
    def force(t, q, v, p, Q):
        Q[1] = factor * p[0]

    system = ConstrainedSystem(**{**PENDULUM, "force": force}, parameters=[2.0])
    assert pickle.loads(pickle.dumps(system)).force(0.0, Q, V).tolist() == [0.0, 6.0]


def enclosing():
    def force(t, q, v):
        return np.zeros(2)

    return force


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("force", [lambda t, q, v: np.zeros(2), enclosing()], ids=["lambda", "closure"])
def test_functions_without_a_name_of_their_own_say_so(force, compiled):
    system = made(force=force, compile=compiled)
    words = r"(?s)force of 'own', .*(<lambda>|enclosing.<locals>.force), cannot be pickled.*top level of a module"
    with pytest.raises(TypeError, match=words):
        pickle.dumps(system)
    assert copy.deepcopy(system).force(0.0, Q, V).tolist() == [0.0, 0.0]  # needs no name


def test_numbers_that_lead_to_no_function_are_refused():
    system = made()
    callbacks = {kind: getattr(system.functions, kind) for kind in ("mass", "force", "constraint", "jacobian")}
    stale = ConstrainedSystem(n_q=2, n_c=1, **callbacks, parameters=[12345.0])
    with pytest.raises(RuntimeError, match="of a system that is not in this process, or no longer"):
        stale.force(0.0, Q, V)
