"""Derivatives of traced quantities."""

from twoloop.generate.tracing import Form, Graph
from twoloop.kernels.evaluation import operations as op


class Derivative:
    """Derivatives of quantities along a direction in which the inputs change, by the rules of differentiation."""

    def __init__(self, graph: Graph, direction: dict[int, Form]):
        self.graph = graph
        self._known = dict(direction)
        self._changing = sum(1 << i for i in direction)

    def of(self, form: Form) -> Form:
        """The derivative of a form."""
        total = Form(self.graph, 0.0, {})
        for i, c in form.terms.items():
            if self.graph.inputs_of[i] & self._changing:
                total = total + self._of_quantity(i).times(c)
        return total

    def _of_quantity(self, i: int) -> Form:
        ahead = [i]  # no recursion: products may be a thousand deep
        while i not in self._known:
            operation = self.graph.operations[ahead[-1]]
            forms = () if operation is None else [form for form in operation[1:] if isinstance(form, Form)]
            unknown = [
                k
                for form in forms
                for k in form.terms
                if k not in self._known and self.graph.inputs_of[k] & self._changing
            ]
            if unknown:
                ahead += unknown
                continue
            k = ahead.pop()
            if k not in self._known:
                change = Form(self.graph, 0.0, {}) if operation is None else self._of_operation(k, *operation)
                self._known[k] = change.value()
        return self._known[i]

    def _of_operation(self, i: int, kind: int, first: Form, second: Form | None) -> Form:
        result, change = self.graph.quantity(i), self.of(first)
        if kind == op.PRODUCT:
            assert second is not None
            return change * second + first * self.of(second)
        if kind == op.SUM:
            return change
        if kind == op.RECIPROCAL:
            return -(change * result * result)
        if kind == op.SQUARE_ROOT:
            return change * result.reciprocal() * 0.5
        if kind == op.EXPONENTIAL:
            return change * result
        if kind == op.SINE:
            return change * first.cosine()
        if kind == op.COSINE:
            return -(change * first.sine())
        assert kind in (op.LOGARITHM, op.ARCTANGENT) and second is not None
        return change * second.reciprocal()
