"""Whether forces, C_t or b may change suddenly with time, by what their callbacks are traced to."""

from typing import Any, NamedTuple

from twoloop.generate.families import Evaluator, Family, of_family
from twoloop.generate.traced_equations import Equations
from twoloop.generate.traced_values import unchecked
from twoloop.generate.tracing import Form, Graph, Untraceable
from twoloop.kernels.evaluation.operations import COSINE, PRODUCT, SINE, SUM
from twoloop.problem.system import ConstrainedSystem

SMOOTH = (PRODUCT, SUM, SINE, COSINE)  # polynomials and vibrations: nothing happens in a short time alone ...
HIGHEST = 8  # ... up to this degree: a high power of a cosine is a pulse
LARGEST = 300  # coordinates: to trace the forces of more takes up to seconds, the looks of a run a tenth of it
BY_TIME = 1  # the bit of t, the first input of a graph


class TimeDependence(NamedTuple):
    """What is known of a family of systems."""

    is_sudden: bool
    kinds: frozenset[str]  # of callbacks that ran on symbols

    def of(self, system: ConstrainedSystem, evaluate: Evaluator) -> "TimeDependence":
        """That of one of the systems: the same."""
        return self


def may_be_sudden(system: ConstrainedSystem, ran_on_symbols: bool) -> bool:
    """Whether a force, C_t or b may act for a short time; so may what cannot be traced.

    Functions called in Python run on symbols only if the force has done so: they may keep what they are given.
    """
    if system.n_q > LARGEST or (system.called_in_python and not ran_on_symbols):
        return True
    try:
        known: TimeDependence = of_family(system, "time dependence", _traced(system), unchecked)
    except Untraceable:
        return True
    return known.is_sudden


def _traced(system: ConstrainedSystem) -> Any:
    def make(family: Family) -> TimeDependence:
        equations = Equations(system, family.parameters)
        kinds = ("force", "constraint_rate", "nonholonomic_rate")
        forms = [form for kind in kinds if kind in system.given for form in equations.of(kind).ravel()]
        return TimeDependence(_is_sudden(equations.graph, forms), frozenset(equations.graph.traced))

    return make


def _is_sudden(graph: Graph, forms: list[Form]) -> bool:
    degrees = {0: 1}  # in time, or in vibrations with it; 0 of what is not here

    def degree(form: Form | None) -> int:
        return 0 if form is None else max((degrees.get(i, 0) for i in form.terms), default=0)

    for i in graph.needed_by(forms):
        operation = graph.operations[i]
        if operation is None or not graph.inputs_of[i] & BY_TIME:
            continue
        kind, first, second = operation
        degrees[i] = degree(first) + degree(second) if kind == PRODUCT else degree(first)
        if kind not in SMOOTH or degrees[i] > HIGHEST:
            return True
    return False
