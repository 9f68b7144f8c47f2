"""What is traced is the callback: every difference is refused at the start or ends the run, none is silent."""

import functools
import math
import types

import numpy as np
import pytest

from tests import problems
from tests.problems import kept, pendulum, quick, unconstrained, worst
from twoloop import ConstrainedSystem, Status, consistent_state, mechanisms, solve_dae
from twoloop.generate.derived_callbacks import derive_callbacks
from twoloop.generate.series import series_program
from twoloop.generate.traced_values import accept_traces
from twoloop.kernels.data.common import KIT, VECTOR, WORK, f8, i8
from twoloop.kernels.data.indices import DONE
from twoloop.kernels.evaluation.constraints import constraint_rows
from twoloop.kernels.evaluation.inner_loop import compute_gamma
from twoloop.run.workspace import make_kit, workspace

WEIGHT = np.array([0.0, -9.81])
START = {"t_span": (0.0, 0.3), "q0": [1.0, 0.0], "v0": [0.0, 0.0]}


def run(system, method="Taylor", tolerance=1e-8, **options):
    return solve_dae(system, **START, method=method, rtol=tolerance, atol=tolerance, **options)


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
    "array of integers": (lambda t, q, v: np.array([v[0], -9.0], dtype=int), "makes int64 of"),
    "single precision": (lambda t, q, v: np.array([v[0], -9.0], dtype=np.float32), "makes float32 of"),
    "astype": (lambda t, q, v: (WEIGHT - 20.0 * v).astype(int), "branches on, or converts"),
    "where": (lambda t, q, v: WEIGHT - np.where(v > 0.0, 2.0, 1.0) * v, "branches"),
    "abs": (lambda t, q, v: WEIGHT - abs(v) * v, "branches"),
    "sign": (lambda t, q, v: WEIGHT - np.sign(v), "calls numpy.sign on"),
    "floor division": (lambda t, q, v: WEIGHT - (5.0 * t // 1.0) * v, "branches on, or converts"),
    "floor": (lambda t, q, v: WEIGHT - math.floor(8.0 * t) * v, "calls math.floor on"),
    "text": (lambda t, q, v: WEIGHT - (2.0 if f"{t:.1f}" > "0.1" else 0.1) * v, "makes text of"),
    "look-up": (lambda t, q, v: WEIGHT - table.get(t, 3.0) * v, "branches on, or converts"),
    "cache": (lambda t, q, v: WEIGHT - functools.lru_cache(math.cos)(t) * v, "branches on, or converts"),
    "evaluated text": (lambda t, q, v: WEIGHT - eval("1.0 if t < 0.2 else 2.0") * v, "branches"),
    "method of an object": (lambda t, q, v: WEIGHT - Cosine().of(t) * v, "functions of math .* in `return math.cos"),
    "dtype": (lambda t, q, v: WEIGHT - (2.0 if q.dtype == np.float64 else 0.1) * v, "does not give what its opera"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_tells_symbols_from_numbers_is_refused(case):
    force, reason = REFUSED[case]
    with pytest.raises(ValueError, match=f"method='Taylor' needs .*; force of 'pendulum'.* {reason}"):
        run(pendulum(force=force))
    with pytest.raises(ValueError, match="compiled=True needs equations that can be written down; force of 'pendulum'"):
        run(pendulum(force=force), "DOP853", compiled=True)


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
    assert program.traced.difference(system, states) is None
    one, other = run(system), run(system, "DOP853", 1e-10)
    assert one.success and worst(one.q[:, -1], other.q[:, -1]) < 1e-6


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


def two_masses(mass):
    return unconstrained(lambda t, q, v: np.ones(2), 2, mass=mass, name="two")


@pytest.mark.parametrize("method", quick(["auto", "Taylor", "RadauIIA5"]))
def test_a_mass_that_is_symmetric_at_the_start_only_is_refused(method):
    system = two_masses(lambda t, q: np.array([[2.0, 0.5 * q[1]], [0.0, 2.0]]))
    with pytest.raises(ValueError, match=r"mass of 'two' must be symmetric; .* entry \(0, 1\) .*near the start"):
        run(system, method)


@pytest.mark.parametrize("method", ["auto", "Taylor"])
def test_a_mass_that_is_not_symmetric_later_ends_the_run(method):
    system = two_masses(lambda t, q: np.array([[2.0, 0.1 * t**4], [0.2 * t**4, 2.0]]))
    result = run(system, method)
    assert result.status is Status.WRONG_DERIVATIVE and "mass of 'two' must be symmetric" in result.message


# --- c_q and gamma that are not given come exactly from what the other callbacks were traced to
SPEED = 4000.0  # rad/s
WEIGHT3 = np.array([0.0, -9.81, 0.0])


def bar(speed=SPEED, **more):
    """A bar about a pin, [x, y, angle] of its centre, that a drive turns at a speed."""
    functions = {
        "constraint": lambda t, q: np.array([q[0] - np.cos(q[2]), q[1] - np.sin(q[2]), q[2] - speed * t]),
        "jacobian": lambda t, q: np.array([[1.0, 0.0, np.sin(q[2])], [0.0, 1.0, -np.cos(q[2])], [0.0, 0.0, 1.0]]),
        "constraint_rate": lambda t, q: np.array([0.0, 0.0, -speed]),
        "gamma": lambda t, q, v: -(v[2] ** 2) * np.array([np.cos(q[2]), np.sin(q[2]), 0.0]),
    }
    functions |= more
    given = {kind: function for kind, function in functions.items() if function is not None}
    return unconstrained(lambda t, q, v: WEIGHT3, 3, n_c=3, mass=np.diag([1.0, 1.0, 1.0 / 3.0]), **given)


def constant_pendulum(**more):
    return problems.pendulum(constant_mass=True, **more)


@kept(i8(KIT, WORK, f8, VECTOR, VECTOR))
def rows_and_gamma(f, w, t, q, v):
    w.G[:, :] = 0.0
    constraint_rows(f, w, t, q, w.G)
    return compute_gamma(f, w, t, q, v)


def in_kernels(system, t, q, v):
    """C_q and Gamma as used in an evaluation."""
    system, traced = derive_callbacks(system, accept_traces)
    kit = make_kit(system, t, q)
    work = workspace(system, kit, np.ones((system.n_c + system.n_a, system.n_q)), q, 1e-8, 0.0)
    assert rows_and_gamma(kit, work, t, q, v) == DONE
    return work.G[:-1].copy(), work.Gamma.copy(), traced


READY = sorted({name for name in mechanisms.__all__ if name[0].islower()} - {"ancf_beam", "n_four_bar"})


@pytest.mark.parametrize("name", quick(READY, 3))
def test_of_every_ready_mechanism_they_are_those_of_its_formulas(name):
    problem = getattr(mechanisms, name)()
    system, v = problem.system, problem.v0 + np.linspace(0.5, 1.5, problem.system.n_q)
    left_out = {"gamma", "nonholonomic_gamma", "kinematics", *(["jacobian"] if system.n_q < 30 else [])}
    given = {kind: function for kind, function in system.given.items() if kind not in left_out}
    sizes = {size: getattr(system, size) for size in ("n_q", "n_c", "n_a", "constant_mass", "parameters")}
    rows, gamma, traced = in_kernels(ConstrainedSystem(**sizes, **given), 0.3, problem.q0, v)
    assert traced
    if system.n_c:
        assert worst(rows[: system.n_c], system.jacobian(0.3, problem.q0)) < 1e-13 * max(1.0, np.abs(rows).max())
    kinds = [kind for kind, n in (("gamma", system.n_c), ("nonholonomic_gamma", system.n_a)) if n]
    known = np.concatenate([system.evaluate(kind, 0.3, problem.q0, v) for kind in kinds])
    assert worst(gamma, known) < 1e-12 * max(1.0, np.abs(known).max())


def test_a_driven_rate_that_depends_on_position_and_time():
    def rate(t, q):
        return np.array([np.sin(2.0 * t) * q[0]])

    def constraint(t, q):
        return np.array([0.5 * (q @ q - 1.0) + 0.5 * (1.0 - np.cos(2.0 * t)) * q[0]])

    def jacobian(t, q):
        return np.array([[q[0] + 0.5 * (1.0 - np.cos(2.0 * t)), q[1]]])

    q, v, t = np.array([0.6, -0.8]), np.array([1.0, 2.0]), 0.7
    system = constant_pendulum(constraint=constraint, jacobian=jacobian, constraint_rate=rate, gamma=None)
    _, gamma, _ = in_kernels(system, t, q, v)
    known = -(v @ v + 2.0 * np.sin(2.0 * t) * v[0] + 2.0 * np.cos(2.0 * t) * q[0])
    assert gamma[0] == pytest.approx(known, rel=1e-12)


def test_a_fast_bar_is_as_right_without_gamma_as_with():
    """Differences along the motion err where 2e-8 s are an angle: by two hundred times as much."""
    errors = []
    for system in (bar(), bar(gamma=None)):
        q0, v0 = consistent_state(system, 0.0, [1.0, 0.0, 0.0], [0.0, SPEED, SPEED])
        q = solve_dae(system, (0.0, 0.01), q0, v0, rtol=1e-8, atol=1e-8).q[:, -1]
        errors.append(np.abs(q[:2] - [np.cos(0.01 * SPEED), np.sin(0.01 * SPEED)]).max())
    assert errors[1] <= 1.01 * errors[0] + 1e-12


def test_what_branches_is_differenced():
    system = constant_pendulum(jacobian=lambda t, q: q[None, :] if q[0] > -2.0 else 2.0 * q[None, :], gamma=None)
    other, traced = derive_callbacks(system, accept_traces)
    assert other is system and traced == () and solve_dae(system, (0.0, 1.0), [0.6, -0.8], [0.8, 0.6]).success


def driven_along_a_rail(parameters=(9.81, 0.2)):
    """A pendulum on a pivot that moves, with a mass that varies; without derivatives of the constraint."""
    return ConstrainedSystem.from_python(
        n_q=2,
        n_c=1,
        mass=lambda t, q, p: np.array([[1.0 + 0.1 * q[0] ** 2, 0.0], [0.0, 1.0]]),
        force=lambda t, q, v, p: np.array([np.sin(t), -p[0]]),
        constraint=lambda t, q, p: np.array([0.5 * ((q[0] - p[1] * np.sin(3.0 * t)) ** 2 + q[1] ** 2 - 1.0)]),
        constraint_rate=lambda t, q, p: np.array([-3.0 * p[1] * np.cos(3.0 * t) * (q[0] - p[1] * np.sin(3.0 * t))]),
        parameters=parameters,
    )


@pytest.mark.parametrize("compiled", quick(["auto", False, True]))
@pytest.mark.parametrize("method", quick(["auto", "Taylor"]))
def test_a_series_follows_where_a_derivative_is_a_sum(method, compiled):
    system = driven_along_a_rail()
    start = consistent_state(system, 0.0, [0.3, -0.95], [0.4, 0.1])
    implicit = solve_dae(system, (0.0, 2.0), *start, method="RadauIIA9", rtol=1e-11, atol=1e-11)
    result = solve_dae(system, (0.0, 2.0), *start, method=method, compiled=compiled)
    assert result.success and worst(result.q[:, -1], implicit.q[:, -1]) < 1e-6


def switched_on(rapidity):
    """A slider that a smoothed step moves by 1 m in about 1 / rapidity, with a bar of 1 m that hangs from it."""
    return problems.driven_cart(
        lambda t: 0.5 * (1.0 + np.tanh(rapidity * (t - 0.5))),
        lambda t: 0.5 * rapidity * (1.0 - np.tanh(rapidity * (t - 0.5)) ** 2),
    )


def test_where_a_derivative_overflows_differences_take_its_place():
    """That of tanh(x) is made of exp(2 x), which is infinite from x = 355 on."""
    system = switched_on(2000.0)
    q0, v0 = consistent_state(system, 0.0, [0.0, 0.3, -0.95], [0.0, 0.0, 0.0])
    rows, gamma, traced = in_kernels(system, 0.0, q0, v0)
    assert traced and np.allclose(rows, [[1.0, 0.0, 0.0], [-q0[1], q0[1], q0[2]]], atol=1e-7)
    assert np.allclose(gamma, 0.0, atol=1e-7)
    result = solve_dae(system, (0.0, 1.0), q0, v0, rtol=1e-6, atol=1e-6)
    assert result.success and result.q[0, -1] == pytest.approx(1.0, abs=1e-6)


def test_products_may_be_a_thousand_deep():
    def constraint(t, q):
        x = q[0]
        for _ in range(1000):
            x = x * np.cos(0.001 * q[1])
        return np.array([x + q[1]])

    system = constant_pendulum(constraint=constraint, jacobian=None, gamma=None)
    rows, gamma, traced = in_kernels(system, 0.0, np.array([1.0, 0.0]), np.array([0.0, 1.0]))
    assert traced and np.allclose(rows, [[1.0, 1.0]], rtol=1e-12) and gamma[0] == pytest.approx(1000.0 * 1e-6, rel=1e-9)
