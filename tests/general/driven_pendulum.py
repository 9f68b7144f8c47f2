"""A pendulum that hangs from the pin of a driven crank: a rheonomic row, and one degree of freedom.

Coordinates: x, y of the bob, angle of the crank. The inertia of the crank matters for the torque of its drive only.
"""

import numpy as np

from tests.general.mechanism import G, Mechanism, integrate

CRANK, ROD, SPEED = 0.3, 1.0, 2.5
START = (0.4, -1.0)  # angle of the rod from the downward vertical, and its rate


def constraint(t, q):
    x, y = q[0] - CRANK * np.cos(q[2]), q[1] - CRANK * np.sin(q[2])
    return np.array([q[2] - SPEED * t - 0.2 * np.sin(t), 0.5 * (x * x + y * y - ROD**2)])


def jacobian(t, q):
    x, y = q[0] - CRANK * np.cos(q[2]), q[1] - CRANK * np.sin(q[2])
    return np.array([[0.0, 0.0, 1.0], [x, y, CRANK * (x * np.sin(q[2]) - y * np.cos(q[2]))]])


def constraint_rate(t, q):
    return np.array([-SPEED - 0.2 * np.cos(t), 0.0])


def gamma(t, q, v):
    x, y = q[0] - CRANK * np.cos(q[2]), q[1] - CRANK * np.sin(q[2])
    u, w = v[0] + CRANK * np.sin(q[2]) * v[2], v[1] - CRANK * np.cos(q[2]) * v[2]
    inward = CRANK * v[2] ** 2 * (x * np.cos(q[2]) + y * np.sin(q[2]))
    return np.array([-0.2 * np.sin(t), -u * u - w * w - inward])


def _pin(t):
    """Angle of the crank; position, velocity and acceleration of its pin as complex numbers."""
    angle, rate, acceleration = SPEED * t + 0.2 * np.sin(t), SPEED + 0.2 * np.cos(t), -0.2 * np.sin(t)
    z = CRANK * np.exp(1j * angle)
    return angle, rate, z, 1j * rate * z, (1j * acceleration - rate**2) * z


def driven_pendulum():
    end = 3.0

    def rate(t, y):
        acceleration = _pin(t)[4]
        return [y[1], -((G + acceleration.imag) * np.sin(y[0]) + acceleration.real * np.cos(y[0])) / ROD]

    solution = integrate(rate, START, end)

    def state(t):
        (angle, speed), (crank, turn, z, u, _) = solution(t), _pin(t)
        rod = -1j * ROD * np.exp(1j * angle)
        x, w = z + rod, u + 1j * speed * rod
        return np.array([x.real, x.imag, crank]), np.array([w.real, w.imag, turn])

    return Mechanism(
        name="pendulum on a driven crank",
        sizes={"n_q": 3, "n_c": 2},
        functions={
            "mass": np.diag([1.0, 1.0, 0.1]),
            "force": lambda t, q, v: np.array([0.0, -G, 0.0]),
            "constraint": constraint,
            "jacobian": jacobian,
            "constraint_rate": constraint_rate,
            "gamma": gamma,
        },
        end=end,
        state=state,
        rank=2,
    )
