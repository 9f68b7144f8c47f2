"""What a run returns: Result, Status, Statistics."""

from __future__ import annotations  # Reaction and its kin are imported when they are asked for

import os
import pickle
from dataclasses import dataclass, fields
from enum import IntEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from twoloop.dense import DenseSolution
from twoloop.description import Description
from twoloop.system import ConstrainedSystem

if TYPE_CHECKING:
    from twoloop.reactions import Reaction

Array = NDArray[np.float64]


class Status(IntEnum):
    """How a run ended: 0 reached the end, 1 an event, negative a failure; in words in `MEANINGS`."""

    REACHED_END = 0
    EVENT = 1
    STEP_TOO_SMALL = -1
    MAX_STEPS = -2
    NOT_CONVERGED = -3
    NOT_FINITE = -4
    RANK_LOST = -5
    SOLVER_FAILED = -6
    INTERRUPTED = -7
    STAGNATED = -8
    WRONG_DERIVATIVE = -9
    TIME_LIMIT = -10
    ROWS_CONTRADICT = -11
    RATE_JUMPS = -12


MEANINGS: dict[Status, str] = {
    Status.REACHED_END: "the end of t_span was reached",
    Status.EVENT: "an event ended the run",
    Status.STEP_TOO_SMALL: "the step size fell below the spacing of floating-point numbers",
    Status.MAX_STEPS: "max_steps accepted steps were taken",
    Status.NOT_CONVERGED: "a step of fixed size did not converge, or gamma by differences misses the tolerance",
    Status.NOT_FINITE: "a callback returned a value that is not finite, or the state overflowed",
    Status.RANK_LOST: "the constraint Jacobian lost rank: no choice of independent coordinates exists",
    Status.SOLVER_FAILED: "a solver of another project failed, or reached the time limit of its adapter",
    Status.INTERRUPTED: "the run was interrupted from the keyboard",
    Status.STAGNATED: "the steps became so short that the end is out of reach",
    Status.WRONG_DERIVATIVE: "a derivative that the system gives is wrong at a state of the run",
    Status.TIME_LIMIT: "the run reached its time_limit",
    Status.ROWS_CONTRADICT: "a constraint that depended on others at the start is violated",
    Status.RATE_JUMPS: "constraint_rate jumps, and no impulse gives velocities that the constraints allow",
}


def explained(status: Status) -> str:
    """Where the documentation explains a failure, for the end of its message; nothing for a run that succeeded."""
    return "" if status >= 0 else f" See docs/when_it_fails.md#{status.name.lower()}."


@dataclass(frozen=True)
class Statistics:
    """Counts and CPU time of a run; None where a foreign solver does not tell.

    Attributes
    ----------
    n_accepted, n_rejected_error, n_rejected_convergence : int or None
        Steps accepted, steps that failed the error test, steps whose loops did not converge.
    n_outer : int or None
        Iterations of the outer loop (each evaluates every stage once).
    n_inner : int or None
        Newton iterations of the inner loop.
    n_evaluations : int or None
        Solutions of eq. (6) for accelerations and multipliers, and evaluations of the forces alone, with which the
        derivatives of a banded system are made.
    n_partitions : int or None
        Coordinate partitionings, the first included.
    n_factorizations : int or None
        Matrix factorisations: of C_qd, of C_q M^-1 C_q^T, of M where it is not constant, of the partitionings,
        and for Newton's method in the outer loop.
    n_jacobians : int or None
        Times the derivatives of the right-hand side were made for Newton's method in the outer loop.
    cpu_time : float
        Process time of the integration, s: of the steps, of storing what they give, of events, and of q and v at output
        times between them. Compilation, checks of the input, the workspace, the first accelerations, and a and lam at
        output times between steps are not included.
    """

    n_accepted: int | None = None
    n_rejected_error: int | None = None
    n_rejected_convergence: int | None = None
    n_outer: int | None = None
    n_inner: int | None = None
    n_evaluations: int | None = None
    n_partitions: int | None = None
    n_factorizations: int | None = None
    n_jacobians: int | None = None
    cpu_time: float = 0.0


@dataclass(frozen=True)
class Result:
    """A trajectory, how the run ended, and what it cost.

    Attributes
    ----------
    t : ndarray (n_t,)
        Times, s.
    q, v, a : ndarray (n_q, n_t)
        Coordinates, velocities, accelerations: one column an instant.
    lam : ndarray (n_c + n_a, n_t)
        Multipliers [lam; mu] of M a + C_q^T lam + A^T mu = Q; of least norm where rows depend on one another.
    h : ndarray
        Sizes of the accepted steps, s; after a terminal event the last is the part of the step before it.
    status : Status
        0: reached the end; 1: an event; negative: failed.
    message : str
        What happened and, after a failure, what to try, and where the documentation explains it.
    stats : Statistics
        Counts and CPU time. After a terminal event `n_accepted` counts the steps up to it, the rest the few behind it,
        too. What is evaluated between steps is in `cpu_time` alone, and not at all where `sol` does it.
    rejected_error, rejected_convergence : ndarray of int (n_accepted,) or None
        Attempts that failed the error test, and those whose loops did not converge, between the acceptance of the step
        before (or the start) and that of this one. Those after the last accepted step of a failed run are in `stats`
        alone. None where a foreign solver does not tell.
    partitioned : ndarray of int (n_accepted,) or None
        How often the coordinates were partitioned anew in the same interval; the partition at the start of the run
        is not among them. None where a foreign solver has none.
    rank : int or None
        Rank of the constraints C_q and A at the start. None where a foreign solver does not tell.
    redundant : ndarray of int or None
        Rows of C_q and A, counted as in `lam`, that depended on the others at the start and were left out.
    sol : DenseSolution or None
        With `dense_output=True`: `sol(t)` is the state at any time of the run.
    t_events, q_events, v_events : list of ndarray or None
        For each event function the times (n_events,) of its events, and coordinates and velocities (n_events, n_q)
        there. None: no events were asked for.
    defect : float or None
        Largest defect that the steps found of themselves, over what the tolerances allow: how far their accelerations
        are from those of the equations, at the ends of steps and between them. A step whose defect is above 1 is not
        accepted, unless rounding in the equations explains it. None where a step did not look: of methods other than
        "Taylor", and of "auto" where it took others; `certify` looks afterwards.
    widest_gap : float or None
        The longest time of the run within which the equations were perhaps not looked at, s: what lasts no longer may
        have been missed. It is the longest distance of the places where "Taylor" looks, or the longest step of other
        methods; at most a hundredth of the run unless the steps are constant. None where a foreign solver ran.
    system : ConstrainedSystem or None
        The system: `reactions` and `plot` evaluate its rows, and its `Problem` told it names, energy and drawing. None
        where a foreign solver ran, a file was read without the system, or the result comes from another process, and
        the system's functions (such as lambdas) cannot be pickled.
    method : str
        Name of the method with its options; "" of a foreign solver. `twoloop.citation` says what to cite for it.
    """

    t: Array
    q: Array
    v: Array
    a: Array
    lam: Array
    h: Array
    status: Status
    message: str
    stats: Statistics
    rejected_error: NDArray[np.int64] | None = None
    rejected_convergence: NDArray[np.int64] | None = None
    partitioned: NDArray[np.int64] | None = None
    rank: int | None = None
    redundant: NDArray[np.int64] | None = None
    sol: DenseSolution | None = None
    t_events: list[Array] | None = None
    q_events: list[Array] | None = None
    v_events: list[Array] | None = None
    defect: float | None = None
    widest_gap: float | None = None
    system: ConstrainedSystem | None = None
    method: str = ""

    @property
    def success(self) -> bool:
        """Whether the run reached its end or an event."""
        return self.status >= 0

    @property
    def description(self) -> Description:
        """Names, energy and drawing, as far as the `Problem` of the system told them."""
        return Description() if self.system is None else self.system.description

    @property
    def coordinates(self) -> tuple[str, ...]:
        """Names of the coordinates with their units; q0, q1, ... where the problem has none."""
        return self.description.coordinates or tuple(f"q{k}" for k in range(len(self.q)))

    @property
    def energy(self) -> Array:
        """Energy at the times `t`, J, (n_t,).

        Raises
        ------
        ValueError
            If no energy is known: the system was solved without a `Problem`, or the result has no system.
        """
        return np.asarray(self._known("energy")(self.t, self.q, self.v))

    def _known(self, what: str) -> Any:
        """The energy or the drawing, or what to do to have it."""
        found = getattr(self.description, what)
        if found is None:
            raise ValueError(
                f"this result knows no {what}: put the system into a problem, twoloop.mechanisms.Problem(..., "
                f"system=system, {what}=...), and solve problem.system. To a result in a file, or of another solver, "
                "give the system: twoloop.load(path, problem.system), dataclasses.replace(result, "
                "system=problem.system)"
            )
        return found

    def to_dataframe(self) -> Any:
        """The run as a table of pandas: a row an instant.

        Returns
        -------
        pandas.DataFrame
            Indexed by "t (s)". Columns: coordinates by their names, such as "x of crank (m)", their velocities "x of
            crank, velocity (m/s)" and accelerations, the multipliers lam0, lam1, ..., and, where it is known, "energy
            (J)".

        Raises
        ------
        ImportError
            If pandas is not installed.
        """
        from twoloop.dataframe import to_dataframe

        return to_dataframe(self)

    def plot(self, path: str | os.PathLike[str] | None = None) -> Any:
        """Draw the coordinates, the energy and the violation of the constraints over time; needs no display.

        A panel for each unit of the coordinates; the energy less that at the start where it is an invariant; the
        largest violation of positions and of velocities at each time of `t`. What is not known is left out.

        Parameters
        ----------
        path : str or path, optional
            Where to save the figure as well, in a format of matplotlib, by the ending.

        Returns
        -------
        matplotlib.figure.Figure

        Raises
        ------
        ImportError
            If matplotlib is not installed.
        ValueError
            If the result has no output.
        """
        from twoloop.plotting import plot

        return plot(self, path)

    def animate(self, path: str | os.PathLike[str], seconds: float | None = None) -> Path:
        """Write the mechanism in its motion, as its problem's `drawing` says; needs no display.

        Between the stored times the motion is that of `sol`, or without it a polynomial through q, v and a: with
        `t_eval`, take times close enough for that.

        Parameters
        ----------
        path : str or path
            A file that ends in .html (one page without further files, in which a spatial mechanism can be turned with
            the mouse), .gif (needs Pillow) or .mp4 (needs Pillow and the program ffmpeg).
        seconds : float, optional
            How long the animation lasts. None: as long as the run, but from 3 to 12 s.

        Returns
        -------
        pathlib.Path
            The file.

        Raises
        ------
        ImportError, RuntimeError
            If Pillow or ffmpeg is missing where it is needed.
        TypeError, ValueError
            If an argument is wrong, no drawing is known, or the run has fewer than two times.
        """
        from twoloop.animation import animate

        return animate(self, path, seconds)

    def __getstate__(self) -> dict[str, Any]:
        state = dict(vars(self))
        try:
            pickle.dumps(self.system)
        except TypeError:  # of functions without a name of their own
            state["system"] = None
        return state

    def reactions(self, name: str) -> Reaction:
        """Force and torque of a joint on its body at the times `t`.

        They are those of the generalised reaction -C_q^T lam (or -A^T mu) of the rows of the joint: what the joint
        does to the body that it names, along the axes of space. A bob that hangs from a link is pulled upwards. The
        body on the other side gets the opposite. Where rows depend on one another the multipliers, and so the
        reactions of single joints, may not be unique: `Reaction.unique` says so.

        Parameters
        ----------
        name : str
            Of one of the joints of the system (`problem.joints` of a ready mechanism).

        Returns
        -------
        Reaction
            `.force` (2 or 3, n_t), N, and `.torque` (n_t,) or (3, n_t), N m, about `.point` (2 or 3, n_t), m;
            `.unique`.

        Raises
        ------
        ValueError
            If there is no joint of this name, the system has no joints, or the result was read without its system.
        """
        from twoloop.reactions import reaction

        return reaction(self, name)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the result to a file, as NumPy's npz without pickle; `twoloop.load` reads it.

        The file takes 8 (1 + 3 n_q + n_c + n_a) bytes for each time of `t`. A dense solution takes 8 (2 + 3 n_q) more
        for each step, and 8 (1 + 3 n_q) for each state within steps, of methods that need these (see `DenseSolution`).

        Parameters
        ----------
        path : str or path
            Where to; a file there is replaced.
        """
        from twoloop.storage import save

        save(self, path)

    def __repr__(self) -> str:
        known = {f.name: getattr(self.stats, f.name) for f in fields(self.stats)}
        counts = ", ".join(f"{name}={value}" for name, value in known.items() if value is not None)
        end = f"t[-1]={self.t[-1]:g}" if self.t.size else "no output"
        return f"Result({self.status.name}: {self.message} n_t={self.t.size}, {end}; {counts})"
