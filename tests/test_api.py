"""The public face: what problems, results and statuses have, defaults, names, help."""

from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest

import twoloop
from tests.problems import PLAIN, START, pendulum_state, worst
from twoloop import ConstrainedSystem, Statistics, Status, mechanisms, solve_dae


def test_arguments_that_are_left_out_are_as_documented():
    few = ConstrainedSystem.from_python(**PLAIN)
    more = {"constraint_rate": None, "gamma": None, "compile": False, "name": "system"}
    system = ConstrainedSystem.from_python(**PLAIN, **more)
    options = {"t_eval": None, "first_step": None, "max_step": np.inf, "max_steps": None, "dense_output": False}
    options |= {"method": "auto", "rtol": 1e-8, "atol": 1e-8, "events": None, "progress": None}
    result = solve_dae(system, (0.0, 2.0), *START, **options)
    assert (result.q == solve_dae(few, (0.0, 2.0), *START).q).all()
    assert worst(result.q[:, -1], pendulum_state(2.0)[0]) < 1e-6


def test_names_that_come_when_they_are_asked_for():
    assert set(twoloop.__all__) == set(twoloop._PLACES)
    assert all(getattr(twoloop, name).__name__ == name for name in twoloop.__all__)
    assert set(twoloop.__all__) <= set(dir(twoloop))
    assert twoloop.mechanisms is mechanisms  # and so do folders
    with pytest.raises(AttributeError, match="module 'twoloop' has no attribute 'solve_ode'"):
        twoloop.solve_ode  # noqa: B018


def test_zero_is_the_end_one_an_event_and_what_is_negative_a_failure():
    assert Status.REACHED_END == 0 and Status.EVENT == 1 and len({int(status) for status in Status}) == len(Status)
    problem = mechanisms.pendulum()
    result = solve_dae(problem.system, (0.0, 0.1), problem.q0, problem.v0)
    for status in Status:
        assert (status < 0) == (status not in (Status.REACHED_END, Status.EVENT))
        assert replace(result, status=status).success == (status >= 0)
    with pytest.raises(FrozenInstanceError):
        result.status = Status.EVENT


def test_a_result_says_its_status_its_message_and_the_counts_that_are_known():
    problem = mechanisms.pendulum()
    result = solve_dae(problem.system, (0.0, 1.0), problem.q0, problem.v0, t_eval=[1.0])
    text = repr(replace(result, message="Said so.", stats=Statistics(n_accepted=1, n_evaluations=17)))
    assert "REACHED_END" in text and "Said so." in text and "n_evaluations=17" in text and "t[-1]=1" in text
    assert "n_inner" not in text and Statistics().n_inner is None  # not told
    assert "no output" in repr(replace(result, t=result.t[:0], q=result.q[:, :0]))
