"""What `solve_dae` returns: the record of a run, and what can be made of it."""

from __future__ import annotations  # so that help shows the names of types as they are written

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.typing import ArrayLike

from twoloop.result.animation import animate
from twoloop.result.certificate import Certificate, certify
from twoloop.result.dataframe import to_dataframe
from twoloop.result.plotting import plot
from twoloop.result.reactions import Reaction, reaction
from twoloop.result.storage import save
from twoloop.run.record import Record


@dataclass(frozen=True, repr=False)
class Result(Record):
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
        methods; at most a hundredth of the run unless the steps are constant. Forces and drives were besides looked at
        with time alone, every two-thousandth of the run. None where a foreign solver ran.
    system : ConstrainedSystem or None
        The system: `reactions` and `plot` evaluate its rows, and its `Problem` told it names, energy and drawing. None
        where a foreign solver ran, a file was read without the system, or the result comes from another process, and
        the system's functions (such as lambdas) cannot be pickled.
    method : str
        Name of the method with its options; "" of a foreign solver. `twoloop.citation` says what to cite for it.
    compiled : bool or None
        Whether the run had machine code made for the mechanism, see `solve_dae`. None of a foreign solver.
    rtol : float or None
    atol : ndarray (n_q,) or None
        Tolerances of a step; those of `Newmark(error_tol=...)` are its own. None where a foreign solver ran.
    untested : ndarray of bool (n_accepted,) or None
        Steps in which the errors of velocities were not tested: those by Newton's method of "auto" and of methods with
        tested="positions", as "TRBDF2", and all of `Newmark(error_tol=...)`. None: they were tested in all, or a
        foreign solver ran.
    changes : str
        What changed on the way, where this is more than one run of one system: inputs at samples (`Integrator.step`),
        velocities in impacts (`solve_with_stops`). "": nothing.
    arcs : tuple of Result
        Of `solve_with_stops`: the runs from impact to impact that this is joined of. Files and other processes do
        not get them, nor their `sol`.
    impacts : tuple of Impact
        Likewise: when, at which stops, the velocities before and after, and the impulses.
    """

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
        return to_dataframe(self)

    def plot(self, path: str | os.PathLike[str] | None = None) -> Any:
        """Draw the coordinates, the energy and the violation of the constraints over time; needs no display.

        A panel for each unit of the coordinates; the energy, less that at the start where it is known as an invariant;
        the largest violation of positions and of velocities at each time of `t`. What is not known is left out.

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
        return animate(self, path, seconds)

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
        return reaction(self, name)

    def certify(self, rtol: float | None = None, atol: ArrayLike | None = None) -> Certificate:
        """Look at the run again, by a method and at places of its own, and say how far it is from the equations.

        Every part of the run is integrated again from the state stored at its start, with the callbacks as they are, a
        tenth of the tolerance and steps of at most 1/200 of the run, by `DOP853` or, where the run was stiff, Radau IIA
        of seven stages. What this gives at the end of the part is compared with the state stored there. A step that
        passed over a force, or an altered state, is off by far more than the tolerance.

        It costs about as much as a run by `DOP853`, at least 2,400 evaluations. Without `dense_output` a result with
        `t_eval` has no states at its steps: between these times the errors of the steps add up, and the certificate
        allows for that.

        Parameters
        ----------
        rtol : float, optional
        atol : float or array_like (n_q,), optional
            Tolerances of a step, for positions and velocities. None: those of the run. A result of another solver has
            none.

        Returns
        -------
        Certificate
            `.defect`, the largest distance over tolerance, `.t`, `.gap`, `.limit`, `.unseen`, `.passed`, `.message`.

        Raises
        ------
        TypeError, ValueError
            If an argument is wrong, no tolerances are known, the result has fewer than two times, or it has no system.

        Warns
        -----
        CertificateWarning
            If the defect is above the limit.

        Notes
        -----
        It does not prove that the errors at the end are small: those of the steps grow along an unstable motion. Nor
        that the model is right, nor anything of what lasts less than `gap`. Coordinates and velocities are compared;
        the accelerations and multipliers of the result, from which `reactions` come, are not.
        """
        return certify(self, rtol, atol)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the result to a file, as NumPy's npz without pickle; `twoloop.load` reads it.

        The file takes 8 (1 + 3 n_q + n_c + n_a) bytes for each time of `t`. A dense solution takes 8 (2 + 3 n_q) more
        for each step, and 8 (1 + 3 n_q) for each state within steps, of methods that need these (see `DenseSolution`).

        Parameters
        ----------
        path : str or path
            Where to; a file there is replaced.
        """
        save(self, path)


def result_of(record: Mapping[str, Any], **more: Any) -> Result:
    """The result with the fields of a record, and other values of some of them."""
    made = object.__new__(Result)  # a frozen class of thirty fields takes microseconds to make
    vars(made).update(record, **more)
    return made
