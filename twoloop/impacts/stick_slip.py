"""solve_with_friction: arcs of a motion in which joints slide, and stick, under dry friction."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from numpy.typing import ArrayLike

from twoloop.checks.arguments import check_span, check_times, shown
from twoloop.impacts.modes import Motion
from twoloop.impacts.motion import checked_options
from twoloop.impacts.rubbing import Rubbing
from twoloop.methods.plan import Method
from twoloop.result.result import Result

if TYPE_CHECKING:
    from twoloop.bodies.model_problem import ModelProblem


def solve_with_friction(
    problem: ModelProblem,
    t_span: tuple[float, float] | None = None,
    method: str | Method = "auto",
    rtol: float = 1e-8,
    atol: ArrayLike = 1e-8,
    *,
    t_eval: ArrayLike | None = None,
    **options: Any,
) -> Result:
    """Integrate a model with dry friction, and with stops if it has some: joints slide, stop, stick, and are released.

    While a joint slides, its friction is a constant force; while it sticks, a row of the constraints, which is released
    when its force exceeds the static friction. Where joints come to rest, those stick whose friction suffices, together
    (the box-constrained minimum of F^T D F / 2 + c^T F, with c the accelerations of the joints without friction); the
    forces of stops that stay closed are found with them. Impacts are those of `solve_with_stops`: friction that does
    not depend on the load has no impulse, so that joints that stick may be released by an impact.

    Parameters
    ----------
    problem : ModelProblem
        Of a model that has `dry_friction`; begins at its q0 and v0.
    t_span : (float, float), optional
        None: that of the problem.
    method, rtol, atol
        As for `solve_dae`.
    t_eval : array_like, optional
        Times at which to store the states. None: the ends of steps.
    **options
        Further keyword arguments of `solve_dae`: max_step, compiled, time_limit (of each arc), ...

    Returns
    -------
    Result
        `.arcs` are the runs between changes; the names of their systems say which joints stick, and on which stops
        bodies rest. `.impacts` as that of `solve_with_stops`.

    Raises
    ------
    TypeError, ValueError
        If an argument is wrong, the model has no dry friction, or a joint with it cannot slide by itself.

    Notes
    -----
    Changes are found as events are: a joint that stops and slides on the other way within a quarter of a step is
    missed; `max_step` helps.
    """
    from twoloop.bodies.model_problem import ModelProblem  # which imports much that other motions do without

    if not isinstance(problem, ModelProblem):
        raise TypeError(f"problem must be that of a model, what model.problem() returned; given {shown(problem)}")
    if problem.model is None:
        raise ValueError(f"{problem.name!r} came from another process without its model: make it again there")
    if not problem.model.dry:
        raise ValueError(
            f"{problem.name!r} has no dry friction: add some with model.dry_friction(...), or use solve_dae"
        )
    t0, t1 = problem.t_span if t_span is None else check_span(t_span)
    options |= checked_options("solve_with_friction", options, method, rtol, atol, problem.system.n_q)
    times = None if t_eval is None else check_times(t_eval, t0, t1, None)
    start = t0, problem.q0.copy(), problem.v0.copy()
    return Motion(problem.stops, Rubbing(problem), *start, options).to(t1, times)
