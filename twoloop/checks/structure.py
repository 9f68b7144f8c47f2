"""Check M, C_q and A at a position: rank and pattern of the rows, definiteness of M, bandwidth, and `kinematics`."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.linalg import lapack, null_space, qr

from twoloop.checks.arguments import Array
from twoloop.checks.callbacks import SAME, UNSYMMETRIC, unsymmetric_mass, wrong_values
from twoloop.checks.scales import (
    EPS,
    defined,
    format_difference,
    generic_factors,
    generic_velocities,
    rows_at,
    scales_of,
)
from twoloop.checks.sparse_rows import SparseRows
from twoloop.kernels.compile.callbacks import KINDS
from twoloop.kernels.compile.linking import entry_point

if TYPE_CHECKING:
    from twoloop.kernels.data.common import Kit
    from twoloop.problem.system import ConstrainedSystem


RANK_TOLERANCE = 1e-11  # a pivot counts as zero below this fraction of the largest diagonal entry of R
SHOWN = 5  # largest number of dependent rows whose equations are written out
# largest number of other rows that a message names with coefficients, and largest number that it names at all
MOST_TERMS, MOST_NAMED = 3, 8
WEAK = 1e-9  # directions with a larger singular value, relative to the largest, are certainly in the pseudo-inverse
NO_DIRECTION = 1e-12  # a row minus its dependent components counts as zero below this fraction of the row


def certainly_exceed(ratio: float, rows: Array, rank: int) -> bool:
    """Return whether `rank` singular values certainly exceed `ratio` times the largest, by bounds, without an SVD."""
    from twoloop.kernels.linalg.rank import independent_rows, norm_of_inverse, singular_values_exceed

    rows, size, kept = np.ascontiguousarray(rows), min(rows.shape) + 1, np.zeros(len(rows), dtype=np.int64)
    if rank == len(rows) > 0 and entry_point(singular_values_exceed)(rows, ratio, np.empty((rank, rank))):
        return True
    basis, factors = np.zeros((size, rows.shape[1])), np.zeros((size, size))
    if rank == 0 or entry_point(independent_rows)(rows, NO_DIRECTION, basis, factors, kept) != rank:
        return False
    inverse = entry_point(norm_of_inverse)(np.ascontiguousarray(factors[:rank, :rank]), rank, np.zeros(rank))
    return bool(ratio * float(np.linalg.norm(rows)) * inverse < 1.0)


def redundant_rows(scaled: Array, tolerance: float = RANK_TOLERANCE) -> list[int]:
    """Return the rows of a Jacobian, scaled to similar size, that depend on the others, by QR with pivoting."""
    if scaled.size == 0:
        return []
    R, order = qr(scaled.T, mode="r", pivoting=True)
    diagonal = np.abs(np.diagonal(R))
    rank = int((diagonal > tolerance * diagonal.max()).sum())
    return sorted(order[rank:].tolist())


def describe_dependence(jacobian: Array, redundant: list[int]) -> str:
    """Describe which rows depend on which others; few coefficients are listed, because many vary between starts."""
    from twoloop.kernels.linalg.rank import express_other_rows

    (n_rows, n_q), shown = jacobian.shape, redundant[:SHOWN]
    others = [i for i in range(n_rows) if i not in redundant]
    max_rank, rest = min(len(others), n_q) + 1, np.empty((len(others), n_q))
    lengths, shares = np.zeros(n_rows), np.zeros((len(shown), len(others)))
    order, kept = np.array([*others, *shown]), np.zeros(n_rows, dtype=np.int64)
    room = np.zeros((max_rank, n_q)), np.zeros((max_rank, max_rank)), kept
    if not entry_point(express_other_rows)(
        np.ascontiguousarray(jacobian), order, RANK_TOLERANCE, rest, *room, shares, lengths
    ):
        shares[:] = np.linalg.lstsq(rest.T, jacobian[shown].T, rcond=None)[0].T
    return describe_equations(redundant, others, shares, lengths)


def describe_equations(redundant: list[int], others: list[int], shares: Array, lengths: Array) -> str:
    """Describe the first redundant rows, by their coefficients `shares` (SHOWN, n) and the lengths of all rows."""
    equations = []
    counts = np.abs(shares) * lengths[others] > 1e-9 * lengths[redundant[: len(shares)], None]
    for i, factors, which in zip(redundant, shares.tolist(), counts, strict=False):
        of = which.nonzero()[0].tolist()
        if len(of) > MOST_TERMS:
            named = ", ".join(str(others[k]) for k in of[:MOST_NAMED])
            also = f" and {len(of) - MOST_NAMED} more" if len(of) > MOST_NAMED else ""
            equations.append(f"row {i} on rows {named}{also}")
            continue
        terms = " + ".join([f"{factors[k]:.4g} row {others[k]}" for k in of])
        equations.append(f"row {i} = {terms.replace('+ -', '- ') or '0'}")
    more = ", ..." if len(redundant) > SHOWN else ""
    return f"row(s) {redundant} depend on the others ({', '.join(equations)}{more})"


NEARBY = (0.0, 1e-3, 1e-2, 3e-2)  # displacements, relative to the coordinates, at which the pattern of C_q is sampled
SINGULAR_MASS = 1e-12  # M may have no inverse if its smallest eigenvalue is below this fraction of its largest entry


def pattern_of(system: ConstrainedSystem, t: float, q: Array) -> Array:
    """Return 1 where C_q or A has an entry at a position or near it, (n_c + n_a, n_q); read-only."""

    def find_entries() -> Array:
        size = np.maximum(np.abs(q), np.abs(q).max())
        # entries that are zero at all these positions are found during the run
        rows, defined = rows_at(system, t, q + size * shifts(system.n_q))
        return (rows[defined] != 0.0).any(axis=0).astype(float)

    return system.remembered_at("pattern", (t, q.tobytes()), find_entries)


@cache
def shifts(n_q: int) -> Array:
    """Return fixed random displacements to nearby positions, relative to the coordinates, (len(NEARBY), n_q)."""
    return np.array(NEARBY)[:, None] * np.random.default_rng(4).uniform(-1.0, 1.0, (len(NEARBY), n_q))


def mass_and_rows(system: ConstrainedSystem, t: float, q: Array) -> tuple[Array, Array]:
    """Return M, and C_q with A below it, at a position; read-only."""
    return system.remembered_at("mass and rows", (t, q.tobytes()), lambda: (system.mass(t, q), system.rows(t, q)))


def has_definite_mass(system: ConstrainedSystem, t: float, q: Array) -> bool:
    """Return whether M has an inverse at a position, not only on the velocities that the constraints allow."""
    return system.remembered_at("definite mass", mass_key(system, t, q), lambda: is_definite(system.mass(t, q)))


def is_definite(mass: Array) -> bool:
    """Return whether M has an inverse; LAPACK, called directly, takes a fifth of the time of NumPy for small M."""
    return bool(lapack.dsyevd(mass, compute_v=0)[0][0] > SINGULAR_MASS * np.abs(mass).max())


def mass_key(system: ConstrainedSystem, t: float, q: Array) -> Any:
    """Return the key of a mass matrix in a cache: the position on which it depends, or None if it is constant."""
    return None if system.constant_mass else (t, q.tobytes())


def parts_of(value: Array | tuple[Array, ...]) -> tuple[Array, ...]:
    """Return the arrays that a callback fills; "kinematics" fills several."""
    return value if isinstance(value, tuple) else (value,)


def not_finite(system: ConstrainedSystem, t: float, q: Array, v: Array) -> str | None:
    """Name the callbacks whose values are not finite at (t, q, v); None: all are finite."""
    state = {"q": q, "v": v, "lam": np.ones(system.n_c)}
    kinds = [kind for kind in system.given if kind not in system.entries]  # callbacks whose values are checked
    values = {kind: system.evaluate(kind, t, *[state[name] for name in KINDS[kind].state]) for kind in kinds}
    wrong = [kind for kind, value in values.items() if not all(np.isfinite(part).all() for part in parts_of(value))]
    return f"{' and '.join(wrong)} of {system.name!r} returned values that are not finite" if wrong else None


def dependent_rows(system: ConstrainedSystem, t: float, q: Array) -> str:
    """Describe which rows of C_q(t, q) depend on the others."""
    jacobian = system.rows(t, q)
    rows = redundant_rows(scales_of(system, t, q, jacobian).scaled(jacobian))
    if rows:
        return describe_dependence(jacobian, rows)
    values = np.linalg.svd(jacobian, compute_uv=False)
    return (
        "or so nearly that Newton cannot tell: its smallest singular value at the last state is "
        f"{values[-1] / values[0]:.1g} of the largest"
    )


def least_inertia(system: ConstrainedSystem, t: float, q: Array) -> tuple[float, str]:
    """Return the smallest over the largest eigenvalue of T^T M T, and describe the motion that it belongs to."""
    mass, rows = system.mass(t, q), system.rows(t, q)
    free = null_space(rows) if len(rows) > 0 else np.eye(system.n_q)
    if free.shape[1] == 0:
        return 1.0, "the constraints allow no motion"
    energies, motions = np.linalg.eigh(free.T @ mass @ free)
    motion = np.abs(free @ motions[:, 0])
    coordinates = np.flatnonzero(motion > 0.1 * motion.max()).tolist()
    return float(energies[0] / max(energies[-1], np.finfo(np.float64).tiny)), (
        f"a motion of coordinate(s) {coordinates}, which the constraints allow, has next to no inertia, or a negative "
        f"one: the smallest eigenvalue of T^T M T is {energies[0]:.3g}, the largest {energies[-1]:.3g}"
    )


NEAR = 1e-3  # displacement from the start, relative to the coordinates, at which no symmetry hides terms
# allowed difference of the values of C from two callbacks, in rounding errors of its terms, in addition to SAME
ROUNDED = 100.0
MAX_ENTRIES = 1_000_000  # largest number of entries of Jacobians that are evaluated together
ROUNDING = 1e-12  # rounding error of a difference quotient, relative to (largest entry) / displacement


def run_inconsistency(
    system: ConstrainedSystem, states: Sequence[tuple[float, Array, Array]], t0: float, q0: Array
) -> tuple[float, str] | None:
    """Describe, with its time, an error in M, `kinematics` or values of entries at states of a run; None: no error.

    The run begins at (t0, q0). Most values are equal bit for bit, which is fast to check.
    """
    before = _mass_at(system, t0, q0).tobytes() if system.constant_mass else b""
    kit = system.kit if "kinematics" in system.given else None
    for t, q, v in states:
        if not system.constant_mass:
            wrong = unsymmetric_mass(system, t, q)
        else:
            there = defined(lambda t=t, q=q: _mass_at(system, t, q))  # type: ignore[misc]
            same = there is None or there.tobytes() == before
            wrong = None if same else changed_mass(system, t0, q0, t, q)
        if wrong is None and kit is not None and not _compared(system, kit, t, q, v)[0]:
            wrong = wrong_kinematics(system, t, q)
        if wrong is None and system.entries:
            wrong = wrong_values(system, t, q)
        if wrong is not None:
            return t, wrong
    return None


def wrong_kinematics(system: ConstrainedSystem, t: float, q: Array) -> str | None:
    """Describe where `kinematics` differs from the separate callbacks, which other checks compare with differences."""
    if "kinematics" not in system.given:
        return None
    _, rate, rows = _compared(system, system.kit, t, q, 0.0 * q)
    entries = system.sparse_rows(t, q)  # because for large systems units of full matrices take seconds
    v = generic_velocities(system, t, q, entries if isinstance(entries, SparseRows) else rows, rate)[-1]
    for place in (q, q + NEAR * v):
        if _compared(system, system.kit, t, place, v)[0]:
            continue
        separate = {
            "constraint": system.constraint(t, place),
            "jacobian": system.jacobian(t, place),
            "constraint_rate": system.constraint_rate(t, place),
            "gamma": system.gamma(t, place, v),
        }
        size = EPS * np.abs(separate["jacobian"]) @ np.abs(place)  # rounding of the terms in a constraint
        for fused, (kind, given) in zip(system.kinematics(t, place, v), separate.items(), strict=True):
            off = np.abs(fused - given)
            level = SAME * np.abs(given).max(initial=0.0) + (ROUNDED * size if kind == "constraint" else 0.0)
            if (off > level).any():
                entry = np.unravel_index(int((off - level).argmax()), off.shape)
                where = int(entry[0]) if len(entry) == 1 else tuple(int(i) for i in entry)
                here, there = format_difference(float(fused[entry]), float(given[entry]))
                return (
                    f"kinematics of {system.name!r} does not give what {kind} gives: entry {where} is "
                    f"{here} and {there} (near t = {t:.10g}). Correct it, or leave it out"
                )
    return None


def _compared(system: ConstrainedSystem, kit: Kit, t: float, q: Array, v: Array) -> tuple[bool, Array, Array]:
    """Return whether `kinematics` agrees with the separate callbacks, and C_t and C_q from the separate callbacks."""
    from twoloop.kernels.evaluation.checks import kinematics_agree

    n, n_c = system.n_q, system.n_c
    fused, given = np.zeros((2, 3 + n, n_c))
    state = np.ascontiguousarray(q), np.ascontiguousarray(v)
    agree = entry_point(kinematics_agree)(kit, t, *state, fused, given, np.zeros(n_c), SAME, ROUNDED * EPS)
    return bool(agree), given[1], given[3:].reshape((n_c, n))


def changed_mass(system: ConstrainedSystem, t0: float, q0: Array, t: float, q: Array) -> str | None:
    """Describe a change of M between two positions although constant_mass is set; None: M does not change."""
    there, before = defined(lambda: _mass_at(system, t, q)), _mass_at(system, t0, q0)
    if there is None or there.tobytes() == before.tobytes():
        return None
    if not np.abs(there - before).max() > UNSYMMETRIC * np.abs(there).max():
        return None
    return f"mass of {system.name!r} is said to be constant (constant_mass=True) and is not"


def _mass_at(system: ConstrainedSystem, t: float, q: Array) -> Array:
    """Return M, or the values of its entries if the system has `mass_values`."""
    kind = "mass_values" if "mass" in system.entries else "mass"
    (values,) = system.arrays_of(kind)
    getattr(system.functions, kind)(t, np.ascontiguousarray(q), system.functions.p, values)
    return values


def check_bandwidth(system: ConstrainedSystem, bandwidth: int, t: float, q: Array) -> None:
    """Check the bandwidth: displace each coordinate and velocity; the response must stay within the bandwidth."""
    n, places = system.n_q, np.arange(system.n_q)
    farthest, where = bandwidth, ""
    size = float(np.abs(q).max()) or 1.0
    v = size * generic_factors(n)
    q, shift = q + 1e-3 * v, 1e-3 * size
    steps, away = shift * np.eye(n), np.abs(places - places[:, None])

    def record(what: str, first: int, answers: Array, level: float) -> None:
        """Find the farthest response: row k of `answers` is the response to coordinate first + k."""
        nonlocal farthest, where
        far = away[first : first + len(answers)]
        distances = np.where(np.isfinite(answers) & (np.abs(answers) > level), far, 0)
        if distances.max() > farthest:
            j, i = np.unravel_index(int(distances.argmax()), distances.shape)
            farthest, where = int(distances[j, i]), f"{what} has the entry ({i}, {first + j}) = {answers[j, i]:.6g}"

    def force(q: Array, v: Array) -> Array:
        try:
            return system.force(t, q, v)
        except (ArithmeticError, ValueError):  # math.sqrt and similar functions, outside their domains
            return np.full(n, np.nan)

    record("M", 0, system.mass(t, q).T, 0.0)
    at = force(q, v)
    level = ROUNDING * float(np.abs(at).max()) / shift
    record("the derivative of force by q", 0, (np.array([force(q + step, v) for step in steps]) - at) / shift, level)
    record("the derivative of force by v", 0, (np.array([force(q, v + step) for step in steps]) - at) / shift, level)
    for some in np.array_split(places, 1 + n * n * system.n_c // MAX_ENTRIES):
        rows, known = rows_at(system, t, np.vstack([q, q + steps[some]]))
        rows = np.where(known[:, None, None], rows[:, : system.n_c], np.nan)
        level = ROUNDING * float(np.abs(rows[0]).max(initial=0.0)) / shift
        for k in range(system.n_c):
            name = f"the second derivative of constraint {k} by q"
            record(name, int(some[0]), (rows[1:, k] - rows[0, k]) / shift, level)
    if where:
        raise ValueError(
            f"bandwidth of {system.name!r} must be at least {farthest}: {where}; given {bandwidth}. Or number the "
            "coordinates otherwise, or leave bandwidth out"
        )
