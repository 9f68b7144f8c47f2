"""What changes suddenly for so short a time that other such changes may have passed between two looks.

A run that met it is made again with closer looks, at most MOST times: changes that follow one another without end, as
noise does, would take looks without end. Then it is said.
"""

import warnings
from typing import TYPE_CHECKING

from twoloop.checks.consistency import ConstraintWarning

if TYPE_CHECKING:
    from twoloop.run.run import Run

WITHIN = 2.0  # looks: a run that met what lasts no longer is made again, as some of it may last shorter still
SEEN = 1.25  # looks: what lasts longer does not fall between two of them; of the rest it is said
CLOSER = 4.0  # looks within the shortest change, when the run is made again ...
MOST_CLOSER = 8.0  # ... but no more times as many looks as before
MOST = 2  # runs that are made again


def may_be_missed(run: "Run", looks: float = WITHIN) -> bool:
    """Whether something changed for so short a time that the next such change may have been passed over."""
    a, clock = run.a, run.clock
    return bool(clock[a.BRIEFEST] < looks * clock[a.WIDEST_LOOK])


def closer(run: "Run") -> float:
    """The time between two looks of a run that is to meet what this one may have missed, s."""
    a, clock = run.a, run.clock
    return float(max(clock[a.BRIEFEST] / CLOSER, clock[a.WIDEST_LOOK] / MOST_CLOSER))


def said_of_missed(run: "Run", calls: int = 5) -> str:
    """A warning, and the sentence, of a run that succeeded, and is not made again, but may have missed something.

    calls : from here to who has called.
    """
    if not may_be_missed(run, SEEN):
        return ""
    a, clock = run.a, run.clock
    said = (
        f"forces, constraint_rate or nonholonomic_rate change suddenly for {clock[a.BRIEFEST]:.2g} s, and were looked "
        f"at every {clock[a.WIDEST_LOOK]:.2g} s only, where steps are long: other changes as short may have been "
        f"missed. Give max_step, at most {clock[a.BRIEFEST]:.2g}"
    )
    warnings.warn(said, ConstraintWarning, stacklevel=calls)
    return f" {said[0].upper()}{said[1:]}."
