"""Define `Result`, the return value of `solve_dae`, with its views; load saved results, and cite methods."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from twoloop.checks.arguments import check_path
from twoloop.methods.presets import PRESETS
from twoloop.problem.system import ConstrainedSystem, check_system
from twoloop.result import certificate, reactions, storage, views
from twoloop.run.record import Record

SOFTWARE = """@software{twoloop,
  title = {twoloop: two-loop state-space integration of constrained mechanical systems},
  author = {{The twoloop contributors}},
  version = VERSION
}"""

# keys of the bibliography by prefix of the method name; the sources are those named in the docstrings of the methods
SOURCES = {
    "Sun Radau IIB": ("sun",),
    "Gauss": ("butcher",),
    "Radau IIA": ("stiff",),
    "Lobatto IIIE": ("geometric",),
    "Newmark": ("newmark",),
    "BDF": ("brenan",),
    "TRBDF2": ("hosea",),
    "ESDIRK4": ("kennedy",),
    "DOP853": ("explicit",),
    "Lobatto16": ("stiff", "lanes"),
    "auto": ("lanes", "explicit", "krogh", "shampine", "pryce", "jorba", "hosea", "stiff"),
    "Adams": ("krogh", "shampine"),
    "Taylor": ("pryce", "jorba"),
}


@dataclass(frozen=True, repr=False)
class Result(Record):
    """Trajectory, status and cost of a run.

    Attributes
    ----------
    t : ndarray (n_t,)
        Times, s.
    q, v, a : ndarray (n_q, n_t)
        Coordinates, velocities, accelerations: one column per time.
    lam : ndarray (n_c + n_a, n_t)
        Multipliers [lam; mu] of M a + C_q^T lam + A^T mu = Q; of minimum norm where rows are linearly dependent.
    h : ndarray
        Sizes of the accepted steps, s; the last one is cut at a terminal event.
    status : Status
        0: reached the end; 1: an event; negative: failed.
    message : str
        What happened and, after a failure, what to try, with a reference to the documentation.
    stats : Statistics
        Counts and CPU time. After a terminal event `n_accepted` counts the steps up to it; the other counts include
        the few steps beyond it. Evaluations between steps count in `cpu_time` only, and not at all if made by `sol`.
    rejected_error, rejected_convergence : ndarray of int (n_accepted,) or None
        Attempts rejected by the error test, and attempts whose iterations did not converge, since the previous
        accepted step (or the start). Attempts after the last accepted step of a failed run count in `stats` only. None
        if a foreign solver does not report them.
    partitioned : ndarray of int (n_accepted,) or None
        Number of repartitionings in the same interval, without the initial partition. None for a foreign solver.
    rank : int or None
        Rank of the constraints C_q and A at the start. None if a foreign solver does not report it.
    redundant : ndarray of int or None
        Rows of C_q and A, numbered as in `lam`, that depended on the others at the start and were left out.
    sol : DenseSolution or None
        With `dense_output=True`: `sol(t)` is the state at any time of the run.
    t_events, q_events, v_events : list of ndarray or None
        For each event function the times (n_events,) of its events, and the coordinates and velocities (n_events, n_q)
        there. None: the run had no event functions.
    defect : float or None
        Largest defect of the steps relative to the tolerances: the residual of the accelerations at the ends of steps
        and between them. A step with a defect above 1 is rejected, unless rounding in the equations explains it. None
        if it was not evaluated in all steps: only "Taylor" does so, and "Lobatto16" in long steps; `certify` verifies a
        run afterwards.
    widest_gap : float or None
        Longest time without an evaluation of the equations, s: shorter features may have been missed. It is the
        longest distance between the evaluation points of "Taylor", or the longest step of other methods; of a step of
        "Lobatto16" or "DOP853" above a hundredth of the run, the longest distance between its stages. At most a
        hundredth of the run unless the step size is constant. Forces and drives that may change suddenly with time were
        also sampled at every two-thousandth of the run, and eight times per step. None for a foreign solver.
    t_end : float or None
        End of `t_span`, s. None for a foreign solver.
    system : ConstrainedSystem or None
        The system: `reactions` and `plot` evaluate its rows; names, energy and drawing come from its `Problem`. None
        for a foreign solver, for a file read without the system, or for a result from another process if the
        system's functions (such as lambdas) cannot be pickled.
    method : str
        Name of the method with its options; "" for a foreign solver. `twoloop.citation` returns what to cite for it.
    compiled : bool or None
        True if the run used machine code generated for the mechanism, see `solve_dae`. None for a foreign solver.
    rtol : float or None
    atol : ndarray (n_q,) or None
        Tolerances of a step; error_tol^(2/3) for `Newmark(error_tol=...)`. None for a foreign solver.
    untested : ndarray of bool (n_accepted,) or None
        Steps without an error test of the velocities: the Newton steps of "auto", the steps of methods with
        tested="positions", such as "TRBDF2", and all steps of `Newmark(error_tol=...)`. None: tested in all steps, or
        a foreign solver.
    changes : str
        What changed during the run if it is not a single run of a single system: inputs at samples
        (`Integrator.step`), velocities in impacts (`solve_with_stops`). "": nothing.
    arcs : tuple of Result
        For `solve_with_stops`: the runs between impacts. They and their `sol` are neither saved to files nor sent to
        other processes.
    impacts : tuple of Impact
        For `solve_with_stops`: times, stops, velocities before and after, and impulses. They are not saved to files.

    Examples
    --------
    >>> from twoloop import solve_dae
    >>> from twoloop.mechanisms import four_bar
    >>> problem = four_bar()
    >>> result = solve_dae(problem.system, (0.0, 1.0), problem.q0, problem.v0)
    >>> result.status.name, result.q.shape == result.v.shape
    ('REACHED_END', True)
    >>> names = list(result.to_dataframe().columns)
    >>> names[:2]
    ['x (m) of bar 1', 'y (m) of bar 1']
    """

    to_dataframe = views.to_dataframe
    plot = views.plot
    animate = views.animate
    reactions = reactions.reactions
    certify = certificate.certify
    save = storage.save


def citation(result: Result) -> str:
    """Return the BibTeX entries of a result: the paper, its method, and this software.

    Parameters
    ----------
    result : Result
        Result of `solve_dae`, or read from a file.

    Returns
    -------
    str
        Entries for a .bib file. The comment at the top names the method with its options.

    Raises
    ------
    TypeError, ValueError
        If the argument is not a result, or comes from another solver.

    Examples
    --------
    >>> from twoloop import solve_dae
    >>> from twoloop.mechanisms import four_bar
    >>> problem = four_bar()
    >>> result = solve_dae(problem.system, (0.0, 1.0), problem.q0, problem.v0)
    >>> from twoloop import citation
    >>> "@" in citation(result)  # BibTeX
    True
    """
    from twoloop import __version__

    if not isinstance(result, Result):
        raise TypeError(f"citation needs a result of solve_dae; given {type(result).__name__}")
    if not result.method:
        raise ValueError("this result was made by another solver, or by a version that did not record the method")
    keys = ["paper", *(key for name, sources in SOURCES.items() if result.method.startswith(name) for key in sources)]
    if any(outer in result.method for outer in (", auto", ", newton")) and "stiff" not in keys:
        keys.append("stiff")  # simplified Newton iteration in the outer loop
    preset = next((f' (method="{name}")' for name, method in PRESETS.items() if method.name == result.method), "")
    entries = bibliography()
    software = SOFTWARE.replace("VERSION", f"{{{__version__}}}")
    return "\n\n".join([f"% {result.method}{preset}", *[entries[key] for key in keys], software])


def bibliography() -> dict[str, str]:
    """Return the BibTeX entries of all sources by the keys of `SOURCES`, and that of the paper."""
    text = Path(__file__).with_name("citations.bib").read_text(encoding="utf-8")
    return dict(entry.removeprefix("% ").split("\n", 1) for entry in text.strip().split("\n\n"))


def load(path: str | os.PathLike[str], system: ConstrainedSystem | None = None) -> Result:
    """Read a result written by `Result.save`, or stored in a folder by `solve_dae(..., store=folder)`.

    Parameters
    ----------
    path : str or path
        The file, or the folder, whose arrays are memory-mapped.
    system : ConstrainedSystem, optional
        The system that was solved, required by `result.sol`, `result.reactions`, `result.energy`, `result.plot` and
        `result.animate`. None: `result.sol` is None.

    Returns
    -------
    Result
        The result as saved.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    TypeError, ValueError
        If the file was not written by `Result.save`, or the folder not by `solve_dae`; if it is damaged (the message
        names the field); or if the system has other sizes.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> from twoloop import load, solve_dae
    >>> from twoloop.mechanisms import four_bar
    >>> problem = four_bar()
    >>> result = solve_dae(problem.system, (0.0, 1.0), problem.q0, problem.v0)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     result.save(Path(folder) / "run.npz")
    ...     loaded = load(Path(folder) / "run.npz")
    >>> bool((loaded.q == result.q).all())
    True
    """
    if system is not None:
        check_system(system)
    return Result(**storage.read_fields(check_path(path), system))
