"""What a model takes to write and to control: lines of the six-bar of the docs, and calls of a sampled controller."""

import re
import sys
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

from twoloop import Integrator, solve_dae
from twoloop.bodies import PlanarModel

PAGE = Path(__file__).parents[2] / "docs" / "bodies.md"


def test_a_six_bar_takes_twenty_lines_and_has_nine_digits():
    """The first block of the page, to the run; its motion by unlike methods, and by Newton's laws of each bar."""
    code = re.search(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)[1]
    lines = [line for line in code.splitlines() if line.strip() and not line.startswith("print")]
    assert len(lines) <= 20
    known = {}
    exec("\n".join(lines), known)
    problem, times = known["problem"], np.linspace(0.0, 5.0, 6)
    run = problem.system, problem.t_span, problem.q0, problem.v0
    ends = [solve_dae(*run, method, rtol=1e-11, atol=1e-11, t_eval=times) for method in ("DOP853", "RadauIIA9")]
    np.testing.assert_allclose(ends[0].q, ends[1].q, atol=1e-9 * np.abs(ends[0].q).max())
    result, bodies = ends[0], {body.name: body for body in known["model"].bodies}
    masses = {"crank": 0.5, "coupler": 2.0, "rocker": 1.0, "arm": 1.0, "post": 1.0}
    places = {name: result.q[list(body.coordinates[:2])] for name, body in bodies.items()}
    ends_of = {
        name: np.array([known[one], known[other]]) for name, one, other in (("rocker", "B", "C"), ("post", "E", "F"))
    }
    tips = {}
    for name, (one, other) in ends_of.items():
        turned = result.q[bodies[name].coordinates[2]] - problem.q0[bodies[name].coordinates[2]]
        c, s, (x, y) = np.cos(turned), np.sin(turned), 0.5 * (one - other)
        tips[name] = places[name] + np.array([c * x - s * y, s * x + c * y])
        fixed = 2.0 * places[name] - tips[name]  # the other end is on the ground
        np.testing.assert_allclose(fixed, np.broadcast_to(other[:, None], fixed.shape), atol=1e-9)
    apart = tips["post"] - tips["rocker"]
    length, rest = np.hypot(*apart), np.hypot(*(np.array(known["E"]) - known["B"]))
    weight = sum(m * 9.81 * places[name][1] for name, m in masses.items()) + 20.0 * (length - rest) ** 2
    moving = sum(
        0.5 * m * (result.v[list(bodies[name].coordinates[:2])] ** 2).sum(axis=0) for name, m in masses.items()
    )
    moments = {"coupler": 0.4}
    for name, (one, other) in {"crank": "OA", "rocker": "BC", "arm": "DE", "post": "EF"}.items():
        moments[name] = masses[name] * np.hypot(*(np.array(known[one]) - known[other])) ** 2 / 12.0
    moving = moving + sum(0.5 * J * result.v[bodies[name].coordinates[2]] ** 2 for name, J in moments.items())
    np.testing.assert_allclose(problem.energy(times, result.q, result.v), weight + moving, rtol=1e-11)


def test_a_controller_at_1_khz():
    """To 1e-12 of scipy's motion from sample to sample, in a bounded number of calls of Python functions."""
    mass, length, wanted = 1.3, 0.8, 0.3
    arm = PlanarModel(name="arm")
    link = arm.rod("link", (0.0, 0.0), (0.0, -length), mass=mass)
    arm.motor(arm.revolute("ground", link, at=(0.0, 0.0)), 0.0, name="servo")
    problem = arm.problem()
    servo, angle = problem.place("value of servo"), link.coordinates[2]
    start, J = problem.q0[angle], mass * length**2 / 3.0
    integrator = Integrator(problem.system, rtol=1e-10, atol=1e-10)
    sample, calls = integrator.start(0.0, problem.q0, problem.v0), [0]

    def count(frame, event, argument):
        calls[0] += event in ("call", "c_call")

    state = np.zeros(2)
    for k in range(300):
        torque = 40.0 * (wanted - sample.q[angle]) - 8.0 * sample.v[angle]
        sys.setprofile(count if k >= 10 else None)
        sample = integrator.step(1e-3, inputs={servo: torque})
        sys.setprofile(None)
        torque = 40.0 * (wanted - start - state[0]) - 8.0 * state[1]
        state = solve_ivp(
            lambda t, y, torque=torque: [y[1], (torque - mass * 9.81 * 0.5 * length * np.sin(y[0])) / J],
            (0.0, 1e-3),
            state,
            "DOP853",
            rtol=1e-12,
            atol=1e-14,
        ).y[:, -1]
    assert abs(sample.q[angle] - start - state[0]) < 1e-12 and abs(sample.v[angle] - state[1]) < 1e-10
    assert calls[0] / 290 <= 50  # 30 when written
