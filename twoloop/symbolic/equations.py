"""Equations of motion in plain symbols, with all derivatives required by the callbacks."""

from collections.abc import Sequence
from dataclasses import dataclass

import sympy
from sympy import Expr, Symbol

from twoloop.symbolic.differentiation import ZERO, Entries, filled
from twoloop.symbolic.printing import callback_source, energy_source
from twoloop.symbolic.reading import Reader


@dataclass(frozen=True)
class Equations:
    """M a + C_q^T lam + A^T mu = Q with C(t, q) = 0 and A v + b = 0.

    Attributes
    ----------
    symbols : Reader
        The symbols of the expressions.
    M : matrix (n_q, n_q)
        Mass matrix, independent of the velocities; the upper triangle is used.
    Q : sequence (n_q,)
        Generalised forces.
    C : sequence (n_c,)
        Position constraints.
    W : sequence (n_a,)
        Non-holonomic constraints A v + b, linear in v.
    energy : expression
    conserved : bool
        True if the energy is an invariant.
    """

    symbols: Reader
    M: sympy.MatrixBase
    Q: Sequence[Expr]
    C: Sequence[Expr]
    W: Sequence[Expr]
    energy: Expr
    conserved: bool

    @property
    def constant_mass(self) -> bool:
        """Return True if M depends neither on t nor on q."""
        moving = {self.symbols.t, *self.symbols.q}
        return not any(entry.free_symbols & moving for entry in self.M)

    def source(self, tangents: bool) -> str:
        """Return the generated code: a function for each callback, and the energy."""
        tangents = tangents and not self.W  # not supported with non-holonomic rows
        arrays = self._callbacks() | (self._tangents() if tangents else {})
        constant = self.constant_mass
        known = {
            "CONSTANT_MASS": constant,
            "BANDWIDTH": self._bandwidth() if constant else None,
            "CONSERVED": self.conserved,
        }
        parts = ["".join(f"{name} = {value}\n" for name, value in known.items())]
        parts += [callback_source(kind, each) for kind, each in arrays.items()]
        return "\n\n".join([*parts, energy_source(self.energy)])

    def _bandwidth(self) -> int:
        """Return the largest distance of two coordinates coupled by M, the force or a constraint."""
        x, d = self.symbols, self.symbols.differentiation
        places = {symbol: j for symbols in (x.q, x.v) for j, symbol in enumerate(symbols)}
        entries = [*enumerate(self.Q), *((j, entry) for (_, j), entry in d.rows(self.C, x.q).items())]
        pairs = [(i, places[symbol]) for i, entry in entries for symbol in d.symbols_of(entry) & set(places)]
        pairs += [divmod(place, self.M.cols) for place, entry in enumerate(self.M) if entry != 0]
        return max((abs(i - j) for i, j in pairs), default=0)

    def _callbacks(self) -> dict[str, list[Entries]]:
        x, d, n = self.symbols, self.symbols.differentiation, range(len(self.symbols.q))
        found = {
            "mass": [filled(((i, j), self.M[min(i, j), max(i, j)]) for i in n for j in n)],
            "force": [filled(enumerate(self.Q))],
        }
        if self.C:
            rows, rate = d.rows(self.C, x.q), [d.by(each, x.t) for each in self.C]
            moving = [rate[i] + sum(rows.get((i, j), ZERO) * x.v[j] for j in n) for i in range(len(self.C))]
            C, Ct, Qd = (filled(enumerate(each)) for each in (self.C, rate, accelerations(moving, x)))
            found |= {"constraint": [C], "jacobian": [rows]} | ({"constraint_rate": [Ct]} if Ct else {})
            found |= {"gamma": [Qd], "kinematics": [C, rows, Ct, Qd]}
        if self.W:
            still = dict.fromkeys(x.v, ZERO)
            b = filled((i, each.xreplace(still)) for i, each in enumerate(self.W))
            found |= {"nonholonomic": [d.rows(self.W, x.v)]} | ({"nonholonomic_rate": [b]} if b else {})
            found["nonholonomic_gamma"] = [filled(enumerate(accelerations(self.W, x)))]
        return found

    def _tangents(self) -> dict[str, list[Entries]]:
        x, d, n = self.symbols, self.symbols.differentiation, range(len(self.symbols.q))
        found = {"force_by_q": [d.rows(self.Q, x.q)]}
        by_v = d.rows(self.Q, x.v)
        if by_v:
            found["force_by_v"] = [by_v]
        if self.C:
            lam, rows = [Symbol(f"lam{k}") for k in range(len(self.C))], d.rows(self.C, x.q)
            reaction = [sympy.Add(*(lam[k] * rows.get((k, i), ZERO) for k in range(len(lam)))) for i in n]
            found["reaction_by_q"] = [d.symmetric(reaction, x.q)]
        return found


def along(expressions: Sequence[Expr], x: Reader) -> list[Expr]:
    """Return the time derivatives of expressions without the terms in the accelerations."""
    rates: list[list[Expr]] = [[x.differentiation.by(each, x.t)] for each in expressions]
    for (i, j), entry in x.differentiation.rows(expressions, x.q).items():
        rates[i].append(entry * x.v[j])
    return [sympy.Add(*terms) for terms in rates]


def accelerations(expressions: Sequence[Expr], x: Reader) -> list[Expr]:
    """Return the right-hand side of the acceleration equations that keep expressions in q and v constant."""
    return [-each for each in along(expressions, x)]


def linear(argument: str, expressions: Sequence[Expr], x: Reader) -> Entries:
    """Return the derivatives with respect to the velocities; raise ValueError unless these are constant in v."""
    rows, velocities = x.differentiation.rows(expressions, x.v), set(x.v)
    for (i, j), entry in rows.items():
        if x.differentiation.symbols_of(entry) & velocities:
            rows[i, j] = entry.expand()
            if rows[i, j].free_symbols & velocities:
                raise ValueError(
                    f"{argument}[{i}] must be linear in the velocities; its derivative by that of {x.names[j]} depends "
                    "on velocities"
                )
    return filled(rows.items())
