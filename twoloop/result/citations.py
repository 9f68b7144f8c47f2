"""What to cite for a result, as BibTeX."""

from pathlib import Path

from twoloop.methods.presets import PRESETS
from twoloop.result.result import Result

SOFTWARE = """@software{twoloop,
  title = {twoloop: two-loop state-space integration of constrained mechanical systems},
  author = {{The twoloop contributors}},
  version = VERSION
}"""

# the names by which METHODS know them stand above them
ENTRIES = dict(
    part.removeprefix("% ").split("\n", 1)
    for part in Path(__file__).with_suffix(".bib").read_text(encoding="utf-8").strip().split("\n\n")
)

# by how the name of a method begins; the sources are those that the docstrings of the methods name
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
    "auto": ("explicit", "krogh", "shampine", "pryce", "jorba", "hosea", "stiff"),
    "Adams": ("krogh", "shampine"),
    "Taylor": ("pryce", "jorba"),
}


def citation(result: Result) -> str:
    """BibTeX of what a result was made with: the paper, its method, and this software.

    Parameters
    ----------
    result : Result
        Of `solve_dae`, or read from a file.

    Returns
    -------
    str
        Entries; print them into a .bib file. The comment at the head names the method with its options.

    Raises
    ------
    TypeError, ValueError
        If it is not a result, or one of another solver.
    """
    from twoloop import __version__

    if not isinstance(result, Result):
        raise TypeError(f"citation needs a result of solve_dae; given {type(result).__name__}")
    if not result.method:
        raise ValueError("this result was made by another solver, or by a version that did not note the method")
    keys = ["paper", *(key for name, known in METHODS.items() if result.method.startswith(name) for key in known)]
    if ", momenta" in result.method and "geometric" not in keys:
        keys.append("geometric")
    if any(outer in result.method for outer in (", auto", ", newton")) and "stiff" not in keys:
        keys.append("stiff")  # the outer loop is its simplified Newton
    preset = next((f' (method="{name}")' for name, known in PRESETS.items() if known.name == result.method), "")
    entries = [ENTRIES[key] for key in keys]
    return "\n\n".join([f"% {result.method}{preset}", *entries, SOFTWARE.replace("VERSION", f"{{{__version__}}}")])
