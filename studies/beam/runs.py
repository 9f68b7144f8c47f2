"""The runs of the beam study: solvers, settings, and the tip's error by which they are judged."""

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any

import numpy as np
import pandas as pd

from studies.bench import Array, Case, Run, Solver
from studies.cases import beam
from studies.cases.beam import SOFT, STIFF
from studies.metrics import ASTRAY
from studies.solvers import CATALOGUE, IDA_C, IDA_C_ORDER_2, IRK, NEWMARK, OWN_EXPLICIT, QUARTER, two_loop
from twoloop import ConstrainedSystem, Result, RungeKutta, solve_dae
from twoloop.mechanisms import Problem
from twoloop.mechanisms.ancf_beam import tip_height
from twoloop.plan import Method
from twoloop.tableaux import gauss, radau_iia

PAPER = IRK
NEWTON, NEWTON_4, NEWTON_5 = "RadauIIA5", "RadauIIA7, Newton", "RadauIIA9, Newton"
DIFFERENCES, NEWTON_GAUSS = "RadauIIA7, Newton, by differences", "Gauss6, Newton"
FIXED_POINT = ("Gauss6", "BDF", "Newmark")
EXPLICIT = "DOP853, projected"  # SciPy's
EXUDYN = "Exudyn, GeneralizedAlpha, its own cable"
IDA = "IDA, stabilised"
PAPER_TOL = 1e-5  # Atol = Rtol of the paper, in Sect. 4.1

LOOSE = (1e-1, 3e-2, 1e-2, 3e-3, 1e-3, 1e-4)  # of runs with Newton's method, repeated three times
PAPER_TOLERANCES = (1e-1, 1e-3, PAPER_TOL, 1e-7)  # its error is that of rounding from the loosest on
ERR_OUT = (1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 3e-10)  # of PaperNewmark
NEWMARK_TOLERANCES = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6)  # its steps shrink with the cube root
SLOW_TOLERANCES = (1e-1, 1e-2, 1e-3, 1e-4, 1e-6)  # of SciPy's implicit solvers
PEER_TOLERANCES = (1e-2, 1e-4, 1e-6)  # of the package solve_dae, all Python
PEERS = ("Radau, solve_dae", "Radau9, solve_dae", "BDF, solve_dae")
EXUDYN_STEPS = (1000, 2000, 5000, 10_000, 20_000, 50_000)
EXUDYN_FINE = (100_000, 200_000)  # of the motion against which Exudyn is judged: its own
INSTANTS = 1000
QUICK = (PAPER, NEWTON, NEWTON_4, "BDF", "Gauss6", OWN_EXPLICIT)  # IDA takes seconds to compile
QUICK_TOLERANCES = (1e-1, 1e-3)


def with_less_known(problem: Problem, tangent: bool = False) -> ConstrainedSystem:
    """The same system without the bandwidth of its matrices and, unless `tangent`, the tangent of its force."""
    system = problem.system
    f = system.functions._asdict()
    for name in ("p", "flags", "force_by_v", "reaction_by_q", *(() if tangent else ("force_by_q",))):
        f.pop(name)
    sizes = {"n_q": system.n_q, "n_c": system.n_c, "parameters": system.parameters}
    return ConstrainedSystem(**sizes, **f, constant_mass=True, name=problem.name)  # type: ignore[arg-type]


def _two_loop(method: str | Method, case: Case, tol: float, repeat: int) -> Result:
    return two_loop(method, case.problem, case.t_end, tol, repeat)


def _by_differences(case: Case, tol: float, repeat: int) -> Result:
    problem, method = case.problem, RungeKutta(radau_iia(4), "newton")
    system, span = with_less_known(problem), (0.0, case.t_end)
    return solve_dae(system, span, problem.q0, problem.v0, method=method, rtol=tol, atol=tol)


def _exudyn(case: Case, step: float, repeat: int) -> Result:
    from references.exudyn_beam import solve_exudyn_beam

    n_steps = round(case.t_end / step)
    return solve_exudyn_beam(case.problem, case.t_end, n_steps, store_every=max(1, n_steps // INSTANTS))


def solvers() -> dict[str, Solver]:
    """The line-up by name: the catalogue's, and those that only this study has."""
    made = [replace(CATALOGUE["PaperIRK, Atol = Rtol varied"], name=PAPER, values=PAPER_TOLERANCES)]
    made += [replace(CATALOGUE[name], values=ERR_OUT) for name in (NEWMARK, QUARTER)]
    own = {NEWTON_4: RungeKutta(radau_iia(4), "newton"), NEWTON_5: RungeKutta(radau_iia(5), "newton")}
    own[NEWTON_GAUSS] = RungeKutta(gauss(3), "newton")
    runs = {name: partial(_two_loop, method) for name, method in own.items()} | {DIFFERENCES: _by_differences}
    made.append(CATALOGUE[NEWTON])
    made += [Solver(name, "two-loop", "compiled", True, "tol", run) for name, run in runs.items()]
    made += [CATALOGUE[name] for name in ("SunRadau5", *FIXED_POINT, OWN_EXPLICIT, IDA_C, IDA_C_ORDER_2, IDA)]
    made += [CATALOGUE[name] for name in (EXPLICIT, "Radau, index 1", "BDF, index 1", *PEERS)]
    made.append(Solver(EXUDYN, "Exudyn", "compiled, base in Python", True, "h", _exudyn))
    return {solver.name: solver for solver in made}


def values_of(solver: Solver, case: Case) -> tuple[float, ...]:
    """Settings of a solver on a beam, loose to tight."""
    own = {PAPER: PAPER_TOLERANCES, NEWMARK: ERR_OUT, QUARTER: ERR_OUT, "Newmark": NEWMARK_TOLERANCES}
    own |= dict.fromkeys(("Radau, index 1", "BDF, index 1"), SLOW_TOLERANCES) | dict.fromkeys(PEERS, PEER_TOLERANCES)
    own[EXUDYN] = tuple(case.t_end / n for n in EXUDYN_STEPS)
    return own.get(solver.name) or solver.grid(case)


def cases(quick: bool) -> dict[str, Case]:
    """Both beams by their names in this study."""
    return {name: beam.case(name, name, quick) for name in (SOFT, STIFF)}


def runs(known: dict[str, Case], quick: bool) -> Iterator[Run]:
    """The cells: a solver at one setting on one beam."""
    for name, case in known.items():
        for solver in solvers().values():
            if quick and solver.name not in QUICK:
                continue
            values = values_of(solver, case)
            if quick:
                values = (PAPER_TOL,) if solver.name == PAPER else QUICK_TOLERANCES
            long = solver.called_from == "Python" or (name == STIFF and solver.name in (PAPER, NEWMARK, QUARTER))
            for value in values:
                short = (
                    not quick and not long and (solver.setting == "h" or value in LOOSE or solver.family != "two-loop")
                )
                yield Run(case, solver, value, "run", 3 if short else 1)


@lru_cache
def _exudyn_motion(kind: str, t_end: float) -> tuple[Array, float]:
    """Exudyn's own tip at the common instants in fine steps, and how far it is from that in half as many."""
    from references.exudyn_beam import solve_exudyn_beam

    coarse, fine = (
        tip_height(solve_exudyn_beam(beam.MAKE[kind](), t_end, n, store_every=n // INSTANTS).q) for n in EXUDYN_FINE
    )
    return np.asarray(fine), float(np.abs(fine - coarse).max())


def tip_error(case: Case, result: Result) -> float | None:
    """Largest error of the tip's height, at the ends of the run's own steps beside the common instants."""
    if not result.success or result.t.size < 2:
        return None
    left = np.clip(np.searchsorted(result.t, case.instants, side="right") - 1, 0, result.t.size - 2)
    chosen = np.unique(np.concatenate([left, left + 1]))
    true, _ = case.reference.states(result.t[chosen])
    return float(np.abs(tip_height(result.q[:, chosen]) - tip_height(true)).max())


def measure(run: Run, result: Result) -> dict[str, Any]:
    """Columns of this study: the tip's error, by which all is ranked, and the steps taken."""
    case, h = run.case, result.h
    row: dict[str, Any] = {"n_rejected_convergence": result.stats.n_rejected_convergence}
    row |= {"h_median": float(np.median(h)) if h.size else None, "h_max": float(h.max()) if h.size else None}
    row["t_reached"] = float(result.t[-1]) if result.t.size else 0.0
    if run.solver.name == EXUDYN:
        tip, floor = _exudyn_motion(case.name, case.t_end)
        row["error_tip"] = float(np.abs(tip_height(result.q) - tip).max()) if result.success else None
        row["floor"] = floor
    else:
        row["error_tip"] = tip_error(case, result)
    span = float(np.ptp(tip_height(case.reference.states(case.instants)[0])))
    row["astray"] = row["error_tip"] is None or row["error_tip"] > ASTRAY * span
    return row


def by_tip(rows: pd.DataFrame) -> pd.DataFrame:
    """The runs among the rows, with the tip's error as the error by which `tables` and `figures` go."""
    found = rows[rows["group"] == "run"]
    return found.assign(error_q=found["error_tip"])
