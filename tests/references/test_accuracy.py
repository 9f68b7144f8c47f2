"""Test every adapter against motions that are known by other means, at tolerances that it follows."""

import pytest

from references.paper.four_bar_minimal import MinimalFourBar
from references.scipy.index1 import STABILISATIONS, solve_index1
from references.sundials.residual import FORMS
from tests import problems
from tests.marks import slow
from tests.references.adapters import ADAPTERS, ANY_CALLBACK, each

# error of q at 10 s for each tolerance: three times the largest of 15 runs that differ in rounding, which alone moves
# IDA's error by a factor of 2 to 24
BOUNDS = {
    ("default", "IDA, index1"): {1e-5: 5e-2, 1e-7: 1e-3, 1e-9: 1.1e-5},
    ("default", "IDA, stabilised"): {1e-5: 8e-3, 1e-7: 1.5e-4, 1e-9: 3e-6},
    ("collinear", "IDA, stabilised"): {1e-5: 3e-2, 1e-7: 9e-4, 1e-9: 2.3e-5},
    ("default", "DOP853, index 1"): {1e-6: 1.5e-4, 1e-8: 3e-7},
    ("default", "DOP853, baumgarte"): {1e-6: 1e-5, 1e-8: 1e-7},
    ("default", "DOP853, projection"): {1e-6: 1e-4, 1e-8: 2e-7},
    ("default", "RK45, index 1"): {1e-6: 2e-3, 1e-8: 2e-5},
    ("default", "LSODA, index 1"): {1e-6: 1e-3, 1e-8: 1e-5},
    ("default", "Radau, index 1"): {1e-6: 1e-5},
    ("default", "BDF, index 1"): {1e-6: 5e-3},
    ("default", "Radau, solve_dae"): {1e-6: 3e-5},
    ("collinear", "DOP853, projection"): {1e-6: 2e-4, 1e-8: 6e-7},
}


# test_adapters.py has every adapter on a double pendulum, of which machine code is made in less time
FAST = (("default", "DOP853, projection"),)


def run(name, *start, tol, **options):
    method, _, stabilisation = name.partition(", ")
    if stabilisation in STABILISATIONS:
        return solve_index1(*start, method, tol, tol, stabilisation=stabilisation, **options)
    return ADAPTERS[name](*start, tol=tol, **options)


@pytest.mark.parametrize(("problem", "name"), [key if key in FAST else slow(*key) for key in BOUNDS])
@pytest.mark.slow
def test_agrees_with_the_truth_and_follows_the_tolerance(problem, name):
    made, times, errors = problems.LINKAGES[problem], [10.0], []
    q, v = MinimalFourBar.from_parameters(made.parameters).states(times)
    for tol, bound in BOUNDS[problem, name].items():
        result = run(name, made.system, (0.0, 10.0), made.q0, made.v0, tol=tol)
        assert result.success and result.t[-1] == 10.0 and "reached the end" in result.message
        assert result.t.size == result.h.size + 1 == result.stats.n_accepted + 1
        errors.append(problems.worst(result.q[:, -1], q[:, 0]))
        assert errors[-1] < bound and problems.worst(result.v[:, -1], v[:, 0]) < 20.0 * bound
    if "IDA" in name:
        assert errors[0] > 50.0 * errors[2], errors


# times and tolerances; gear takes steps of 1e-3 s
ON_ANY = [*ANY_CALLBACK, "DOP853, baumgarte"]
LOOSE = {"GSTIFF": 1e-4, "RK45, index 1": 1e-5, "BDF, solve_dae": 1e-4}


@pytest.mark.parametrize("name", each(of=ON_ANY))
@pytest.mark.slow
def test_time_dependent_constraints_without_a_gamma(name):
    system, times = problems.moving_pivot(gamma=False), [0.5, 2.0]
    result = run(name, system, (0.0, 2.0), *problems.moving_pivot_state(0.0), tol=1e-8, t_eval=times)
    q, v = problems.moving_pivot_state(result.t)
    far = LOOSE.get(name, 1e-5)
    assert result.success and problems.worst(result.q, q) < far and problems.worst(result.v, v) < 10.0 * far
    held = {"DOP853, index 1": 1e-7, "DOP853, baumgarte": 1e-8, "DOP853, projected": 1e-14, "GSTIFF": 1e-12}
    assert problems.violations(system, result)[0] < held.get(name, 1e-5)


@pytest.mark.parametrize("name", each(of=ON_ANY))
@pytest.mark.slow
def test_full_mass_matrix_that_varies_and_forces_that_depend_on_velocities(name):
    result = run(name, problems.oblique_pendulum(), (0.0, 2.0), *problems.oblique_start(), tol=1e-8, t_eval=[0.5, 2.0])
    x, u, lam = problems.oblique_point(result.t)
    ours, far = problems.oblique_to_point(result), LOOSE.get(name, 1e-5)
    assert problems.worst(ours[0], x) < far and problems.worst(ours[1], u) < 10.0 * far
    assert problems.worst(result.lam[0], lam) < (1e3 if "IDA" in name or "solve_dae" in name else 1e2) * far


@pytest.mark.slow
def test_the_stabilised_form_of_ida_keeps_both_constraints_and_index_1_drifts():
    made = problems.LINKAGES["default"]
    start = made.system, (0.0, 10.0), made.q0, made.v0
    drifted, kept = (problems.violations(made.system, ADAPTERS[f"IDA, {form}"](*start, tol=1e-8)) for form in FORMS)
    assert kept[0] < 1e-7 and kept[1] < 2e-6 and drifted[0] > 20.0 * kept[0]
