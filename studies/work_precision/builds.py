"""The first call with code made for a mechanism whose callbacks are compiled: what building it adds to a later call.

A part of `studies.work_precision`. Each is made in a process of its own that finds the kernels and the callbacks, and
no code of a mechanism; a run on another mechanism has loaded the packages. Runs last for a small part of the motion:
they are of the same code, and some of whole motions through singular positions end early.
"""

import json
import sys
from collections.abc import Collection
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

from references.driver import cpu_time
from studies.bench.collector import REPEATS, attempt, timed
from studies.bench.headline import OWN_CODE
from studies.bench.solvers import CATALOGUE
from studies.bench.store import KeptRows, Row
from studies.validation.study import MAKE
from studies.work_precision import first_calls, rivals
from twoloop import mechanisms
from twoloop.mechanisms import Problem

GROUP = "build"
PROCESSES = 3  # of each mechanism, of which the median counts
ASKED = 0.3  # s of CPU time: a build that takes less is not noticed
PART = 0.05  # of the motion, for which runs last


def collect(kept: KeptRows, quick: bool) -> pd.DataFrame:
    """A row a mechanism and process."""

    def made(name: str, repeat: int) -> Row:
        row: Row = {"group": GROUP, "case": name, "solver": OWN_CODE, "tol": first_calls.TOLERANCE, "repeat": repeat}
        found = first_calls.in_process(__name__, name)
        return row | {"family": CATALOGUE[OWN_CODE].family, "first_call_s": None, "call_s": None} | found

    return pd.DataFrame(
        [
            kept.made(f"{GROUP} | {name} | {repeat}", partial(made, name, repeat))
            for name in names(quick)
            for repeat in range(1 if quick else PROCESSES)
        ]
    )


def names(quick: bool) -> list[str]:
    """The mechanisms, each once: four-bars have one code."""
    made = [problem.name for problem in (make() for make in MAKE)]
    return [rivals.HEADLINE, *made] if not quick else [rivals.HEADLINE]


def times_of(name: str) -> Row:
    """CPU times of the first call and of later ones in this process, s, status and message."""
    problem, loads = problem_of(name), mechanisms.double_pendulum()
    attempt(first_calls.run_of(loads if name != loads.name else mechanisms.heavy_top(), OWN_CODE), 0)
    run = first_calls.run_of(problem, OWN_CODE)
    run = replace(run, case=replace(run.case, t_end=PART * run.case.t_end))
    began = cpu_time()
    result, status, message, _ = attempt(run, 0)
    spent = cpu_time() - began
    found: Row = {"status": status, "message": message}
    if result is None or not result.success:
        return found
    later = [timed(run, 0)[3]["call_s"] for _ in range(REPEATS)]
    return found | {"first_call_s": spent, "call_s": float(np.median(later))}


def problem_of(name: str) -> Problem:
    """The mechanism of a name; nothing is run, which might build code that it shares."""
    if name == rivals.HEADLINE:
        return mechanisms.four_bar()
    return next(problem for problem in (make() for make in MAKE) if problem.name == name)


def findings_of(rows: pd.DataFrame, with_code: Collection[str]) -> list[dict[str, Any]]:
    """By mechanism: what the first call takes longer than a later one, s, and whether the default makes the code.

    `with_code`: the mechanisms for which it does.
    """
    if "first_call_s" not in rows:
        return []
    told = rows[rows["first_call_s"].notna()]
    longer = (told["first_call_s"] - told["call_s"]).groupby(told["case"], sort=False).median()
    return [{"case": case, "build_s": seconds, "default": case in with_code} for case, seconds in longer.items()]


if __name__ == "__main__":
    print(json.dumps(times_of(*sys.argv[1:])))
