"""Which runs in lanes, whose steps do not look ahead, have forces or drives that change for a shorter time than looks.

As in single runs, of what is met once for less than two looks another one may have been passed over.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from twoloop.checks.arguments import Array
from twoloop.generate.parameter_expressions import ParameterTape
from twoloop.generate.program import OnArrays
from twoloop.generate.time_dependence import BY_TIME, TIME
from twoloop.generate.trace import Equations
from twoloop.kernels.control.sudden import FLOOR, LEAST, PLACES, SHARE, STEEPER  # what counts as sudden in single runs
from twoloop.problem.system import ConstrainedSystem

AT_ONCE = 30_000  # numbers that are compared together


class ShortLooks:
    """Looks at forces and drives of many runs, at times a two-thousandth of a run apart.

    Parameters
    ----------
    system : ConstrainedSystem
        Whose callbacks run on symbols, and have no nonholonomic rows.
    values, varying
        Of a `ParameterTape`: generic parameters, and which of them differ from run to run.
    """

    def __init__(self, system: ConstrainedSystem, values: Array, varying: Sequence[int]):
        self._record = ParameterTape(values.tolist(), varying)
        equations = Equations(system, self._record.parameters)
        self._graph = graph = equations.graph
        forms = np.concatenate([equations.of(kind).ravel() for kind in BY_TIME if kind in system.given])
        self._forms = np.array([x for x in forms if any(graph.inputs_of[i] & TIME for i in x.terms)], dtype=object)

    def meet(self, times: Array, rtol: float, parameters: Array, q: Array, v: Array) -> NDArray[np.bool_]:
        """Which runs, of these parameters, meet what lasts for less than two looks, or has no value.

        q, v : (n_runs, n), of one state of each run.
        """
        met = np.zeros(len(q), dtype=bool)
        size = max(1, AT_ONCE // max(1, len(times) * len(self._forms)))
        for begin in range(0, len(q), size):
            rows = slice(begin, begin + size)
            at = OnArrays(self._graph, self._record, parameters[rows])
            met[rows] = _are_short(at.evaluate([self._forms], times[:, None], q[rows], v[rows])[0], rtol)
        return met


def _are_short(values: Array, rtol: float) -> NDArray[np.bool_]:
    """In which runs some value, (n_times, n_runs, n), changes suddenly twice within two looks."""
    if not values.size:
        return np.zeros(values.shape[1], dtype=bool)
    finite: NDArray[np.bool_] = np.asarray(np.isfinite(values).all(axis=(0, 2)))
    values = np.where(finite[:, None], values, 0.0)
    least = np.maximum(FLOOR, LEAST * rtol * np.abs(values).max(axis=(0, 2)))
    size = PLACES + 1
    ranges = maximum_filter1d(values, size, axis=0) - minimum_filter1d(values, size, axis=0)
    change, within = np.diff(values, axis=0), np.maximum(ranges[:-1], ranges[1:])
    beside = np.zeros_like(change)
    direction = np.sign(change)
    beside[1:] = change[:-1] * direction[1:]
    beside[:-1] = np.maximum(beside[:-1], change[1:] * direction[:-1])
    flanks = (np.abs(change) > SHARE * within) & (STEEPER * beside < np.abs(change)) & (within > least[:, None])
    short = (flanks[:-1] & flanks[1:]).any(axis=(0, 2)) | (flanks[:-2] & flanks[2:]).any(axis=(0, 2))
    return np.asarray(short | ~finite)
