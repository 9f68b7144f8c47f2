"""Draw four-bar linkages at random, with their motion by one equation of one unknown.

That motion is `references.paper.four_bar_minimal`, SciPy's DOP853 at 1e-13: it shares no line with the integrators.
"""

import sys
from dataclasses import dataclass

import numpy as np

from references.paper.four_bar_minimal import MinimalFourBar
from studies.bench.store import Array
from twoloop.mechanisms import Problem, four_bar

equations = sys.modules[four_bar.__module__]  # the module, whose name its function has taken in the package


GRASHOF, OTHER, NEAR = "a bar can turn round", "no bar can", "near a change point"
KINDS = (GRASHOF, OTHER, NEAR)
LENGTHS = (0.3, 2.0)  # m, of bars and ground
APART = 0.05  # m, least |shortest + longest - the others| of the first two kinds ...
CLOSE = (-8.0, -2.0)  # ... and the decades of those of the third
NUDGE = 1e-7  # rad of the initial angle, by which the sensitivity of the end is found
PLACES = np.array([0, 1, 3, 4, 6, 7])  # the coordinates that are lengths


@dataclass(frozen=True)
class Drawn:
    """A linkage, its right state at the end, and how much an error at the start grows until then."""

    problem: Problem
    q: Array  # (9,); positions at the end, the angles counted from those of the start
    sensitivity: float  # change of q over that of the initial angle of bar 3


def four_lengths(kind: str, generator: np.random.Generator) -> Array:
    """Lengths of the three bars and of the ground, in random order."""
    while True:
        s = np.sort(generator.uniform(*LENGTHS, 4))
        excess = s[1] + s[2] - s[0] - s[3]  # positive: Grashof's condition holds
        if kind == NEAR:
            s[3] += excess - generator.choice([-1.0, 1.0]) * 10.0 ** generator.uniform(*CLOSE)
            if s[3] < s[2]:
                continue
        elif abs(excess) < APART or (excess > 0.0) != (kind == GRASHOF):
            continue
        return generator.permutation(s)


def end_of(problem: Problem, t_end: float, theta3: float | None = None) -> Array:
    """Positions at t_end by the minimal coordinate; whole turns by which its angles differ at the start are removed."""
    p = problem.parameters if theta3 is None else problem.parameters | {"theta3": theta3}
    q = MinimalFourBar.from_parameters(p).states([0.0, t_end])[0]
    turns = np.round((problem.q0 - q[:, 0]) / (2.0 * np.pi))
    turns[PLACES] = 0.0
    return q[:, 1] + 2.0 * np.pi * turns


def draw(kind: str, generator: np.random.Generator, t_end: float) -> Drawn | None:
    """A linkage at rest in a random position; None where it cannot be assembled or its motion is not known."""
    *bars, ground = four_lengths(kind, generator).tolist()
    theta3, branch = float(generator.uniform(-np.pi, np.pi)), int(generator.choice([-1, 1]))
    try:
        problem = four_bar((bars[0], bars[1], bars[2]), ground, theta3, branch)
        q, nudged = end_of(problem, t_end), end_of(problem, t_end, theta3 + NUDGE)
    except ValueError:
        return None
    return Drawn(problem, q, float(np.abs(nudged - q).max()) / NUDGE)
