"""`solve_with_friction`: arcs in which joints slide or stick under dry friction."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from numpy.typing import ArrayLike

from twoloop.checks.arguments import check_span, check_times, shown
from twoloop.impacts.modes import Motion
from twoloop.impacts.motion import checked_options
from twoloop.impacts.rubbing import FrictionModes
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
    """Integrate a model with dry friction, and with its stops: joints slide, stop, stick, and are released.

    The friction of a sliding joint is a constant force; a sticking joint is a constraint, released when its force
    exceeds the static friction. When joints come to rest, their friction forces and the forces of closed stops are
    the bounded minimum of F^T D F / 2 + c^T F, with c the joint accelerations without friction; joints stick where the
    bound is not active. Impacts are those of `solve_with_stops`: load-independent friction causes no impulse, so an
    impact may release sticking joints.

    Parameters
    ----------
    problem : ModelProblem
        Problem of a model with `dry_friction`; the run starts at its q0 and v0.
    t_span : (float, float), optional
        None: the time span of the problem.
    method, rtol, atol
        As for `solve_dae`. While stops are closed, "auto" takes the place of "Taylor", which cannot trace their forces.
    t_eval : array_like, optional
        Output times. None: the ends of steps.
    **options
        Further keyword arguments of `solve_dae`: max_step, compiled, time_limit (of each arc), ...

    Returns
    -------
    Result
        `.arcs` are the runs between changes of mode; the names of their systems contain the sticking joints and the
        closed stops. `.impacts` as for `solve_with_stops`.

    Raises
    ------
    TypeError, ValueError
        If an argument is invalid, the model has no dry friction, or a joint with friction cannot slide independently.

    Notes
    -----
    Mode changes are located like events, by checks four times per step and at least every two-thousandth of the motion:
    a joint that reverses twice between two of these is missed; reduce `max_step` if needed.

    Examples
    --------
    >>> from twoloop import solve_with_friction
    >>> from twoloop.bodies import PlanarModel
    >>> model = PlanarModel(name="block")
    >>> block = model.box("block", (0.2, 0.1), mass=1.0, position=(0.0, 0.0), velocity=(1.0, 0.0))
    >>> rail = model.prismatic("ground", block, at=(0.0, 0.0), axis=(1.0, 0.0))
    >>> friction = model.dry_friction(rail, 2.0)
    >>> result = solve_with_friction(model.problem((0.0, 1.0)))
    >>> round(float(result.q[0, -1]), 6)  # v**2 / (2 a), m
    0.25
    """
    from twoloop.bodies.model_problem import ModelProblem  # slow to import

    if not isinstance(problem, ModelProblem):
        raise TypeError(f"problem must be a model's problem, as returned by model.problem(); given {shown(problem)}")
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
    return Motion(problem.stops, FrictionModes(problem), *start, options).to(t1, times)
