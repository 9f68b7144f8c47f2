"""Wrong input: each mistake of `tests/bad_input` has its error, and docs/errors.md shows it; what goes wrong later."""

import re
from pathlib import Path

import numpy as np
import pytest

from tests import errors_page
from tests.bad_input.case import solve
from tests.bad_input.cases import CASES
from tests.problems import pendulum
from twoloop import Status
from twoloop.checks.arguments import check_real, check_tolerance
from twoloop.methods.presets import PRESETS


def refuses(error, words, *arguments, **options):
    with pytest.raises(error, match=words):
        solve(*arguments, **options)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.id)
def test_each_mistake_has_its_error(case):
    error = errors_page.error_of(case)
    if isinstance(error, ImportError) and not issubclass(case.error, ImportError):
        pytest.skip(str(error))  # of a package that is optional: `make test-oldest`
    assert isinstance(error, case.error) and not isinstance(error, (OverflowError, UnicodeError)), repr(error)
    assert re.search(case.words, str(error), re.DOTALL), str(error)


def test_there_are_many_and_each_once():
    assert len(CASES) >= 650 and len({case.id for case in CASES}) == len(CASES)
    assert all(case.words and case.advice for case in CASES)


def test_the_page_of_errors_is_what_the_cases_give():
    for package in ("pandas", "matplotlib"):
        pytest.importorskip(package)
    page = Path(errors_page.__file__).parents[1] / "docs" / "errors.md"
    assert page.read_text(encoding="utf-8") == errors_page.page(), "renew it: python -m tests.errors_page"


@pytest.mark.parametrize(
    "value",
    [[-1, 0], (-1.0, 0.0), np.array([-1, 0], dtype=np.int8), np.array([-1.0, 0.0], dtype=np.float32), [2**70, 0]],
)
def test_all_sorts_of_numbers_are_numbers(value):
    assert check_real("q0", value).dtype == np.float64


def test_columns_of_pandas_are_numbers():
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame({"q": [-1, 0], "v": [0.0, 0.0]})
    assert solve(q0=frame["q"], v0=frame["v"], t_span=(0.0, 0.1)).success
    with pytest.raises(TypeError, match="q0 must be an array of real numbers"):
        solve(q0=pandas.Series(["-1", "0"]))


def test_an_unknown_method_lists_the_known():
    with pytest.raises(ValueError, match=r"method must be one of.*given 'RK45'") as caught:
        solve(method="RK45")
    assert all(name in str(caught.value) for name in PRESETS)


def test_a_tolerance_is_one_number_or_one_for_each_coordinate():
    assert (check_tolerance("atol", 1e-8, 3) == 1e-8).all()
    assert (check_tolerance("atol", [1e-8, 1e-6], 2) == [1e-8, 1e-6]).all()
    for value in ([1e-8], [1e-8, 0.0], [1e-8, np.nan], [1e-8, True], "small", True):
        with pytest.raises((TypeError, ValueError), match="atol must be"):
            check_tolerance("atol", value, 2)


@pytest.mark.parametrize(
    "mass", [np.diag([1.0, -2.0]), np.diag([0.0, -1.0]), np.zeros((2, 2)), lambda t, q: np.diag([1.0, -2.0])]
)
def test_a_mass_that_is_not_positive_definite(mass):
    system = pendulum(mass=mass)
    refuses(ValueError, "mass of 'pendulum' must be positive definite on the velocities .* next to no inertia", system)


def test_a_callback_whose_shape_changes_later_names_the_time():
    system = pendulum(force=lambda t, q, v: np.zeros(2 if t < 0.5 else 3))
    refuses(ValueError, r"force of system 'pendulum'.*t = 0\.[5-9].*shape \(3,\)", system)


class OwnError(Exception):
    pass


@pytest.mark.parametrize("kind", ["mass", "force", "constraint", "jacobian", "gamma", "constraint_rate"])
def test_an_exception_of_a_callback_comes_through_with_its_time(kind):
    good, error = getattr(pendulum(), kind), ZeroDivisionError if kind == "force" else OwnError

    def fails(t, *arguments):
        if t > 0.5:
            raise error("out of order")
        return good(t, *arguments)

    system = pendulum(**{kind: fails})
    words = rf"(?s)out of order.*raised by {kind} of system 'pendulum' at t = 0\.[5-9]"
    with pytest.raises(error, match=words) as caught:
        solve(system)
    assert type(caught.value) is error and str(caught.value) == "out of order"  # unchanged; the time stands in a note
    assert solve(t_span=(0.0, 0.1)).success  # the next run is not disturbed


def test_an_exception_at_the_start_has_its_time_too():
    def fails(t, q, v):
        raise OwnError("never")

    refuses(OwnError, r"(?s)never.*force of system 'pendulum' at t = 0", pendulum(force=fails))


def test_a_message_on_many_entries_is_short():
    with pytest.raises(ValueError, match=r"t_eval must be finite; entries \[0, 1, .*: given \[nan, nan") as error:
        solve(pendulum(), t_eval=np.full(100_000, np.nan))
    assert len(str(error.value)) < 400


def test_a_fixed_step_into_values_that_are_not_finite():
    system = pendulum(force=lambda t, q, v: np.array([0.0, -9.81 if t < 0.5 else np.nan]))
    result = solve(system, step_size=0.01)
    assert result.status == Status.NOT_FINITE and result.t[-1] == pytest.approx(0.49, abs=0.0101)


def test_a_mass_that_loses_definiteness_ends_the_run():
    result = solve(pendulum(mass=lambda t, q: np.eye(2) * (1.0 if t < 0.5 else -1.0)))
    assert not result.success and 0.3 < result.t[-1] < 0.5
    assert "the mass matrix was not positive definite" in result.message


def test_step_size_underflow_says_where_and_what_to_try():
    def noise(t, q, v):
        return np.array([0.0, -9.81 if t < 0.5 else 1e20 * np.sin(1e15 * (t + q[0]))])

    result = solve(pendulum(force=noise), method="SunRadau5")
    assert result.status == Status.STEP_TOO_SMALL and not result.success and 0.4 < result.t[-1] < 0.51
    assert f"t = {result.t[-1]:.10g}" in result.message and "loosen rtol" in result.message
    assert result.t.size == result.stats.n_accepted + 1 and result.stats.n_rejected_convergence > 10


@pytest.mark.parametrize(
    ("kind", "function"),
    [pytest.param("jacobian", lambda t, q: q, marks=pytest.mark.slow), ("force", lambda t, q, v: np.zeros(3))],
    ids=["jacobian", "force"],
)
def test_compiled_functions_of_the_wrong_shape(kind, function):
    system = pendulum(compile=True, gamma=False, **{kind: function})
    refuses(ValueError, rf"{kind} of system 'pendulum' must return an array of shape .*it returned shape", system)
