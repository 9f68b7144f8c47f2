"""The paper's first example, the four-bar linkage, in two geometries, with its motion known without any solver.

Lengths, masses and start are assumed, because Table 2 is missing from the text that was available.
"""

from functools import cache, partial
from typing import Any

from references.paper.four_bar_minimal import MinimalFourBar
from studies.bench.collector import Case
from studies.bench.reference_motion import ReferenceMotion
from twoloop.mechanisms import Problem, four_bar

Y3 = 7  # place of y3, the height of bar 3's centre, by which the paper shows the motion
SECOND: dict[str, Any] = {"lengths": (0.8, 1.2, 1.0), "ground": 2.0}
FLOOR = 1e-11  # m, rad; the one-coordinate solution is good to about 1e-12 after 100 s
STEPS = (1e-2, 4e-3, 2e-3, 1e-3, 4e-4, 1e-4)  # s
TOLD: dict[str, Any] = {"watched": (Y3,), "step_sizes": STEPS, "time_limit": 20.0}  # s


def _known(problem: Problem) -> ReferenceMotion:
    motion = MinimalFourBar.from_parameters(problem.parameters)
    source = "one-coordinate formulation of its own (references/paper/four_bar_minimal.py), DOP853 at 1e-13"
    return ReferenceMotion(motion.states, FLOOR, source)


@cache
def period() -> float:
    """Period of the first geometry, s."""
    return MinimalFourBar.from_parameters(four_bar().parameters).period


def case_of(lengths: tuple[float, float, float], ground: float, quick: bool) -> Case:
    """Return another geometry, released from rest, over 100 s; quick: 10 s."""
    problem = four_bar(lengths, ground)
    return Case("four-bar, given lengths", problem, 10.0 if quick else 100.0, partial(_known, problem), **TOLD)


def cases(quick: bool) -> list[Case]:
    """Both geometries, released from rest, over 100 s; quick: 10 s."""
    t_end, timed = (10.0, 0.004) if quick else (100.0, 0.1)
    made = {"four-bar": four_bar(), "four-bar, second": four_bar(**SECOND)}
    return [Case(name, each, t_end, partial(_known, each), timed=timed, **TOLD) for name, each in made.items()]
