"""Which of the solvers on the beams are explicit, which take Newton's iteration."""

from studies.bench.cli import StudyError
from studies.bench.solvers import (
    ADAMS,
    COMPILED,
    CVODE_C,
    CYRK,
    DEFAULT,
    DIFFRAX,
    HEYOKA,
    IRK,
    NEWMARK,
    OWN_EXPLICIT,
    QUARTER,
)

EXPLICIT = (
    *(OWN_EXPLICIT, ADAMS, HEYOKA, DIFFRAX, "DOP853, projected", "DOP853, index 1", "Pr9, index 1"),
    *(CYRK, "CyRK, Vern8"),
)
FIXED_POINT = (IRK, NEWMARK, QUARTER, CVODE_C, "CVODE, Adams", "CVODES, CasADi, Adams")
CHOOSING = (DEFAULT, *COMPILED, "LSODA, index 1", "CyRK, LSODA")  # between explicit and implicit
# in names of implicit methods by Newton's iteration
BY_NEWTON = ("Radau", "Gauss", "BDF", "TRBDF2", "ESDIRK", "IDA", "CVODES", "collocation", "GeneralizedAlpha")


def kind_of(solver: str) -> str:
    """What a solver's steps are. Raises StudyError for one that is in no list: it would count as something else."""
    if solver in EXPLICIT:
        return "explicit"
    if solver in (*CHOOSING, *FIXED_POINT):
        return "neither"
    if any(each in solver for each in BY_NEWTON):
        return "Newton"
    raise StudyError(f"whether {solver!r} is explicit is not known: add it to a list of {__name__}")
