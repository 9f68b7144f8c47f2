"""Callbacks compared once more, where a run went: derivatives, and what was traced of them."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.derivatives import wrong_derivative
from twoloop.checks.structure import unlike_itself
from twoloop.generate.exact_derivatives import Territory, exact_derivatives, generic_states
from twoloop.generate.traced_values import Sample
from twoloop.run.record import Status

if TYPE_CHECKING:
    from twoloop.run.run import Run

Array = NDArray[np.float64]

LATER_CHECKS = 3  # states of the run, beside the last, at which derivatives are checked again


def compared(
    run: "Run",
    t: Array,
    table: Array,
    last: tuple[float, Array],
    sample: Sample,
    check_derivatives: bool,
    status: Status,
    message: str,
) -> tuple[Status, str]:
    """Status and message, unless callbacks are not what they should be where the run went.

    Compiled ones are not compared again where they were: see Territory.
    """
    what = (check_derivatives, *map(id, run.traced))  # the system keeps these
    territory = run.system.remembered(("territory", what), Territory)
    again = not territory.is_due() and not run.system.called_in_python
    if again and last[0] <= run.compared_to[0]:
        return status, message
    states = sample.up_to(last[0])
    if again and territory.covers(states):
        run.compared_to[0] = last[0]
        return status, message
    before = status
    if check_derivatives:
        status, message = _derivatives_again(run, t, table, last, states[-1], status, message)
    status, message = _traces(run, states, status, message)
    if status == before:
        territory.add(states)
        run.compared_to[0] = last[0]
    return status, message


def _derivatives_again(
    run: "Run", t: Array, table: Array, last: tuple[float, Array], first: Array, status: Status, message: str
) -> tuple[Status, str]:
    """Status and message, unless a derivative, or a constant mass, is wrong where the run went from its first state."""
    n = run.system.n_q
    inner = np.arange(1, LATER_CHECKS + 1) * len(t) // (LATER_CHECKS + 1)
    states = [(float(t[k]), table[k, :n], table[k, n : 2 * n]) for k in np.unique(inner) if 0 < k < len(t)]
    states.append((last[0], last[1][:n], last[1][n : 2 * n]))
    exact = exact_derivatives(run.system)
    fine = exact is not None and exact.wrong(run.system, generic_states(states)) is None
    for instant, q, v in states:
        wrong = unlike_itself(run.system, instant, q, v, float(first[0]), first[1 : 1 + n])
        if wrong is None and not fine:
            wrong = wrong_derivative(run.system, instant, q, v)
        if wrong is not None:
            return Status.WRONG_DERIVATIVE, f"At t = {instant:.10g} of the run {wrong} {message}"
    return status, message


def _traces(run: "Run", states: Any, status: Status, message: str) -> tuple[Status, str]:
    """Status and message, unless a callback gives other values than what was recorded of it."""
    for traced in run.traced:
        wrong = traced.wrong(run.system, states)
        if wrong is not None:
            return Status.WRONG_TRACE, f"In the run {wrong}. {message}"
    return status, message
