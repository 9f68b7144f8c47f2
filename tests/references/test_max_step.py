"""The longest step of other solvers: each adapter that takes `max_step` hands it on."""

import pytest

from references.cvode_c import solve_cvode_c
from references.heyoka_taylor import solve_heyoka
from references.ida import solve_ida
from references.ida_c import solve_ida_c
from references.index1 import METHODS, solve_index1
from twoloop.mechanisms import projection_pendulum

T_END, MAX_STEP = 0.2, 1e-3
ADAPTERS = {
    "heyoka": ("heyoka", lambda *start, **more: solve_heyoka(*start, 1e-4, **more)),
    "CVODE from C": ("sksundae", lambda *start, **more: solve_cvode_c(*start, "Adams", 1e-4, 1e-4, **more)),
    "IDA": ("sksundae", lambda *start, **more: solve_ida(*start, "stabilised", 1e-4, 1e-4, **more)),
    "IDA from C": ("sksundae", lambda *start, **more: solve_ida_c(*start, 1e-4, 1e-4, **more)),
}
ADAPTERS |= {
    name: ("scipy", lambda *start, name=name, **more: solve_index1(*start, name, 1e-4, 1e-4, **more))
    for name in METHODS
}


@pytest.mark.parametrize("name", ADAPTERS)
def test_no_step_is_longer(name):
    package, solve = ADAPTERS[name]
    pytest.importorskip(package)
    problem = projection_pendulum()
    start = problem.system, (0.0, T_END), problem.q0, problem.v0
    free, bound = solve(*start), solve(*start, max_step=MAX_STEP)
    assert free.success and bound.success
    assert bound.stats.n_accepted >= 0.999 * T_END / MAX_STEP > 1.2 * free.stats.n_accepted
    with pytest.raises(ValueError, match="max_step"):
        solve(*start, max_step=0.0)
