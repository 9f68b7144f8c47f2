"""The catalogue: every solver that the studies compare, one entry each, usable on any case.

The other solvers are the `LINES` of `references/`, found by their place. A solver that needs a model of its own
(Exudyn) or compiled functions (IDA from C) refuses cases that it cannot run, and the refusal becomes a row. Packages of
others are imported when they are used, so that a missing one is a row, too.
"""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np

from references.driver import user_call
from references.exudyn.model import SOLVERS as EXUDYN_SOLVERS
from references.lines import Line, lines
from references.minimal.solvers import FAMILY as MINIMAL_FAMILY
from references.paper.gear import HIGHEST
from references.paper.gear import name_of as gear
from references.scipy.index1 import baumgarte
from studies.bench.collector import Case, NotApplicable, Solver
from twoloop import Result, RungeKutta, paper_irk, paper_newmark, solve_dae
from twoloop.methods.auto import LOOSE, TIGHTEST
from twoloop.methods.plan import Method
from twoloop.methods.presets import Compiled
from twoloop.methods.tableaux import sun_radau_iib

TOLERANCES = tuple(float(f"1e-{k}") for k in range(3, 14))  # of all solvers that have one: no gap of over a decade
ERR_OUT = (1e-3, 1e-5, 1e-7, 1e-9)  # of the paper's procedures
ERR_IN = 1e-9  # err_in and ...
PAPER_TOL = 1e-5  # ... Atol = Rtol of the paper
NEWTON_SHARE = 0.1  # of the steps with a new Jacobian, from which on a run of the default counts as implicit
NUDGE = 1e-5  # IDA's error scatters with rounding: repeats differ by this in rtol, and the median error is shown

IRK, NEWMARK, QUARTER = "PaperIRK", "PaperNewmark (beta = 1/2)", "PaperNewmark, beta = 1/4"
IRK_LINE = "PaperIRK, Atol = Rtol varied"
IDA_C, IDA_C_ORDER_2 = "IDA from C, stabilised", "IDA from C, order 2, positions tested"
IDA_C_BANDED = "IDA from C, order 2, banded"  # of systems with a bandwidth, with positions tested
IDA_C_STATES = "IDA from C, q and v tested"
ADAMS, TAYLOR = "Adams", "Taylor"
OWN_EXPLICIT, OWN_BDF = "DOP853 (twoloop)", "BDF"  # presets; the other lines of the first name are SciPy's
DEFAULT = "auto"  # of solve_dae, without code made for the mechanism
GIVEN = "the default"  # of solve_dae as it is called with no options: it makes code for small mechanisms
# with code made for the mechanism, and the method of each
COMPILED = {f"{method}, compiled": method for method in (DEFAULT, TAYLOR, ADAMS, "DOP853")}
RADAU = ("RadauIIA5", "RadauIIA9", "RadauIIA13")
IMPLICIT = ("SunRadau5", "Gauss6", "Gauss12", *RADAU, "TRBDF2", "ESDIRK4", "Newmark", OWN_BDF)
PRESETS = (*IMPLICIT, OWN_EXPLICIT, ADAMS, TAYLOR)  # of twoloop, with their own options
# of ours, beside the other solvers
OWN = (*(*COMPILED, DEFAULT, TAYLOR, ADAMS, OWN_EXPLICIT), *("Gauss12", "Gauss16", *RADAU, "TRBDF2", OWN_BDF))
IDA_INDEX_1 = "IDA, index1"
EXUDYN = tuple(EXUDYN_SOLVERS)
HEYOKA, CYRK, CVODE_C, DIFFRAX = "heyoka", "CyRK, DOP853", "CVODE from C, Adams", "Dopri8, diffrax"
CVODES = "CVODES, CasADi"
CVODE_C_PROJECTED = "CVODE from C, BDF, projected"
SAME_IN_LINES = ("traces", "builds_each", "builds_span", "fixed")
GEAR_ORDERS = tuple(range(1, HIGHEST + 1))

# other projects' solvers, the same beside ours in every table: called from compiled code, then from Python
OTHER_SOLVERS = tuple(line.name for line in lines() if line.compared)
# in minimal coordinates, where these have a closed form: no solvers of a DAE, and in no ranking
MINIMAL = tuple(line.name for line in lines() if line.family == MINIMAL_FAMILY)

# of ours what `compare` and the cases at length run, and with enough other solvers for a mechanism of a user's own
COMPARED_OWN = ("auto, compiled", DEFAULT, TAYLOR, ADAMS, OWN_EXPLICIT, "Gauss12", "SunRadau5", "RadauIIA5", "BDF")
COMPARED = (
    *(*COMPARED_OWN, HEYOKA, CYRK, "CyRK, Radau", CVODE_C, "CVODE from C, BDF"),
    *(IDA_C, "IDA, stabilised", "LSODA, index 1", "DOP853, index 1", "DOP853, projected", "Radau, index 1"),
)


def _preset(method: str | Method, case: Case, tolerance: float, repeat: int, compiled: Compiled = False) -> Result:
    # runs that begin later are made only after one like them has ended. A limit takes 0.4 ms in large systems, where a
    # thread watches it, that a user without one does not pay
    start, limit = case.start, None if case.t0 else case.time_limit
    with user_call:  # as around the calls of other solvers: nothing of the study is timed
        return solve_dae(*start, method, tolerance, tolerance, time_limit=limit, compiled=compiled)


def _chosen(tolerance: float, result: Result) -> str:
    """What the default took: Newton's method, of which there are three by tolerance, or an explicit one."""
    stats = result.stats
    if (stats.n_jacobians or 0) < NEWTON_SHARE * (stats.n_accepted or 1):
        return "explicit"
    return "Newton, " + ("loose" if tolerance >= LOOSE else "tight" if tolerance >= TIGHTEST else "tightest")


def _traced(method: str, compiled: bool, case: Case, tolerance: float, repeat: int) -> Result:
    """`NotApplicable` where the callbacks cannot be run on symbols, which is a ValueError of `solve_dae`."""
    try:
        return _preset(method, case, tolerance, repeat, compiled)
    except ValueError as why:
        raise NotApplicable(str(why)) from None


def _paper_irk(case: Case, tolerance: float, repeat: int) -> Result:
    err_out = max(1e-4 * tolerance, 1e-14)  # smaller ones are below rounding
    method = RungeKutta(sun_radau_iib(3), "paper", "richardson-paper", ERR_IN, err_out)
    return _preset(method, case, tolerance, repeat)


def _paper(make: Callable[[float], Method], case: Case, err_out: float, repeat: int) -> Result:
    return _preset(make(err_out), case, PAPER_TOL, repeat)


def at_instants(solve: Callable[..., Result], case: Case, **options: Any) -> Result:
    """A run of a solver that tells its states at the common instants."""
    return solve(*case.start, t_eval=np.append(0.0, case.instants), time_limit=case.time_limit, **options)


def _by_line(line: Line, case: Case, value: float, repeat: int) -> Result:
    if line.compiled_callbacks and case.problem.system.called_in_python:
        raise NotApplicable(f"{line.name!r} needs compiled functions; those of this mechanism are plain Python")
    near = value * (1.0 + NUDGE * repeat * line.scatters)
    told: dict[str, Any] = {"step": value} if line.setting == "h" else {"rtol": near, "atol": value}
    if line.one_tolerance:
        told = {"tol": value}
    if not line.stores_steps:
        told["t_eval"] = np.append(0.0, case.instants)
    start = (case.problem, case.t_end) if line.of_problem else case.start
    return line.solve(*start, time_limit=case.time_limit, **told, **line.options)


def paper_irk_at(err_in: float) -> Solver:
    """The paper's Runge-Kutta procedure along err_out, Atol = Rtol = 1e-5."""
    run, fixed = partial(_paper, partial(paper_irk, err_in)), {"err_in": err_in, "tol": PAPER_TOL}
    return Solver(IRK, "two-loop", "compiled", True, "err_out", run, ERR_OUT, fixed)


def paper_newmark_at(err_in: float, beta: float = 0.5) -> Solver:
    """The paper's Newmark procedure along err_out."""
    name, run = NEWMARK if beta == 0.5 else QUARTER, partial(_paper, partial(paper_newmark, err_in, beta=beta))
    return Solver(name, "two-loop", "compiled", True, "err_out", run, ERR_OUT, {"err_in": err_in})


def _solver(name: str, family: str, called_from: str, setting: str, run: Any, **more: Any) -> Solver:
    values = TOLERANCES if setting == "tol" else ()
    return Solver(name, family, called_from, more.pop("keeps", True), setting, run, values, **more)


def _all() -> Iterator[Solver]:
    yield paper_irk_at(ERR_IN)
    yield _solver(IRK_LINE, "two-loop", "compiled", "tol", _paper_irk)
    yield paper_newmark_at(ERR_IN)
    yield paper_newmark_at(ERR_IN, 0.25)
    run = partial(_preset, DEFAULT, compiled="auto")
    yield _solver(GIVEN, "two-loop", "compiled", "tol", run, used=_chosen)
    for preset in dict.fromkeys((DEFAULT, *PRESETS, *OWN)):
        run = partial(_preset, "DOP853" if preset == OWN_EXPLICIT else preset)
        if preset == TAYLOR or preset in COMPILED:
            run = partial(_traced, COMPILED.get(preset, preset), preset in COMPILED)
        used = _chosen if COMPILED.get(preset, preset) == DEFAULT else None
        yield _solver(preset, "two-loop", "compiled", "tol", run, used=used, traces=preset in COMPILED)
    for line in lines():
        told = {each: getattr(line, each) for each in SAME_IN_LINES}
        run = partial(_by_line, line)
        yield _solver(line.name, line.family, line.called_from, line.setting, run, keeps=line.keeps, **told)


CATALOGUE: dict[str, Solver] = {solver.name: solver for solver in _all()}

# one sensible setting of each, for studies that show a run of every solver: two-loop procedures first
LINE_UP: dict[str, float] = dict.fromkeys((IRK, NEWMARK, QUARTER), 1e-9) | dict.fromkeys((GIVEN, *PRESETS), 1e-8)
LINE_UP |= {"Newmark": 1e-6}  # of order 2: ten times the steps at 1e-8
LINE_UP |= dict.fromkeys((IDA_INDEX_1, "IDA, stabilised", IDA_C, HEYOKA, CVODE_C, "LSODA, index 1"), 1e-8)
LINE_UP |= dict.fromkeys(("DOP853, index 1", "DOP853, projected", baumgarte("DOP853", 10.0)), 1e-8)
LINE_UP |= dict.fromkeys((*(f"Exudyn, {solver}" for solver in EXUDYN), "Exudyn, GeneralizedAlpha 0.6"), 1e-3)
LINE_UP |= dict.fromkeys(("Exudyn, GeneralizedAlpha 1", gear(2), gear(5)), 1e-3)
