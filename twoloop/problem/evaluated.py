"""The equations of a system at a state: values of its callbacks and what is made of these."""

from __future__ import annotations  # ArrayLike stays a word in help()

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import ArrayLike

from twoloop.checks.arguments import Array, check_number, check_real, shaped, shown
from twoloop.checks.bounds import check_callback
from twoloop.checks.sparse_rows import Rows, SparseRows
from twoloop.kernels.compile.callbacks import KINDS, STATE
from twoloop.problem.adapters import store


class EvaluatedEquations:
    """What a ConstrainedSystem, whose attributes these methods read, makes of its callbacks."""

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any: ...

    def remembered(self, what: Any, make: Callable[[], Any]) -> Any:
        """What `make` makes of the equations with these parameters, once; functions may do otherwise."""
        if self._python is not None:  # what such functions find in their surroundings may change
            return make()
        if what not in self.made:
            self.made[what] = make()
        return self.made[what]

    def remembered_at(self, what: Any, state: Any, make: Callable[[], Any]) -> Any:
        """The same of the equations at a state, as long as no other state is asked for."""
        if self._python is not None:
            return make()
        known = self.made.get(what)
        if known is None or known[0] != state:
            known = self.made[what] = state, make()
        return known[1]

    def remember_at(self, what: Any, state: Any, made: Any) -> None:
        """Let `remembered_at` have what was made beside something else."""
        if self._python is None:
            self.made[what] = state, made

    def arrays_of(self, kind: str) -> list[Array]:
        """Zeros for a kind of callback to fill."""
        return [np.zeros(shape) for shape in self._shapes[kind]]

    def evaluate(self, kind: str, t: float, *state: ArrayLike) -> Any:
        """What a callback gives at (t, q), (t, q, v) or (t, q, lam), whichever its kind asks for.

        Raises
        ------
        TypeError, ValueError
            If an argument is wrong, if the callback goes out of the bounds of its arrays, or if there is none and
            nothing can stand for it, as for gamma: the integrator then finds it by differences.
        """
        if kind not in KINDS:
            raise ValueError(f"kind must be one of {', '.join(KINDS)}; given {shown(kind)}")
        entry = KINDS[kind]
        if entry.absent == "kernels" and kind not in self.given:
            raise ValueError(f"{self.name!r} was given no {kind}")
        t = check_number("t", t)
        if not math.isfinite(t):
            raise ValueError(f"t must be finite; given {t!r}")
        if len(state) != len(entry.state):
            wanted = ", ".join(("t", *entry.state))
            raise TypeError(f"{kind} is evaluated at ({wanted}); given {len(state)} arrays after t")
        arrays = []
        for name, value in zip(entry.state, state, strict=True):
            array = check_real(name, value)
            if array.shape != (n := getattr(self, STATE[name]),):
                raise ValueError(
                    f"{name} must have shape ({n},), as {STATE[name]} = {n} in {self.name!r}; given {shaped(array)}"
                )
            arrays.append(np.ascontiguousarray(array))
        check_callback(cast(Any, self), kind, t, arrays)
        out = self.arrays_of(kind)
        getattr(self.functions, kind)(t, *arrays, self.functions.p, *out)
        return out[0] if len(out) == 1 else tuple(out)

    def check_returned(self, t: float, q: Array, v: Array) -> None:
        """Say what is wrong with the arrays that functions given with `compile=True` return at (t, q, v).

        Machine code can only say that a shape is wrong, not which.
        """
        for kind, function in self._returning.items():
            known = {"q": q, "v": v, "lam": np.ones(self.n_c)}
            arguments = [known[name].copy() for name in KINDS[kind].state]
            store(kind, self.name, t, function(t, *arguments, *self.parameters_for(kind)), self.arrays_of(kind)[0])

    def velocity_constraint(self, t: float, q: Array, v: Array) -> Array:
        """C_q v + C_t and A v + b, (n_c + n_a,): zero for consistent velocities (eq. (4))."""
        return self.sparse_rows(t, q) @ np.asarray(v, dtype=np.float64) + self.rates(t, q)

    def rows(self, t: float, q: ArrayLike) -> Array:
        """C_q, then A, (n_c + n_a, n_q)."""
        return self.jacobian(t, q) if self.n_a == 0 else np.vstack([self.jacobian(t, q), self.nonholonomic(t, q)])

    def sparse_rows(self, t: float, q: ArrayLike) -> Rows:
        """The same by their entries, where `jacobian_values` gives these."""
        if self.n_a > 0 or "jacobian" not in self.entries:
            return self.rows(t, q)
        values, shape = self.jacobian_values(t, q), (self.n_c, self.n_q)
        rows, columns = self.entries["jacobian"]
        made = self.remembered("sparse rows", lambda: SparseRows(rows, columns, values, shape))
        return made.with_values(made.added(values))  # type: ignore[no-any-return]

    def rates(self, t: float, q: ArrayLike) -> Array:
        """C_t, then b, (n_c + n_a,)."""
        rate = self.constraint_rate(t, q)
        return rate if self.n_a == 0 else np.append(rate, self.nonholonomic_rate(t, q))
