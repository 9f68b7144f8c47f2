"""Judges of the claims of Sections 1 and 2: other methods, constraints, Jacobians."""

from studies.claims.rows import DEFAULT, IRK_GROUP, Rows, common_costs, cost
from studies.claims.verdicts import Judgement, grade, span
from studies.solvers import IRK

GROWTH = 10.0  # of the violation from the first tenth of a run to its last: it drifts
SATISFIED = 1e-12  # violation that counts as rounding
GROWS, TIMES = 0.25, 2.0  # a violation grows if it goes as t^p with a greater p and ends above TIMES its beginning
TARGETS = (1e-1, 1e-2, 1e-3, 1e-4)  # m or rad, errors over the run at which costs are compared
DEARER = 1.2  # times the cost: beyond the noise of times
TIP = 1e-4  # m, tip error at which methods are compared on the beams
EXPLICIT = ("DOP853, projected", "DOP853 (two-loop)")
BEAMS = ("very flexible", "moderately stiff")


def index_1_drifts(rows: Rows) -> Judgement:
    runs = rows.long("table3", solver=("DOP853, index 1", "LSODA, index 1", "IDA, index1"), problem=DEFAULT)
    growth = runs["violation_late"] / runs["violation_early"]
    values = {"growth": span(growth), "violation": span(runs["violation_q"])}
    return Judgement(grade((growth > GROWTH).all(), (growth > GROWTH).any()), values)


def low_index_on_index_3(rows: Rows) -> Judgement:
    runs = rows.long("motion", group="GSTIFF stand-in")
    runs = runs[~runs["solver"].str.contains("ramp")]
    good = (runs["status"] == "REACHED_END") & ~runs["astray"]
    least = float(runs[good]["error_y3"].min()) if good.any() else 0.0
    return Judgement(grade(not good.any()), {"good": int(good.sum()), "runs": len(runs), "least": least})


def baumgarte_inexact(rows: Rows) -> Judgement:
    runs = rows.long("violation", group=("line-up", "tolerances"))
    runs = runs[runs["solver"].str.contains("Baumgarte")]
    rows.first(runs, "Baumgarte's stabilisation")
    size = runs["violation_q"].astype(float)
    off = size > SATISFIED
    return Judgement(grade(off.all(), off.any()), {"violation": span(size), "off": int(off.sum()), "runs": len(size)})


def projection_exact(rows: Rows) -> Judgement:
    runs = {name: rows.long("table3", solver=name) for name in ("DOP853, projected", "IDA, stabilised")}
    projected, multipliers = (float(each["violation_q"].max()) for each in runs.values())
    exact = [projected < SATISFIED, multipliers < SATISFIED]
    return Judgement(grade(all(exact), any(exact)), {"multipliers": multipliers, "projected": projected})


def projection_inefficient(rows: Rows) -> Judgement:
    ratios: list[float] = []
    for with_it, without in (("IDA, stabilised", "IDA, index1"), ("DOP853, projected", "DOP853, index 1")):
        one, other = (rows.long("table3", solver=name, problem=DEFAULT) for name in (with_it, without))
        for what in ("n_evaluations", "cpu_s"):
            ratios += common_costs(one, other, TARGETS, what)
    dearer = [ratio > DEARER for ratio in ratios]
    return Judgement(grade(all(dearer), any(dearer)), {"ratio": span(ratios)})


def constraints_kept(rows: Rows) -> Judgement:
    run = rows.long("violation", solver=IRK, group="line-up").iloc[0]
    levels = [float(run[f"violation_{level}"]) for level in "qva"]
    grows = run["growth_q"] > GROWS and run["late_q"] > TIMES * run["early_q"]
    loosest = rows.cells(IRK_GROUP, problem=DEFAULT)["violation_q"].max()
    values = {"levels": max(levels), "positions": levels[0], "exponent": float(run["growth_q"]), "loosest": loosest}
    return Judgement(grade(max(levels) < SATISFIED and not grows), values)


def jacobian_difficult(rows: Rows) -> Judgement:
    soft, stiff = ([cost(rows.beam(case, words), TIP) for words in ("differences", IRK)] for case in BEAMS)
    dearer = [newton > paper for newton, paper in (soft, stiff)]
    values = {"stiff": stiff[0], "stiff_paper": stiff[1], "soft": soft[0], "soft_paper": soft[1]}
    return Judgement(grade(all(dearer), any(dearer)), values)


def implicit_needed(rows: Rows) -> Judgement:
    ratios = []
    for case in BEAMS:
        explicit = (cost(rows.beam(case, name), TIP, "n_evaluations") for name in EXPLICIT)
        ratios.append(min(explicit) / cost(rows.beam(case, IRK), TIP, "n_evaluations"))
    return Judgement(grade(min(ratios) > 1.0, max(ratios) > 1.0), {"ratio": span(ratios)})
