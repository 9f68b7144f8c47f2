"""Compare C_q, C_t, Q_d and the tangents of a system with differences, and check the symmetry of M.

A run with a wrong sign in one of these often ends without an error, and looks like a motion. At the start every entry
is compared; later in a run, only the derivative along one direction in which all coordinates change.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from twoloop.checks.arguments import Array
from twoloop.checks.callbacks import unsymmetric_mass, wrong_values
from twoloop.checks.scales import (
    EPS,
    Estimate,
    Function,
    confirms,
    defined,
    differentiate,
    format_difference,
    generic_factors,
    generic_velocities,
    sizes,
)
from twoloop.checks.sparse_rows import SparseRows, is_finite
from twoloop.checks.structure import changed_mass, check_bandwidth, wrong_kinematics
from twoloop.kernels.data.indices import FORCE_BY_Q_GIVEN, FORCE_BY_V_GIVEN, REACTION_BY_Q_GIVEN
from twoloop.kernels.linalg.sparse_lu import column_groups

if TYPE_CHECKING:
    from twoloop.problem.system import ConstrainedSystem


ALL_SIDES = (0, 1, -1)  # sides to sample: around a point or, if callbacks are undefined there, after or before it
FORWARD = (1, -1)  # sides for the start time, before which callbacks need not be defined
FIRST_TIME_SCALE = 0.1  # first guess of the time scale of the constraints, s
# displacement from the start, relative to the coordinates, to a state at which no symmetry hides terms of tangents
NEAR_START = 1e-3
MAX_WIDTHS_IN_RUN = 9  # largest number of half-widths of intervals tried at a state of a run

MEANINGS = {
    "jacobian": "the derivative of constraint with respect to q",
    "jacobian_values": "the entries of the derivative of constraint with respect to q, zero where none is named",
    "constraint_rate": "the derivative of constraint with respect to t",
    "gamma": "-((C_q v)_q v + 2 C_qt v + C_tt), the right-hand side of C_q a = gamma",
    "nonholonomic_gamma": "-((A v)_q v + A_t v + b_q v + b_t), the right-hand side of A a = nonholonomic_gamma",
    "force_by_q": "the derivative of force with respect to q",
    "force_by_v": "the derivative of force with respect to v",
    "reaction_by_q": "the derivative of C_q^T lam with respect to q",
}
HINTS = {
    "constraint_rate": ", or give constraint_rate: the constraints depend on time",
    "gamma": ", or leave gamma out to have it differenced",
    "nonholonomic_gamma": ", or leave nonholonomic_gamma out to have it differenced",
    "force_by_q": ", or leave all tangents out to have the force differenced",
    "reaction_by_q": ", or leave reaction_by_q out to have it differenced",
}


def check_derivatives(system: ConstrainedSystem, t: float, q: Array, exact: Callable[[], bool] | None = None) -> None:
    """Compare the callbacks of a system with one another near (t, q), at generic velocities.

    Every entry is compared with its own displacement; if differences cannot decide, the entry is accepted. C_q is
    checked first, then C_t, then gamma, whose check relies on both. This takes a few dozen calls of each callback for
    each coordinate, once for each system, and none if `exact` returns that the derivatives are exact. Raise ValueError
    if an entry is wrong; the message names the callback, the entry, its value and the value by differences.
    """
    if system.checked:
        return
    wrong = None if exact is not None and exact() else _wrong_constraint(system, t, q, FORWARD)
    wrong = wrong or _wrong_tangent(system, t, q) or _unsymmetric_near(system, t, q) or wrong_kinematics(system, t, q)
    if wrong is None and system.constant_mass:
        wrong = changed_mass(system, t, q, t + 1.0, q + 0.1 * sizes(q) * np.sign(generic_factors(system.n_q)))
    if wrong is not None:
        raise ValueError(wrong)
    if system.bandwidth is not None:
        check_bandwidth(system, system.bandwidth, t, q)
    if system.entries:
        near = q + NEAR_START * sizes(q) * np.random.default_rng(1).uniform(0.5, 1.5, system.n_q)
        wrong = wrong_values(system, t, q if defined(lambda: system.constraint(t, near)) is None else near)
        if wrong is not None:
            raise ValueError(wrong)
    system.checked = True


def wrong_derivative(system: ConstrainedSystem, t: float, q: Array, v: Array) -> str | None:
    """Describe which of C_q, C_t and gamma is wrong at a state of a run, or return None.

    A formula may be right at the start only. One direction in which all coordinates and the time change covers all
    entries, with nine calls of `constraint`, sixteen of `jacobian`, ten of `constraint_rate` and one of `gamma` for any
    n_q. If these differ, the entries are compared one by one, as at the start. Tangents are not checked: they affect
    whether Newton's method converges, but not its result.
    """
    jacobian, rate = system.sparse_rows(t, q), system.rates(t, q)
    if jacobian.size == 0 or not (is_finite(jacobian) and np.isfinite(rate).all()):
        return None
    n_c = system.n_c
    generic = generic_velocities(system, t, q, jacobian, rate)[-1]
    generic = generic * max(1.0, float(np.abs(v).max()) / float(np.abs(generic).max()))
    scale = min(FIRST_TIME_SCALE, _time_scale(q, generic))
    noise = EPS * (abs(jacobian) @ np.abs(q))[:n_c]
    given = (jacobian @ generic + rate)[:n_c]
    spacing = _spacing(t, q, generic)
    suspicious = False
    if n_c > 0:
        estimate = _estimate_in_run(lambda s: system.constraint(t + s, q + s * generic), scale, noise, given, spacing)
        suspicious = estimate.disagrees(given, EPS * (abs(jacobian) @ np.abs(generic))[:n_c]).max() > 1.0
    for kind, rows in _given_gammas(system):
        if suspicious:
            break
        right = defined(lambda kind=kind: system.evaluate(kind, t, q, generic))  # type: ignore[misc]
        if right is None:
            return None
        noise = EPS * (abs(jacobian) @ np.abs(generic) + np.abs(rate))[rows]
        estimate = _estimate_in_run(_negative_rates(system, t, q, generic, rows), scale, noise, right, spacing)
        suspicious = estimate.disagrees(right, 0.0 * right).max() > 1.0
    return _wrong_constraint(system, t, q, ALL_SIDES, generic) if suspicious else None


def _estimate_in_run(function: Function, scale: float, noise: Array, given: Array, spacing: float) -> Estimate:
    largest = np.abs(given)
    return differentiate(
        function, 0.0, scale, noise, given, largest, spacing=spacing, sides=ALL_SIDES, max_widths=MAX_WIDTHS_IN_RUN
    )


@dataclass(frozen=True)
class _Comparison:
    """Comparison of one column of given values with the derivative of a function, by differences."""

    system: ConstrainedSystem
    kind: str
    t: float
    function: Function
    place: float
    given: Array
    column: int | None = None
    spacing: float = 0.0

    def wrong(self, scale: float, noise: Array, largest: Array, rounding: Array, sides: tuple[int, ...]) -> str | None:
        """Describe the entry that is most certainly wrong, or return None."""
        best = differentiate(
            self.function, self.place, scale, noise, self.given, largest, spacing=self.spacing, sides=sides
        )
        ratio = best.disagrees(self.given, rounding)
        for entry in np.argsort(-ratio):
            if ratio[entry] <= 1.0:
                return None
            given = float(self.given[entry])
            if confirms(self.function, self.place, int(entry), best, given, noise, self.spacing):
                return self._message(int(entry), best)
        return None

    def _message(self, row: int, best: Estimate) -> str:
        entry = row if self.column is None else (row, self.column)
        hint = HINTS.get(self.kind, "")
        if self.kind == "force_by_v" and self.system.functions.flags[FORCE_BY_V_GIVEN] == 0:
            hint = ", that is, give force_by_v: beside force_by_q the force may depend on v only with it"
        given, found = format_difference(float(self.given[row]), float(best.slope[row]))
        return (
            f"{self.kind} of {self.system.name!r} is not {MEANINGS[self.kind]}: entry {entry} is {given}, by "
            f"differences it is {found} with an error of about {best.error[row]:.1g} (near t = "
            f"{self.t:.10g}; velocities are chosen at random). Correct its formula{hint}"
        )


def _wrong_constraint(
    system: ConstrainedSystem, t: float, q: Array, sides: tuple[int, ...], *faster: Array
) -> str | None:
    """Describe the first wrong entry of C_q, C_t or gamma; checks in this order rely on the results of earlier checks.

    `gamma` is compared at generic velocities, and at the velocities `faster` of a run: it may be wrong only there.
    """
    wrong = _wrong_jacobian(system, t, q, sides) if system.n_c > 0 else None
    if wrong is not None:
        return wrong
    jacobian, rate = system.sparse_rows(t, q), system.rates(t, q)
    if not (is_finite(jacobian) and np.isfinite(rate).all()):
        return None
    for kind, rows in _given_gammas(system):
        for v in (*generic_velocities(system, t, q, jacobian, rate), *faster):
            given = defined(lambda kind=kind, v=v: system.evaluate(kind, t, q, v))  # type: ignore[misc]
            if given is None:
                continue
            noise = EPS * (abs(jacobian) @ np.abs(v) + np.abs(rate))[rows]
            rounding = _rounding(lambda x, kind=kind, v=v: system.evaluate(kind, t, x, v), given, q)  # type: ignore[misc]
            rates = _negative_rates(system, t, q, v, rows)
            compared = _Comparison(system, kind, t, rates, 0.0, given, spacing=_spacing(t, q, v))
            wrong = compared.wrong(min(FIRST_TIME_SCALE, _time_scale(q, v)), noise, np.abs(given), rounding, sides)
            if wrong is not None:
                return wrong
    return None


def _unsymmetric_near(system: ConstrainedSystem, t: float, q: Array) -> str | None:
    """Describe an asymmetry of M near the start, where more entries are nonzero, or return None."""
    if system.constant_mass:
        return None
    near = q + NEAR_START * sizes(q) * np.abs(generic_factors(system.n_q))
    kind = "mass_values" if "mass" in system.entries else "mass"
    if defined(lambda: system.evaluate(kind, t, near)) is None:
        return None
    wrong = unsymmetric_mass(system, t, near)
    return None if wrong is None else f"{wrong} (near the start: at q = {near})"


def _given_gammas(system: ConstrainedSystem) -> list[tuple[str, slice]]:
    """Return the kinds of callbacks given for the right-hand side of G a = gamma, with their rows."""
    rows = {"gamma": slice(0, system.n_c), "nonholonomic_gamma": slice(system.n_c, None)}
    return [(kind, part) for kind, part in rows.items() if kind in system.given]


def _wrong_jacobian(system: ConstrainedSystem, t: float, q: Array, sides: tuple[int, ...]) -> str | None:
    """Describe the wrong entry of C_q or C_t, or return None."""
    jacobian, rate = system.sparse_rows(t, q)[: system.n_c], system.constraint_rate(t, q)
    if not (is_finite(jacobian) and np.isfinite(rate).all()):
        return None  # outside the domain of the callbacks; at a state of the run, partition.py reports this
    if isinstance(jacobian, SparseRows):
        wrong = _wrong_group(system, t, q, jacobian)
    else:
        parts = (lambda x: system.constraint(t, x), lambda x: system.jacobian(t, x))
        wrong = _wrong_column(system, "jacobian", t, q, *parts)
    if wrong is not None:
        return wrong
    noise = EPS * (abs(jacobian) @ np.abs(q))
    rounding = _rounding(lambda x: system.constraint_rate(t, x), rate, q)
    in_t = _Comparison(system, "constraint_rate", t, lambda s: system.constraint(t + s, q), t, rate)
    return in_t.wrong(FIRST_TIME_SCALE, noise, np.abs(rate), rounding, sides)


def _wrong_tangent(system: ConstrainedSystem, t: float, q: Array) -> str | None:
    """Describe the wrong entry of the given tangents, or return None."""
    if system.functions.flags[FORCE_BY_Q_GIVEN] == 0:
        return None
    v = sizes(q) * generic_factors(system.n_q)
    if defined(lambda: system.force(t, q + NEAR_START * v, v)) is not None:
        q = q + NEAR_START * v

    def force_in_v(x: Array) -> Array:
        return system.force(t, q, x)

    functions = lambda x: system.force(t, x, v), lambda x: system.force_by_q(t, x, v)
    wrong = _wrong_column(system, "force_by_q", t, q, *functions)
    if wrong is None and (system.functions.flags[FORCE_BY_V_GIVEN] == 1 or _varies(force_in_v, v)):
        wrong = _wrong_column(system, "force_by_v", t, v, force_in_v, lambda x: system.force_by_v(t, q, x))
    if wrong is not None or system.functions.flags[REACTION_BY_Q_GIVEN] == 0:
        return wrong
    lam = np.linspace(1.0, 2.0, system.n_c)
    functions = lambda x: lam @ system.jacobian(t, x), lambda x: system.reaction_by_q(t, x, lam)
    return _wrong_column(system, "reaction_by_q", t, q, *functions)


def _varies(function: Callable[[Array], Array], x: Array) -> bool:
    """Return whether a function changes along one direction, which costs less than differences of all columns."""
    values = [defined(lambda part=part: function(part * x)) for part in (1.0, 1.001, 2.0, 0.0, 1e3)]  # type: ignore[misc]
    known = [value for value in values if value is not None]
    return any(bool((value != known[0]).any()) for value in known)


def _wrong_column(
    system: ConstrainedSystem,
    kind: str,
    t: float,
    x: Array,
    function: Callable[[Array], Array],
    derivative: Callable[[Array], Array],
) -> str | None:
    """Displace one coordinate (or velocity) after another; describe the wrong entry of the matrix, or return None."""
    given = defined(lambda: derivative(x))
    if given is None:
        return None
    noise = EPS * (np.abs(given) @ np.abs(x))
    largest = np.abs(given).max(axis=1)
    rounding = _rounding(derivative, given, x)
    scales = sizes(x)
    for j in range(len(x)):
        unit = np.zeros(len(x))
        unit[j] = 1.0

        def displaced(shift: float, unit: Array = unit) -> Array:
            return function(x + shift * unit)

        column = _Comparison(system, kind, t, displaced, float(x[j]), given[:, j], j)
        wrong = column.wrong(float(scales[j]), noise, largest, rounding[:, j], ALL_SIDES)
        if wrong is not None:
            return wrong
    return None


def _wrong_group(system: ConstrainedSystem, t: float, q: Array, jacobian: SparseRows) -> str | None:
    """Compare C_q given by entries with differences; columns without common rows are displaced together, as a group.

    If a group is wrong, its columns are compared one by one, to name the entry. This also finds entries that
    `jacobian_entries` does not name: they add to another column, or to a row without entries in the group.
    """
    noise = EPS * (abs(jacobian) @ np.abs(q))
    scales, largest = sizes(q), jacobian.largest()
    unit = float(np.median(scales))

    def full(x: Array) -> Array:
        rows = system.sparse_rows(t, x)
        return rows.matrix() if isinstance(rows, SparseRows) else rows

    def product(direction: Array) -> Array:
        return _rounding(lambda x: system.sparse_rows(t, x) @ direction, jacobian @ direction, q)

    groups = column_groups((jacobian.rows, jacobian.columns), len(q))
    for k in range(groups.max(initial=-1) + 1):
        group, direction = groups == k, np.zeros(len(q))
        direction[group] = scales[group] / unit

        def displaced(shift: float, direction: Array = direction) -> Array:
            return system.constraint(t, q + shift * direction)

        given = jacobian @ direction
        place = float(np.abs(q[group] / direction[group]).max())
        compared = _Comparison(system, "jacobian", t, displaced, 0.0, given, spacing=float(np.spacing(place)))
        if compared.wrong(unit, noise, np.maximum(largest, np.abs(given)), product(direction), ALL_SIDES) is not None:
            return _wrong_column(system, "jacobian_values", t, q, lambda x: system.constraint(t, x), full)
    return None


def _rounding(derivative: Callable[[Array], Array], given: Array, x: Array) -> Array:
    """Estimate the effect on the given values of rounding of the arguments x."""
    largest = EPS * np.abs(given)
    for signs in np.random.default_rng(2).choice((-2.0, 2.0), (3, len(x))):
        try:
            moved = np.abs(derivative(x * (1.0 + EPS * signs)) - given)
        except Exception:  # the place is at the edge of the callbacks' domain
            continue
        largest = np.fmax(largest, moved)
    return largest


def _time_scale(q: Array, v: Array) -> float:
    """Return the time, s, in which no coordinate moves by more than its size."""
    return float((sizes(q) / np.maximum(np.abs(v), 1e-300)).min())


def _spacing(t: float, q: Array, v: Array) -> float:
    """Return the shortest time, s, in which a straight motion moves every coordinate by more than rounding."""
    return max(float(np.spacing(abs(t))), float((np.spacing(np.abs(q)) / np.maximum(np.abs(v), 1e-300)).max()))


def _negative_rates(system: ConstrainedSystem, t: float, q: Array, v: Array, rows: slice) -> Function:
    """Return rows of -(C_q v + C_t, A v + b) along a straight motion; their derivatives are the right-hand sides."""
    return lambda s: -system.velocity_constraint(t + s, q + s * v, v)[rows]
