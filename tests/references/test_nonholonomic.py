"""Rows A v + b = 0 through the adapters of solvers of the accelerations, against references that share nothing."""

import numpy as np
import pytest

from references.casadi.integrators import solve_idas
from references.diffrax.dopri8 import solve_diffrax
from references.equations.rows import with_all_rows
from references.heyoka.taylor import solve_heyoka
from references.paper.gear import solve_gear
from references.scipy.index1 import solve_index1
from references.sundials.cvode_c import solve_cvode_c
from references.sundials.ida import solve_ida
from references.sundials.ida_c import solve_ida_c
from twoloop import ConstrainedSystem
from twoloop.mechanisms import four_bar, knife_edge, rolling_disc

ADAPTERS = {
    "DOP853": ("scipy", rolling_disc, lambda *start: solve_index1(*start, "DOP853", 1e-9, 1e-9)),
    "DOP853, projected": (
        "scipy",
        rolling_disc,
        lambda *start: solve_index1(*start, "DOP853", 1e-9, 1e-9, stabilisation="projection"),
    ),
    "heyoka": ("heyoka", rolling_disc, lambda *start: solve_heyoka(*start, 1e-10)),
    "CVODE": ("sksundae", rolling_disc, lambda *start: solve_cvode_c(*start, "Adams", 1e-9, 1e-9)),
    "CVODE, projected": (
        "sksundae",
        knife_edge,
        lambda *start: solve_cvode_c(*start, "BDF", 1e-9, 1e-9, projected=True),
    ),
    "IDAS": ("casadi", knife_edge, lambda *start: solve_idas(*start, 1e-9, 1e-9)),
    "IDA, stabilised": ("sksundae", rolling_disc, lambda *start: solve_ida(*start, "stabilised", 1e-9, 1e-9)),
    "IDA, index 1": ("sksundae", knife_edge, lambda *start: solve_ida(*start, "index1", 1e-9, 1e-9)),
    "IDA from C": ("sksundae", rolling_disc, lambda *start: solve_ida_c(*start, 1e-9, 1e-9)),
    "diffrax": ("diffrax", knife_edge, lambda *start: solve_diffrax(*start, 1e-9, 1e-9)),
}


def start(problem):
    return problem.system, (0.0, problem.reference.t), problem.q0, problem.v0


@pytest.mark.parametrize("name", ADAPTERS)
def test_the_motion_is_right_and_the_rows_hold(name):
    package, make, solve = ADAPTERS[name]
    pytest.importorskip(package)
    problem = make()
    result = solve(*start(problem))
    system = problem.system
    assert result.success and np.abs(result.q[:, -1] - problem.reference.q).max() < 1e-6
    assert result.lam.shape == (system.n_c + system.n_a, result.t.size)
    rows, rates = system.rows(result.t[-1], result.q[:, -1]), system.rates(result.t[-1], result.q[:, -1])
    assert np.abs(rows @ result.v[:, -1] + rates).max() < 1e-6


def test_the_rows_stand_below_those_of_c():
    problem = rolling_disc()
    system, made = problem.system, with_all_rows(problem.system)
    assert made is with_all_rows(system) and (made.n_c, made.n_a) == (3, 0)
    at = 0.3, problem.q0 + 0.1, problem.v0 - 0.2
    np.testing.assert_array_equal(made.jacobian(*at[:2]), system.rows(*at[:2]))
    np.testing.assert_array_equal(made.gamma(*at), np.append(system.gamma(*at), system.nonholonomic_gamma(*at)))
    np.testing.assert_array_equal(made.constraint(*at[:2]), np.append(system.constraint(*at[:2]), [0.0, 0.0]))
    plain = four_bar().system
    assert with_all_rows(plain) is plain


def test_without_the_right_hand_side_of_these_rows_there_is_no_way():
    problem = knife_edge()
    given = {kind: function for kind, function in problem.system.given.items() if kind != "nonholonomic_gamma"}
    system = ConstrainedSystem(n_q=3, n_c=0, n_a=1, name="edge", parameters=problem.system.parameters, **given)
    with pytest.raises(ValueError, match="must give nonholonomic_gamma for the adapters of other solvers"):
        solve_index1(system, (0.0, 1.0), problem.q0, problem.v0, "DOP853", 1e-6, 1e-6)


def test_other_adapters_have_no_such_rows_and_say_so():
    with pytest.raises(ValueError, match=r"this adapter has no rows A v \+ b = 0; given 'rolling disc' with n_a = 2"):
        solve_gear(*start(rolling_disc()), 0.01, 2)
