"""Mechanisms from SymPy: what a chain of n links costs to derive, to compile, to start again and to evaluate.

Times of making are CPU times of a process of its own; those of evaluations are the least of several runs.
"""

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from itertools import product
from typing import Any

import numpy as np
import pandas as pd

from studies.bench.cli import ROOT
from studies.bench.store import Row
from studies.bench.study import Study, kept_rows
from studies.symbolic_size.models import MODELS, REPEATS
from twoloop import solve_dae
from twoloop.mechanisms import Problem

SIZES = (2, 5, 10, 20)
QUICK_SIZES = (2,)
QUICK_MODELS = 2
TIME_LIMIT = 150.0  # s of wall-clock time for one chain, twice
LONGEST = 2.0  # s of motion of the comparisons


def made(coordinates: str, n: int, tangents: bool) -> Row:
    """One chain, made in a process of its own, and again in a second one."""
    row: Row = {"group": "size", "case": coordinates, "n": n, "tangents": tangents}
    with tempfile.TemporaryDirectory() as folder:
        words = [sys.executable, "-m", "studies.symbolic_size.models", coordinates, str(n), str(tangents), folder]
        for turn in ("first", "second"):
            try:
                done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=TIME_LIMIT)
            except subprocess.TimeoutExpired:
                return row | {"status": "TIME_LIMIT", "message": f"the {turn} process took more than {TIME_LIMIT:g} s"}
            if done.returncode != 0:
                return row | {"status": "RAISED", "message": (done.stderr.strip().splitlines() or ["?"])[-1]}
            got = json.loads(done.stdout)
            row |= {"second_s": got["start_s"]} if turn == "second" else got
    return row


def cost(problem: Problem, times: int) -> tuple[float, int | None]:
    """Least CPU time of an evaluation, us, and how many there were."""
    end = min(LONGEST, problem.t_span[1])
    least, count = np.inf, None
    for _ in range(times):
        result = solve_dae(
            problem.system, (0.0, end), problem.q0, problem.v0, "DOP853", rtol=1e-8, atol=1e-8, compiled=False
        )
        count = result.stats.n_evaluations
        least = min(least, 1e6 * (result.stats.cpu_time or 0.0) / (count or 1))
    return least, count


def compared(name: str) -> Row:
    """A ready mechanism and its twin from SymPy: evaluations of a run and what one costs."""
    hand, mechanism = MODELS[name]()
    twin = mechanism.problem(hand.q0, hand.v0, hand.t_span)
    row: Row = {"group": "twin", "case": name, "status": "REACHED_END"} | dict.fromkeys(("hand_us", "twin_us"), np.inf)
    for _ in range(REPEATS):  # in turn, so that both see the same machine
        for whose, problem in (("hand", hand), ("twin", twin)):
            least, count = cost(problem, REPEATS)
            row |= {f"{whose}_us": min(row[f"{whose}_us"], least), f"{whose}_evaluations": count}
    return row


def rows_of(quick: bool) -> Iterator[tuple[str, Callable[[], Row]]]:
    """Keys of chains and twins, and what makes their rows."""
    sizes = product(QUICK_SIZES if quick else SIZES, ("positions", "angles"), (False,) if quick else (False, True))
    for n, which, tangents in sizes:
        yield str((which, n, tangents)), partial(made, which, n, tangents)
    for name in list(MODELS)[: QUICK_MODELS if quick else None]:
        yield name, partial(compared, name)


def findings_of(rows: pd.DataFrame) -> dict[str, Any]:
    sizes, twins = rows[rows["group"] == "size"], rows[rows["group"] == "twin"]
    done = sizes[sizes["status"] == "REACHED_END"]
    ratios = twins["twin_us"] / twins["hand_us"]
    largest = done[(done["n"] == done["n"].max()) & (done["case"] == "angles")]
    parts = [largest[largest["tangents"] == which]["compile_s"] for which in (False, True)]
    failed = sizes[sizes["status"] != "REACHED_END"]
    return {
        "n": None if done.empty else int(done["n"].max()),
        "failed": [f"{row.case}, n = {row.n:g}: {row.status}" for row in failed.itertuples()],
        "second_s": None if done.empty else [float(done["second_s"].median()), float(done["second_s"].max())],
        "compile_s": [None if part.empty else float(part.max()) for part in parts],
        "ratio": [float(ratios.min()), float(ratios.max())],
        "other_counts": twins["case"][twins["twin_evaluations"] != twins["hand_evaluations"]].tolist(),
    }


STUDY = Study("symbolic_size", __doc__, kept_rows(rows_of), findings_of)
