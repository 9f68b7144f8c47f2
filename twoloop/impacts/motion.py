"""`solve_with_stops`: arcs between impacts, and rest in contact with stops."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from typing import Any

from numpy.typing import ArrayLike

from twoloop.checks.arguments import check_positive, check_span, check_times, check_tolerance, check_vector, shown
from twoloop.impacts.modes import Motion
from twoloop.impacts.rubbing import Modes
from twoloop.methods.plan import Method
from twoloop.problem.description import Stop
from twoloop.problem.system import ConstrainedSystem, check_system
from twoloop.result.result import Result
from twoloop.solve import solve_dae

OF_A_RUN = {"system", "t_span", "q0", "v0", "method", "rtol", "atol", "t_eval", "step_size"}
OF_A_RUN |= {"events", "dense_output", "store"}


def solve_with_stops(
    system: ConstrainedSystem,
    t_span: tuple[float, float],
    q0: ArrayLike,
    v0: ArrayLike,
    stops: Stop | Sequence[Stop],
    method: str | Method = "auto",
    rtol: float = 1e-8,
    atol: ArrayLike = 1e-8,
    *,
    t_eval: ArrayLike | None = None,
    **options: Any,
) -> Result:
    """Integrate a system with stops: impacts with restitution, rest in contact, and release.

    An impact changes the velocities by impulses at the closed stops and the impulses of all constraints:
    M (v+ - v-) + C_q^T p = W^T P, with C_q v+ + C_t = 0. Where several stops are closed, the impulses follow from
    Moreau's law. The rebound height decreases by the square of the restitution; a rebound below a hundredth of `atol`
    ends in contact: the gap is then a constraint as long as its force pushes.

    Stops with friction slide or stick while they are closed, by Coulomb's law. In an impact, the impulse of friction
    stops the sliding, if the coefficient times the impulse of the stop suffices; otherwise it has that value and
    opposes the sliding after the impact. A run ends where forces with friction are not unique (a jam), or where the
    law would add energy, as is possible for a large restitution.

    Parameters
    ----------
    system, t_span, q0, v0, method, rtol, atol
        As for `solve_dae`. The gaps must not be negative at the start. While stops are closed, "auto" takes the place
        of "Taylor", which cannot trace their forces, and `compiled=True` has no effect.
    stops : Stop or sequence of Stop
        E.g. `Stop(lambda t, q: q[1], restitution=0.5)`, or `problem.stops` of a model.
    t_eval : array_like, optional
        Output times. None: the ends of steps, with two columns at an impact, before and after it.
    **options
        Further keyword arguments of `solve_dae`: max_step, compiled, time_limit (of each arc), ...

    Returns
    -------
    Result
        `.impacts` lists the impacts, `.arcs` the runs between them, `.sol` is the state at any time. `.lam` are the
        multipliers of the system; in an arc with closed stops, those of the stops follow those of C, and the force of
        a stop is the negative of its multiplier. Stops that stick have a row each, after those of all gaps.

    Raises
    ------
    TypeError, ValueError
        If an argument is invalid, or a gap cannot be traced or is negative at the start.

    Notes
    -----
    Impacts and releases are located like events. The gaps, their rates and the forces of closed stops are evaluated
    four times per step, and at least at every two-thousandth of the motion. A gap that closes and opens again between
    two evaluations is found, unless its rate changes sign more than once there; then reduce `max_step`. The time of an
    impact is as accurate as the motion before it.

    Examples
    --------
    >>> from twoloop import Stop, solve_with_stops
    >>> from twoloop.mechanisms import four_bar
    >>> problem = four_bar()
    >>> stop = Stop(lambda t, q: 1.0 - q[8], restitution=0.5, name="stop")  # the third bar turns to 1 rad at most
    >>> result = solve_with_stops(problem.system, (0.0, 0.6), problem.q0, problem.v0, stop)
    >>> bool(result.q[8].max() <= 1.0 + 1e-8), len(result.impacts)
    (True, 1)
    """
    check_system(system)
    t0, t1 = check_span(t_span)
    q, v = check_vector("q0", q0, system.n_q), check_vector("v0", v0, system.n_q)
    stops = [stops] if isinstance(stops, Stop) else stops
    if not isinstance(stops, (list, tuple)) or not stops or not all(isinstance(each, Stop) for each in stops):
        raise TypeError(f"stops must be a Stop or a list of them; given {shown(stops)}")
    options |= checked_options("solve_with_stops", options, method, rtol, atol, system.n_q)
    times = None if t_eval is None else check_times(t_eval, t0, t1, None)
    return Motion(stops, Modes(system), t0, q, v, options).to(t1, times)


def checked_options(
    caller: str, options: dict[str, Any], method: str | Method, rtol: float, atol: ArrayLike, n_q: int
) -> dict[str, Any]:
    """Return options of runs that include method and tolerances; raise TypeError for unknown options."""
    known = inspect.signature(solve_dae).parameters.keys() - OF_A_RUN
    wrong = [name for name in options if name not in known]
    if wrong:
        raise TypeError(f"{caller} has no option {wrong[0]!r}; those of runs are {', '.join(sorted(known))}")
    check_positive("rtol", rtol)
    return {"method": method, "rtol": rtol, "atol": check_tolerance("atol", atol, n_q)}
