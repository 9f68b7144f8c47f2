"""Forces so short that a solver may step over them: how many runs end silently wrong, over random times of the force.

A gust exp(-(t / b)^2) has tails that may be seen from afar; a pulse, a constant force, is zero before and behind.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from typing import Any

import numpy as np
import pandas as pd

from studies.bench.end_states import EXACT
from studies.bench.sharp_forces import Sharp, gust, pulse
from studies.bench.sharp_mechanisms import Mechanism, bars
from studies.bench.sharp_mechanisms import chain as chain_of
from studies.bench.sharp_motion import motion
from studies.honesty.solvers import DEFAULT, LIMITED
from studies.honesty.traps import AGREE, GROWN, HELD_OUT_SEED, SHORT, Trap, of_force, pendulum

SHAPES = {"gust": gust, "pulse": pulse}
WIDTHS = (1e-4, 3e-4, 1e-3, 3e-3, 1e-2)  # s: b of a gust, duration of a pulse
N_DRAWS, N_QUICK, QUICK_WIDTHS = 8, 2, (1e-3,)  # of each width on each mechanism
SEED, PULSES = HELD_OUT_SEED, 1  # what begins the seeds of the draws; of pulses, behind the others
MISSED = {"some": True, "none": False}  # widths of which some runs of the default are off, or none


def two_points(sharp: Sharp) -> Mechanism:
    """A chain of two points of 1 kg on links of 1 m."""
    two = np.ones(2)
    return chain_of(sharp, two, two, np.array([1.0, 0.5]), 0.0 * two)


def name_of(shape: str, width: float) -> str:
    return f"{shape} of {1e3 * width:g} ms"


def traps(quick: bool) -> Iterator[Trap]:
    """Each width on each mechanism, at random times, drawn until two methods agree and errors do not grow.

    The motion (`sharp_motion.motion`) is by SciPy's DOP853 in steps of a fortieth of the gust's window, and by LSODA.
    """
    widths = enumerate(QUICK_WIDTHS if quick else WIDTHS)
    mechanisms = enumerate((pendulum,) if quick else (pendulum, bars, two_points))
    draws = range(N_QUICK if quick else N_DRAWS)
    for shape, (place, width), (k, bodies), draw in product(SHAPES, widths, mechanisms, draws):
        seed = [SEED, place, k, draw] + [PULSES] * (shape == "pulse")
        g, known = np.random.default_rng(seed), None
        while known is None or not (known.apart <= AGREE and known.growth <= GROWN):
            mechanism = bodies(SHAPES[shape](width)(name_of(shape, width), g))
            known = motion(mechanism)
        trap = of_force(mechanism, SHORT, partial(known.q.__getitem__, -1))
        yield replace(trap, mechanism=f"{mechanism.name}, draw {draw}")


def findings_of(ran: pd.DataFrame, wrong: Sequence[str]) -> dict[str, Any]:
    """Of each of SHAPES and each solver the runs with a `wrong` outcome, off by over EXACT, by width.

    Of the default also the widths of which some runs are that ("some"), and those of which none is ("none"), and its
    counts over all widths beside those of the best of the others with a largest step.
    """
    return {shape: _of_shape(shape, ran[ran["trap"].str.startswith(shape)], wrong) for shape in SHAPES}


def _of_shape(shape: str, ran: pd.DataFrame, wrong: Sequence[str]) -> dict[str, Any]:
    gross = ran["outcome"].isin(wrong) & ~(ran["error"].astype(float) <= EXACT)
    widths = [width for width in WIDTHS if (ran["trap"] == name_of(shape, width)).any()]
    lines: list[dict[str, Any]] = []
    for solver, own in ran.groupby("solver", sort=False):
        by = [gross[own.index[own["trap"] == name_of(shape, width)]] for width in widths]
        lines.append({"solver": str(solver), "at": [{"n": len(each), "gross": int(each.sum())} for each in by]})
    totals = {line["solver"]: {key: sum(at[key] for at in line["at"]) for key in ("n", "gross")} for line in lines}
    limited = [{"solver": name, **total} for name, total in totals.items() if name.endswith(LIMITED)]
    found: dict[str, Any] = {"widths": widths, "solvers": lines, "n": len(ran), "default": {}}
    found["best_limited"] = min(limited, key=lambda each: each["gross"] / each["n"], default=None)
    found["of_default"] = totals.get(DEFAULT)
    for line in lines:
        if line["solver"] == DEFAULT:
            found["default"] = {name: _of_widths(widths, line["at"], missed) for name, missed in MISSED.items()}
    return found


def _of_widths(widths: Sequence[float], at: Sequence[dict[str, int]], missed: bool) -> dict[str, Any]:
    """The widths at which some runs are off, or none, and their runs together."""
    own = [(width, each) for width, each in zip(widths, at, strict=True) if bool(each["gross"]) is missed]
    counts = {key: sum(each[key] for _, each in own) for key in ("n", "gross")}
    return counts | {"widths": [width for width, _ in own]}
