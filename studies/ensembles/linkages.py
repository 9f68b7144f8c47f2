"""Run random four-bar linkages by the million: lengths varied by 2 %, or drawn anew with errors measured."""

import time
from collections.abc import Iterator
from typing import Any

import numpy as np

from references.paper.four_bar_minimal import MinimalFourBar
from studies.bench.cli import Call
from studies.bench.store import Array
from twoloop import consistent_states, ensemble, mechanisms
from twoloop.ensembles.ensemble import Runs
from twoloop.ensembles.lanes import threads_of
from twoloop.mechanisms import Problem, four_bar
from twoloop.mechanisms.four_bar import DENSITY, GRAVITY

VARIED, DRAWN = "random linkages", "in one call"  # groups of rows
SPAN = 6.0  # s
SPREAD = 0.02  # of lengths that are varied
SEED, SEED_DRAWN = 2016, 2017
BLOCK = 50_000  # linkages in a call, which bounds the memory
N_TIMES = 12  # of each run, at which its energy is taken
N_WORST, N_ANY = 20, 100  # linkages whose ends are compared: of largest energy errors, of most steps; of all
RANGES = {"L1": (0.8, 1.5), "L2": (1.0, 2.0), "L3": (0.8, 1.6), "ground": (2.0, 3.0), "theta3": (-1.0, 1.0)}


def drawn(n: int) -> list[dict[str, Any]]:
    """Return the parameters of n linkages, always the same ones."""
    random, given = np.random.default_rng(SEED), []
    for _ in range(n):
        values = {name: round(float(random.uniform(*limits)), 4) for name, limits in RANGES.items()}
        given.append({**values, "branch": int(random.choice((-1, 1)))})
    return given


def linkage(L1: float, L2: float, L3: float, ground: float, theta3: float, branch: int) -> Problem:
    """Return a linkage of these lengths, released from rest."""
    return four_bar((L1, L2, L3), ground, theta3, branch)


def varied(n: int, random: np.random.Generator) -> tuple[Array, Array, Array]:
    """Vary the lengths of the four-bar by 2 %, and assemble n linkages by `consistent_states`."""
    problem = mechanisms.four_bar()
    p = problem.system.parameters * (1.0 + SPREAD * random.uniform(-1.0, 1.0, (n, 4)))
    return p, *consistent_states(problem.system, 0.0, problem.q0, problem.v0, parameters=p, keep=[8])


def varied_row(n: int, block: int = 2 * BLOCK) -> dict[str, Any]:
    """Assemble and run n linkages on all cores, and time it."""
    system, random = mechanisms.four_bar().system, np.random.default_rng(11)
    began, failed, singly, spent = time.perf_counter(), 0, 0, time.process_time()
    for first in range(0, n, block):
        p, q, v = varied(min(block, n - first), random)
        runs = ensemble(system, (0.0, SPAN), q, v, parameters=p)
        failed, singly = failed + int((~runs.success).sum()), singly + int(runs.singly.sum())
    row = {"group": VARIED, "n_runs": n, "n_threads": threads_of(None), "wall": time.perf_counter() - began}
    return row | {"cpu": time.process_time() - spent, "n_failed": failed, "n_singly": singly}


def assembled(n: int) -> tuple[Array, Array]:
    """Draw n linkages, and return those that can be assembled (m, 6) with their positions (m, 9).

    Columns of the first: those of `RANGES`, and the branch. Joint 2-3 is the third corner of a triangle with O.
    """
    low, high = np.array(list(RANGES.values())).T
    uniform = np.random.default_rng(SEED_DRAWN).uniform(size=(n, 6))
    given = np.column_stack([low + (high - low) * uniform[:, :5], np.where(uniform[:, 5] < 0.5, -1.0, 1.0)])
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
    return given, np.ascontiguousarray(np.transpose(places))


def energies(lengths: Array, q: Array, v: Array) -> Array:
    """Return energies (n, n_t) at states (n, 9, n_t), over the sum of weights times lengths of the bars (n, 3)."""
    masses = (DENSITY * lengths)[:, :, None]
    speeds = v[:, 0::3] ** 2 + v[:, 1::3] ** 2 + lengths[:, :, None] ** 2 / 12.0 * v[:, 2::3] ** 2
    total = (masses * (0.5 * speeds + GRAVITY * q[:, 1::3])).sum(axis=1)
    return np.asarray(total / (GRAVITY * DENSITY * (lengths**2).sum(axis=1, keepdims=True)))


def energy_errors(given: Array, q0: Array, runs: Runs) -> Array:
    """Return the largest energy error of each run, NaN where it failed."""
    before = energies(given[:, :3], q0[:, :, None], np.zeros((len(q0), 9, 1)))
    errors = np.abs(energies(given[:, :3], runs.q, runs.v) - before).max(axis=1)
    return np.where(runs.success, errors, np.nan)


def end_error(given: Array, q: Array, t_end: float) -> float:
    """Return how far a run ends from the solution of the equation in one coordinate; NaN where that fails."""
    *lengths, ground, theta3, branch = given.tolist()
    try:
        known = MinimalFourBar(tuple(lengths), ground, theta3, int(branch), DENSITY, GRAVITY)
    except ValueError:
        return float("nan")
    return float(np.abs(known.states(np.array([t_end]))[0][:, 0] - q).max())


def drawn_row(n: int, t_end: float = SPAN) -> dict[str, Any]:
    """Draw, assemble and run n linkages, time it, and measure errors of energy and of some ends.

    `end_error_hard`: of the runs of largest energy errors and most steps, and of those not made in lanes;
    `end_error_any`: of the first ones.
    """
    times, system, began = np.linspace(0.0, t_end, N_TIMES + 1)[1:], four_bar().system, time.perf_counter()
    given, q0 = assembled(n)
    errors, steps, ends, singly, failed = [], [], [], [], 0
    for first in range(0, len(given), BLOCK):
        some = slice(first, first + BLOCK)
        p = given[some, :4]
        runs = ensemble(system, (0.0, t_end), q0[some], np.zeros(9), parameters=p, t_eval=times)
        errors.append(energy_errors(given[some], q0[some], runs))
        steps.append(runs.n_steps)
        ends.append(runs.q[:, :, -1].copy())
        singly += [first + k for k in runs.reasons if k > 0]  # the first of a call checks the system
        failed += int((~runs.success).sum())
    wall = time.perf_counter() - began
    off, taken, q = np.concatenate(errors), np.concatenate(steps), np.concatenate(ends)
    row: dict[str, Any] = {"group": DRAWN, "n_runs": n, "n_threads": threads_of(None), "wall": wall}
    row |= {"n_assembled": len(given), "n_failed": failed, "n_singly": len(singly)}
    row |= {"energy_median": float(np.nanmedian(off)), "energy_error": float(np.nanmax(off))}
    hard = {*np.argsort(-np.nan_to_num(off))[:N_WORST], *np.argsort(-taken)[:N_WORST], *singly}
    for name, chosen in (("hard", sorted(hard)), ("any", range(min(N_ANY, len(given))))):
        row[f"end_error_{name}"] = float(np.nanmax([end_error(given[k], q[k], t_end) for k in chosen]))
    return row


def rows(call: Call) -> Iterator[dict[str, Any]]:
    """Make the rows of both groups, the larger numbers last."""
    varied_row(16)  # compiles what is not on disk
    for n in (200,) if call.quick else (10_000, 1_000_000):
        yield from (make(n) for group, make in ((VARIED, varied_row), (DRAWN, drawn_row)) if call.wants(group))
