"""Rivals whose energy is followed: what they make of it, and that they may take all the steps they need."""

import pytest

from references.casadi.integrators import solve_cvodes
from studies.bench.collector import attempt
from studies.bench.figures import STYLES
from studies.bench.solvers import CVODE_C, CVODES, CYRK, DIFFRAX, HEYOKA
from studies.energy.runs import NOT_QUICK, OTHERS, QUICK, SWITCHING, case_of, measure, runs

PACKAGES = {HEYOKA: "heyoka", CYRK: "CyRK", CVODE_C: "sksundae", CVODES: "casadi", DIFFRAX: "diffrax"}


def test_the_rivals_are_among_the_runs():
    full, quick = ({run.solver.name for run in runs(short)} for short in (False, True))
    assert set(PACKAGES) <= full and quick == full - set(NOT_QUICK) and set(PACKAGES) <= set(STYLES)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if name == DIFFRAX else ()) for name in PACKAGES]
)
def test_the_energy_of_a_rival_is_followed(name):
    """Where tolerances are tight the energy changes less, and the motion is the true one."""
    pytest.importorskip(PACKAGES[name])
    run = next(run for run in runs(False) if run.solver.name == name)
    case, found = case_of(SWITCHING, QUICK), {}
    for tol in (1e-6, 1e-10):
        short = type(run)(case, run.solver, tol, "other", 1)
        result, status, message, _ = attempt(short, 0)
        assert status == "REACHED_END", message
        found[tol] = max(
            abs(case.problem.energy(result.t, result.q, result.v) - case.problem.energy(0.0, *start(case)))
        )
        assert measure(short, result)["slope_error"] > 0.0 and result.t.size > 300
    assert found[1e-10] < 1e-3 * case.scale.kinetic and found[1e-10] < 0.01 * found[1e-6]


def start(case):
    return case.problem.q0, case.problem.v0


def test_a_long_run_may_take_as_many_steps_as_it_needs():
    """The limit of the other studies, which have no clock in it, would end a long run."""
    pytest.importorskip("casadi")
    case = case_of(SWITCHING, QUICK)
    assert OTHERS[CVODES][1](case, 1e-8, 0).stats.n_accepted > 1000
    span = (0.0, case.t_end)
    few = solve_cvodes(case.problem.system, span, *start(case), 1e-4, 1e-4, most_steps=100)
    assert not few.success and few.t.size == 0
    run = next(run for run in runs(False) if run.solver.name == CVODES)
    assert measure(type(run)(case, run.solver, 1e-4, "other", 1), few)["t_reached"] == 0.0  # a row, all the same
    with pytest.raises(ValueError, match="most_steps"):
        solve_cvodes(case.problem.system, span, *start(case), most_steps=0)
