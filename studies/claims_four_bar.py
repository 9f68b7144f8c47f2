"""The claims of Section 4.1, the four-bar linkage, with their judges."""

import numpy as np
import pandas as pd

from studies.claims_introduction import TIGHT, VALUE
from studies.claims_verdicts import (
    LONG,
    Claim,
    Judgement,
    Rows,
    grade,
    long_enough,
    pick,
    span,
)
from studies.motion import VISIBLE
from studies.report import number
from studies.runs import ASTRAY
from studies.solvers import GEAR_ORDERS, IRK, NEWMARK, QUARTER, gear
from studies.violation import SLOPE, TIMES

PASSES = 1e-3  # m above 0 from which y3 passes the line, and below it to which it reaches it
STEP = 0.02  # s
MOSTLY = 0.5


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
    return Judgement(f"residual {span(printed)} m", grade(bool((printed < TIGHT).all())), why)


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


def _limit(error: float) -> str:
    return "any" if np.isnan(error) else f"{number(error)} m"


def _gear(rows: Rows, h: float, wrong: bool) -> Judgement:
    errors = _gear_runs(rows, h)["error_y3_short"]
    off = ~(errors <= VISIBLE)  # so that a failed run is off, too
    met = off == wrong
    below, above = errors[~off].max(), errors[off].min()
    theirs = ", ".join(str(k) for k in errors.index[met]) or "none"
    why = (
        f"Error of y3 within 2 s at h = {h:g} s: {_by_order(errors)}. As the paper says at orders {theirs}, for any limit from {_limit(below)} to {_limit(above)}. The stand-in is a "
        "fixed-step BDF on the index-3 form; Gstiff's order in the paper is not told, nor is ADAMS at hand."
    )
    return Judgement(f"{int(met.sum())} of {len(met)} orders", grade(bool(met.all()), bool(met.any())), why)


def _agree(rows: Rows) -> Judgement:
    runs = pick(rows, "motion", solver=(IRK, NEWMARK), group="line-up").set_index("solver")["error_y3_short"]
    why = f"Error of y3 within 2 s: {', '.join(f'{name} {number(e)} m' for name, e in runs.items())}."
    return Judgement(f"error ≤ {number(runs.max())} m", grade(bool((runs < VISIBLE).all())), why)


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
    return Judgement(f"error {span(errors.dropna())} m", grade(bool(wrong.all()), bool(wrong.any())), why)


def _step(rows: Rows) -> Judgement:
    run = long_enough(pick(rows, "step_size", solver=IRK, group="paper")).iloc[0]
    why = (
        f"{run['share_steps']:.1%} of the steps of PaperIRK are longer than {STEP:g} s; they cover {run['share_time']:.2%} of the time. The "
        f"median is {number(run['h_median'])} s. The lengths of the bars, which set the period, have their share in it."
    )
    return Judgement(f"{run['share_time']:.2%} of the time", grade(bool(run["share_time"] > MOSTLY)), why)


def _larger(rows: Rows) -> Judgement:
    runs = pick(rows, "step_size", solver=(IRK, NEWMARK, QUARTER), group="paper").set_index("solver")
    irk, others = runs["h_median"][IRK], runs["h_median"].drop(IRK)
    ratios = irk / others
    spent = runs["n_evaluations"] / runs["n_steps"]
    spent_on = ", ".join(
        f"{name} {spent[name]:.3g} (error {number(runs['error_q'][name])} m or rad)" for name in runs.index
    )
    why = f"Median step of PaperIRK {number(irk)} s; {', '.join(f'{name} {number(h)} s ({ratios[name]:.0f} times less)' for name, h in others.items())}. But evaluations a step: {spent_on}."
    return Judgement(f"{span(ratios)} × longer", grade(bool((ratios > 1.0).all())), why)


def _violation(rows: Rows) -> Judgement:
    run = long_enough(pick(rows, "violation", solver=IRK, group="line-up")).iloc[0]
    worst = max(run["violation_35"], run["violation_36"])
    grows = run["growth_q"] > SLOPE and run["late_q"] > TIMES * run["early_q"]
    why = (
        f"Largest violation of (35) {number(run['violation_35'])} m, of (36) {number(run['violation_36'])} m; of all positions in the first tenth of the "
        f"run {number(run['early_q'])} m, in the last {number(run['late_q'])} m, going as t^{run['growth_q']:.2f}."
    )
    return Judgement(f"{number(worst)} m, t^{run['growth_q']:.2f}", grade(worst < TIGHT and not grows), why)


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
        {"step_size": ("group = paper", ("h_median", "n_evaluations", "n_steps", "error_q"))},
        "Holds if PaperIRK's median step is the largest.",
        _larger,
        assumed=True,
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
)
