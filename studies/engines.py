"""Engines and closed loops: what MuJoCo, Drake, Pinocchio and Exudyn are off by, and what an accuracy costs there."""

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cache, partial
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from references.engines import drake, exudyn_bodies, mujoco, pinocchio
from references.engines.rigid import Motion, Prepared
from studies.bench import figures, tables
from studies.bench.closed_loops import MECHANISMS, four_bar, rssr
from studies.bench.engine_runs import INSTANTS, LIMIT, Loop, errors, gate, timed
from studies.bench.render import number
from studies.bench.store import Output, Row
from studies.bench.study import Study
from twoloop.audit.step_audit import LOST, order_and_floor

GATE, RUN, OURS = "gate", "run", "twoloop"  # groups of rows; the engine that is none
N_STEPS = (100, 200, 500, 1500, 5000, 15_000, 50_000, 150_000)  # multiples of INSTANTS
TOLERANCES = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10, 1e-11)
ERRORS = (1e-2, 1e-3, 1e-4, 1e-6)
MODULES = {"mujoco": mujoco, "drake": drake, "pinocchio": pinocchio, "exudyn_bodies": exudyn_bodies}
NAMES = {"mujoco": "MuJoCo", "drake": "Drake", "pinocchio": "Pinocchio", "exudyn_bodies": "Exudyn", OURS: "twoloop"}
PACKAGES = {"mujoco": "mujoco", "drake": "drake", "pinocchio": "pin", "exudyn_bodies": "exudyn"}
RIGID = mujoco.Settings("RK4", "1e-9 1", "0.9999 0.9999 0.001")
SHOWN = ("four-bar", "Watt's six-bar", "Andrews' squeezer", "RSSR", "Bricard", "Stewart platform")  # in the figure


@dataclass(frozen=True)
class Configuration:
    """An engine with settings; `how` says in the engine's own words what is set."""

    engine: str
    label: str
    settings: Any = None
    how: str = "nothing"

    @property
    def name(self) -> str:
        """In tables and rows."""
        return f"{NAMES[self.engine]}, {self.label}"


CONFIGURATIONS = (
    Configuration("mujoco", "default", mujoco.Settings()),
    Configuration("mujoco", "RK4", mujoco.Settings("RK4"), '`integrator="RK4"`'),
    Configuration(
        "mujoco",
        "RK4, solref 2 ms",
        mujoco.Settings("RK4", "0.002 1", "0.999 0.9999 0.001"),
        '`integrator="RK4"`; on connects `solref="0.002 1" solimp="0.999 0.9999 0.001"`',
    ),
    Configuration(
        "mujoco",
        "RK4, solref 2h",
        RIGID,
        '`integrator="RK4"`; on connects `solref="1e-9 1" solimp="0.9999 0.9999 0.001"`',
    ),
    Configuration("drake", "SAP", drake.Settings(), "`kSap`"),
    Configuration("drake", "TAMSI", drake.Settings("kTamsi"), "`kTamsi`"),
    Configuration("drake", "continuous", drake.Settings("continuous"), "a plant with step 0"),
    Configuration("pinocchio", "default", pinocchio.Settings()),
    Configuration(
        "pinocchio",
        "Euler, Baumgarte",
        pinocchio.Settings("Euler", 1e-3, baumgarte=10.0),
        "semi-implicit Euler; `ProximalSettings(1e-14, 1e-3, 20)`, `Kp` 100, `Kd` 20",
    ),
    Configuration(
        "pinocchio",
        "RK4, Baumgarte",
        pinocchio.Settings("RK4", 1e-3, baumgarte=10.0),
        "RK4 of q and v; `ProximalSettings(1e-14, 1e-3, 20)`, `Kp` 100, `Kd` 20",
    ),
    Configuration(
        "pinocchio",
        "RK4, mu 1e-8",
        pinocchio.Settings("RK4", 1e-8, baumgarte=10.0),
        "as before, with `ProximalSettings(1e-14, 1e-8, 20)`",
    ),
    Configuration("exudyn_bodies", "generalized-alpha", exudyn_bodies.Settings()),
    Configuration("exudyn_bodies", "trapezoidal", exudyn_bodies.Settings("TrapezoidalIndex2"), "`TrapezoidalIndex2`"),
    Configuration(OURS, "default"),
)
BEST: dict[str, Any] = {  # of the gates: the most rigid of an engine
    "mujoco": RIGID,
    "drake": drake.Settings(),
    "pinocchio": pinocchio.Settings("RK4", 1e-3),
    "exudyn_bodies": exudyn_bodies.Settings(),
}


@cache
def loop_of(make: Callable[[], Any]) -> Loop:
    """A mechanism, made once."""
    return Loop(make())


@cache
def gated(make: Callable[[], Any], engine: str) -> tuple[str, str]:
    """Status and message of the gates of an engine's model of a mechanism."""
    try:
        wrong = gate(loop_of(make), MODULES[engine].prepare(loop_of(make).rigid, BEST[engine]))
    except RuntimeError as error:
        return ("NOT_AVAILABLE" if "not installed" in str(error) else "FAILED"), str(error).strip().splitlines()[0]
    except ValueError as error:
        return "NOT_APPLICABLE", str(error)
    return ("GATE_FAILED", wrong) if wrong else ("PASSED", "")


def make(output: Output) -> pd.DataFrame:
    """Rows of the gates, and of runs."""
    quick = output.call.quick
    with output.kept() as kept:
        rows: list[Row] = []
        for build in (four_bar, rssr) if quick else MECHANISMS:
            for engine in MODULES:
                rows.append(kept.made(f"{GATE} {build.__name__} {engine}", partial(_gate_row, build, engine)))
            for each in CONFIGURATIONS:
                cost: list[float] = []  # of the run before, and its steps
                for value in _values(each, quick):
                    key = f"{RUN} {build.__name__} {each.name} {value!r}"
                    row = kept.made(key, partial(run_row, build, each, value, cost))
                    cost = [row["call_s"], row["n_steps"]] if row["call_s"] else cost
                    rows.append(row)
                    if row["status"] in ("NOT_AVAILABLE", "NOT_APPLICABLE", "GATE_FAILED"):
                        break
    return pd.DataFrame(rows)


def _values(each: Configuration, quick: bool) -> Iterator[float]:
    values = TOLERANCES if each.engine == OURS else N_STEPS
    return iter(values[1:4:2] if quick else values)


def _row(group: str, build: Callable[[], Any], **more: Any) -> Row:
    nothing = dict.fromkeys(
        ("h", "tol", "n_steps", "call_s", "stepping_s", "error_q", "error_v", "error_f", "gap", "energy")
    )
    return {"group": group, "case": loop_of(build).problem.name, **nothing, "floor": None, "message": "", **more}


def _gate_row(build: Callable[[], Any], engine: str) -> Row:
    status, message = gated(build, engine)
    return _row(GATE, build, solver=NAMES[engine], family=NAMES[engine], status=status, message=message)


def run_row(build: Callable[[], Any], each: Configuration, value: float, before: list[float]) -> Row:
    """A run, its error and its time."""
    loop = loop_of(build)
    row = _row(RUN, build, solver=each.name, family=NAMES[each.engine], status="REACHED_END")
    if each.engine == OURS:
        row |= {"tol": value}
        run, again = _ours(loop, value)
    else:
        row |= {"h": loop.t_end / value, "n_steps": int(value)}
        status, message = gated(build, each.engine)
        if status != "PASSED":
            return row | {"status": status, "message": message}
        if before and before[0] * value / before[1] > LIMIT:
            return row | {"status": "TIME_LIMIT", "message": f"not run: would take more than {LIMIT:g} s"}
        try:
            prepared: Prepared = MODULES[each.engine].prepare(loop.rigid, each.settings)
        except RuntimeError as error:
            return row | {"status": "NOT_APPLICABLE", "message": str(error).strip().splitlines()[0]}
        run = partial(prepared.run, loop.t_end, int(value), INSTANTS)
        again = partial(_again, prepared, loop.t_end, int(value))
    motion = run()
    if motion.message:
        return row | {"status": "FAILED", "message": motion.message, "call_s": motion.call_s}
    call, stepping = timed(again)
    row |= {"call_s": call, "stepping_s": stepping, "floor": loop.reference[1]}
    return row | errors(loop, motion)


def _again(prepared: Prepared, t_end: float, n_steps: int, k: int) -> Motion:
    return prepared.run(t_end, n_steps, 1)


def _ours(loop: Loop, tolerance: float) -> tuple[Callable[[], Motion], Callable[[int], Motion]]:
    def run() -> Motion:
        made = loop.ours(tolerance, times=loop.times)
        motion = loop.motion(made.q, made.v, loop.force(made))
        return motion if made.success else replace(motion, message=made.message)

    def again(k: int) -> Motion:
        began = time.process_time()
        made = loop.ours(tolerance, t0=1e-9 * (k + 1) * loop.t_end)  # a start that no call has had
        call = time.process_time() - began
        return loop.motion(made.q[:, :1], made.v[:, :1], None, call, made.stats.cpu_time)

    return run, again


def findings_of(rows: pd.DataFrame) -> dict[str, Any]:
    """Versions, gates, what each configuration is off by, and what an accuracy costs."""
    runs, gates = rows[rows["group"] == RUN], rows[rows["group"] == GATE]
    cases = list(dict.fromkeys(runs["case"]))
    found: dict[str, Any] = {
        "cases": cases,
        "errors": list(ERRORS),
        "lost": LOST,
        "limit": LIMIT,
    }
    found["absent"] = sorted(set(gates[gates["status"] == "NOT_AVAILABLE"]["family"]))
    found["versions"] = {NAMES[engine]: _version(package) for engine, package in PACKAGES.items()}
    found["gates"] = gates[gates["status"] != "PASSED"][["case", "solver", "message"]].to_dict("records")
    found["n_gates"] = int((gates["status"] == "PASSED").sum())
    found["apart"] = float(runs["floor"].astype(float).max())
    found["configurations"] = [_configuration(each, runs[runs["solver"] == each.name]) for each in CONFIGURATIONS]
    found["cheapest"] = [_cheapest(case, runs[runs["case"] == case]) for case in cases]
    found["engines"] = [_engine(name, runs[runs["family"] == name], cases) for name in NAMES.values()]
    for key in ("at", "engines"):  # with ours and without
        found[f"wins_{key}"] = [_counted(line[key][k] for line in found["cheapest"]) for k in range(len(ERRORS))]
    return found


def _counted(cheapest: Iterable[dict[str, Any] | None]) -> dict[str, int]:
    """On how many mechanisms each engine is the cheapest."""
    names = [line["solver"].split(", ")[0] for line in cheapest if line]
    return {name: names.count(name) for name in sorted(set(names), key=lambda each: (-names.count(each), each))}


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


def _configuration(each: Configuration, runs: pd.DataFrame) -> dict[str, Any]:
    ended = runs[runs["error_q"].notna()]
    orders, floors, lost = [], [], 0
    for _, own in ended.groupby("case", sort=False):
        lost += bool((own["error_q"].astype(float) > LOST).all())
        if own["h"].notna().all():
            order, floor = order_and_floor(own["h"], own["error_q"], float(own["floor"].max()))
            orders += [order] if order is not None else []
            floors += [floor] if floor is not None else []
    refused = runs.loc[runs["status"] == "NOT_APPLICABLE", "message"]
    return {
        "name": each.name,
        "how": each.how,
        "runs": len(ended),
        "silent": int((ended["error_q"].astype(float) > LOST).sum()),
        "failed": int((runs["status"] == "FAILED").sum()),
        "refused": sorted({message.split(". ")[1] for message in refused}),
        "order": [min(orders), float(np.median(orders)), max(orders)] if orders else None,
        "floor": [min(floors), max(floors)] if floors else None,
        "n_floors": len(floors),
        "lost": lost,
        "gap": float(ended["gap"].astype(float).median()) if len(ended) else None,
    }


def _priced(runs: pd.DataFrame, error: float, what: str = "call_s") -> float | None:
    """What a configuration takes on a mechanism for an error: between its runs, or of the cheapest that is as good."""
    if runs["error_q"].isna().all():
        return None
    cost = tables.time_for(runs, error, what)
    good = runs[runs["error_q"].astype(float) <= error]
    return float(cost) if cost == cost else float(good[what].min()) if len(good) else None


def _cheapest(case: str, runs: pd.DataFrame) -> dict[str, Any]:
    """At each error the cheapest configuration on a mechanism, the cheapest of an engine, and what ours takes."""
    line: dict[str, Any] = {"case": case, "at": [], "engines": [], "ours": []}
    own = f"{NAMES[OURS]}, default"
    for error in ERRORS:
        costs = {str(solver): cost for solver, rows in runs.groupby("solver") if (cost := _priced(rows, error))}
        for key, priced in (("at", costs), ("engines", {name: cost for name, cost in costs.items() if name != own})):
            best = min(priced, key=priced.__getitem__) if priced else None
            line[key].append({"solver": best, "call_s": priced[best]} if best else None)
        line["ours"].append(costs.get(own))
    return line


def _engine(name: str, runs: pd.DataFrame, cases: list[str]) -> dict[str, Any]:
    """At each error the configuration of an engine that gets there on most mechanisms, then the fastest by median."""
    lines: list[dict[str, Any] | None] = []
    for error in ERRORS:
        ranked: list[tuple[int, float, str, list[float], list[float]]] = []
        for solver, own in runs.groupby("solver", sort=False):
            by_case = {case: each for case, each in own.groupby("case")}
            costs = {case: cost for case in cases if case in by_case and (cost := _priced(by_case[case], error))}
            if costs:
                found = (_step_for(by_case[case], error) for case in costs)
                steps = [step for step in found if step is not None]
                stepping = [_priced(by_case[case], error, "stepping_s") or np.nan for case in costs]
                middle = float(np.median(list(costs.values())))
                ranked.append((-len(costs), middle, str(solver), steps, stepping))
        best = min(ranked, key=lambda each: each[:2], default=None)
        if best is None:
            lines.append(None)
            continue
        steps = best[3]
        line = {"solver": best[2], "reached": -best[0], "call_s": best[1]}
        line |= {"steps": [min(steps), max(steps)] if steps else None}
        lines.append(line | {"stepping_s": float(np.nanmedian(best[4]))})
    return {"name": name, "runs": int(runs["error_q"].notna().sum()), "at": lines}


def _step_for(runs: pd.DataFrame, error: float) -> float | None:
    """The longest step, or loosest tolerance, of which neither it nor any shorter one is off by more."""
    known = runs[runs["error_q"].notna()].assign(value=lambda each: each["h"].fillna(each["tol"]))
    wrong = known[known["error_q"].astype(float) > error]["value"].min()
    good = known[~(known["value"] >= wrong)]["value"] if wrong == wrong else known["value"]
    return float(good.max()) if len(good) else None


LOOKS = {  # engine: colour
    "MuJoCo": figures.BLUE,
    "Drake": figures.GREEN,
    "Pinocchio": figures.ORANGE,
    "Exudyn": figures.PINK,
    "twoloop": figures.BLACK,
}


def figures_of(rows: pd.DataFrame, found: dict[str, Any]) -> dict[str, Figure]:
    """Time of the call over the error, a panel a mechanism."""
    runs = rows[(rows["group"] == RUN) & rows["error_q"].notna()]
    shown = [case for case in SHOWN if case in set(runs["case"])] or found["cases"]
    columns = min(3, len(shown))
    lines = -(-len(shown) // columns)
    size: dict[str, Any] = {
        "figsize": (3.3 * columns + 1.0, 2.9 * lines + 1.2),
        "layout": "constrained",
        "squeeze": False,
    }
    figure, panels = plt.subplots(lines, columns, sharey=True, **size)
    for panel, case in zip(panels.flat, shown, strict=False):
        own, markers = runs[runs["case"] == case], dict.fromkeys(LOOKS, 0)
        for each in CONFIGURATIONS:
            line = own[own["solver"] == each.name].assign(value=lambda row: row["h"].fillna(row["tol"]))
            family = NAMES[each.engine]
            look = {"color": LOOKS[family], "marker": "osD^v"[markers[family]], "markersize": 3.5}
            markers[family] += 1
            if len(line):
                line = line.sort_values("value")
                panel.plot(line["error_q"].astype(float), 1e3 * line["call_s"], label=each.name, **look)
        panel.axvspan(LOST, 10.0, color=figures.GREY, alpha=0.15, lw=0)
        panel.set(xscale="log", yscale="log", title=case, xlim=(1e-11, 10.0))
    for panel in panels[-1]:
        panel.set_xlabel("error of positions (m, or of the axes)")
    for panel in panels[:, 0]:
        panel.set_ylabel("CPU time of the call (ms)")
    entries = {
        label: handle for panel in panels.flat for handle, label in zip(*panel.get_legend_handles_labels(), strict=True)
    }
    figure.legend(entries.values(), entries, loc="outside lower center", ncols=3, fontsize=8)
    return {"engines": figure}


def tables_of(rows: pd.DataFrame, found: dict[str, Any]) -> dict[str, str]:
    """Errors at one step length of each configuration, a line a mechanism."""
    runs = rows[rows["group"] == RUN]
    failures = runs[runs["status"] == "FAILED"]
    lines = [
        f"- {solver}, {case}: h = {' and '.join(number(each * 1e3) for each in own['h'])} ms: {own['message'].iloc[-1]}"
        for (solver, case), own in failures[failures["h"].notna()].groupby(["solver", "case"], sort=False)
    ]
    return {"failures": "\n".join(lines)}


STUDY = Study("engines", __doc__, make, findings_of, figures_of, tables_of)
main = STUDY.main

if __name__ == "__main__":
    main()
