"""Remarks on an assembled model: degrees of freedom, redundancy, and likely mistakes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from twoloop.bodies.assembly import Freedom
from twoloop.bodies.collection import Collection
from twoloop.bodies.model_stops import TurnGap
from twoloop.bodies.tables import TENSOR, Tables
from twoloop.checks.arguments import Array
from twoloop.problem.description import name_and_unit

MOVED = 1e-6  # relative to the largest coordinate: smaller displacements are not reported
ROUNDED = 0.01  # relative tolerance of the triangle inequality, for moments of inertia rounded to a few digits
TURN = 2.0 * np.pi


def note_of(
    model: Collection,
    tables: Tables,
    freedom: Freedom,
    given: Array,
    closed: Array,
    start: Array,
    coordinates: Sequence[str],
) -> str:
    """Return remarks on degrees of freedom, redundant rows and possible mistakes.

    Parameters
    ----------
    model : Collection
    tables : Tables
    freedom : Freedom
    given, closed, start : ndarray (n_q,)
        Coordinates as given, with all joints closed, and with the drives at their initial values.
    coordinates : sequence of str (n_q,)
    """
    made = [*_freedom(freedom), *_moved(given, closed, coordinates), *_forgotten(model)]
    made += (*_inertias(model, tables), *_turns(model, tables, start))
    if tables.untraced:
        made.append(f"Its functions are called in Python, which is slower: {tables.untraced}.")
    return " ".join(made)


def _freedom(freedom: Freedom) -> Iterator[str]:
    yield f"{freedom.degrees} {'degree' if freedom.degrees == 1 else 'degrees'} of freedom."
    if freedom.singular:
        yield f"The start is singular: {freedom.singular} more degrees of freedom there."
    for group in freedom.redundant:
        yield f"The rows of {', '.join(map(repr, group))} are dependent."


def _moved(given: Array, closed: Array, coordinates: Sequence[str]) -> Iterator[str]:
    off = np.abs(closed - given)
    if off.max(initial=0.0) > MOVED * np.abs(closed).max():
        name, unit = name_and_unit(coordinates[int(off.argmax())])
        yield f"Bodies were moved to close the joints, {name} by {f'{off.max():.3g} {unit}'.rstrip()}."


def _forgotten(model: Collection) -> Iterator[str]:
    drives = {id(each.point_b): each.name for each in model.joints if each.kind == "drive"}
    joined = {id(body) for each in model.joints for body in (each.a, each.b)}
    joined |= {id(body) for each in model.forces for body in (each.first, each.second)}
    for body in model.bodies:
        if model.joints and id(body) not in joined:
            yield f"{body.name!r} has no joint, and no force acts on it."
    for force in model.forces:
        if force.joint is not None and id(force.joint.point_b) in drives:
            name = drives[id(force.joint.point_b)]
            yield f"{force.name!r} acts where {name!r} prescribes the motion: it only changes the drive reaction."
    if model.dry:
        yield "solve_with_friction handles its dry friction; solve_dae ignores it."
    if model.stops:
        yield "solve_with_stops handles its stops; solve_dae ignores them."


def _inertias(model: Collection, tables: Tables) -> Iterator[str]:
    """Yield bodies whose principal moments violate the triangle inequality; the equations are still well defined."""
    for body in model.bodies if model.dimension == 3 else ():
        first = tables.places[f"mass of {body.name} (kg)"] + 1
        low, middle, high = np.linalg.eigvalsh(tables.p[first : first + 6][TENSOR].reshape(3, 3))
        if high > (1.0 + ROUNDED) * (low + middle):
            yield (
                f"No body has the principal moments of inertia of {body.name!r}, {low:.6g}, {middle:.6g} and "
                f"{high:.6g}: the largest exceeds the sum of the others."
            )


def _turns(model: Collection, tables: Tables, start: Array) -> Iterator[str]:
    """Yield angles of more than one turn, which may be meant in degrees."""
    angles = {name: value for name, value in tables.values.items() if name.endswith("(rad)")}
    if model.dimension == 2:
        angles |= {f"angle of {body.name} (rad)": start[body.coordinates[2]] for body in model.bodies}
    angles |= {f"{each.name} (rad)": each.gap.limit for each in model.stops if isinstance(each.gap, TurnGap)}
    for name, value in angles.items():
        if abs(value) > TURN:
            yield f"{name[:-6]} is {value:.6g} rad, more than a turn: angles are in rad, not in degrees."
