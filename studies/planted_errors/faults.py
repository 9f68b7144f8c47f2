"""Single faults to plant at run time: in mechanisms, traces, references, tableaux, options, adapters and reports."""

import math
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from typing import Any
from unittest.mock import patch

import numpy as np

from studies.bench import metrics, render, solvers, tables
from studies.bench.store import Array
from twoloop import ConstrainedSystem, Result, callback, mechanisms
from twoloop.generate import collocation_code
from twoloop.mechanisms import Problem
from twoloop.methods import dop853, tableaux
from twoloop.methods import presets as methods
from twoloop.methods.dop853 import DOP853
from twoloop.methods.plan import Plan

TABLEAUX = "tests/test_tableaux.py"
LOBATTO = "tests/test_lobatto.py::test_the_coefficients_are_exact_for_polynomials"
EXPLICIT = "tests/test_tableaux.py::test_dop853_is_that_of_scipy"
TABLES, METRICS, RENDER = (f"tests/studies/test_{name}.py" for name in ("tables", "metrics", "render"))


SCIPY = "DOP853, index 1"  # stands for the adapters of all other solvers
TRACING = "Taylor"  # a solver that integrates what callbacks were traced to
GRAVITY, OTHER = 9.81, 9.80  # m/s^2, of a pendulum and what it is in a wrong trace
weight = GRAVITY  # a global on purpose: numba takes it as it is when it compiles `frozen`


@dataclass(frozen=True)
class Fault:
    """One mistake, and where to look for it."""

    # name, place: what is wrong, and in what
    name: str
    place: str
    plant: Callable[[], AbstractContextManager[Any]] = nullcontext  # plant() -> a context in which it is
    # files or tests of pytest, run in this order until one fails. Empty: the run below is the check.
    checks: tuple[str, ...] = ()
    problem: Problem | None = None  # to be run by `solver` and judged as in `validation`
    solver: str = "Gauss12"


def python_copy(system: ConstrainedSystem, **edits: Callable[..., Any]) -> ConstrainedSystem:
    """The system in plain Python, some of its callbacks passed through edit(value, t, *state)."""

    def edited(kind: str) -> Callable[..., Any]:
        original, edit = getattr(system, kind), edits.get(kind, lambda value, *state: value)
        if kind in ("mass", "constraint", "jacobian", "constraint_rate"):
            return lambda t, q: edit(np.array(original(t, q)), t, q)
        return lambda t, q, v: edit(np.array(original(t, q, v)), t, q, v)

    kinds = ("mass", "force", "constraint", "jacobian", "constraint_rate", "gamma")
    made: dict[str, Any] = {kind: edited(kind) for kind in kinds}
    return ConstrainedSystem.from_python(n_q=system.n_q, n_c=system.n_c, name=system.name, **made)


def put(place: Any, number: float, factor: float = 0.0) -> Callable[..., Any]:
    """An edit that multiplies the value at a place by `factor` and adds a number."""

    def edit(value: Array, *state: Any) -> Array:
        value[place] = factor * value[place] + number
        return value

    return edit


def in_mechanism() -> Iterator[Fault]:
    """Callbacks and starts of Andrews' mechanism, and C_t of a driven crank."""
    sound, driven = mechanisms.andrews(), mechanisms.driven_crank()
    edits: list[tuple[str, str, Callable[..., Any]]] = [
        ("Q_d with the other sign", "gamma", lambda value, *state: -value),
        ("one entry of Q_d 1 % too large", "gamma", put(2, 0.0, 1.01)),
        ("one row of Q_d left out", "gamma", put(4, 0.0)),
        ("one entry of C_q with the other sign", "jacobian", put((0, 0), 0.0, -1.0)),
        ("one entry of C_q off by 1e-5", "jacobian", put((3, 4), 1e-5, 1.0)),
        ("one row of C_q left out", "jacobian", put(5, 0.0)),
        ("two columns of C_q swapped", "jacobian", lambda value, *state: value[:, [1, 0, *range(2, 7)]]),
        ("a length of the loop 0.01 mm too large", "constraint", put(0, 1e-5, 1.0)),
        ("a constraint of the wrong coordinate", "constraint", lambda value, t, q: value + (q[0] - q[3]) * 1e-3),
        ("one mass 0.1 % too large", "mass", put((0, 0), 0.0, 1.001)),
        ("an off-diagonal entry of M left out on one side", "mass", put((0, 1), 0.0)),
        ("an off-diagonal pair of M with the other sign", "mass", put(([0, 1], [1, 0]), 0.0, -1.0)),
        ("a negative inertia", "mass", put((2, 2), 0.0, -1.0)),
        ("the driving torque 0.01 % too large", "force", put(0, 3.3e-6, 1.0)),
        ("one generalised force with the other sign", "force", put(2, 0.0, -1.0)),
        ("a velocity term of the forces left out", "force", put(1, 0.0)),
        ("a force of velocity where none is", "force", lambda value, t, q, v: value - 1e-7 * v),
    ]
    for name, kind, edit in edits:
        yield Fault(name, "mechanism", problem=replace(sound, system=python_copy(sound.system, **{kind: edit})))
    rates: list[tuple[str, dict[str, Callable[..., Any]]]] = [
        ("C_t left out", {"constraint_rate": lambda value, *state: 0.0 * value}),
        ("C_t with the other sign", {"constraint_rate": lambda value, *state: -value}),
        ("C_tt left out of Q_d", {"gamma": lambda value, t, q, v: driven.system.gamma(0.0, q, v)}),
    ]
    for name, edit_of in rates:
        system = python_copy(driven.system, **edit_of)
        yield Fault(name, "mechanism", problem=replace(driven, system=system))
    moved = sound.q0 + 1e-6 * np.eye(7)[0]
    yield Fault("start off the constraints by 1e-6", "mechanism", problem=replace(sound, q0=moved))
    yield Fault("initial velocity off the constraints", "mechanism", problem=replace(sound, v0=np.full(7, 1e-3)))
    closed = mechanisms.projection_pendulum()
    yield Fault(
        "consistent start at another speed", "mechanism", problem=replace(closed, v0=closed.v0 + np.array([0.0, 1e-4]))
    )


@callback("force")
def frozen(t, q, v, p, Q):  # type: ignore[no-untyped-def]
    Q[1] = -weight


def pendulum_in_python(**changed: Any) -> ConstrainedSystem:
    """The pendulum of A01 in functions that can be traced, with others in the place of some."""
    given: dict[str, Any] = {"mass": lambda t, q: np.eye(2), "force": lambda t, q, v: np.array([0.0, -GRAVITY])}
    given |= {"constraint": lambda t, q: np.array([0.5 * (q @ q - 1.0)]), "jacobian": lambda t, q: q.reshape(1, 2)}
    given |= {"gamma": lambda t, q, v: np.array([-(v @ v)])} | changed
    return ConstrainedSystem.from_python(n_q=2, n_c=1, name="pendulum", **given)


def in_trace() -> Iterator[Fault]:
    """Callbacks of a pendulum that are not what they are traced to."""

    def swallowed(t: Any, q: Any, v: Any) -> Array:
        try:
            return np.array([0.0, -GRAVITY if t < 1e3 else -OTHER])
        except Exception:
            return np.array([0.0, -OTHER])

    def by_type(t: Any, q: Any, v: Any) -> Array:
        return np.array([0.0, -GRAVITY if isinstance(t, float) else -OTHER])

    def counting(most: int) -> Callable[..., Array]:
        calls = [0]

        def force(t: Any, q: Any, v: Any) -> Array:
            calls[0] += 1
            return np.array([0.0, -GRAVITY if calls[0] < most else -OTHER])

        return force

    sound = mechanisms.pendulum()
    given: dict[str, Any] = sound.system.given | {"force": frozen, "parameters": sound.system.parameters}
    in_numba = ConstrainedSystem(n_q=2, n_c=1, name="pendulum", **given)
    lopsided = pendulum_in_python(mass=lambda t, q: np.array([[1.0, 0.1 * q[1]], [0.0, 1.0]]))
    changed = partial(patch, "studies.planted_errors.faults.weight", OTHER)
    for name, system, plant in (
        ("a branch that tracing loses behind try/except", pendulum_in_python(force=swallowed), nullcontext),
        ("a branch on the type of t", pendulum_in_python(force=by_type), nullcontext),
        ("a global that changed after numba compiled", in_numba, changed),
        ("M symmetric at the start only", lopsided, nullcontext),
        ("a callback that changes after 5 calls", pendulum_in_python(force=counting(5)), nullcontext),
        ("a callback that changes after 100 calls", pendulum_in_python(force=counting(100)), nullcontext),
    ):
        yield Fault(name, "trace", plant, problem=replace(sound, system=system), solver=TRACING)


def in_reference() -> Iterator[Fault]:
    """The state that runs are compared with."""
    sound = mechanisms.andrews()
    known = sound.reference
    assert known is not None and known.lam is not None
    swapped = known.q[[1, 0, *range(2, 7)]]
    for name, change in (
        ("q off in the 7th digit", {"q": known.q * (1.0 + 3e-7 * np.eye(7)[0])}),
        ("v off in the 7th digit", {"v": known.v * (1.0 + 3e-7 * np.eye(7)[1])}),
        ("lam off in the 6th digit", {"lam": known.lam * (1.0 + 3e-6 * np.eye(6)[0])}),
        ("lam with the other sign", {"lam": -known.lam}),
        ("one velocity with the other sign", {"v": known.v * (1.0 - 2.0 * np.eye(7)[3])}),
        ("two coordinates swapped", {"q": swapped}),
        ("time of the state off by 1e-9 s", {"t": known.t + 1e-9}),
    ):
        yield Fault(name, "reference", problem=replace(sound, reference=replace(known, **change)))


def _changed(owner: Any, name: str, change: Callable[[Any], Any]) -> Callable[[], AbstractContextManager[Any]]:
    """What plants a function that returns change(what it returned)."""
    original = getattr(owner, name)

    def faulty(*arguments: Any, **named: Any) -> Any:
        return change(original(*arguments, **named))

    return lambda: patch.object(owner, name, faulty)


def in_tableau() -> Iterator[Fault]:
    """Numbers of the Runge-Kutta methods."""

    def off(pair: tuple[Array, Array]) -> tuple[Array, Array]:
        A = pair[0].copy()
        A[0, -1] += 1e-6
        return A, pair[1]

    faults: list[tuple[str, str, Callable[[Any], Any]]] = [
        ("an a_ij off by 1e-6", "_collocation", off),
        ("weights in the other order", "_collocation", lambda pair: (pair[0], pair[1][::-1])),
        ("A transposed", "_collocation", lambda pair: (pair[0].T.copy(), pair[1])),
        ("nodes mirrored", "_nodes", lambda c: np.sort(1.0 - c)),
        ("one node off by 1e-9", "_nodes", lambda c: c + 1e-9 * (np.arange(c.size) == 0)),
        ("A of Sun's family off by 1e-9", "_symplectic_average", lambda A: A + 1e-9 * np.eye(len(A))),
    ]
    for name, attribute, change in faults:
        yield Fault(name, "tableau", _changed(tableaux, attribute, change), (TABLEAUX,))
    plain = partial(patch.object, tableaux, "_symplectic_average", lambda A, b: A)
    yield Fault("the symplectic average left out", "tableau", plain, (TABLEAUX,))
    for name in ("A", "B", "C", "E3", "E5"):
        array = getattr(dop853, name).copy()
        array[np.unravel_index(np.flatnonzero(array)[1], array.shape)] += 1e-6
        plant = partial(patch.object, dop853, name, array)
        yield Fault(f"a number of DOP853's {name} off by 1e-6", "tableau", plant, (EXPLICIT,))
    off_twice = _changed(collocation_code, "tables", lambda all_: all_._replace(positions=all_.positions + 1e-9))
    yield Fault("double integrals of Lobatto16 off by 1e-9", "tableau", off_twice, (LOBATTO,))


def in_options() -> Iterator[Fault]:
    """The plan of a method: what its compiled step and the step-size control read."""
    from twoloop.kernels.paper import newmark_step as newmark

    sound, pendulum = mechanisms.andrews(), mechanisms.projection_pendulum()

    def planned(owner: Any, **changed: Any) -> Callable[[], AbstractContextManager[Any]]:
        return _changed(owner, "plan", lambda plan: replace(plan, **changed))

    def swapped(plan: Plan) -> Plan:
        plan.options[[newmark.BETA, newmark.GAMMA]] = plan.options[[newmark.GAMMA, newmark.BETA]]
        return plan

    orders = "tests/kernels/test_orders.py::test_observed_order_is_the_theoretical_one[newmark(1/4)]"
    plant = _changed(methods.Newmark, "plan", swapped)
    yield Fault("beta and gamma of Newmark swapped", "options", plant, (orders,))
    for name, owner, solver, change in (
        ("exponent of the error 1 in place of 1/8", DOP853, "DOP853 (twoloop)", {"exponent": 1.0}),
        ("exponent of the error with the other sign", DOP853, "DOP853 (twoloop)", {"exponent": -0.125}),
        ("exponent of the error 1 in place of 1/6", methods.RungeKutta, "RadauIIA9", {"exponent": 1.0}),
        ("steps that never grow", methods.RungeKutta, "Gauss12", {"factor_max": 1.0}),
        ("a safety factor of 9", DOP853, "DOP853 (twoloop)", {"safety": 9.0}),
        ("a safety factor of 0.09", DOP853, "DOP853 (twoloop)", {"safety": 0.09}),
    ):
        yield Fault(name, "options", planned(owner, **change), problem=sound, solver=solver)
    original = solvers.solve_dae

    def looser(*arguments: Any, **named: Any) -> Result:
        system, t_span, q0, v0, method, rtol, atol = arguments
        return original(system, t_span, q0, v0, method, 1e4 * rtol, 1e4 * atol, **named)

    loose = partial(patch.object, solvers, "solve_dae", looser)
    yield Fault("tolerances handed on 1e4 times too large", "options", loose, problem=pendulum)


def in_adapter() -> Iterator[Fault]:
    """What comes back from our methods and from SciPy's."""
    sound = mechanisms.double_pendulum()
    entry = solvers.CATALOGUE[SCIPY]

    def foreign(change: Callable[[Any], Any]) -> Callable[[], AbstractContextManager[Any]]:
        changed = replace(entry, run=lambda *cell: change(entry.run(*cell)))
        return partial(patch.dict, solvers.CATALOGUE, {SCIPY: changed})

    own = partial(_changed, solvers, "solve_dae")
    for solver, whose, plant in (("Gauss12", "twoloop", own), (SCIPY, "SciPy's", foreign)):
        for what, change in (
            ("multipliers with the other sign", lambda result: replace(result, lam=-result.lam)),
            ("velocities of the step before", lambda result: replace(result, v=np.roll(result.v, 1, axis=1))),
            ("two coordinates swapped", lambda result: replace(result, q=result.q[[1, 0, 2, 3]])),
            ("single precision", lambda result: replace(result, q=result.q.astype(np.float32).astype(float))),
            ("the end 1e-6 s too early", lambda result: replace(result, q=result.q - 1e-6 * result.v)),
            ("accelerations of the other sign", lambda result: replace(result, a=-result.a)),
        ):
            yield Fault(f"{what} ({whose})", "adapter", plant(change), problem=sound, solver=solver)


def in_report() -> Iterator[Fault]:
    """Measures, medians, rankings and numbers of a report."""

    def fault(name: str, owner: Any, attribute: str, change: Callable[[Any], Any], check: str) -> Fault:
        return Fault(name, "report", _changed(owner, attribute, change), (check,))

    def columns_swapped(lines: list[list[str]]) -> list[list[str]]:
        return [[*line[:2], *line[:1:-1]] for line in lines]

    def halved(levels: tuple[Any, dict[str, Array]]) -> tuple[Any, dict[str, Array]]:
        return levels[0], {level: 0.0 * size for level, size in levels[1].items()}

    yield fault("columns of the table of costs swapped", tables, "work_precision", columns_swapped, TABLES)
    yield fault("costs at equal error 10 % too small", tables, "time_for", lambda time: 0.9 * time, TABLES)
    yield fault("a ranking that begins with the dearest", tables, "ranking", lambda rows: rows.iloc[::-1], TABLES)
    yield fault("failed runs left out", tables, "medians", lambda rows: rows[rows["status"] == "REACHED_END"], TABLES)
    yield fault("violations counted as 0", metrics, "violations", halved, METRICS)
    yield fault("deviations 1.5 times too large", metrics, "deviation", lambda q_v: (1.5 * q_v[0], q_v[1]), METRICS)
    yield fault("digits by the natural logarithm", metrics, "correct_digits", lambda x: x * math.log(10.0), METRICS)
    yield fault("errors of multipliers left out", metrics, "_error_lam", lambda size: None, METRICS)
    yield fault("minus signs lost", render, "number", lambda text: text.replace("−", ""), RENDER)
    yield fault("percentages a hundred times too small", render, "percent", lambda text: "0." + text, RENDER)


def all_faults() -> list[Fault]:
    made = (in_mechanism, in_trace, in_reference, in_tableau, in_options, in_adapter, in_report)
    return [fault for make in made for fault in make()]
