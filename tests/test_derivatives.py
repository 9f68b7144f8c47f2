"""What a system says about itself is checked at the start: wrong derivatives do not run."""

import numpy as np
import pytest

from tests.problems import moving_pivot, moving_pivot_state, pendulum
from twoloop import ConstrainedSystem, callback, solve_dae

START = ([-1.0, 0.0], [0.0, 0.0])


def refused(system, words, q0=START[0], v0=START[1]):
    with pytest.raises(ValueError, match=words):
        solve_dae(system, (0.0, 0.1), q0, v0)


@pytest.mark.parametrize(
    "jacobian",
    [
        lambda t, q: 2.0 * q[None, :],
        lambda t, q: -q[None, :],
        lambda t, q: q[None, ::-1],
        lambda t, q: q[None, :] + 0.01,
    ],
    ids=["twice", "sign", "swapped", "off by a per cent"],
)
def test_a_wrong_jacobian_is_named_with_its_entry(jacobian):
    refused(
        pendulum(jacobian=jacobian, gamma=False), r"jacobian of 'pendulum' is not.*entry \(0, \d\) is.*by differences"
    )


@pytest.mark.parametrize(
    "gamma", [lambda t, q, v: np.array([v @ v]), lambda t, q, v: np.zeros(1)], ids=["sign", "zero"]
)
def test_a_wrong_gamma_is_named_even_at_rest(gamma):
    refused(pendulum(gamma=gamma), r"gamma of 'pendulum' is not.*entry 0 is .*by differences")


def test_a_forgotten_constraint_rate_is_named():
    right = moving_pivot()
    system = ConstrainedSystem.from_python(
        n_q=2,
        n_c=1,
        mass=np.eye(2),
        force=lambda t, q, v: right.force(t, q, v),
        constraint=lambda t, q: right.constraint(t, q),
        jacobian=lambda t, q: right.jacobian(t, q),
        name="forgotten",
    )
    q, v = moving_pivot_state(0.0)
    refused(
        system, "constraint_rate of 'forgotten' is not.*or give constraint_rate: the constraints depend on time", q, v
    )


def test_right_derivatives_pass_at_any_scale():
    for scale in (1e-4, 1.0, 1e4):
        system = ConstrainedSystem.from_python(
            n_q=2,
            n_c=1,
            mass=np.eye(2),
            force=lambda t, q, v: np.array([0.0, -9.81]),
            constraint=lambda t, q, s=scale: np.array([0.5 * (q @ q - s * s)]),
            jacobian=lambda t, q: q[None, :],
            gamma=lambda t, q, v: np.array([-(v @ v)]),
        )
        assert solve_dae(system, (0.0, 1e-3), [scale, 0.0], [0.0, 0.0]).success


def test_a_mass_that_is_not_constant_is_found():
    @callback("mass")
    def mass(t, q, p, M):
        M[0, 0] = 1.0 + q[0] ** 2
        M[1, 1] = 1.0

    @callback("force")
    def force(t, q, v, p, Q):
        Q[1] = -1.0

    @callback("constraint")
    def constraint(t, q, p, C):
        C[0] = q[0] - q[1]

    @callback("jacobian")
    def jacobian(t, q, p, Cq):
        Cq[0, 0] = 1.0
        Cq[0, 1] = -1.0

    parts = {"force": force, "constraint": constraint, "jacobian": jacobian}
    system = ConstrainedSystem(n_q=2, n_c=1, mass=mass, constant_mass=True, **parts)
    with pytest.raises(ValueError, match="said to be constant"):
        solve_dae(system, (0.0, 0.1), [1.0, 1.0], [0.0, 0.0])
    assert solve_dae(ConstrainedSystem(n_q=2, n_c=1, mass=mass, **parts), (0.0, 0.1), [1.0, 1.0], [0.0, 0.0]).success


def test_an_index_out_of_bounds_is_an_error_not_a_crash():
    @callback("force")
    def force(t, q, v, p, Q):
        Q[1] = -p[0]

    given = pendulum(compile=True).functions
    system = ConstrainedSystem(
        n_q=2, n_c=1, mass=given.mass, force=force, constraint=given.constraint, jacobian=given.jacobian, name="short"
    )
    with pytest.raises(ValueError, match=r"force of 'short' goes out of bounds.*p has 0"):
        solve_dae(system, (0.0, 0.1), *START)


def test_a_function_that_changes_its_arguments_is_refused_when_compiled():
    def force(t, q, v):
        v[0] += 1.0
        return np.array([0.0, -9.81])

    refused(pendulum(compile=True, force=force), "force of 'pendulum' must not change the arrays")


def test_arguments_in_another_order_are_refused():
    with pytest.raises(TypeError, match=r"force is called as force\(t, q, v\); the function given takes \(t, v, q\)"):
        pendulum(force=lambda t, v, q: np.zeros(2))


def test_a_bandwidth_is_checked_without_constraints_too():
    parts = {"n_q": 2, "n_c": 0, "mass": np.eye(2), "name": "free"}
    coupled = ConstrainedSystem.from_python(**parts, force=lambda t, q, v: -q[::-1], bandwidth=0)
    with pytest.raises(ValueError, match="bandwidth of 'free' must be at least 1"):
        solve_dae(coupled, (0.0, 0.1), *START)
    apart = ConstrainedSystem.from_python(**parts, force=lambda t, q, v: -q, bandwidth=0)
    assert solve_dae(apart, (0.0, 0.1), *START).success
