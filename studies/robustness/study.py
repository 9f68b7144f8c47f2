"""Random linkages, sizes, masses and long runs: no answer of ours may be wrong and silent."""

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from studies.bench.apart import apart
from studies.bench.names import label
from studies.bench.random_linkages import KINDS, PLACES, draw, end_of_scaled, scaled
from studies.bench.render import power
from studies.bench.sharp_motion import RIGHT, SAID, SILENT, graded
from studies.bench.store import Array, Row
from studies.bench.study import Study, kept_rows
from studies.robustness import sharp_runs
from twoloop import solve_dae
from twoloop.mechanisms import Problem, four_bar

METHODS = ("auto", "Taylor", "Adams", "DOP853", "Gauss12", "RadauIIA5", "BDF")
QUICK_METHODS = ("DOP853", "Gauss12", "BDF")
TOLERANCE = 1e-8  # rtol and atol of all runs
LOOSENESS = 1e3  # an answer is right within so many tolerances, times the sensitivity of the end to the start
TIME_LIMIT = 10.0  # s
T_END = 5.0  # s; of a size s it is times sqrt(s)
SEED = 2016
N_LINKAGES, N_QUICK = 100, 2  # of each kind
SIZES = tuple(10.0**k for k in (-15, -12, -9, -6, -3, 0, 3, 6, 9, 12, 15))
DENSITIES = tuple(10.0**k for k in (-15, -10, -5, 0, 5, 10, 15))  # kg/m, of all bars
RATIOS = tuple(10.0**k for k in (-10, -8, -5, 5, 8, 10))  # of bar 2 to the others
LONG_STEP, LONG_STEPS, LONG_QUICK = 1e-3, (100_000, 1_000_000), (2_000, 10_000)  # s, largest step; their numbers
STATES = 1000  # states of a long run that are stored
GROWS = 10.0  # times, from the first tenth of a run to the last: then the violation grows
LONG_LIMIT = 600.0  # s


def measured(problem: Problem, method: str, t_end: float, truth: Array, unit: Array, allowed: float) -> Row:
    """A run and its outcome: the error is the largest of those of the coordinates, each over its unit."""
    options: dict[str, Any] = {"rtol": TOLERANCE, "atol": TOLERANCE, "time_limit": TIME_LIMIT}
    start = problem.system, (0.0, t_end), problem.q0, problem.v0
    made = graded(
        lambda: solve_dae(*start, method, **options),
        lambda result: float(np.abs((result.q[:, -1] - truth) / unit).max()),
        allowed,
    )
    return {"method": method} | made


def linkages(quick: bool) -> Iterator[sharp_runs.Part]:
    """Key and rows of every linkage; those without a known motion are drawn again and counted."""

    def rows(kind: str, seed: list[int]) -> list[Row]:
        generator, drawn, empty = np.random.default_rng(seed), None, 0
        while drawn is None:
            drawn, empty = draw(kind, generator, T_END), empty + 1
        allowed = LOOSENESS * TOLERANCE * max(1.0, drawn.sensitivity)
        about = {"group": "linkage", "what": kind, "value": float(seed[-1]), "name": drawn.problem.name}
        about |= {"theta3": drawn.problem.parameters["theta3"], "branch": drawn.problem.parameters["branch"]}
        about |= {"sensitivity": drawn.sensitivity, "n_redrawn": empty - 1}
        methods = QUICK_METHODS if quick else METHODS
        return [about | measured(drawn.problem, name, T_END, drawn.q, np.ones(9), allowed) for name in methods]

    for k in range(N_QUICK if quick else N_LINKAGES):
        for place, kind in enumerate(KINDS):
            yield f"linkage {kind} {k}", partial(rows, kind, [SEED, place, k])


def scales(quick: bool) -> Iterator[sharp_runs.Part]:
    """Key and rows of every size and mass."""

    def rows(group: str, value: float) -> list[Row]:
        size = value if group == "size" else 1.0
        bar = value if group == "density" else 1.0
        densities = (bar, value if group == "ratio" else bar, bar)
        problem, t_end = scaled(size, densities), T_END * np.sqrt(size)
        unit = np.ones(9)
        unit[PLACES] = size
        truth = end_of_scaled(size, (1.0, densities[1] / bar, 1.0), t_end)
        about = {"group": group, "what": group, "value": value, "name": problem.name}
        allowed = LOOSENESS * TOLERANCE
        methods = QUICK_METHODS if quick else METHODS
        return [about | measured(problem, name, t_end, truth, unit, allowed) for name in methods]

    for group, values in (("size", SIZES), ("density", DENSITIES), ("ratio", RATIOS)):
        for value in values[:: 5 if quick else 1]:
            yield f"{group} {value:g}", partial(rows, group, value)


def resident() -> int:
    """Memory of this process, bytes."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


def long_run(method: str, n_steps: int) -> Row:
    """A run of so many steps at least; what its constraints, its energy and its memory do.

    Call it in a process of its own: memory that an earlier run has given back would hide what this one takes.
    """
    problem = four_bar()
    system, t_end = problem.system, n_steps * LONG_STEP
    options: dict[str, Any] = {"rtol": TOLERANCE, "atol": TOLERANCE, "max_step": LONG_STEP, "time_limit": LONG_LIMIT}
    times = np.linspace(0.0, t_end, STATES + 1)
    start = (problem.q0, problem.v0, method)
    solve_dae(system, (0.0, 1.0), *start, **options, t_eval=times[times < 1.0])  # what is loaded once
    before = resident()
    result = solve_dae(system, (0.0, t_end), *start, **options, t_eval=times)
    row: Row = {"group": "long", "what": "long", "method": method, "value": float(n_steps), "name": problem.name}
    row |= {"status": result.status.name, "message": result.message, "outcome": RIGHT if result.success else SAID}
    row |= {"n_steps": result.h.size, "bytes_a_step": (resident() - before) / max(1, result.h.size)}
    states = list(zip(result.t, result.q.T.copy(), result.v.T.copy(), strict=True))
    sizes = {
        "q": [float(np.abs(system.constraint(t, q)).max()) for t, q, _ in states],
        "v": [float(np.abs(system.velocity_constraint(t, q, v)).max()) for t, q, v in states],
    }
    energy = np.abs(problem.energy(result.t, result.q, result.v) - problem.energy(0.0, problem.q0, problem.v0))
    tenth = max(1, len(states) // 10)
    for level, size in sizes.items():
        row |= {f"first_{level}": max(size[:tenth]), f"last_{level}": max(size[-tenth:])}
    return row | {"energy": float(energy.max())}


def long_runs(quick: bool) -> Iterator[sharp_runs.Part]:
    """Key and row of every long run, each made in a process of its own."""
    for method in QUICK_METHODS if quick else METHODS:
        for n in LONG_QUICK if quick else LONG_STEPS:
            yield f"long {method} {n}", partial(lambda *run: [apart(partial(long_run, *run))], method, n)


def counts_of(own: pd.DataFrame) -> dict[str, Any]:
    """Outcomes, and the largest share of the allowed error of runs that reach the end."""
    done = own[own["error"].notna()]
    found: dict[str, Any] = {what: int((own["outcome"] == what).sum()) for what in (RIGHT, SAID, SILENT)}
    share = (done["error"] / done["allowed"]).astype(float)
    found["median"], found["worst"] = (float(done["error"].median()), float(share.max())) if len(done) else (None, None)
    return found


def limits_of(own: pd.DataFrame) -> dict[str, Any]:
    """Smallest and largest value from which and to which all of a method's runs are right, about 1."""
    good = (own["outcome"] == RIGHT).groupby(own["value"]).all()  # in the order of the values
    found: dict[str, Any] = {}
    for end, outwards in (("low", good[good.index <= 1.0][::-1]), ("high", good[good.index >= 1.0])):
        reached = outwards.index[outwards.cummin()]
        found[end] = float(reached[-1]) if len(reached) else None
    return found | {"said": sorted({str(x) for x in own[own["outcome"] == SAID]["status"]})}


def alike(limits: dict[str, dict[str, dict[str, Any]]]) -> list[dict[str, Any]]:
    """Lines of a table, one for all methods with the same limits of each group."""
    methods: dict[tuple[str, ...], list[str]] = {}
    for name in next(iter(limits.values())):
        methods.setdefault(tuple(_said(own[name]) for own in limits.values()), []).append(name)
    return [
        {"methods": ", ".join(label(name, coded=False) for name in names), "limits": list(line)}
        for line, names in methods.items()
    ]


def _said(line: dict[str, Any]) -> str:
    if line["low"] is None or line["high"] is None:
        return "–"
    beyond = f" ({', '.join(line['said']).lower()})" if line["said"] else ""
    return f"{power(line['low'])} … {power(line['high'])}{beyond}"


def findings_of(rows: pd.DataFrame) -> dict[str, Any]:
    drawn, long = rows[rows["group"] == "linkage"], rows[rows["group"] == "long"]
    silent = rows[(rows["outcome"] == SILENT) & (rows["group"] != sharp_runs.SHARP)]
    found: dict[str, Any] = {"tolerance": TOLERANCE, "looseness": LOOSENESS, "t_end": T_END, "grows": GROWS}
    found["n_linkages"] = len(drawn.groupby(["what", "value"]))
    found["n_redrawn"] = int(drawn.drop_duplicates(["what", "value"])["n_redrawn"].sum())
    found["sensitivity"], found["allowed"] = float(drawn["sensitivity"].max()), float(drawn["allowed"].max())
    beyond = drawn[drawn["outcome"].eq(RIGHT) & (drawn["error"] > LOOSENESS * TOLERANCE)]
    found["beyond"] = {"n": len(beyond), "of": int(drawn["outcome"].eq(RIGHT).sum())}
    found["beyond"] |= {"default": int(beyond["method"].eq("auto").sum())}
    found["sharp"] = sharp_runs.counts(rows[rows["group"] == sharp_runs.SHARP])
    stopped = drawn[drawn["outcome"] == SAID]
    found["n_stopped"], found["n_stopped_rank"] = len(stopped), int(stopped["message"].str.contains("rank").sum())
    kinds = drawn.groupby(["method", "what"], sort=False)
    found["linkages"] = [{"method": name, "kind": kind, **counts_of(own)} for (name, kind), own in kinds]
    found["silent"] = silent[["group", "what", "value", "method", "error", "allowed"]].to_dict("records")
    limits = {
        group: {name: limits_of(own) for name, own in rows[rows["group"] == group].groupby("method", sort=False)}
        for group in ("size", "density", "ratio")
    }
    found["scales"] = alike(limits)
    told = ["method", "n_steps", "first_q", "last_q", "first_v", "last_v", "energy"]
    longest = long[long["value"] == long["value"].max()]
    grow = (longest["last_q"] > GROWS * longest["first_q"]) | (longest["last_v"] > GROWS * longest["first_v"])
    found["long"] = longest[told].assign(bytes=longest["bytes_a_step"], grows=grow).to_dict("records")
    found["long_grow"] = [line["method"] for line in found["long"] if line["grows"]]
    found["most_bytes"] = max(line["bytes"] for line in found["long"])
    ends = pd.DataFrame(limits["size"].values())[["low", "high"]].astype(float)
    sizes = [float(ends["low"].max()), float(ends["high"].min())]
    found["sizes"] = sizes if ends.notna().all(axis=None) and sizes[0] <= sizes[1] else None
    return found | {"least_steps": min(line["n_steps"] for line in found["long"])}


STUDY = Study("robustness", __doc__, kept_rows(linkages, sharp_runs.random_mechanisms, scales, long_runs), findings_of)
