"""The four-bar linkage: derivatives, assembly, and its motion by routes with one degree of freedom."""

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from references.paper.four_bar_minimal import MinimalFourBar
from tests.problems import row_errors, run, violations, worst
from twoloop import solve_dae
from twoloop.mechanisms import four_bar

lengths = st.floats(0.3, 3.0)
angles = st.floats(-math.pi, math.pi)
states = st.lists(st.floats(-4.0, 4.0), min_size=9, max_size=9).map(np.array)
branches = st.sampled_from([-1, 1])


def assembled(L1, L2, L3, ground, theta3, branch):
    """The problem, or a discarded example where the bars do not reach."""
    reach = abs(ground - L3 * np.exp(1j * theta3))
    assume(abs(L1 - L2) * 1.02 + 0.02 < reach < 0.98 * (L1 + L2))
    return four_bar(lengths=(L1, L2, L3), ground=ground, theta3=theta3, branch=branch)


def system_of(L1, L2, L3, ground):
    """A system of these lengths; its callbacks take any q, so it need not hold together there."""
    return four_bar().system.with_parameters([L1, L2, L3, ground])


@given(lengths, lengths, lengths, lengths, states, states)
def test_derivatives_of_the_constraint(L1, L2, L3, ground, q, v):
    by_q, by_t, gamma = row_errors(system_of(L1, L2, L3, ground), 0.0, q, v)
    assert by_q < 1e-8 and by_t == 0.0 and gamma < 1e-7


def test_masses_are_those_of_uniform_rods(default_four_bar):
    expected = [1.0, 1.0, 1.0 / 12.0, 2.0, 2.0, 8.0 / 12.0, 1.5, 1.5, 1.5**3 / 12.0]
    assert worst(default_four_bar.system.mass(0.0, default_four_bar.q0), np.diag(expected)) < 1e-15


@given(lengths, lengths, lengths, lengths, angles, branches)
def test_assembled_linkages_satisfy_their_constraints_on_the_branch_asked_for(L1, L2, L3, ground, theta3, branch):
    problem = assembled(L1, L2, L3, ground, theta3, branch)
    q = problem.q0
    assert np.abs(problem.system.constraint(0.0, q)).max() < 1e-12 and q[8] == theta3 and (problem.v0 == 0.0).all()
    joint12 = 2.0 * complex(q[0], q[1])
    joint23 = ground - L3 * np.exp(1j * theta3)
    side = (joint23.conjugate() * joint12).imag  # positive: to the left of the line from O to joint 2-3
    assert math.copysign(1.0, side) == branch


@given(lengths, lengths, lengths, lengths, angles, branches)
def test_energy_is_kept_by_any_geometry_over_a_short_run(L1, L2, L3, ground, theta3, branch):
    # where all four bars can lie in line, the motion may pass a position in which the constraints lose rank
    assume(min(abs(L1 + s * L2 + r * L3 + k * ground) for s in (-1, 1) for r in (-1, 1) for k in (-1, 1)) > 0.02)
    problem = assembled(L1, L2, L3, ground, theta3, branch)
    result = solve_dae(problem.system, (0.0, 0.3), problem.q0, problem.v0, rtol=1e-9, atol=1e-9)
    assert result.success, (problem.name, result.message)
    energy = problem.energy(result.t, result.q, result.v)
    assert worst(energy, energy[0]) < 1e-6 and violations(problem.system, result)[0] < 1e-12


def test_default_is_marked_as_assumed_and_others_carry_no_reference(default_four_bar, collinear_four_bar):
    assert "assumed" in default_four_bar.note and "*assumed*" in four_bar.__doc__
    assert default_four_bar.reference is not None and collinear_four_bar.reference is None
    p = default_four_bar.parameters
    assert (p["L1"], p["L2"], p["L3"], p["L"], p["gravity"]) == (1.0, 2.0, 1.5, 3.0, 9.81)


# the embedded estimate of RadauIIA5 is of order 3, and its steps continue unextrapolated
TIGHT = {"SunRadau5": 1e-10, "Gauss6": 1e-10, "Gauss12": 1e-10, "RadauIIA5": 1e-11}


@pytest.mark.parametrize("linkage", ["default_four_bar", "collinear_four_bar"])
@pytest.mark.parametrize("method", TIGHT)
def test_linkages_agree_with_the_minimal_form_to_nine_digits(linkage, method, request):
    problem, times = request.getfixturevalue(linkage), np.linspace(0.0, 10.0, 41)
    result = run(problem, method=method, rtol=TIGHT[method], atol=TIGHT[method], t_eval=times)
    assert result.success
    q, v = MinimalFourBar.from_parameters(problem.parameters).states(times)
    assert worst(result.q, q) < 1e-9 and worst(result.v, v) < 5e-9
    if problem.reference is not None:
        assert worst(result.q[:, -1], problem.reference.q) < 5e-10
        assert worst(result.v[:, -1], problem.reference.v) < 1e-9


def test_default_linkage_for_100_s(default_four_bar):
    problem = default_four_bar
    result = solve_dae(problem.system, (0.0, 100.0), problem.q0, problem.v0, method="Gauss12", rtol=1e-10, atol=1e-10)
    q, _ = MinimalFourBar.from_parameters(problem.parameters).states([100.0])
    assert worst(result.q[:, -1], q[:, 0]) < 1e-8
    energy = problem.energy(result.t, result.q, result.v)
    assert worst(energy, energy[0]) < 1e-9 and violations(problem.system, result)[0] < 1e-9
    assert result.q[7].max() < 1e-9  # bar 3 comes back to y = 0 and does not pass it, as the paper says
