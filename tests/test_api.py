"""The public face: what problems and results have, defaults, names, help."""

import pydoc

import numpy as np
import pytest

import twoloop
from tests.problems import PLAIN, START, pendulum_state, worst
from twoloop import ConstrainedSystem, exported, mechanisms, solve_dae


@pytest.mark.parametrize("make", [mechanisms.four_bar, mechanisms.pendulum])
def test_what_a_problem_and_a_result_have(make):
    problem = make()
    result = solve_dae(problem.system, problem.t_span, problem.q0, problem.v0, rtol=1e-8, atol=1e-8)
    n_t = result.t.size
    assert result.q.shape == result.v.shape == result.a.shape == (problem.system.n_q, n_t)
    assert result.lam.shape == (problem.system.n_c, n_t) and result.success and result.status == 0 and result.message
    assert result.t[-1] == problem.t_span[1]
    counts = {name: value for name, value in vars(result.stats).items() if name.startswith("n_")}
    assert len(counts) > 7 and all(isinstance(value, int) for value in counts.values()) and result.stats.cpu_time > 0.0
    assert result.h.shape == (result.stats.n_accepted,) and result.sol is None and result.t_events is None
    assert isinstance(problem.name, str) and isinstance(problem.parameters, dict)
    assert worst(result.energy, result.energy[0]) < 1e-5


def test_arguments_that_are_left_out_are_as_documented():
    """With all of them given, a run is that of the few that are needed."""
    few = ConstrainedSystem.from_python(**PLAIN)
    more = {"constraint_rate": None, "gamma": None, "compile": False, "name": "system"}
    system = ConstrainedSystem.from_python(**PLAIN, **more)
    options = {"t_eval": None, "first_step": None, "max_step": np.inf, "max_steps": None, "dense_output": False}
    options |= {"method": "auto", "rtol": 1e-8, "atol": 1e-8, "events": None, "progress": None}
    result = solve_dae(system, (0.0, 2.0), *START, **options)
    assert (result.q == solve_dae(few, (0.0, 2.0), *START).q).all()
    assert worst(result.q[:, -1], pendulum_state(2.0)[0]) < 1e-6


def test_names_that_come_when_they_are_asked_for():
    assert set(twoloop.__all__) == {name for name in vars(exported) if name[0].isalpha()}
    assert set(twoloop.__all__) <= set(dir(twoloop))
    assert twoloop.mechanisms is mechanisms  # and so do folders
    with pytest.raises(AttributeError, match="module 'twoloop' has no attribute 'solve_ode'"):
        twoloop.solve_ode  # noqa: B018


def test_all_that_is_promised_can_be_imported():
    for name in twoloop.__all__:
        assert getattr(twoloop, name).__doc__, name


@pytest.mark.parametrize("name", twoloop.__all__)
def test_help_leaves_the_names_of_types_as_they_are(name):
    text = pydoc.render_doc(getattr(twoloop, name), renderer=pydoc.plaintext)
    assert "_array_like" not in text and "Union[" not in text
    if name == "solve_dae":
        signature = text.splitlines()[2]
        assert "q0: 'ArrayLike'" in signature and "t_eval: 'ArrayLike | None' = None" in signature
