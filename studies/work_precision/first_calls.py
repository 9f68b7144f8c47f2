"""Time the first call on a mechanism: nothing built, caches cold, a process of its own.

A part of `studies.work_precision`. The process has an empty folder of caches, but for the kernels of twoloop and the
callbacks that all models of bodies share, which are compiled once an installation; callbacks written for a mechanism
are compiled anew. It loads the packages by a run on another mechanism. CPU time, with that of compilers, is from the
making of the mechanism, which compiles its callbacks, until the end of the call. For solvers that read the equations
from the callbacks, and call none of them, it is without that: their users write equations instead.
"""

import importlib
import json
import os
import shutil
import site
import subprocess
import sys
import tempfile
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from types import ModuleType
from typing import Any

import numba
import numpy as np
import pandas as pd

from references.driver import cpu_time, user_call
from studies.bench.cli import ROOT, Call
from studies.bench.collector import REPEATS, Run, attempt, timed
from studies.bench.end_states import case_of
from studies.bench.solvers import CATALOGUE, COMPILED, CVODE_C, CYRK, DEFAULT, DIFFRAX, HEYOKA, IDA_C
from studies.bench.store import KeptRows, Row
from studies.work_precision.mechanisms import TIMED
from twoloop import mechanisms
from twoloop.checks.consistency import check_start

GROUP = "first call"
BUILDING = (*COMPILED, HEYOKA, CYRK, CVODE_C, IDA_C, DIFFRAX, "IDAS, CasADi")  # for whom code is built
MECHANISMS = {"four-bar": "four_bar", "SUNDIALS slider-crank": "sundials_slider_crank"}  # and how each is made
MECHANISMS |= {"Andrews' squeezing mechanism": "andrews", "spatial four-bar": "spatial_four_bar"}
MECHANISMS |= {"heavy top": "heavy_top"}
QUICK = (DEFAULT, "auto, compiled")
TOLERANCE = 1e-8
TIMES = ("first_call_s", "call_s", "call_q1", "call_q3")
LIMIT = 120.0  # s of CPU of a call
EQUATIONS = "equations"  # folder of twoloop's code for single mechanisms in a folder of caches


def collect(kept: KeptRows, call: Call) -> pd.DataFrame:
    """Make the rows, one a mechanism and solver."""

    def made(name: str, solver: str) -> Row:
        row: Row = {"group": GROUP, "case": name, "solver": solver, "tol": TOLERANCE, "repeat": 0}
        return row | {"family": CATALOGUE[solver].family, **dict.fromkeys(TIMES), **in_process(__name__, name, solver)}

    pairs = product(list(MECHANISMS)[: 1 if call.quick else None], QUICK if call.quick else (DEFAULT, *BUILDING))
    wanted = [pair for pair in pairs if call.wants(GROUP, *pair, CATALOGUE[pair[1]].family)]
    return pd.DataFrame([kept.made(" | ".join((GROUP, *pair)), partial(made, *pair)) for pair in wanted])


def in_process(module: str, *words: str) -> Row:
    """Run a module for a mechanism in a new process, in which no code of mechanisms is cached, and read its answer."""
    with tempfile.TemporaryDirectory(prefix="twoloop-first-") as folder:
        environment = {**os.environ, "HOME": folder, "XDG_CACHE_HOME": folder, "PYTHONUSERBASE": site.getuserbase()}
        if shared := os.environ.get("NUMBA_CACHE_DIR"):  # with the kernels, and the code of mechanisms
            own = shutil.copytree(shared, Path(folder, "numba"), ignore=shutil.ignore_patterns(EQUATIONS))
            environment["NUMBA_CACHE_DIR"] = str(own)
        command = [sys.executable, "-m", module, *words]
        done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    if done.returncode:
        return {"status": "RAISED", "message": (done.stderr.strip().splitlines() or ["no word of why"])[-1]}
    return dict(json.loads(done.stdout.splitlines()[-1]))


def times_of(name: str, solver: str) -> Row:
    """Time the first call and later ones in this process."""
    attempt(run_of(mechanisms.double_pendulum(), solver), 0)
    make = getattr(mechanisms, MECHANISMS[name])
    module = importlib.import_module(make.__module__)
    user_call.ended = None
    began = cpu_time()
    run = run_of(getattr(_compiled_anew(module), MECHANISMS[name])(), solver)
    if run.solver.traces and run.solver.family != "two-loop":
        start = run.case.problem
        check_start(start.system, 0.0, start.q0, start.v0)
        began = cpu_time()
    result, status, message, _ = attempt(run, 0)
    # to the end of the user's call: a second run for the output, and what is built for it, is ours
    spent = (cpu_time() if user_call.ended is None else user_call.ended) - began
    found: Row = {"status": status, "message": message}
    if result is None or not result.success:
        return found
    later = [timed(run, 0)[3]["call_s"] for _ in range(REPEATS)]
    low, middle, high = map(float, np.percentile(later, (25, 50, 75)))
    return found | {"first_call_s": spent, "call_s": middle, "call_q1": low, "call_q3": high}


def run_of(problem: mechanisms.Problem, solver: str) -> Run:
    """Set up the run of a solver on a mechanism."""
    return Run(replace(case_of(problem), time_limit=LIMIT, timed=TIMED), CATALOGUE[solver], TOLERANCE)


def _compiled_anew(module: ModuleType) -> ModuleType:
    """Load a module again with its callbacks compiled anew, as a user's are."""
    kept = numba.config.CACHE_DIR  # type: ignore[attr-defined]
    with tempfile.TemporaryDirectory(prefix="twoloop-callbacks-") as numba.config.CACHE_DIR:  # type: ignore[attr-defined]
        module = importlib.reload(module)
    numba.config.CACHE_DIR = kept  # type: ignore[attr-defined]
    return module


def findings_of(rows: pd.DataFrame) -> list[dict[str, Any]]:
    """Find the first call of each solver, s: median and range over mechanisms."""
    if "first_call_s" not in rows:
        return []
    told = rows[rows["first_call_s"].notna()].groupby("solver", sort=False)["first_call_s"]
    lines = told.agg(["size", "median", "min", "max"]).reset_index()
    return [dict(zip(("solver", "n", "median", "least", "most"), line, strict=True)) for line in lines.values.tolist()]


if __name__ == "__main__":
    print(json.dumps(times_of(*sys.argv[1:])))
