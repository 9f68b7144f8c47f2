"""The table of callbacks and what follows from it, the decorator, and what becomes of plain Python functions."""

import inspect

import numba
import numpy as np
import pytest

from tests.compiled import centripetal, circle, heavy, radius, unit_mass, weight
from tests.problems import pendulum
from twoloop import ConstrainedSystem, Status, callback, solve_dae
from twoloop.kernels.compile.callbacks import KINDS, OPTIONAL
from twoloop.kernels.data.common import KIT, Functions
from twoloop.kernels.data.flags import GIVEN


@callback("force")
def gravity(t, q, v, p, Q):
    Q[1] = -9.81 * p[0]


PENDULUM = {"n_q": 2, "n_c": 1, "mass": heavy, "force": gravity, "constraint": circle, "jacobian": radius}  # p = mass


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


def test_what_numba_cannot_compile_takes_two_lines():
    def force(t, q, v):
        return np.linalg.solve(q, v, 3.0)

    with pytest.raises(TypeError, match=r"'force'.*test_callbacks\.py, line") as caught:
        pendulum(compile=True, force=force)
    lines = str(caught.value).splitlines()
    assert len(lines) == 2
    assert lines[1].startswith("Numba says: TypingError: No implementation of function Function(<function solve")
    assert caught.value.__suppress_context__  # nor are numba's own hundred lines shown below


@pytest.mark.parametrize("kind", ["mass", "force", "constraint", "jacobian", "constraint_rate", "gamma"])
def test_plain_functions_are_sent_to_from_python(kind):
    with pytest.raises(TypeError, match=rf"{kind} must be compiled by @twoloop.callback.*from_python"):
        ConstrainedSystem(**{**PENDULUM, kind: lambda t, q, p, x: None})


# --- what follows from an entry of the table
MAKERS = {"the class": ConstrainedSystem, "from_python": ConstrainedSystem.from_python}


@pytest.mark.parametrize("kind", KINDS)
def test_a_kind_is_known_everywhere(kind):
    entry = KINDS[kind]
    assert f'"{kind}" ({", ".join(entry.arguments)})' in callback.__doc__ and (kind in GIVEN) == (kind in OPTIONAL)
    assert kind in Functions._fields and KIT.functions[kind] == entry.signature
    for name, maker in MAKERS.items():
        assert f"{kind} : " in maker.__doc__, name
        assert (inspect.signature(maker).parameters[kind].default is None) == (kind in OPTIONAL)
    assert tuple(inspect.signature(getattr(pendulum(), kind)).parameters) == ("t", *entry.state)


@pytest.mark.parametrize("maker", MAKERS.values(), ids=MAKERS)
@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"gama": heavy}, "a system has no argument 'gama'; its callbacks are mass, force, .*reaction_by_q"),
        ({}, "a system needs mass, force, constraint: not given"),
    ],
)
def test_callbacks_that_are_unknown_or_missing_are_named(maker, changed, words):
    with pytest.raises(TypeError, match=words):
        maker(n_q=2, n_c=1, **changed)


@pytest.mark.parametrize("kind", ["constraint_rate", "force_by_q", "force_by_v", "reaction_by_q"])
def test_what_is_left_out_leaves_zeros(kind):
    system = pendulum()
    state = [np.ones(1) if name == "lam" else np.ones(2) for name in KINDS[kind].state]
    assert kind not in system.given
    values = getattr(system, kind)(0.0, *state)
    for value, zeros in zip(values if KINDS[kind].more else [values], system.arrays_of(kind), strict=True):
        assert value.shape == zeros.shape and not value.any()


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


def test_helpers_compiled_for_arrays_that_may_be_written_are_taken():
    @numba.njit("f8(f8[::1])")
    def first(x):
        return x[0]

    @callback("force")
    def force(t, q, v, p, Q):
        x = q.copy()
        x[0] += 1.0
        Q[0] = first(q) + x[0]

    Q, q = np.zeros(1), np.ones(1)
    force(0.0, q, q, q, Q)
    assert Q[0] == 3.0 and q[0] == 1.0


@callback("mass")
def heavier_beyond(t, q, p, M):
    M[0, 0] = 1.0 if q[0] < p[0] else 1.0 + q[0]


@callback("force")
def pushed(t, q, v, p, Q):
    Q[0] = 1.0


@pytest.mark.parametrize("method", ["auto", "Adams", "RadauIIA9", "TRBDF2", "Gauss8", "Newmark"])
def test_a_mass_that_is_constant_at_the_start_only_ends_the_run(method):
    """It was factored once, and the motion that of a lighter body, by every method."""
    system = ConstrainedSystem(
        n_q=1, n_c=0, mass=heavier_beyond, force=pushed, parameters=[1.0], constant_mass=True, name="growing"
    )
    for _ in range(3):  # what is kept of the runs before is of ones that failed
        result = solve_dae(system, (0.0, 3.0), [0.0], [0.0], method, rtol=1e-6, atol=1e-6)
        assert result.status is Status.WRONG_DERIVATIVE and "mass of 'growing' is said to be constant" in result.message
    assert solve_dae(system, (0.0, 1.0), [0.0], [0.0], method, rtol=1e-6, atol=1e-6).success


@callback("kinematics")
def agrees_at_first(t, q, v, p, C, Cq, Ct, Qd):
    C[0] = 0.5 * (q[0] * q[0] + q[1] * q[1] - 1.0)
    Cq[0, 0], Cq[0, 1] = q[0], q[1] if q[0] > 0.0 else 1.01 * q[1]
    Qd[0] = -(v[0] * v[0] + v[1] * v[1])


@pytest.mark.parametrize("method", ["auto", "Adams", "TRBDF2"])
def test_kinematics_that_agree_at_the_start_only_end_the_run(method):
    given = dict(mass=unit_mass, force=weight, constraint=circle, jacobian=radius, gamma=centripetal)
    system = ConstrainedSystem(n_q=2, n_c=1, **given, kinematics=agrees_at_first, name="fused")
    result = solve_dae(system, (0.0, 1.0), [1.0, 0.0], [0.0, 0.0], method, rtol=1e-6, atol=1e-6)
    assert result.status is Status.WRONG_DERIVATIVE
    assert "kinematics of 'fused' does not give what jacobian gives: entry (0, 1)" in result.message
