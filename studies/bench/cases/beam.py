"""The paper's second example, a flexible beam on a moving base, very flexible and moderately stiff."""

from functools import partial
from typing import Any

import numpy as np

from references.scipy.beam_reduced import reduced_motion
from studies.bench.cli import StudyError
from studies.bench.collector import Case
from studies.bench.reference_motion import Quintic, ReferenceMotion
from twoloop import solve_dae
from twoloop.mechanisms import Problem, moderately_stiff_beam, very_flexible_beam

SOFT, STIFF = "very flexible", "moderately stiff"
MAKE = {SOFT: very_flexible_beam, STIFF: moderately_stiff_beam}
TAGS = {SOFT: ("stiff", "vibrations wanted"), STIFF: ("stiff", "vibrations irrelevant")}
T_END, T_END_QUICK = 2.0, 0.1  # s; the paper does not say how long its runs are
TIGHT = 1e-10  # tolerance of the reference
CHECK = 1e-9  # of the two runs that it is compared with
TOLERANCES = tuple(float(f"1e-{k}") for k in range(1, 9))  # from looser ones on: these step over vibrations
TIME_LIMIT = 30.0  # s, of a call; the paper's procedure takes a third of it on the processors seen so far
NOTE = (
    "The start is assumed, the paper's text does not tell it: straight along x, gravity across it, only the base node "
    "moving. Its figures are missing from the text that we worked from."
)


def _known(problem: Problem, t_end: float) -> ReferenceMotion:
    """DOP853 (twoloop), its own steps joined by quintics; the floor is its distance from two other ways.

    Gauss12 shares the equations and not the method; SciPy's DOP853 on the equations without constraints shares the
    forces and the tableau, and nothing of the two-loop procedure.
    """
    span, start = (0.0, t_end), (problem.q0, problem.v0)
    first = solve_dae(problem.system, span, *start, method="DOP853", rtol=TIGHT, atol=TIGHT)
    other = solve_dae(problem.system, span, *start, method="Gauss12", rtol=CHECK, atol=CHECK)
    for result in (first, other):
        if not result.success:
            raise StudyError(f"no reference for {problem.name}: {result.message}")
    motion = Quintic(first.t, first.q, first.v, first.a)
    differ = np.abs(motion(other.t)[0] - other.q).max()
    times = np.linspace(0.0, t_end, 101)[1:]
    apart = np.abs(motion(times)[0] - reduced_motion(problem, times, CHECK)[0]).max()
    source = (
        f"DOP853 (twoloop) at {TIGHT:.0e}, from which Gauss12 differs by {differ:.1e} and SciPy's DOP853 on the "
        f"equations without constraints by {apart:.1e}"
    )
    return ReferenceMotion(motion, float(max(differ, apart, motion.uncertainty(), 1e-13)), source)


def case(kind: str, name: str, quick: bool, t_end: float | None = None) -> Case:
    """One of the beams, SOFT or STIFF, over 2 s; quick: 0.1 s; or over `t_end`."""
    problem, t_end = MAKE[kind](), t_end or (T_END_QUICK if quick else T_END)
    # the base does work on the beam: its energy is no invariant
    about: dict[str, Any] = {"conserved": False, "watched": (problem.q0.size - 5,)}  # the tip's height
    about |= {"tolerances": TOLERANCES, "time_limit": TIME_LIMIT, "timed": 0.004 if quick else 0.1}
    return Case(name, problem, t_end, partial(_known, problem, t_end), tags=TAGS[kind], note=NOTE, **about)
