"""Exudyn's own beams against the elements of twoloop, where the theories meet: Poisson's ratio 0, a slender section.

The beam of 2e8 N/m^2 starts with all of it moving (start="beam": the other start depends on the mesh) and swings once
through 1 m within 1 s. The elements of twoloop converge slowly, Exudyn's cable fast. What they then leave is what the
theories differ by, of second order in height/length: shear, most of it, and rotary inertia, stretch of the thickness,
Green's strains.
"""

import math
from functools import cache

import numpy as np
import pytest

from references.exudyn.beam import MODELS, solve_exudyn_beam
from references.exudyn.run import SOLVERS
from twoloop import solve_dae
from twoloop.mechanisms import ancf_beam, four_bar, moderately_stiff_beam
from twoloop.mechanisms.ancf_beam import midpoint_deflection, tip_height
from twoloop.run.record import Status

TIMES = np.arange(11) / 10.0
STEPS = 2000  # of Exudyn; twice as many move the tip of the cable by 1.2e-5 m
# m: largest distance of the tip's height from the cable, 0 to 1 s, a tenth more than measured
BY_ELEMENTS = {4: 2.0e-2, 8: 5.0e-3, 16: 9.2e-4}  # at the height 0.02 m; all but some 4e-4 is the elements' mesh
BY_HEIGHT = {0.08: 5.2e-3, 0.04: 1.9e-3, 0.02: 4.7e-4}  # with 64 elements


def beam(n_elements, height=0.02, start="beam", stiffness=1.0):
    """The moderately stiff beam at Poisson's ratio 0; E I/(rho A) is kept when the height changes."""
    return ancf_beam(
        n_elements,
        start,
        youngs_modulus=stiffness * 2e8 * (0.02 / height) ** 2,
        amplitude=-0.01,
        angular_frequency=2.0 * math.pi,
        poisson_ratio=0.0,
        height=height,
    )


@cache
def theirs(model, n_elements, height=0.02, n_steps=STEPS, stiffness=1.0):
    problem = beam(n_elements, height, stiffness=stiffness)
    result = solve_exudyn_beam(problem, 1.0, n_steps, model, store_every=n_steps // 10)
    assert result.success and np.allclose(result.t, TIMES, rtol=0.0, atol=1e-10)
    return tip_height(result.q)


@cache
def ours(n_elements, height=0.02):
    return tip_of(beam(n_elements, height))


def tip_of(problem):
    """The tip's height: 1e-4 is good to 1e-5 m here."""
    result = solve_dae(problem.system, (0.0, 1.0), problem.q0, problem.v0, "RadauIIA5", 1e-4, 1e-4, t_eval=TIMES)
    assert result.success
    return tip_height(result.q)


def distance(one, other):
    return np.abs(one - other).max()


def test_cable_converges_in_mesh_and_in_time():
    fine = theirs("cable", 16)
    assert distance(theirs("cable", 4), fine) < 1.5e-3 and distance(theirs("cable", 8), fine) < 8e-5
    assert distance(theirs("cable", 8, n_steps=1000), theirs("cable", 8)) < 1e-4
    assert fine.min() < -0.8  # it moves


def test_elements_approach_the_cable_as_the_mesh_gets_finer():
    apart = {n: distance(ours(n), theirs("cable", 16)) for n in BY_ELEMENTS}
    assert all(apart[n] < BY_ELEMENTS[n] for n in apart), apart
    assert apart[4] > 3.0 * apart[8] > 9.0 * apart[16], apart


def test_elements_lock_by_the_factor_that_is_said():
    # Poisson's ratio 0.3: the elements meet a cable that is (lambda + 2 mu)/E = 0.7/(1.3 x 0.4) times as stiff
    elements = tip_of(moderately_stiff_beam(16, "beam"))
    assert distance(elements, theirs("cable", 16, stiffness=0.7 / 0.52)) < 7.6e-4
    assert distance(elements, theirs("cable", 16)) > 3.5e-2


@pytest.mark.slow
def test_beams_meet_as_the_section_gets_slender():
    apart = {height: distance(ours(64, height), theirs("cable", 16, height)) for height in BY_HEIGHT}
    assert all(apart[height] < BY_HEIGHT[height] for height in apart), apart
    assert apart[0.08] > 2.5 * apart[0.04] > 2.5 * 3.5 * apart[0.02], apart
    # most of it is shear: Exudyn's model that has it is nearer, and as far from the cable
    assert distance(ours(64, 0.08), theirs("shear", 64, 0.08)) < 0.5 * apart[0.08]
    assert distance(theirs("cable", 16, 0.08), theirs("shear", 64, 0.08)) > apart[0.08]


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("solver", SOLVERS)
def test_result_is_in_our_order_and_on_the_base(model, solver):
    problem = moderately_stiff_beam(4)
    result = solve_exudyn_beam(problem, 0.2, 400, model, solver=solver)
    assert result.status is Status.REACHED_END and result.stats.n_accepted == result.h.size == 400
    assert result.q.shape == result.v.shape == result.a.shape == (30, 401) and result.lam.shape == (2, 401)
    known = [True] * (4 if model == "cable" else 2) + [False] * (2 if model == "cable" else 4)
    for values in (result.q, result.v, result.a):
        assert np.array_equal(np.isfinite(values).all(axis=1), known * 5)
    assert np.array_equal(result.q[:, 0][known * 5], problem.q0[known * 5])
    # the trapezoidal rule holds the base's velocity, not its place
    assert np.abs(result.q[0] + 0.01 * np.sin(2.0 * np.pi * result.t)).max() < 1e-7 and np.abs(result.q[1]).max() < 1e-9
    assert -0.3 < tip_height(result.q)[-1] < -0.2
    assert midpoint_deflection(result.q)[0] == 0.0 and np.abs(midpoint_deflection(result.q)).max() > 1e-3


def test_the_start_is_that_of_the_problem():
    for start, moving in (("node", 1), ("beam", 5)):
        v = solve_exudyn_beam(beam(4, start=start), 0.01, 10).v[:, 0].reshape(5, 6)
        assert np.allclose(v[:moving, 0], -0.02 * np.pi, rtol=1e-12) and not v[moving:, :4].any()


def test_failure_comes_back_as_a_row(capfd):
    result = solve_exudyn_beam(beam(16, 0.001), 1.0, 4)
    assert result.status is Status.SOLVER_FAILED and "Take more steps" in result.message
    assert result.q.shape == (102, result.t.size) and result.stats.n_accepted == result.t.size - 1 < 4
    assert capfd.readouterr().out == ""


def test_wrong_arguments_are_named():
    problem = beam(4)
    with pytest.raises(ValueError, match="model must be 'cable' or 'shear'; given 'rope'"):
        solve_exudyn_beam(problem, 1.0, 10, "rope")
    with pytest.raises(TypeError, match=r"problem must be a beam of twoloop\.mechanisms\.ancf_beam"):
        solve_exudyn_beam(four_bar(), 1.0, 10)
