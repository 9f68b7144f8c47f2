"""Four-bar linkages drawn at random, made of any size and mass, with their motion by one equation of one unknown.

That motion is `references.paper.four_bar_minimal`, SciPy's DOP853 at 1e-13: it shares no line with the integrators.
"""

import sys
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from references.paper.four_bar_minimal import MinimalFourBar
from studies.bench.store import Array
from twoloop import ConstrainedSystem
from twoloop.kernels.compile.callbacks import callback
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
    kind: str  # one of KINDS
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
    return Drawn(problem, kind, q, float(np.abs(nudged - q).max()) / NUDGE)


@callback("mass")
def mass(t, q, p, M):  # type: ignore[no-untyped-def]
    for i in range(3):
        m = p[4 + i] * p[i]
        M[3 * i, 3 * i] = m
        M[3 * i + 1, 3 * i + 1] = m
        M[3 * i + 2, 3 * i + 2] = m * p[i] ** 2 / 12.0


@callback("force")
def force(t, q, v, p, Q):  # type: ignore[no-untyped-def]
    for i in range(3):
        Q[3 * i + 1] = -p[4 + i] * p[i] * 9.81


def scaled(size: float, densities: tuple[float, float, float]) -> Problem:
    """The default linkage with all lengths times `size`, and bars of these masses per length (kg/m)."""
    problem = four_bar()
    p = np.array([problem.parameters[name] for name in ("L1", "L2", "L3", "L")]) * size
    rows = {name: getattr(equations, name) for name in ("constraint", "jacobian", "gamma", "kinematics")}
    about: dict[str, Any] = {"parameters": [*p.tolist(), *densities], "constant_mass": True}
    name = f"four-bar of size {size:g}, densities {', '.join(f'{d:g}' for d in densities)}"
    system = ConstrainedSystem(n_q=9, n_c=8, mass=mass, force=force, name=name, **rows, **about)
    q0 = problem.q0.copy()
    q0[PLACES] *= size
    return replace(problem, name=system.name, system=system, q0=q0, reference=None)


def end_of_scaled(size: float, densities: tuple[float, float, float], t_end: float) -> Array:
    """Its positions at t_end: size scales lengths by s and times by sqrt(s), as gravity stays."""
    p = four_bar().parameters
    bars = (p["L1"], p["L2"], p["L3"])
    motion = MinimalFourBar(bars, p["L"], p["theta3"], p["branch"], densities, p["gravity"])
    q = motion.states(t_end / np.sqrt(size))[0][:, 0]
    q[PLACES] *= size
    return q
