"""What is traced is the callback: every difference is refused at the start or ends the run, none is silent."""

import functools
import math
import types

import numpy as np
import pytest

from tests.compiled import unit_mass
from tests.problems import pendulum, unconstrained, worst
from twoloop import ConstrainedSystem, Status, callback
from twoloop.generate.calls_on_symbols import as_forms
from twoloop.generate.series import series_program
from twoloop.generate.traced_values import Traced
from twoloop.generate.tracing import Graph, Untraceable
from twoloop.solve import solve_dae

WEIGHT = np.array([0.0, -9.81])
START = {"t_span": (0.0, 0.3), "q0": [1.0, 0.0], "v0": [0.0, 0.0]}


def run(system, method="Taylor", tolerance=1e-8, **options):
    return solve_dae(system, **START, method=method, rtol=tolerance, atol=tolerance, **options)


# callbacks that do something else with symbols than with numbers, unless that is refused ----------------------------


def swallowed_branch(t, q, v):
    try:
        return WEIGHT - (2.0 if q[0] > 0.9 else 0.1) * v
    except Exception:
        return WEIGHT


def swallowed_by_a_bare_except(t, q, v):
    try:
        return WEIGHT - float(t) * v
    except:  # noqa: E722
        return WEIGHT


def swallowed_interpolation(t, q, v):
    try:
        return WEIGHT - np.interp(t, [0.0, 1.0], [0.0, 3.0]) * v
    except Exception:
        return WEIGHT


def asks_for_the_dtype(t, q, v):
    return WEIGHT - (2.0 if hasattr(q[0], "dtype") else 0.1) * v


def truncated_in_a_list_of_integers(t, q, v):
    out = np.array([0, 0])
    out[0] = -20.0 * v[0]
    return out


def truncated_in_place(t, q, v):
    out = np.zeros(2, dtype=int)
    out[:] = WEIGHT - 20.0 * v
    return out


def truncated_like(t, q, v):
    out = np.zeros_like(q, dtype=int)
    out[:] = WEIGHT - 20.0 * v
    return out


def matched(t, q, v):
    match t:
        case float():
            return WEIGHT - 2.0 * v
        case _:
            return WEIGHT


table = {0.0: 1.0}
REFUSED = {
    "swallowed branch": (swallowed_branch, "branches"),
    "bare except": (swallowed_by_a_bare_except, "converts .* and catches the exception"),
    "swallowed interpolation": (swallowed_interpolation, "calls numpy.interp on"),
    "isinstance": (lambda t, q, v: WEIGHT - (2.0 if isinstance(t, float) else 0.1) * v, "asks for the type"),
    "type": (lambda t, q, v: WEIGHT - (2.0 if type(t) is float else 0.1) * v, "asks for the type"),
    "match": (matched, "asks for the type"),
    "isscalar": (lambda t, q, v: WEIGHT - (2.0 if np.isscalar(t) else 0.1) * v, "calls numpy.isscalar on"),
    "hasattr": (asks_for_the_dtype, r"asks for \.dtype"),
    "integer array": (truncated_in_a_list_of_integers, "branches on, or converts"),
    "dtype=int": (truncated_in_place, "converts"),
    "zeros_like": (truncated_like, "converts"),
    "array of integers": (lambda t, q, v: np.array([v[0], -9.0], dtype=int), "makes int64 of"),
    "single precision": (lambda t, q, v: np.array([v[0], -9.0], dtype=np.float32), "makes float32 of"),
    "astype": (lambda t, q, v: (WEIGHT - 20.0 * v).astype(int), "branches on, or converts"),
    "where": (lambda t, q, v: WEIGHT - np.where(v > 0.0, 2.0, 1.0) * v, "branches"),
    "max": (lambda t, q, v: WEIGHT - max(v[0], 0.0) * v, "branches"),
    "abs": (lambda t, q, v: WEIGHT - abs(v) * v, "branches"),
    "sign": (lambda t, q, v: WEIGHT - np.sign(v), "calls numpy.sign on"),
    "floor division": (lambda t, q, v: WEIGHT - (5.0 * t // 1.0) * v, "branches on, or converts"),
    "remainder": (lambda t, q, v: WEIGHT - q % 0.3, "branches on, or converts"),
    "floor": (lambda t, q, v: WEIGHT - math.floor(8.0 * t) * v, "calls math.floor on"),
    "text": (lambda t, q, v: WEIGHT - (2.0 if f"{t:.1f}" > "0.1" else 0.1) * v, "makes text of"),
    "look-up": (lambda t, q, v: WEIGHT - table.get(t, 3.0) * v, "branches on, or converts"),
    "cache": (lambda t, q, v: WEIGHT - functools.lru_cache(math.cos)(t) * v, "branches on, or converts"),
    "evaluated text": (lambda t, q, v: WEIGHT - eval("1.0 if t < 0.2 else 2.0") * v, "branches"),
    "method of an object": (lambda t, q, v: WEIGHT - Cosine().of(t) * v, "functions of math .* in `return math.cos"),
    "dtype": (
        lambda t, q, v: WEIGHT - (2.0 if q.dtype == np.float64 else 0.1) * v,
        "does not give what its operations",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_tells_symbols_from_numbers_is_refused(case):
    force, reason = REFUSED[case]
    with pytest.raises(ValueError, match=f"method='Taylor' needs .*; force of 'pendulum'.* {reason}"):
        run(pendulum(force=force))
    with pytest.raises(ValueError, match="compiled=True needs equations that can be written down; force of 'pendulum'"):
        run(pendulum(force=force), "DOP853", compiled=True)


def test_symbols_that_a_callback_keeps_are_found():
    kept = [np.zeros(2)]

    def previous(t, q, v):
        kept.append(v)
        return WEIGHT - kept[-2]

    with pytest.raises(ValueError, match="force of 'pendulum' does not give what its operations give"):
        run(pendulum(force=previous))
    with pytest.raises(Untraceable, match="of another call, which it has kept"):
        series_program(pendulum(force=lambda t, q, v: v + kept[-2]))
        kept.append(Graph().inputs(2, True))
        series_program(pendulum(force=lambda t, q, v: v + kept[-1]))


# callbacks that are traced ------------------------------------------------------------------------------------------


class Damper:
    k = 2.0

    def force(self, t, q, v):
        return WEIGHT - self.k * math.cos(t) * v - self.spring(q)

    def spring(self, q):
        return np.sin(q)

    def __call__(self, t, q, v):
        return WEIGHT - self.k * np.cos(t) * v - self.spring(q)


class Cosine:
    def of(self, t):
        return math.cos(t)


def of_a_module(source):
    module = types.ModuleType("of_a_user")
    exec("import math\n" + source, vars(module))
    return module


dampers = of_a_module("def speed(v):\n    return math.sqrt(v @ v + 0.01)\ndef drag(v):\n    return speed(v) * v\n")


def fills_arrays(t, q, v):
    out = np.zeros(2, dtype=float)
    out += WEIGHT
    out[0] -= v[0] ** 3
    out *= np.full(2, 2.0)
    return np.array(out, dtype=np.float64) + np.asarray([t, 1.0]) * np.float64(2.0)


TRACED = {
    "method": Damper().force,
    "object": Damper(),
    "partial": functools.partial(lambda k, t, q, v: WEIGHT - k * math.exp(-t) * v, 2.0),
    "function of a module": lambda t, q, v: WEIGHT - dampers.drag(v),
    "default": lambda t, q, v, sine=np.sin: WEIGHT - sine(v),
    "attributes of a number": lambda t, q, v: WEIGHT - (2.0 if hasattr(t, "real") else 0.1) * q[0].item() * v,
    "arrays": fills_arrays,
    "numpy": lambda t, q, v: WEIGHT - np.linalg.norm(v + 1.0) * (np.outer(q, q) @ v) - np.hypot(q, v + 1.0),
    "powers": lambda t, q, v: WEIGHT - 2.0**t * v - q**101,
    "constants": lambda t, q, v: WEIGHT - (np.clip(3.0, 0.0, 1.0) + math.floor(2.5) + max(1, 2)) * v,
}
if np.lib.NumpyVersion(np.__version__) >= "1.25.0":  # before it takes no objects
    TRACED["einsum"] = lambda t, q, v: WEIGHT - np.einsum("ij,j->i", np.outer(q, q), v)


@pytest.mark.parametrize("case", TRACED)
def test_what_does_the_same_with_symbols_is_traced(case):
    system = pendulum(force=TRACED[case])
    program = series_program(system)
    states = np.column_stack([np.linspace(0.0, 1.0, 5), np.random.default_rng(1).uniform(-1.0, 1.0, (5, 4))])
    assert program.traced.wrong(system, states) is None
    one, other = run(system), run(system, "DOP853", 1e-10)
    assert one.success and worst(one.q[:, -1], other.q[:, -1]) < 1e-6


# values that are not what they were ---------------------------------------------------------------------------------

K = 5.0


@callback("force")
def damped(t, q, v, p, Q):
    Q[0] = -K * v[0]
    Q[1] = -9.81 - K * v[1]


def free(force):
    return ConstrainedSystem(n_q=2, n_c=0, mass=unit_mass, force=force, name="free")


@pytest.fixture
def another_constant(monkeypatch):
    """The global is another than when numba compiled the callback."""
    monkeypatch.setattr("tests.test_traced_values.K", 0.5)


@pytest.mark.usefixtures("another_constant")
def test_a_global_that_numba_froze_is_not_read_anew():
    for method, compiled in (("Taylor", False), ("DOP853", True), ("Adams", True), ("auto", True), ("auto", "auto")):
        with pytest.raises(ValueError, match=r"force of 'free' was compiled with K = 5.0, which is 0.5 now"):
            run(free(damped), method, compiled=compiled)


@pytest.mark.parametrize("options", [{"method": "Taylor"}, {"method": "Adams", "compiled": True}], ids=str)
def test_an_event_that_changes_a_callback_ends_the_run(options):
    state = {"k": 1.0}

    def switch(t, q, v):
        if t > 0.15:
            state["k"] = 2.0
        return 1.0

    result = solve_dae(pendulum(force=lambda t, q, v: WEIGHT - state["k"] * v), **START, **options, events=switch)
    assert result.status is Status.WRONG_TRACE and "entry 0" in result.message


def test_random_numbers_are_seen():
    rng = np.random.default_rng(0)
    with pytest.raises(ValueError, match="does not give what its operations give"):
        run(pendulum(force=lambda t, q, v: WEIGHT - rng.uniform(1.0, 1.001) * v))


def traced(system, **changed):
    """What the callbacks of a system were traced to, with other operations in the place of some."""
    graph = Graph()
    t, *x = graph.inputs(1, False) + graph.inputs(system.n_q, False) + graph.inputs(system.n_q, True)
    for kind, function in changed.items():
        made = function(t, np.array(x[: system.n_q]), np.array(x[system.n_q :]))
        graph.traced[kind] = as_forms(graph, np.array(made, dtype=object))
    return Traced(system, graph)


STATES = np.column_stack([np.linspace(0.0, 1.0, 9), np.random.default_rng(2).uniform(0.5, 1.5, (9, 4))])


@pytest.mark.parametrize(
    ("kind", "entry", "function"),
    [
        ("mass", "entry (1, 1)", lambda t, q, v: [[1.0, 0.0], [0.0, 1.0 + 1e-8 * q[0]]]),
        ("force", "entry 1", lambda t, q, v: [0.0, -9.81 + 1e-7 * t]),
        ("constraint", "entry 0", lambda t, q, v: [(q[0] * q[0] + q[1] * q[1] - 1.0) * 0.5 + 1e-8]),
        ("jacobian", "entry (0, 1)", lambda t, q, v: [[q[0], q[1] * (1.0 + 1e-8)]]),
        ("gamma", "entry 0", lambda t, q, v: [-v[0] * v[0] - v[1] * v[1] * v[1]]),
    ],
)
def test_a_difference_is_named_by_callback_and_entry(kind, entry, function):
    wrong = traced(pendulum(), **{kind: function}).wrong(pendulum(), STATES)
    assert wrong is not None and wrong.startswith(f"{kind} of 'pendulum' does not give") and entry in wrong


@pytest.mark.parametrize(
    "function",
    [
        lambda t, q, v: [0.0, -9.81],
        lambda t, q, v: [1e6 * (q[0] + 1e8) - 1e6 * q[0] - 1e14, -9.81],
        lambda t, q, v: [q[0].sine() ** 2 + q[0].cosine() ** 2 - 1.0, -9.81],
        lambda t, q, v: [0.0, -9.81 - (q[0] * 1e8) ** 2 + (q[0] * 1e4) ** 2 * 1e8],
    ],
)
def test_rounding_is_no_difference(function):
    assert traced(pendulum(), force=function).wrong(pendulum(), STATES) is None


# symmetry of M ------------------------------------------------------------------------------------------------------


def two_masses(mass):
    return unconstrained(lambda t, q, v: np.ones(2), 2, mass=mass, name="two")


@pytest.mark.parametrize("method", ["auto", "Taylor", "RadauIIA5"])
def test_a_mass_that_is_symmetric_at_the_start_only_is_refused(method):
    system = two_masses(lambda t, q: np.array([[2.0, 0.5 * q[1]], [0.0, 2.0]]))
    with pytest.raises(ValueError, match=r"mass of 'two' must be symmetric; .* entry \(0, 1\) .*near the start"):
        run(system, method)


@pytest.mark.parametrize("method", ["auto", "Taylor"])
def test_a_mass_that_is_not_symmetric_later_ends_the_run(method):
    system = two_masses(lambda t, q: np.array([[2.0, 0.1 * t**4], [0.2 * t**4, 2.0]]))
    result = run(system, method)
    assert result.status is Status.WRONG_DERIVATIVE and "mass of 'two' must be symmetric" in result.message
