"""The table of callbacks and what follows from it, the decorator, and what becomes of plain Python functions."""

import copy
import inspect
import itertools
import multiprocessing
import pickle

import numba
import numpy as np
import pytest

from tests.compiled import HEAVY_PENDULUM, centripetal, circle, heavy, radius, unit_mass, weight
from tests.problems import pendulum, quick
from twoloop import ConstrainedSystem, Status, callback, solve_dae
from twoloop.kernels.compile.callbacks import KINDS, OPTIONAL_KINDS
from twoloop.kernels.data.common import KIT, Functions
from twoloop.kernels.data.indices import GIVEN
from twoloop.mechanisms import four_bar
from twoloop.problem.callbacks import PythonFunctions


@pytest.mark.parametrize("kind", KINDS)
def test_other_arguments_than_the_kind_has_are_named(kind):
    def wrong(t, q):
        pass

    with pytest.raises(TypeError, match=rf"wrong.*'{kind}'.*arguments are \(t, q, .*it has \(t, q\)"):
        callback(kind)(wrong)


def test_a_function_that_numba_cannot_compile_says_why():
    with pytest.raises(TypeError, match=r"(?s)force: numba cannot compile the function 'force'.*undefined_name"):

        @callback("force")
        def force(t, q, v, p, Q):
            Q[0] = undefined_name  # noqa: F821


@pytest.mark.parametrize("kind", ["mass", "force", "constraint", "jacobian", "constraint_rate", "gamma"])
def test_plain_functions_are_sent_to_from_python(kind):
    with pytest.raises(TypeError, match=rf"{kind} must be compiled by @twoloop.callback.*from_python"):
        ConstrainedSystem(**{**HEAVY_PENDULUM, kind: lambda t, q, p, x: None})


MAKERS = {"the class": ConstrainedSystem, "from_python": ConstrainedSystem.from_python}


@pytest.mark.parametrize("kind", KINDS)
def test_a_kind_is_known_everywhere(kind):
    entry = KINDS[kind]
    assert f'"{kind}" ({", ".join(entry.arguments)})' in callback.__doc__ and (kind in GIVEN) == (
        kind in OPTIONAL_KINDS
    )
    assert kind in Functions._fields and KIT.functions[kind] == entry.signature
    for name, maker in MAKERS.items():
        assert f"{kind} : " in maker.__doc__, name
        assert (inspect.signature(maker).parameters[kind].default is None) == (kind in OPTIONAL_KINDS)
    assert tuple(inspect.signature(getattr(pendulum(), kind)).parameters) == ("t", *entry.state)


@pytest.mark.parametrize("maker", MAKERS.values(), ids=MAKERS)
def test_callbacks_that_are_unknown_or_missing_are_named(maker):
    with pytest.raises(TypeError, match=r"a system has no argument 'gama'; its callbacks are mass, .*reaction_by_q"):
        maker(n_q=2, n_c=1, gama=heavy)
    with pytest.raises(TypeError, match="a system needs mass, force, constraint: not given"):
        maker(n_q=2, n_c=1)


@numba.njit
def wrapped(q):
    if q[0] > np.pi:
        q[0] -= 2.0 * np.pi


def wraps_an_angle(t, q, v, p, Q):
    if q[0] > np.pi:  # never at the start of a run
        q[0] -= 2.0 * np.pi


def limits_a_speed(t, q, v, p, Q):
    rates = v[:1]
    rates[0] = min(rates[0], 2.0)


def keeps_a_state(t, q, v, p, Q):
    if v[0] > 2.0:
        p[0] = 1.0


def scales(t, q, v, p, Q):
    v *= 0.5


def asks_a_helper(t, q, v, p, Q):
    wrapped(q)


@pytest.mark.parametrize("function", [wraps_an_angle, limits_a_speed, keeps_a_state, scales, asks_a_helper])
def test_a_callback_that_writes_to_its_arguments_is_refused(function):
    """The run went on with what it wrote: another angle, another speed, other parameters, without a word."""
    with pytest.raises(TypeError, match=rf"'{function.__name__}' \(.*\(q, v, p\), which are those of the run. Copy"):
        callback("force")(function)


def test_functions_that_return_arrays_must_not_write_either():
    def force(t, q, v):
        if q[0] > 2.0:
            v[1] = 0.0
        return -v

    with pytest.raises(TypeError, match=r"force: the function 'force' \(.*test_callbacks\.py.* must not change"):
        pendulum(compile=True, force=force)
    assert pendulum(force=force).force(0.0, [3.0, 0.0], [1.0, 1.0]).tolist() == [-1.0, 0.0]  # on copies it may


@callback("mass")
def heavier_beyond(t, q, p, M):
    M[0, 0] = 1.0 if q[0] < p[0] else 1.0 + q[0]


@callback("force")
def pushed(t, q, v, p, Q):
    Q[0] = 1.0


@pytest.mark.parametrize("method", quick(["auto", "Adams", "RadauIIA9", "TRBDF2", "Gauss8", "Newmark"]))
def test_a_mass_that_is_constant_at_the_start_only_ends_the_run(method):
    """It was factored once, and the motion that of a lighter body, by every method."""
    given = {"mass": heavier_beyond, "force": pushed, "parameters": [1.0], "constant_mass": True}
    system = ConstrainedSystem(n_q=1, n_c=0, **given, name="growing")
    for _ in range(3):  # what is kept of the runs before is of ones that failed
        result = solve_dae(system, (0.0, 3.0), [0.0], [0.0], method, rtol=1e-6, atol=1e-6)
        assert result.status is Status.WRONG_DERIVATIVE and "mass of 'growing' is said to be constant" in result.message
    assert solve_dae(system, (0.0, 1.0), [0.0], [0.0], method, rtol=1e-6, atol=1e-6).success


@callback("kinematics")
def agrees_at_first(t, q, v, p, C, Cq, Ct, Qd):
    C[0] = 0.5 * (q[0] * q[0] + q[1] * q[1] - 1.0)
    Cq[0, 0], Cq[0, 1] = q[0], q[1] if q[0] > 0.0 else 1.01 * q[1]
    Qd[0] = -(v[0] * v[0] + v[1] * v[1])


@pytest.mark.parametrize("method", quick(["auto", "Adams", "TRBDF2"]))
def test_kinematics_that_agree_at_the_start_only_end_the_run(method):
    given = dict(mass=unit_mass, force=weight, constraint=circle, jacobian=radius, gamma=centripetal)
    system = ConstrainedSystem(n_q=2, n_c=1, **given, kinematics=agrees_at_first, name="fused")
    result = solve_dae(system, (0.0, 1.0), [1.0, 0.0], [0.0, 0.0], method, rtol=1e-6, atol=1e-6)
    assert result.status is Status.WRONG_DERIVATIVE
    assert "kinematics of 'fused' does not give what jacobian gives: entry (0, 1)" in result.message


# --- copied, deep-copied, pickled and sent to another process, a system keeps its own functions, or says why it cannot
AT, MOVING = [-0.6, -0.8], [0.4, -0.3]
LOADS = np.diag([2.0, 3.0])


def plain_mass(t, q):
    return np.eye(2)


def light_weight(t, q, v):
    return np.array([0.0, -9.81])


def heavy_weight(t, q, v):
    return np.array([0.0, -98.1])


def plain_constraint(t, q):
    return np.array([0.5 * (q[0] * q[0] + q[1] * q[1] - 1.0)])


def plain_jacobian(t, q):
    return q.reshape((1, 2))


def make_system(force=light_weight, **changed):
    functions = {"mass": plain_mass, "force": force, "constraint": plain_constraint, "jacobian": plain_jacobian}
    return ConstrainedSystem.from_python(n_q=2, n_c=1, **{**functions, "name": "own", **changed})


SYSTEMS = {
    "plain": make_system,
    "plain, array mass": lambda: make_system(mass=LOADS),
    "compile=True, array mass": lambda: make_system(mass=LOADS, compile=True),
    "compiled": lambda: ConstrainedSystem(**HEAVY_PENDULUM, parameters=[3.0], constant_mass=True, name="own"),
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
    OTHERS.extend(make_system(force=heavy_weight) for _ in range(5))
    return observed(system), [other.force(0.0, AT, MOVING).tolist() for other in OTHERS]


@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, lambda system: pickle.loads(pickle.dumps(system))])
def test_a_copy_works_when_the_original_is_gone(name, copied):
    system = SYSTEMS[name]()
    expected = observed(system)
    other = copied(system)
    del system
    assert observed(other) == expected
    if other.called_in_python:
        assert int(other.functions.p[0]) in PythonFunctions.registry


@pytest.mark.parametrize("method", quick(["fork", "spawn"]))
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


def enclosing():
    def force(t, q, v):
        return np.zeros(2)

    return force


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("force", [lambda t, q, v: np.zeros(2), enclosing()], ids=["lambda", "closure"])
def test_functions_without_a_name_of_their_own_say_so(force, compiled):
    system = make_system(force=force, compile=compiled)
    words = r"(?s)force of 'own', .*(<lambda>|enclosing.<locals>.force), cannot be pickled.*top level of a module"
    with pytest.raises(TypeError, match=words):
        pickle.dumps(system)
    assert copy.deepcopy(system).force(0.0, AT, MOVING).tolist() == [0.0, 0.0]  # needs no name


# --- forces in Python that depend on more than t, q and v: named at the start, or at the end of the run
BESIDE = np.array([0.6, -0.8]), np.array([0.4, 0.3])


def pushed_by(along_x):
    return pendulum(force=lambda t, q, v: np.array([along_x(t, q, v), -9.81]), gamma=False, constant_mass=True)


def noise():
    random = np.random.default_rng(1)
    return lambda t, q, v: 1e-3 * random.normal()


def sampled_controller():
    held = {"next": 0.0, "value": 0.0}

    def force(t, q, v):
        if t >= held["next"]:
            held["value"], held["next"] = -3.0 * v[0], held["next"] + 0.01
        return held["value"]

    return force


@pytest.mark.parametrize("method", quick(["auto", "RadauIIA9"]))
@pytest.mark.parametrize("make", [noise, sampled_controller])
def test_memory_is_named_at_the_start(make, method):
    with pytest.raises(ValueError, match="force of 'pendulum' gives something else when it is called again"):
        solve_dae(pushed_by(make()), (0.0, 1.0), *BESIDE, method)


def tired(n):
    calls = itertools.count()
    return lambda t, q, v: -2.0 * v[0] * (1.0 if v[0] > 1e9 or next(calls) < n else 1.5)


def timed():
    clock = itertools.count(0.0, 10e-6)  # s, as long as a call takes
    return lambda t, q, v: -2.0 * v[0] if v[0] > 1e9 else 1e3 + next(clock)


def dozes():
    calls = itertools.count()
    return lambda t, q, v: -2.0 * v[0] * (1.0 if v[0] > 1e9 or not 310 <= next(calls) < 440 else 1.5)


@pytest.mark.parametrize("make", [lambda: tired(60), lambda: tired(250), timed, dozes])
def test_memory_that_shows_along_the_motion_is_named_at_its_end(make):
    """The force changes once, so that two calls at the end of the run agree, or slowly, or late, or for a while."""
    result = solve_dae(pushed_by(make()), (0.0, 1.0), *BESIDE, "DOP853")
    assert result.status is Status.WRONG_TRACE and "when it is called again" in result.message


@pytest.mark.parametrize("kind", ["mass", "constraint", "jacobian", "gamma", "force"])
@pytest.mark.parametrize("method", ["DOP853", "RadauIIA9"])
def test_any_callback_that_changes_once_is_named(kind, method):
    calls = itertools.count()
    functions = {
        "mass": lambda t, q: np.eye(2),
        "constraint": lambda t, q: np.array([q @ q - 1.0]),
        "jacobian": lambda t, q: 2.0 * q[None, :],
        "gamma": lambda t, q, v: np.array([-2.0 * v @ v]),
        "force": lambda t, q, v: np.array([0.0, -9.81]),
    }
    changing = functions[kind]
    functions[kind] = lambda *arguments: changing(*arguments) + (0.0 if next(calls) < 60 else 1e-4)
    system = ConstrainedSystem.from_python(n_q=2, n_c=1, **functions)
    result = solve_dae(system, (0.0, 1.0), [0.8, -0.6], [0.0, 0.0], method, rtol=1e-6, atol=1e-6)
    assert result.status is Status.WRONG_TRACE and f"{kind} of 'system' gives something else" in result.message


@callback("force")
def throws_dice(t, q, v, p, Q):
    Q[0] = np.random.random()  # noqa: NPY002


@pytest.mark.slow
def test_a_compiled_force_that_changes_is_named_at_the_end_of_each_run():
    system = ConstrainedSystem(n_q=1, n_c=0, mass=unit_mass, force=throws_dice, name="dice")
    for _ in range(3):
        result = solve_dae(system, (0.0, 1.0), [0.0], [0.0], "DOP853", rtol=1e-2, atol=1e-2)
        assert result.status is Status.WRONG_TRACE and "when it is called again" in result.message


def test_what_is_kept_for_speed_or_to_be_looked_at_is_no_memory():
    known, log, guess = {}, [], [0.0]

    def kept(t, q, v):
        log.append((t, q, v))
        return known.setdefault((t, *q, *v), -2.0 * v[0])

    def warm_start(t, q, v):
        x = guess[0]
        for _ in range(60):
            x -= (x + 0.5 * np.sin(x) - v[0]) / (1.0 + 0.5 * np.cos(x))
        guess[0] = x
        return -2.0 * x

    for force in (kept, warm_start):
        assert solve_dae(pushed_by(force), (0.0, 1.0), *BESIDE).success


def test_noise_goes_with_steps_of_a_constant_size():
    assert solve_dae(pushed_by(noise()), (0.0, 0.1), *BESIDE, "DOP853", step_size=0.01).success
