"""Many pendulums, each with parameters and a start of its own."""

import numpy as np

from tests.compiled import PENDULUM, circle_of_length, heavy
from tests.problems import pendulum
from twoloop import ConstrainedSystem, callback, solve_dae


@callback("force")
def weight_and_drag(t, q, v, p, Q):
    Q[0], Q[1] = -0.1 * v[0], -0.1 * v[1] - p[0] * p[2]


COMPILED = PENDULUM | {"mass": heavy, "force": weight_and_drag, "constraint": circle_of_length, "constant_mass": False}


def system_of(parameters, **functions):
    """A pendulum of mass p[0], length p[1] and gravity p[2], with a drag, or with other functions."""
    usual = {
        "mass": lambda t, q, p: p[0] * np.eye(2),
        "force": lambda t, q, v, p: np.array([-0.1 * v[0], -0.1 * v[1] - p[0] * p[2]]),
        "constraint": lambda t, q, p: np.array([0.5 * (q @ q - p[1] ** 2)]),
    }
    return pendulum(**{"gamma": False, "parameters": parameters[0], **usual, **functions})


def drawn(n_runs):
    """Starts at rest and parameters of pendulums, each of its own."""
    random = np.random.default_rng(4)
    parameters = np.column_stack([random.uniform(0.5, 2.0, n_runs), random.uniform(0.5, 1.5, n_runs)])
    parameters = np.column_stack([parameters, random.uniform(5.0, 12.0, n_runs)])
    angles = random.uniform(0.3, 2.0, n_runs)
    q = parameters[:, 1:2] * np.column_stack([np.sin(angles), -np.cos(angles)])
    return q, np.zeros_like(q), parameters


def pendulums(n_runs):
    q, v, parameters = drawn(n_runs)
    return ConstrainedSystem(**COMPILED, parameters=parameters[0]), q, v, parameters


def far_from_single_runs(runs, which, system, span, q, v, parameters, **options):
    """Largest difference of the positions at the end from those of DOP853, run by run."""
    options = {"method": "DOP853", "rtol": 1e-10, "atol": 1e-10, **options}
    known = [solve_dae(system.with_parameters(parameters[k]), span, q[k], v[k], **options).q[:, -1] for k in which]
    return np.abs(runs.q[which, :, -1] - known).max()
