"""Validate the options of a call of `solve_dae`; calls with equal options can use the same cached integrator."""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.arguments import check_flag, check_positive, check_size, check_tolerance, shown
from twoloop.kernels.data import indices
from twoloop.methods.plan import Method
from twoloop.methods.presets import PRESETS, Compiled, check_compiled, identity, is_preset
from twoloop.problem.system import ConstrainedSystem
from twoloop.run.run import Run

SMALLEST_TOLERANCE = 1e-15  # rtol or atol must be at least this; else rounding would hide the errors of steps


@lru_cache(maxsize=1024)
def _unique_key(*_: Any) -> object:
    """Return the same object whenever the arguments are equal: a dict finds such a key faster than a tuple."""
    return object()


@dataclass(frozen=True)
class Options:
    """Validated options of a call of `solve_dae`, whose docstring explains the names."""

    method: Method
    rtol: float
    atol: NDArray[np.float64]
    first_step: float | None
    max_step: float
    max_steps: int | None
    step_size: float | None
    compiled: Compiled
    check_derivatives: bool

    @cached_property
    def key(self) -> object:
        """Key of the options in caches of integrators; equal options have the same object as key."""
        step_options = self.first_step, self.max_step, self.max_steps, self.step_size
        tolerances = self.rtol, self.atol.tobytes()
        return _unique_key(identity(self.method), *tolerances, *step_options, self.compiled, self.check_derivatives)

    @cached_property
    def own_tolerance(self) -> float | None:
        """Tolerance of a method with its own error test (Newmark), which ignores rtol and atol; else None."""
        return getattr(self.method, "error_tol", None)

    @cached_property
    def metadata(self) -> dict[str, Any]:
        """Fields `method` and `rtol` of a result, and `untested` = None (no step) if all steps test velocity errors."""
        tested = getattr(self.method, "tested", "all")
        return {"method": self.method.name, "rtol": self.rtol} | ({} if tested == "positions" else {"untested": None})

    def set_step_sizes(self, run: Run, t1: float) -> None:
        """Set the first step size and the limits of step sizes (s) of a run that ends at t1, unless steps are fixed."""
        run.work.notes[indices.NEXT_JUMP] = t1  # time of the next jump of C_t or b; t1 as long as none is known
        if self.step_size is None:
            run.set_step_sizes(self.first_step, self.max_step, t1)


NO_CALL: Any = (None,) * 12, None  # stands for (12 arguments, options) of the last call if there was no call yet


def options_of(
    system: ConstrainedSystem,
    method: Any,
    rtol: Any,
    atol: Any,
    first_step: Any,
    max_step: Any,
    max_steps: Any,
    step_size: Any,
    dense_output: Any,
    progress: Any,
    time_limit: Any,
    check_derivatives: Any,
    compiled: Any,
) -> Options:
    """Return the validated options of a call of `solve_dae`; raise TypeError or ValueError if one is wrong.

    If all arguments are the same objects as in the last call, they are not checked again.
    """
    last_arguments, options = system.shared.get("options", NO_CALL)
    m, r, a, first, longest, most, size, dense, shows, limit, checks, code = last_arguments
    # compare without a loop, which would take a tenth of the time of a short repeated call
    same = m is method and r is rtol and a is atol and first is first_step and longest is max_step and most is max_steps
    same = same and size is step_size and dense is dense_output and shows is progress and limit is time_limit
    if same and checks is check_derivatives and code is compiled:
        return options  # type: ignore[no-any-return]
    check_flag("dense_output", dense_output)
    if progress is not None:
        check_flag("progress", progress)
    generates = check_compiled(compiled)
    check_flag("check_derivatives", check_derivatives)
    method_object = check_method(method)
    check_positive("rtol", rtol)
    tolerances = check_tolerance("atol", atol, system.n_q)
    if max(rtol, tolerances.min()) < SMALLEST_TOLERANCE:
        raise ValueError(
            f"rtol and atol must not both be below {SMALLEST_TOLERANCE:g}, where rounding hides the error; given "
            f"{rtol!r} and {float(tolerances.min())!r}"
        )
    if first_step is not None:
        check_positive("first_step", first_step)
    check_positive("max_step", max_step, infinite=True)
    if step_size is not None:
        check_positive("step_size", step_size)
        if first_step is not None or max_step != np.inf:
            raise ValueError(
                "step_size is a constant step: give neither first_step nor max_step with it; given step_size = "
                f"{step_size!r}, first_step = {first_step!r}, max_step = {max_step!r}"
            )
    if max_steps is not None:
        check_size("max_steps", max_steps, 1)
    if time_limit is not None:
        check_positive("time_limit", time_limit)
    step_options = first_step, float(max_step), max_steps, step_size
    options = Options(method_object, float(rtol), tolerances, *step_options, generates, bool(check_derivatives))
    if type(atol) is float and is_preset(method):  # unlike arrays, these cannot change between calls
        arguments = method, rtol, atol, first_step, max_step, max_steps, step_size, dense_output, progress
        system.shared["options"] = (*arguments, time_limit, check_derivatives, compiled), options
    return options


def check_method(method: str | Method) -> Method:
    """Return the method object, given its name or the object itself; raise for any other argument."""
    names = ", ".join(PRESETS)
    if isinstance(method, str):
        if method not in PRESETS:
            raise ValueError(f"method must be one of {names}, or a method object; given {shown(method)}")
        return PRESETS[method]
    if isinstance(method, type) or not callable(getattr(method, "plan", None)):
        raise TypeError(
            f"method must be a name ({names}) or an object such as RungeKutta(gauss(3)); given {shown(method)}"
        )
    return method
