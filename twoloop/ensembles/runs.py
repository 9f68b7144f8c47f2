"""What an ensemble returns."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.arguments import Array

Integers = NDArray[np.int64]


@dataclass(frozen=True)
class Runs:
    """Many runs, one along the first axis each.

    Attributes
    ----------
    t : ndarray (n_t,)
        Times, s: `t_eval`, or start and end.
    q, v : ndarray (n_runs, n_q, n_t)
        Coordinates and velocities; NaN at times that a run did not reach.
    status : ndarray (n_runs,)
        As `Result.status`: 0 where the end was reached, negative where a run failed.
    success : ndarray (n_runs,) of bool
    n_steps : ndarray (n_runs,)
        Accepted steps.
    n_evaluations : ndarray (n_runs,)
        Solutions for accelerations, as `Statistics` counts them.
    singly : ndarray (n_runs,) of bool
        Runs that were not made in lanes, but one by one, as by `solve_dae`.
    message : str
        How many runs reached the end, how many were made in lanes, by which method, how many singly, and why.
    messages : dict of int to str
        What `solve_dae` said of those runs that failed.
    reasons : dict of int to str
        Why each of the runs that were made singly was.

    Examples
    --------
    >>> import numpy as np
    >>> from twoloop import ensemble
    >>> from twoloop.mechanisms import pendulum
    >>> problem = pendulum()
    >>> speeds = np.array([0.0, 0.5, 1.0])
    >>> v0 = np.outer(speeds, [0.0, 1.0])  # along the circle
    >>> runs = ensemble(problem.system, (0.0, 1.0), problem.q0, v0, t_eval=[0.0, 0.5, 1.0])
    >>> runs.v.shape, runs.status.shape
    ((3, 2, 3), (3,))
    """

    t: Array
    q: Array
    v: Array
    status: Integers
    n_steps: Integers
    n_evaluations: Integers
    singly: NDArray[np.bool_]
    message: str
    messages: dict[int, str]
    reasons: dict[int, str]

    @property
    def success(self) -> NDArray[np.bool_]:
        """Whether a run reached its end."""
        made: NDArray[np.bool_] = self.status >= 0
        return made

    def __len__(self) -> int:
        return len(self.status)

    def __repr__(self) -> str:
        return f"<{len(self)} runs to t = {self.t[-1]:g}: {self.message}>"
