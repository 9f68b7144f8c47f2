"""The judges of claims on the beams of Sect. 4.2."""

import numpy as np
import pandas as pd

from studies.beam.limits import PARAMETERS
from studies.bench.solvers import IRK, PAPER_TOL
from studies.bench.tables import as_good
from studies.claims.explicit import kind_of
from studies.claims.rows import BEAM_END, BEAMS, Rows, cheapest
from studies.claims.verdicts import Judgement, decide, span, span_known
from studies.table3.causes import FLAT

FACTOR = 2.0  # within which an estimate, or a limit, counts as the same
GIVEN_UP = 0.1  # share of steps given up that counts as little
STIFFER = 10.0  # times w_max of the very flexible beam, whose modulus is a hundredth
SECONDS = (56.27, 6278.54)  # s of the beams, printed
HALF_A_DECADE = 10.0**0.5
FOLLOWS = 1e-3  # m, of the tip over the run
A_LOT = 5.0  # times; the frequencies grow by 10
TIPS = (1e-2, 1e-3, 1e-4)  # m or rad, errors over the run at which costs are compared: tip, or the linkage
TIP = TIPS[-1]  # m
WIDTH = 0.02  # m, about the width of a line in a figure of the tip
KEYS = ("soft", "stiff")
PARTED = 10.0  # times the change until 1.2 s


def jacobian_difficult(rows: Rows) -> Judgement:
    """That of a tableau's outer loop alone, and against the paper's procedure; whether they are difficult, not."""
    counts = {key: rows.number(f"Newton over fixed point, {case}") for key, case in zip(KEYS, BEAMS, strict=True)}
    counts["linkage"] = rows.number("Newton over fixed point, linkage")
    seconds = [[as_good(rows.beam(case, name), TIP) for name in ("SunRadau5", IRK)] for case in BEAMS]
    times = [newton / paper for newton, paper in seconds]
    return decide((ratio > 1.0 for ratio in (*counts.values(), *times)), times=span(times), **counts)


def stiff_applicable(rows: Rows) -> Judgement:
    limit = rows.pick("beam", named="latest stages", group="limit").iloc[0]
    runs = [_paper_on(rows, case) for case in BEAMS]
    steps, reached = [float(run["h_median"]) for run in runs], sum(map(_follows, runs))
    h_omega = [steps[0] * limit["w_max"], steps[1] * limit["w_max"] * STIFFER]
    limited = max(h_omega) < limit["theory"] and max(h_omega) < FACTOR * min(h_omega)  # h goes as 1 / w_max
    values = {"reached": reached, "limited": limited, "limit": float(limit["theory"])}
    all_reached = reached == len(BEAMS)
    return decide([all_reached and not limited], all_reached, h_omega=span(h_omega), **values)


def limit_reset_34(rows: Rows) -> Judgement:
    runs = pd.concat([rows.beam(case, IRK) for case in BEAMS])
    share = 100.0 * runs["n_rejected_convergence"] / (runs["n_steps"] + runs["n_rejected"])
    return decide(share < 100.0 * GIVEN_UP, share=span(share))


def implicit_needed(rows: Rows) -> Judgement:
    ratios = {}
    for key, case in zip(KEYS, BEAMS, strict=True):
        runs = rows.beam(case, "")
        kinds = runs["solver"].map(kind_of)
        sides = [runs[kinds == kind] for kind in ("explicit", "Newton")]
        for name, what in ((key, "call_s"), (f"{key}_evaluations", "n_evaluations")):
            costs = [[cheapest(side, tip, what) for tip in TIPS] for side in sides]
            ratios[name] = span_known((np.array(costs[0]) / costs[1]).tolist())
    return decide((ratio > 1.0 for each in ratios.values() for ratio in each), **ratios)


def _paper_on(rows: Rows, case: str) -> pd.Series:
    return rows.beam(case, IRK, tol=PAPER_TOL).iloc[0]


def step_order(rows: Rows, case: str, order: float) -> Judgement:
    run = _paper_on(rows, case)
    median, limits = float(run["h_median"]), [1.0 / HALF_A_DECADE, HALF_A_DECADE]
    return decide([limits[0] <= median / order <= limits[1]], median=median, ratio=median / order, limits=limits)


def beams_work(rows: Rows) -> Judgement:
    runs = [_paper_on(rows, case) for case in BEAMS]
    return decide(map(_follows, runs), soft=_at_most(runs[0]), stiff=_at_most(runs[1]))


def _follows(run: pd.Series) -> bool:
    return bool(run["status"] == "REACHED_END" and run["error_q"] < FOLLOWS)


def _at_most(run: pd.Series) -> float:
    """An error, or what the reference resolves if that is more."""
    return float(max(run["error_q"], run["floor"]))


def grows_a_lot(rows: Rows) -> Judgement:
    soft, stiff = (_paper_on(rows, case) for case in BEAMS)
    time, evaluations = (float(stiff[what] / soft[what]) for what in ("call_s", "n_evaluations"))
    return decide([min(time, evaluations) >= A_LOT], time=time)


def beam_seconds(rows: Rows) -> Judgement:
    over = [seconds / float(_paper_on(rows, case)["call_s"]) for seconds, case in zip(SECONDS, BEAMS, strict=True)]
    return decide([max(over) <= FLAT * min(over)], soft=over[0], stiff=over[1])


def parting(rows: Rows) -> Judgement:
    soft, stiff = (rows.pick("beam", BEAM_END, case=case, group="sensitivity", solver=PARAMETERS) for case in BEAMS)
    before, after, other = (float(each.max()) for each in (soft["before"], soft["largest"], stiff["largest"]))
    met = [before < WIDTH and after > PARTED * before, other < WIDTH]
    return decide([all(met)], before=before, after=after, stiff=other)
