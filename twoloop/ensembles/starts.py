"""Check the starts and parameters of many runs, and expand them to one row for each run."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.arguments import Array, check_real, shaped, shown, wrong_entries
from twoloop.problem.system import ConstrainedSystem

MAX_ROUNDING_ERRORS = 1e4  # largest residual of a consistent start, in rounding errors of its terms
# velocity for which rounding errors of a run at rest are computed, relative to the largest velocity of all runs
MIN_SPEED_RATIO = 1e-3
N_AVERAGED_RUNS = 16  # number of runs, besides the extreme ones, whose parameters are averaged (generic parameters)


@dataclass
class Starts:
    """Starts of runs at t0, and their parameters, one row per run."""

    t0: float
    q: Array
    v: Array
    parameters: Array

    def subset(self, which: NDArray[np.intp]) -> "Starts":
        """Return the starts of the runs with the indices `which`."""
        return Starts(self.t0, self.q[which], self.v[which], self.parameters[which])


def all_starts(
    system: ConstrainedSystem, t0: float, q0: Any, v0: Any, parameters: Any, names: tuple[str, str] = ("q0", "v0")
) -> Starts:
    """Return one row of starts and parameters for each run; raise TypeError or ValueError if an argument is wrong."""
    arrays = {name: check_real(name, value) for name, value in zip(names, (q0, v0), strict=True)}
    sizes = {**dict.fromkeys(names, system.n_q), "parameters": system.parameters.size}
    if parameters is not None:
        arrays["parameters"] = check_real("parameters", parameters)
    row_counts = {}
    for name, array in arrays.items():
        n = sizes[name]
        min_ndim = 2 if name == "parameters" else 1
        if array.ndim not in (min_ndim, 2) or array.shape[-1] != n or array.shape[0] == 0:
            single_shape = "" if name == "parameters" else f"({n},) or "
            raise ValueError(f"{name} must have shape {single_shape}(n_runs, {n}); given {shaped(array)}")
        if not np.isfinite(array).all():
            if array.ndim == 1:
                raise wrong_entries(name, "finite", array, ~np.isfinite(array))
            run = int(np.argwhere(~np.isfinite(array))[0][0])
            raise ValueError(f"{name} must be finite; row {run} is not: given {shown(array[run].tolist())}")
        if array.ndim == 2:
            row_counts[name] = len(array)
    if len(set(row_counts.values())) > 1:
        counts = ", ".join(f"{name} {count}" for name, count in row_counts.items())
        raise ValueError(f"{names[0]}, {names[1]} and parameters must have a row for each run; rows given: {counts}")
    n_runs = next(iter(row_counts.values()), 1)
    q, v = (np.array(np.broadcast_to(arrays[name], (n_runs, system.n_q)), order="C") for name in names)
    p = arrays.get("parameters", np.broadcast_to(system.parameters, (n_runs, sizes["parameters"])))
    return Starts(t0, q, v, np.array(p, order="C"))


def system_of(system: ConstrainedSystem, starts: Starts, run: int) -> ConstrainedSystem:
    """Return the system with the parameters of a run."""
    is_unchanged = np.array_equal(starts.parameters[run], system.parameters)
    return system if is_unchanged else system.with_parameters(starts.parameters[run])


def generic_system(system: ConstrainedSystem, starts: Starts) -> ConstrainedSystem:
    """Return the system with generic parameters, so that it has all terms, even those that are zero in some runs."""
    generic, _ = generic_parameters(starts.parameters)
    return system if np.array_equal(generic, system.parameters) else system.with_parameters(generic)


def writable_kit(system: ConstrainedSystem) -> tuple[Any, NDArray[np.int64]]:
    """Return a kit with parameters that may be overwritten, and [n_q, n_c, index of the first parameter]."""
    from twoloop.kernels.data.common import Kit

    new_system = system.with_parameters(system.parameters) if system.parameters.size else system
    return Kit(new_system.functions), np.array([system.n_q, system.n_c, int(system.called_in_python)], dtype=np.int64)


def is_inconsistent(kit: tuple[Any, NDArray[np.int64]], starts: Starts) -> NDArray[np.bool_]:
    """Return a mask of the starts whose C or C_q v + C_t is larger than the rounding of its terms."""
    from twoloop.kernels.lanes.starts import constraint_residuals

    functions, sizes = kit
    workspace, residuals = np.zeros(int(sizes[1] * (sizes[0] + 2))), np.zeros(len(starts.q))
    min_speed = MIN_SPEED_RATIO * float(np.abs(starts.v).max(initial=0.0))
    constraint_residuals(
        functions, sizes, starts.t0, min_speed, starts.parameters, starts.q, starts.v, workspace, residuals
    )
    return ~(residuals <= MAX_ROUNDING_ERRORS * np.finfo(float).eps)


def generic_parameters(parameters: Array) -> tuple[Array, list[int]]:
    """Return generic parameters, and the indices of those that vary between runs.

    Generic parameters are random averages over runs: they satisfy no relations that hold only in some of the runs.
    """
    is_varying = (parameters != parameters[:1]).any(axis=0)
    if not is_varying.any():
        return parameters[0], []
    varying = parameters[:, is_varying]
    extreme_runs = varying.argmin(axis=0), varying.argmax(axis=0)  # a parameter may vary in one run only
    spacing = max(1, len(parameters) // N_AVERAGED_RUNS)
    rows = parameters[np.concatenate([np.arange(0, len(parameters), spacing), *extreme_runs])]
    weights = np.random.default_rng(3).uniform(0.5, 1.5, len(rows))
    return np.where(is_varying, weights @ rows / weights.sum(), parameters[0]), np.flatnonzero(is_varying).tolist()
