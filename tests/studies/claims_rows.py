"""Rows as the other studies write them after a full run, made up but like theirs, for the tests of the claims."""

import itertools

import numpy as np
import pandas as pd

from studies.beam.runs import EXPLICIT, NEWTON, PAPER
from studies.cases.beam import SOFT, STIFF
from studies.energy_drift import GAUSS, ONE, PAPER_IRK, SUN, SWITCHING
from studies.solvers import GEAR_ORDERS, IRK, NEWMARK, PRESETS, QUARTER, gear

T_END = 100.0
LINE_UP = (IRK, NEWMARK, QUARTER, *PRESETS)


def motion() -> pd.DataFrame:
    """The line-up, the stand-in for Gstiff and Exudyn's HHT."""
    good = {"status": "REACHED_END", "error_y3": 5e-3, "error_y3_short": 1e-6, "error_q": 0.02, "n_evaluations": 1e5}
    good |= {
        "top": 0.0,
        "top_late": -1e-4,
        "energy": -2.5e-3,
        "growth": 2.0,
        "lost": False,
        "astray": False,
        "h": np.nan,
    }
    rows = [good | {"group": "line-up", "solver": solver} for solver in LINE_UP]
    for order, h in itertools.product(GEAR_ORDERS, (0.02, 0.01)):
        errors = {"error_y3_short": 0.2 * (50.0 * h) ** order / 4.0 ** (order - 1), "error_y3": 0.5, "top": 0.1}
        rows.append(good | errors | {"group": "GSTIFF stand-in", "solver": gear(order), "h": h})
    for h in (0.01, 0.005):
        rows.append(good | {"group": "Exudyn", "solver": "Exudyn, HHT", "h": h, "error_y3_short": 30.0 * h**2})
    return pd.DataFrame(rows).assign(t_end=T_END, kinetic=22.5, range_y3=0.726)


def step_size() -> pd.DataFrame:
    """The paper's procedures."""
    columns = ["solver", "h_median", "n_steps", "n_outer", "n_rejected_error", "n_rejected_convergence"]
    rows = pd.DataFrame(
        [
            (IRK, 0.06, 1600, 50_000, 650, 52),
            (NEWMARK, 2.3e-4, 415_000, 1_270_000, 270, 0),
            (QUARTER, 3.6e-4, 262_000, 840_000, 225, 0),
        ],
        columns=columns,
    )
    return rows.assign(
        group="paper",
        share_steps=0.999,
        share_time=0.9999,
        status="REACHED_END",
        t_end=T_END,
        n_evaluations=1e6,
        error_q=0.02,
    )


def violation() -> pd.DataFrame:
    """PaperIRK, and Baumgarte's method at two tolerances."""
    ours = {
        "violation_q": 9e-16,
        "violation_v": 2e-15,
        "violation_a": 3e-13,
        "violation_35": 7e-16,
        "violation_36": 9e-16,
    }
    ours |= {"growth_q": 0.0, "early_q": 9e-16, "late_q": 9e-16, "group": "line-up", "solver": IRK, "tol": 1e-5}
    theirs = [
        ours | {"violation_q": size, "group": "tolerances", "solver": "DOP853, Baumgarte 10", "tol": tol}
        for size, tol in ((1e-6, 1e-5), (1e-9, 1e-8))
    ]
    return pd.DataFrame([ours, *theirs]).assign(t_end=T_END)


def energy() -> pd.DataFrame:
    """Sun's method drifts on velocities and not on momenta."""
    rows = []
    for geometry, (solver, h, variables, slope) in itertools.product(
        (ONE, SWITCHING),
        (
            (PAPER_IRK, np.nan, "velocities", -4e-6),
            (SUN, np.nan, "velocities", -1e-7),
            (SUN, 0.02, "velocities", -1e-9),
            (SUN, 0.02, "momenta", 1e-13),
            (GAUSS, 0.02, "velocities", 1e-14),
        ),
    ):
        rows.append({"geometry": geometry, "solver": solver, "h": h, "variables": variables, "slope": slope})
    table = pd.DataFrame(rows).assign(partition="lasting", slope_error=1e-11, t_end=1e4, n_steps=500_000)
    return table.assign(kinetic=5.6, status="REACHED_END", swing=1e-6)


def beam() -> pd.DataFrame:
    """The paper's procedure on both beams, an explicit method and Newton's on the stiff one, and changed beams."""
    good = {"group": "run", "status": "REACHED_END", "t_end": 2.0, "tol": 1e-5}
    columns = ("case", "solver", "error_tip", "n_evaluations", "cpu_s", "h_median", "h_max")
    runs = [
        (SOFT, PAPER, 3e-9, 9e5, 3.6, 2.4e-4, 5.6e-4),
        (STIFF, PAPER, 5e-11, 8e6, 31.0, 3e-5, 7e-5),
        (STIFF, EXPLICIT, 2e-5, 2e5, 2.1, 1.6e-4, 2e-4),
        (STIFF, NEWTON, 3e-5, 4e4, 0.3, 5e-3, 1e-2),
    ]
    changed = [
        {"group": "sensitivity", "case": case, "solver": "E + 0.1 %", "before": before, "largest": largest}
        for case, before, largest in ((SOFT, 0.015, 0.3), (STIFF, 2e-4, 4e-4))
    ]
    return pd.DataFrame([*(good | dict(zip(columns, run, strict=True)) for run in runs), *changed])
