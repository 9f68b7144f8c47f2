"""An integrator that is kept: its runs are those of solve_dae, whatever came before."""

import numpy as np
import pytest

from twoloop import Integrator, mechanisms, solve_dae
from twoloop.ensembles import integrator as module


@pytest.fixture(scope="module")
def problem():
    return mechanisms.four_bar()


@pytest.mark.parametrize("options", [{}, {"compiled": True}, {"method": "DOP853", "max_step": 0.01}])
def test_its_runs_are_those_of_solve_dae(problem, options):
    integrator = Integrator(problem.system, rtol=1e-7, atol=1e-7, **options)
    random, given = np.random.default_rng(0), {"rtol": 1e-7, "atol": 1e-7, **options}
    for factor in (1.0, random.uniform(0.5, 2.0), 1.0):
        span = (0.0, 0.5 * factor)
        own = integrator.run(span, problem.q0, problem.v0, t_eval=[0.1, 0.2])
        known = solve_dae(problem.system, span, problem.q0, problem.v0, t_eval=[0.1, 0.2], **given)
        assert (own.q == known.q).all() and own.t.tolist() == [0.1, 0.2]


def test_parameters_of_a_run(problem, monkeypatch):
    monkeypatch.setattr(module, "MOST", 2)
    system, integrator = problem.system, Integrator(problem.system, rtol=1e-7, atol=1e-7)
    scaled = [system.parameters * factor for factor in (1.0, 1.5, 2.0, 1.5)]
    for p in scaled:  # everything is longer by as much, and so is the motion slower
        q0 = problem.q0.copy()
        factor = p[0] / system.parameters[0]
        q0[[0, 1, 3, 4, 6, 7]] *= factor
        own = integrator.run((0.0, 0.5 * factor**0.5), q0, problem.v0, p)
        known = integrator.run((0.0, 0.5), problem.q0, problem.v0)
        assert np.abs(own.q[2::3, -1] - known.q[2::3, -1]).max() < 1e-5 and (own.system.parameters == p).all()
    assert len(integrator._systems) <= 2


def test_its_tolerances_stay(problem):
    tolerances = np.full(9, 1e-9)
    integrator = Integrator(problem.system, atol=tolerances)
    runs = [integrator.run((0.0, 0.5), problem.q0, problem.v0)]
    tolerances[:] = 1e-3
    runs.append(integrator.run((0.0, 0.5), problem.q0, problem.v0))
    assert (runs[0].q == runs[1].q).all()


def test_wrong_tolerances_and_systems_are_named_when_it_is_made(problem):
    with pytest.raises(ValueError, match="rtol must be positive"):
        Integrator(problem.system, rtol=0.0)
    with pytest.raises(TypeError, match="system must be a ConstrainedSystem"):
        Integrator(problem)
    assert "four-bar" in repr(Integrator(problem.system)) and "auto" in repr(Integrator(problem.system))
