"""Judges of the claims of Section 4.2: the flexible beams."""

import pandas as pd

from studies.claims.introduction import BEAMS
from studies.claims.rows import Rows
from studies.claims.verdicts import Judgement, Verdict, grade
from studies.solvers import IRK, PAPER_TOL
from studies.table3_causes import FLAT

HALF_A_DECADE = 10.0**0.5
FOLLOWS = 1e-3  # m, of the tip over the run
A_LOT = 5.0  # times; the frequencies grow by 10
SECONDS = (56.27, 6278.54)  # s, printed


def _paper(rows: Rows, case: str) -> pd.Series:
    return rows.beam(case, IRK, tol=PAPER_TOL).iloc[0]


def step_order(rows: Rows, case: str, order: float) -> Judgement:
    run = _paper(rows, case)
    met = order / HALF_A_DECADE <= run["h_median"] <= order * HALF_A_DECADE
    return Judgement(grade(met), {"median": float(run["h_median"]), "largest": float(run["h_max"])})


def beams_work(rows: Rows) -> Judgement:
    runs = [_paper(rows, case) for case in BEAMS]
    good = [run["status"] == "REACHED_END" and run["error_q"] < FOLLOWS for run in runs]
    return Judgement(
        grade(all(good), any(good)), {"soft": float(runs[0]["error_q"]), "stiff": float(runs[1]["error_q"])}
    )


def grows_a_lot(rows: Rows) -> Judgement:
    soft, stiff = (_paper(rows, case) for case in BEAMS)
    time, evaluations = (float(stiff[what] / soft[what]) for what in ("cpu_s", "n_evaluations"))
    return Judgement(grade(min(time, evaluations) >= A_LOT), {"time": time, "evaluations": evaluations})


def beam_seconds(rows: Rows) -> Judgement:
    over = [seconds / float(_paper(rows, case)["cpu_s"]) for seconds, case in zip(SECONDS, BEAMS, strict=True)]
    return Judgement(grade(max(over) <= FLAT * min(over)), {"soft": over[0], "stiff": over[1]})


def published_results(rows: Rows) -> Judgement:
    soft, stiff = (rows.sensitivity(case) for case in BEAMS)
    values = {"before": soft["before"].max(), "after": soft["largest"].max(), "stiff": stiff["largest"].max()}
    return Judgement(Verdict.UNCHECKED, {name: 1e3 * float(value) for name, value in values.items()})
