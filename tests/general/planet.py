"""A planet: no row at all, so that the motion is an ordinary second-order equation. Closed form."""

import numpy as np

from tests.general.mechanism import Mechanism, of_functions


def planet(eccentricity=0.2):
    def state(t):
        E = t
        for _ in range(50):  # Kepler's equation, by Newton
            E -= (E - eccentricity * np.sin(E) - t) / (1.0 - eccentricity * np.cos(E))
        b, rate = np.sqrt(1.0 - eccentricity**2), 1.0 / (1.0 - eccentricity * np.cos(E))
        return np.array([np.cos(E) - eccentricity, b * np.sin(E)]), rate * np.array([-np.sin(E), b * np.cos(E)])

    return Mechanism(
        name="planet",
        system=of_functions(
            name="planet", n_q=2, n_c=0, mass=np.eye(2), force=lambda t, q, v: -q / (q[0] * q[0] + q[1] * q[1]) ** 1.5
        ),
        end=3.0,
        state=state,
        rank=0,
        energy=lambda q, v: 0.5 * v @ v - 1.0 / np.hypot(q[0], q[1]),
    )
