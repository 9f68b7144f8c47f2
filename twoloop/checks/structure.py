"""What a system says of its callbacks as a whole: M constant, a bandwidth, `kinematics` in the place of others."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from twoloop.checks.arguments import Array
from twoloop.checks.differences import EPS, as_far_as_they_differ, defined
from twoloop.checks.scales import generic_factors, generic_velocities, rows_at
from twoloop.checks.values import SAME, UNSYMMETRIC, unsymmetric_mass, wrong_values
from twoloop.kernels.compile.linking import entry_point

if TYPE_CHECKING:
    from twoloop.problem.system import ConstrainedSystem


NEAR = 1e-3  # of the coordinates: also looked at a little off the start, where symmetry hides terms
ROUNDED = 100.0  # times rounding of the terms of a constraint, by which values that callbacks share may differ, too
MOST = 1_000_000  # numbers of Jacobians that are looked at together
ROUNDING = 1e-12  # of a difference, relative to the largest entry over the displacement


def unlike_itself(
    system: ConstrainedSystem, states: Sequence[tuple[float, Array, Array]], t0: float, q0: Array
) -> tuple[float, str] | None:
    """Say when and what of M, `kinematics` and values is not as it should be at states of a run from (t0, q0), or None.

    Most often all is the same to the bit, which is seen soon.
    """
    before = _mass_at(system, t0, q0).tobytes() if system.constant_mass else b""
    fused = "kinematics" in system.given
    for t, q, v in states:
        if not system.constant_mass:
            wrong = unsymmetric_mass(system, t, q)
        else:
            there = defined(lambda t=t, q=q: _mass_at(system, t, q))  # type: ignore[misc]
            same = there is None or there.tobytes() == before
            wrong = None if same else changed_mass(system, t0, q0, t, q)
        if wrong is None and fused and not _compared(system, t, q, v)[0]:
            wrong = wrong_kinematics(system, t, q)
        if wrong is None and system.entries:
            wrong = wrong_values(system, t, q)
        if wrong is not None:
            return t, wrong
    return None


def wrong_kinematics(system: ConstrainedSystem, t: float, q: Array) -> str | None:
    """Compare the fused callback with the separate ones, which are compared with differences."""
    if "kinematics" not in system.given:
        return None
    _, rate, rows = _compared(system, t, q, 0.0 * q)
    v = generic_velocities(system, t, q, rows, rate)[-1]
    for place in (q, q + NEAR * v):
        if _compared(system, t, place, v)[0]:
            continue
        separate = {
            "constraint": system.constraint(t, place),
            "jacobian": system.jacobian(t, place),
            "constraint_rate": system.constraint_rate(t, place),
            "gamma": system.gamma(t, place, v),
        }
        size = EPS * np.abs(separate["jacobian"]) @ np.abs(place)  # of the terms in a constraint
        for fused, (kind, given) in zip(system.kinematics(t, place, v), separate.items(), strict=True):
            off = np.abs(fused - given)
            level = SAME * np.abs(given).max(initial=0.0) + (ROUNDED * size if kind == "constraint" else 0.0)
            if (off > level).any():
                entry = np.unravel_index(int((off - level).argmax()), off.shape)
                where = int(entry[0]) if len(entry) == 1 else tuple(int(i) for i in entry)
                here, there = as_far_as_they_differ(float(fused[entry]), float(given[entry]))
                return (
                    f"kinematics of {system.name!r} does not give what {kind} gives: entry {where} is "
                    f"{here} and {there} (near t = {t:.10g}). Correct it, or leave it out"
                )
    return None


def _compared(system: ConstrainedSystem, t: float, q: Array, v: Array) -> tuple[bool, Array, Array]:
    """Whether kinematics give what the separate callbacks give, and C_t and C_q of these."""
    from twoloop.kernels.evaluation.checks import kinematics_agree

    n, n_c = system.n_q, system.n_c
    fused, given = np.zeros((2, 3 + n, n_c))
    state = np.ascontiguousarray(q), np.ascontiguousarray(v)
    agree = entry_point(kinematics_agree)(system.kit, t, *state, fused, given, np.zeros(n_c), SAME, ROUNDED * EPS)
    return bool(agree), given[1], given[3:].reshape((n_c, n))


def changed_mass(system: ConstrainedSystem, t0: float, q0: Array, t: float, q: Array) -> str | None:
    """Say that a mass is not the same in two places, where it is said to be constant, or None."""
    there, before = defined(lambda: _mass_at(system, t, q)), _mass_at(system, t0, q0)
    if there is None or there.tobytes() == before.tobytes():
        return None
    if not np.abs(there - before).max() > UNSYMMETRIC * np.abs(there).max():
        return None
    return f"mass of {system.name!r} is said to be constant (constant_mass=True) and is not"


def _mass_at(system: ConstrainedSystem, t: float, q: Array) -> Array:
    """M, or the values of its entries where these are given."""
    kind = "mass_values" if "mass" in system.entries else "mass"
    (made,) = system.arrays_of(kind)
    getattr(system.functions, kind)(t, np.ascontiguousarray(q), system.functions.p, made)
    return made


def check_bandwidth(system: ConstrainedSystem, bandwidth: int, t: float, q: Array) -> None:
    """Displace one coordinate or velocity after another: what lies farther away than the bandwidth may not answer."""
    n, places = system.n_q, np.arange(system.n_q)
    farthest, where = bandwidth, ""
    size = float(np.abs(q).max()) or 1.0
    v = size * generic_factors(n)
    q, shift = q + 1e-3 * v, 1e-3 * size
    steps, away = shift * np.eye(n), np.abs(places - places[:, None])

    def look(what: str, first: int, answers: Array, level: float) -> None:
        """Rows of answers are what answers to coordinates from the first on."""
        nonlocal farthest, where
        far = away[first : first + len(answers)]
        distances = np.where(np.isfinite(answers) & (np.abs(answers) > level), far, 0)
        if distances.max() > farthest:
            j, i = np.unravel_index(int(distances.argmax()), distances.shape)
            farthest, where = int(distances[j, i]), f"{what} has the entry ({i}, {first + j}) = {answers[j, i]:.6g}"

    def force(q: Array, v: Array) -> Array:
        try:
            return system.force(t, q, v)
        except (ArithmeticError, ValueError):  # math.sqrt and its like, outside what the callbacks are made for
            return np.full(n, np.nan)

    look("M", 0, system.mass(t, q).T, 0.0)
    at = force(q, v)
    level = ROUNDING * float(np.abs(at).max()) / shift
    look("the derivative of force by q", 0, (np.array([force(q + step, v) for step in steps]) - at) / shift, level)
    look("the derivative of force by v", 0, (np.array([force(q, v + step) for step in steps]) - at) / shift, level)
    for some in np.array_split(places, 1 + n * n * system.n_c // MOST):
        rows, known = rows_at(system, t, np.vstack([q, q + steps[some]]))
        rows = np.where(known[:, None, None], rows[:, : system.n_c], np.nan)
        level = ROUNDING * float(np.abs(rows[0]).max(initial=0.0)) / shift
        for k in range(system.n_c):
            name = f"the second derivative of constraint {k} by q"
            look(name, int(some[0]), (rows[1:, k] - rows[0, k]) / shift, level)
    if where:
        raise ValueError(
            f"bandwidth of {system.name!r} must be at least {farthest}: {where}; given {bandwidth}. Or number the "
            "coordinates otherwise, or leave bandwidth out"
        )
