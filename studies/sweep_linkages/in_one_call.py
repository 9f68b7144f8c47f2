"""Random linkages by the hundred thousand: assembled in closed form, run by `ensemble`, judged by their energies."""

import time
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from references.paper.four_bar_minimal import MinimalFourBar
from studies.bench.store import Array
from twoloop import ensemble
from twoloop.ensembles.runs import Runs
from twoloop.mechanisms import four_bar
from twoloop.mechanisms.four_bar import DENSITY, GRAVITY

GROUP = "in one call"
SEED = 2017
BLOCK = 50_000  # linkages at a time
N_TIMES = 12  # of each run, at which its energy is taken
# of how many the ends are compared with the equation in one coordinate: of largest energy errors, of most steps,
# and of all
N_WORST, N_ANY = 20, 100
RANGES = {"L1": (0.8, 1.5), "L2": (1.0, 2.0), "L3": (0.8, 1.6), "ground": (2.0, 3.0), "theta3": (-1.0, 1.0)}
NAMES = (*RANGES, "branch")


class Drawn(NamedTuple):
    """Linkages that can be assembled: what they are, a row each, as NAMES has it, and where they start."""

    given: Array  # (n, 6)
    q0: Array  # (n, 9)


def drawn(n: int) -> Array:
    """What n linkages are, (n, 6); the first of more are the same."""
    random = np.random.default_rng(SEED)
    low, high = np.array(list(RANGES.values())).T
    uniform = random.uniform(size=(n, 6))
    return np.column_stack([low + (high - low) * uniform[:, :5], np.where(uniform[:, 5] < 0.5, -1.0, 1.0)])


def assembled(given: Array) -> Drawn:
    """Those whose bars 1 and 2 reach joint 2-3, from the triangle that they make with O."""
    L1, L2, L3, ground, theta3, branch = given.T
    x, y = ground - L3 * np.cos(theta3), -L3 * np.sin(theta3)
    distance = np.hypot(x, y)
    reach = (np.abs(L1 - L2) < distance) & (distance < L1 + L2)
    given, x, y, distance = given[reach], x[reach], y[reach], distance[reach]
    L1, L2, L3, ground, theta3, branch = given.T
    theta1 = np.arctan2(y, x) + branch * np.arccos((L1**2 + distance**2 - L2**2) / (2.0 * L1 * distance))
    theta2 = np.arctan2(y - L1 * np.sin(theta1), x - L1 * np.cos(theta1))
    ends, places = np.zeros((2, len(given))), []
    for length, angle in ((L1, theta1), (L2, theta2), (L3, theta3)):
        bar = length * np.array([np.cos(angle), np.sin(angle)])
        places += [*(ends + 0.5 * bar), angle]
        ends = ends + bar
    return Drawn(given, np.ascontiguousarray(np.transpose(places)))


def energies(lengths: Array, q: Array, v: Array) -> Array:
    """Energies (n, n_t) of linkages with lengths (n, 3) at states (n, 9, n_t), over weights times lengths of bars."""
    masses = (DENSITY * lengths)[:, :, None]
    speeds = v[:, 0::3] ** 2 + v[:, 1::3] ** 2 + lengths[:, :, None] ** 2 / 12.0 * v[:, 2::3] ** 2
    total = (masses * (0.5 * speeds + GRAVITY * q[:, 1::3])).sum(axis=1)
    return np.asarray(total / (GRAVITY * DENSITY * (lengths**2).sum(axis=1, keepdims=True)))


def energy_errors(linkages: Drawn, runs: Runs) -> Array:
    """The largest of each run, NaN where it failed."""
    lengths = linkages.given[:, :3]
    before = energies(lengths, linkages.q0[:, :, None], np.zeros((len(lengths), 9, 1)))
    errors = np.abs(energies(lengths, runs.q, runs.v) - before).max(axis=1)
    return np.where(runs.success, errors, np.nan)


def end_error(given: Array, q: Array, t_end: float) -> float:
    """How far a run ends from where the equation in one coordinate has it end; NaN where that cannot be solved."""
    *lengths, ground, theta3, branch = given.tolist()
    try:
        known = MinimalFourBar(tuple(lengths), ground, theta3, int(branch), DENSITY, GRAVITY)
    except ValueError:
        return float("nan")
    return float(np.abs(known.states(np.array([t_end]))[0][:, 0] - q).max())


def blocks(n: int, t_end: float) -> Iterator[tuple[Drawn, Runs]]:
    """Linkages and their runs, so many at a time."""
    given, times, system = drawn(n), np.linspace(0.0, t_end, N_TIMES + 1)[1:], four_bar().system
    for first in range(0, n, BLOCK):
        linkages = assembled(given[first : first + BLOCK])
        options: dict[str, Any] = {"parameters": linkages.given[:, :4], "t_eval": times}
        yield linkages, ensemble(system, (0.0, t_end), linkages.q0, np.zeros(9), **options)


class _Ends:
    """Linkages and where they end, of which some are kept: the largest of some measures, and the first ones."""

    def __init__(self) -> None:
        self.hard: dict[str, list[tuple[float, Array, Array]]] = {}
        self.left: list[tuple[float, Array, Array]] = []
        self.any: list[tuple[float, Array, Array]] = []

    def take(self, linkages: Drawn, runs: Runs, errors: Array) -> None:
        def ends(which: Any, measure: Array) -> list[tuple[float, Array, Array]]:
            return [(float(measure[k]), linkages.given[k], runs.q[k, :, -1].copy()) for k in which]

        for name, measure in (("energy", np.nan_to_num(errors)), ("steps", runs.n_steps.astype(float))):
            both = self.hard.get(name, []) + ends(np.argsort(-measure)[:N_WORST], measure)
            self.hard[name] = sorted(both, key=lambda each: -each[0])[:N_WORST]
        self.left += ends([k for k in runs.reasons if k > 0], errors)  # the first of a call checks the system
        self.any += ends(range(min(N_ANY - len(self.any), len(errors))), errors)

    def compared(self, t_end: float) -> dict[str, Any]:
        """The largest errors at the end, of hard ones and of any, and of how many of these nothing is known."""
        hard = [*self.hard["energy"], *self.hard["steps"], *self.left]
        found: dict[str, Any] = {"n_left": len(self.left)}
        for name, some in (("hard", hard), ("any", self.any)):
            off = np.array([end_error(given, q, t_end) for _, given, q in some])
            found |= {f"n_{name}": len(off), f"end_error_{name}": float(np.nanmax(off))}
            found |= {f"n_unknown_{name}": int(np.isnan(off).sum())}
        return found


def row_of(n: int, t_end: float) -> dict[str, Any]:
    """What became of n linkages, and how long they took, to be drawn, assembled, run and measured."""
    row: dict[str, Any] = {"group": GROUP, "n_runs": n, "n_assembled": 0, "n_failed": 0}
    ends, errors, wall, began = _Ends(), [], 0.0, time.perf_counter()
    for linkages, runs in blocks(n, t_end):
        errors.append(energy_errors(linkages, runs))
        wall += time.perf_counter() - began
        row["n_assembled"] += len(runs)
        row["n_failed"] += int((~runs.success).sum())
        ends.take(linkages, runs, errors[-1])
        began = time.perf_counter()
    low, high = np.nanquantile(np.concatenate(errors), [0.5, 0.95])
    worst, given, _ = ends.hard["energy"][0]
    row |= {"wall": wall, "energy_median": float(low), "energy_high": float(high), "energy_error": worst}
    return row | ends.compared(t_end) | dict(zip(NAMES, given.tolist(), strict=True))
