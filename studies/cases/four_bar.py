"""The paper's first example, the four-bar linkage, in two geometries; its motion is known apart from all solvers."""

from functools import cache, partial

import numpy as np

from references.four_bar_minimal import MinimalFourBar
from studies.bench import Case
from studies.reference_motion import ReferenceMotion
from twoloop.mechanisms import Problem, four_bar

Y3 = 7  # place of y3, the height of bar 3's centre, by which the paper shows the motion
SECOND = {"lengths": (0.8, 1.2, 1.0), "ground": 2.0}
FLOOR = 1e-11  # m, rad; the one-coordinate solution is good to about 1e-12 after 100 s
STEPS = (1e-2, 4e-3, 2e-3, 1e-3, 4e-4, 1e-4)  # s
NOTE = "Lengths, masses and start are assumed: Table 2 of the paper is lost."


def _known(problem: Problem) -> ReferenceMotion:
    motion = MinimalFourBar.from_parameters(problem.parameters)
    source = "one-coordinate formulation of its own (references/four_bar_minimal.py), DOP853 at 1e-13"
    return ReferenceMotion(motion.states, FLOOR, source)


@cache
def period() -> float:
    """Period of the first geometry, s."""
    return MinimalFourBar.from_parameters(four_bar().parameters).period


def case(problem: Problem, name: str, t_end: float, timed: float = 0.1) -> Case:
    """A linkage from `four_bar(...)`, released from rest."""
    told = {"watched": (Y3,), "step_sizes": STEPS, "timed": timed, "tags": ("smooth",), "note": NOTE}
    return Case(name, problem, t_end, partial(_known, problem), **told)  # type: ignore[arg-type]


def cases(quick: bool) -> list[Case]:
    """Both geometries over 100 s; quick: 10 s."""
    t_end, timed = (10.0, 0.02) if quick else (100.0, 0.1)
    second = four_bar(**SECOND)  # type: ignore[arg-type]
    return [case(four_bar(), "four-bar", t_end, timed), case(second, "four-bar, second", t_end, timed)]


def in_line(problem: Problem) -> dict[str, int]:
    """How often two bars come into line in a period, by the angle that then fails as the independent coordinate."""
    motion = MinimalFourBar.from_parameters(problem.parameters)
    q, _ = motion.states(np.linspace(0.0, motion.period, 2001))
    angles = {"θ1": q[8] - q[5], "θ2": q[8] - q[2], "θ3": q[5] - q[2]}
    return {name: int(np.count_nonzero(np.diff(np.sign(np.sin(a))))) for name, a in angles.items()}
