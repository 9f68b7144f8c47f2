"""Test mechanisms from energies against the same ones written by hand."""

import numpy as np
import pytest

from tests.symbolic.models import MODELS, symbolic_four_bar, symbolic_knife_edge
from twoloop import solve_dae


def in_python(mechanism, problem, kind, t, *state):
    """What generated code gives without numba."""
    out = problem.system.arrays_of(kind)
    mechanism.code.value(kind)(t, *state, np.array(list(mechanism.parameters.values())), *out)
    return out


@pytest.fixture(scope="module", params=list(MODELS))
def pair(request):
    return MODELS[request.param]()


def states(problem, count=5):
    """Random positions and velocities about the start, off the constraints."""
    generic = np.random.default_rng(3)
    for _ in range(count):
        yield generic.uniform(0.0, 2.0), *(generic.normal(at, 1.0) for at in (problem.q0, problem.v0))


def test_every_callback_is_that_of_the_hand_written_mechanism(pair):
    """The fused one, too, which there is where there are constraints."""
    problem, mechanism = pair
    system, hand = problem.system, set(problem.system.given) - {"kinematics"}
    assert hand <= set(mechanism.code.kinds) and ("kinematics" in mechanism.code.kinds) == (system.n_c > 0)
    for t, q, v in states(problem):
        pairs = []
        for kind in hand:
            state = (q, v) if kind in ("force", "gamma", "nonholonomic_gamma") else (q,)
            pairs.append((*in_python(mechanism, problem, kind, t, *state), system.evaluate(kind, t, *state)))
        if system.n_c > 0:
            known = system.constraint(t, q), system.jacobian(t, q), system.constraint_rate(t, q), system.gamma(t, q, v)
            pairs += zip(in_python(mechanism, problem, "kinematics", t, q, v), known, strict=True)
        for given, known in pairs:
            assert given == pytest.approx(known, rel=1e-13, abs=1e-13 * max(1.0, np.abs(known).max()))


@pytest.mark.parametrize("name", list(MODELS))
def test_tangents_are_the_derivatives(name):
    problem, mechanism = MODELS[name](tangents=True)
    n, small = problem.system.n_q, 1e-6
    if problem.system.n_a > 0:
        assert "force_by_q" not in mechanism.code.kinds  # Newton's method would not ask for it
        return
    t, q, v = next(states(problem))
    lam = np.linspace(1.0, 2.0, problem.system.n_c)

    def force(q, v):
        return in_python(mechanism, problem, "force", t, q, v)[0]

    def differences(function, x):
        steps = small * np.eye(n)
        return np.array([(function(x + step) - function(x - step)) / (2.0 * small) for step in steps]).T

    (K,) = in_python(mechanism, problem, "force_by_q", t, q, v)
    assert pytest.approx(differences(lambda x: force(x, v), q), rel=1e-6, abs=1e-6 * max(1.0, np.abs(K).max())) == K
    by_v = differences(lambda x: force(q, x), v)
    D = in_python(mechanism, problem, "force_by_v", t, q, v)[0] if "force_by_v" in mechanism.code.kinds else 0.0 * by_v
    assert pytest.approx(by_v, rel=1e-6, abs=1e-6 * max(1.0, np.abs(K).max())) == D
    if problem.system.n_c > 0:
        (R,) = in_python(mechanism, problem, "reaction_by_q", t, q, lam)
        reaction = differences(lambda x: lam @ in_python(mechanism, problem, "jacobian", t, x)[0], q)
        assert pytest.approx(reaction, rel=1e-6, abs=1e-6) == R


@pytest.mark.slow
def test_counts_are_those_of_the_hand_written_mechanism():
    for make in (symbolic_four_bar, symbolic_knife_edge):
        problem, mechanism = make()
        start = mechanism.problem(problem.q0, problem.v0, (0.0, 2.0))
        hand = solve_dae(problem.system, (0.0, 2.0), problem.q0, problem.v0)
        made = solve_dae(start.system, start.t_span, start.q0, start.v0)
        assert abs(made.stats.n_evaluations - hand.stats.n_evaluations) <= 0.01 * hand.stats.n_evaluations  # rounding
        assert made.stats.n_accepted == hand.stats.n_accepted
        assert np.abs(made.q[:, -1] - hand.q[:, -1]).max() < 1e-9  # the tolerance is 1e-8


def test_mass_that_is_constant_and_bandwidth_are_seen():
    known = {name: make()[1].code for name, make in MODELS.items()}
    constant = {name for name, code in known.items() if code.value("CONSTANT_MASS")}
    assert constant == set(MODELS) - {"rolling disc", "heavy top"}
    assert known["four-bar"].value("BANDWIDTH") == 0  # neither M nor the force nor a row couples coordinates
    assert known["slider-crank with spring and damper"].value("BANDWIDTH") == 2
    assert known["rolling disc"].value("BANDWIDTH") is None
