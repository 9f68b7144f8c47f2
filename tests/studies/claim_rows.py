"""Rows of a full run of each study that the claims of the paper are judged by, made up."""

import itertools

import numpy as np
import pandas as pd

from studies.bench.solvers import GEAR_ORDERS, IMPLICIT, IRK, IRK_LINE, NEWMARK, QUARTER, gear
from studies.reproduction import ablation as study
from studies.reproduction.beam import PARAMETERS
from studies.table3 import FAMILIES, PAPER_IRK, PAPER_NEWMARK, TOLERANCES
from twoloop.mechanisms import four_bar

FIRST, SECOND = four_bar().name, "another linkage"
GOOD = {"status": "REACHED_END", "lost": False, "astray": False, "t_end": 100.0, "floor": 1e-12, "repeat": 0}
EXPERIMENTS = {
    **{"iterations from Euler": 7.6, "iterations from the step before": 6.9},
    **{"difference": 1e-14, "calls given": 4.3, "calls differenced": 8.3},
    **{"mechanisms": 21.0, "mechanisms right": 19.0, "non-holonomic error": 1e-6, "non-holonomic violation": 1e-16},
    **{"partitions seen": 18.0, "partitions mostly kept": 16.0},
    **{f"Newton over fixed point, {name}": 0.4 for name in ("linkage", "very flexible", "moderately stiff")},
    **{"methods": 10.0, "methods of their order": 10.0},
    **{"linkages": 20.0, "linkages passing": 10.0, "highest y3, assumed": 0.0},
}


def table3():
    """Both procedures by the paper's pattern, the comparison by orders 5 and 2, solvers with and without projection."""
    rows = []
    for problem, (i, e_in), (j, e_out) in itertools.product((FIRST, SECOND), *[list(enumerate(TOLERANCES))] * 2):
        for group, solver in FAMILIES.items():
            seconds = (PAPER_IRK if solver == IRK else PAPER_NEWMARK)[i][j]
            cpu = 2.5 * (1.0 + 0.1 * i) * (1.0 + 0.2 * j) if solver == IRK else 0.5 * 4.0**j * (1.0 + 0.01 * i)
            row = {"group": group, "solver": solver, "problem": problem, "err_in": e_in, "err_out": e_out}
            row |= {"call_s": cpu, "n_evaluations": 1e6 * cpu, "n_steps": 1600.0 if solver == IRK else 4e3 * 4.0**j}
            row |= {"lost": seconds is None, "astray": j == 0, "error_q": 2.0 / 16.0**j, "y3_max": 0.01 * (j == 0)}
            rows.append(row | {"violation_q": 1e-9 * e_in, "n_inner": 1e5, "n_rejected": 10.0})
        if i == j:
            error, cost = 10.0 ** (-1 - j), 10.0 ** (j / 2)
            each = ((IRK_LINE, np.nan, 10.0 ** (j / 5)), (NEWMARK, 1e-9, 3 * cost), (QUARTER, 1e-9, 2 * cost))
            for solver, err_in, cpu in each:
                row = {"group": "comparison", "solver": solver, "problem": problem, "err_in": err_in, "error_q": error}
                rows.append(row | {"call_s": cpu, "n_evaluations": 1e5 * cpu, "violation_q": 1e-15})
            for solver, cpu, early, late, violation in (
                ("DOP853, index 1", 1.0, 1e-15, 1e-13, 1e-13),
                ("DOP853, projected", 0.9, 1e-15, 1e-15, 1e-15),
                ("IDA, index1", 1.0, 1e-6, 1e-3, 1e-6),
                ("IDA, stabilised", 1.1, 1e-6, 1e-3, 1e-6),
            ):
                row = {"group": "comparison", "solver": solver, "problem": problem, "error_q": error}
                row |= {"violation_early": early, "violation_late": late, "violation_q": violation}
                row |= {"tol": (1e-3, 1e-8, 1e-10, 1e-13)[j], "call_s": cpu * (j + 1)}
                rows.append(row | {"n_evaluations": 1e4 * cpu * (j + 1)})
    return pd.DataFrame([GOOD | row for row in rows])


def motion():
    """The line-up and the stand-in for Gstiff, which fits from order 2 on."""
    near = {"error_y3": 5e-3, "error_y3_short": 1e-6, "top": 0.0, "top_late": -1e-4, "energy": -2e-3, "call_s": 0.3}
    rows = [{"group": "line-up", "solver": solver, "error_q": 0.02, **near} for solver in (IRK, NEWMARK, *IMPLICIT)]
    for order, (h, short, long, cpu) in itertools.product(
        GEAR_ORDERS, ((0.02, 0.02, 0.7, 0.03), (0.01, 5e-3, 0.5, 0.06), (0.001, 1e-9, 1e-5, 0.5))
    ):
        row = {"group": "GSTIFF stand-in", "solver": gear(order), "h": h, "error_y3": long, "error_q": long}
        row |= {"error_y3_short": short * (3.0 if order == 1 else 1.0), "call_s": cpu, "astray": h > 0.001}
        rows.append(row)
    return pd.DataFrame([GOOD | row for row in rows]).assign(range_y3=0.7)


def beam():
    """Both beams: the paper's, Newmark, explicit as good as Newton, TRBDF2 best at 10 mm on one; limit."""
    rows = []
    for case, slow in (("very flexible", 1.0), ("moderately stiff", 8.0)):
        for solver, tol, error, cpu in (
            *((IRK, tol, 1e-9, cpu) for tol, cpu in ((1e-1, 0.5), (1e-5, 1.0))),
            *(
                (name, tol, error, cpu)
                for name in (NEWMARK, QUARTER)
                for tol, error, cpu in ((1e-5, 1e-2, 0.2), (1e-9, 1e-5, 1.6))
            ),
            *((name, 1e-1, 1e-6, 0.05) for name in ("DOP853, projected", "DOP853 (twoloop)", "SunRadau5")),
            ("TRBDF2", 1e-1, 5e-3, 0.03 if slow > 1.0 else 0.06),
        ):
            row = {"group": "run", "case": case, "solver": solver, "tol": tol, "error_tip": error, "call_s": cpu * slow}
            if solver in (NEWMARK, QUARTER) and slow > 1.0:
                row["error_tip"], row["call_s"] = 2e-3 * error, 0.3 * cpu * slow
            rows.append(row | {"n_evaluations": 1e6 * cpu * slow, "h_median": 2.4e-4 / slow, "error_q": 1.0})
        for change in PARAMETERS:
            before, largest = (0.016, 0.3) if slow == 1.0 else (1e-3, 2e-3)
            row = {"group": "sensitivity", "case": case, "solver": change, "before": before, "largest": largest}
            rows.append(row)
    rows.append({"group": "limit", "solver": "Sun, latest stages", "w_max": 3358.5, "theory": 3.22})
    return pd.DataFrame([GOOD | {"t_end": 2.0} | row for row in rows])


def energy():
    """The paper's procedure and Sun's method drift, Newmark's method does not."""
    slopes = ((IRK, -4e-6), ("Sun Radau IIB(3)", -1e-7), ("Newmark, β = 1/2", 1e-13))
    rows = [GOOD | {"solver": solver, "slope": slope, "slope_error": 1e-11} for solver, slope in slopes]
    made = pd.DataFrame(rows).assign(case="one partition", partition="lasting", h=0.02, t_end=1e4, n_steps=500_000)
    return made.assign(kinetic=5.6, swing=1e-3, t_reached=1e4)


def steps():
    """Steps of the paper's procedures."""
    rows = [
        GOOD | {"solver": solver, "h_median": h, "share_time": 0.999}
        for solver, h in ((IRK, 0.06), (NEWMARK, 2e-4), (QUARTER, 4e-4))
    ]
    return pd.DataFrame(rows).assign(group="paper")


def violation():
    """PaperIRK, and Baumgarte's method at two tolerances, the tight one at rounding."""
    ours = GOOD | {"group": "line-up", "solver": IRK, "growth_q": 0.0, "early_q": 9e-16, "late_q": 9e-16}
    ours |= {f"violation_{level}": 1e-15 for level in "qva"}
    theirs = [
        ours | {"group": "tolerances", "solver": "DOP853, Baumgarte 100", "tol": tol, "violation_q": x}
        for tol, x in ((1e-5, 1e-5), (1e-8, 1e-11), (1e-10, 1e-14))
    ]
    return pd.DataFrame([ours, *theirs])


def ablation():
    """Projecting is as good in evaluations and takes half the time; frozen dependents are of order 1."""
    rows = []
    for variant, evaluations, seconds in zip(study.VARIANTS, (1, 20, 1, 2, 1), (2, 20, 1, 5, 1), strict=True):
        row = {"case": study.LINKAGE, "tableau": study.SUN.name, "solver": variant, "t_end": 10.0}
        rows += [row | {"group": "order", "h": h, "error_q": h} for h in study.ORDER_STEPS]
        for k in range(2, 9):
            error = 3e-4 if variant == study.FROZEN else 3.0 * 10.0**-k
            costs = {"n_evaluations": 1e3 * k * evaluations, "call_s": 0.01 * k * seconds}
            rows.append(row | {"group": "controlled", "tol": 10.0**-k, "error_q": error, **costs})
    return pd.DataFrame([GOOD | row for row in rows])


MADE = {"table3_full": table3, "motion": motion, "beam": beam, "energy": energy, "step_size": steps}
MADE |= {"violation": violation, "ablation": ablation}
