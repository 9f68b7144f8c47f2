"""Wrong input: each mistake has its own error, which names the argument, says what was given and what to do."""

import numpy as np
import pytest

from tests.problems import moving_pivot, moving_pivot_state, pendulum, violations
from twoloop import ConstrainedSystem, Newmark, RungeKutta, Status, solve_dae
from twoloop.methods import PRESETS
from twoloop.tableaux import gauss

Q0, V0 = np.array([-1.0, 0.0]), np.zeros(2)


def solve(system=None, t_span=(0.0, 1.0), q0=Q0, v0=V0, **options):
    return solve_dae(system or pendulum(), t_span, q0, v0, **options)


def refuses(error, words, *arguments, **options):
    with pytest.raises(error, match=words):
        solve(*arguments, **options)


# --- the start


@pytest.mark.parametrize("name", ["q0", "v0"])
@pytest.mark.parametrize(
    ("value", "error", "words"),
    [
        ([1.0], ValueError, r"must have shape \(2,\); given shape \(1,\)"),
        (np.zeros((2, 1)), ValueError, r"must have shape \(2,\); given shape \(2, 1\)"),
        (0.0, ValueError, r"must have shape \(2,\)"),
        ([np.nan, 0.0], ValueError, r"must be finite; entries \[0\]"),
        ([0.0, np.inf], ValueError, r"must be finite; entries \[1\]"),
        (["left", "down"], TypeError, "must be an array of real numbers"),
        (None, (TypeError, ValueError), ""),
        ([1j, 0.0], TypeError, "must be an array of real numbers"),
        ([[1.0], [0.0, 1.0]], TypeError, "must be an array of real numbers"),
    ],
)
def test_start_vectors(name, value, error, words):
    refuses(error, f"{name}.*{words}", **{name: value})


def test_inconsistent_positions_say_how_far_and_what_to_do():
    refuses(ValueError, r"q0 is not consistent.*'pendulum'.*max\|C.*0.105.*consistent_state", q0=[-1.1, 0.0])


def test_inconsistent_velocities_say_how_far_and_what_to_do():
    refuses(ValueError, r"v0 is not consistent.*'pendulum'.*max\|C_q v.*0.3.*consistent_state", v0=[0.3, 0.0])


def test_velocities_that_forget_the_motion_of_the_constraint():
    q, v = moving_pivot_state(0.0)
    solve_dae(moving_pivot(), (0.0, 0.1), q, v)
    with pytest.raises(ValueError, match="v0 is not consistent"):
        solve_dae(moving_pivot(), (0.0, 0.1), q, v - [0.9, 0.0])


def test_positions_within_rounding_are_accepted():
    assert solve(q0=[-1.0 - 1e-10, 0.0]).success
    refuses(ValueError, "q0 is not consistent", q0=[-1.0 - 1e-6, 0.0])


def test_inconsistency_names_the_row(default_four_bar):
    problem, q = default_four_bar, default_four_bar.q0.copy()
    q[4] += 0.01  # y2: row 3
    with pytest.raises(ValueError, match=r"q0.*0\.01 \(row 3\)"):
        solve_dae(problem.system, (0.0, 1.0), q, problem.v0)


# --- times


@pytest.mark.parametrize(
    ("t_span", "error", "words"),
    [
        ((1.0, 0.0), ValueError, r"end > start; given \(1.0, 0.0\)"),
        ((1.0, 1.0), ValueError, "end > start"),
        ((0.0, np.nan), ValueError, "must be finite"),
        ((0.0, np.inf), ValueError, "must be finite"),
        ((0.0, 1.0, 2.0), ValueError, r"must have shape \(2,\)"),
        (1.0, ValueError, r"must have shape \(2,\)"),
        (("now", "then"), TypeError, "must be an array of real numbers"),
    ],
)
def test_t_span(t_span, error, words):
    refuses(error, f"t_span.*{words}", t_span=t_span)


@pytest.mark.parametrize(
    ("t_eval", "error", "words"),
    [
        ([0.5, 1.5], ValueError, r"within t_span = \(0.0, 1.0\).*1.5"),
        ([-0.1, 0.5], ValueError, r"within t_span.*-0.1"),
        ([0.5, 0.2], ValueError, r"strictly increasing; entry 1 \(0.2\) follows 0.5"),
        ([0.2, 0.2], ValueError, "strictly increasing"),
        ([], ValueError, "non-empty"),
        ([[0.1, 0.2]], ValueError, "one-dimensional"),
        (0.5, ValueError, "one-dimensional"),
        ([0.1, np.nan], ValueError, "must be finite"),
        (["soon"], (TypeError, ValueError), ""),
        ([0.5 + 1.0j], (TypeError, ValueError), ""),
    ],
)
def test_t_eval(t_eval, error, words):
    refuses(error, f"t_eval.*{words}", t_eval=t_eval)


def test_t_eval_between_fixed_steps():
    refuses(ValueError, r"t_eval must hold multiples of step_size = 0.1.*0.25", t_eval=[0.2, 0.25], step_size=0.1)
    assert solve(t_eval=[0.02, 0.5, 1.0], step_size=0.01).success


# --- numbers


@pytest.mark.parametrize("name", ["rtol", "atol", "first_step", "max_step", "step_size"])
@pytest.mark.parametrize(
    ("value", "error"),
    [
        (0.0, ValueError),
        (-1e-6, ValueError),
        (np.nan, ValueError),
        (-np.inf, ValueError),
        ("small", TypeError),
        (True, TypeError),
        ([1e-6, 1e-6], TypeError),
        (1e-3j, TypeError),
    ],
)
def test_positive_numbers(name, value, error):
    refuses(error, f"{name} must be", **{name: value})


@pytest.mark.parametrize("name", ["rtol", "atol", "first_step", "step_size"])
def test_numbers_that_must_be_finite(name):
    refuses(ValueError, f"{name}.*finite", **{name: np.inf})


@pytest.mark.parametrize("name", ["rtol", "atol"])
def test_tolerances_are_not_optional(name):
    refuses(TypeError, f"{name} must be a number; given None", **{name: None})


@pytest.mark.parametrize(("value", "error"), [(0, ValueError), (-3, ValueError), (10.0, TypeError), (True, TypeError)])
def test_max_steps(value, error):
    refuses(error, f"max_steps must be.*{value}", max_steps=value)


def test_step_size_longer_than_the_span():
    refuses(ValueError, "step_size must not exceed the length of t_span, 1; given 2.0", step_size=2.0)


@pytest.mark.parametrize("other", ["first_step", "max_step"])
def test_step_size_with_step_size_control(other):
    refuses(ValueError, f"step_size.*{other}", step_size=0.1, **{other: 0.1})


# --- the method and the system


def test_an_unknown_method_lists_the_known():
    with pytest.raises(ValueError, match=r"method must be one of.*given 'RK45'") as caught:
        solve(method="RK45")
    for name in PRESETS:
        assert name in str(caught.value)


@pytest.mark.parametrize("method", [None, 5, RungeKutta, Newmark, gauss(2)])
def test_methods_that_are_none(method):
    refuses(TypeError, "method must be a name.*SunRadau5.*or an object", method=method)


def test_a_problem_is_not_a_system(default_four_bar):
    with pytest.raises(TypeError, match=r"system must be a ConstrainedSystem.*problem\.system"):
        solve_dae(default_four_bar, (0.0, 1.0), default_four_bar.q0, default_four_bar.v0)


@pytest.mark.parametrize(
    ("changed", "error", "words"),
    [
        ({"n_q": 0}, ValueError, "n_q must be at least 1; given 0"),
        ({"n_q": 2.0}, TypeError, "n_q must be an int; given 2.0"),
        ({"n_c": 0}, ValueError, "n_c must be at least 1"),
        ({"n_c": True}, TypeError, "n_c must be an int"),
        ({"n_c": 3}, ValueError, "n_c must not exceed n_q = 2; given 3"),
        ({"mass": np.eye(3)}, ValueError, r"mass must have shape \(2, 2\); given an array of shape \(3, 3\)"),
        ({"mass": "heavy"}, (TypeError, ValueError), "mass"),
        ({"mass": [[1.0, 0.0], [1.0]]}, (TypeError, ValueError), "mass"),
        ({"force": None}, TypeError, "force must be a function; given None"),
        ({"constraint": np.zeros(1)}, TypeError, "constraint must be a function"),
        ({"gamma": 0.0}, TypeError, "gamma must be a function"),
    ],
)
def test_systems_that_make_no_sense(changed, error, words):
    arguments = {
        "n_q": 2,
        "n_c": 1,
        "mass": np.eye(2),
        "force": lambda t, q, v: np.zeros(2),
        "constraint": lambda t, q: q[:1],
        "jacobian": lambda t, q: np.eye(2)[:1],
    }
    with pytest.raises(error, match=words):
        ConstrainedSystem.from_python(**{**arguments, **changed})


SHAPES = {"mass": (2, 2), "force": (2,), "constraint": (1,), "jacobian": (1, 2), "gamma": (1,), "constraint_rate": (1,)}


@pytest.mark.parametrize("kind", SHAPES)
@pytest.mark.parametrize(
    ("value", "error", "words"),
    [
        (np.zeros((3, 3)), ValueError, r"returned shape \(3, 3\)"),
        (0.0, ValueError, r"returned shape \(\)"),
        (None, TypeError, "returned None"),
        ("text", TypeError, "returned 'text'"),
        (np.zeros(1, dtype=complex), TypeError, "returned array"),
        ([[1.0], [1.0, 2.0]], TypeError, r"returned \[\[1"),
    ],
)
def test_results_of_callbacks(kind, value, error, words):
    shape = str(SHAPES[kind]).replace("(", r"\(").replace(")", r"\)")
    with pytest.raises(error, match=rf"(?s){kind} of system 'pendulum' must return.*shape {shape}.*{words}"):
        solve(pendulum(**{kind: lambda *arguments: value}))


def test_a_callback_whose_shape_changes_later_names_the_time():
    system = pendulum(force=lambda t, q, v: np.zeros(2 if t < 0.5 else 3))
    refuses(ValueError, r"force of system 'pendulum'.*t = 0\.5.*shape \(3,\)", system)


@pytest.mark.parametrize("kind", ["mass", "force", "constraint", "jacobian", "gamma"])
def test_values_that_are_not_finite_at_the_start_name_the_callback(kind):
    system = pendulum(**{kind: lambda *arguments: np.full(SHAPES[kind], np.nan)})
    refuses(ValueError, rf"start.*{kind} of 'pendulum' returned values that are not finite", system)


def test_redundant_constraints_name_their_rows(default_four_bar):
    system = ConstrainedSystem.from_python(
        n_q=3,
        n_c=3,
        mass=np.eye(3),
        force=lambda t, q, v: np.zeros(3),
        constraint=lambda t, q: np.array([q[0], q[1], q[0] + 0.5 * q[1]]),
        jacobian=lambda t, q: np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 0.5, 0.0]]),
    )
    with pytest.raises(ValueError, match=r"rank 2 < n_c = 3.*row\(s\) \[[012]\] depend on the others.*Leave"):
        solve_dae(system, (0.0, 1.0), np.zeros(3), np.zeros(3))


def test_a_constraint_without_gradient_names_its_row():
    system = pendulum(constraint=lambda t, q: np.zeros(1), jacobian=lambda t, q: np.zeros((1, 2)), gamma=False)
    refuses(ValueError, r"rank 0 < n_c = 1.*row\(s\) \[0\]", system)


def test_a_mass_that_is_not_symmetric():
    system = pendulum(mass=lambda t, q: np.array([[1.0, 0.5], [0.0, 1.0]]))
    refuses(ValueError, r"mass of 'pendulum' must be symmetric.*0.5", system)


@pytest.mark.parametrize("mass", [np.diag([1.0, -2.0]), np.array([[1.0, 2.0], [2.0, 1.0]]), np.diag([1.0, 0.0])])
@pytest.mark.parametrize("constant", [True, False])
def test_a_mass_that_is_not_positive_definite(mass, constant):
    system = pendulum(mass=mass if constant else lambda t, q: mass)
    refuses(ValueError, "mass of 'pendulum' must be positive definite; its smallest eigenvalue", system)


# --- what goes wrong later


class OwnError(Exception):
    pass


@pytest.mark.parametrize("kind", ["mass", "force", "constraint", "jacobian", "gamma", "constraint_rate"])
@pytest.mark.parametrize("error", [OwnError, ZeroDivisionError])
def test_an_exception_of_a_callback_comes_through_with_its_time(kind, error):
    good = {
        "mass": lambda t, q: np.eye(2),
        "force": lambda t, q, v: np.array([0.0, -9.81]),
        "constraint": lambda t, q: np.array([0.5 * (q @ q - 1.0)]),
        "jacobian": lambda t, q: q[None, :],
        "gamma": lambda t, q, v: np.array([-(v @ v)]),
        "constraint_rate": lambda t, q: np.zeros(1),
    }[kind]

    def fails(t, *arguments):
        if t > 0.5:
            raise error("out of order")
        return good(t, *arguments)

    system = pendulum(**{kind: fails})
    with pytest.raises(
        error, match=rf"(?s)out of order.*raised by {kind} of system 'pendulum' at t = 0\.[5-9]"
    ) as caught:
        solve(system)
    assert type(caught.value) is error
    assert str(caught.value) == "out of order"  # unchanged; the time stands in a note
    # and the next run is not disturbed
    assert solve(t_span=(0.0, 0.1)).success


def test_an_exception_at_the_start_has_its_time_too():
    def fails(t, q, v):
        raise OwnError("never")

    refuses(OwnError, r"(?s)never.*force of system 'pendulum' at t = 0", pendulum(force=fails))


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("method", ["SunRadau5", "Newmark", "BDF", "DOP853", "PaperIRK"])
def test_values_that_stop_being_finite_end_the_run(value, method):
    system = pendulum(force=lambda t, q, v: np.array([0.0, -9.81 if t < 0.5 else value]))
    result = solve(system, method=method, rtol=1e-6, atol=1e-6)
    assert result.status == Status.NOT_FINITE
    assert not result.success
    assert 0.3 < result.t[-1] < 0.5
    assert result.t.size == result.stats.n_accepted + 1 > 3
    assert "force of 'pendulum'" in result.message
    assert f"t = {result.t[-1]:.10g}" in result.message
    assert np.isfinite(result.q).all()
    assert violations(pendulum(), result)[0] < 1e-9


@pytest.mark.parametrize("kind", ["constraint", "jacobian", "gamma", "mass"])
def test_every_callback_that_stops_being_finite_is_named(kind):
    good = pendulum()

    def fails(t, *arguments):
        return getattr(good, kind)(t, *arguments) * (1.0 if t < 0.5 else np.nan)

    result = solve(pendulum(**{kind: fails}))
    assert result.status == Status.NOT_FINITE
    assert f"{kind} of 'pendulum'" in result.message
    assert 0.3 < result.t[-1] < 0.5


def test_a_fixed_step_into_values_that_are_not_finite():
    system = pendulum(force=lambda t, q, v: np.array([0.0, -9.81 if t < 0.5 else np.nan]))
    result = solve(system, step_size=0.01)
    assert result.status == Status.NOT_FINITE
    assert result.t[-1] == pytest.approx(0.49, abs=0.0101)


def test_a_mass_that_loses_definiteness_ends_the_run():
    result = solve(pendulum(mass=lambda t, q: np.eye(2) * (1.0 if t < 0.5 else -1.0)))
    assert not result.success
    assert 0.3 < result.t[-1] < 0.5
    assert "the mass matrix was not positive definite" in result.message


def test_step_size_underflow_says_where_and_what_to_try():
    calls = [0]

    def noise(t, q, v):
        calls[0] += 1
        return np.array([0.0, -9.81 if t < 0.5 else 1e20 * (-1) ** calls[0]])

    result = solve(pendulum(force=noise))
    assert result.status == Status.STEP_TOO_SMALL
    assert not result.success
    assert 0.4 < result.t[-1] < 0.51
    assert f"t = {result.t[-1]:.10g}" in result.message
    assert "loosen rtol" in result.message
    assert result.t.size == result.stats.n_accepted + 1
    assert result.stats.n_rejected_convergence > 10


# --- compile=True


def test_what_cannot_be_compiled_says_which_function_and_why():
    def force(t, q, v):
        return open("forces.txt")

    with pytest.raises(TypeError, match=r"(?s)force: numba cannot compile the function 'force'.*Numba says.*open"):
        pendulum(compile=True, force=force)


@pytest.mark.parametrize(
    ("kind", "function"),
    [("jacobian", lambda t, q: q), ("force", lambda t, q, v: np.zeros(3))],
    ids=["jacobian", "force"],
)
def test_compiled_functions_of_the_wrong_shape(kind, function):
    system = pendulum(compile=True, gamma=False, **{kind: function})
    refuses(ValueError, rf"{kind} of system 'pendulum' must return an array of shape .*it returned shape", system)


def test_tolerances_below_rounding_are_refused(default_four_bar):
    problem = default_four_bar
    with pytest.raises(ValueError, match="rtol and atol must not both be below"):
        solve_dae(problem.system, (0.0, 1.0), problem.q0, problem.v0, rtol=1e-20, atol=1e-20)
