"""Rows of random assemblies: accelerations, multipliers and rank at a state, against NumPy's dense algebra."""

import warnings
from collections.abc import Callable
from functools import partial

import numpy as np
import pandas as pd

from studies.bench.random_assemblies import PlanarAssembly, RandomAssembly, SpatialAssembly, dense_solution, drawn
from studies.bench.store import Row
from studies.scale.runs import METHOD, Keyed
from twoloop import ConstraintWarning, solve_dae

AGREEMENT = "agreement"  # group of rows
KINDS: dict[str, tuple[Callable[..., RandomAssembly], int]] = {
    "in a plane": (PlanarAssembly, 400),
    "in space": (SpatialAssembly, 200),
}
QUICK = 4  # assemblies of a kind


def agreements(quick: bool) -> Keyed:
    """Rows of random trees and loops, some of them with redundant rows."""
    for case, (kind, number) in KINDS.items():
        for seed in range(QUICK if quick else number):
            yield f"{AGREEMENT} | {case} | {seed}", partial(agreement, case, kind, seed)


def agreement(case: str, kind: Callable[..., RandomAssembly], seed: int) -> Row:
    """An assembly at random velocities that its constraints allow, by the form that a run would take."""
    made = drawn(kind, seed)
    system = made.system("random")
    v = made.v(system)
    exact = dense_solution(system, made.q, v)
    row: Row = {"group": AGREEMENT, "case": case, "n": len(made.places), "repeat": seed, "error_q": None}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConstraintWarning)  # redundant rows are meant
        try:
            result = solve_dae(system, (0.0, 1.0), made.q, v, METHOD, max_steps=1, compiled=False)
        except (RuntimeError, ValueError) as error:
            return row | {"status": "FAILED", "message": str(error)}
    row |= {"redundant": system.n_c - exact.rank, "status": "REACHED_END", "message": ""}
    if result.rank != exact.rank:
        return row | {"status": "FAILED", "message": f"rank {result.rank} instead of {exact.rank}"}
    return row | {"error_q": exact.error(result.a[:, 0], result.lam[:, 0])}


def found_of(rows: pd.DataFrame) -> list[dict[str, object]]:
    """By kind: how many there are, how many have redundant rows, bodies, the largest error, and which failed."""
    found: list[dict[str, object]] = []
    for case, own in rows[rows["group"] == AGREEMENT].groupby("case", sort=False):
        failed = own[own["status"] != "REACHED_END"]
        line: dict[str, object] = {"case": str(case), "number": len(own), "worst": float(np.nanmax(own["error_q"]))}
        line |= {"redundant": int((own["redundant"] > 0).sum()), "bodies": [int(own["n"].min()), int(own["n"].max())]}
        found.append(line | {"failed": len(failed), "why": sorted(set(failed["message"]))[:1]})
    return found
