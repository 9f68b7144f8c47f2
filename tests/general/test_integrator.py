"""Test `Integrator`: its runs are those of solve_dae, and motions made sample by sample are right."""

import copy
import pickle
from importlib.util import find_spec

import numpy as np
import pytest

from tests import problems
from tests.bodies.runs import by_hand
from tests.marks import slow
from twoloop import Integrator, load, solve_dae
from twoloop.bodies import PlanarModel


@pytest.mark.parametrize("options", [{}, {"compiled": True}, {"method": "DOP853", "max_step": 0.01}])
def test_its_runs_are_those_of_solve_dae(default_four_bar, options):
    problem = default_four_bar
    integrator = Integrator(problem.system, rtol=1e-7, atol=1e-7, **options)
    random, given = np.random.default_rng(0), {"rtol": 1e-7, "atol": 1e-7, **options}
    for factor in (1.0, random.uniform(0.5, 2.0), 1.0):
        span = (0.0, 0.5 * factor)
        own = integrator.run(span, problem.q0, problem.v0, t_eval=[0.1, 0.2])
        known = solve_dae(problem.system, span, problem.q0, problem.v0, t_eval=[0.1, 0.2], **given)
        assert (own.q == known.q).all() and own.t.tolist() == [0.1, 0.2]


M, L, GRAVITY = 1.3, 0.8, 9.81
ABOUT_PIN = M * L * L / 3.0


def pendulum():
    """A rod with a motor in its pin: the problem, and the place of the torque."""
    model = PlanarModel()
    model.rod("rod", (0.0, 0.0), (0.0, -L), mass=M, angular_velocity=0.3)
    model.motor(model.revolute("ground", "rod", at=(0.0, 0.0)), 0.0, name="servo")
    problem = model.problem()
    return problem, problem.place("value of servo")


def known(dt, n, torque):
    """Angles and rates of the rod under a torque of its last sample, by SciPy."""
    y = np.array([-0.5 * np.pi, 0.3])
    states = [y]
    for k in range(n):
        u = torque(k, *y)
        y = by_hand(lambda t, a, w, u=u: (u - 0.5 * M * GRAVITY * L * np.cos(a)) / ABOUT_PIN, y, [dt])[:, -1]
        states.append(y)
    return np.array(states)


def controller(k, angle, rate):
    return 5.0 * (0.7 - angle) - 0.5 * rate


@pytest.mark.parametrize(("method", "error"), [("auto", 1e-10), slow("RadauIIA5", 1e-10), slow("Adams", 1e-9)])
def test_a_sampled_controller_of_a_pendulum(method, error, tmp_path):
    problem, servo = pendulum()
    integrator = Integrator(problem.system, method, rtol=1e-11, atol=1e-11)
    state = integrator.start(0.0, problem.q0, problem.v0)
    for k in range(40):
        state = integrator.step(0.02, inputs={servo: controller(k, state.q[2], state.v[2])})
    result = integrator.result()
    np.testing.assert_allclose(np.column_stack([result.q[2], result.v[2]]), known(0.02, 40, controller), atol=error)
    assert result.success and result.t[-1] == state.t == pytest.approx(0.8) and (result.q[:, -1] == state.q).all()
    assert np.abs(problem.system.constraint(0.0, state.q)).max() < 1e-14
    with pytest.raises(ValueError, match="parameters changed at samples"):
        result.certify()
    result.save(tmp_path / "run.npz")
    result.animate(tmp_path / "run.html")
    if find_spec("matplotlib"):  # an extra
        assert result.plot() is not None
    with pytest.raises(ValueError, match="parameters changed at samples"):
        load(tmp_path / "run.npz", problem.system).certify()
    assert (problem.system.parameters[servo] == 0.0).all()  # the system stays as it was


def test_samples_are_one_step_each_after_the_first_hundred():
    problem, servo = pendulum()
    integrator, counts = Integrator(problem.system), []
    integrator.start(0.0, problem.q0, problem.v0)
    for k in range(300):
        integrator.step(1e-3, inputs={servo: 0.1 * (k % 2)})
        counts.append(integrator.result().stats.n_accepted if k in (199, 299) else 0)
    assert counts[299] - counts[199] == 100 and counts[199] < 1000


@pytest.mark.parametrize("given", ["all", "derived", "closure"])
def test_plain_functions(given):
    torque = [0.0]

    def force(t, q, v, p):
        u = torque[0] if given == "closure" else p[1]
        return np.array([-u * q[1], u * q[0] - GRAVITY * p[0]])

    less = {"jacobian": None, "gamma": False} if given == "derived" else {}
    system = problems.pendulum(mass=lambda t, q, p: p[0] * np.eye(2), force=force, parameters=[2.0, 0.0], **less)
    integrator = Integrator(system, rtol=1e-10, atol=1e-10)
    state = integrator.start(0.0, [0.0, -1.0], [0.0, 0.0])
    y = np.zeros(2)
    for k in range(10):
        torque[0] = np.cos(0.7 * k)
        state = integrator.step(0.05, inputs=[2.0, torque[0]])
        y = by_hand(lambda t, a, w: 0.5 * torque[0] - 0.5 * GRAVITY * 2.0 * np.sin(a), y, [0.05])[:, -1]
    np.testing.assert_allclose(state.q, [np.sin(y[0]), -np.cos(y[0])], atol=1e-8)


def test_what_is_more_than_a_force_is_refused():
    problem, _ = pendulum()
    for name, kind in (("mass of rod", "mass"), ("x of revolute rod-ground on rod", "constraint")):
        integrator = Integrator(problem.system)
        integrator.start(0.0, problem.q0, problem.v0)
        with pytest.raises(ValueError, match=f"enters {kind} of"):
            integrator.step(1e-3, inputs={problem.place(name): 1.5})
        assert integrator.result().t.tolist() == [0.0]


def test_the_parameters_of_the_start_are_those_of_the_result():
    """Reactions and energy were those of the parameters of the system."""
    problem, _ = pendulum()
    other = problem.with_parameters({"x of revolute rod-ground on rod": -0.3, "gravity along y": -2.0})
    integrator = Integrator(problem.system)
    integrator.start(0.0, other.q0, other.v0, parameters=other.system.parameters)
    integrator.step(0.5)
    result = integrator.result()
    np.testing.assert_allclose(result.system.constraint(0.5, result.q[:, -1]), 0.0, atol=1e-12)
    assert result.description.energy is None
    with pytest.raises(ValueError, match="reactions need joints"):  # which may be elsewhere, as in a run
        result.reactions("revolute rod-ground")


@pytest.mark.parametrize("method", ["auto", slow("RadauIIA5"), slow("BDF")])
def test_after_a_step_that_failed_the_next_goes_on_from_the_last_sample(method):
    def force(t, q, v, p):
        push = p[0] if t < p[1] else np.nan
        return np.array([-push * q[1], push * q[0] - 9.81])

    system = problems.pendulum(force=force, parameters=[0.0, 9.0])
    integrator, straight = (Integrator(system, method) for _ in range(2))
    start = [np.sin(0.5), -np.cos(0.5)], [0.3 * np.cos(0.5), 0.3 * np.sin(0.5)]
    for each in (integrator, straight):
        each.start(0.0, *start)
        each.step(0.1)
    with pytest.raises(RuntimeError, match="not finite"):
        integrator.step(1.0, inputs={0: 5.0, 1: 0.7})
    with pytest.raises(RuntimeError):  # the inputs are the same
        integrator.step(1.0)
    state, other = integrator.step(0.2, inputs={0: 0.0, 1: 9.0}), straight.step(0.2)
    np.testing.assert_allclose(state.q, other.q, atol=1e-6)
    assert state.t == other.t == integrator.result().t[-1]
    assert integrator.result().h.sum() == pytest.approx(state.t)


def test_what_a_force_raises_leaves_the_last_sample():
    def force(t, q, v, p):
        if t > p[0]:
            raise OSError("no reading")
        return np.array([0.0, -9.81])

    integrator = Integrator(problems.pendulum(force=force, parameters=[0.3]))
    integrator.start(0.0, [1.0, 0.0], [0.0, 0.0])
    with pytest.raises(OSError, match="no reading"):
        integrator.step(0.5)
    state = integrator.step(0.5, inputs=[9.0])
    expected = solve_dae(problems.pendulum(), (0.0, 0.5), [1.0, 0.0], [0.0, 0.0]).q[:, -1]
    assert state.t == 0.5
    np.testing.assert_allclose(state.q, expected, atol=1e-7)


@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, lambda each: pickle.loads(pickle.dumps(each))])
def test_a_copy_has_no_motion(default_four_bar, copied):
    """Both stepped on in the same arrays, and the samples of one were in the result of the other."""
    problem = default_four_bar
    integrator = Integrator(problem.system, "DOP853", rtol=1e-7, atol=1e-7, max_step=0.01)
    integrator.start(0.0, problem.q0, problem.v0)
    integrator.step(0.1)
    other = copied(integrator)
    with pytest.raises(ValueError, match=r"call integrator\.start"):
        other.step(0.1)
    runs = [each.run((0.0, 0.2), problem.q0, problem.v0) for each in (integrator, other)]
    assert (runs[0].q == runs[1].q).all() and integrator.step(0.1).t == 0.2
