"""Run MuJoCo, Drake, Pinocchio and Exudyn on closed loops beside twoloop: errors, and time at equal error."""

import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from itertools import product
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from references.engines import rigid as parts
from references.engines.rigid import Motion, Prepared, Rigid, engines, rigid_of
from studies.bench import figures, tables
from studies.bench.cli import version_of
from studies.bench.closed_loops import LIGHTENED, LIGHTER, MECHANISMS, four_bar, parallelogram_motion, rssr
from studies.bench.end_states import EXACT
from studies.bench.render import number, power
from studies.bench.solvers import GIVEN
from studies.bench.store import Array, Output, Row
from studies.bench.study import Study
from twoloop import ConstraintWarning, solve_dae
from twoloop.audit.simulator import LOST, gaps, order_and_floor
from twoloop.bodies.model_problem import ModelProblem

PARALLEL = "parallelogram"  # the mechanism whose motion is known, as no method crosses its singular positions tightly
INSTANTS = 50  # beside the start, at which motions are compared
REFERENCE_TOL = 1e-12  # tolerance of both routes to a reference
LIMIT = 1.0  # s of CPU that the next finer run may be expected to take
# time of the gates, as a share of the span, and steps within it, of which one pair must do: Drake's loops take some
# steps to hold, and Exudyn's accelerations carry rounding over the square of the step
GATES = (1e-5, 1), (1e-5, 10), (1e-5, 200), (1e-3, 20)
SAME_POSE, SAME_INERTIA, SAME_ACCELERATION, SAME_PLACE = 1e-9, 1e-9, 5e-3, 1e-6
TIMED, ENOUGH = 3, 0.3  # calls of which the shortest counts, and s of CPU after which no further one is made


@dataclass(frozen=True)
class Loop:
    """A mechanism with its reference motion."""

    problem: ModelProblem

    @cached_property
    def rigid(self) -> Rigid:
        return rigid_of(self.problem)

    @property
    def t_end(self) -> float:
        return self.problem.t_span[1]

    @cached_property
    def times(self) -> Array:
        return np.linspace(0.0, self.t_end, INSTANTS + 1)

    def solve(self, tolerance: float, times: Array | None = None, t0: float = 0.0, **more: Any) -> Any:
        options: dict[str, Any] = {"rtol": tolerance, "atol": tolerance, "t_eval": times, **more}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConstraintWarning)
            problem = self.problem
            return solve_dae(problem.system, (t0, t0 + self.t_end), problem.q0, problem.v0, **options)

    @cached_property
    def reference(self) -> tuple[Motion, float]:
        """Return the motion, and its largest difference from a second solution; raise RuntimeError if one fails."""
        if self.problem.name == PARALLEL:
            q, v, apart = parallelogram_motion(self.times)
            return self.motion(q, v), apart
        plain = partial(self.solve, REFERENCE_TOL, self.times, compiled=False)  # references are no reason to compile
        runs = [plain(method=method) for method in ("DOP853", "RadauIIA9")]
        if not all(run.success for run in runs):
            raise RuntimeError(next(run.message for run in runs if not run.success))
        one, other = (self.motion(run.q, run.v, self.force(run)) for run in runs)
        return one, float(max(np.abs(one.x - other.x).max(), np.abs(one.R - other.R).max()))

    @cached_property
    def kinetic(self) -> float:
        """Return the largest kinetic energy of the reference, J."""
        known, bodies = self.reference[0], self.rigid.model.bodies
        J = np.array([parts.tensor(body.inertia) for body in bodies])
        local = np.einsum("tkji,tkj->tki", known.R, known.w)
        m = np.array([body.inertia[0] for body in bodies])
        each = m * (known.v**2).sum(axis=2) + np.einsum("tki,kij,tkj->tk", local, J, local)
        return float(0.5 * each.sum(axis=1).max())

    def force(self, run: Any) -> Array:
        """Return the force of the first joint that closes a loop, as in `Motion`; NaN if it is not unique."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConstraintWarning)
            reaction = run.reactions(self.rigid.cut)
        if not reaction.unique:
            return np.full((run.t.size, 3), np.nan)
        return np.pad(reaction.force.T, ((0, 0), (0, 3 - len(reaction.force))))

    def motion(
        self, q: Array, v: Array, f: Array | None = None, call_s: float = 0.0, stepping_s: float = 0.0
    ) -> Motion:
        """Return the motion of coordinates of the model, at the instants."""
        f = np.full((q.shape[1], 3), np.nan) if f is None else f
        return Motion(self.times[: q.shape[1]], *parts.states(self.rigid.planar, q, v), f, call_s, stepping_s)

    @cached_property
    def start_rates(self) -> dict[float, tuple[Array, Array]]:
        """Return the changes of v and w within the times of the checks, by these times."""
        spans = [0.0, *sorted({share * self.t_end for share, _ in GATES})]
        run = self.solve(REFERENCE_TOL, np.array(spans), method="DOP853", compiled=False)
        _, _, v, w = parts.states(self.rigid.planar, run.q, run.v)
        return {span: (v[k] - v[0], w[k] - w[0]) for k, span in enumerate(spans)}


def gate(loop: Loop, prepared: Prepared) -> str:
    """Say what is wrong with a model before anything is timed; an empty text if it is the mechanism."""
    rigid = loop.rigid
    bodies = rigid.model.bodies
    for what, own, given in (
        ("mass", prepared.masses, [body.inertia[0] for body in bodies]),
        ("largest moment of inertia", prepared.moments, [parts.largest_moment(body.inertia) for body in bodies]),
    ):
        for body, one, other in zip(bodies, own, given, strict=True):
            if abs(one - other) > SAME_INERTIA * other:
                return f"the {what} of {body.name!r} is {one:.6g} instead of {other:.6g}"
    wrong = ""
    for share, n_steps in GATES:
        span = share * loop.t_end
        motion = prepared.run(span, n_steps, 1)
        if motion.message:
            wrong = f"the first steps fail: {motion.message}"
            continue
        pose = max(np.abs(motion.x[0] - rigid.x).max(), np.abs(motion.R[0] - rigid.R).max())
        if pose > SAME_POSE:
            return f"the pose at the start is off by {pose:.2g}"
        gap = gaps(rigid.model, motion.x, motion.R)[-1]
        wrong = _accelerated(loop, motion, span) or (
            f"joints gape by {gap:.2g} m at the start" if gap > SAME_PLACE else ""
        )
        if not wrong:
            return ""
    return wrong


def _accelerated(loop: Loop, motion: Motion, span: float) -> str:
    """Say by how much accelerations at the start are off; angular ones at the bodies' radii of gyration."""
    dv, dw = loop.start_rates[span]
    bodies = loop.rigid.model.bodies
    size = np.array([np.sqrt(np.trace(parts.tensor(each.inertia)) / 2.0 / each.inertia[0]) for each in bodies])[:, None]
    changes = (motion.v[1] - motion.v[0], dv), (size * (motion.w[1] - motion.w[0]), size * dw)
    largest = max(float(np.abs(expected).max()) for _, expected in changes)
    for name, (change, expected) in zip(("", "angular "), changes, strict=True):
        off = np.abs(change - expected).max() / largest
        if off > SAME_ACCELERATION:
            return f"{name}accelerations at the start are off by {off:.2g} of the largest: a loop, an inertia, a motor?"
    return ""


def errors(loop: Loop, motion: Motion) -> Row:
    """Return the largest errors of a motion that reached its end, over the instants."""
    (known, _), rigid = loop.reference, loop.rigid
    off = max(np.abs(motion.x - known.x).max(), np.abs(motion.R - known.R).max())
    fastest = max(np.linalg.norm(known.v, axis=2).max(), 1e-12)
    energies = [loop.problem.energy(each.t, *parts.coordinates(each, rigid.planar)) for each in (motion, known)]
    d = 2 if rigid.planar else 3  # what holds a mechanism in its plane is not unique
    f = np.abs(motion.f - known.f)[1:, :d].max() / np.abs(known.f[:, :d]).max()  # Drake's first step holds no loop
    values = {
        "error_f": f,
        "error_q": off,
        "error_v": np.abs(motion.v - known.v).max() / fastest,
        "gap": gaps(rigid.model, motion.x, motion.R).max(),
        "energy": np.abs(energies[0] - energies[1]).max() / loop.kinetic,
    }
    return {name: float(value) for name, value in values.items()}


def timed(run: Callable[[int], Motion]) -> tuple[float, float]:
    """Return the CPU time of the shortest of some calls, whole and stepping; run(k) makes the k-th."""
    calls: list[tuple[float, float]] = []
    began = time.process_time()
    while len(calls) < TIMED and (not calls or time.process_time() - began < ENOUGH):
        motion = run(len(calls))
        calls.append((motion.call_s, motion.stepping_s))
    return min(calls)


GATE, RUN, MASS = "gate", "run", "mass"  # groups of rows
ERRORS = (1e-2, 1e-3, 1e-4, 1e-6)
PROBED = 5000  # steps of the runs with other masses
TIGHT = 1e-8  # tolerance of twoloop in these
OURS = "twoloop"  # which is compared with the engines
PROBES = {  # label: group of rows, end of the names of the mechanisms, measure
    "positions": (RUN, "", "error_q"),
    "positions, a light body": (MASS, max(LIGHTER, key=LIGHTER.__getitem__), "error_q"),
    "force in a joint": (RUN, "", "error_f"),
}


class Configuration(NamedTuple):
    """An engine with settings; those of twoloop are `compiled` of solve_dae."""

    engine: str
    name: str
    settings: Any
    everywhere: bool


NAMES = {**{key: engine.name for key, engine in engines().items()}, OURS: OURS}
CONFIGURATIONS = (
    *(
        Configuration(key, f"{engine.name}, {each.label}", each.settings, each.everywhere)
        for key, engine in engines().items()
        for each in engine.configured
    ),
    Configuration(OURS, f"{OURS}, default", "auto", True),
    Configuration(OURS, f"{OURS}, compiled=True", True, False),
)
HOW = {f"{engine.name}, {each.label}": each.how for engine in engines().values() for each in engine.configured}
DEFAULT = f"{OURS}, default"


def findings_of(rows: pd.DataFrame) -> dict[str, Any]:
    """Compare the default with the fastest engine at each error; then times, orders and silent errors of each."""
    runs, gates = rows[rows["group"] == RUN], rows[rows["group"] == GATE]
    found: dict[str, Any] = {"cases": list(dict.fromkeys(runs["case"])), "errors": list(ERRORS)}
    found |= {"exact": EXACT, "limit": LIMIT, "lost": LOST, "probed": PROBED}
    found["apart"] = float(runs["floor"].astype(float).max())
    found["absent"] = sorted(set(gates[gates["status"] == "NOT_AVAILABLE"]["family"]))
    found["versions"] = rows.dropna(subset="version").groupby("family")["version"].first().astype(str).to_dict()
    found["gates"] = gates[gates["status"] != "PASSED"][["case", "solver", "message"]].to_dict("records")
    found["n_gates"] = int((gates["status"] == "PASSED").sum())
    found["against"] = {power(error): _against(runs, error) for error in ERRORS}
    solvers = {name: DEFAULT if name == OURS else _best(runs[runs["family"] == name]) for name in NAMES.values()}
    found["best"] = best = {name: solver for name, solver in solvers.items() if solver}
    found["settings"] = {solver: HOW.get(solver, "nothing") for solver in best.values() if solver != DEFAULT}
    found["times"] = {name: _times(runs[runs["solver"] == solver]) for name, solver in best.items()}
    shown = [each.name for each in CONFIGURATIONS if each.name in best.values() or each.name.endswith("default")]
    found["configurations"] = [_configuration(name, runs[runs["solver"] == name]) for name in shown]
    found["probes"] = {label: {} for label in PROBES}
    for (label, probe), (name, solver) in product(PROBES.items(), best.items()):
        found["probes"][label][name] = _probe(rows[rows["solver"] == solver], *probe)
    return found | {"answer": _answer(found)}


def ends_of(found: dict[str, Any]) -> list[tuple[str, dict[str, Any]]]:
    """List the largest and the smallest error at which an engine and the default are compared."""
    compared = [(error, line) for error, line in found["against"].items() if line["compared"]]
    return [compared[0], compared[-1]] if compared else []


def _answer(found: dict[str, Any]) -> str:
    if not (ends := ends_of(found)):
        return "No engine and twoloop reach the same error."
    (loose, first), (tight, last) = ends
    return (
        f"For an error of {loose} twoloop is faster than every engine on {first['ahead']} of {first['compared']} "
        f"mechanisms (median {number(first['ratio'])} times), for {tight} on {last['ahead']} of {last['compared']} "
        f"({number(last['ratio'])} times)."
    )


def _cost(runs: pd.DataFrame, error: float) -> float | None:
    """Return the cost of the cheapest run on a mechanism whose error is at most this; None if there is none."""
    cost = tables.as_good(runs, error) if len(runs) else np.nan
    return cost if cost == cost else None


def _against(runs: pd.DataFrame, error: float) -> dict[str, Any]:
    """Compare the default with the fastest configuration of any engine on each mechanism.

    `ratio`: median of the engine's time over the default's. `slower`: ratios below 1, with the engine. `compared`:
    mechanisms on which an engine and the default reach the error. `fastest`: wins among engines.
    """
    ratios, fastest = {}, []
    for case, own in runs.groupby("case", sort=False):
        costs = {str(name): cost for name, each in own.groupby("solver") if (cost := _cost(each, error))}
        default = costs.get(DEFAULT)
        others = {name: cost for name, cost in costs.items() if not name.startswith(OURS)}
        if others:
            name = min(others, key=others.__getitem__)
            fastest.append(name.split(", ")[0])
            if default:
                ratios[str(case)] = others[name] / default, fastest[-1]
    values = [ratio for ratio, _ in ratios.values()]
    found: dict[str, Any] = {"compared": len(ratios), "ahead": sum(ratio > 1.0 for ratio in values)}
    found |= {"ratio": float(np.median(values)) if values else None}
    found["slower"] = {case: {"engine": name, "ratio": ratio} for case, (ratio, name) in ratios.items() if ratio <= 1.0}
    return found | {"fastest": {name: fastest.count(name) for name in sorted(set(fastest))}}


def _best(runs: pd.DataFrame) -> str | None:
    """Return the configuration that reaches most errors on most mechanisms, then the fastest; None: none does."""
    ranked = []
    for solver, own in runs.groupby("solver", sort=False):
        costs = [cost for _, each in own.groupby("case") for error in ERRORS if (cost := _cost(each, error))]
        ranked += [(-len(costs), float(np.median(costs)), str(solver))] if costs else []
    return min(ranked)[2] if ranked else None


def _times(runs: pd.DataFrame) -> dict[str, dict[str, Any]]:
    """Return the median time of a call at each error over the mechanisms on which it is reached, and their number."""
    found = {}
    for error in ERRORS:
        costs = [cost for _, own in runs.groupby("case") if (cost := _cost(own, error))]
        found[power(error)] = {"call_s": float(np.median(costs)) if costs else None, "reached": len(costs)}
    return found


def _configuration(name: str, runs: pd.DataFrame) -> dict[str, Any]:
    """Return the median order of convergence, the largest error floor, and how many runs are silently wrong."""
    ended = runs[runs["error_q"].notna()]
    orders, floors = [], []
    for _, own in ended[ended["h"].notna()].groupby("case", sort=False):
        order, floor = order_and_floor(own["h"], own["error_q"], float(own["floor"].max()))
        orders += [order] if order is not None else []
        floors += [floor] if floor is not None else []
    found: dict[str, Any] = {"name": name, "runs": len(ended), "failed": int((runs["status"] == "FAILED").sum())}
    found |= {"order": float(np.median(orders)) if orders else None, "floor": max(floors, default=None)}
    found["wrong"] = int((ended["error_q"].astype(float) > EXACT).sum())
    return found | {"lost": int((ended["error_q"].astype(float) > LOST).sum())}


def _probe(rows: pd.DataFrame, group: str, ending: str, measure: str) -> float | None:
    """Return the median error with `PROBED` steps, or tolerance `TIGHT`; None if not run, or infinite (failed)."""
    own = rows[(rows["group"] == group) & rows["case"].str.endswith(ending)]
    own = own[own["status"].isin(("REACHED_END", "FAILED"))]
    own = own[(own["n_steps"] == PROBED) | (own["tol"] == TIGHT)]
    if own.empty or measure not in own:
        return None
    value = float(own[measure].astype(float).where(own["status"] == "REACHED_END", np.inf).median())
    return value if np.isfinite(value) else None


N_STEPS = (100, 200, 500, 1500, 5000, 15_000, 50_000, 150_000)  # multiples of INSTANTS
TOLERANCES = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10, 1e-11)
# by group: steps of engines, tolerances of twoloop
VALUES: dict[str, Any] = {RUN: (N_STEPS, TOLERANCES), MASS: ((PROBED,), (TIGHT,))}
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
    text = "No engine and twoloop reach the same error"
    if ends := ends_of(found):
        (loose, first), (tight, last) = ends
        times = f"{number(last['ratio'])} times as long as twoloop (median)"
        text = f"For an error of {tight} the fastest engine takes {times}"
        if n := len(first["slower"]):
            text += f"; for {loose} an engine is faster on {n} of {first['compared']} mechanisms"
    figures.message(figure, text, panels[0])
    return {"engines": figure}


STUDY = Study("engines", __doc__, make, findings_of, figures_of)

if __name__ == "__main__":
    STUDY.main()
