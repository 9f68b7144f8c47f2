"""Which solvers report when they are wrong: every solver on every trap, right, with a report, silent, or hung."""

import time
import warnings
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Any
from unittest.mock import patch

import numpy as np
import pandas as pd

from studies.bench.apart import apart, heard
from studies.bench.cli import StudyError
from studies.bench.store import Array, Output, Row, read_rows
from studies.bench.study import Study
from studies.honesty import findings
from studies.honesty import solvers as catalogue
from studies.honesty.traps import FORCE, GROUPS, LINKAGE, SEED, SHORT, Trap, traps
from twoloop import ConstrainedSystem, solve_dae
from twoloop.__main__ import compile_all
from twoloop.kernels.compile import callbacks

GRACE = 6.0  # s beyond the time limit of a run after which it hangs
TRUTHS = (1e-12, 1e-10, 1e-9)  # tolerances of the two runs that give the right answer: the first that succeed
TRUTH_LIMIT = 10.0  # s that one of them may take
AGREE = 1e-7  # how far the two may differ
UNCONTROLLED = "no error was estimated"  # in the message of a successful run with steps of a given size
REFUSALS = (  # in messages of an adapter, or of twoloop, that does not take the equations or the setting: no run
    *("NotSymbolic", "compiled=True needs equations", "needs callbacks whose operations it can see"),
    *("must be positive definite", "cannot keep a constant one", "LinAlgError"),
)
# are built for each system, which takes longer than a run
BUILT = (catalogue.HEYOKA, catalogue.CVODE_C, catalogue.PROJECTED, catalogue.CYRK, catalogue.CYRK_RADAU)


def right_answer(trap: Trap) -> Array | None:
    """Compute the positions at the end by two unlike methods, from one break of the forces to the next, if there are.

    Raises StudyError if the two agree at no tolerance.
    """
    if trap.positions is not None:
        return trap.positions(trap.t_end)
    if trap.sane is None:
        return None
    differ = np.inf
    for tolerance in TRUTHS:
        first = _end(trap.sane, trap, "RadauIIA5", tolerance)
        second = None if first is None else _end(trap.sane, trap, "Gauss12", tolerance)
        if first is not None and second is not None:
            differ = float(np.abs(first - second).max())
            if differ <= AGREE:
                return second
    raise StudyError(f"no right answer for {trap.name} on {trap.mechanism}: two methods differ by {differ:.1e}")


def _end(system: ConstrainedSystem, trap: Trap, method: str, tolerance: float) -> Array | None:
    """Integrate in pieces between the breaks to the positions at the end; None where a piece fails."""
    q, v = trap.q0, trap.v0
    options: dict[str, Any] = {"method": method, "rtol": tolerance, "atol": tolerance, "time_limit": TRUTH_LIMIT}
    for begin, end in pairwise((0.0, *trap.breaks, trap.t_end)):
        result = solve_dae(system, (begin, end), q, v, **options)
        if not result.success:
            return None
        q, v = result.q[:, -1], result.v[:, -1]
    return q


def cell(call: catalogue.Call, trap: Trap, truth: Array | None) -> Row:
    """Make a run and describe what came of it."""
    result, made = heard(partial(call, trap))
    made |= {"error": None, "evaluated": True}
    if result is not None and result.success and truth is not None:
        made["error"] = float(np.nanmax(np.abs(result.q[:, -1] - truth)))
    if result is not None and result.success and trap.unnoticed is not None:
        without, _ = heard(partial(call, replace(trap, system=trap.unnoticed)))
        made["evaluated"] = without is None or not np.array_equal(result.q, without.q)
    return made


def outcome(row: Row, trap: Trap, has_answer: bool) -> str:
    """Judge a run that came back."""
    if row["status"] == "RAISED" and any(words in row["message"] for words in REFUSALS):
        return findings.NOT_RUN
    if row["status"] != "REACHED_END":
        return findings.HANG if row["status"] == findings.HANG else findings.SAID
    limit = findings.LOOSENESS * max(trap.tolerance, findings.LEAST) * trap.sensitivity
    if has_answer and row["error"] is not None and row["error"] <= limit:
        return findings.RIGHT
    return findings.SAID if row["warned"] or UNCONTROLLED in row["message"] else findings.SILENT


def about(name: str, trap: Trap) -> dict[str, str]:
    """Say which cell it is."""
    return {"group": trap.group, "trap": trap.name, "mechanism": trap.mechanism, "solver": name}


def run(name: str, call: catalogue.Call, trap: Trap, truth: Array | None) -> Row:
    """Make one cell in a process of its own, which is ended when it does not come back."""
    row: Row = {**about(name, trap), "tol": trap.tolerance, "n_drawn": trap.n_drawn}
    row["seed"] = SEED if trap.group in (FORCE, SHORT, LINKAGE) else None
    limited = name.endswith(catalogue.LIMITED)
    row["max_step"] = None if name.endswith(catalogue.OWN_SUFFIX) else catalogue.largest_step(limited, trap)
    began, no_answer = time.monotonic(), {"message": "", "error": None, "warned": ""}
    try:
        row |= apart(partial(cell, call, trap, truth), trap.time_limit + GRACE)
    except TimeoutError:
        row |= {"status": findings.HANG, **no_answer}
    except EOFError:
        row |= {"status": "CRASHED", **no_answer, "message": "the process ended without an answer"}
    row["seconds"] = time.monotonic() - began
    return row | {"outcome": outcome(row, trap, truth is not None)}


def make(output: Output) -> pd.DataFrame:
    """Make all cells. The adapters' own checks of a start are off: the solvers are to answer alone."""
    only, quick = output.call.only, output.call.quick
    groups = only if only and set(only) <= set(GROUPS) else None
    rows: list[Row] = []
    compiled: set[tuple[Any, ...]] = set()
    compile_all()  # what a child of a slow machine compiles may exceed its time limit, and is lost with it

    def made(name: str, call: catalogue.Call, trap: Trap, truth: Array | None) -> Row:
        if why := catalogue.why_not(name, trap):
            return about(name, trap) | {"outcome": findings.NOT_RUN, "status": "", "message": why}
        warm_up(name, call, trap, compiled)
        return run(name, call, trap, truth)

    with output.kept() as kept, patch("references.driver.check_start"):
        for trap in traps(quick, groups):
            known = catalogue.solvers(quick, trap.group)
            known = {name: call for name, call in known.items() if output.call.wants(name, trap.group)}
            keys = {name: " | ".join(about(name, trap).values()) for name in known}
            truth = None if all(key in kept for key in keys.values()) else right_answer(trap)
            rows += [kept.made(keys[name], partial(made, name, call, trap, truth)) for name, call in known.items()]
    return pd.DataFrame(rows)


def warm_up(name: str, call: catalogue.Call, trap: Trap, compiled: set[tuple[Any, ...]]) -> None:
    """Compile in this process what the children call, on a harmless motion."""
    shared = name.removesuffix(catalogue.LIMITED)
    sane, tolerance = trap.sane or trap.system, 1e-4
    functions = (getattr(sane.functions, kind) for kind in callbacks.KINDS)
    made_for: tuple[Any, ...] = (shared, sane.n_q, sane.n_c, sane.called_in_python, *functions)
    if shared in BUILT:
        tolerance = trap.tolerance
        made_for += (trap.group, trap.name, trap.mechanism)
    if made_for in compiled:
        return
    compiled.add(made_for)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            call(replace(trap, system=sane, t_end=1e-6, tolerance=tolerance))
        except Exception:  # comes again in the run, where it is counted
            return


class WithValidation(Study):
    """Count the rows of `validation` in the same folder, too: all silent failures stand in one table."""

    def report(self, output: Output, rows: pd.DataFrame, line: str) -> None:
        """Write findings, figures and report, from the rows of both studies."""
        super().report(output, pd.concat([rows, validated(output)], ignore_index=True), line)


def validated(output: Output) -> pd.DataFrame:
    """Read the rows of `validation`, if there are, as rows of this study."""
    path = output.file("validation.csv")
    if not path.is_file():
        return pd.DataFrame()
    return findings.of_validation(read_rows(path, "group", "case", "solver", "family", "tol", "outcome", "error_q")[0])


STUDY = WithValidation("honesty", __doc__, make, findings.findings_of, findings.figures_of)
