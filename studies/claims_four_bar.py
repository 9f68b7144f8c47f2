"""The claims of Section 4.1, the four-bar linkage, with their judges."""

from itertools import pairwise

import numpy as np
import pandas as pd

from studies.claims_introduction import TIGHT, VALUE
from studies.claims_verdicts import (
    DEFAULT,
    LONG,
    Claim,
    Judgement,
    NoRows,
    Rows,
    cell,
    cost,
    grade,
    long_enough,
    not_run,
    one,
    pick,
    span,
)
from studies.motion_report import VISIBLE
from studies.report import number
from studies.runs import ASTRAY, LOST
from studies.solvers import GEAR_ORDERS, IRK, IRK_LINE, NEWMARK, QUARTER, gear
from studies.table3_report import FAMILIES, PAPER_IRK, PAPER_NEWMARK, TOLERANCES
from studies.violation_report import SLOPE, TIMES

PASSES = 1e-3  # m above 0 from which y3 passes the line, and below it to which it reaches it
STEP = 0.02  # s
MOSTLY = 0.5
IRK_GROUP, NEWMARK_GROUP = FAMILIES
LAST = TOLERANCES[-1]
PRINTED_RATIO = PAPER_NEWMARK[3][3] / PAPER_IRK[3][3]  # type: ignore[operator]
NEAR = 1.5  # factor within which a ratio counts as the printed one
MAIN = 2.0  # times a logarithm must exceed another for its tolerance to be the main influence
SHARES = (0.3, 0.1, 0.03, 0.01)  # m or rad: errors over the run at which the procedures are compared


def _closure(rows: Rows) -> Judgement:
    printed, sine = (
        pick(rows, "claims", check="(35)", case=f"{name}: largest residual, m")["value"]
        for name in ("printed, cosine", "sine")
    )
    start = pick(rows, "claims", check="(35)", case="printed, cosine: residual at q0, m")["value"]
    why = (
        f"Along the true motion of {len(printed)} geometries (35) with a cosine of θ3 is violated by up to {span(printed)} m, at the start by "
        f"{span(start)} m; with a sine by {number(sine.max())} m. With a cosine the chain does not close, and bar 3 cannot start horizontal: a misprint."
    )
    return Judgement(f"{span(printed)} m", grade(bool((printed < TIGHT).all())), why)


def _energy_line(rows: Rows) -> Judgement:
    tops = pick(rows, "claims", check="true motion", case="highest y3, m").set_index("problem")["value"]
    stay = tops[tops <= PASSES]
    why = (
        f"Highest y3 of the true, energy-conserving motion: {'; '.join(f'{name}: {number(top)} m' for name, top in tops.items())}. "
        "Bars 1 and 2 can pay for raising bar 3, so conservation of energy alone does not imply it. Conversely a curve may keep below "
        "0 and be wrong (see Newmark at 1e-3). It is a criterion for geometries with that property only."
    )
    return Judgement(f"{len(stay)} of {len(tops)} geometries", grade(len(stay) == len(tops), len(stay) > 0), why)


def _reaches(rows: Rows) -> Judgement:
    runs = long_enough(pick(rows, "motion", solver=(IRK, NEWMARK), group="line-up"))
    met = (runs["top"] < PASSES) & (runs["top_late"] > -PASSES)
    texts = [
        f"{run['solver']}: at most {number(1e3 * run['top'])} mm, in the last period and a half {number(1e3 * run['top_late'])} mm, error of y3 "
        f"{number(1e3 * run['error_y3'])} mm"
        for _, run in runs.iterrows()
    ]
    why = f"{'; '.join(texts)}. The line is a weak test; the errors are the stronger one."
    return Judgement(
        f"{span(1e3 * runs['top'])}, {span(1e3 * runs['top_late'])} mm", grade(bool(met.all()), bool(met.any())), why
    )


def _gear_runs(rows: Rows, h: float) -> pd.DataFrame:
    """Rows of the stand-in at a step, by order, accurate start."""
    names = {gear(order): order for order in GEAR_ORDERS}
    runs = pick(rows, "motion", solver=tuple(names), group="GSTIFF stand-in", h=h)
    return runs.assign(k=runs["solver"].map(names)).set_index("k").sort_index()


def _by_order(errors: pd.Series) -> str:
    return ", ".join(
        f"order {k}: {number(e)} m" if not np.isnan(e) else f"order {k}: failed" for k, e in errors.items()
    )


def _gear(rows: Rows, h: float, wrong: bool) -> Judgement:
    errors = _gear_runs(rows, h)["error_y3_short"]
    met = (errors > VISIBLE) == wrong
    theirs = ", ".join(str(k) for k in errors.index[met]) or "none"
    why = (
        f"Error of y3 within 2 s at h = {h:g} s: {_by_order(errors)}. As the paper says at orders {theirs}. The stand-in is a "
        "fixed-step BDF on the index-3 form; Gstiff's order in the paper is not told, nor is ADAMS at hand."
    )
    return Judgement(f"{int(met.sum())} of {len(met)} orders", grade(bool(met.all()), bool(met.any())), why)


def _agree(rows: Rows) -> Judgement:
    runs = pick(rows, "motion", solver=(IRK, NEWMARK), group="line-up").set_index("solver")["error_y3_short"]
    why = f"Error of y3 within 2 s: {', '.join(f'{name} {number(e)} m' for name, e in runs.items())}."
    return Judgement(f"{number(runs.max())} m", grade(bool((runs < VISIBLE).all())), why)


def _gear_long(rows: Rows) -> Judgement:
    runs = long_enough(_gear_runs(rows, 0.01))
    errors, limit = runs["error_y3"], ASTRAY * runs["range_y3"].iloc[0]
    wrong = ~(errors <= limit)
    passing = [str(k) for k, run in runs.iterrows() if run["top"] > PASSES]
    losing = [str(k) for k, run in runs.iterrows() if run["energy"] < 0.0]
    why = (
        f"Error of y3 over {LONG:g} s at h = 0.01 s: {_by_order(errors)}; {ASTRAY:.0%} of its range is {number(limit)} m. y3 passes 0 at "
        f"orders {', '.join(passing) or 'none'}; energy is lost at orders {', '.join(losing) or 'none'}. Again of the stand-in, not of ADAMS."
    )
    return Judgement(f"{span(errors.dropna())} m", grade(bool(wrong.all()), bool(wrong.any())), why)


def _step(rows: Rows) -> Judgement:
    run = long_enough(pick(rows, "step_size", solver=IRK, group="paper")).iloc[0]
    why = (
        f"{run['share_steps']:.1%} of the steps of PaperIRK are longer than {STEP:g} s; they cover {run['share_time']:.2%} of the time. The "
        f"median is {number(run['h_median'])} s. The lengths of the bars, which set the period, have their share in it."
    )
    return Judgement(f"{run['share_time']:.2%} of the time", grade(bool(run["share_time"] > MOSTLY)), why)


def _larger(rows: Rows) -> Judgement:
    irk = one(rows, "step_size", solver=IRK, group="paper")["h_median"]
    others = pick(rows, "step_size", solver=(NEWMARK, QUARTER), group="paper").set_index("solver")["h_median"]
    ratios = irk / others
    why = f"Median step of PaperIRK {number(irk)} s; {', '.join(f'{name} {number(h)} s ({ratios[name]:.0f} times less)' for name, h in others.items())}."
    return Judgement(f"× {span(ratios)}", grade(bool((ratios > 1.0).all())), why)


def _influence(rows: Rows, group: str, what: str, coarsest: float) -> tuple[float, float]:
    """Mean factors in `what` from `coarsest` to 1e-9: of err_in at every err_out from there on, and the reverse."""
    out = [e for e in TOLERANCES if e <= coarsest]
    by_in = [cell(rows, group, LAST, e)[what] / cell(rows, group, coarsest, e)[what] for e in out]
    by_out = [cell(rows, group, e, LAST)[what] / cell(rows, group, e, coarsest)[what] for e in out]
    return float(np.exp(np.log(by_in).mean())), float(np.exp(np.log(by_out).mean()))


def _newmark_time(rows: Rows) -> Judgement:
    long_enough(pick(rows, "table3", group=NEWMARK_GROUP, problem=DEFAULT))
    found = {what: _influence(rows, NEWMARK_GROUP, what, 1e-5) for what in ("cpu_s", "n_evaluations")}
    met = [np.log(by_out) > MAIN * abs(np.log(by_in)) for by_in, by_out in found.values()]
    evaluations = [cell(rows, NEWMARK_GROUP, LAST, e)["n_evaluations"] for e in TOLERANCES[1:]]
    decades = [b / a for a, b in pairwise(evaluations)]
    why = (
        f"From 1e-5 to 1e-9, means over the cells: err_out changes time by × {found['cpu_s'][1]:.2f} and evaluations by × "
        f"{found['n_evaluations'][1]:.2f}, err_in by × {found['cpu_s'][0]:.2f} and × {found['n_evaluations'][0]:.2f}. Evaluations for two "
        f"decades of err_out: × {span(decades)} (paper, time: × {13.40 / 3.09:.2f}, {50.93 / 13.40:.2f}). So err_out is read as the "
        "tolerance of the step's error; the paper does not say."
    )
    return Judgement(f"× {found['cpu_s'][1]:.1f}, not {found['cpu_s'][0]:.2f}", grade(all(met), any(met)), why)


def _irk_time(rows: Rows) -> Judgement:
    long_enough(pick(rows, "table3", group=IRK_GROUP, problem=DEFAULT))
    found = {what: _influence(rows, IRK_GROUP, what, 1e-3) for what in ("cpu_s", "n_evaluations", "n_inner")}
    fine = _influence(rows, IRK_GROUP, "cpu_s", 1e-5)
    met = {what: np.log(by_in) > MAIN * abs(np.log(by_out)) for what, (by_in, by_out) in found.items()}
    texts = [f"{what} × {by_in:.2f} by err_in, × {by_out:.2f} by err_out" for what, (by_in, by_out) in found.items()]
    why = (
        f"From 1e-3 to 1e-9, means over the cells: {'; '.join(texts)}; from 1e-5, where the outer loop no longer disturbs the error estimate, time × "
        f"{fine[0]:.2f} and × {fine[1]:.2f}. The paper's time at the other tolerance 1e-9: × {3.60 / 2.08:.2f} and × {3.60 / 3.37:.2f}. Its growth with err_in is "
        "that of the inner iterations, as if they made up its cost; here an evaluation weighs more, and (32) asks more sweeps for a smaller err_out."
    )
    return Judgement(
        f"× {found['cpu_s'][0]:.2f}, × {found['cpu_s'][1]:.2f}", grade(bool(met["cpu_s"]), bool(met["n_inner"])), why
    )


def _newmark_star(rows: Rows) -> Judgement:
    cells = long_enough(pick(rows, "table3", group=NEWMARK_GROUP, problem=DEFAULT))
    coarse, fine = cells[cells["err_out"] == 1e-3], cells[cells["err_out"] < 1e-3]
    other = long_enough(pick(rows, "table3", group=NEWMARK_GROUP))
    other = other[(other["problem"] != DEFAULT) & (other["err_out"] == 1e-3)]
    astray = sorted(fine[fine["astray"]]["err_out"].unique(), reverse=True)
    why = (
        f"Lost in {int(coarse['lost'].sum())} of {len(coarse)} cells with err_out = 1e-3 (energy error {span(coarse['energy'])} J of "
        f"{coarse['kinetic'].iloc[0]:.3g} J) and in {int(fine['lost'].sum())} of {len(fine)} others. On the second geometry at 1e-3: lost in "
        f"{int(other['lost'].sum())} of {len(other)}. Out of phase, by more than {ASTRAY:.0%} of the range of y3, also at err_out = "
        f"{', '.join(f'{e:.0e}' for e in astray) or 'none'}, which the paper's criterion, the line y3 = 0, does not show."
    )
    met = bool(coarse["lost"].all() and not fine["lost"].any())
    number_ = f"{int(coarse['lost'].sum())} of {len(coarse)}, {int(fine['lost'].sum())} of {len(fine)}"
    return Judgement(number_, grade(met and not fine["astray"].any(), met), why)


def _irk_star(rows: Rows) -> Judgement:
    cells = long_enough(pick(rows, "table3", group=IRK_GROUP, problem=DEFAULT, err_out=1e-3))
    kept, follows = not cells["lost"].any(), not cells["astray"].any()
    why = (
        f"Not lost: the energy error, {span(cells['energy'])} J, is {(cells['energy'].abs() / cells['kinetic']).max():.1%} of the kinetic energy. "
        f"But out of phase in {int(cells['astray'].sum())} of {len(cells)} cells (error up to {number(cells['error_q'].max())} m or rad), and y3 "
        f"passes 0 by up to {number(1e3 * cells['y3_max'].max())} mm. Reasonable as to energy, not as to the motion."
    )
    return Judgement(
        f"{span(cells['energy'])} J", grade(kept and follows and bool((cells["y3_max"] < PASSES).all()), kept), why
    )


def _ratio(rows: Rows) -> Judgement:
    parts, ratios = [], {}
    for problem in dict.fromkeys(pick(rows, "table3", group=IRK_GROUP)["problem"]):
        slow, fast = cell(rows, NEWMARK_GROUP, LAST, LAST, problem), cell(rows, IRK_GROUP, LAST, LAST, problem)
        time, evaluations = slow["cpu_s"] / fast["cpu_s"], slow["n_evaluations"] / fast["n_evaluations"]
        ratios[problem] = (time, evaluations)
        parts.append(
            f"{problem}: × {time:.1f} in time, × {evaluations:.1f} in evaluations (errors {number(slow['error_q'])} and {number(fast['error_q'])})"
        )
    long_enough(pick(rows, "table3", group=IRK_GROUP))
    both = [ratio for pair in ratios.values() for ratio in pair]
    time, evaluations = ratios[DEFAULT]
    why = f"{'; '.join(parts)}; printed: × {PRINTED_RATIO:.1f}. Newmark with β = 1/2; at equal error see the next row."
    met = all(ratio >= PRINTED_RATIO / NEAR for ratio in both)
    return Judgement(f"× {time:.1f}, × {evaluations:.1f}", grade(met, min(both) > 1.0), why)


def _equal_error(rows: Rows) -> Judgement:
    parts, ratios = [], []
    for problem in dict.fromkeys(pick(rows, "table3", solver=IRK_LINE)["problem"]):
        runs = long_enough(pick(rows, "table3", problem=problem))
        fast = runs[runs["solver"] == IRK_LINE]
        for solver in (NEWMARK, QUARTER):
            slow = runs[(runs["solver"] == solver) & (runs["err_in"] == LAST)]
            for what in ("cpu_s", "n_evaluations"):
                found = [cost(slow, e, what) / cost(fast, e, what) for e in SHARES]
                found = [ratio for ratio in found if not np.isnan(ratio)]
                ratios += found
                parts.append(f"{solver}, {what}, {problem}: × {span(found) if found else '–'}")
    if not ratios:
        raise NoRows("no error is reached by both procedures")
    why = f"Cost of Newmark over that of PaperIRK at errors of {', '.join(f'{e:g}' for e in SHARES)}, where both reach them: {'; '.join(parts)}."
    return Judgement(f"× {span(ratios)}", grade(min(ratios) > 1.0, max(ratios) > 1.0), why)


def _violation(rows: Rows) -> Judgement:
    run = long_enough(pick(rows, "violation", solver=IRK, group="line-up")).iloc[0]
    worst = max(run["violation_35"], run["violation_36"])
    grows = run["growth_q"] > SLOPE and run["late_q"] > TIMES * run["early_q"]
    why = (
        f"Largest violation of (35) {number(run['violation_35'])} m, of (36) {number(run['violation_36'])} m; of all positions in the first tenth of the "
        f"run {number(run['early_q'])} m, in the last {number(run['late_q'])} m, going as t^{run['growth_q']:.2f}."
    )
    return Judgement(f"{number(worst)} m, t^{run['growth_q']:.2f}", grade(worst < TIGHT and not grows), why)


def _constraints(rows: Rows) -> Judgement:
    runs = pick(rows, "table3", solver=(IRK, NEWMARK))
    reached = runs["status"] == "REACHED_END"
    inner = runs["n_inner"] / runs["n_evaluations"]
    why = f"{int(reached.sum())} of {len(runs)} runs of both procedures on {runs['problem'].nunique()} geometries reach their end, with {span(inner)} iterations of the inner loop an evaluation."
    return Judgement(f"{int(reached.sum())} of {len(runs)} runs", grade(bool(reached.all())), why)


CELLS = ("err_in", "err_out", "cpu_s", "n_evaluations")

CLAIMS = (
    Claim(
        "4.1",
        "(35): the vertical closure of the chain, with a cosine of θ3.",
        "(35) as printed and with a sine along the true motion.",
        {"claims": ("check = (35)", VALUE)},
        f"Holds if the printed equation is met to {TIGHT:g} m at every instant.",
        _closure,
    ),
    Claim(
        "4.1",
        "Conservation of energy means that the centre of bar 3 reaches and does not pass y = 0.",
        "The true motion from rest, bar 3 horizontal, of several geometries.",
        {"claims": ("check = true motion; case = highest y3", (*VALUE, "problem"))},
        f"Holds if y3 stays below {PASSES:g} m in every geometry, with conditions if in some.",
        _energy_line,
    ),
    Claim(
        "4.1",
        "In 100 s the curves of both two-loop procedures reach y3 = 0 and do not pass it.",
        "PaperIRK and PaperNewmark (β = 1/2) at err_in = err_out = 1e-9.",
        {"motion": ("group = line-up; solver = the two", ("top", "top_late", "error_y3", "t_end"))},
        f"Holds if both stay below {PASSES:g} m and come within {PASSES:g} m of 0 in the last period and a half.",
        _reaches,
        assumed=True,
    ),
    Claim(
        "4.1",
        "Within 2 s the two procedures agree.",
        "Both at err_in = err_out = 1e-9 against the true motion.",
        {"motion": ("group = line-up; solver = the two", ("error_y3_short",))},
        f"Holds if both errors of y3 are below {VISIBLE:g} m, the width of a line.",
        _agree,
        assumed=True,
    ),
    Claim(
        "4.1",
        "Gstiff with h = 0.02 s differs visibly within 2 s.",
        "The stand-in for Gstiff, orders 1 to 6.",
        {"motion": ("group = GSTIFF stand-in; h = 0.02; without ramp", ("error_y3_short",))},
        f"Holds if the error of y3 exceeds {VISIBLE:g} m at every order run, with conditions if at some.",
        lambda rows: _gear(rows, 0.02, True),
        assumed=True,
    ),
    Claim(
        "4.1",
        "Gstiff with h = 0.01 s coincides with the two-loop procedures within 2 s.",
        "The stand-in for Gstiff, orders 1 to 6.",
        {"motion": ("group = GSTIFF stand-in; h = 0.01; without ramp", ("error_y3_short",))},
        f"Holds if the error of y3 is below {VISIBLE:g} m at every order run, with conditions if at some.",
        lambda rows: _gear(rows, 0.01, False),
        assumed=True,
    ),
    Claim(
        "4.1",
        "Gstiff with h = 0.01 s is obviously wrong over 100 s.",
        "The stand-in for Gstiff, orders 1 to 6.",
        {
            "motion": (
                "group = GSTIFF stand-in; h = 0.01; without ramp",
                ("error_y3", "range_y3", "top", "energy", "t_end"),
            )
        },
        f"Holds if the error of y3 exceeds {ASTRAY:.0%} of its range, or the run fails, at every order; with conditions if at some.",
        _gear_long,
        assumed=True,
    ),
    Claim(
        "4.1",
        "The step of the new procedure is above 0.02 s most of the time.",
        "PaperIRK at the paper's settings.",
        {"step_size": ("group = paper; solver = PaperIRK", ("share_steps", "share_time", "h_median", "t_end"))},
        f"Holds if steps longer than {STEP:g} s cover more than {MOSTLY:.0%} of the time.",
        _step,
        assumed=True,
    ),
    Claim(
        "4.1",
        "Runge–Kutta takes larger steps than Newmark.",
        "PaperIRK and PaperNewmark with β = 1/2 and 1/4 at the paper's settings.",
        {"step_size": ("group = paper", ("h_median",))},
        "Holds if PaperIRK's median step is the largest.",
        _larger,
        assumed=True,
    ),
    Claim(
        "4.1",
        "err_out governs the time of Newmark's procedure, err_in hardly matters.",
        "Table 3, the columns and rows from 1e-5 on (1e-3 loses the solution).",
        {"table3": ("group = Table 3: Newmark, default geometry", CELLS)},
        f"Logarithms of the mean factors from 1e-5 to 1e-9. Holds if err_out's is more than {MAIN:g} times err_in's, in time and in evaluations.",
        _newmark_time,
        assumed=True,
    ),
    Claim(
        "4.1",
        "err_in is the main influence on the time of the new procedure.",
        "Table 3.",
        {"table3": ("group = Table 3: IRK, default geometry", (*CELLS, "n_inner"))},
        f"Logarithms of the mean factors from 1e-3 to 1e-9. Holds if err_in's is more than {MAIN:g} times err_out's in time; with conditions if it is so "
        "in inner iterations only.",
        _irk_time,
        assumed=True,
    ),
    Claim(
        "4.1",
        "With err_out = 1e-3 Newmark gives no reasonable long-time result, with smaller ones it does.",
        "Table 3.",
        {"table3": ("group = Table 3: Newmark", ("err_out", "lost", "astray", "energy", "kinetic", "t_end"))},
        f"Holds if all cells with 1e-3 are lost (energy error above {LOST:.0%} of the kinetic energy) and no other, and the others are in phase; with conditions if they are not.",
        _newmark_star,
        assumed=True,
    ),
    Claim(
        "4.1",
        "With err_out = 1e-3 the new procedure still gives a reasonable long-time result.",
        "Table 3.",
        {
            "table3": (
                "group = Table 3: IRK; err_out = 1e-3",
                ("lost", "astray", "energy", "kinetic", "y3_max", "error_q"),
            )
        },
        f"Holds if no such cell is lost or out of phase and y3 stays below {PASSES:g} m; with conditions if none is lost.",
        _irk_star,
        assumed=True,
    ),
    Claim(
        "4.1",
        "At err_in = err_out = 1e-9 the new procedure is 14 times as fast as Newmark's (3.60 s against 50.93 s).",
        "Table 3, both geometries.",
        {"table3": ("err_in = err_out = 1e-9; both groups", ("cpu_s", "n_evaluations", "error_q", "t_end"))},
        f"Holds if all ratios, in time and evaluations, reach {PRINTED_RATIO:.1f} / {NEAR:g}; with conditions (faster, by less) if all exceed 1.",
        _ratio,
        assumed=True,
    ),
    Claim(
        "abstract, 1, 5",
        "The new procedure is more efficient than the two-loop procedure with Newmark's method.",
        "PaperIRK over Atol = Rtol, PaperNewmark over err_out with β = 1/2 and 1/4, at equal error, both geometries.",
        {"table3": ("solver = the three; err_in = 1e-9 or none", ("error_q", "cpu_s", "n_evaluations", "t_end"))},
        "Holds if Newmark costs more at every error that both reach, in time and in evaluations; with conditions if at some.",
        _equal_error,
        assumed=True,
    ),
    Claim(
        "4.1",
        "Table 3: the computation times in seconds.",
        "Nothing.",
        {},
        "Needs a run of the paper's code on its computer.",
        not_run(
            "the paper names neither its computer nor its language, and its code is not public. Ratios are judged above."
        ),
    ),
    Claim(
        "4.1, 5",
        "The constraints (35), (36) are violated very little, and the violation does not grow.",
        "PaperIRK at the paper's settings.",
        {
            "violation": (
                "group = line-up; solver = PaperIRK",
                ("violation_35", "violation_36", "growth_q", "early_q", "late_q", "t_end"),
            )
        },
        f"Holds if both stay below {TIGHT:g} m and it does not grow: growing means an exponent above {SLOPE:g} and a last tenth above {TIMES:g} "
        "times the first.",
        _violation,
        assumed=True,
    ),
    Claim(
        "4.1",
        "The procedure handles the constraints of a closed chain: one independent coordinate, eight dependent ones.",
        "All cells of Table 3 on both geometries.",
        {"table3": ("solver = PaperIRK, PaperNewmark (beta = 1/2)", ("status", "n_inner", "n_evaluations"))},
        "Holds if all runs reach their end.",
        _constraints,
        assumed=True,
    ),
)
