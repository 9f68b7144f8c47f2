"""BibTeX entries to cite for a result."""

from pathlib import Path

from twoloop.methods.presets import PRESETS
from twoloop.result.result import Result

SOFTWARE = """@software{twoloop,
  title = {twoloop: two-loop state-space integration of constrained mechanical systems},
  author = {{The twoloop contributors}},
  version = VERSION
}"""

# keyed by the names used in METHODS
ENTRIES = dict(
    part.removeprefix("% ").split("\n", 1)
    for part in Path(__file__).with_suffix(".bib").read_text(encoding="utf-8").strip().split("\n\n")
)

# by prefix of the method name; the sources are those named in the docstrings of the methods
METHODS = {
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
    keys = ["paper", *(key for name, known in METHODS.items() if result.method.startswith(name) for key in known)]
    if any(outer in result.method for outer in (", auto", ", newton")) and "stiff" not in keys:
        keys.append("stiff")  # simplified Newton iteration in the outer loop
    preset = next((f' (method="{name}")' for name, known in PRESETS.items() if known.name == result.method), "")
    entries = [ENTRIES[key] for key in keys]
    return "\n\n".join([f"% {result.method}{preset}", *entries, SOFTWARE.replace("VERSION", f"{{{__version__}}}")])
