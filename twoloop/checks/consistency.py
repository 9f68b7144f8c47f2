"""Check the state at the start: consistent, of full rank, finite.

A violation is measured by the correction that would make the state consistent.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from twoloop.checks.arguments import Array
from twoloop.checks.callbacks import UNSYMMETRIC, check_bounds, unsymmetric_mass
from twoloop.checks.derivatives import check_derivatives
from twoloop.checks.scales import EPS, NONE, Scales, defined, generic_factors, scales_of, signs
from twoloop.checks.sparse_rows import Rows, SparseRows
from twoloop.checks.structure import SINGULAR_MASS, mass_key, not_finite, pattern_of, shifts
from twoloop.kernels.compile.linking import entry_point

if TYPE_CHECKING:
    from twoloop.problem.system import ConstrainedSystem


CONSISTENT = 1e-8  # largest correction that an initial state may need, relative to the size of the mechanism
# if the ratios (correction / limit) of two coordinates differ relatively by at most this number, they count as equal,
# and the message names the first coordinate
TIED = 1e-6
NEIGHBOURS = 4  # number of neighbouring positions at which constraints are evaluated to measure their rounding
# largest rounding error of a constraint, relative to the largest coordinate times the largest entry of the row
MOST_NOISE = 1e-11
# a singular value of M in units of the inertia counts as zero if it is below this fraction of the largest one
NO_INERTIA = 1e-12
ROUNDING = 64.0  # allowed rounding error of the state, in spacings of floating-point numbers


def is_at_rounding(values: Array, rows: Rows, state: Array, rate: Array | float = 0.0) -> bool:
    """Return whether `values` are no larger than the rounding of their terms; then no scales need to be computed.

    Scales need full matrices, which this test avoids for sparse rows. In it, each entry of `rows` counts as the largest
    entry of its row, which allows for rounding of the entries.
    """
    if isinstance(rows, SparseRows):
        terms = rows.largest() * (rows.pattern() @ np.abs(state)) + np.abs(rate)
        return bool((np.abs(values) <= ROUNDING * EPS * terms).all())
    return bool((np.abs(values) <= ROUNDING * EPS * (abs(rows) @ np.abs(state) + np.abs(rate))).all())


def _noise(q: Array, change: Callable[[Array], Array], rows: Array, largest: float) -> Array:
    """Estimate how much rounding of q changes each constraint (n_rows,), from values at neighbouring positions.

    `largest`: largest coordinate, or velocity, by which the rows are multiplied.
    """
    noise = np.zeros(len(rows))
    for k in range(NEIGHBOURS):
        noise = np.maximum(noise, np.abs(change(q * (1.0 + EPS * np.roll(signs(len(q)), k)))))
    limit = MOST_NOISE * largest * np.abs(rows).max(axis=1, initial=0.0)
    return np.where(np.isfinite(noise), np.minimum(noise, limit), 0.0)


def _unconstrained_accelerations(system: ConstrainedSystem, t: float, q: Array, v: Array, columns: Array) -> Array:
    """Return the accelerations M^-1 Q without constraints; zero in directions without inertia, as of Euler parameters.

    The constraints exclude these directions. Rounding may give such an M an inverse of 1e16. So small singular values
    count as zero, in units in which the largest inertia of each coordinate, at q or nearby, is 1.
    """
    mass, inertia = system.mass(t, q), np.zeros(len(q))
    for each in (mass, defined(lambda: system.mass(t, q + columns * generic_factors(len(q))))):
        if each is not None:
            inertia = np.maximum(inertia, np.abs(np.diag(each)))
    units = np.divide(1.0, np.sqrt(inertia), out=np.zeros(len(q)), where=inertia > 0.0)
    force = system.force(t, q, v)
    accelerations: Array = units * np.linalg.lstsq(units[:, None] * mass * units, units * force, rcond=NO_INERTIA)[0]
    return accelerations


class Violation:
    """Violation of constraints by a state, measured by the change of coordinates (or velocities) that corrects it.

    `correction`: Newton correction by least squares, with coordinates weighted by their scales. `allowed`: largest
    accepted correction, 1e-8 of the mechanism's size plus rounding. `left`: residual after the correction, which
    remains if rows of C_q are dependent or zero; `allowed_left`: its limit.
    """

    def __init__(
        self,
        system: ConstrainedSystem,
        t: float,
        equation: str,
        values: Array,
        terms: Array,
        jacobian: Array,
        scales: Scales,
        per_row: Array,
        spacing: Array,
    ):
        self.system, self.t, self.equation, self.values = system, t, equation, values
        scaled = scales.scaled(jacobian)
        inverse = np.linalg.pinv(scaled, rcond=1e-10)
        self.correction = -scales.columns * (inverse @ (values / scales.rows))
        by_rounding = scales.columns * (np.abs(inverse) @ (terms / scales.rows)) + spacing
        self.allowed = CONSISTENT * scales.by_coordinate(per_row, jacobian) + ROUNDING * EPS * by_rounding
        self.left = np.abs(values + jacobian @ self.correction) / scales.rows
        self.allowed_left = CONSISTENT * per_row + ROUNDING * EPS * terms / scales.rows

    @classmethod
    def measure_q(cls, system: ConstrainedSystem, t: float, q: Array, jacobian: Array, scales: Scales) -> Violation:
        """Measure the violation of C(t, q) = 0 at a position."""
        values, size = system.constraint(t, q), np.abs(q)

        def change(neighbour: Array) -> Array:  # its rounding shows whether C is a difference of large terms
            return system.constraint(t, neighbour) - values - jacobian @ (neighbour - q)

        noise = _noise(q, change, jacobian, float(size.max(initial=0.0)))
        terms = np.maximum(np.abs(jacobian) @ size, noise / EPS)
        return cls(system, t, "C(t, q)", values, terms, jacobian, scales, scales.reach, np.abs(q))

    @classmethod
    def measure_v(
        cls,
        system: ConstrainedSystem,
        t: float,
        q: Array,
        v: Array,
        jacobian: Array,
        scales: Scales,
        harmless: Array | float = 0.0,
    ) -> Violation:
        """Measure the violation of C_q v + C_t = 0 and A v + b = 0, relative to the fastest motion at the state.

        Corrections up to `harmless`, (n_q,), are always accepted, because at rest rounding is large relative to v.
        """
        rate = system.rates(t, q)
        # entries that are zero only at this position count, too: bars may be in line with an axis
        pattern = pattern_of(system, t, q)[: len(jacobian)]
        fastest = (pattern * (np.abs(v) / scales.columns)).max(axis=1)
        pull = _unconstrained_accelerations(system, t, q, v, scales.columns)
        falling = np.sqrt(scales.reach * float(np.abs(pull / scales.columns).max()))
        speeds = np.maximum(np.maximum(fastest, np.abs(rate) / scales.rows), falling)
        equation, values = "C_q v + C_t" if system.n_a == 0 else "(C_q v + C_t, A v + b)", jacobian @ v + rate

        def change(neighbour: Array) -> Array:  # how much the rows change with the position
            return system.rows(t, neighbour) @ v + system.rates(t, neighbour) - values

        noise = _noise(q, change, jacobian, float(np.abs(v).max(initial=0.0)))
        terms = np.maximum(np.abs(jacobian) @ np.abs(v) + np.abs(rate), noise / EPS)
        violation = cls(system, t, equation, values, terms, jacobian, scales, speeds, np.abs(v))
        violation.allowed = np.maximum(violation.allowed, harmless)
        in_rows = np.where(pattern != 0.0, harmless / scales.columns, np.inf).min(axis=1)
        violation.allowed_left = np.maximum(violation.allowed_left, np.where(np.isfinite(in_rows), in_rows, 0.0))
        return violation

    @property
    def excess(self) -> float:
        """Return the largest ratio of a correction to its limit; at most 1 if the state is consistent."""
        parts = [(np.abs(self.correction), self.allowed), (self.left, self.allowed_left)]
        with np.errstate(divide="ignore"):
            return max(float((part[part > 0.0] / allowed[part > 0.0]).max(initial=0.0)) for part, allowed in parts)

    def refuse(self, name: str) -> None:
        """Raise unless the state is consistent."""
        if self.excess <= 1.0:
            return
        row = int(np.abs(self.values).argmax())
        raise ValueError(
            f"{name} is not consistent with the constraints of {self.system.name!r}: max|{self.equation}| is "
            f"{abs(self.values[row]):.3g} (row {row}) at t = {self.t:g}; {self._remedy(name)}"
        )

    def _remedy(self, name: str) -> str:
        excesses = np.abs(self.correction) / np.maximum(self.allowed, 1e-300)
        if excesses.max(initial=0.0) <= 1.0:
            return (
                "no small change puts it right, as rows of C_q are zero there or depend on one another. Take another "
                "guess, and project it with twoloop.consistent_state(system, t, q, v)"
            )
        j = int(np.flatnonzero(excesses >= (1.0 - TIED) * excesses.max())[0])
        of = "coordinate" if name == "q0" else "the velocity of coordinate"
        return (
            f"to put it right {of} {j} has to change by {abs(self.correction[j]):.3g}, and at most "
            f"{self.allowed[j]:.1g} is accepted. Project it with twoloop.consistent_state(system, t, q, v)"
        )


def is_consistent(system: ConstrainedSystem, t: float, q: Array, v: Array) -> bool:
    """Return whether a state with finite values of all callbacks is consistent; for the limits see `Violation`."""
    rows, C, rate = system.rows(t, q), system.constraint(t, q), system.rates(t, q)
    jacobian, scales = rows[: system.n_c], scales_of(system, t, q, rows)
    if not is_at_rounding(C, jacobian, q):
        scales_of_c = scales if system.n_a == 0 else scales_of(system, t, q, jacobian)
        if Violation.measure_q(system, t, q, jacobian, scales_of_c).excess > 1.0:
            return False
        scales_of_c.keep(system, q, jacobian)
    at_rounding = is_at_rounding(rows @ v + rate, rows, v, rate)
    return at_rounding or Violation.measure_v(system, t, q, v, rows, scales).excess <= 1.0


ROUNDINGS = np.array([ROUNDING * EPS, UNSYMMETRIC, SINGULAR_MASS])  # limits in the order in which the kernel reads them


class ConstraintWarning(UserWarning):
    """Warning: dependent constraints, a singular position, or a change so brief that a run may have missed it.

    Dependent rows are left out of the solution but checked; their multipliers are not unique.

    Examples
    --------
    >>> import warnings
    >>> from twoloop import ConstraintWarning, solve_dae
    >>> from twoloop.mechanisms import redundant_slider_crank
    >>> problem = redundant_slider_crank()
    >>> with warnings.catch_warnings(record=True) as caught:
    ...     warnings.simplefilter("always", ConstraintWarning)
    ...     result = solve_dae(problem.system, (0.0, 0.1), problem.q0, problem.v0)
    >>> caught[0].category.__name__
    'ConstraintWarning'
    """


def check_start(
    system: ConstrainedSystem,
    t0: float,
    q0: Array,
    v0: Array,
    *,
    derivatives: bool = True,
    exact: Callable[[], bool] | None = None,
    harmless: Array | float = 0.0,
) -> None:
    """Call every callback once at the start; check shapes, finiteness, rank, consistency and optionally derivatives.

    `exact` returns whether derivatives were derived from traces: then they are not compared with differences.
    Corrections of velocities up to `harmless`, (n_q,), are accepted. Raise TypeError or ValueError if a check fails;
    the message names the callback or the argument, its value and a remedy.
    """
    check_bounds(system, t0, q0, v0)
    system.check_returned(t0, q0, v0)
    if _passes_all_checks(system, t0, q0, v0):
        if derivatives:
            check_derivatives(system, t0, q0, exact)
        return
    rows = system.sparse_rows(t0, q0)
    jacobian = rows[: system.n_c]
    reason = not_finite(system, t0, q0, v0)
    if reason is not None:
        raise ValueError(f"at the start, t = {t0:g}, {reason}")
    unsymmetric = unsymmetric_mass(system, t0, q0)
    if unsymmetric is not None:
        raise ValueError(unsymmetric)
    if not is_at_rounding(system.constraint(t0, q0), jacobian, q0):
        full = system.jacobian(t0, q0)
        scales = scales_of(system, t0, q0, full)
        Violation.measure_q(system, t0, q0, full, scales).refuse("q0")
        scales.keep(system, q0, full)
    if derivatives:
        check_derivatives(system, t0, q0, exact)
    largest = rows.largest() if isinstance(rows, SparseRows) else np.abs(rows).max(axis=1, initial=0.0)
    empty = np.flatnonzero(largest == 0.0).tolist()
    if empty:
        raise ValueError(
            f"row(s) {empty} of the constraint Jacobian of {system.name!r} are zero at t = {t0:g}: they hold nothing "
            "there. Leave these constraints out, or start from another position"
        )
    rate = system.rates(t0, q0)
    if not is_at_rounding(rows @ v0 + rate, rows, v0, rate):
        full = system.rows(t0, q0)
        scales = scales_of(system, t0, q0, full)
        Violation.measure_v(system, t0, q0, v0, full, scales, harmless).refuse("v0")


class StartEvaluation:
    """Evaluation of compiled callbacks at one start after another; its arrays hold the results at the last start.

    `pattern` is 1 where the rows C_q and A have entries at the start or nearby.
    """

    def __init__(self, system: ConstrainedSystem):
        from twoloop.kernels.evaluation import checks as start_checks
        from twoloop.kernels.evaluation.checks import evaluate_start, results_size

        self.flags, self._evaluate = start_checks, entry_point(evaluate_start)
        n, n_rows, size = system.n_q, system.n_c + system.n_a, results_size(system.n_q, system.n_c, system.n_a)
        self.system, values = system, np.zeros(size + n * n + 2 * n_rows * n)
        room, mass, rows, pattern = np.split(values, np.cumsum([size, n * n, n_rows * n]))
        self.mass, self.rows, self.pattern = mass.reshape(n, n), rows.reshape(n_rows, n), pattern.reshape(n_rows, n)
        self.arrays = {
            **{"start_values": values, "lam": np.ones(system.n_c), "room": room, "mass": self.mass},
            **{"rows": self.rows, "shifts": shifts(n)[1:], "pattern": self.pattern, "roundings": ROUNDINGS},
        }

    def evaluate(self, t: float, q: Array, v: Array) -> int:
        """Evaluate the callbacks at a start; return the flags of kernels/evaluation/checks.py, or 0 on an exception."""
        values, *arrays = self.arrays.values()
        values.fill(0.0)
        try:
            return int(self._evaluate(self.system.kit, t, q, v, self.sizes(), *arrays))
        except Exception:  # raised by a callback: the detailed checks call it again, and describe the error
            return 0

    def sizes(self) -> Array:
        """Return sizes of coordinates at earlier starts (see `Scales.keep`), as lower bounds for rounding errors."""
        sizes: Array = self.system.derived.get("sizes", NONE)
        return sizes


def _passes_all_checks(system: ConstrainedSystem, t: float, q: Array, v: Array) -> bool:
    """Return whether compiled callbacks pass all checks at a start, so that no detailed check is needed."""
    if system.called_in_python or system.entries:
        return False
    evaluation = StartEvaluation(system)
    flags, state = evaluation.flags, (np.ascontiguousarray(x, dtype=np.float64) for x in (q, v))
    bits = evaluation.evaluate(t, *state)
    if not bits & flags.WELL_FORMED:
        return False
    place = (t, q.tobytes())
    system.remember_at("pattern", place, evaluation.pattern)
    system.remember_at("mass and rows", place, (evaluation.mass, evaluation.rows))
    if bits & (flags.DEFINITE | flags.INDEFINITE):  # neither is set if M is constant, or if rounding would decide
        system.remember_at("definite mass", mass_key(system, t, q), bool(bits & flags.DEFINITE))
    return bool(bits & flags.CONSISTENT)
