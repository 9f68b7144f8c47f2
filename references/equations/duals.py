"""Values with their derivatives by several unknowns, of expressions of any package; what is zero is left out."""

from collections.abc import Callable, Mapping
from typing import Any

Function = Callable[[Any], Any]


class Dual:
    """A value, and its derivatives by the unknowns that it depends on."""

    def __init__(self, value: Any, by: Mapping[int, Any]):
        self.value, self.by = value, by

    def _chained(self, value: Any, slope: Any) -> "Dual":
        return Dual(value, {k: slope * rate for k, rate in self.by.items()})

    def __add__(self, other: Any) -> Any:
        if not isinstance(other, Dual):
            return Dual(self.value + other, self.by)
        by = dict(self.by)
        for k, rate in other.by.items():
            by[k] = by[k] + rate if k in by else rate
        return Dual(self.value + other.value, by)

    def __mul__(self, other: Any) -> Any:
        if not isinstance(other, Dual):
            return 0.0 if isinstance(other, int | float) and other == 0.0 else self._chained(self.value * other, other)
        product = self.value * other.value
        return self._chained(product, other.value) + Dual(0.0, other._chained(0.0, self.value).by)

    __radd__, __rmul__ = __add__, __mul__

    def __neg__(self) -> Any:
        return self._chained(-self.value, -1.0)

    def __sub__(self, other: Any) -> Any:
        return self + -other

    def __rsub__(self, other: Any) -> Any:
        return -self + other

    def __truediv__(self, other: Any) -> Any:
        return self * (1.0 / other)

    def __rtruediv__(self, other: Any) -> Any:
        inverse = 1.0 / self.value
        return self._chained(inverse, -(inverse * inverse)) * other

    def __pow__(self, exponent: Any) -> Any:
        if exponent == 1:
            return self
        return self._chained(self.value**exponent, exponent * self.value ** (exponent - 1))


def functions_on_duals(functions: Mapping[str, Function]) -> dict[str, Function]:
    """These functions of numbers, taken of duals."""
    f = functions
    slopes: dict[str, Callable[[Any, Any], Any]] = {  # of the argument and the value
        "sin": lambda x, _: f["cos"](x),
        "cos": lambda x, _: -f["sin"](x),
        "tan": lambda _, y: 1.0 + y * y,
        "sqrt": lambda _, y: 0.5 / y,
        "exp": lambda _, y: y,
        "log": lambda x, _: 1.0 / x,
        "sinh": lambda x, _: f["cosh"](x),
        "cosh": lambda x, _: f["sinh"](x),
        "tanh": lambda _, y: 1.0 - y * y,
        "asin": lambda x, _: 1.0 / f["sqrt"](1.0 - x * x),
        "acos": lambda x, _: -1.0 / f["sqrt"](1.0 - x * x),
        "atan": lambda x, _: 1.0 / (1.0 + x * x),
    }

    def on_dual(name: str) -> Function:
        def function(x: Any) -> Any:
            if not isinstance(x, Dual):  # of t alone
                return f[name](x)
            value = f[name](x.value)
            return x._chained(value, slopes[name](x.value, value))

        return function

    return {name: on_dual(name) for name in functions}
