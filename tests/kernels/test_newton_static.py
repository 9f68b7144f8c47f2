"""Test that stiff runs of large systems leave the static form, which has no Newton matrices, and go on in another."""

import numpy as np
import pytest

import twoloop.run.workspace as static_module
from tests.problems import worst
from twoloop import solve_dae
from twoloop.bodies import PlanarModel
from twoloop.methods.presets import PRESETS
from twoloop.run.run import Run

N_BARS, SPAN = 8, (0.0, 0.3)


@pytest.fixture
def left(monkeypatch):
    """Let small systems count as large; return the list of times at which runs leave the static form."""
    times = []
    change = Run.change_form

    def noted(run):
        times.append(float(run.clock[run.a.T]))
        change(run)

    monkeypatch.setattr(Run, "change_form", noted)
    for name, value in (("LARGE", 0), ("MAX_STATIC_SHARE", 1e9)):
        monkeypatch.setattr(static_module, name, value)
    return times


def stiff_chain():
    """Return the problem of a chain of bars that falls, with stiff and strongly damped joints."""
    model = PlanarModel(gravity=(0.0, -9.81))
    bar = model.ground
    for k in range(N_BARS):
        previous, bar = bar, model.body(f"bar {k}", mass=1.0, inertia=1.0 / 12.0, position=(k + 0.5, 0.0), angle=0.0)
        model.torsion_spring(model.revolute(previous, bar, at=(float(k), 0.0)), stiffness=1e5, damping=1e4)
    return model.problem(t_span=SPAN)


def solve(problem, method, tolerance):
    return solve_dae(problem.system, SPAN, problem.q0, problem.v0, method, tolerance, tolerance, compiled=False)


def test_a_run_that_becomes_stiff_leaves_the_static_form_once(left):
    problem = stiff_chain()
    result = solve(problem, "auto", 1e-5)
    assert result.success and len(left) == 1 and result.stats.n_jacobians > 0
    known = solve(problem, "RadauIIA9", 1e-10)
    assert len(left) == 1 and worst(result.q[:, -1], known.q[:, -1]) < 1e-4


def test_implicit_methods_do_not_take_the_static_form():
    problem = stiff_chain()
    system, start = problem.system, (0.0, np.asarray(problem.q0))
    plans = {name: PRESETS[name].plan(system.n_q, 1e-6, 1e-6, False) for name in ("DOP853", "TRBDF2")}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(static_module, "LARGE", 0)
        patch.setattr(static_module, "MAX_STATIC_SHARE", 1e9)
        assert static_module.static_form(system, *start, plans["DOP853"]) is not None
        assert static_module.static_form(system, *start, plans["TRBDF2"]) is None
