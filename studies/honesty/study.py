"""Which solver says so when it is wrong: every solver on every trap, right, said so, wrong and silent, or hung."""

import time
import warnings
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import chain, pairwise
from typing import Any
from unittest.mock import patch

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from studies.bench import figures
from studies.bench.apart import apart
from studies.bench.cli import StudyError
from studies.bench.end_states import EXACT
from studies.bench.sharp_forces import T_END
from studies.bench.store import Array, Output, Row
from studies.bench.study import Study
from studies.honesty.solvers import CVODE_C, DEFAULT, DEFAULT_COMPILED, HEYOKA, LIMITED, OURS, Call, solvers, why_not
from studies.honesty.traps import AGREE as TRUE_TO
from studies.honesty.traps import FORCE, GROWN, HELD_OUT, HELD_OUT_SEED, INPUT, MISTAKE, Trap, held_out, traps
from twoloop import ConstrainedSystem, solve_dae
from twoloop.kernels.compile.callbacks import KINDS

LOOSENESS = 1e3  # an answer is right within so many times the tolerance ...
LEAST = 1e-10  # ... of which no more is asked than this
GRACE = 6.0  # s beyond the time limit of a run after which it hangs
TRUTHS = (1e-12, 1e-10, 1e-9)  # tolerances of the two runs that make the right answer: the first that succeed
TRUTH_LIMIT = 10.0  # s that one of them may take
AGREE = 1e-7  # how far the two may differ
RIGHT, SAID, SILENT, HANG, NOT_RUN = "right", "said so", "WRONG AND SILENT", "HANG", "not run"
OUTCOMES = (HANG, SILENT, SAID, RIGHT, NOT_RUN)
UNCONTROLLED = "no error was estimated"  # what the message of a successful run says of steps without error control
REFUSALS = (  # of an adapter or of ours to put the equations, or the setting, to a solver: no run
    *("NotSymbolic", "compiled=True needs equations", "needs callbacks whose operations it can see"),
    *("must be positive definite", "cannot keep a constant one", "LinAlgError"),
)
BUILT = (HEYOKA, CVODE_C)  # solvers that are built for each system, which takes longer than they run

PARTS = {  # of the bars of the figure
    "right": ((RIGHT,), figures.BLUE),
    "said so": ((SAID,), figures.SKY),
    "wrong and silent, or hanging": ((SILENT, HANG), figures.RED),
}


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


def cell(call: Call, trap: Trap, truth: Array | None) -> Row:
    """Make a run: what came of it."""
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
    return made | {"warned": " / ".join(str(each.message) for each in said)}


def outcome(row: Row, trap: Trap, has_answer: bool) -> str:
    """The rule: what a run that came back is."""
    if row["status"] == "RAISED" and any(words in row["message"] for words in REFUSALS):
        return NOT_RUN
    if row["status"] != "REACHED_END":
        return HANG if row["status"] == HANG else SAID
    limit = LOOSENESS * max(trap.tolerance, LEAST)
    if has_answer and row["error"] is not None and row["error"] <= limit:
        return RIGHT
    if row["warned"] or UNCONTROLLED in row["message"]:
        return SAID
    return SILENT


def about(name: str, trap: Trap) -> dict[str, str]:
    """Which cell it is."""
    return {"group": trap.group, "trap": trap.name, "mechanism": trap.mechanism, "solver": name}


def run(name: str, call: Call, trap: Trap, truth: Array | None) -> Row:
    """One cell, in a process of its own that is ended when it does not come back."""
    row: Row = {**about(name, trap), "tol": trap.tolerance, "n_drawn": trap.n_drawn}
    began, no_answer = time.monotonic(), {"message": "", "error": None, "warned": ""}
    try:
        row |= apart(partial(cell, call, trap, truth), trap.time_limit + GRACE)
    except TimeoutError:
        row |= {"status": HANG, **no_answer}
    except EOFError:
        row |= {"status": "CRASHED", **no_answer, "message": "the process ended without an answer"}
    row["seconds"] = time.monotonic() - began
    return row | {"outcome": outcome(row, trap, truth is not None)}


def make(output: Output) -> pd.DataFrame:
    """Make all cells. The checks of a start in our adapters of foreign solvers are off: those are to answer alone."""
    rows: list[Row] = []
    compiled: set[tuple[Any, ...]] = set()

    def made(name: str, call: Call, trap: Trap, truth: Array | None) -> Row:
        if why := why_not(name, trap):
            return about(name, trap) | {"outcome": NOT_RUN, "status": "", "message": why}
        warm_up(name, call, trap, compiled)
        return run(name, call, trap, truth)

    with output.kept() as kept, unchecked():
        for trap in chain(traps(output.call.quick), held_out(output.call.quick)):
            known = solvers(output.call.quick, trap.group)
            keys = {name: " | ".join(about(name, trap).values()) for name in known}
            truth = None if all(key in kept for key in keys.values()) else right_answer(trap)
            rows += [kept.made(keys[name], partial(made, name, call, trap, truth)) for name, call in known.items()]
    return pd.DataFrame(rows)


def warm_up(name: str, call: Call, trap: Trap, compiled: set[tuple[Any, ...]]) -> None:
    """Compile in this process what the children call, on a harmless motion."""
    shared = name.removesuffix(LIMITED)
    sane, tolerance = trap.sane or trap.system, 1e-4
    callbacks = (getattr(sane.functions, kind) for kind in KINDS)
    made_for: tuple[Any, ...] = (shared, sane.n_q, sane.n_c, sane.called_in_python, *callbacks)
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


def unchecked() -> Any:
    """Context: references/ without the check of a start, which is ours."""
    return patch("references.driver.check_start")


def unasked(rows: pd.DataFrame) -> pd.Series:
    """Which of the runs that are wrong and silent never evaluated the force in question."""
    return (rows["outcome"] == SILENT) & rows["asked"].eq(False)


def counts_of(rows: pd.DataFrame) -> dict[str, int]:
    """Runs, and how many of them had each outcome."""
    return {"n": len(rows)} | {what: int((rows["outcome"] == what).sum()) for what in OUTCOMES}


def findings_of(all_rows: pd.DataFrame) -> dict[str, Any]:
    """What the report says: of mistakes and forces, how far ours can be trusted on both, and what was held out."""
    rows, forces, inputs, held = (all_rows[all_rows["group"] == group] for group in (MISTAKE, FORCE, INPUT, HELD_OUT))
    both = pd.concat([rows, forces])
    found = of_mistakes(rows) | {"forces": of_forces(forces), "trust": trust_in(both)}
    found["forces_only"] = [name for name in dict.fromkeys(forces["solver"]) if name not in set(rows["solver"])]
    found["input"] = of_mistakes(inputs) | {"trust": trust_in(inputs)}
    found["held_out"] = of_forces(held) | {"trust": trust_in(held), "bad": bad_in(held), "seed": HELD_OUT_SEED}
    theirs = [line for line in found["held_out"]["solvers"] if not line["solver"].endswith((OURS, LIMITED))]
    gross = held[held["outcome"].isin((SILENT, HANG)) & ~(held["error"].astype(float) <= EXACT)][
        "solver"
    ].value_counts()
    counted = [
        {"solver": name, "n": line["n"], "wrong": line[SILENT] + line[HANG], "gross": int(gross.get(name, 0))}
        for line in theirs
        for name in [line["solver"]]
    ]
    found["held_out"]["by_solver"] = sorted(counted, key=lambda line: -line["wrong"])
    return found | {"exact": EXACT, "forces_end": T_END, "forces_agree": TRUE_TO, "grown": GROWN}


def totals(rows: pd.DataFrame) -> list[dict[str, Any]]:
    """Outcomes of each solver on the traps that it was run on: ours, others as they come, and limited."""
    ran = rows[rows["outcome"] != NOT_RUN]
    counts = [{"solver": str(name)} | counts_of(own) for name, own in ran.groupby("solver", sort=False)]
    return sorted(counts, key=lambda line: (not line["solver"].endswith(OURS), line["solver"].endswith(LIMITED)))


def parts_of(rows: pd.DataFrame) -> dict[str, pd.Series]:
    """Which rows are of ours, of others as they come, and of these with a largest step."""
    ours, limited = rows["solver"].str.endswith(OURS), rows["solver"].str.endswith(LIMITED)
    return {"ours": ours, "others": ~ours & ~limited, "limited": limited}


def of_forces(rows: pd.DataFrame) -> dict[str, Any]:
    """Outcomes under sharp forces: of every solver, and of ours and others under each force."""
    ran = rows[rows["outcome"] != NOT_RUN]
    found: dict[str, Any] = {"n": len(ran), "n_families": ran["trap"].nunique(), "families": of_traps(ran)}
    return found | {"solvers": totals(rows), "mechanisms": [str(name) for name in ran["mechanism"].unique()]}


def of_traps(ran: pd.DataFrame) -> list[dict[str, Any]]:
    """Of each trap, whose runs had which outcome, and which solvers as they come were wrong and silent, or hung."""
    found = []
    for trap, own in ran.groupby("trap", sort=False):
        line = {whose: counts_of(own[which]) for whose, which in parts_of(own).items()}
        bad = own[own["outcome"].isin((SILENT, HANG)) & ~own["solver"].str.endswith(LIMITED)]
        found.append({"trap": str(trap), "silent": list(dict.fromkeys(bad["solver"])), **line})
    return found


def trust_in(rows: pd.DataFrame) -> dict[str, dict[str, int]]:
    """Runs, of what, and those wrong without a word: of the default, compiled, of our others, of others, limited.

    What an adapter refuses is no run.
    """
    parts = parts_of(rows)
    parts = {"default": rows["solver"] == DEFAULT, "compiled": rows["solver"] == DEFAULT_COMPILED} | parts
    parts["ours"] &= ~parts["default"] & ~parts["compiled"]
    found = {}
    for name, which in parts.items():
        own = rows[which]
        ran = own[own["outcome"] != NOT_RUN]
        wrong = ran["outcome"].isin((SILENT, HANG))
        line = {"n": len(ran), "wrong": int(wrong.sum()), "unasked": int(unasked(ran).sum())}
        line["gross"] = int((wrong & ~(ran["error"].astype(float) <= EXACT)).sum())
        found[name] = line | {"refused": int((own["outcome"].eq(NOT_RUN) & own["status"].eq("RAISED")).sum())}
    return found


def bad_in(rows: pd.DataFrame) -> dict[str, list[dict[str, Any]]]:
    """Runs that are wrong and silent, or hang, of ours, of others as they come, and limited."""
    bad = rows[rows["outcome"].isin((SILENT, HANG))]
    columns = ["trap", "mechanism", "solver", "outcome", "error"]
    return {whose: bad[which][columns].to_dict("records") for whose, which in parts_of(bad).items()}


def of_mistakes(rows: pd.DataFrame) -> dict[str, Any]:
    """Outcomes on traps that lie in a model, a motion or a setting."""
    ran = rows[rows["outcome"] != NOT_RUN]
    found: dict[str, Any] = {"n_traps": rows["trap"].nunique(), "n_cells": len(ran), "traps": of_traps(ran)}
    alike = {str(trap): set(own["outcome"]) for trap, own in ran.groupby("trap", sort=False)}
    for key, outcome in (("all_say_so", SAID), ("all_right", RIGHT)):
        found[key] = [trap for trap, outcomes in alike.items() if outcomes == {outcome}]
    found["missed_by_all"] = [trap for trap, outcomes in alike.items() if outcomes <= {SILENT, HANG}]
    found["counts"] = {str(name): counts_of(own) for name, own in rows.groupby("solver", sort=False)}
    found |= {"looseness": LOOSENESS, "grace": GRACE, "agree": AGREE}
    return found | {f"{whose}_bad": lines for whose, lines in bad_in(rows).items()}


def figures_of(rows: pd.DataFrame, found: dict[str, Any]) -> dict[str, Figure]:
    """The bars of the forces held out."""
    return {"honesty": picture(found["held_out"]["solvers"])}


def picture(totals: Sequence[dict[str, Any]]) -> Figure:
    """A bar for each solver, ours first, then others: the share of its runs with the outcomes of each part."""
    names = [f"{line['solver'].replace(OURS, '')} ({line['n']})" for line in totals]
    figure, axes = plt.subplots(figsize=(7.6, 0.17 * len(totals) + 0.9), layout="constrained")
    left = np.zeros(len(totals))
    for what, (outcomes, color) in PARTS.items():
        counts = [sum(line[each] for each in outcomes) for line in totals]
        shares = np.array([100.0 * count / line["n"] for count, line in zip(counts, totals, strict=True)])
        bars = axes.barh(names, shares, left=left, color=color, label=what)
        if SILENT in outcomes:
            axes.bar_label(bars, [str(count) if count else "" for count in counts], label_type="center", fontsize=7)
        left += shares
    n_own = sum(line["solver"].endswith(OURS) for line in totals)
    axes.axhline(n_own - 0.5, color="black", linewidth=0.8)
    for text, place in (("ours", 0.5 * n_own), ("others", 0.5 * (n_own + len(totals)))):
        axes.text(101.0, place - 0.5, text, rotation=90.0, va="center")
    axes.set(xlabel="share of runs (%)", xlim=(0.0, 100.0), ylim=(len(totals) - 0.4, -0.6), ylabel="solver (its runs)")
    axes.tick_params(axis="y", labelsize=8, length=0.0)
    axes.grid(False)
    figures.legend(figure, [axes], "numbers: runs")
    return figure


STUDY = Study("honesty", __doc__, make, findings_of, figures_of)
main = STUDY.main
