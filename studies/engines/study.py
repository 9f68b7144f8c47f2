"""Run MuJoCo, Drake, Pinocchio and Exudyn on closed loops beside twoloop: errors, and time at equal error."""

import time
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import Any

import matplotlib.pyplot as plt
import pandas as pd
from matplotlib.figure import Figure

from references.engines.rigid import Motion, Prepared, engines
from studies.bench import figures
from studies.bench.cli import version_of
from studies.bench.closed_loops import LIGHTENED, MECHANISMS, four_bar, rssr
from studies.bench.engine_runs import INSTANTS, LIMIT, Loop, errors, gate, timed
from studies.bench.render import number
from studies.bench.solvers import GIVEN
from studies.bench.store import Output, Row
from studies.bench.study import Study
from studies.engines import findings
from studies.engines.findings import CONFIGURATIONS, GATE, MASS, NAMES, OURS, RUN, TIGHT, Configuration
from twoloop.audit.simulator import LOST

N_STEPS = (100, 200, 500, 1500, 5000, 15_000, 50_000, 150_000)  # multiples of INSTANTS
TOLERANCES = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10, 1e-11)
# by group: steps of engines, tolerances of twoloop
VALUES: dict[str, Any] = {RUN: (N_STEPS, TOLERANCES), MASS: ((findings.PROBED,), (TIGHT,))}
SHOWN, AS_IT_COMES = ("four-bar", "RSSR", "Stewart platform"), "MuJoCo, default"  # in the figure
EVERYWHERE = [each for each in CONFIGURATIONS if each.everywhere]
MEASURES = ("h", "tol", "n_steps", "call_s", "stepping_s", "error_q", "error_v", "error_f", "gap", "energy", "floor")
STOPPED = ("NOT_AVAILABLE", "NOT_APPLICABLE", "GATE_FAILED")


@cache
def loop_of(build: Callable[[], Any]) -> Loop:
    """Return a mechanism with its reference."""
    return Loop(build())


@cache
def gated(build: Callable[[], Any], engine: str) -> tuple[str, str]:
    """Return status and message of the checks of an engine's model of a mechanism."""
    chosen, loop = engines()[engine], loop_of(build)
    try:
        wrong = gate(loop, chosen.prepare(loop.rigid, chosen.most_rigid))
    except RuntimeError as error:
        return ("NOT_AVAILABLE" if "not installed" in str(error) else "FAILED"), str(error).strip().splitlines()[0]
    except ValueError as error:
        return "NOT_APPLICABLE", str(error)
    return ("GATE_FAILED", wrong) if wrong else ("PASSED", "")


def make(output: Output) -> pd.DataFrame:
    """Make the rows of the checks, and of runs, also with a light body."""
    quick = output.call.quick
    groups: dict[str, Any] = {RUN: (four_bar, rssr)} if quick else {RUN: MECHANISMS, MASS: LIGHTENED}

    def wants(group: str, build: Callable[[], Any], *names: str) -> bool:
        return output.call.wants(group, loop_of(build).problem.name, *names)

    with output.kept() as kept:
        rows: list[Row] = []
        for group, build in ((group, build) for group, builds in groups.items() for build in builds):
            for engine, name in list(NAMES.items())[:-1] if wants(GATE, build) else ():  # twoloop is last
                status, message = gated(build, engine)
                row = _row(GATE, build, solver=name, family=name, status=status, message=message)
                rows.append(kept.made(f"{GATE} {build.__name__} {engine}", partial(dict, row)))
            for each in CONFIGURATIONS if group == RUN else EVERYWHERE:
                if not wants(group, build, NAMES[each.engine], each.name):
                    continue
                values: Any = VALUES[group][each.engine == OURS]
                cost: list[float] = []  # of the run before, and its steps
                for value in values[1:4:2] if quick else values:
                    key = f"{group} {build.__name__} {each.name} {value!r}"
                    row = kept.made(key, partial(run_row, build, each, value, cost, group))
                    cost = [row["call_s"], row["n_steps"]] if row["call_s"] else cost
                    rows.append(row)
                    if row["status"] in STOPPED:
                        break
    versions = {engine.name: version_of(engine.package) for engine in engines().values()}
    return (table := pd.DataFrame(rows)).assign(version=table["family"].map(versions))


def _row(group: str, build: Callable[[], Any], **more: Any) -> Row:
    loop = loop_of(build)
    told = {"group": group, "case": loop.problem.name, "span": loop.t_end}
    return {**told, **dict.fromkeys(MEASURES), "message": "", **more}


def _prepared(build: Callable[[], Any], each: Configuration) -> tuple[Prepared | None, Row]:
    """Return the model in an engine, or why there is none."""
    status, message = gated(build, each.engine)
    if status != "PASSED":
        return None, {"status": status, "message": message}
    try:
        return engines()[each.engine].prepare(loop_of(build).rigid, each.settings), {}
    except RuntimeError as error:
        return None, {"status": "NOT_APPLICABLE", "message": str(error).strip().splitlines()[0]}


def run_row(build: Callable[[], Any], each: Configuration, value: float, before: list[float], group: str = RUN) -> Row:
    """Make a run and measure its error and time; in the group of runs the shortest of several calls."""
    loop = loop_of(build)
    row = _row(group, build, solver=each.name, family=NAMES[each.engine], status="REACHED_END")
    if each.engine == OURS:
        row |= {"tol": value}
        run, again = _ours(loop, value, each.settings)
    else:
        row |= {"h": loop.t_end / value, "n_steps": int(value)}
        prepared, why = _prepared(build, each)
        if prepared is None:
            return row | why
        if before and before[0] * value / before[1] > LIMIT:
            return row | {"status": "TIME_LIMIT", "message": f"not run: would take more than {LIMIT:g} s"}
        run, alone = (partial(prepared.run, loop.t_end, int(value), n) for n in (INSTANTS, 1))
        again = lambda k: alone()  # noqa: E731
    try:
        motion = run()
    except ValueError as error:  # a mechanism for which no code can be generated
        return row | {"status": "NOT_APPLICABLE", "message": str(error)}
    if motion.message:
        return row | {"status": "FAILED", "message": motion.message, "call_s": motion.call_s}
    call, stepping = timed(again) if group == RUN else (motion.call_s, motion.stepping_s)
    return row | {"call_s": call, "stepping_s": stepping, "floor": loop.reference[1]} | errors(loop, motion)


def _ours(loop: Loop, tolerance: float, compiled: Any) -> tuple[Callable[[], Motion], Callable[[int], Motion]]:
    """Return a run of twoloop with states at the instants, and one that is timed: the k-th has a start of its own."""

    def run(times: Any = None, t0: float = 0.0) -> Motion:
        began = time.process_time()
        result = loop.solve(tolerance, times, t0=t0, compiled=compiled)
        spent, last = time.process_time() - began, None if times is not None else 1
        force = loop.force(result) if last is None else None
        motion = loop.motion(result.q[:, :last], result.v[:, :last], force, spent, result.stats.cpu_time)
        return motion if result.success else replace(motion, message=result.message)

    return lambda: run(loop.times), lambda k: run(t0=1e-9 * (k + 1) * loop.t_end)


# one configuration a line, those that come closest, and MuJoCo as it comes
COLORS = {"Drake": figures.TEAL, "MuJoCo": figures.NAVY, "Pinocchio": figures.ORANGE, "Exudyn": figures.TAN}


def figures_of(rows: pd.DataFrame, found: dict[str, Any]) -> dict[str, Figure]:
    """Draw the time of the call over the error, a panel a mechanism."""
    runs = rows[(rows["group"] == RUN) & rows["error_q"].notna()]
    shown = [case for case in SHOWN if case in found["cases"]] or found["cases"][:1]
    lines = {solver: name for name, solver in found["best"].items()} | {AS_IT_COMES: AS_IT_COMES}
    figure, panels = plt.subplots(1, len(shown), sharey=True, figsize=(9.6, 3.6), layout="constrained", squeeze=False)
    for panel, case in zip(panels[0], shown, strict=True):
        for solver, name in lines.items():
            line = runs[(runs["case"] == case) & (runs["solver"] == solver)]
            line = line.assign(value=line["h"].fillna(line["tol"])).sort_values("value")
            engine = name.split(", ")[0]
            look = {"color": COLORS.get(engine), "marker": "x" if name == AS_IT_COMES else "o", "label": name}
            if engine == OURS:
                look = figures.style(figures.DEFAULT) | {"label": f"{OURS}, {GIVEN}"}
            panel.plot(line["error_q"].astype(float), 1e3 * line["call_s"].astype(float), **look)
        panel.axvspan(LOST, 10.0, color=figures.GREY, alpha=0.15, lw=0)
        panel.text(1.0, 1.0, "wrong\nmotion", transform=panel.transAxes, ha="right", va="top", fontsize=8)
        panel.set(xscale="log", yscale="log", title=case, xlim=(1e-12, 10.0))
    panels[0, len(shown) // 2].set_xlabel("largest error of positions (m, or of the axes of bodies)")
    panels[0, 0].set_ylabel("CPU time of the call (ms)")
    figures.message(figure, _message(found))
    figures.label_lines(panels[0])
    return {"engines": figure}


def _message(found: dict[str, Any]) -> str:
    if not (ends := findings.ends_of(found)):
        return "No engine and twoloop reach the same error"
    (loose, first), (tight, last) = ends
    text = f"For an error of {tight} the fastest engine takes {number(last['ratio'])} times as long as twoloop (median)"
    n = len(first["slower"])
    return text + (f"; for {loose} an engine is faster on {n} of {first['compared']} mechanisms" if n else "")


STUDY = Study("engines", __doc__, make, findings.findings_of, figures_of)
