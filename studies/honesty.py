"""Which solver says so when it is wrong: every solver on every trap, right, said so, wrong and silent, or hung."""

import multiprocessing
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from itertools import pairwise
from multiprocessing.connection import Connection
from typing import Any
from unittest.mock import patch

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from references.cvode_c import solve_cvode_c
from references.ida import solve_ida
from references.ida_c import solve_ida_c
from references.index1 import solve_index1
from studies import study
from studies.cli import StudyError
from studies.render import render, table
from studies.sharp_forces import T_END
from studies.store import Output, Row
from studies.traps import AGREE as TRUE_TO
from studies.traps import FORCE, INPUT, MISTAKE, Trap, traps
from twoloop import ConstrainedSystem, Result, solve_dae

Array = NDArray[np.float64]

OWN = ("auto", "Taylor", "Adams", "DOP853", "Gauss12", "RadauIIA5", "BDF")
IDA_C, CVODE_C, HEYOKA = "IDA from C", "CVODE from C, Adams", "heyoka, Taylor"
COMPILED_ONLY = (IDA_C, CVODE_C, HEYOKA)
SCIPY = ("LSODA", "DOP853", "Radau", "BDF")
OF_FORCES = (  # further ones of ours under sharp forces: all presets but the paper's, which follow it to the letter
    *("auto, compiled", "Taylor, compiled", "Gauss4", "Gauss6", "Gauss8", "Gauss10", "Gauss14", "Gauss16", "SunRadau5"),
    *("RadauIIA9", "RadauIIA13", "TRBDF2", "ESDIRK4", "Newmark"),
)
DEFAULT, DEFAULT_COMPILED = "auto (two-loop)", "auto, compiled (two-loop)"
QUICK_OWN, QUICK_SCIPY = ("auto", "DOP853", "BDF"), ("DOP853",)
LOOSENESS = 1e3  # an answer is right within so many times the tolerance ...
LEAST = 1e-10  # ... of which no more is asked than this
GRACE = 6.0  # s beyond the time limit of a run after which it hangs
TRUTHS = (1e-12, 1e-10, 1e-9)  # tolerances of the two runs that make the right answer: the first that succeed
TRUTH_LIMIT = 10.0  # s that one of them may take
AGREE = 1e-7  # how far the two may differ
RIGHT, SAID, SILENT, HANG, NOT_RUN = "right", "said so", "WRONG AND SILENT", "HANG", "not run"
UNASKED = "wrong, never asked"
REFUSED = "^NotSymbolic|needs equations that can be written down"
SHORT = {HANG: "**hang**", SILENT: "**silent**", UNASKED: "**unasked**", SAID: "said", RIGHT: "right", NOT_RUN: "–"}
ORDER = (HANG, SILENT, UNASKED, SAID, RIGHT, NOT_RUN)  # in which those of the mechanisms of a trap are shown
UNCONTROLLED = "no error was estimated"  # what the message of a successful run says of steps without error control

Call = Callable[[Trap], Result]


def own(method: str, trap: Trap) -> Result:
    """One of ours, as a user calls it."""
    name, _, code = method.partition(", ")
    options: dict[str, Any] = {"rtol": trap.tolerance, "atol": trap.tolerance, "time_limit": trap.time_limit}
    options |= ({"compiled": True} if code else {}) | dict(trap.steps)
    return solve_dae(trap.system, (0.0, trap.t_end), trap.q0, trap.v0, method=name, **options)


def scipy(method: str, trap: Trap) -> Result:
    """One of SciPy's solvers on index 1."""
    return solve_index1(*_start(trap), method, trap.tolerance, trap.tolerance, time_limit=trap.time_limit)


def ida(trap: Trap) -> Result:
    """IDA through scikit-sundae."""
    return solve_ida(*_start(trap), "stabilised", trap.tolerance, trap.tolerance, time_limit=trap.time_limit)


def ida_c(trap: Trap) -> Result:
    """IDA's library with compiled functions."""
    return solve_ida_c(*_start(trap), trap.tolerance, trap.tolerance, time_limit=trap.time_limit)


def cvode_c(trap: Trap) -> Result:
    """CVODE's library with code made of the mechanism."""
    return solve_cvode_c(*_start(trap), "Adams", trap.tolerance, trap.tolerance, time_limit=trap.time_limit)


def heyoka(trap: Trap) -> Result:
    """heyoka's Taylor series, compiled for the mechanism."""
    from references.heyoka_taylor import solve_heyoka

    return solve_heyoka(*_start(trap), trap.tolerance, time_limit=trap.time_limit)


def _start(trap: Trap) -> tuple[Any, Any, Any, Any]:
    return trap.system, (0.0, trap.t_end), trap.q0, trap.v0


def solvers(quick: bool, group: str = MISTAKE) -> dict[str, Call]:
    """Name to call, of those that are asked a group of traps; "two-loop" ones first."""
    ours = (*OWN, *(OF_FORCES if group == FORCE else ()))
    made: dict[str, Call] = {f"{name} (two-loop)": partial(own, name) for name in (QUICK_OWN if quick else ours)}
    made |= {} if quick else {"IDA, stabilised": ida, IDA_C: ida_c}
    made |= {} if quick else {CVODE_C: cvode_c, HEYOKA: heyoka}
    return made | {f"{name}, index 1": partial(scipy, name) for name in (QUICK_SCIPY if quick else SCIPY)}


def right_answer(trap: Trap) -> Array | None:
    """Positions at the end by two unlike methods, from one break of the forces to the next; None where there is none.

    Raises
    ------
    StudyError
        If the two agree at no tolerance.
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
    """Positions at the end, in pieces between the breaks; None where a piece fails."""
    q, v = trap.q0, trap.v0
    for begin, end in pairwise((0.0, *trap.breaks, trap.t_end)):
        result = solve_dae(
            system, (begin, end), q, v, method=method, rtol=tolerance, atol=tolerance, time_limit=TRUTH_LIMIT
        )
        if not result.success:
            return None
        q, v = result.q[:, -1], result.v[:, -1]
    return q


def cell(call: Call, trap: Trap, truth: Array | None, pipe: Connection) -> None:
    """Make a run in a process of its own and send what came of it."""
    made: Row = {"status": "", "message": "", "error": None, "warned": "", "asked": True}
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            result = call(trap)
            made |= {"status": result.status.name, "message": result.message}
            if result.success and truth is not None:
                made["error"] = float(np.nanmax(np.abs(result.q[:, -1] - truth)))
            if result.success and trap.unnoticed is not None:
                without = call(replace(trap, system=trap.unnoticed))
                made["asked"] = not np.array_equal(result.q, without.q)
        except Exception as error:
            made |= {"status": "RAISED", "message": f"{type(error).__name__}: {error}"}
    made["warned"] = " / ".join(str(each.message) for each in said)
    pipe.send(made)


def outcome(row: Row, trap: Trap, has_answer: bool) -> str:
    """The rule: what a run that came back is."""
    if row["status"] != "REACHED_END":
        return SAID
    limit = LOOSENESS * max(trap.tolerance, LEAST)
    if has_answer and row["error"] is not None and row["error"] <= limit:
        return RIGHT
    if row["warned"] or UNCONTROLLED in row["message"]:
        return SAID
    return SILENT if row["asked"] else UNASKED


def about(name: str, trap: Trap) -> Row:
    """Which cell it is."""
    return {"group": trap.group, "trap": trap.name, "mechanism": trap.mechanism, "solver": name}


def run(name: str, call: Call, trap: Trap, truth: Array | None) -> Row:
    """One cell, in a process of its own that is ended when it does not come back."""
    row = about(name, trap) | {"tol": trap.tolerance}
    context = multiprocessing.get_context("fork")
    here, there = context.Pipe(duplex=False)
    process = context.Process(target=cell, args=(call, trap, truth, there), daemon=True)
    process.start()
    there.close()
    began = time.monotonic()
    try:
        came = here.poll(trap.time_limit + GRACE)
        row |= here.recv() if came else {"status": "HANG", "message": "", "error": None, "warned": ""}
    except EOFError:
        row |= {"status": "CRASHED", "message": "the process ended without an answer", "error": None, "warned": ""}
        came = True
    process.kill()
    process.join()
    row["seconds"] = time.monotonic() - began
    return row | {"outcome": outcome(row, trap, truth is not None) if came else HANG}


def make(output: Output) -> pd.DataFrame:
    """Make all cells. The checks of a start in our adapters of foreign solvers are off: those are to answer alone."""
    rows = []
    with output.kept() as kept, unchecked():
        compiled: set[tuple[Any, ...]] = set()
        for trap in traps(output.call.quick):
            known = solvers(output.call.quick, trap.group)
            if all(f"{trap.name} | {trap.mechanism} | {name}" in kept for name in known):
                truth = None
            else:
                truth = right_answer(trap)
            for name, call in known.items():
                key = f"{trap.name} | {trap.mechanism} | {name}"
                if key not in kept:
                    if why := why_not(name, trap):
                        kept.add(key, about(name, trap) | {"outcome": NOT_RUN, "status": "", "message": why})
                    else:
                        warm_up(name, call, trap, compiled)
                        kept.add(key, run(name, call, trap, truth))
                rows.append(kept[key])
    return pd.DataFrame(rows)


def why_not(name: str, trap: Trap) -> str:
    """Why a solver is not run on a trap; "" where it is."""
    if trap.steps and not name.endswith("(two-loop)"):
        return "its adapter takes no steps"
    if name == HEYOKA and find_spec("heyoka") is None:
        return "heyoka is not installed"
    return "it takes compiled functions only" if name in COMPILED_ONLY and trap.system.called_in_python else ""


def warm_up(name: str, call: Call, trap: Trap, compiled: set[tuple[Any, ...]]) -> None:
    """Compile in this process what the children call, on a harmless motion."""
    shared = call.func.__name__ if isinstance(call, partial) and not name.endswith("(two-loop)") else name
    size = (shared, trap.system.n_q, trap.system.n_c, trap.system.called_in_python)
    sane = trap.sane or trap.system
    if size in compiled:
        return
    compiled.add(size)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            call(replace(trap, system=sane, t_end=1e-6, tolerance=1e-4))
        except Exception:  # comes again in the run, where it is counted
            return


class unchecked:
    """Context: references/ without the check of a start, which is ours."""

    def __enter__(self) -> None:
        self.patches = [
            patch(f"references.{name}.check_start") for name in ("cvode_c", "heyoka_taylor", "ida", "ida_c", "index1")
        ]
        for each in self.patches:
            each.start()

    def __exit__(self, *_: object) -> None:
        for each in self.patches:
            each.stop()


def counts_of(rows: pd.DataFrame) -> dict[str, int]:
    """Runs, and how many of them had each outcome."""
    return {"n": len(rows)} | {what: int((rows["outcome"] == what).sum()) for what in ORDER}


def findings_of(all_rows: pd.DataFrame) -> dict[str, Any]:
    """What the report says: of mistakes and of forces, and of both together how far ours can be trusted."""
    # what cannot be written down as expressions is refused before a run, of theirs and of ours
    if "message" in all_rows:
        refused = all_rows["message"].astype(str).str.contains(REFUSED)
        all_rows = all_rows.assign(outcome=all_rows["outcome"].mask(refused, NOT_RUN))
    rows, forces, inputs = (all_rows[all_rows["group"] == group] for group in (MISTAKE, FORCE, INPUT))
    found = of_mistakes(rows) | {"forces": of_forces(forces), "trust": trust_in(pd.concat([rows, forces]))}
    found["input"] = of_mistakes(inputs) | {"trust": trust_in(inputs)}
    return found | {"silent": SILENT, "forces_end": T_END, "forces_agree": TRUE_TO}


def of_forces(rows: pd.DataFrame) -> dict[str, Any]:
    """Outcomes under sharp forces: of every solver, and of ours and others under each force."""
    ran = rows[rows["outcome"] != NOT_RUN]
    ours = ran["solver"].str.endswith("(two-loop)")
    solvers = [{"solver": str(name)} | counts_of(own) for name, own in ran.groupby("solver", sort=False)]
    found: dict[str, Any] = {"n": len(ran), "n_families": ran["trap"].nunique(), "solvers": solvers, "families": []}
    for family, own in ran.groupby("trap", sort=False):
        mine = own["solver"].str.endswith("(two-loop)")
        line = {"family": str(family), "ours": counts_of(own[mine]), "others": counts_of(own[~mine])}
        found["families"].append(line | {"by": sorted(set(own[mine & (own["outcome"] == SILENT)]["solver"]))})
    found["mechanisms"] = [str(name) for name in ran["mechanism"].unique()]
    return found | {"ours": counts_of(ran[ours]), "others": counts_of(ran[~ours])}


def trust_in(rows: pd.DataFrame) -> dict[str, Any]:
    """Runs on all traps, and those wrong without a word: of the default, compiled, of our others, of others.

    A run that never evaluates a force is as wrong as any; how many of the wrong ones are such is told beside.
    """
    ran = rows[rows["outcome"] != NOT_RUN]
    wrong, unasked = ran["outcome"].isin((SILENT, HANG, UNASKED)), ran["outcome"] == UNASKED
    ours = ran["solver"].str.endswith("(two-loop)")
    default, compiled = ran["solver"] == DEFAULT, ran["solver"] == DEFAULT_COMPILED
    parts = {"default": default, "compiled": compiled, "ours": ours & ~default & ~compiled, "others": ~ours}
    return {
        name: {"n": int(which.sum()), "wrong": int((wrong & which).sum()), "unasked": int((unasked & which).sum())}
        for name, which in parts.items()
    }


def of_mistakes(rows: pd.DataFrame) -> dict[str, Any]:
    """Outcomes on traps that lie in a model, a motion or a setting."""
    names, trap_names = list(dict.fromkeys(rows["solver"])), list(dict.fromkeys(rows["trap"]))
    found: dict[str, Any] = {"n_traps": len(trap_names), "n_cells": int((rows["outcome"] != NOT_RUN).sum())}
    found["cells"] = []
    for trap in trap_names:
        line = {"trap": trap}
        for name in names:
            these = rows[(rows["trap"] == trap) & (rows["solver"] == name)]["outcome"].tolist()
            line[name] = [what for what in ORDER if what in these]
        found["cells"].append(line)
    for key, outcome in (("all_say_so", SAID), ("all_right", RIGHT)):
        alike = [[outcome], [NOT_RUN]]
        found[key] = [each["trap"] for each in found["cells"] if all(each[name] in alike for name in names)]
    found["one_says_so"] = []
    for each in found["cells"]:
        said = [name for name in names if each[name] == [SAID]]
        if len(said) == 1 and all(each[name] in ([RIGHT], [NOT_RUN]) for name in names if name not in said):
            found["one_says_so"].append({"trap": each["trap"], "solver": said[0]})
    found |= {"solvers": names, "looseness": LOOSENESS, "grace": GRACE, "agree": AGREE}
    ran = rows[rows["outcome"] != NOT_RUN]
    found["missed_by_all"] = [
        str(trap) for trap, own in ran.groupby("trap", sort=False) if own["outcome"].isin((SILENT, HANG)).all()
    ]
    found["counts"] = {
        name: {what: int((rows[rows["solver"] == name]["outcome"] == what).sum()) for what in ORDER} for name in names
    }
    found["unasked"] = int((rows["outcome"] == UNASKED).sum())
    bad = rows[rows["outcome"].isin((SILENT, HANG))]
    for which in (True, False):
        some = bad[bad["solver"].str.endswith("(two-loop)") == which]
        found["ours_bad" if which else "others_bad"] = [
            {key: row[key] for key in ("trap", "mechanism", "solver", "outcome", "error")} for _, row in some.iterrows()
        ]
    return found


def outcomes(found: dict[str, Any], without: set[str]) -> str:
    """A line for each trap, a column for each solver."""
    short = [name.replace(" (two-loop)", "") for name in found["solvers"]]
    lines = [
        [each["trap"], *("/".join(SHORT[what] for what in each[name]) for name in found["solvers"])]
        for each in found["cells"]
        if each["trap"] not in without
    ]
    return table(["trap", *short], lines)


def report(output: Output, rows: pd.DataFrame, line: str) -> None:
    """Write findings and report."""
    found = findings_of(rows)
    output.save_findings(found)
    alike = {*found["all_say_so"], *found["all_right"], *(each["trap"] for each in found["one_says_so"])}
    ready = {"cells": outcomes(found, alike), "input": outcomes(found["input"], set())}
    of_force = (SILENT, SAID, RIGHT)
    ready["forces"] = table(
        ["force", *(f"{whose}: silent / said / right" for whose in ("ours", "others"))],
        [
            [each["family"], *("/".join(str(each[whose][what]) for what in of_force) for whose in ("ours", "others"))]
            for each in found["forces"]["families"]
        ],
    )
    of_solvers = [
        [each["solver"].replace(" (two-loop)", ""), *(each[what] for what in of_force)]
        for each in found["forces"]["solvers"]
    ]
    flawless = [line[0] for line in of_solvers if line[1] == line[2] == 0 and line[3]]
    lines = [line for line in of_solvers if any(line[1:]) and line[0] not in flawless]
    ready["solvers"] = table(["solver", "silent", "said", "right"], [*lines, [", ".join(flawless), 0, 0, "all"]])
    output.write("honesty.md", render("honesty", found, ready, stamp=line, quick=output.call.quick))


def main(words: Sequence[str] | None = None) -> None:
    """Run the study and write its report."""
    study.run_rows("honesty", __doc__, words, make, report)


if __name__ == "__main__":
    main()
