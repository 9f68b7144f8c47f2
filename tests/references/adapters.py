"""The adapters of other solvers in one table, for the tests of what holds for each."""

from collections.abc import Callable, Collection
from typing import Any, NamedTuple

import pytest

from references.casadi.integrators import solve_collocation, solve_cvodes, solve_idas
from references.diffrax.dopri8 import solve_diffrax
from references.heyoka.taylor import solve_heyoka
from references.paper.gear import solve_gear
from references.scipy.fully_implicit import METHODS as IMPLICIT
from references.scipy.fully_implicit import solve_fully_implicit
from references.scipy.index1 import METHODS, solve_index1
from references.sundials.cvode import solve_cvode
from references.sundials.cvode_c import solve_cvode_c
from references.sundials.ida import solve_ida
from references.sundials.ida_c import solve_ida_c
from references.sundials.residual import FORMS


class Adapter(NamedTuple):
    """One solver with one method: its package, and (system, t_span, q0, v0, tol, **options) -> Result."""

    package: str
    solve: Callable[..., Any]

    def __call__(self, *start: Any, tol: float = 1e-6, **options: Any) -> Any:
        pytest.importorskip(self.package)
        return self.solve(*start, tol, **options)


def _of_two(solve: Any, *method: str, **more: Any) -> Callable[..., Any]:
    return lambda *given, **options: solve(*given[:4], *method, given[4], given[4], **more, **options)


ADAPTERS = {
    **{name: Adapter("scipy", _of_two(solve_index1, name)) for name in METHODS},
    "Pr9": Adapter("extensisq", _of_two(solve_index1, "Pr9")),
    "DOP853, projected": Adapter("scipy", _of_two(solve_index1, "DOP853", stabilisation="projection")),
    **{f"IDA, {form}": Adapter("sksundae", _of_two(solve_ida, form)) for form in FORMS},
    "IDA from C": Adapter("sksundae", _of_two(solve_ida_c)),
    "CVODE": Adapter("sksundae", _of_two(solve_cvode)),
    "CVODE from C, Adams": Adapter("sksundae", _of_two(solve_cvode_c, "Adams")),
    "CVODE from C, BDF": Adapter("sksundae", _of_two(solve_cvode_c, "BDF")),
    "CVODE from C, projected": Adapter("sksundae", _of_two(solve_cvode_c, "BDF", projected=True)),
    **{f"{method} of solve_dae": Adapter("solve_dae", _of_two(solve_fully_implicit, method)) for method in IMPLICIT},
    "heyoka": Adapter("heyoka", solve_heyoka),
    "IDAS": Adapter("casadi", _of_two(solve_idas)),
    "CVODES": Adapter("casadi", _of_two(solve_cvodes)),
    "collocation": Adapter("casadi", lambda *given, **options: solve_collocation(*given[:4], 300, **options)),
    "Dopri8": Adapter("diffrax", _of_two(solve_diffrax)),
    "gear": Adapter("scipy", lambda *given, **options: solve_gear(*given[:4], 1e-3, 2, **options)),
}
OF_EXPRESSIONS = ("heyoka", "IDAS", "CVODES", "collocation", "Dopri8")
COMPILES = {"Dopri8"}  # for ten seconds
ANY_CALLBACK = tuple(name for name in ADAPTERS if name not in OF_EXPRESSIONS and "from C" not in name)  # Python's, too


def each(*left_out: str, of: Any = tuple(ADAPTERS), slow: Collection[str] = COMPILES) -> list[Any]:
    """Names of adapters, of which some are slow: those that compile for long, or those given."""
    return [pytest.param(name, marks=[pytest.mark.slow] * (name in slow)) for name in of if name not in left_out]
