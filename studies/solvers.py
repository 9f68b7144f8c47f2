"""All solvers that the studies compare, by name: how to run each at one setting, a tolerance or a step."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from references import exudyn_four_bar, ida
from references.exudyn_four_bar import solve_exudyn
from references.gear import STARTS, solve_gear
from references.ida import solve_ida
from references.ida_c import solve_ida_c
from references.index1 import solve_index1
from studies.runs import Job
from twoloop import Result, RungeKutta, paper_irk, paper_newmark, solve_dae
from twoloop.mechanisms import Problem
from twoloop.plan import Method
from twoloop.tableaux import gauss, sun_radau_iib

ERR_IN = 1e-9  # err_in and ...
PAPER_TOL = 1e-5  # ... Atol = Rtol of the paper
INSTANTS = 2001  # output times of solvers that interpolate
STORED = 5000  # about as many steps of a fixed-step solver are stored
NUDGE = 1e-5  # IDA's error scatters with rounding: repeats differ by this in rtol, and the median error is the row's

IRK, NEWMARK, QUARTER = "PaperIRK", "PaperNewmark (beta = 1/2)", "PaperNewmark, beta = 1/4"
IRK_LINE = "PaperIRK, Atol = Rtol varied"
IDA_C = "IDA from C, stabilised"
CANONICAL = "Gauss6, momenta, symmetric"
OWN_EXPLICIT = "DOP853 (two-loop)"  # the preset "DOP853"; the other lines of this name are SciPy's
IMPLICIT = ("SunRadau5", "Gauss6", "Gauss12", "RadauIIA5", "Newmark", "BDF")
PRESETS = (*IMPLICIT, OWN_EXPLICIT)  # of twoloop, with their own options
ALPHAS = (1.0, 10.0, 100.0)  # 1/s, of Baumgarte
GEAR_ORDERS = (1, 2, 3, 4, 5, 6)


@dataclass(frozen=True)
class Solver:
    """A solver of the catalogue.

    Attributes
    ----------
    name : str
        Its line in tables and figures.
    setting : str
        What the one number is that `run` takes: "tol" (relative and absolute), "err_out" (Newmark's step-error
        tolerance) or "h" (fixed step, s).
    run : callable
        run(problem, t_end, value, k) integrates from the problem's start to t_end and returns a Result; k is the
        number of the repeat.
    fixed : mapping
        Settings that do not vary, for the row.
    two_loop : bool
        Whether it is a two-loop procedure of this project.
    own_a : bool
        Whether the accelerations in its results are not those of eq. (6) at its q and v, but unknowns of its own,
        differences of v, or with Baumgarte's terms.
    """

    name: str
    setting: str
    run: Callable[[Problem, float, float, int], Result]
    fixed: Mapping[str, float] = field(default_factory=dict)
    two_loop: bool = False
    own_a: bool = False

    def job(self, group: str, problem: Problem, t_end: float, value: float, repeats: int = 3) -> Job:
        """One run at the setting `value` as a job of a study."""
        settings = {**self.fixed, self.setting: value}
        return Job(group, self.name, problem, partial(self.run, problem, t_end, value), settings, repeats)


def two_loop(method: str | Method, problem: Problem, t_end: float, tolerance: float, k: int) -> Result:
    """Run a method of twoloop with rtol = atol = tolerance."""
    span = (0.0, t_end)
    return solve_dae(problem.system, span, problem.q0, problem.v0, method=method, rtol=tolerance, atol=tolerance)


def _paper_irk(problem: Problem, t_end: float, tolerance: float, k: int) -> Result:
    method = RungeKutta(sun_radau_iib(3), "paper", "richardson-paper", ERR_IN, 1e-4 * tolerance)
    return two_loop(method, problem, t_end, tolerance, k)


def _paper_irk_out(problem: Problem, t_end: float, err_out: float, k: int) -> Result:
    return two_loop(paper_irk(ERR_IN, err_out), problem, t_end, PAPER_TOL, k)


def _paper_newmark(beta: float, problem: Problem, t_end: float, err_out: float, k: int) -> Result:
    return two_loop(paper_newmark(ERR_IN, err_out, beta), problem, t_end, PAPER_TOL, k)


def _canonical(problem: Problem, t_end: float, step: float, k: int) -> Result:
    method = RungeKutta(gauss(3), variables="momenta", partition="symmetric")
    return solve_dae(problem.system, (0.0, t_end), problem.q0, problem.v0, method=method, step_size=step)


def _ida(form: str, problem: Problem, t_end: float, tolerance: float, k: int) -> Result:
    # scikit-sundae keeps every step by copying all before it: asked for few instants it is up to three times faster
    instants = np.linspace(0.0, t_end, INSTANTS)
    rtol = tolerance * (1.0 + NUDGE * k)
    return solve_ida(problem.system, (0.0, t_end), problem.q0, problem.v0, form, rtol, tolerance, t_eval=instants)


def _ida_c(problem: Problem, t_end: float, tolerance: float, k: int) -> Result:
    instants = np.linspace(0.0, t_end, INSTANTS)
    rtol = tolerance * (1.0 + NUDGE * k)
    return solve_ida_c(problem.system, (0.0, t_end), problem.q0, problem.v0, rtol, tolerance, t_eval=instants)


def _index1(
    method: str,
    stabilisation: str,
    alpha: float | None,
    problem: Problem,
    t_end: float,
    tolerance: float,
    k: int,
) -> Result:
    options = {"stabilisation": stabilisation, "alpha": alpha}
    span = (0.0, t_end)
    return solve_index1(problem.system, span, problem.q0, problem.v0, method, tolerance, tolerance, **options)  # type: ignore[arg-type]


def _exudyn(solver: str, options: Mapping[str, float], problem: Problem, t_end: float, step: float, k: int) -> Result:
    n_steps = round(t_end / step)
    return solve_exudyn(problem, t_end, n_steps, solver, **options, store_every=max(1, n_steps // STORED))  # type: ignore[arg-type]


def _gear(order: int, start: str, problem: Problem, t_end: float, step: float, k: int) -> Result:
    n_steps = round(t_end / step)
    every = max(1, n_steps // STORED)
    kept = np.append(np.arange(0, n_steps, every) * step, t_end)
    return solve_gear(problem.system, (0.0, t_end), problem.q0, problem.v0, step, order, start=start, t_eval=kept)


def baumgarte(method: str, alpha: float) -> str:
    """Name of one of SciPy's solvers with Baumgarte's stabilisation."""
    return f"{method}, Baumgarte {alpha:g}"


def gear(order: int, start: str = "accurate") -> str:
    """Name of the stand-in for ADAMS GSTIFF."""
    return f"GSTIFF stand-in, order {order}" + (", ramp" if start == "ramp" else "")


def _all() -> Iterator[Solver]:
    yield Solver(IRK, "err_out", _paper_irk_out, {"err_in": ERR_IN, "tol": PAPER_TOL}, two_loop=True)
    yield Solver(IRK_LINE, "tol", _paper_irk, two_loop=True)
    for name, beta in ((NEWMARK, 0.5), (QUARTER, 0.25)):
        yield Solver(name, "err_out", partial(_paper_newmark, beta), {"err_in": ERR_IN}, two_loop=True)
    for preset in PRESETS:
        method = "DOP853" if preset == OWN_EXPLICIT else preset
        yield Solver(preset, "tol", partial(two_loop, method), two_loop=True)
    yield Solver(CANONICAL, "h", _canonical, two_loop=True)
    for form in ida.FORMS:
        yield Solver(f"IDA, {form}", "tol", partial(_ida, form), own_a=True)
    yield Solver(IDA_C, "tol", _ida_c, own_a=True)
    for name in ("LSODA", "DOP853", "RK45"):
        yield Solver(f"{name}, index 1", "tol", partial(_index1, name, "none", None))
    for name in ("DOP853", "RK45"):
        yield Solver(f"{name}, projected", "tol", partial(_index1, name, "projection", None))
    for name in ("LSODA", "DOP853"):
        for alpha in ALPHAS:
            run = partial(_index1, name, "baumgarte", alpha)
            yield Solver(baumgarte(name, alpha), "tol", run, {"alpha": alpha}, own_a=True)
    for solver in exudyn_four_bar.SOLVERS:
        yield Solver(f"Exudyn, {solver}", "h", partial(_exudyn, solver, {}), own_a=True)
    for radius in (1.0, 0.6):
        run = partial(_exudyn, "GeneralizedAlpha", {"spectral_radius": radius})
        yield Solver(f"Exudyn, GeneralizedAlpha {radius:g}", "h", run, {"spectral_radius": radius}, own_a=True)
    for order in GEAR_ORDERS:
        for start in STARTS:
            yield Solver(gear(order, start), "h", partial(_gear, order, start), {"order": order}, own_a=True)


CATALOGUE: dict[str, Solver] = {solver.name: solver for solver in _all()}

# one sensible setting of each, for studies that show a run of every solver: two-loop procedures first
LINE_UP: dict[str, float] = {
    IRK: 1e-9,
    NEWMARK: 1e-9,
    QUARTER: 1e-9,
    **dict.fromkeys(PRESETS, 1e-8),
    CANONICAL: 0.01,
    **{f"IDA, {form}": 1e-8 for form in ida.FORMS},
    IDA_C: 1e-8,
    "LSODA, index 1": 1e-8,
    "DOP853, index 1": 1e-8,
    "DOP853, projected": 1e-8,
    baumgarte("DOP853", 10.0): 1e-8,
    **{f"Exudyn, {solver}": 1e-3 for solver in exudyn_four_bar.SOLVERS},
    "Exudyn, GeneralizedAlpha 0.6": 1e-3,
    "Exudyn, GeneralizedAlpha 1": 1e-3,
    **{gear(order): 1e-3 for order in (2, 5)},
}
