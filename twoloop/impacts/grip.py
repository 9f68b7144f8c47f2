"""Coulomb friction of stops: which of them slide or stick along their surfaces."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from twoloop.checks.arguments import Array
from twoloop.impacts.gaps import Gap, Gaps
from twoloop.impacts.laws import NEGLIGIBLE, Rubs, Undetermined
from twoloop.impacts.rubbing import INDEPENDENT, Signs
from twoloop.problem.description import Stop

AT_REST = 1e-10  # relative to the largest velocities of the last arc: smaller rates count as zero
ALIKE = 1e-6  # tolerance of the coefficients by which one displacement follows from another


class Mode(NamedTuple):
    """What holds between two changes: directions of joints, closed stops, and which of these slide or stick.

    Attributes
    ----------
    signs : list
    resting : tuple of int
    slips : dict
        Direction of sliding by stop.
    sticks : dict
        By one stop of each group that sticks together, all stops of the group.
    """

    signs: Signs
    resting: tuple[int, ...] = ()
    slips: dict[int, int] = {}  # noqa: RUF012
    sticks: dict[int, list[int]] = {}  # noqa: RUF012


class Grip:
    """Friction of the stops of a motion.

    Parameters
    ----------
    stops : sequence of Stop
    t, q : float, ndarray (n_q,)
    """

    def __init__(self, stops: Sequence[Stop], t: float, q: Array):
        self._stops = stops
        rubbing = [k for k, stop in enumerate(stops) if stop.friction > 0.0]
        self.place = {k: i for i, k in enumerate(rubbing)}
        self.slides = Gaps("slide", [stops[k] for k in rubbing], t, q)
        self.still: set[int] = set()  # stops that have come to rest or stick
        self.released: set[int] = set()  # stops that stuck in the last arc

    def rows(self, closed: Sequence[int], t: float, q: Array, v: Array, speeds: Array) -> tuple[list[int], Gap, Rubs]:
        """Return which of the closed stops rub, their displacements, and how they slide."""
        of = [k for k in closed if k in self.place]
        every = self.slides.at(t, q, v)
        made = Gap(*(each[[self.place[k] for k in of]] for each in every))
        held = np.array([k in self.still or k in self.released for k in of], dtype=bool)
        moves = ~held & (np.abs(made.u) > AT_REST * (np.abs(made.W) @ speeds))
        signs = (np.sign(made.u) * moves).astype(int)
        places = np.array([list(closed).index(k) for k in of], dtype=int)
        return of, made, Rubs(places, np.array([self._stops[k].friction for k in of]), signs)

    def coefficient(self, k: int) -> float:
        """Return the coefficient of friction of a stop."""
        return self._stops[k].friction

    def groups(self, D: Array, base: list[int], at: dict[int, int]) -> dict[int, list[int]]:
        """Return stops that stick, in groups with one displacement; D has rows of `base`, and of the stops `at`."""
        groups: dict[int, list[int]] = {}
        first: dict[int, int] = {}  # stop of a row
        for k, row in at.items():
            known = np.linalg.lstsq(D[np.ix_(base, base)], D[base, row], rcond=NEGLIGIBLE)[0]
            if D[row, row] - D[row, base] @ known > INDEPENDENT * D[row, row]:
                base.append(row)
                groups[k], first[row] = [k], k
                continue
            others = [i for i, part in zip(base, known, strict=True) if abs(part) > ALIKE]
            if len(others) != 1 or others[0] not in first or abs(abs(known[base.index(others[0])]) - 1.0) > ALIKE:
                raise Undetermined(
                    f"the friction of {self._stops[k].name!r} is not determined: other stops and joints hold it already"
                )
            groups[first[others[0]]].append(k)
        return groups

    def change(self, mode: Mode, over: set[int]) -> None:
        """Note which stops have come to rest or were released, from those whose events ended the arc."""
        self.released = {k for one, group in mode.sticks.items() if one in over for k in group}
        self.still = {k for one, group in mode.sticks.items() if one not in over for k in group}
        self.still |= {k for k in mode.slips if k in over}
