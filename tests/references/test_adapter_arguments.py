"""Test that adapters name wrong arguments, wrong options and callbacks out of bounds."""

import numpy as np
import pytest

from references.casadi.integrators import solve_collocation
from references.exudyn.mechanisms import solve_exudyn
from references.paper.gear import solve_gear
from references.scipy.fully_implicit import solve_fully_implicit
from references.scipy.index1 import solve_index1
from references.sundials.cvode_c import solve_cvode_c
from references.sundials.ida import solve_ida, solve_ida_c
from tests.references.adapters import ADAPTERS, start
from tests.test_bounds import FAR, NO_TANGENT, Q, V, beyond, system
from twoloop.mechanisms import four_bar

PROBLEM = four_bar()
BOUNDED = {f.__name__: lambda system, f=f: f(system, (0.0, 0.1), Q, V) for f in (solve_ida_c, solve_index1)}


@pytest.mark.parametrize("entry", BOUNDED)
@pytest.mark.parametrize("kind", ["mass", "force", "constraint", "jacobian", "gamma", "reaction_by_q"])
def test_every_adapter_watches_the_bounds_of_every_callback(entry, kind):
    tangents = NO_TANGENT if kind == "reaction_by_q" else {}
    with pytest.raises(ValueError, match=rf"{kind} of 'far' goes out of bounds: index {FAR}"):
        BOUNDED[entry](system(**tangents, **{kind: beyond(kind)}))


CHECKED = (
    "DOP853, index 1",
    "IDA from C, stabilised",
    "heyoka",
)  # one function checks what all are given, in three ways
WRONG = [
    ({"system": PROBLEM}, TypeError, r"given a Problem: give its system, problem\.system"),
    ({"system": "pendulum"}, TypeError, "system must be a ConstrainedSystem .*; given 'pendulum'"),
    ({"t_span": (1.0, 0.0)}, ValueError, "t_span must be"),
    ({"q0": np.zeros(3)}, ValueError, "q0 must have shape"),
    ({"v0": np.full(9, np.nan)}, ValueError, "v0 must be finite"),
    ({"q0": PROBLEM.q0 + 0.01}, ValueError, "q0 is not consistent"),
    ({"t_eval": [0.5, 0.4]}, ValueError, "t_eval must be strictly increasing"),
    ({"t_eval": [2.0]}, ValueError, "t_eval must lie within"),
    ({"time_limit": 0.0}, ValueError, "time_limit must be positive"),
    ({"time_limit": np.inf}, ValueError, "time_limit must be positive and finite"),
    ({"time_limit": "1 s"}, TypeError, "time_limit must be a number"),
]


@pytest.mark.parametrize(("changed", "error", "words"), WRONG)
@pytest.mark.parametrize("name", CHECKED)
def test_wrong_arguments_are_named(name, changed, error, words):
    given = {"system": PROBLEM.system, "t_span": (0.0, 1.0), "q0": PROBLEM.q0, "v0": PROBLEM.v0, **changed}
    at = [given.pop(key) for key in ("system", "t_span", "q0", "v0")]
    with pytest.raises(error, match=words):
        ADAPTERS[name](*at, **given)


@pytest.mark.parametrize(
    ("solve", "changed", "words"),
    [
        (solve_index1, {"method": ["DOP853"]}, r"method must be 'DOP853', .*'BDF' or 'Pr9'; given \['DOP853'\]"),
        (solve_index1, {"stabilisation": "glue"}, "stabilisation must be 'none', 'baumgarte' or 'projection'"),
        (solve_index1, {"stabilisation": "projection", "method": "LSODA"}, "one-step method, DOP853 or RK45"),
        (solve_index1, {"alpha": 5.0}, "alpha belongs to stabilisation='baumgarte'"),
        (solve_index1, {"stabilisation": "baumgarte", "alpha": -1.0}, "alpha must be positive"),
        (solve_ida, {"form": None}, "form must be 'index1' or 'stabilised'; given None"),
        (solve_ida_c, {"max_order": 6}, "max_order must be at most 5"),
        (solve_ida_c, {"max_order": 0}, "max_order must be at least 1"),
        (solve_ida_c, {"banded": True}, "banded=True needs a system with a bandwidth; 'four-bar' declares none"),
        (solve_ida_c, {"error_test": []}, r"error_test must be 'all', 'states' or 'positions'; given \[\]"),
        (solve_cvode_c, {"method": "adams"}, "method must be 'Adams' or 'BDF'; given 'adams'"),
        (solve_cvode_c, {"projected": True}, r"projected needs method 'BDF'.*; given 'Adams'"),
        (solve_fully_implicit, {"method": "Gauss"}, "method must be 'Radau', 'Radau9' or 'BDF'; given 'Gauss'"),
        (solve_collocation, {"n_steps": 0}, "n_steps must be at least 1"),
        (solve_gear, {"step": 0.0}, "step must be positive"),
        (solve_gear, {"step": 0.3}, "step must divide t_span, whose length is 1.0, into whole steps; given 0.3"),
        (solve_gear, {"step": 3.0}, "into whole steps; given 3.0"),
        (solve_gear, {"step": 0.01, "order": 0}, "order must be at least 1"),
        (solve_gear, {"step": 0.01, "order": 7}, "order must be at most 6"),
        (solve_gear, {"step": 0.01, "start": "push"}, "start must be 'ramp' or 'accurate'; given 'push'"),
        (solve_gear, {"step": 0.01, "t_eval": [0.015]}, "t_eval must hold multiples of step"),
    ],
)
def test_wrong_options_are_named(solve, changed, words):
    with pytest.raises((TypeError, ValueError), match=words):
        solve(*start(PROBLEM, 1.0), **changed)


def test_adapters_of_one_mechanism_name_wrong_arguments():
    for changed, error, words in (
        ({"problem": PROBLEM.system}, TypeError, "problem must be a "),
        ({"t_end": np.nan}, ValueError, "t_end must be positive"),
        ({"t_end": "1"}, TypeError, "t_end must be a number"),
        ({"n_steps": 10.0}, TypeError, "n_steps must be an int"),
        ({"store_every": 3}, ValueError, "multiple of store_every = 3"),
        ({"time_limit": -1.0}, ValueError, "time_limit must be positive"),
        ({"solver": "RK"}, ValueError, "solver must be 'GeneralizedAlpha', 'TrapezoidalIndex2' or 'HHT'"),
    ):
        with pytest.raises(error, match=words):
            solve_exudyn(**{"problem": PROBLEM, "t_end": 1.0, "n_steps": 10, **changed})


def test_a_missing_package_is_told(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "solve_dae.integrate", None)
    with pytest.raises(RuntimeError, match=r"solve_dae is not installed.*pip install 'twoloop\[peers\]'"):
        solve_fully_implicit(*start(PROBLEM, 1.0))
