"""C_q and gamma that are not given come exactly from what the other callbacks were traced to."""

import numpy as np
import pytest

from tests import problems
from tests.problems import kept, worst
from twoloop import ConstrainedSystem, consistent_state, mechanisms, solve_dae
from twoloop.generate import derived
from twoloop.generate.derived import standing_for
from twoloop.generate.programs import program_of
from twoloop.generate.traced_values import unchecked
from twoloop.kernels.data.codes import DONE
from twoloop.kernels.data.common import KIT, VECTOR, WORK, f8, i8
from twoloop.kernels.evaluation.accelerations import acceleration_constraint
from twoloop.kernels.evaluation.constraints import constraint_rows
from twoloop.run.workspace import kit_of, workspace

SPEED = 4000.0  # rad/s


def bar(speed=SPEED, length=1.0, **more):
    """A bar about a pin, [x, y, angle] of its centre, that a drive turns at a speed."""
    functions = {
        "constraint": lambda t, q: np.array(
            [q[0] - length * np.cos(q[2]), q[1] - length * np.sin(q[2]), q[2] - speed * t]
        ),
        "jacobian": lambda t, q: np.array(
            [[1.0, 0.0, length * np.sin(q[2])], [0.0, 1.0, -length * np.cos(q[2])], [0.0, 0.0, 1.0]]
        ),
        "constraint_rate": lambda t, q: np.array([0.0, 0.0, -speed]),
        "gamma": lambda t, q, v: -length * v[2] ** 2 * np.array([np.cos(q[2]), np.sin(q[2]), 0.0]),
    }
    functions |= more
    given = {kind: function for kind, function in functions.items() if function is not None}
    return ConstrainedSystem.from_python(
        n_q=3, n_c=3, mass=np.diag([1.0, 1.0, 1.0 / 3.0]), force=lambda t, q, v: np.array([0.0, -9.81, 0.0]), **given
    )


def pendulum(**more):
    return problems.pendulum(constant_mass=True, **more)


@kept(i8(KIT, WORK, f8, VECTOR, VECTOR))
def rows_and_gamma(f, w, t, q, v):
    w.G[:, :] = 0.0
    constraint_rows(f, w, t, q, w.G)
    return acceleration_constraint(f, w, t, q, v)


def in_kernels(system, t, q, v):
    """C_q and Gamma as used in an evaluation."""
    system, traced = standing_for(system, unchecked)
    kit = kit_of(system, t, q)
    work = workspace(system, kit, np.ones((system.n_c + system.n_a, system.n_q)), q, 1e-8, 0.0)
    assert rows_and_gamma(kit, work, t, q, v) == DONE
    return work.G[:-1].copy(), work.Gamma.copy(), traced


READY = sorted({name for name in mechanisms.__all__ if name[0].islower()} - {"ancf_beam", "n_four_bar"})


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if name == "governor" else ()) for name in READY]
)
def test_of_every_ready_mechanism_they_are_those_of_its_formulas(name):
    problem = getattr(mechanisms, name)()
    system, v = problem.system, problem.v0 + np.linspace(0.5, 1.5, problem.system.n_q)
    left_out = {"gamma", "nonholonomic_gamma", "kinematics", *(["jacobian"] if system.n_q < 30 else [])}
    given = {kind: function for kind, function in system.given.items() if kind not in left_out}
    sizes = {size: getattr(system, size) for size in ("n_q", "n_c", "n_a", "constant_mass", "parameters")}
    rows, gamma, traced = in_kernels(ConstrainedSystem(**sizes, **given), 0.3, problem.q0, v)
    assert traced
    if system.n_c:
        assert worst(rows[: system.n_c], system.jacobian(0.3, problem.q0)) < 1e-13 * max(1.0, np.abs(rows).max())
    kinds = [kind for kind, n in (("gamma", system.n_c), ("nonholonomic_gamma", system.n_a)) if n]
    known = np.concatenate([system.evaluate(kind, 0.3, problem.q0, v) for kind in kinds])
    assert worst(gamma, known) < 1e-12 * max(1.0, np.abs(known).max())


def test_a_driven_rate_that_depends_on_position_and_time():
    def rate(t, q):
        return np.array([np.sin(2.0 * t) * q[0]])

    def constraint(t, q):
        return np.array([0.5 * (q @ q - 1.0) + 0.5 * (1.0 - np.cos(2.0 * t)) * q[0]])

    def jacobian(t, q):
        return np.array([[q[0] + 0.5 * (1.0 - np.cos(2.0 * t)), q[1]]])

    q, v, t = np.array([0.6, -0.8]), np.array([1.0, 2.0]), 0.7
    system = pendulum(constraint=constraint, jacobian=jacobian, constraint_rate=rate, gamma=None)
    _, gamma, _ = in_kernels(system, t, q, v)
    known = -(v @ v + 2.0 * np.sin(2.0 * t) * v[0] + 2.0 * np.cos(2.0 * t) * q[0])
    assert gamma[0] == pytest.approx(known, rel=1e-12)


def test_a_fast_bar_is_as_right_without_gamma_as_with():
    """Differences along the motion err where 2e-8 s are an angle: by two hundred times as much."""
    errors = []
    for system in (bar(), bar(gamma=None)):
        q0, v0 = consistent_state(system, 0.0, [1.0, 0.0, 0.0], [0.0, SPEED, SPEED])
        q = solve_dae(system, (0.0, 0.01), q0, v0, rtol=1e-8, atol=1e-8).q[:, -1]
        errors.append(np.abs(q[:2] - [np.cos(0.01 * SPEED), np.sin(0.01 * SPEED)]).max())
    assert errors[1] <= 1.01 * errors[0] + 1e-12


@pytest.mark.parametrize(
    ("method", "compiled"),
    [("auto", "auto"), ("auto", True), ("RadauIIA5", "auto"), ("PaperIRK", "auto"), ("Taylor", "auto")],
)
def test_a_motion_without_them_is_the_motion_with_them(method, compiled):
    ends = []
    for absent in ((), ("gamma",), ("jacobian", "gamma")):
        system = pendulum(**dict.fromkeys(absent))
        run = solve_dae(system, (0.0, 1.0), [0.6, -0.8], [0.8, 0.6], method, 1e-9, 1e-9, compiled=compiled)
        ends.append(run.q[:, -1])
    assert np.ptp(ends, axis=0).max() < 1e-12


def test_what_branches_is_differenced():
    system = pendulum(jacobian=lambda t, q: q[None, :] if q[0] > -2.0 else 2.0 * q[None, :], gamma=None)
    other, traced = standing_for(system, unchecked)
    assert other is system and traced == () and solve_dae(system, (0.0, 1.0), [0.6, -0.8], [0.8, 0.6]).success


def driven_along_a_rail(parameters=(9.81, 0.2)):
    """A pendulum on a pivot that moves, with a mass that varies; without derivatives of the constraint."""
    return ConstrainedSystem.from_python(
        n_q=2,
        n_c=1,
        mass=lambda t, q, p: np.array([[1.0 + 0.1 * q[0] ** 2, 0.0], [0.0, 1.0]]),
        force=lambda t, q, v, p: np.array([np.sin(t), -p[0]]),
        constraint=lambda t, q, p: np.array([0.5 * ((q[0] - p[1] * np.sin(3.0 * t)) ** 2 + q[1] ** 2 - 1.0)]),
        constraint_rate=lambda t, q, p: np.array([-3.0 * p[1] * np.cos(3.0 * t) * (q[0] - p[1] * np.sin(3.0 * t))]),
        parameters=parameters,
        compile=True,
    )


@pytest.mark.parametrize("compiled", [False, "auto", True])
@pytest.mark.parametrize("method", ["auto", "Taylor"])
def test_a_series_follows_where_a_derivative_is_a_sum(method, compiled):
    system = driven_along_a_rail()
    start = consistent_state(system, 0.0, [0.3, -0.95], [0.4, 0.1])
    implicit = solve_dae(system, (0.0, 2.0), *start, method="RadauIIA9", rtol=1e-11, atol=1e-11)
    result = solve_dae(system, (0.0, 2.0), *start, method=method, compiled=compiled)
    assert result.success and worst(result.q[:, -1], implicit.q[:, -1]) < 1e-6


def switched_on(rapidity):
    """A slider that a smoothed step moves by 1 m in about 1 / rapidity, with a bar of 1 m that hangs from it."""
    return problems.driven_cart(
        lambda t: 0.5 * (1.0 + np.tanh(rapidity * (t - 0.5))),
        lambda t: 0.5 * rapidity * (1.0 - np.tanh(rapidity * (t - 0.5)) ** 2),
    )


def test_where_a_derivative_overflows_differences_take_its_place():
    """That of tanh(x) is made of exp(2 x), which is infinite from x = 355 on."""
    system = switched_on(2000.0)
    q0, v0 = consistent_state(system, 0.0, [0.0, 0.3, -0.95], [0.0, 0.0, 0.0])
    rows, gamma, traced = in_kernels(system, 0.0, q0, v0)
    assert traced and np.allclose(rows, [[1.0, 0.0, 0.0], [-q0[1], q0[1], q0[2]]], atol=1e-7)
    assert np.allclose(gamma, 0.0, atol=1e-7)
    result = solve_dae(system, (0.0, 1.0), q0, v0, rtol=1e-6, atol=1e-6)
    assert result.success and result.q[0, -1] == pytest.approx(1.0, abs=1e-6)


def test_where_there_is_no_second_derivative_a_motion_goes_on():
    """The curve y = |x|**1.5 has an infinite curvature at the start."""
    system = pendulum(constraint=lambda t, q: np.array([q[1] - (q[0] * q[0]) ** 0.75]), jacobian=None, gamma=None)
    assert solve_dae(system, (0.0, 0.1), [0.3, 0.3**1.5], [0.0, 0.0]).success
    _, gamma, _ = in_kernels(system, 0.0, np.zeros(2), np.zeros(2))
    assert np.isfinite(gamma).all()


def test_products_may_be_a_thousand_deep():
    def constraint(t, q):
        x = q[0]
        for _ in range(1000):
            x = x * np.cos(0.001 * q[1])
        return np.array([x + q[1]])

    system = pendulum(constraint=constraint, jacobian=None, gamma=None)
    rows, gamma, traced = in_kernels(system, 0.0, np.array([1.0, 0.0]), np.array([0.0, 1.0]))
    assert traced and np.allclose(rows, [[1.0, 1.0]], rtol=1e-12) and gamma[0] == pytest.approx(1000.0 * 1e-6, rel=1e-9)


BEAD = {  # on a circle of radius p[1]
    "n_q": 2,
    "n_c": 1,
    "mass": np.eye(2),
    "force": lambda t, q, v, p: np.array([0.0, -p[0]]),
    "constraint": lambda t, q, p: np.array([0.5 * (q[0] * q[0] + q[1] * q[1] - p[1] * p[1])]),
    "parameters": [9.81, 1.1],
    "compile": True,
}


def branches(t, q, v, p):
    return np.array([0.0, -p[0] if p[0] < 10.0 else 0.0])


@pytest.mark.parametrize("force", [BEAD["force"], branches], ids=["formulas", "a branch on a parameter"])
def test_systems_of_other_parameters_share_what_was_derived(force, monkeypatch):
    system = ConstrainedSystem.from_python(**BEAD | {"force": force})
    solve_dae(system, (0.0, 1.0), [1.1, 0.0], [0.0, 0.0])
    made = []
    monkeypatch.setattr(derived, "program_of", lambda *given: made.append(given) or program_of(*given))
    for gravity, radius in ((9.7, 1.2), (10.1, 1.3), (9.9, 1.4)):
        other = system.with_parameters([gravity, radius])
        whole = {"jacobian": lambda t, q: q[None, :], "gamma": lambda t, q, v: np.array([-(v @ v)])}
        given = {kind: BEAD[kind] for kind in ("n_q", "n_c", "mass")} | whole
        fall = -gravity if force is not branches or gravity < 10.0 else 0.0
        radial = {"constraint": lambda t, q, r=radius: np.array([0.5 * (q @ q - r * r)])}
        radial |= {"force": lambda t, q, v, fall=fall: np.array([0.0, fall])}
        expected = solve_dae(ConstrainedSystem.from_python(**given | radial), (0.0, 1.0), [radius, 0.0], [0.0, 0.0])
        result = solve_dae(other, (0.0, 1.0), [radius, 0.0], [0.0, 0.0])
        assert worst(result.q[:, -1], expected.q[:, -1]) < 1e-6
    assert not made or force is branches
