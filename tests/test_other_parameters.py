"""Systems of other parameters share code and arrays: a run equals that of a new system, and no mistake is hidden."""

import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from tests.compiled import centripetal, circle_of_length, heavy, radius
from tests.problems import assert_same, quick, some_of
from tests.problems import pendulum as bare_pendulum
from tests.test_bounds import FAR
from twoloop import ConstrainedSystem, Integrator, callback, consistent_state, mechanisms, solve_dae

METHODS = ["auto", "Taylor", "DOP853", "Adams", "RadauIIA5", "BDF"]
NAMES = ["four_bar", "redundant_slider_crank", "heavy_top", "knife_edge", "driven_crank", "n_four_bar"]
GRAVITY = 9.81


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


FEW = [("four_bar", "auto"), ("knife_edge", "DOP853"), ("redundant_slider_crank", "RadauIIA5")]
CASES = quick([*FEW, *(each for each in some_of(NAMES, METHODS) if each not in FEW)], 3)


@pytest.mark.parametrize(("name", "method"), CASES)
@pytest.mark.filterwarnings("ignore::twoloop.ConstraintWarning")
def test_it_is_the_run_of_the_long_way_to_the_bit(name, method, taken, by_the_loop):
    problem, new = getattr(mechanisms, name)(), getattr(mechanisms, name)()
    asked = [(k, t_eval) for k in (0, 1, 2, 3, 0, 2) for t_eval in (None, [0.02, 0.11, 0.15])]

    def call(problem, k, t_eval):
        system, q0, v0 = other(problem, k)
        return solve_dae(system, (0.0, 0.15), q0, v0, method, 1e-6, 1e-6, t_eval=t_eval)

    by_arrays = [call(problem, *each) for each in asked]
    assert sum(taken) >= 8
    by_the_loop()
    for each, one in zip(asked, by_arrays, strict=True):
        assert_same(one, call(new, *each))
        assert one.system.parameters.tobytes() == other(problem, each[0])[0].parameters.tobytes()


# Pendulums of mass p[0] and length p[1], in p[2] of the gravity


@callback("force")
def weight(t, q, v, p, Q):
    Q[1] = -p[0] * p[2]


@callback("gamma")
def wrong_gamma(t, q, v, p, Qd):
    Qd[0] = -(v[0] * v[0] + v[1] * v[1]) * (1.0 + 10.0 * (p[1] - 1.1) * (p[1] - 1.12))


@callback("kinematics")
def wrong_kinematics(t, q, v, p, C, Cq, Ct, Qd):
    C[0] = 0.5 * (q[0] * q[0] + q[1] * q[1] - p[1] * p[1])
    Cq[0, 0], Cq[0, 1] = q[0], q[1]
    Qd[0] = -(v[0] * v[0] + v[1] * v[1]) * (1.0 + 10.0 * (p[1] - 1.1) * (p[1] - 1.12))


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


@pytest.mark.parametrize("kind", ["gamma", "kinematics"])
def test_what_is_wrong_with_other_parameters_alone_is_found(kind, taken):
    """Wrong gamma that is right for the first parameters; the second show it, and so do all that follow."""
    system = pendulum(**{kind: wrong_gamma if kind == "gamma" else wrong_kinematics})
    for length in (1.1, 1.12, 1.1, 1.12, 1.1):
        assert swing(system, 1.3, length, GRAVITY).success
    assert taken[-1]
    for length in (1.11, 1.14, 1.13):
        with pytest.raises(ValueError, match=kind):
            swing(system, 1.3, length, GRAVITY)


def test_a_callback_that_branches_on_its_parameters_goes_the_long_way(taken, angle=1.5):
    @callback("gamma")
    def wrong(t, q, v, p, Qd):
        Qd[0] = -(v[0] * v[0] + v[1] * v[1])
        if 1.155 < p[1] < 1.165:
            Qd[0] *= 1.001

    system = pendulum(gamma=wrong)
    assert all(each.success for each in scan(system, 3, angle=angle)) and not any(taken)
    with pytest.raises(ValueError, match="gamma"):
        swing(system, 1.3, 1.16, GRAVITY, angle=angle)


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


def test_parameters_of_another_family_and_back(taken):
    """Whole numbers and equal ones make other equations."""
    system, new = pendulum(), pendulum()
    for p in [*((mass, 1.1, 9.81) for mass in (1.3, 1.4, 1.5, 1.0, 1.1)), (1.6, 1.2, 9.7)] * 3:
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


def test_an_integrator_takes_parameters_as_it_would_a_system(taken):
    integrator, system = Integrator(pendulum(), rtol=1e-7, atol=1e-7), pendulum()
    for k in range(6):
        p = 1.3 + 0.01 * k, 1.1, GRAVITY
        q0 = 1.1 * np.array([np.sin(0.4), -np.cos(0.4)])
        result = integrator.run((0.0, 1.0), q0, [0.0, 0.0], parameters=p, t_eval=[0.5, 1.0])
        assert_same(result, swing(system, *p, t_eval=[0.5, 1.0]))
    assert taken[-2:] == [True, True]


# --- calls from other starts and with other parameters: what is kept between them hides no mistake
@callback("force")
def as_far_as_it_is_told(t, q, v, p, Q):
    Q[int(p[1] * FAR)] = -9.81 * p[0]


@pytest.mark.parametrize("wrong", [2.0, 0.7])
def test_bounds_are_looked_at_where_parameters_are_places(wrong):
    given = bare_pendulum(compile=True).given | {"force": as_far_as_it_is_told, "mass": heavy}
    system = ConstrainedSystem(n_q=2, n_c=1, parameters=[1.3, 0.1 / FAR], **given)
    q0, v0 = [0.6, -0.8], [0.0, 0.0]
    for _ in range(2):
        assert solve_dae(system, (0.0, 0.1), q0, v0).success
        assert solve_dae(system.with_parameters([1.4, 0.2 / FAR]), (0.0, 0.1), q0, v0).success
    with pytest.raises(ValueError, match="goes out of bounds: index"):
        solve_dae(system.with_parameters([1.4, wrong]), (0.0, 0.1), q0, v0)


# --- code that is traced once for systems that share callbacks: with any parameters it is what they would get alone
SPAN = (0.0, 1.0)


@callback("force")
def spring_and_damper(t, q, v, p, Q):
    Q[0] = -p[1] * q[0] - p[2] * v[0]
    Q[1] = -p[0] * 9.81


@callback("constraint")
def circle(t, q, p, C):
    C[0] = 0.5 * (q[0] ** 2 + q[1] ** 2 - p[3] ** 2)


@callback("force")
def by_whole_part(t, q, v, p, Q):
    Q[0], Q[1] = -math.floor(10.0 * p[1]) * q[0], -p[0] * 9.81


@callback("force")
def by_threshold(t, q, v, p, Q):
    Q[0], Q[1] = (-10.0 * q[0] if p[1] > 1.5001 else 0.0), -p[0] * 9.81


def bead(parameters, force=spring_and_damper):
    return ConstrainedSystem(
        n_q=2, n_c=1, mass=heavy, force=force, constraint=circle, jacobian=radius, gamma=centripetal,
        parameters=parameters,
    )  # fmt: skip


def run_bead(system, compiled="auto", method="auto"):
    return solve_dae(system, SPAN, [system.parameters[3], 0.0], [0.0, 0.5], method, 1e-10, 1e-10, compiled=compiled)


@callback("force")
def by_sum(t, q, v, p, Q):
    Q[0], Q[1] = -(p[0] + p[1]) * q[0] + p[0] * v[1], -p[0] * 9.81


@callback("force")
def by_loop(t, q, v, p, Q):
    """A root by Newton's method, which there is for p[1] < 1 only."""
    x = 1.0
    while abs(x * x + p[1] - 1.0) > 1e-10:
        x = x - 0.5 * (x * x + p[1] - 1.0) / x
    Q[0], Q[1] = -x * q[0], -p[0] * 9.81


@callback("force")
def by_root(t, q, v, p, Q):
    """Of what is negative for p[1] > 1, as the number may be with which it is traced."""
    Q[0], Q[1] = -math.sqrt(1.0 - p[1] * p[1]) * q[0], -p[0] * 9.81


@callback("force")
def by_knock(t, q, v, p, Q):
    """A blow late in the run, above a threshold."""
    Q[0], Q[1] = 0.0, -p[0] * 9.81
    if p[1] > 1.5:
        Q[0] = 50.0 * np.exp(-((t - 0.77) ** 2) * 1e5)


PARAMETERS = [
    *([1.3, 2.7, 0.4, 1.9], [2.6, 1.4, 0.1, 1.7], [1.3, 1.3, 0.4, 1.9], [1.3, -1.3, 0.4, 1.9], [2.0, 2.7, 0.0, 1.9]),
    *([2.0, -1.0, 0.5, 1.0], [0.7, 0.7, 0.7, 0.7], [1e-3, 2.5e4, 0.3, 1.1]),
]


@pytest.mark.parametrize("method", quick(["auto", "DOP853", "Taylor"]))
@pytest.mark.parametrize("parameters", PARAMETERS, ids=str)
def test_a_run_is_what_it_is_without_code(parameters, method):
    made, expected = (run_bead(bead(parameters), compiled, method) for compiled in ("auto", False))
    assert made.success and expected.success and made.compiled and expected.compiled is False
    assert np.abs(made.q[:, -1] - expected.q[:, -1]).max() < 1e-7


@pytest.mark.parametrize("first", [1e-14, 5e-324, 1e30, 1.3000000001, 0.4])
def test_what_ran_before_has_no_part_in_it(first):
    """Parameters that are alike, tiny or huge once are told apart all the same."""
    run_bead(bead([1.3, first, 0.4, 1.9], by_sum))
    system = bead([1.3, 0.31, 0.4, 1.9], by_sum)
    made, expected = run_bead(system, method="DOP853"), run_bead(system, compiled=False, method="DOP853")
    assert np.abs(made.q[:, -1] - expected.q[:, -1]).max() < 1e-11


NO_FORMULAS = {by_loop: (0.995, 0.7), by_root: (0.995, 1.0 - 2.0**-30), by_knock: (1.495, 1.51)}
NO_FORMULAS |= dict.fromkeys((by_whole_part, by_threshold), (1.37, 1.5, 1.52, 2.25))


@pytest.mark.parametrize("force", NO_FORMULAS)
def test_callbacks_that_are_no_formulas_of_their_parameters_run_all_the_same(force):
    for value in NO_FORMULAS[force]:
        system = bead([1.3, value, 0.4, 1.9], force)
        made, expected = run_bead(system), run_bead(system, compiled=False, method="DOP853")
        assert made.success and np.abs(made.q[:, -1] - expected.q[:, -1]).max() < 1e-7
