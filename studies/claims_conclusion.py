"""The claims of Section 5, the conclusion, with their judges."""

import numpy as np
import pandas as pd

from studies.claims_introduction import VALUE
from studies.claims_verdicts import (
    DEFAULT,
    Claim,
    Judgement,
    NoRows,
    Rows,
    grade,
    long_enough,
    not_run,
    one,
    pick,
    value,
)
from studies.energy_drift import GAUSS, GAUSS_12, NEWMARK_QUARTER, RADAU, SUN
from studies.report import number
from studies.runs import ASTRAY, LOST
from studies.solvers import IMPLICIT, IRK, IRK_LINE, NEWMARK, QUARTER

AGREE = 1e-10  # m or rad
ORDERS = {IRK_LINE: 5, NEWMARK: 2, QUARTER: 2}
SAME = {  # presets that are methods of the energy study
    "SunRadau5": SUN,
    "Gauss6": GAUSS,
    "Gauss12": GAUSS_12,
    "RadauIIA5": RADAU,
    "Newmark": NEWMARK_QUARTER,
}
NEAR = 0.25  # of an exponent about 1 / order, relative


def _values(rows: Rows) -> Judgement:
    given, differenced = (
        value(rows, "values alone", f"{case}: difference from the compiled linkage")
        for case in ("Q_d given", "Q_d by differences")
    )
    calls = {
        case: value(rows, "values alone", f"{case}: calls of jacobian an evaluation")
        for case in ("Q_d given", "Q_d by differences")
    }
    reached = min(value(rows, "values alone", f"{case}: reached its end") for case in calls)
    works = reached == 1.0 and max(given, differenced) < AGREE
    free = calls["Q_d by differences"] <= calls["Q_d given"]
    why = (
        f"Given by values alone the linkage moves as the compiled one does (difference {number(given)}). But Q_d, with second derivatives of "
        f"C, is needed as well, which the paper's list leaves out: given, C_q is called {calls['Q_d given']:.2f} times an evaluation; by "
        f"differences {calls['Q_d by differences']:.2f} times, with a difference of {number(differenced)} m or rad at the end."
    )
    return Judgement(f"difference {number(differenced)}", grade(works and free, works), why)


def _long(rows: Rows) -> Judgement:
    run = long_enough(pick(rows, "motion", solver=IRK, group="line-up")).iloc[0]
    why = (
        f"After {run['t_end']:g} s at the paper's settings: energy error {number(run['energy'])} J of {run['kinetic']:.3g} J, error of y3 up to "
        f"{number(run['error_y3'])} m, growing as t^{run['growth']:.2f}; an error of phase under a linear drift of energy grows as t²."
    )
    good = not run["lost"] and not run["astray"]
    return Judgement(f"error {number(run['error_y3'])} m", grade(good), why)


def _because_of_order(rows: Rows) -> Judgement:
    found = {}
    for solver in ORDERS:
        runs = long_enough(pick(rows, "table3", solver=solver, problem=DEFAULT))
        runs = runs[(runs["err_in"].isna() | (runs["err_in"] == 1e-9)) & ~runs["astray"]].sort_values("error_q")
        if len(runs) < 2:
            raise NoRows(f"fewer than two runs of {solver} follow the motion")
        found[solver] = float(np.polyfit(np.log(1.0 / runs["error_q"]), np.log(runs["n_evaluations"]), 1)[0])
    texts = [f"{solver}: {p:.3f} (1 / order = {1 / ORDERS[solver]:.3f})" for solver, p in found.items()]
    near = all(abs(p * ORDERS[solver] - 1.0) < NEAR for solver, p in found.items())
    less = found[IRK_LINE] < min(found[NEWMARK], found[QUARTER])
    why = f"Evaluations go as error^−p with p = {'; '.join(texts)}. The lesser exponent wins the more, the more accuracy is asked for. (Sun's method is conjugate to one of order 6.)"
    return Judgement(f"p = {', '.join(f'{p:.2f}' for p in found.values())}", grade(near and less, less), why)


def _any_method(rows: Rows) -> Judgement:
    parts = (
        pick(rows, "motion", solver=IMPLICIT, group="line-up"),
        pick(rows, "energy", variables="velocities", partition="lasting"),
    )
    runs = pd.concat([part[["solver", "h", "t_end", "status"]] for part in parts])
    runs["solver"] = runs["solver"].replace(SAME)
    failed = runs[runs["status"] != "REACHED_END"]
    reached = set(runs[runs["status"] == "REACHED_END"]["solver"])
    names = sorted(set(runs["solver"]))
    texts = [f"{run['solver']}, h = {run['h']:g} s, {run['t_end']:g} s" for _, run in failed.iterrows()]
    why = f"Run in the same two loops: {'; '.join(names)}. Of their {len(runs)} runs {len(failed)} failed ({'; '.join(texts) or 'none'}), as one may whose fixed step is too long for the sweeps. No method tried is an exception; that there is none among all cannot be run."
    return Judgement(f"{len(reached)} of {len(names)} methods", grade(len(reached) == len(names), bool(reached)), why)


def _bdf(rows: Rows) -> Judgement:
    run = one(rows, "motion", solver="BDF", group="line-up")
    why = f"Status {run['status']}, error over the run {number(run['error_q'])} m or rad at its setting in the line-up, {number(run['n_evaluations'])} evaluations."
    return Judgement(
        f"error {number(run['error_q'])}", grade(run["status"] == "REACHED_END" and not run["astray"]), why
    )


CLAIMS = (
    Claim(
        "5",
        "Only values of M, Q and C_q are needed, no formulas: the method is general.",
        "PaperIRK on the linkage given by functions that return values, with Q_d given and with Q_d by differences.",
        {"claims": ("check = values alone", VALUE)},
        f"Holds if both runs agree with the compiled linkage to {AGREE:g} and Q_d costs no further values; with conditions if it does.",
        _values,
    ),
    Claim(
        "1, 5",
        "The new procedure works well over long times.",
        "PaperIRK at the paper's settings over 100 s.",
        {
            "motion": (
                "group = line-up; solver = PaperIRK",
                ("lost", "astray", "energy", "kinetic", "error_y3", "growth", "t_end"),
            )
        },
        f"Holds if the energy error is below {LOST:.0%} of the kinetic energy and y3 errs by less than {ASTRAY:.0%} of its range.",
        _long,
        assumed=True,
    ),
    Claim(
        "1, 5",
        "It saves computation because its order is higher.",
        "Evaluations over error of PaperIRK and of PaperNewmark with both β.",
        {
            "table3": (
                "solver = the three, err_in = 1e-9 or none, not astray",
                ("n_evaluations", "error_q", "astray", "t_end"),
            )
        },
        f"Holds if the exponents are within {NEAR:.0%} of 1 / order and PaperIRK's is the least; with conditions if only the latter.",
        _because_of_order,
        assumed=True,
    ),
    Claim(
        "5",
        "Any implicit method for first-order equations fits into the two loops.",
        "Gauss, Radau IIA, Sun's and Lobatto IIIE tableaux, Newmark and BDF, all by sweeps.",
        {
            "motion": ("group = line-up; solver = implicit presets of twoloop", ("status",)),
            "energy": ("variables = velocities; partition = lasting", ("solver", "status")),
        },
        "Holds if every method reaches the end of one run or more, with conditions if some do. The step limit of sweeps (see stiff systems) applies to all.",
        _any_method,
        assumed=True,
    ),
    Claim(
        "5",
        "A two-loop procedure with backward differentiation formulas is possible in the same way.",
        "The two-loop BDF of the line-up, in which sweeps on the accelerations find positions and velocities.",
        {"motion": ("group = line-up; solver = BDF", ("status", "error_q", "astray", "n_evaluations"))},
        "Holds if the run reaches its end and follows the motion.",
        _bdf,
        assumed=True,
    ),
    Claim(
        "5",
        "The best structure of the procedure with Newmark's method has the accelerations as unknowns.",
        "Nothing.",
        {},
        "Needs runs of Newmark's method with positions or velocities as unknowns.",
        not_run("this project iterates Newmark's method on accelerations only, as the paper does."),
    ),
    Claim(
        "5",
        "With the dependent positions integrated the procedure may work for non-holonomic systems.",
        "Nothing.",
        {},
        "Needs a run of a non-holonomic system.",
        not_run("non-holonomic constraints are not implemented."),
    ),
)
