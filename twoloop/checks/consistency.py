"""The check of a start: consistent, of full rank, finite."""

from __future__ import annotations  # ArrayLike stays a word in help()

from collections.abc import Callable
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from twoloop.checks.arguments import Array
from twoloop.checks.at_position import SINGULAR_MASS, not_finite, place_of_mass, ways
from twoloop.checks.bounds import check_bounds
from twoloop.checks.derivatives import check_derivatives
from twoloop.checks.scales import EPS, NONE, scales_of
from twoloop.checks.sparse_rows import largest_in_rows
from twoloop.checks.values import UNSYMMETRIC, unsymmetric_mass
from twoloop.checks.violation import ROUNDING, Violation, is_at_rounding, surely_consistent
from twoloop.kernels.compile.linking import entry_point

if TYPE_CHECKING:
    from twoloop.problem.system import ConstrainedSystem


LEAST = np.array([ROUNDING * EPS, UNSYMMETRIC, SINGULAR_MASS])  # as the kernel takes them


class ConstraintWarning(UserWarning):
    """Constraints depend on one another, or something changes for so short a time that a run may have missed it.

    Rows that are left out are checked, and their multipliers are not unique.

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
) -> None:
    """Call every callback once at the start and check shapes, finiteness, rank, consistency and, if asked, derivatives.

    `exact` says whether derivatives are those of what was traced: then they are not compared with differences.

    Raises
    ------
    TypeError, ValueError
        Naming the callback or the argument, what was found and what to do.
    """
    check_bounds(system, t0, q0, v0)
    system.check_returned(t0, q0, v0)
    if _in_order(system, t0, q0, v0):
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
        Violation.of_position(system, t0, q0, full, scales).refuse("q0")
        scales.keep(system, q0, full)
    if derivatives:
        check_derivatives(system, t0, q0, exact)
    empty = np.flatnonzero(largest_in_rows(rows) == 0.0).tolist()
    if empty:
        raise ValueError(
            f"row(s) {empty} of the constraint Jacobian of {system.name!r} are zero at t = {t0:g}: they hold nothing "
            "there. Leave these constraints out, or start from another position"
        )
    rate = system.rates(t0, q0)
    if not is_at_rounding(rows @ v0 + rate, rows, v0, rate):
        full = system.rows(t0, q0)
        scales = scales_of(system, t0, q0, full)
        Violation.of_velocity(system, t0, q0, v0, full, scales).refuse("v0")


class Look:
    """Arrays for the look of compiled callbacks at one start after another, and what the last one found.

    Attributes
    ----------
    mass, rows, pattern : ndarray
        M, C_q with A, and 1 where rows have entries there or nearby.
    definite : bool or None
        Whether an M that varies has an inverse; None: that is in doubt, or M is constant.
    """

    def __init__(self, system: ConstrainedSystem):
        from twoloop.kernels.evaluation import checks as first_look
        from twoloop.kernels.evaluation.checks import evaluate_start, room_size

        self.flags, self._look = first_look, entry_point(evaluate_start)
        n, n_rows, size = system.n_q, system.n_c + system.n_a, room_size(system.n_q, system.n_c, system.n_a)
        self.system, looked = system, np.zeros(size + n * n + 2 * n_rows * n)
        self._room, mass, rows, pattern = np.split(looked, np.cumsum([size, n * n, n_rows * n]))
        self.mass, self.rows, self.pattern = mass.reshape(n, n), rows.reshape(n_rows, n), pattern.reshape(n_rows, n)
        self.arrays = {
            **{"looked": looked, "lam": _ones(system.n_c), "room": self._room, "mass": self.mass, "rows": self.rows},
            **{"ways": ways(n)[1:], "pattern": self.pattern, "least": LEAST},
        }
        self.definite: bool | None = None

    def at(self, t: float, q: Array, v: Array) -> int:
        """Flags of what `first_look` finds at a start."""
        definite, indefinite = self.flags.DEFINITE, self.flags.INDEFINITE
        looked, *arrays = self.arrays.values()
        looked.fill(0.0)
        try:
            found: int = self._look(self.system.kit, t, q, v, self.sizes(), *arrays)
        except Exception:  # of a callback, which is called by itself then
            return 0
        self.definite = bool(found & definite) if found & (definite | indefinite) else None
        return found

    def sizes(self) -> Array:
        """What no coordinate is less than in what counts as rounding, as starts before have shown of theirs."""
        sizes: Array = self.system.made.get("sizes", NONE)
        return sizes

    def is_surely(self, found: int, t: float, q: Array, v: Array) -> bool:
        """Whether `Violation` would accept the state of the last look, which found this, beyond doubt."""
        if found & self.flags.CONSISTENT:
            return True
        n, n_c, n_rows = self.system.n_q, self.system.n_c, len(self.rows)
        force, C, rates = np.split(self._room[: n + n_c + n_rows], (n, n + n_c))
        return surely_consistent(self.system, t, q, v, self.mass, force, self.rows, C, rates)


def _in_order(system: ConstrainedSystem, t: float, q: Array, v: Array) -> bool:
    """Whether compiled callbacks give nothing at a start that would have to be looked at more closely."""
    if system.called_in_python or system.entries:
        return False
    look = Look(system)
    found = look.at(t, np.ascontiguousarray(q, dtype=np.float64), np.ascontiguousarray(v, dtype=np.float64))
    if not found & look.flags.IN_ORDER:
        return False
    place = (t, q.tobytes())
    system.remember_at("pattern", place, look.pattern)
    system.remember_at("mass and rows", place, (look.mass, look.rows))
    if look.definite is not None:
        system.remember_at("definite mass", place_of_mass(system, t, q), look.definite)
    return look.is_surely(found, t, q, v)


@cache
def _ones(n: int) -> Array:
    return np.ones(n)
