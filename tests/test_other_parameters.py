"""A run of a system of other parameters equals that of the long way, and what is wrong with these alone is found."""

import cProfile
import pstats
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from tests.compiled import centripetal, circle_of_length, heavy, radius
from tests.problems import some_of
from tests.test_again import assert_same
from twoloop import ConstrainedSystem, Integrator, callback, consistent_state, mechanisms, solve, solve_dae
from twoloop.run import comparison

METHODS = ["auto", "Taylor", "DOP853", "Adams", "RadauIIA5", "BDF"]
NAMES = ["four_bar", "redundant_slider_crank", "heavy_top", "knife_edge", "closed_chain", "driven_crank", "n_four_bar"]
GRAVITY = 9.81


def the_long_way(monkeypatch):
    monkeypatch.setattr(solve, "record_again", lambda *asked: None)


def made(name):
    return mechanisms.closed_chain(4) if name == "closed_chain" else getattr(mechanisms, name)()


def other(problem, k):
    """A system of other parameters, and a start that is consistent with them."""
    system, q, v = problem.system, problem.q0, problem.v0
    p = system.parameters.copy()
    weights = np.isclose(np.abs(p), GRAVITY) | np.isclose(np.abs(p), 0.25 * GRAVITY)
    if problem.system.name == "four-bar":
        p[2] += 0.003 * k
    elif weights.any():
        p[weights] *= 1.0 + 0.01 * k
    else:
        p[-1] *= 1.0 + 0.01 * k
    changed = system.with_parameters(p)
    return (changed, *(consistent_state(changed, 0.0, q, v) if problem.system.name == "four-bar" else (q, v)))


@pytest.mark.parametrize(("name", "method"), some_of(NAMES, METHODS))
@pytest.mark.filterwarnings("ignore::twoloop.ConstraintWarning")
def test_it_is_the_run_of_the_long_way_to_the_bit(name, method, taken, monkeypatch):
    problem, new = made(name), made(name)
    asked = [(k, t_eval) for k in (0, 1, 2, 3, 0, 2) for t_eval in (None, [0.02, 0.11, 0.15])]

    def call(problem, k, t_eval):
        system, q0, v0 = other(problem, k)
        return solve_dae(system, (0.0, 0.15), q0, v0, method, 1e-6, 1e-6, t_eval=t_eval)

    by_arrays = [call(problem, *each) for each in asked]
    assert sum(taken) >= 8
    the_long_way(monkeypatch)
    for each, one in zip(asked, by_arrays, strict=True):
        assert_same(one, call(new, *each))
        assert one.system.parameters.tobytes() == other(problem, each[0])[0].parameters.tobytes()


# Pendulums of mass p[0] and length p[1], in p[2] of the gravity


@callback("force")
def weight(t, q, v, p, Q):
    Q[1] = -p[0] * p[2]


FUNCTIONS = {"mass": heavy, "force": weight, "constraint": circle_of_length, "jacobian": radius, "gamma": centripetal}
FIRST = (1.3, 1.1, GRAVITY)


def pendulum(**functions):
    return ConstrainedSystem(n_q=2, n_c=1, parameters=FIRST, **(FUNCTIONS | functions))


def swing(system, *p, angle=0.4, method="auto", **options):
    changed = system.with_parameters(p)
    q0 = p[1] * np.array([np.sin(angle), -np.cos(angle)])
    return solve_dae(changed, (0.0, 1.0), q0, [0.0, 0.0], method, 1e-7, 1e-7, **options)


def scan(system, n=6, **options):
    return [swing(system, 1.3 + 0.01 * k, 1.1 + 0.02 * k, GRAVITY, **options) for k in range(n)]


def test_what_is_wrong_with_other_parameters_alone_is_found(taken):
    """Wrong gamma that is right for the first parameters; the second show it, and so do all that follow."""

    @callback("gamma")
    def wrong(t, q, v, p, Qd):
        Qd[0] = -(v[0] * v[0] + v[1] * v[1]) * (1.0 + 10.0 * (p[1] - 1.1000000001) * (p[1] - 1.1200000001))

    system = pendulum(gamma=wrong)
    for length in (1.1, 1.12, 1.1, 1.12, 1.1):
        assert swing(system, 1.3, length, GRAVITY).success
    assert taken[-1]
    for length in (1.11, 1.14, 1.13):
        with pytest.raises(ValueError, match="gamma"):
            swing(system, 1.3, length, GRAVITY)


@pytest.mark.parametrize("angle", [0.4, 1.5])
def test_a_callback_that_branches_on_its_parameters_goes_the_long_way(angle, taken):
    @callback("gamma")
    def wrong(t, q, v, p, Qd):
        Qd[0] = -(v[0] * v[0] + v[1] * v[1])
        if 1.155 < p[1] < 1.165:
            Qd[0] *= 1.001

    system = pendulum(gamma=wrong)
    assert all(each.success for each in scan(system, 3, angle=angle)) and not any(taken)
    with pytest.raises(ValueError, match="gamma"):
        swing(system, 1.3, 1.16, GRAVITY, angle=angle)


def test_fused_callbacks_are_compared_for_all_parameters(taken):
    @callback("kinematics")
    def wrong(t, q, v, p, C, Cq, Ct, Qd):
        C[0] = 0.5 * (q[0] * q[0] + q[1] * q[1] - p[1] * p[1])
        Cq[0, 0], Cq[0, 1] = q[0], q[1]
        Qd[0] = -(v[0] * v[0] + v[1] * v[1]) * (1.0 + 10.0 * (p[1] - 1.1) * (p[1] - 1.12))

    system = pendulum(kinematics=wrong)
    for length in (1.1, 1.12, 1.1, 1.12):
        assert swing(system, 1.3, length, GRAVITY).success
    assert taken[-1]
    with pytest.raises(ValueError, match="kinematics"):
        swing(system, 1.3, 1.11, GRAVITY)


def test_an_error_that_grows_along_the_run_is_found_where_no_parameters_were(taken):
    """Gamma is right until 1 s, and beyond only for the first lengths: there nothing is compared at the start."""

    @callback("gamma")
    def wrong(t, q, v, p, Qd):
        Qd[0] = -(v[0] * v[0] + v[1] * v[1]) * (1.0 + 10.0 * t**9 * (p[1] - 1.1000000001) * (p[1] - 1.1200000001))

    system = pendulum(gamma=wrong)
    for length in (1.1, 1.12, 1.1, 1.12, 1.1, 1.12):
        assert swing(system, 1.3, length, GRAVITY).success
    assert taken[-1]
    found = [swing(system, 1.3, length, GRAVITY).status.name for length in (1.2, 1.3)]
    assert found == ["WRONG_DERIVATIVE"] * 2


@pytest.mark.parametrize("level", [GRAVITY, 9.5], ids=["diagonal at first", "full"])
def test_a_mass_that_parameters_make_singular_is_refused_as_ever(taken, level):
    @callback("mass")
    def other_mass(t, q, p, M):
        M[0, 0], M[1, 1], M[0, 1], M[1, 0] = p[0], p[0], p[2] - level, p[2] - level

    system = ConstrainedSystem(n_q=2, n_c=1, parameters=FIRST, constant_mass=True, **(FUNCTIONS | {"mass": other_mass}))
    new = ConstrainedSystem(n_q=2, n_c=1, parameters=FIRST, constant_mass=True, **(FUNCTIONS | {"mass": other_mass}))
    scan(system)
    assert taken[-1] == (level != GRAVITY)  # where the difference is zero, its formulas may divide by it
    for p in ((1.3, 1.1, level + 1.2999999999), (1.3, 1.1, level + 0.19), (1.3, 1.1, level + 0.01)):
        assert_same(swing(system, *p), swing(new, *p))
    for each in (system, new):
        with pytest.raises(ValueError, match="mass"):
            swing(each, 1.3, 1.1, level - 2.6)


def test_what_a_callback_raises_for_some_parameters_comes_through(taken):
    @callback("force")
    def raising(t, q, v, p, Q):
        Q[1] = -p[0] * p[2]
        if q[0] > 1.2:
            raise ValueError("out of range")

    system = pendulum(force=raising)  # branches: the long way
    scan(system)
    assert not any(taken)
    with pytest.raises(ValueError, match="out of range"):
        swing(system, 1.3, 2.2, GRAVITY, angle=1.0)


def test_wrong_starts_and_parameters_are_said_as_ever(taken):
    system = pendulum()
    scan(system)
    assert taken[-1]
    with pytest.raises(ValueError, match="q0"):
        solve_dae(
            system.with_parameters([1.3, 1.2, GRAVITY]), (0.0, 1.0), [0.0, -1.1], [0.0, 0.0], rtol=1e-7, atol=1e-7
        )
    with pytest.raises(ValueError, match="3 numbers"):
        system.with_parameters([1.0])
    scan(system)
    assert taken[-1]


def test_parameters_of_another_family_and_back(taken):
    """Whole numbers and equal ones make other equations."""
    system, new = pendulum(), pendulum()
    for p in [
        (1.3, 1.1, 9.81),
        (1.4, 1.1, 9.81),
        (1.5, 1.1, 9.81),
        (1.0, 1.1, 9.81),
        (1.1, 1.1, 9.81),
        (1.6, 1.2, 9.7),
    ] * 3:
        assert_same(swing(system, *p), swing(new, *p) if not taken[-1] else swing(pendulum(), *p))
    assert sum(taken) > 8


def test_threads_have_parameters_of_their_own(taken):
    system = pendulum()
    alone = scan(system, 40)
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda k: swing(system, 1.3 + 0.01 * k, 1.1 + 0.02 * k, GRAVITY), range(40)))
    assert sum(taken) > 60
    for one, another in zip(alone, together, strict=True):
        assert_same(one, another)


def test_results_keep_what_they_are(taken):
    results = scan(pendulum(), 8, t_eval=np.linspace(0.0, 1.0, 5))
    kept = [(each.q.copy(), each.system.parameters.copy()) for each in results]
    scan(results[0].system, 8, t_eval=np.linspace(0.0, 1.0, 5))
    assert sum(taken) > 10
    for each, (q, p) in zip(results, kept, strict=True):
        assert (each.q == q).all() and (each.system.parameters == p).all()
        rows = 0.5 * ((each.q**2).sum(axis=0) - p[1] ** 2)
        assert np.abs(rows).max() < 1e-12


def test_an_integrator_takes_parameters_as_it_would_a_system(taken):
    integrator, system = Integrator(pendulum(), rtol=1e-7, atol=1e-7), pendulum()
    for k in range(6):
        p = 1.3 + 0.01 * k, 1.1, GRAVITY
        q0 = 1.1 * np.array([np.sin(0.4), -np.cos(0.4)])
        result = integrator.run((0.0, 1.0), q0, [0.0, 0.0], parameters=p, t_eval=[0.5, 1.0])
        assert_same(result, swing(system, *p, t_eval=[0.5, 1.0]))
    assert taken[-2:] == [True, True]


def test_callbacks_along_runs_are_compared_by_the_doubling_rule(monkeypatch):
    """At the first runs by the arrays of one before, then at the 2nd, 4th, 8th, ..., and at parameters beyond these."""
    looked = []
    compare = comparison._derivatives_again
    monkeypatch.setattr(comparison, "_derivatives_again", lambda *given: looked.append(1) or compare(*given))
    system, counts = pendulum(), []
    for k in [0, 9, 0, 9, *range(1, 9), 20]:
        before = len(looked)
        assert swing(system, 1.3 + 0.01 * k, 1.1, GRAVITY).success
        counts.append(len(looked) > before)
    assert counts == [True, True, True, True, False, True, False, False, False, True, False, False, True]


CALLS = {  # in a call with other parameters: beyond those before, and among them
    "four_bar": (1010, 710),
    "heavy_top": (770, 500),
    "spatial_four_bar": (1390, 1120),
    "bricard": (640, 450),
    "redundant_slider_crank": (1460, 1210),
}
AT_TIMES = 210  # more where the solution is wanted at times


@pytest.mark.parametrize("name", CALLS)
@pytest.mark.filterwarnings("ignore::twoloop.ConstraintWarning")
def test_a_call_with_other_parameters_takes_few_calls_of_functions(name):
    problem = made(name)

    def calls_of(k, t_eval):
        system, q0, v0 = other(problem, k)
        profile = cProfile.Profile()
        profile.runcall(solve_dae, system, (0.0, 0.1), q0, v0, t_eval=t_eval)
        return pstats.Stats(profile).total_calls

    for t_eval, more in ((None, 0), (np.linspace(0.0, 0.1, 5), AT_TIMES)):
        beyond = [calls_of(k, t_eval) for k in range(8)]
        among = [calls_of(k, t_eval) for k in range(8)]
        medians = np.median(beyond[3:]), np.median(among)
        assert medians[0] < CALLS[name][0] + more and medians[1] < CALLS[name][1] + more, (beyond, among)
