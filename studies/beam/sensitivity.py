"""How far the tip's motion depends on the model: beams that differ a little."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from studies.beam.limits import Row
from studies.beam.runs import NEWTON
from studies.bench.cases.beam import SOFT, STIFF
from studies.bench.collector import Array, Case
from twoloop import solve_dae
from twoloop.mechanisms import ancf_beam
from twoloop.mechanisms.ancf_beam import tip_height

TOL = {SOFT: 1e-4, STIFF: 1e-3}  # of RadauIIA5, whose error then is far below all differences
PARTING = 1.2  # s, until which the paper's very flexible results agree with those that it compares with
PARAMETERS, MESH, START = ("E + 0.1 %", "g + 0.1 %"), "8 elements", "start of the whole beam"
CHANGES = (*PARAMETERS, MESH, START)


def sensitivity_rows(known: dict[str, Case]) -> Iterator[Row]:
    """Largest change of the tip's height, until the paper's 1.2 s and over the run, of beams that differ a little."""
    for name, case in known.items():
        times = np.append(0.0, case.instants)
        given = dict(case.problem.parameters)
        changed: list[dict[str, Any]] = [{key: 1.001 * given[key]} for key in ("youngs_modulus", "gravity")]
        changed += [{"n_elements": 8}, {"start": "beam"}]  # in the order of CHANGES
        given_tip = _tip(given, TOL[name], times)
        for change, what in zip(CHANGES, changed, strict=True):
            off = np.abs(_tip({**given, **what}, TOL[name], times) - given_tip)
            row: Row = {"group": "sensitivity", "case": name, "solver": change, "t_end": case.t_end}
            yield row | {"before": float(off[times <= PARTING].max()), "largest": float(off.max())}


def _tip(parameters: dict[str, Any], tol: float, times: Array) -> Array:
    problem, span = ancf_beam(**parameters), (0.0, float(times[-1]))
    start = problem.q0, problem.v0
    result = solve_dae(problem.system, span, *start, method=NEWTON, rtol=tol, atol=tol, t_eval=times)
    if not result.success:
        raise RuntimeError(f"a changed beam, {parameters}: {result.message}")
    return np.asarray(tip_height(result.q))
