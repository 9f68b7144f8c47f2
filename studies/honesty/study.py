"""Which solvers report when they are wrong: every solver on every trap, right, with a report, silent, or hung."""

import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from itertools import pairwise
from typing import Any
from unittest.mock import patch

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from references.cyrk.ode import solve_cyrk
from references.heyoka.taylor import solve_heyoka
from references.scipy.index1 import solve_index1
from references.sundials.cvode_c import solve_cvode_c
from references.sundials.ida import solve_ida, solve_ida_c
from studies.bench import figures
from studies.bench.apart import SEPARATOR, apart, heard
from studies.bench.cli import StudyError
from studies.bench.end_states import EXACT, JUDGED
from studies.bench.render import number, power
from studies.bench.sharp_forces import T_END
from studies.bench.solvers import GIVEN
from studies.bench.store import Array, Output, Row, read_rows
from studies.bench.study import Study
from studies.honesty import traps
from studies.honesty.traps import Trap
from twoloop import ConstrainedSystem, Result, solve_dae
from twoloop.__main__ import compile_all
from twoloop.kernels.compile import callbacks
from twoloop.kernels.control.discontinuities import N_SAMPLES
from twoloop.kernels.data.indices import MAX_GAP_RATIO

OWN = (GIVEN, "Taylor", "Adams", "DOP853", "Gauss12", "RadauIIA5", "BDF")
IDA, IDA_C, CVODE_C, HEYOKA = "IDA, stabilised", "IDA from C", "CVODE from C, Adams", "heyoka, Taylor"
PROJECTED = "CVODE from C, BDF, projected"
CYRK, CYRK_RADAU = "CyRK, DOP853", "CyRK, Radau"
OTHERS: dict[str, Callable[..., Result]] = {  # but for SciPy's
    **{IDA: partial(solve_ida, form="stabilised"), IDA_C: solve_ida_c, CVODE_C: partial(solve_cvode_c, method="Adams")},
    **{HEYOKA: solve_heyoka, PROJECTED: partial(solve_cvode_c, method="BDF", projected=True)},
    **{CYRK: solve_cyrk, CYRK_RADAU: partial(solve_cyrk, method="Radau")},
}
SUNDIALS = (IDA, IDA_C, CVODE_C, PROJECTED)
COMPILED_ONLY = (IDA_C, CVODE_C, PROJECTED, HEYOKA, CYRK, CYRK_RADAU)
SCIPY = ("LSODA", "DOP853", "Radau", "BDF")
OF_FORCES = (  # run under sharp forces, too: all presets but the paper's, which follow it to the letter
    *("auto, compiled", "auto, not compiled", "Taylor, compiled", "Gauss4", "Gauss6", "Gauss8", "Gauss10", "Gauss14"),
    *("Gauss16", "SunRadau5", "RadauIIA9", "RadauIIA13", "TRBDF2", "ESDIRK4", "Newmark"),
)
OWN_SUFFIX = " (twoloop)"
DEFAULT = f"{GIVEN}{OWN_SUFFIX}"
WITH_CODE: dict[str, dict[str, Any]] = {"": {}, "compiled": {"compiled": True}, "not compiled": {"compiled": False}}
OWN_ONLY = (traps.MANY, traps.STOPS, traps.INERTIA, traps.CERTIFICATE, traps.SIGNAL, traps.CALLS)
QUICK_OWN, QUICK_SCIPY = (GIVEN, "DOP853", "BDF"), ("DOP853",)
OWN_OF = {  # groups of many runs, which fewer methods make
    **dict.fromkeys((traps.SINGULAR, traps.FOLD), (GIVEN, "auto, not compiled", "DOP853")),
    **dict.fromkeys((traps.STOPS, traps.SIGNAL, traps.CALLS, traps.SHORT), (GIVEN, "DOP853", "RadauIIA5")),
    traps.MANY: (GIVEN,),
    traps.INERTIA: (GIVEN, "auto, compiled", "DOP853", "Taylor", "RadauIIA5"),
    traps.CERTIFICATE: (GIVEN, "DOP853", "RadauIIA5", "BDF", "TRBDF2", "ESDIRK4", "Newmark"),
    traps.LINKAGE: (GIVEN, "DOP853"),
    traps.FORCE: (*OWN, *OF_FORCES),
}
LOOK = MAX_GAP_RATIO / N_SAMPLES  # of a run: longest time between two evaluations of a force that changes with time
LIMITED = ", max_step"  # of other solvers whose largest step is that time

KINDS = {  # kinds of solvers, in words
    "default": "the default",
    "own": "twoloop's other methods",
    "heyoka": "heyoka",
    "cyrk": "CyRK",
    "sundials": "SUNDIALS (IDA, CVODE)",
    "scipy": "SciPy",
    "limited": "other solvers with `max_step`",
}

Call = Callable[[Trap], Result]


def kind_of(name: str) -> str:
    """Which of KINDS a solver is; other solvers with a largest step are "limited", whosever they are."""
    if name.endswith(OWN_SUFFIX):
        return "default" if name == DEFAULT else "own"
    if name.endswith(LIMITED):
        return "limited"
    named = {HEYOKA: "heyoka", CYRK: "cyrk", CYRK_RADAU: "cyrk"} | dict.fromkeys(SUNDIALS, "sundials")
    return named.get(name, "scipy")


def own(method: str, trap: Trap) -> Result:
    """Run a method of twoloop, as a user calls it."""
    name, _, code = method.partition(", ")
    options: dict[str, Any] = {"rtol": trap.tolerance, "atol": trap.tolerance, "time_limit": trap.time_limit}
    options |= WITH_CODE[code] | ({} if name == GIVEN else {"method": name}) | dict(trap.steps)
    return trap.solve(trap.system, (0.0, trap.t_end), trap.q0, trap.v0, **options)  # type: ignore[no-any-return]


def largest_step(limited: bool, trap: Trap) -> float | None:
    """Return `max_step` of another solver (s): the trap's own, else LOOK if it is `limited`, else none."""
    return trap.steps.get("max_step", LOOK * trap.t_end if limited else None)


def other(solve: Callable[..., Result], limited: bool, trap: Trap) -> Result:
    """Run another solver, without a largest step, or with one."""
    options = {"time_limit": trap.time_limit, "max_step": largest_step(limited, trap)}
    tolerances = {"tol": trap.tolerance} if solve is solve_heyoka else {"rtol": trap.tolerance, "atol": trap.tolerance}
    return solve(trap.system, (0.0, trap.t_end), trap.q0, trap.v0, **tolerances, **options)


def solvers_of(quick: bool, group: str = traps.MISTAKE) -> dict[str, Call]:
    """Return the solvers of a group of traps by name: twoloop's, then others without `max_step` and with it."""
    left_out = OTHERS if quick else (IDA, PROJECTED, CYRK_RADAU) if group in (traps.SHORT, traps.LINKAGE) else ()
    others = {name: solve for name, solve in OTHERS.items() if name not in left_out}
    scipy = QUICK_SCIPY if quick or group in (traps.SHORT, traps.LINKAGE) else SCIPY
    others |= {f"{name}, index 1": partial(solve_index1, method=name) for name in scipy}
    if group in (traps.SINGULAR, traps.FOLD):  # where accelerations are undefined
        others = {name: solve for name, solve in others.items() if name in (IDA, IDA_C)}
    methods = QUICK_OWN if quick else OWN_OF.get(group, OWN)
    made: dict[str, Call] = {f"{name}{OWN_SUFFIX}": partial(own, name) for name in methods}
    if group in OWN_ONLY:
        return made
    made |= {name: partial(other, solve, False) for name, solve in others.items()}
    if group not in (traps.INPUT, traps.LINKAGE, traps.SINGULAR, traps.FOLD):  # which a largest step does not help
        made |= {name + LIMITED: partial(other, solve, True) for name, solve in others.items()}
    return made


def why_not(name: str, trap: Trap) -> str:
    """Say why a solver is not run on a trap; "" where it is run."""
    solver, theirs = name.removesuffix(LIMITED), not name.endswith(OWN_SUFFIX)
    if theirs and set(trap.steps) - {"max_step"}:
        return "its adapter takes neither first nor constant steps"
    if name.endswith(LIMITED) and trap.steps:
        return "the trap sets max_step itself"
    if theirs and not solver.startswith("IDA"):  # it is given accelerations, which twoloop derives
        if trap.group == traps.INPUT:
            return "it is given accelerations: it has no constraints to check"
        if trap.impulse or trap.singular:
            return "the accelerations are not defined throughout: of an impulse, or where C_q loses rank"
    package = {HEYOKA: "heyoka", CYRK: "CyRK", CYRK_RADAU: "CyRK"}.get(solver)
    if package is not None and find_spec(package) is None:
        return f"{package} is not installed"
    return "it takes compiled functions only" if solver in COMPILED_ONLY and trap.system.called_in_python else ""


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
    "folds": ("folds of linkages", _of(traps.FOLD)),
    "many": ("both, from more starts", _of(traps.MANY)),
    "stops": ("several stops", _of(traps.STOPS)),
    "inertia": ("little inertia", _of(traps.INERTIA)),
    "certificates": ("certificates", _of(traps.CERTIFICATE)),
    "signals": ("signals", _of(traps.SIGNAL)),
    "calls": ("forces that count calls", _of(traps.CALLS)),
    "linkages": ("random four-bar linkages", _of(traps.LINKAGE)),
    "mistakes": ("mistakes and hard motions", _of(traps.MISTAKE)),
    "input": ("inconsistent start, wrong derivative", _of(traps.INPUT)),
    "published": ("published and textbook mechanisms", _of(PUBLISHED)),
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


def best_limited(ran: pd.DataFrame, shape: str) -> dict[str, Any] | None:
    """Return the solver with a largest step that misses the fewest short forces of a shape."""
    own = ran[ran["trap"].str.startswith(shape) & ran["solver"].str.endswith(LIMITED)]
    lines: list[dict[str, Any]] = [
        {"solver": str(name).removesuffix(LIMITED)} | graded(of) for name, of in own.groupby("solver", sort=False)
    ]
    return min(lines, key=lambda line: line["wrong"] / line["n"], default=None)


def findings_of(rows: pd.DataFrame) -> dict[str, Any]:
    """Count silent failures by kind of trap, and those under sharp forces by kind of solver."""
    ran = rows[rows["outcome"] != NOT_RUN]
    forces, short, mistakes, singular = (ran[ran["group"] == group] for group in GROUPS)
    found: dict[str, Any] = {"table": {}}
    for key, (words, which) in TABLE.items():
        if len(own := ran[which(ran)]):
            found["table"][key] = {"trap": words} | {who: graded(part) for who, part in parts_of(own).items()}
    of = {kind: forces[forces["solver"].map(kind_of) == kind] for kind in KINDS}
    found["kinds"] = [{"kind": words} | graded(of[kind]) for kind, words in KINDS.items() if len(of[kind])]
    own = short[short["solver"] == DEFAULT]
    by_width = {width: graded(own[own["trap"] == traps.name_of("pulse", width)]) for width in traps.WIDTHS}
    missed = [(width, each["wrong"]) for width, each in by_width.items() if each["wrong"]]
    found["pulses"] = {"n": max(each["n"] for each in by_width.values()), "wrong": missed}
    found["n"] = int((~ran["group"].isin((PUBLISHED, AUTHORS))).sum())
    found |= {f"best_{shape}": best_limited(short, shape) for shape in traps.SHAPES}
    found["limited"] = graded(forces[forces["solver"].str.endswith(LIMITED)])
    bad = mistakes[mistakes["outcome"].isin(BAD) & ~mistakes["solver"].str.endswith(LIMITED)]
    found["wrong_traps"] = [{"trap": str(trap), "wrong": len(own)} for trap, own in bad.groupby("trap", sort=False)]
    found["n_forces"] = int(forces["trap"].nunique())
    found["singular"] = {"tolerances": [max(traps.TOLERANCES), min(traps.TOLERANCES)]}
    found["singular"]["plain"] = graded(singular[singular["solver"] == PLAIN])["failed"]
    passed = ran[(ran["group"] == traps.CERTIFICATE) & (ran["trap"] == traps.SOUND)]["outcome"] == RIGHT
    found["passed"] = {"n": len(passed), "right": int(passed.sum())}  # certificates of right results
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
    words |= {("singular", "folds", "many"): "at singular positions"}
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


GRACE = 60.0  # s beyond the time limit of a run after which it hangs: compilation does not count against the limit
TRUTHS = (1e-12, 1e-10, 1e-9)  # tolerances of the two runs that give the right answer: the first that succeed
TRUTH_LIMIT = 10.0  # s that one of them may take
AGREE = 1e-7  # how far the two may differ
UNCONTROLLED = "no error was estimated"  # in the message of a successful run with steps of a given size
REDUNDANT = "the constraints of"  # begins the warning of redundant rows, which says nothing of errors
REFUSALS = (  # in messages of an adapter, or of twoloop, that does not take the equations or the setting: no run
    *("NotSymbolic", "compiled=True needs equations", "needs callbacks whose operations it can see"),
    *("must be positive definite", "cannot keep a constant one", "LinAlgError"),
)
# are built for each system, which takes longer than a run
BUILT = (HEYOKA, CVODE_C, PROJECTED, CYRK, CYRK_RADAU)


def right_answer(trap: Trap) -> Array | None:
    """Return the positions at the end by two methods, from break to break of forces; StudyError if they differ."""
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


def cell(call: Call, trap: Trap, truth: Array | None) -> Row:
    """Make a run and describe what came of it."""
    result, made = heard(partial(call, trap))
    made |= {"error": None, "evaluated": True}
    if result is not None and result.success:
        if trap.error is not None:
            made["error"] = trap.error(result)
        elif truth is not None:
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
    if (has_answer or trap.error is not None) and row["error"] is not None and row["error"] <= limit:
        return RIGHT
    warned = any(not words.startswith(REDUNDANT) for words in row["warned"].split(SEPARATOR) if words)
    return SAID if warned or UNCONTROLLED in row["message"] else SILENT


def about(name: str, trap: Trap) -> dict[str, str]:
    """Say which cell it is."""
    return {"group": trap.group, "trap": trap.name, "mechanism": trap.mechanism, "solver": name}


def run(name: str, call: Call, trap: Trap, truth: Array | None) -> Row:
    """Make one cell in a process of its own, which is ended when it does not come back."""
    row: Row = {**about(name, trap), "tol": trap.tolerance, "n_drawn": trap.n_drawn}
    row["seed"] = None if trap.group in (traps.INPUT, traps.MISTAKE, traps.SINGULAR) else traps.SEED
    limited = name.endswith(LIMITED)
    row["max_step"] = None if name.endswith(OWN_SUFFIX) else largest_step(limited, trap)
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

    def made(name: str, call: Call, trap: Trap, truth: Array | None) -> Row:
        if why := why_not(name, trap):
            return about(name, trap) | {"outcome": NOT_RUN, "status": "", "message": why}
        warm_up(name, call, trap, compiled)
        return run(name, call, trap, truth)

    with output.kept() as kept, patch("references.driver.check_start"):
        for trap in traps.traps(quick, groups):
            known = solvers_of(quick, trap.group)
            known = {name: call for name, call in known.items() if output.call.wants(name, trap.group)}
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
