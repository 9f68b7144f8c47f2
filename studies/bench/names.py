"""Names of solvers in figures, tables and sentences, by their names in rows, which CSV files keep.

`method="auto"` is "the default", "compiled=True" or "compiled=False"; other methods of twoloop have the value of
`method`, with `compiled` if it is not the default. Other solvers have their names.
"""

from studies.bench.solvers import COMPILED, DEFAULT, GIVEN, OWN_EXPLICIT
from twoloop.methods.presets import PRESETS

SUFFIX = " (twoloop)"  # of methods of twoloop, where another solver has such a name, too
WITH, WITHOUT = "compiled", "not compiled"  # after a comma, of rows; without either: as a study runs its methods
ON_SCIPY = "solve_dae"  # another project, whose methods have names of SciPy's
SCIPY = ("LSODA, ", "DOP853, ", "Radau, ", "BDF, ", "RK45, ")  # how rows of SciPy's begin, which ours may, too


def _parts(solver: str) -> tuple[str, str] | None:
    """Method and word on code of a row of ours."""
    method, _, word = solver.removesuffix(SUFFIX).partition(", ")
    return (method, word) if method in PRESETS and word in ("", WITH, WITHOUT) else None


def _option(method: str, word: str, coded: bool | None) -> bool | None:
    """The value of `compiled` that a user gives; None: none, as `solve_dae` does so by itself."""
    given = word == WITHOUT or (method in COMPILED.values() and (word == WITH) is not coded)
    return word == WITH if given else None


def label(solver: str, coded: bool | None = None) -> str:
    """Return the name of a solver in figures and tables; `coded`: whether the default generates code (None: varies)."""
    parts = _parts(solver)
    if parts is None:
        name = solver.removesuffix(SUFFIX)
        return f"SciPy, {name}" if name.startswith(SCIPY) and ON_SCIPY not in name else name
    method, option = parts[0], _option(*parts, coded)
    words = [] if method == DEFAULT else [method]
    words += [] if option is None else [f"compiled={option}"]
    return ", ".join(words) or GIVEN


def call(solver: str, coded: bool | None = None) -> str:
    """The same in sentences, as code: what a user writes where it is one of ours."""
    text, parts = label(solver, coded), _parts(solver)
    if text == GIVEN:
        return text
    if parts is None or parts[0] == DEFAULT:
        return f"`{text}`"
    method, _, option = text.partition(", ")
    return f'`method="{method}"{", " * bool(option)}{option}`'


def project(solver: str) -> str:
    """The project of another solver: what stands before its method."""
    return solver.partition(", ")[0]


def looks_like(solver: str, coded: bool | None = None) -> str:
    """The name in `looks.toml` of a solver: with `compiled` left out, True or False it looks the same everywhere."""
    parts = _parts(solver)
    if parts is None or parts[0] not in COMPILED.values():
        return solver
    method, option = parts[0], _option(*parts, coded)
    if option is None:
        return OWN_EXPLICIT if method == "DOP853" else method
    return f"{method}, {WITH if option else WITHOUT}"
