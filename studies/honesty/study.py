"""Which solvers report when they are wrong: every solver on every trap, right, with a report, silent, or hung."""

import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Any
from unittest.mock import patch

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from studies.bench import figures
from studies.bench.apart import apart, heard
from studies.bench.cli import StudyError
from studies.bench.end_states import EXACT, JUDGED
from studies.bench.render import number, power
from studies.bench.sharp_forces import T_END
from studies.bench.solvers import GIVEN
from studies.bench.store import Array, Output, Row, read_rows
from studies.bench.study import Study
from studies.honesty import solvers as catalogue
from studies.honesty import traps
from studies.honesty.solvers import DEFAULT, KINDS, LIMITED, LOOK, OWN_SUFFIX, kind_of
from studies.honesty.traps import Trap
from twoloop import ConstrainedSystem, solve_dae
from twoloop.__main__ import compile_all
from twoloop.kernels.compile import callbacks

RIGHT, SAID, SILENT, HANG, NOT_RUN = "right", "reported failure", "silently wrong", "hangs", "not run"
BAD = (SILENT, HANG)
LOOSENESS = 1e3  # an answer is right within so many times the tolerance ...
LEAST = 1e-10  # ... of which no less counts: rounding decides there
USUAL = 1e-8  # tolerance of all traps that are not about tolerances
GROUPS = (traps.FORCE, traps.SHORT, traps.MISTAKE, traps.SINGULAR)
PUBLISHED, AUTHORS = "published", "authors"  # groups of the rows of validation
BRIEF = LOOK * T_END  # s: forces that change with time are evaluated at least so often
PLAIN = f"auto, not compiled{OWN_SUFFIX}"
DRAWN = {"gross": figures.RED, "slight": figures.ORANGE}  # parts of the bars


def _brief(shape: str, below: bool) -> Callable[[pd.DataFrame], pd.Series]:
    names = [traps.name_of(shape, width) for width in traps.WIDTHS if (width < BRIEF) is below]
    return lambda rows: (rows["group"] == traps.SHORT) & rows["trap"].isin(names)


def _of(group: str) -> Callable[[pd.DataFrame], pd.Series]:
    return lambda rows: rows["group"] == group


TABLE: dict[str, tuple[str, Callable[[pd.DataFrame], pd.Series]]] = {  # kinds of traps: words, and which rows they are
    "sharp": ("sharp forces", _of(traps.FORCE)),
    "gust_long": ("gusts of 3 and 10 ms", _brief("gust", False)),
    "gust_short": ("gusts of 0.1 to 1 ms", _brief("gust", True)),
    "pulse_long": ("pulses of 3 and 10 ms", _brief("pulse", False)),
    "pulse_short": ("pulses of 0.1 to 1 ms", _brief("pulse", True)),
    "singular": ("singular positions", _of(traps.SINGULAR)),
    "linkages": ("random four-bar linkages", _of(traps.LINKAGE)),
    "mistakes": ("mistakes and hard motions", _of(traps.MISTAKE)),
    "input": ("inconsistent start, wrong derivative", _of(traps.INPUT)),
    "published": ("published mechanisms", _of(PUBLISHED)),
    "authors": ("benchmark authors' own conditions", _of(AUTHORS)),
}


def of_validation(rows: pd.DataFrame) -> pd.DataFrame:
    """Judge the rows of `validation` by the rule of this study, and those on the authors' conditions by these."""
    rows = rows[rows["group"].isna() | (rows["group"] == JUDGED)]
    own = rows["family"] == "two-loop"
    names = rows["solver"].astype(str).str.removesuffix(OWN_SUFFIX) + np.where(own, OWN_SUFFIX, "")
    by_authors = rows["group"] == JUDGED
    allowed = LOOSENESS * rows[["tol", "floor"]].max(axis=1).clip(lower=LEAST)
    wrong = (rows["outcome"] == "wrong").where(by_authors, rows["error_q"].astype(float) > allowed)
    ended = rows["outcome"].isin(("right", "inexact", "wrong"))
    outcome = pd.Series(np.where(wrong, np.where(rows["warnings"] > 0, SAID, SILENT), RIGHT), rows.index)
    made = {"group": np.where(by_authors, AUTHORS, PUBLISHED), "trap": rows["case"], "mechanism": rows["case"]}
    made |= {"solver": names, "tol": rows["tol"], "status": rows["status"], "evaluated": True}
    # by the authors' conditions there is no slight error
    made["error"] = rows["error_q"].astype(float).where(~(by_authors & wrong), np.inf)
    failed = rows["outcome"].where(rows["outcome"] == NOT_RUN, SAID)
    return pd.DataFrame(made | {"outcome": outcome.where(ended, failed)})


def graded(ran: pd.DataFrame) -> dict[str, int]:
    """Count runs, those that end, those silently wrong, and of these those off by over EXACT, or by less."""
    bad = ran["outcome"].isin(BAD)
    slight = bad & (ran["error"].astype(float) <= EXACT)
    failed = int((ran["outcome"] == SAID).sum())
    counts = {"n": len(ran), "ended": len(ran) - failed, "failed": failed, "wrong": int(bad.sum())}
    return counts | {"gross": int((bad & ~slight).sum()), "slight": int(slight.sum())}


def parts_of(rows: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """Split rows into those of the default, of twoloop's other methods, and of other solvers without `max_step`."""
    own, default = rows["solver"].str.endswith(OWN_SUFFIX), rows["solver"] == DEFAULT
    others = ~own & ~rows["solver"].str.endswith(LIMITED)
    return {"default": rows[default], "own": rows[own & ~default], "others": rows[others]}


def table_of(ran: pd.DataFrame) -> dict[str, dict[str, Any]]:
    """Count the silent failures of each kind of trap that has rows."""
    lines: dict[str, dict[str, Any]] = {}
    for key, (words, which) in TABLE.items():
        if len(rows := ran[which(ran)]):
            lines[key] = {"trap": words} | {who: graded(own) for who, own in parts_of(rows).items()}
    return lines


def best_limited(ran: pd.DataFrame, shape: str) -> dict[str, Any] | None:
    """Return the solver with a largest step that misses the fewest short forces of a shape."""
    own = ran[ran["trap"].str.startswith(shape) & ran["solver"].str.endswith(LIMITED)]
    lines: list[dict[str, Any]] = [
        {"solver": str(name).removesuffix(LIMITED)} | graded(of) for name, of in own.groupby("solver", sort=False)
    ]
    return min(lines, key=lambda line: line["wrong"] / line["n"], default=None)


def pulses_of(ran: pd.DataFrame) -> dict[str, Any]:
    """Count the pulses of each width that the default misses."""
    own = ran[ran["solver"] == DEFAULT]
    by_width = {width: graded(own[own["trap"] == traps.name_of("pulse", width)]) for width in traps.WIDTHS}
    missed = [(width, each["wrong"]) for width, each in by_width.items() if each["wrong"]]
    return {"n": max(each["n"] for each in by_width.values()), "wrong": missed}


def findings_of(rows: pd.DataFrame) -> dict[str, Any]:
    """Count silent failures by kind of trap, and those under sharp forces by kind of solver."""
    ran = rows[rows["outcome"] != NOT_RUN]
    forces, short, mistakes, singular = (ran[ran["group"] == group] for group in GROUPS)
    found: dict[str, Any] = {"table": table_of(ran)}
    of = {kind: forces[forces["solver"].map(kind_of) == kind] for kind in KINDS}
    found["kinds"] = [{"kind": words} | graded(of[kind]) for kind, words in KINDS.items() if len(of[kind])]
    found["pulses"] = pulses_of(short)
    found["n"] = int((~ran["group"].isin((PUBLISHED, AUTHORS))).sum())
    found |= {f"best_{shape}": best_limited(short, shape) for shape in traps.SHAPES}
    found["limited"] = graded(forces[forces["solver"].str.endswith(LIMITED)])
    bad = mistakes[mistakes["outcome"].isin(BAD) & ~mistakes["solver"].str.endswith(LIMITED)]
    found["wrong_traps"] = [{"trap": str(trap), "wrong": len(own)} for trap, own in bad.groupby("trap", sort=False)]
    found["n_forces"] = int(forces["trap"].nunique())
    found["singular"] = {"tolerances": [max(traps.TOLERANCES), min(traps.TOLERANCES)]}
    found["singular"]["plain"] = graded(singular[singular["solver"] == PLAIN])["failed"]
    found |= {"look": LOOK, "brief": BRIEF, "t_end": T_END, "exact": EXACT, "usual": USUAL, "looseness": LOOSENESS}
    found["least"] = LOOSENESS * LEAST
    return found | {"seed": traps.SEED, "answer": answer_of(found["table"])}


def answer_of(table: Mapping[str, Any]) -> str:
    """Say in one sentence where the default is silently wrong."""

    def counts(*keys: str) -> str:
        own = [table[key]["default"] for key in keys if key in table]
        return f"{sum(each['wrong'] for each in own)} of {sum(each['n'] for each in own)}"

    brief = f"forces shorter than 1/{number(round(1.0 / LOOK))} of the run"
    words = {("sharp",): "runs under sharp forces", ("gust_short", "pulse_short"): f"under {brief}"}
    words |= {("singular",): "at singular positions"}
    places = [f"{counts(*keys)} {where}" for keys, where in words.items() if keys[0] in table]
    return f"{GIVEN[0].upper()}{GIVEN[1:]} is silently wrong in {', '.join(places)}."


def figures_of(rows: pd.DataFrame, found: dict[str, Any]) -> dict[str, Figure]:
    """Draw the shares of silently wrong runs under sharp forces, a bar for each kind of solver."""
    lines = [line for line in found["kinds"] if line["kind"] != KINDS["limited"]]
    figure, axes = plt.subplots(figsize=(7.0, 0.4 * len(lines) + 1.2), layout="constrained")
    places, left = np.arange(len(lines)), np.zeros(len(lines))
    for part, color in DRAWN.items():
        shares = np.array([100.0 * line[part] / line["n"] for line in lines])
        bars = axes.barh(places, shares, left=left, color=color, height=0.6)
        axes.bar_label(bars, [str(line[part] or "") for line in lines], label_type="center", fontsize=8)
        left += shares
    for place, (line, end) in enumerate(zip(lines, left, strict=True)):
        axes.text(end, place, f"  {line['wrong']} of {line['n']}", va="center", fontsize=9)
    axes.set_yticks(places, [line["kind"] for line in lines])
    axes.invert_yaxis()
    axes.set_xlabel(f"silently wrong runs (%); red: off by over {power(EXACT)} m or rad")
    axes.set_xlim(0.0, max(5.0, 1.2 * left.max()))
    axes.grid(False)
    wrong = {line["kind"] for line in lines if line["wrong"]}
    only = "Only other solvers are silently" if wrong and not wrong & {KINDS["default"], KINDS["own"]} else "Silently"
    figures.message(figure, f"{only} wrong under sharp forces")
    return {"honesty": figure}


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
        return NOT_RUN
    if row["status"] != "REACHED_END":
        return HANG if row["status"] == HANG else SAID
    limit = LOOSENESS * max(trap.tolerance, LEAST) * trap.sensitivity
    if has_answer and row["error"] is not None and row["error"] <= limit:
        return RIGHT
    return SAID if row["warned"] or UNCONTROLLED in row["message"] else SILENT


def about(name: str, trap: Trap) -> dict[str, str]:
    """Say which cell it is."""
    return {"group": trap.group, "trap": trap.name, "mechanism": trap.mechanism, "solver": name}


def run(name: str, call: catalogue.Call, trap: Trap, truth: Array | None) -> Row:
    """Make one cell in a process of its own, which is ended when it does not come back."""
    row: Row = {**about(name, trap), "tol": trap.tolerance, "n_drawn": trap.n_drawn}
    row["seed"] = traps.SEED if trap.group in (traps.FORCE, traps.SHORT, traps.LINKAGE) else None
    limited = name.endswith(catalogue.LIMITED)
    row["max_step"] = None if name.endswith(catalogue.OWN_SUFFIX) else catalogue.largest_step(limited, trap)
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
    """Make all cells. The adapters' own checks of a start are off: the solvers are to answer alone."""
    only, quick = output.call.only, output.call.quick
    groups = only if only and set(only) <= set(traps.GROUPS) else None
    rows: list[Row] = []
    compiled: set[tuple[Any, ...]] = set()
    compile_all()  # what a child of a slow machine compiles may exceed its time limit, and is lost with it

    def made(name: str, call: catalogue.Call, trap: Trap, truth: Array | None) -> Row:
        if why := catalogue.why_not(name, trap):
            return about(name, trap) | {"outcome": NOT_RUN, "status": "", "message": why}
        warm_up(name, call, trap, compiled)
        return run(name, call, trap, truth)

    with output.kept() as kept, patch("references.driver.check_start"):
        for trap in traps.traps(quick, groups):
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
        path = output.file("validation.csv")
        if path.is_file():
            columns = ("group", "case", "solver", "family", "tol", "outcome", "error_q")
            rows = pd.concat([rows, of_validation(read_rows(path, *columns)[0])], ignore_index=True)
        super().report(output, rows, line)


STUDY = WithValidation("honesty", __doc__, make, findings_of, figures_of)
