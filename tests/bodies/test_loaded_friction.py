"""Test friction that grows with the load of a joint, against Newton's and Euler's laws solved apart."""

from functools import cache

import numpy as np
import pytest

from tests.bodies.runs import by_hand
from tests.marks import slow
from twoloop import solve_dae
from twoloop.bodies import PlanarModel, SpatialModel

G = 9.81
RADIUS = 0.15  # of the pin, m
TIMES = np.linspace(0.0, 0.8, 5)


def cart(spatial, guide=0.2, pin=0.3, push=0.0):
    """A cart on a guide, and a rod that hangs from it; friction in both joints."""
    if spatial:
        model, z = SpatialModel((0.0, -G, 0.0)), (0.0, 0.0, 1.0)
        model.body("cart", mass=2.0, inertia=(0.1, 0.1, 0.1), position=(0, 0, 0), velocity=(1.0, 0, 0))
        model.body("rod", mass=1.0, inertia=(0.3, 0.2, 0.08), position=(0.3, -0.4, 0), angular_velocity=(0, 0, 2.0))
        rail = model.prismatic("ground", "cart", at=(0, 0, 0), axis=(1, 0, 0))
        hinge = model.revolute("cart", "rod", at=(0, 0, 0), axis=z)
    else:
        model = PlanarModel()
        model.body("cart", mass=2.0, inertia=0.1, position=(0.0, 0.0), velocity=(1.0, 0.0))
        model.body("rod", mass=1.0, inertia=0.08, position=(0.3, -0.4), angular_velocity=2.0)
        rail = model.prismatic("ground", "cart", at=(0.0, 0.0), axis=(1.0, 0.0))
        hinge = model.revolute("cart", "rod", at=(0.0, 0.0))
    model.friction(rail, push, speed=0.3, coefficient=guide)
    model.friction(hinge, speed=0.5, coefficient=pin, radius=RADIUS)
    return model, rail, hinge


@cache
def known(guide=0.2, pin=0.3, push=0.0):
    """x of the cart, the angle from below, and their rates; forces in the joints by iteration."""
    M, m, J, l = 2.0, 1.0, 0.08, 0.5

    def accelerations(x, a, u, w):
        s, c, rub, turn, before = np.sin(a), np.cos(a), 0.0, 0.0, np.inf
        while abs(abs(rub) + abs(turn) - before) > 1e-14:
            before = abs(rub) + abs(turn)
            # m (x'' + l (a'' c - w^2 s)) = X, m l (a'' s + w^2 c) = Y - m g, M x'' = -X + rub,
            # J a'' = -l s Y - l c X + turn
            A = np.array([[m, m * l * c, -1, 0], [0, m * l * s, 0, -1], [M, 0, 1, 0], [0, J, l * c, l * s]])
            _, _, X, Y = found = np.linalg.solve(A, [m * l * w**2 * s, -m * l * w**2 * c - m * G, rub, turn])
            rub = -(push + guide * abs(Y + M * G)) * np.tanh(u / 0.3)
            turn = -pin * RADIUS * np.hypot(X, Y) * np.tanh(w / 0.5)
        return found[:2]

    start = [0.0, np.arctan2(0.3, 0.4), 1.0, 2.0]
    return by_hand(lambda t, place, rate: accelerations(*place, *rate), start, TIMES)


@pytest.mark.parametrize("spatial", [False, slow(True)])
@pytest.mark.slow
def test_a_cart_with_a_pendulum(spatial):
    model, *_ = cart(spatial, push=0.4)
    problem = model.problem((0.0, TIMES[-1]))
    assert not problem.conserved and "forces in the joints" in problem.note
    if not spatial:
        problem.v0[:] = [1.0, 0.0, 0.0, 1.0 + 0.4 * 2.0, 0.3 * 2.0, 2.0]  # both as given, the hinge closed
    else:
        problem.v0[:3], problem.v0[7:10] = (1.0, 0.0, 0.0), (1.0 + 0.4 * 2.0, 0.3 * 2.0, 0.0)
    run = problem.system, problem.t_span, problem.q0, problem.v0, "DOP853"
    # machine code of the plane's law is made as that of space would be, which is four times as long
    result = solve_dae(*run, rtol=1e-10, atol=1e-10, t_eval=TIMES, compiled=False if spatial else "auto")
    assert result.success, result.message
    x, a, *_ = known(push=0.4)
    np.testing.assert_allclose(result.q[0], x, atol=1e-9)
    rod = result.q[7:9] if spatial else result.q[3:5]
    np.testing.assert_allclose(rod, [x + 0.5 * np.sin(a), -0.5 * np.cos(a)], atol=1e-9)
    assert (np.diff(problem.energy(result.t, result.q, result.v)) < 0.0).all()
