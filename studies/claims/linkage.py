"""Judges of the claims of Section 4.1: the linkage, Table 3, efficiency."""

import numpy as np
import pandas as pd

from studies.claims.introduction import BEAMS
from studies.claims.rows import DEFAULT, IRK_GROUP, NEWMARK_GROUP, NotRun, Rows, common_costs
from studies.claims.verdicts import Judgement, grade, span
from studies.metrics import ASTRAY
from studies.solvers import GEAR_ORDERS, IRK, IRK_LINE, NEWMARK, QUARTER, gear
from studies.table3_causes import FLAT, PAPER_IRK, PAPER_NEWMARK, TOLERANCES, cells
from studies.table3_causes import span as widest

PASSES = 1e-3  # m above 0 from which y3 passes the line, and below it to which it reaches it
VISIBLE = 0.01  # m, about the width of a line in a figure of the motion
STEP = 0.02  # s
NEAR = 1.5  # factor within which a ratio counts as the printed one
MAIN = 2.0  # times a logarithm must exceed another for its tolerance to be the one that governs
CHANGE = 1.1  # times the steps: a tolerance affects them
LAST = TOLERANCES[-1]
PRINTED_RATIO = float(PAPER_NEWMARK[3][3] or 0.0) / PAPER_IRK[3][3]  # 50.93 s over 3.60 s
ERRORS = (0.3, 0.1, 0.03, 0.01)  # m or rad, of the linkage over the run
TIPS = (1e-2, 1e-3, 1e-4)  # m, of the beams
FOIL = (1e-2, 1e-3, 1e-4)  # m or rad, at which the stand-in is compared


def agree_and_reach(rows: Rows) -> Judgement:
    runs = rows.long("motion", solver=(IRK, NEWMARK), group="line-up")
    agree = (runs["error_y3_short"] < VISIBLE).all()
    met = (runs["top"] < PASSES) & (runs["top_late"] > -PASSES)
    values = {"short": float(runs["error_y3_short"].max())}
    values |= {"late": float(1e3 * runs["top_late"].min()), "top": float(1e3 * runs["top"].max())}
    return Judgement(grade(agree and met.all(), agree and met.any()), values)


def gstiff(rows: Rows, part: str) -> Judgement:
    """The statements on Gstiff, of orders for which all are true: its order is not told."""
    met: dict[str, set[int]] = {"short": set(), "long": set()}
    for order in GEAR_ORDERS:
        runs = rows.long("motion", group="GSTIFF stand-in", solver=gear(order))
        coarse, fine = (rows.first(runs[runs["h"] == h], f"{gear(order)} with h = {h:g}") for h in (STEP, STEP / 2))
        # written so that a failed run is off, too
        if not coarse["error_y3_short"] <= VISIBLE and fine["error_y3_short"] <= VISIBLE:
            met["short"].add(order)
        if not fine["error_y3"] <= ASTRAY * fine["range_y3"]:
            met["long"].add(order)
    together = len(met["short"] & met["long"])
    return Judgement(grade(together), {"orders": len(met[part]), "of": len(GEAR_ORDERS), "together": together})


def stand_in_as_foil(rows: Rows) -> Judgement:
    ours = rows.long("table3", solver=IRK_LINE, problem=DEFAULT)
    theirs = rows.long("motion", group="GSTIFF stand-in", solver=gear(5))
    ratios = common_costs(theirs, ours, FOIL, "cpu_s")
    return Judgement(grade(min(ratios) > 1.0, max(ratios) > 1.0), {"ratio": span(ratios)})


def large_steps(rows: Rows) -> Judgement:
    runs = rows.long("step_size", solver=(IRK, NEWMARK, QUARTER), group="paper").groupby("solver").first()
    share, ratios = float(runs["share_time"][IRK]), runs["h_median"][IRK] / runs["h_median"].drop(IRK)
    met = [share > 0.5, bool((ratios > 1.0).all())]
    return Judgement(grade(all(met), any(met)), {"share": 100.0 * share, "ratio": span(ratios)})


def _influence(rows: Rows, group: str, what: str, coarsest: float) -> tuple[float, float]:
    """Mean factors in `what` from `coarsest` to 1e-9: of err_in at every err_out from there on, and the reverse."""
    out = [e for e in TOLERANCES if e <= coarsest]
    by_in = [rows.cell(group, LAST, e)[what] / rows.cell(group, coarsest, e)[what] for e in out]
    by_out = [rows.cell(group, e, LAST)[what] / rows.cell(group, e, coarsest)[what] for e in out]
    return tuple(float(np.exp(np.log(np.asarray(each, dtype=float)).mean())) for each in (by_in, by_out))  # type: ignore[return-value]


def newmark_tolerances(rows: Rows) -> Judgement:
    by_in, by_out = _influence(rows, NEWMARK_GROUP, "cpu_s", 1e-5)
    return Judgement(grade(np.log(by_out) > MAIN * abs(np.log(by_in))), {"by_out": by_out, "by_in": by_in})


def irk_tolerances(rows: Rows) -> Judgement:
    by_in, by_out = _influence(rows, IRK_GROUP, "cpu_s", 1e-3)
    return Judgement(grade(by_in > max(by_out, 1.0 / by_out)), {"by_in": by_in, "by_out": by_out})


def tolerances_and_steps(rows: Rows) -> Judgement:
    changes = {}
    for name, group in (("irk", IRK_GROUP), ("newmark", NEWMARK_GROUP)):
        finest = rows.cell(group, LAST, LAST)["n_steps"]
        changes[f"{name}_in"] = float(finest / rows.cell(group, TOLERANCES[0], LAST)["n_steps"])
        changes[f"{name}_out"] = float(finest / rows.cell(group, LAST, TOLERANCES[0])["n_steps"])
    affected = [max(change, 1.0 / change) > CHANGE for change in changes.values()]
    return Judgement(grade(all(affected), any(affected)), {"affected": sum(affected), **changes})


def newmark_star(rows: Rows) -> Judgement:
    runs = rows.cells(NEWMARK_GROUP, problem=DEFAULT)
    coarse, fine = runs[runs["err_out"] == TOLERANCES[0]], runs[runs["err_out"] < TOLERANCES[0]]
    values = {"lost": int(coarse["lost"].sum()), "cells": len(coarse), "fine_lost": int(fine["lost"].sum())}
    values |= {"fine": len(fine), "astray": int(fine["astray"].sum())}
    return Judgement(grade(coarse["lost"].all() and not fine["lost"].any()), values)


def irk_star(rows: Rows) -> Judgement:
    runs = rows.cells(IRK_GROUP, problem=DEFAULT, err_out=TOLERANCES[0])
    good = ~runs["lost"] & ~runs["astray"] & (runs["y3_max"] < PASSES)
    values = {"astray": int(runs["astray"].sum()), "cells": len(runs), "error": float(runs["error_q"].max())}
    return Judgement(grade(good.all()), values | {"top": float(1e3 * runs["y3_max"].max())})


def fourteen_times(rows: Rows) -> Judgement:
    times, evaluations = [], []
    for problem in dict.fromkeys(rows.cells(IRK_GROUP)["problem"]):
        slow, fast = (rows.cell(group, LAST, LAST, problem) for group in (NEWMARK_GROUP, IRK_GROUP))
        times.append(slow["cpu_s"] / fast["cpu_s"])
        evaluations.append(slow["n_evaluations"] / fast["n_evaluations"])
    values = {"time": times[0], "evaluations": evaluations[0]}
    return Judgement(grade(min(times + evaluations) >= PRINTED_RATIO / NEAR), values)


def _newmark_over_irk(rows: Rows) -> dict[str, list[float]]:
    """CPU time of Newmark, both beta, over Runge-Kutta's at equal error: linkage, and both beams."""
    runs = rows.long("table3")
    fine = runs[runs["err_in"].isna() | (runs["err_in"] == LAST)]
    ratios: dict[str, list[float]] = {"linkage": [], "soft": [], "stiff": []}
    for problem in dict.fromkeys(runs["problem"]):
        here = fine[fine["problem"] == problem]
        for name in (NEWMARK, QUARTER):
            one, other = here[here["solver"] == name], here[here["solver"] == IRK_LINE]
            if one.empty or other.empty:
                raise NotRun(f"table3.csv lacks {name} or {IRK_LINE}")
            ratios["linkage"] += common_costs(one, other, tuple(e for e in ERRORS if e < one["error_q"].max()), "cpu_s")
    for key, case in zip(("soft", "stiff"), BEAMS, strict=True):
        for name in (NEWMARK, QUARTER):
            ratios[key] += common_costs(rows.beam(case, name), rows.beam(case, IRK), TIPS, "cpu_s")
    return ratios


def more_efficient(rows: Rows) -> Judgement:
    ratios = _newmark_over_irk(rows)
    won = [min(each) > 1.0 for each in ratios.values()]
    return Judgement(grade(all(won), any(won)), {name: span(each) for name, each in ratios.items()})


def because_of_order(rows: Rows) -> Judgement:
    found = {}
    for name, solver, order in (("irk", IRK_LINE, 5), ("newmark", NEWMARK, 2), ("quarter", QUARTER, 2)):
        runs = rows.long("table3", solver=solver, problem=DEFAULT)
        runs = runs[(runs["err_in"].isna() | (runs["err_in"] == LAST)) & ~runs["astray"]]
        if runs["error_q"].nunique() < 2:
            raise NotRun(f"fewer than two runs of {solver} follow the motion")
        x, y = np.log(1.0 / runs["error_q"].astype(float)), np.log(runs["n_evaluations"].astype(float))
        found[name] = (float(np.polyfit(x, y, 1)[0]), order)
    near = all(abs(p * order - 1.0) < 0.25 for p, order in found.values())
    least = found["irk"][0] < min(found["newmark"][0], found["quarter"][0])
    won = [min(each) > 1.0 for each in _newmark_over_irk(rows).values()]
    values = {name: p for name, (p, _) in found.items()} | {"won": sum(won), "cases": len(won)}
    return Judgement(grade(near and least and all(won), least and any(won)), values)


def table_3_seconds(rows: Rows) -> Judgement:
    runs: pd.DataFrame = rows.long("table3", problem=DEFAULT)
    table = cells(runs)
    if table.empty:
        raise NotRun("table3.csv has no cells of Table 3")
    over = (table["paper"] / table["cpu_s"]).groupby(table["group"])
    values = {"irk": span(over.get_group(IRK_GROUP)), "newmark": span(over.get_group(NEWMARK_GROUP))}
    return Judgement(grade(widest(table["paper"] / table["cpu_s"]) <= FLAT), values)


def works_long(rows: Rows) -> Judgement:
    run = rows.long("motion", solver=IRK, group="line-up").iloc[0]
    values = {"error": float(run["error_y3"]), "energy": float(abs(run["energy"])), "kinetic": float(run["kinetic"])}
    return Judgement(grade(not run["lost"] and not run["astray"]), values)
