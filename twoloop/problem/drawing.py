"""What is drawn of a mechanism: points that follow from its coordinates, lines between them, paths of some."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from twoloop.checks.arguments import Array, check_call


@dataclass(frozen=True, eq=False)
class Drawing:
    """A mechanism as a wireframe; `Result.animate` moves it.

    Parameters
    ----------
    points : callable
        points(q) gives the points, m: of shape (n_points, 2) in a plane or (n_points, 3) in space for q (n_q,), and
        with a further axis (n_points, 2 or 3, n_t) for q (n_q, n_t).
    bars : sequence of (int, int)
        Pairs of points that a line joins.
    traces : sequence of int
        Points whose paths are drawn.

    Raises
    ------
    TypeError, ValueError
        If `points` is not callable, or `bars` and `traces` are not made of indices. Whether the points exist is
        checked with a `Problem`, at its start.

    Examples
    --------
    >>> import numpy as np
    >>> from twoloop import Drawing
    >>> rod = Drawing(lambda q: [(0.0, 0.0), (q[0], q[1])], bars=((0, 1),), traces=(1,))
    >>> rod.at(np.array([0.6, -0.8])).shape
    (2, 2)
    """

    points: Callable[[Array], Any]
    bars: tuple[tuple[int, int], ...]
    traces: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        if not callable(self.points):
            raise TypeError(f"points must be a function of q that gives (n_points, 2 or 3); given {self.points!r}")
        check_call("points", "points", self.points, ("q",))
        try:
            bars = tuple((int(first), int(second)) for first, second in self.bars)
            traces = tuple(int(each) for each in self.traces)
        except (TypeError, ValueError):
            raise TypeError(
                f"bars must be pairs of points and traces points, by their numbers: bars=[(0, 1)], traces=[1]; given "
                f"{self.bars!r} and {self.traces!r}"
            ) from None
        object.__setattr__(self, "bars", bars)
        object.__setattr__(self, "traces", traces)

    def at(self, q: Array) -> Array:
        """The points at q (n_q,) or (n_q, n_t).

        Raises
        ------
        ValueError
            If `points` gives another shape, or has not the points that `bars` and `traces` name.
        """
        found = np.asarray(self.points(q), dtype=float)
        if found.ndim != 1 + q.ndim or found.shape[1] not in (2, 3) or found.shape[2:] != q.shape[1:]:
            expected = "(n_points, 2 or 3)" if q.ndim == 1 else f"(n_points, 2 or 3, {q.shape[1]})"
            raise ValueError(
                f"points of a drawing must give an array of shape {expected} for q of shape {q.shape}; it gave one of "
                f"shape {found.shape}"
            )
        named = [*self.traces, *(end for bar in self.bars for end in bar)]
        wrong = [number for number in named if not 0 <= number < len(found)]
        if wrong:
            raise ValueError(
                f"bars and traces of a drawing must name points from 0 to {len(found) - 1}; they name {wrong[0]}"
            )
        return found
