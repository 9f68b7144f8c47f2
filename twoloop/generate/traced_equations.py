"""The equations of one system, traced: every callback as an array of forms, and exact derivatives of what is not given.

Series, straight-line code, references and the programs that stand for callbacks that are not given read them from here.
"""

import copy
from collections.abc import Sequence
from contextlib import nullcontext, suppress
from typing import Any

import numpy as np

from twoloop.generate.calls_on_symbols import as_forms, trace
from twoloop.generate.derivative import Derivative
from twoloop.generate.known_numbers import Known, elementwise
from twoloop.generate.tracing import Form, Graph, Untraceable, symbols
from twoloop.kernels.compile.callbacks import KINDS
from twoloop.problem.system import ConstrainedSystem

# in the order in which they are traced
CALLBACKS = (
    *("constraint", "constraint_rate", "jacobian", "nonholonomic", "nonholonomic_rate", "mass", "force"),
    *("gamma", "nonholonomic_gamma"),
)
OF_ROWS = {"gamma": ("jacobian", "constraint_rate"), "nonholonomic_gamma": ("nonholonomic", "nonholonomic_rate")}


class Equations:
    """What the callbacks of a system make of symbols; each is traced when it is first asked for, once.

    Parameters
    ----------
    system : ConstrainedSystem
    parameters : array of float or Known, optional
        In the place of its own.

    Attributes
    ----------
    graph : Graph
        Its first quantities are t, q and v.
    t : Form
    q, v : list of Form (n_q,)
    """

    def __init__(self, system: ConstrainedSystem, parameters: Any = None):
        self.system, self.graph = system, Graph()
        self.parameters = system.parameters if parameters is None else parameters
        self.watched: Any = next((x.record.watched for x in self.parameters if type(x) is Known), nullcontext)
        (self.t,) = self.graph.inputs(1, False)
        self.q, self.v = self.graph.inputs(system.n_q, False), self.graph.inputs(system.n_q, True)
        self._made: dict[str, Any] = {}
        self._before: dict[str, Any] = {}  # what was traced in the graph of which this one is a copy

    def trace_all(self) -> "Equations":
        """Trace all callbacks that can be traced, for copies."""
        for kind in CALLBACKS:
            if not self._is_derived(kind):
                with suppress(Untraceable):  # which who needs it is told
                    self.of(kind)
        return self

    def copy(self) -> "Equations":
        """Equations with a graph of their own, in which what was traced here is not traced again."""
        other = copy.copy(self)
        other.graph = self.graph.copy()
        other.t, other.q, other.v = (
            self.t.on(other.graph),
            *([x.on(other.graph) for x in each] for each in (self.q, self.v)),
        )
        other._made, other._before = {}, self.graph.traced
        return other

    def of(self, kind: str, v: Sequence[Form] | None = None) -> Any:
        """What a kind of callback gives, as an array of forms: zeros, or derivatives, where there is none.

        `v`: forms in the place of the velocities, if not these themselves.

        Raises
        ------
        Untraceable
            If a callback does not run on symbols; says which, and why.
        """
        if v is not None and "v" in KINDS[kind].state:
            return self._make(kind, v)
        if kind not in self._made:
            self._made[kind] = self._make(kind, self.v)
        return self._made[kind].copy()

    def derived(self, kind: str, v: Sequence[Form] | None = None) -> Any:
        """C_q, C_t or a right-hand side by the rules of differentiation, whether there is a callback or not."""
        if kind == "jacobian":
            return self._jacobian()
        return self._rate() if kind == "constraint_rate" else self._gamma(*OF_ROWS[kind], self.v if v is None else v)

    def _make(self, kind: str, v: Sequence[Form]) -> Any:
        if self._is_derived(kind):
            return self.derived(kind, v)
        if kind in self._before and v is self.v:
            made = elementwise(lambda form: form.on(self.graph), [self._before[kind]])
            self.graph.traced.setdefault(kind, made.copy())
            return made
        return self._traced(kind, v)

    def _is_derived(self, kind: str) -> bool:
        return kind not in self.system.given and kind in ("jacobian", *OF_ROWS)

    def _traced(self, kind: str, v: Sequence[Form]) -> Any:
        system, graph, (out,) = self.system, self.graph, self.system.arrays_of(kind)
        out, shape, p = out.astype(object), out.shape, self.parameters.copy()
        arrays = [symbols({"q": self.q, "v": v}[name]) for name in KINDS[kind].state]
        if out.size:
            try:
                with self.watched():
                    if not system.called_in_python:
                        trace(getattr(system.functions, kind), self.t, *arrays, p, out)
                    elif kind in system.python_functions:
                        function, more = system.python_functions[kind], (p,) if system.takes_parameters(kind) else ()
                        out = np.array(trace(function, self.t, *arrays, *more), dtype=object)
                    out = as_forms(graph, out)
                    if out.shape != shape:
                        raise Untraceable(f"on symbols it returns an array of shape {out.shape}, not {shape}")
            except Untraceable as error:
                raise Untraceable(f"{kind} of {system.name!r}: {error}") from error
        graph.traced.setdefault(kind, out.copy())
        return out

    def _jacobian(self) -> Any:
        """C_q from C."""
        constraint, one = self.of("constraint"), Form(self.graph, 1.0, {})
        made = np.empty((self.system.n_c, self.system.n_q), dtype=object)
        for j, coordinate in enumerate(self.q):
            by = Derivative(self.graph, {only(coordinate): one})
            made[:, j] = [by.of(form) for form in constraint]
        return made

    def _rate(self) -> Any:
        """C_t from C."""
        constraint, by_t = self.of("constraint"), Derivative(self.graph, {only(self.t): Form(self.graph, 1.0, {})})
        return symbols(by_t.of(form) for form in constraint)

    def _gamma(self, rows: str, rates: str, v: Sequence[Form]) -> Any:
        """-(dG/dt v + dG_t/dt) at constant v, the right-hand side of G a = gamma, by the rules of differentiation."""
        moving = {only(coordinate): u for coordinate, u in zip(self.q, v, strict=True)}
        along = Derivative(self.graph, {only(self.t): Form(self.graph, 1.0, {}), **moving})
        made = self.of(rates)
        for i, row in enumerate(self.of(rows)):
            total = along.of(made[i])
            for entry, u in zip(row, v, strict=True):
                total = total + along.of(entry) * u if entry.terms else total
            made[i] = -total
        return made


def runs_on_symbols(system: ConstrainedSystem, kind: str, parameters: Any) -> bool:
    """Whether a compiled callback does the same whatever its arguments are, and these parameters where they vary."""
    equations = Equations(system, parameters)
    state = {"q": equations.q, "v": equations.v, "lam": equations.graph.inputs(system.n_c, True)}
    arrays = [symbols(state[name]) for name in KINDS[kind].state]
    filled = [array.astype(object) for array in system.arrays_of(kind)]
    try:
        with equations.watched():
            trace(getattr(system.functions, kind), equations.t, *arrays, equations.parameters.copy(), *filled)
            for array in filled:
                as_forms(equations.graph, array)
    except (Untraceable, ArithmeticError, RecursionError):
        return False
    return True


def only(form: Form) -> int:
    """The one quantity that a form is."""
    (place,) = form.terms
    return place
