"""The claims of Sect. 4.2, the flexible beam on a moving base, with their judges."""

from collections.abc import Iterator

import numpy as np
import pandas as pd

from studies.beam.runs import EXPLICIT, NEWTON, PAPER, PAPER_TOL
from studies.cases.beam import SOFT, STIFF
from studies.claims_algebra import Row, row
from studies.claims_verdicts import Claim, Judgement, NoRows, Rows, grade, one, pick, value
from studies.report import number
from studies.runs import time_for
from twoloop.mechanisms import very_flexible_beam

SECONDS = {SOFT: 56.27, STIFF: 6278.54}  # the paper's computation times
ORDERS = {SOFT: 1e-3, STIFF: 1e-5}  # s, the paper's step sizes by order of magnitude
HALF_A_DECADE = 10.0**0.5
FOLLOWS = 1e-3  # m, of the tip over the run
LENGTH = 2.0  # s, of a full run
A_LOT = 5.0  # times; the frequencies grow by 10
TARGET = 1e-4  # m, tip error at which evaluations are compared
STATES, STEP = 5, 1e-6  # states at which the elastic force is compared, and the displacement of the difference
ROUNDING = 1e-6


def elastic_force() -> Iterator[Row]:
    """The force of the elements against the slope of their strain energy, at bent and stretched states."""
    problem = very_flexible_beam()
    system, rng = problem.system, np.random.default_rng(1)
    rest = np.zeros_like(problem.q0)
    worst = 0.0
    for _ in range(STATES):
        q = problem.q0 + 0.05 * rng.standard_normal(problem.q0.size)
        d = rng.standard_normal(q.size)
        ahead, behind = (problem.energy(0.0, q + sign * STEP * d, rest) for sign in (1.0, -1.0))
        force = system.force(0.0, q, rest)
        worst = max(worst, abs((behind - ahead) / (2.0 * STEP) - force @ d) / np.abs(force * d).sum())
    yield row("elastic force", "largest difference from the slope of the energy", worst, problem=problem.name)


def _paper(rows: Rows, case: str) -> pd.Series:
    run = one(rows, "beam", group="run", case=case, solver=PAPER, tol=PAPER_TOL)
    if run["t_end"] < LENGTH:
        raise NoRows(f"quick run: it covers {run['t_end']:g} s, and the claim is about {LENGTH:g} s")
    return run


def _steps(case: str, rows: Rows) -> Judgement:
    run = _paper(rows, case)
    order = ORDERS[case]

    def near(h: float) -> bool:
        return bool(order / HALF_A_DECADE <= h <= order * HALF_A_DECADE)

    why = (
        f"Half of the steps are longer than {number(run['h_median'])} s, none than {number(run['h_max'])} s. They are limited by the "
        "convergence of the sweeps, not by the error."
    )
    return Judgement(f"median {number(run['h_median'])} s", grade(near(run["h_median"]), near(run["h_max"])), why)


def _soft_steps(rows: Rows) -> Judgement:
    return _steps(SOFT, rows)


def _stiff_steps(rows: Rows) -> Judgement:
    return _steps(STIFF, rows)


def _works(rows: Rows) -> Judgement:
    runs = [_paper(rows, case) for case in (SOFT, STIFF)]
    good = [bool(run["status"] == "REACHED_END" and run["error_tip"] < FOLLOWS) for run in runs]
    errors = " and ".join(f"{number(run['error_tip'])} m" for run in runs)
    why = "At its tolerances, against an explicit method of order 8 on the equations without constraints. The start is this project's choice."
    return Judgement(f"tip errors {errors}", grade(all(good), any(good)), why)


def _time(rows: Rows) -> Judgement:
    soft, stiff = _paper(rows, SOFT), _paper(rows, STIFF)
    ratios = {what: stiff[what] / soft[what] for what in ("cpu_s", "n_evaluations")}
    met = [ratio >= A_LOT for ratio in ratios.values()]
    why = (
        f"Printed times: × {SECONDS[STIFF] / SECONDS[SOFT]:.0f}. The largest frequency grows by 10, so for equal lengths sweeps need ten "
        "times the steps; the paper does not tell the lengths of its runs."
    )
    number_ = f"time × {ratios['cpu_s']:.1f}, evaluations × {ratios['n_evaluations']:.1f}"
    return Judgement(number_, grade(all(met), any(met)), why)


def _explicit(rows: Rows) -> Judgement:
    _paper(rows, STIFF)
    counts = {}
    for solver in (EXPLICIT, PAPER, NEWTON):
        runs = pick(rows, "beam", group="run", case=STIFF, solver=solver)
        counts[solver] = time_for(runs.assign(error_q=runs["error_tip"]), TARGET, "n_evaluations")
    explicit, paper, newton = (counts[solver] for solver in (EXPLICIT, PAPER, NEWTON))
    if not np.isfinite(list(counts.values())).all():
        raise NoRows(f"not all of {', '.join(counts)} reach a tip error of {TARGET:g} m")
    why = (
        f"Evaluations for a tip error of {TARGET:g} m, moderately stiff beam: {EXPLICIT} {number(explicit)}, {PAPER} {number(paper)}, "
        f"{NEWTON} {number(newton)}. Sweeps have a step limit like an explicit method's, and pay for every step several times; what "
        "stiffness asks for is an implicit method whose equations are solved by Newton's."
    )
    return Judgement(f"explicit / paper's {explicit / paper:.2g}", grade(explicit > paper, explicit > newton), why)


def _agreement(rows: Rows) -> Judgement:
    runs = pick(rows, "beam", group="sensitivity", case=SOFT)
    small = runs[runs["solver"].str.contains("0.1 %", regex=False)]
    raise NoRows(
        "the results that the paper compares with are lost. But a change of E or g by 0.1 % moves the tip by at most "
        f"{number(1e3 * small['before'].max())} mm until 1.2 s and by up to {number(1e3 * small['largest'].max())} mm afterwards, so "
        "that good results of slightly different models must part about there"
    )


def _stiff_agreement(rows: Rows) -> Judgement:
    runs = pick(rows, "beam", group="sensitivity", case=STIFF)
    small = runs[runs["solver"].str.contains("0.1 %", regex=False)]
    raise NoRows(
        "the results that the paper compares with are lost. A change of E or g by 0.1 % moves the tip by at most "
        f"{number(1e3 * small['largest'].max())} mm in the whole run, so that such results should agree"
    )


def _force(rows: Rows) -> Judgement:
    worst = value(rows, "elastic force", "largest difference from the slope of the energy", problem=None)
    why = (
        "ε there must be a row: as the column that it is declared, it has to stand transposed, (∂ε/∂e)ᵀ E ε. The matrix E is that of "
        "plane strain for the shear 2 ε12."
    )
    return Judgement(f"off by {worst:.1g}, relative", grade(worst < ROUNDING), why)


_RUN = "Its procedure at Atol = Rtol = 1e-5, err_in = err_out = 1e-9, for 2 s; start chosen here (only the base node moves)."
_PICKED = f"group = run; solver = {PAPER}; tol = {PAPER_TOL:g}"

CLAIMS: tuple[Claim, ...] = (
    Claim(
        "4.2",
        "The elastic force is minus the integral of strain, elasticity and the strain's derivative.",
        "The force of the project's elements, so integrated, against differences of their strain energy.",
        {"claims": ("check = elastic force", ("value",))},
        f"Holds if they differ by less than {ROUNDING:g}.",
        _force,
    ),
    Claim(
        "4.2",
        "For a flexible body in absolute nodal coordinates an implicit method is needed.",
        "The moderately stiff beam with SciPy's explicit DOP853 (projected), the paper's procedure, and Newton's method as the outer loop.",
        {"beam": ("group = run; case = moderately stiff", ("error_tip", "n_evaluations"))},
        f"Holds if DOP853 takes more evaluations than the paper's procedure for a tip error of {TARGET:g} m; with conditions if more than Newton's method only.",
        _explicit,
    ),
    Claim(
        "4.2",
        "The steps with the very flexible beam are of the order of 1e-3 s.",
        _RUN,
        {"beam": (f"{_PICKED}; case = {SOFT}", ("h_median", "h_max"))},
        "Holds if the median is within half a decade; with conditions if the longest step is.",
        _soft_steps,
    ),
    Claim(
        "4.2",
        "The steps with the moderately stiff beam are of the order of 1e-5 s.",
        _RUN,
        {"beam": (f"{_PICKED}; case = {STIFF}", ("h_median", "h_max"))},
        "Holds if the median is within half a decade; with conditions if the longest step is.",
        _stiff_steps,
    ),
    Claim(
        "4.2",
        "The new procedure works for the very flexible and the moderately stiff beam.",
        _RUN,
        {"beam": (_PICKED, ("status", "error_tip"))},
        f"Holds if both runs reach their end with tip errors below {FOLLOWS:g} m, with conditions if one does.",
        _works,
    ),
    Claim(
        "4.2",
        "With a stiffer beam the computation time grows a lot.",
        _RUN,
        {"beam": (_PICKED, ("cpu_s", "n_evaluations"))},
        f"Holds if time and evaluations grow by {A_LOT:g} or more between the cases, with conditions if one does.",
        _time,
    ),
    Claim(
        "4.2",
        "The very flexible results agree with published ones until 1.2 s; later they differ and stay reasonable.",
        "The beam with E or g changed by 0.1 %.",
        {"beam": (f"group = sensitivity; case = {SOFT}", ("before", "largest"))},
        "Needs the published results.",
        _agreement,
    ),
    Claim(
        "4.2",
        "The moderately stiff results agree with published ones.",
        "The beam with E or g changed by 0.1 %.",
        {"beam": (f"group = sensitivity; case = {STIFF}", ("largest",))},
        "Needs the published results.",
        _stiff_agreement,
    ),
)
