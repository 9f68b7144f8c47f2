"""Which engines are run with which settings, and what their rows say: cost at equal error, orders, silent errors."""

from itertools import product
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from references.engines.rigid import engines
from studies.bench import tables
from studies.bench.closed_loops import LIGHTER
from studies.bench.end_states import EXACT
from studies.bench.engine_runs import LIMIT
from studies.bench.render import number, power
from twoloop.audit.simulator import LOST, order_and_floor

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

    `ratio`: the median of the engine's time over the default's. `slower`: where it is below 1, with the engine.
    `compared`: mechanisms on which an engine and the default reach the error. `fastest`: wins among engines.
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
    """Return the median error with `PROBED` steps, or with tolerance `TIGHT`; a failed run counts as infinite.

    None: not run, or infinite.
    """
    own = rows[(rows["group"] == group) & rows["case"].str.endswith(ending)]
    own = own[own["status"].isin(("REACHED_END", "FAILED"))]
    own = own[(own["n_steps"] == PROBED) | (own["tol"] == TIGHT)]
    if own.empty or measure not in own:
        return None
    value = float(own[measure].astype(float).where(own["status"] == "REACHED_END", np.inf).median())
    return value if np.isfinite(value) else None
