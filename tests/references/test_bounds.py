"""The adapters, too, look at the bounds of compiled callbacks before they run."""

import pytest

from references.paper.gear import solve_gear
from references.scipy.index1 import solve_index1
from references.sundials.ida import solve_ida
from references.sundials.ida_c import solve_ida_c
from tests.test_bounds import FAR, NO_TANGENT, Q, V, beyond, system

ENTRIES = {
    "solve_gear": lambda system: solve_gear(system, (0.0, 0.1), Q, V, 0.01),
    "solve_ida": lambda system: solve_ida(system, (0.0, 0.1), Q, V),
    "solve_ida_c": lambda system: solve_ida_c(system, (0.0, 0.1), Q, V),
    "solve_index1": lambda system: solve_index1(system, (0.0, 0.1), Q, V, "DOP853"),
}


@pytest.mark.parametrize("entry", ENTRIES)
@pytest.mark.parametrize("kind", ["mass", "force", "constraint", "jacobian", "gamma", "reaction_by_q"])
def test_every_adapter_watches_every_callback(entry, kind):
    tangents = NO_TANGENT if kind == "reaction_by_q" else {}
    with pytest.raises(ValueError, match=rf"{kind} of 'far' goes out of bounds: index {FAR}"):
        ENTRIES[entry](system(**tangents, **{kind: beyond(kind)}))


@pytest.mark.parametrize("entry", ENTRIES)
def test_too_few_parameters_are_reported_as_such(entry):
    with pytest.raises(ValueError, match=r"(?s)of 'far' goes out of bounds.*p has 0.*Give more `parameters`"):
        ENTRIES[entry](system(parameters=[]))
