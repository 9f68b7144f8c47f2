"""Which solvers report when they are wrong: every solver on every trap, right, with a report, silent, or hung."""

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
from studies.bench.apart import apart, heard
from studies.bench.cli import StudyError
from studies.bench.end_states import EXACT
from studies.bench.names import label
from studies.bench.render import power
from studies.bench.sharp_forces import T_END
from studies.bench.store import Array, Output, Row
from studies.bench.study import Study
from studies.honesty import short_forces
from studies.honesty.solvers import (
    CVODE_C,
    CYRK,
    CYRK_RADAU,
    DEFAULT,
    HEYOKA,
    KINDS,
    LIMITED,
    LOOK,
    OURS,
    PROJECTED,
    Call,
    kind_of,
    largest_step,
    solvers,
    why_not,
)
from studies.honesty.traps import AGREE as TRUE_TO
from studies.honesty.traps import FORCE, GROWN, HELD_OUT, HELD_OUT_SEED, INPUT, MISTAKE, SHORT, Trap, held_out, traps
from twoloop import ConstrainedSystem, solve_dae
from twoloop.__main__ import compile_all
from twoloop.kernels.compile import callbacks
from twoloop.kernels.data.tolerances import LONGEST_UNSEEN

LOOSENESS = 1e3  # an answer is right within so many times the tolerance ...
LEAST = 1e-10  # ... of which no more is asked than this
USUAL = 1e-8  # tolerance of the traps that are not about tolerances
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
BUILT = (HEYOKA, CVODE_C, PROJECTED, CYRK, CYRK_RADAU)  # made for each system, which takes longer than a run

PARTS = {  # of the bars of the figure, in counts of `totals`
    "gross": (f"silently wrong, off by over {power(EXACT)}", figures.RED),
    "slight": (f"silently wrong, off by {power(LOOSENESS * USUAL)} to {power(EXACT)}", figures.ORANGE),
    SAID: ("reported failure", figures.SKY),
}


def right_answer(trap: Trap) -> Array | None:
    """Positions at the end by two unlike methods, from one break of the forces to the next; None where there is none.

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
    result, made = heard(partial(call, trap))
    made |= {"error": None, "asked": True}
    if result is not None and result.success and truth is not None:
        made["error"] = float(np.nanmax(np.abs(result.q[:, -1] - truth)))
    if result is not None and result.success and trap.unnoticed is not None:
        without, _ = heard(partial(call, replace(trap, system=trap.unnoticed)))
        made["asked"] = without is None or not np.array_equal(result.q, without.q)
    return made


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
    row["seed"] = HELD_OUT_SEED if trap.group in (HELD_OUT, SHORT) else None
    row["max_step"] = None if name.endswith(OURS) else largest_step(name.endswith(LIMITED), trap)
    began, no_answer = time.monotonic(), {"message": "", "error": None, "warned": ""}
    try:
        row |= apart(partial(cell, call, trap, truth), trap.time_limit + GRACE)
    except TimeoutError:
        row |= {"status": HANG, **no_answer}
    except EOFError:
        row |= {"status": "CRASHED", **no_answer, "message": "the process ended without an answer"}
    row["seconds"] = time.monotonic() - began
    return row | {"outcome": outcome(row, trap, truth is not None)}


def make(output: Output, groups: Sequence[str] | None = None) -> pd.DataFrame:
    """Make all cells, or those of some groups of traps.

    The checks of a start in our adapters of foreign solvers are off: those are to answer alone.
    """
    rows: list[Row] = []
    compiled: set[tuple[Any, ...]] = set()
    compile_all()  # what a child of a slow machine compiles may exceed its time limit, and is lost with it

    def made(name: str, call: Call, trap: Trap, truth: Array | None) -> Row:
        if why := why_not(name, trap):
            return about(name, trap) | {"outcome": NOT_RUN, "status": "", "message": why}
        warm_up(name, call, trap, compiled)
        return run(name, call, trap, truth)

    with output.kept({"groups": groups}) as kept, unchecked():
        every = chain(*(each(output.call.quick) for each in (traps, held_out, short_forces.traps)))
        for trap in (trap for trap in every if groups is None or trap.group in groups):
            known = solvers(output.call.quick, trap.group)
            keys = {name: " | ".join(about(name, trap).values()) for name in known}
            truth = None if all(key in kept for key in keys.values()) else right_answer(trap)
            rows += [kept.made(keys[name], partial(made, name, call, trap, truth)) for name, call in known.items()]
    return pd.DataFrame(rows)


def warm_up(name: str, call: Call, trap: Trap, compiled: set[tuple[Any, ...]]) -> None:
    """Compile in this process what the children call, on a harmless motion."""
    shared = name.removesuffix(LIMITED)
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
    found = of_mistakes(rows) | {"forces": of_forces(forces) | {"trust": trust_in(forces)}, "trust": trust_in(both)}
    found["forces_only"] = [name for name in dict.fromkeys(forces["solver"]) if name not in set(rows["solver"])]
    found["input"] = of_mistakes(inputs) | {"trust": trust_in(inputs)}
    found["held_out"] = of_forces(held) | {"trust": trust_in(held), "bad": bad_in(held)}
    seeds = held["seed"].dropna().unique() if "seed" in held else []  # of older rows: used during development
    found["held_out"]["seed"] = int(seeds[0]) if len(seeds) else None
    found["held_out"]["ran"] = [kind for kind in KINDS[:-1] if found["held_out"]["trust"][kind]["n"]]
    short = all_rows[(all_rows["group"] == SHORT) & (all_rows["outcome"] != NOT_RUN)]
    found |= {"short": short_forces.findings_of(short, (SILENT, HANG)), "look": LOOK}
    # rows without the column are older, of the longest step that ours take
    found["max_step"] = float(held["max_step"].max()) if "max_step" in held else LONGEST_UNSEEN * T_END
    found |= {"exact": EXACT, "off": LOOSENESS * USUAL, "usual": USUAL}
    return found | {"forces_end": T_END, "forces_agree": TRUE_TO, "grown": GROWN}


def graded(ran: pd.DataFrame) -> dict[str, int]:
    """Runs that are wrong and silent or hang: all, off by over EXACT or without an end, and off by less."""
    wrong = ran["outcome"].isin((SILENT, HANG))
    slight = wrong & (ran["error"].astype(float) <= EXACT)
    return {"wrong": int(wrong.sum()), "gross": int((wrong & ~slight).sum()), "slight": int(slight.sum())}


def totals(rows: pd.DataFrame) -> list[dict[str, Any]]:
    """Outcomes of each solver on the traps that it was run on: ours, others without a largest step, and with."""
    ran = rows[rows["outcome"] != NOT_RUN]
    counts: list[dict[str, Any]] = [
        {"solver": str(name), **counts_of(own), **graded(own)} for name, own in ran.groupby("solver", sort=False)
    ]
    return sorted(counts, key=lambda line: (not line["solver"].endswith(OURS), line["solver"].endswith(LIMITED)))


def parts_of(rows: pd.DataFrame) -> dict[str, pd.Series]:
    """Which rows are of ours, of others without a largest step, and of these with one."""
    ours, limited = rows["solver"].str.endswith(OURS), rows["solver"].str.endswith(LIMITED)
    return {"ours": ours, "others": ~ours & ~limited, "limited": limited}


def of_forces(rows: pd.DataFrame) -> dict[str, Any]:
    """Outcomes under sharp forces: of every solver, and of ours and others under each force."""
    ran = rows[rows["outcome"] != NOT_RUN]
    found: dict[str, Any] = {"n": len(ran), "n_families": ran["trap"].nunique(), "families": of_traps(ran)}
    names = [str(name) for name in ran["trap"].unique()]
    found |= {f"n_{what}s": sum(what in name for name in names) for what in ("gust", "friction")}
    return found | {"solvers": totals(rows), "mechanisms": [str(name) for name in ran["mechanism"].unique()]}


def of_traps(ran: pd.DataFrame) -> list[dict[str, Any]]:
    """Of each trap, whose runs had which outcome, and which without a largest step were wrong and silent, or hung."""
    found = []
    for trap, own in ran.groupby("trap", sort=False):
        line = {whose: counts_of(own[which]) for whose, which in parts_of(own).items()}
        bad = own[own["outcome"].isin((SILENT, HANG)) & ~own["solver"].str.endswith(LIMITED)]
        found.append({"trap": str(trap), "silent": list(dict.fromkeys(bad["solver"])), **line})
    return found


def trust_in(rows: pd.DataFrame) -> dict[str, dict[str, int]]:
    """Runs and those wrong without a word, of each of KINDS, and of all others without a largest step.

    What an adapter refuses is no run.
    """
    kinds = rows["solver"].map(kind_of)
    parts = {kind: kinds == kind for kind in KINDS} | {"others": parts_of(rows)["others"]}
    found = {}
    for name, which in parts.items():
        own = rows[which]
        ran = own[own["outcome"] != NOT_RUN]
        line = {"n": len(ran), "solvers": int(ran["solver"].nunique())} | graded(ran)
        line["unasked"] = int(unasked(ran).sum())
        found[name] = line | {"refused": int((own["outcome"].eq(NOT_RUN) & own["status"].eq("RAISED")).sum())}
    return found


def bad_in(rows: pd.DataFrame) -> dict[str, list[dict[str, Any]]]:
    """Runs that are wrong and silent, or hang, of ours, of others without a largest step, and with one."""
    bad = rows[rows["outcome"].isin((SILENT, HANG))]
    columns = ["trap", "mechanism", "solver", "outcome", "error"]
    return {whose: bad[which][columns].to_dict("records") for whose, which in parts_of(bad).items()}


def of_mistakes(rows: pd.DataFrame) -> dict[str, Any]:
    """Outcomes on traps that lie in a model, a motion or a setting."""
    ran = rows[rows["outcome"] != NOT_RUN]
    found: dict[str, Any] = {"n_traps": rows["trap"].nunique(), "n_cells": len(ran), "traps": of_traps(ran)}
    alike = {str(trap): set(own["outcome"]) for trap, own in ran.groupby("trap", sort=False)}
    found["missed_by_all"] = [trap for trap, seen in alike.items() if seen <= {SILENT, HANG}]
    found["counts"] = {str(name): counts_of(own) for name, own in rows.groupby("solver", sort=False)}
    found |= {"looseness": LOOSENESS, "grace": GRACE, "agree": AGREE}
    return found | {f"{whose}_bad": lines for whose, lines in bad_in(rows).items()}


def figures_of(rows: pd.DataFrame, found: dict[str, Any]) -> dict[str, Figure]:
    """The bars of the forces held out."""
    return {"honesty": picture(found["held_out"]["solvers"])}


def picture(totals: Sequence[dict[str, Any]]) -> Figure:
    """Bars of the runs that did not end right, of ours, of others and of these with a largest step.

    Where all runs of several solvers are right, these share a line.
    """
    groups: dict[str, list[dict[str, Any]]] = {"ours": [], "rivals": [], "rivals, max_step": []}
    for line in totals:
        limited = line["solver"].endswith(LIMITED)
        groups["ours" if line["solver"].endswith(OURS) else "rivals, max_step" if limited else "rivals"].append(line)
    bars: list[tuple[str, list[float], list[int]]] = []
    ends: dict[str, int] = {}
    for whose, own in groups.items():
        bad = [line for line in own if line[RIGHT] < line["n"] or line["solver"] == DEFAULT]  # which has its own bar
        bad = own if len(own) - len(bad) == 1 else bad
        for line in bad:
            name = label(line["solver"].removesuffix(LIMITED), coded=False)
            counts = [line[part] for part in PARTS]
            bars.append((f"{name} ({line['n']})", [100.0 * count / line["n"] for count in counts], counts))
        if len(own) > len(bad):
            n = sum(line["n"] for line in own) - sum(line["n"] for line in bad)
            bars.append((f"{len(own) - len(bad)} solvers, all right ({n})", [0.0] * len(PARTS), [0] * len(PARTS)))
        ends[whose] = len(bars)
    figure, axes = plt.subplots(figsize=(7.6, 0.2 * len(bars) + 1.2), layout="constrained")
    places, left = np.arange(len(bars)), np.zeros(len(bars))
    for k, (words, color) in enumerate(PARTS.values()):
        shares = np.array([each[1][k] for each in bars])
        drawn = axes.barh(places, shares, left=left, color=color, label=words)
        numbers = [str(each[2][k]) if each[2][k] else "" for each in bars]
        axes.bar_label(drawn, numbers, label_type="center", fontsize=7)
        left += shares
    begin = 0
    for whose, end in ends.items():
        if end > begin:
            axes.text(1.01, 0.5 * (begin + end - 1), whose, transform=axes.get_yaxis_transform(), va="center")
            axes.axhline(end - 0.5, color="black", linewidth=0.8)
        begin = end
    axes.set_yticks(places, [each[0] for each in bars])
    axes.set(xlabel="share of runs (%); the rest is right", ylabel="solver (its runs)", ylim=(len(bars) - 0.5, -0.5))
    axes.set_xlim(left=0.0)
    axes.tick_params(axis="y", labelsize=8, length=0.0)
    axes.grid(False)
    axes.set_title("Sharp forces, parameters held out: runs that did not end right (numbers: runs)")
    figure.legend(loc="outside lower center", ncols=len(PARTS))
    return figure


STUDY = Study("honesty", __doc__, make, findings_of, figures_of)
