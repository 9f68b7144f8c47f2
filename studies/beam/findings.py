"""What the beam report says, computed from the medians of its rows."""

from typing import Any

import numpy as np
import pandas as pd

from studies import tables
from studies.beam.growth import MESH, PARAMETERS, PARTING, START, TOLERANCE
from studies.beam.limits import GAUSS_SEIDEL, JACOBI
from studies.beam.runs import (
    DIFFERENCES,
    EXPLICIT,
    EXUDYN,
    NEWTON,
    NEWTON_4,
    NEWTON_5,
    NEWTON_GAUSS,
    PAPER,
    PAPER_TOL,
    by_tip,
)
from studies.cases.beam import SOFT, STIFF
from studies.cli import StudyError
from studies.solvers import IDA_C, IDA_C_ORDER_2, NEWMARK, OWN_EXPLICIT, QUARTER

TARGETS = (1e-2, 1e-3, 1e-4)  # m, of the tip's height
PAPER_SECONDS = {SOFT: 56.27, STIFF: 6278.54}  # the computation times that the paper gives
PAPER_STEPS = {SOFT: 1e-3, STIFF: 1e-5}  # s, its step sizes by order of magnitude
EXPLICIT_SOLVERS = (OWN_EXPLICIT, EXPLICIT)
NEWTONS = (NEWTON, NEWTON_4, NEWTON_5, NEWTON_GAUSS)
STIFF_E = 2e8  # N/m^2


def findings_of(rows: pd.DataFrame) -> dict[str, Any]:
    """All findings; `rows` are medians."""
    runs = by_tip(rows)
    w_max = {case: float(part["straight"].iloc[0]) for case, part in _of(rows, "along").groupby("case")}
    found: dict[str, Any] = {
        "targets": list(TARGETS),
        "parting": PARTING,
        "t_end": float(runs["t_end"].iloc[0]),
        "cases": [_case(rows, runs[runs["case"] == case], case, w_max[case]) for case in (SOFT, STIFF)],
    }
    soft, stiff = (case["paper"] for case in found["cases"])
    growth = {f"growth_{key}": stiff[key] / soft[key] for key in ("n_evaluations", "cpu_s")}
    found |= growth | {
        "growth_paper": PAPER_SECONDS[STIFF] / PAPER_SECONDS[SOFT],
        "growth_w_max": w_max[STIFF] / w_max[SOFT],
    }
    found["growth_as_frequency"] = bool(0.5 < growth["growth_n_evaluations"] / found["growth_w_max"] < 2.0)
    found["n_failed"], found["n_runs"] = int((runs["status"] != "REACHED_END").sum()), len(runs)
    return found | _limits(rows) | _growth(rows)


def _of(rows: pd.DataFrame, group: str, **equal: Any) -> pd.DataFrame:
    found = rows[rows["group"] == group]
    for column, value in equal.items():
        found = found[found[column] == value]
    if found.empty:
        raise StudyError(f"the rows lack those of group {group!r}; make them again by python -m studies.beam")
    return found


def _case(rows: pd.DataFrame, runs: pd.DataFrame, name: str, w_max: float) -> dict[str, Any]:
    paper = _of(runs, "run", solver=PAPER, tol=PAPER_TOL).iloc[0]
    attempts = float(paper["n_steps"] + paper["n_rejected"])
    ours: dict[str, Any] = {
        key: float(paper[key]) for key in ("n_steps", "n_evaluations", "cpu_s", "h_median", "h_max")
    }
    ours |= {"error": paper["error_tip"], "status": paper["status"], "floor": float(paper["floor"])}
    ours |= {"x_median": float(paper["h_median"]) * w_max, "x_max": float(paper["h_max"]) * w_max}
    ours |= {"given_up": float(paper["n_rejected_convergence"]) / attempts, "printed_s": PAPER_SECONDS[name]}
    ours["steps_as_printed"] = bool(10**-0.5 < ours["h_median"] / PAPER_STEPS[name] < 10**0.5)
    ours["printed_h"] = PAPER_STEPS[name]
    found: dict[str, Any] = {"name": name, "w_max": w_max, "t_end": float(paper["t_end"]), "paper": ours}
    found["figure"] = f"beam_{name.replace(' ', '_')}.png"
    found["at"] = [at(runs[runs["solver"] != EXUDYN], error) for error in TARGETS]
    known = [line for line in found["at"] if line["newmark_over_paper"] is not None]
    found["newmark_cheaper"] = [line["error"] for line in known if line["newmark_over_paper"] < 1.0]
    found["newmark_dearer"] = [line["error"] for line in known if line["newmark_over_paper"] >= 1.0]
    found["exudyn"] = _exudyn(runs[runs["solver"] == EXUDYN])
    return found | _sensitivity(rows, name)


def at(runs: pd.DataFrame, error: float) -> dict[str, Any]:
    """Who is cheapest at one error on one beam: of all, of ours, of others, of IDA, among implicit methods."""
    ranked = tables.ranking(runs, error)
    kinds = ("best", "ours", "others", "implicit", "newton", "ida")
    numbers = ("paper_s", "paper_over_best", "newmark_over_paper", "ida_default_s", "ida_best_s", "differences_s")
    found: dict[str, Any] = {"error": error, **dict.fromkeys((*kinds, *numbers, "ida_over_ours"))}
    if ranked.empty:
        return found
    own, implicit = ranked["family"] == "two-loop", ~ranked["solver"].isin(EXPLICIT_SOLVERS)
    found |= {"best": _first(ranked), "ours": _first(ranked[own]), "others": _first(ranked[~own])}
    found |= {"implicit": _first(ranked[implicit]), "newton": _first(ranked[ranked["solver"].isin(NEWTONS)])}
    found["ida"] = _first(ranked[ranked["solver"].isin((IDA_C, IDA_C_ORDER_2))])
    seconds = dict(zip(ranked["solver"], ranked["cpu_s"], strict=True))
    found |= {"ida_default_s": seconds.get(IDA_C), "ida_best_s": seconds.get(IDA_C_ORDER_2)}
    found |= {"differences_s": seconds.get(DIFFERENCES), "paper_s": seconds.get(PAPER)}
    if found["ida"] is not None and found["ours"] is not None:
        found["ida_over_ours"] = found["ida"]["cpu_s"] / found["ours"]["cpu_s"]
    if PAPER in seconds:
        found["paper_over_best"] = seconds[PAPER] / float(ranked["cpu_s"].iloc[0])
        newmark = [seconds[name] for name in (NEWMARK, QUARTER) if name in seconds]
        found["newmark_over_paper"] = min(newmark) / seconds[PAPER] if newmark else None
    return found


def _exudyn(runs: pd.DataFrame) -> dict[str, Any] | None:
    """Exudyn's least error on its own cable, and the time of that run; None where it was not run."""
    reached = runs[runs["error_tip"].notna()]
    if reached.empty:
        return None
    best = reached.loc[reached["error_tip"].astype(float).idxmin()]
    within = [{"error": error, "cpu_s": tables.time_for(reached, error)} for error in TARGETS]
    found = {"error": best["error_tip"], "cpu_s": best["cpu_s"], "floor": best["floor"]}
    return found | {"at": [line for line in within if np.isfinite(line["cpu_s"])]}


def _first(ranked: pd.DataFrame) -> dict[str, Any] | None:
    if ranked.empty:
        return None
    line = ranked.iloc[0]
    family = "ours" if line["family"] == "two-loop" else str(line["family"])
    explicit = bool(line["solver"] in EXPLICIT_SOLVERS)
    keys = ("cpu_s", "n_evaluations")
    return {"solver": line["solver"], "family": family, "explicit": explicit, **{key: float(line[key]) for key in keys}}


def _sensitivity(rows: pd.DataFrame, name: str) -> dict[str, Any]:
    found = _of(rows, "sensitivity", case=name).set_index("solver")["largest"].astype(float)
    parameter = float(found[list(PARAMETERS)].max())
    return {
        "changes": found.to_dict(),
        "parameter_change": parameter,
        "mesh_change": float(found[MESH]),
        "start_change": float(found[START]),
        "tolerance_change": float(found[TOLERANCE]),
        "mesh_more": bool(found[MESH] > parameter),
        "start_more": bool(found[START] > parameter),
        "below_mesh": [error for error in TARGETS if error < found[MESH]],
    }


def _limits(rows: pd.DataFrame) -> dict[str, Any]:
    """The limits of fixed-point iteration, and what accepted steps have to do with them."""
    limits = _of(rows, "limit").set_index("solver")
    found: dict[str, Any] = {
        "jacobi": float(limits["theory"][JACOBI]),
        "gauss_seidel": float(limits["theory"][GAUSS_SEIDEL]),
    }
    found |= {"free": float(limits["free"][GAUSS_SEIDEL]), "linearised": float(limits["measured"][GAUSS_SEIDEL])}
    found["gauss_seidel_shorter"] = found["gauss_seidel"] < found["jacobi"]
    tests = _of(rows, "growth test")
    reached = tests["measured"].to_numpy(float)
    found |= {"test_tols": [float(tests["tol"].max()), float(tests["tol"].min())]}
    found |= {"test_limits": [float(reached.max()), float(reached.min())]}
    found["test_no_limit"] = bool(reached.min() < 0.5 * reached.max())
    found["along"] = []
    for case in (SOFT, STIFF):
        part = _of(rows, "along", case=case)
        limit = part["measured"].to_numpy(float)
        ratio = part["w_max"].to_numpy(float) / part["straight"].to_numpy(float)
        paper = _of(rows, "run", case=case, solver=PAPER, tol=PAPER_TOL).iloc[0]
        accepted = float(paper["h_median"] * part["straight"].iloc[0])
        low, middle, high = (float(x) for x in np.percentile(limit[1:], (25, 50, 75)))
        line = {"case": case, "start": float(limit[0]), "low": low, "median": middle, "high": high, "n": len(limit) - 1}
        line |= {"w_low": float(ratio.min()), "w_high": float(ratio.max()), "accepted": accepted}
        line["explains"] = bool(accepted <= middle and found["linearised"] < middle)
        found["along"].append(line)
    found["reconciled"] = found["test_no_limit"] and all(line["explains"] for line in found["along"])
    return found


def _growth(rows: pd.DataFrame) -> dict[str, Any]:
    """From few elements to many, and from a soft beam to a stiff one."""
    elements = _of(rows, "elements").assign(each=lambda part: part["cpu_s"] / part["n_steps"])
    found: dict[str, Any] = {"elements": [int(elements["n_elements"].min()), int(elements["n_elements"].max())]}
    for kind in ("banded", "dense"):
        each = elements[elements["solver"] == kind].sort_values("n_elements")["each"].to_numpy(float)
        found[f"{kind}_growth"] = float(each[-1] / each[0])
    most = elements[elements["n_elements"] == found["elements"][1]].set_index("solver")["each"]
    found["dense_over_banded"] = float(most["dense"] / most["banded"])
    modulus = _of(rows, "modulus")
    stiffest = float(modulus["modulus"].max())
    newton = modulus[modulus["solver"] == NEWTON]
    counts = [
        tables.time_for(newton[newton["modulus"] == E], TARGETS[-1], "n_evaluations") for E in (STIFF_E, stiffest)
    ]
    paper = modulus[modulus["solver"] == PAPER].set_index("modulus")
    each = paper["n_evaluations"] / paper["t_end"]
    found |= {"modulus": [STIFF_E, stiffest], "newton_stiffness_growth": counts[1] / counts[0]}
    found["paper_stiffness_growth"] = float(each[stiffest] / each[STIFF_E])
    found["newton_flat"] = bool(found["newton_stiffness_growth"] < 2.0)
    return found
