"""Judges of the claims of Section 3 and of what the conclusion says of the method."""

import numpy as np
import pandas as pd

from studies.claims.introduction import BEAMS
from studies.claims.rows import LONG, NotRun, Rows
from studies.claims.verdicts import Judgement, grade, span
from studies.solvers import IMPLICIT, IRK, PAPER_TOL

STIFFER = 10.0  # times w_max of the very flexible beam, whose modulus is a hundredth
RESOLVED = 3.0  # standard errors from which a slope counts as a drift
FACTOR = 2.0  # within which an estimate, or a limit, counts as the same
NEEDLESS = 0.1  # share of steps given up, or of work, that counts as little
AGREE = 1e-10  # m or rad
EPS = float(np.finfo(float).eps)
SUN = "Sun Radau IIB(3)"


def _drifts(runs: pd.DataFrame) -> pd.Series:
    rounding = EPS * runs["kinetic"] * runs["n_steps"] / runs["t_end"]
    steady = runs["slope"].abs() <= np.maximum(RESOLVED * runs["slope_error"], rounding)
    return (runs["status"] != "REACHED_END") | ~steady


def symplectic_stable(rows: Rows) -> Judgement:
    runs = rows.pick("energy", solver=(SUN, IRK), partition="lasting")
    runs = runs[runs["t_end"] == runs["t_end"].max()]
    if not runs["t_end"].max() > LONG:
        raise NotRun(f"quick rows: they cover {runs['t_end'].max():g} s, and the claim is about long runs")
    own, canonical = (runs[runs["variables"] == variables] for variables in ("velocities", "momenta"))
    rows.first(own, "Sun's method on velocities")
    drifts, change = _drifts(own), own["slope"].abs() * own["t_end"]
    values = {"drifting": int(drifts.sum()), "runs": len(own), "change": float(change.max())}
    values |= {"t_end": float(own["t_end"].max()), "steady_on_momenta": int((~_drifts(canonical)).sum())}
    return Judgement(grade(not drifts.any()), values)


def no_jacobian(rows: Rows) -> Judgement:
    calls = rows.number("calls of force, Q_d given")
    return Judgement(grade(calls < 1.01), {"calls": calls})


def stiff_applicable(rows: Rows) -> Judgement:
    limit = rows.pick("beam", group="limit")
    latest = rows.first(limit[limit["solver"].astype(str).str.contains("latest stages")], "the limit, latest stages")
    w_max, theory = float(latest["w_max"]), float(latest["theory"])
    steps = [rows.beam(case, IRK, tol=PAPER_TOL)["h_median"].iloc[0] for case in BEAMS]
    h_omega = [steps[0] * w_max, steps[1] * w_max * STIFFER]
    limited = max(h_omega) < theory and max(h_omega) < FACTOR * min(h_omega)  # h goes as 1 / w_max
    return Judgement(grade(not limited), {"h_omega": span(h_omega), "limit": theory})


def difference_is_the_error(rows: Rows) -> Judgement:
    ratio = rows.number("estimate over error")
    return Judgement(grade(1.0 / FACTOR < ratio < FACTOR), {"ratio": ratio})


def richardson_cheap(rows: Rows) -> Judgement:
    share = rows.number("share of the step for the estimate")
    return Judgement(grade(share < NEEDLESS), {"share": 100.0 * share})


def euler_predictor(rows: Rows) -> Judgement:
    euler, continued = rows.number("iterations from Euler"), rows.number("iterations from the step before")
    return Judgement(grade(continued > (1.0 - NEEDLESS) * euler), {"euler": euler, "continued": continued})


def step_limit_33(rows: Rows) -> Judgement:
    given_up, converging = rows.number("steps given up by (33)"), rows.number("of these, converging")
    if not given_up:
        raise NotRun("(33) gave up none of the steps tried")
    values = {"share": 100.0 * converging / given_up}
    return Judgement(grade(converging <= NEEDLESS * given_up), values)


def limit_reset_34(rows: Rows) -> Judgement:
    shares = []
    for case in BEAMS:
        runs = rows.beam(case, IRK)
        shares += list(100.0 * runs["n_rejected_convergence"] / (runs["n_steps"] + runs["n_rejected"]))
    low, high = min(shares), max(shares)
    return Judgement(grade(high < 100.0 * NEEDLESS, low < 100.0 * NEEDLESS), {"share": [float(low), float(high)]})


def values_alone(rows: Rows) -> Judgement:
    given, differenced = (rows.number(f"calls of jacobian, Q_d {case}") for case in ("given", "by differences"))
    worst = max(rows.number(f"difference, Q_d {case}") for case in ("given", "by differences"))
    works = worst < AGREE
    values = {"difference": worst, "given": given, "differenced": differenced}
    return Judgement(grade(works and differenced <= given, works), values)


def any_method(rows: Rows) -> Judgement:
    parts = (
        rows.pick("motion", solver=IMPLICIT, group="line-up"),
        rows.pick("energy", variables="velocities", partition="lasting"),
    )
    runs = pd.concat([part[["solver", "status"]] for part in parts])
    reached = runs[runs["status"] == "REACHED_END"]["solver"].nunique()
    n = runs["solver"].nunique()
    return Judgement(grade(reached == n, reached > 0), {"reached": int(reached), "methods": int(n)})


def energy_implies_line(rows: Rows) -> Judgement:
    tops = [rows.number(f"highest y3 of geometry {k}") for k in (1, 2, 3, 4)]
    stay = sum(top < 1e-3 for top in tops)
    return Judgement(grade(stay == 4, stay > 0), {"stay": stay, "geometries": 4, "top": max(tops)})
