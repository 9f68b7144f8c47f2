"""The judges of claims on the beams of Sect. 4.2."""

import numpy as np
import pandas as pd

from studies.bench import solvers
from studies.bench.cli import StudyError
from studies.bench.tables import as_good
from studies.claims.rows import BEAM_END, BEAMS, Rows, cheapest
from studies.claims.verdicts import Judgement, decide, span, span_known
from studies.reproduction.beam import HALF_A_DECADE, PAPER_SECONDS, PAPER_STEPS
from studies.reproduction.beam_limits import PARAMETERS
from studies.table3.causes import FLAT

FACTOR = 2.0  # within which an estimate, or a limit, counts as the same
STIFFER = 10.0  # times w_max of the very flexible beam, whose modulus is a hundredth
FOLLOWS = 1e-3  # m, of the tip over the run
A_LOT = 5.0  # times; the frequencies grow by 10
TIPS = (1e-2, 1e-3, 1e-4)  # m or rad, errors over the run at which costs are compared: tip, or the linkage
WIDTH = 0.02  # m, about the width of a line in a figure of the tip
PARTED = 10.0  # times the change until 1.2 s

EXPLICIT = (
    *(solvers.OWN_EXPLICIT, solvers.ADAMS, solvers.HEYOKA, solvers.DIFFRAX, solvers.CYRK, "CyRK, Vern8"),
    *("DOP853, projected", "DOP853, index 1", "Pr9, index 1"),
)
FIXED_POINT = (solvers.IRK, solvers.NEWMARK, solvers.QUARTER, solvers.CVODE_C, "CVODE, Adams", "CVODES, CasADi, Adams")
CHOOSING = (solvers.DEFAULT, *solvers.COMPILED, "LSODA, index 1", "CyRK, LSODA")  # between explicit and implicit
# in names of implicit methods by Newton's iteration
BY_NEWTON = ("Radau", "Gauss", "BDF", "TRBDF2", "ESDIRK", "IDA", "CVODES", "collocation")


def kind_of(solver: str) -> str:
    """Tell how a solver steps. Raises StudyError for one that is in no list: it would count as something else."""
    if solver in EXPLICIT:
        return "explicit"
    if solver in (*CHOOSING, *FIXED_POINT):
        return "neither"
    if any(name in solver for name in BY_NEWTON):
        return "Newton"
    raise StudyError(f"whether {solver!r} is explicit is not known: add it to a list of {__name__}")


def jacobian_difficult(rows: Rows) -> Judgement:
    """Compare costs only; whether Jacobians are hard to get was not tested."""
    counts = [rows.number(f"Newton over fixed point, {case}") for case in ("linkage", *BEAMS)]
    seconds = [[as_good(rows.beam(case, name), TIPS[-1]) for name in ("SunRadau5", solvers.IRK)] for case in BEAMS]
    times = [newton / paper for newton, paper in seconds]
    return decide((ratio > 1.0 for ratio in (*counts, *times)), evaluations=span(counts), times=span(times))


def stiff_applicable(rows: Rows) -> Judgement:
    limit = rows.pick("beam", named="latest stages", group="limit").iloc[0]
    runs = [_paper_on(rows, case) for case in BEAMS]
    reached = sum(map(_follows, runs))
    h_omega = [run["h_median"] * limit["w_max"] * factor for run, factor in zip(runs, (1.0, STIFFER), strict=True)]
    limited = max(h_omega) < limit["theory"] and max(h_omega) < FACTOR * min(h_omega)  # h goes as 1 / w_max
    return decide([reached == len(runs) and not limited], reached == len(runs), h_omega=span(h_omega), reached=reached)


def implicit_needed(rows: Rows) -> Judgement:
    ratios = {}
    for key, case in zip(("soft", "stiff"), BEAMS, strict=True):
        runs = rows.beam(case, "")
        kinds = runs["solver"].map(kind_of)
        for name, what in ((key, "call_s"), (f"{key}_evaluations", "n_evaluations")):
            sides = (runs[kinds == kind] for kind in ("explicit", "Newton"))
            explicit, newton = (np.array([cheapest(side, tip, what) for tip in TIPS]) for side in sides)
            ratios[name] = span_known(explicit / newton)
    return decide((ratio > 1.0 for bounds in ratios.values() for ratio in bounds), **ratios)


def _paper_on(rows: Rows, case: str) -> pd.Series:
    return rows.beam(case, solvers.IRK, tol=solvers.PAPER_TOL).iloc[0]


def step_order(rows: Rows, case: str) -> Judgement:
    median = float(_paper_on(rows, case)["h_median"])
    return decide([abs(np.log10(median / PAPER_STEPS[case])) <= HALF_A_DECADE], median=median)


def beams_work(rows: Rows) -> Judgement:
    runs = [_paper_on(rows, case) for case in BEAMS]
    worst = max(float(run[column]) for run in runs for column in ("error_q", "floor"))  # what the reference resolves
    return decide(map(_follows, runs), worst=worst)


def _follows(run: pd.Series) -> bool:
    return bool(run["status"] == "REACHED_END" and run["error_q"] < FOLLOWS)


def grows_a_lot(rows: Rows) -> Judgement:
    soft, stiff = (_paper_on(rows, case) for case in BEAMS)
    time, evaluations = (float(stiff[what] / soft[what]) for what in ("call_s", "n_evaluations"))
    return decide([min(time, evaluations) >= A_LOT], time=time)


def beam_seconds(rows: Rows) -> Judgement:
    over = [PAPER_SECONDS[case] / float(_paper_on(rows, case)["call_s"]) for case in BEAMS]
    return decide([max(over) <= FLAT * min(over)], soft=over[0], stiff=over[1])


def parting(rows: Rows) -> Judgement:
    soft, stiff = (rows.pick("beam", BEAM_END, case=case, group="sensitivity", solver=PARAMETERS) for case in BEAMS)
    before, after, other = (float(x.max()) for x in (soft["before"], soft["largest"], stiff["largest"]))
    return decide([before < WIDTH and after > PARTED * before and other < WIDTH], before=before, after=after)
