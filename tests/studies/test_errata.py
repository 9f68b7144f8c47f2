"""The misprints that reports/reproduction.md lists, by computation: the printed form fails, the corrected one holds."""

from pathlib import Path

import numpy as np
import pytest

from references.paper.four_bar_minimal import MinimalFourBar
from references.paper.paper_step import Step, true_states
from studies.reproduction.study import ERRATA
from twoloop.mechanisms import four_bar
from twoloop.methods.tableaux import sun_radau_iib

SUN = sun_radau_iib(3)
PHASES = 20  # instants of a period at which an equation is looked at


def test_every_line_names_a_test_that_is_there():
    here = Path(__file__).read_text()
    for entry in ERRATA:
        assert not entry["test"] or f"def {entry['test']}(" in here, entry["place"]


def test_reduction():
    """Equal y_{n+1} and other stages give another next y; equal stages and another y_{n+1} give the same."""
    problem = four_bar()
    t, q, v = true_states(problem, PHASES)[3]
    one, two, same = (Step(problem.system, SUN, t, 0.05, q, v) for _ in range(3))
    shift = 0.1 * np.array([[SUN.b[1]], [-SUN.b[0]], [0.0]])  # across b: sum b K stays as it is
    two.A_stage, two.V_stage = two.A_stage + shift, two.V_stage + shift
    same.q1, same.v1 = same.q1 + 0.1, same.v1 + 0.1
    for step in (one, two, same):
        step.iterate()
    assert np.abs(np.r_[one.q1 - two.q1, one.v1 - two.v1]).max() > 1e-6
    assert np.abs(np.r_[one.q1 - same.q1, one.v1 - same.v1]).max() < 1e-14


def test_dependents():
    """A pendulum on a moving pivot: y' depends on angle and time at equal x', and is g1(t, angle, x')."""

    def g1(t, angle, rate):  # y' where x = sin(3 t) / 2 + sin(angle), y = -cos(angle)
        return np.tan(angle) * (rate - 1.5 * np.cos(3.0 * t))

    t, d = 0.3, 1e-4
    path = [(0.5 * np.sin(3.0 * s) + np.sin(0.4 + 0.5 * s), -np.cos(0.4 + 0.5 * s)) for s in (t - d, t + d)]
    rate, y_rate = ((b - a) / (2.0 * d) for a, b in zip(*path, strict=True))
    assert g1(t, 0.4 + 0.5 * t, rate) == pytest.approx(y_rate, abs=1e-6)
    assert abs(g1(0.1, 0.9, 1.0) - g1(0.1, 0.4, 1.0)) > 0.1 and abs(g1(0.8, 0.4, 1.0) - g1(0.1, 0.4, 1.0)) > 0.1


def test_stopping_test():
    """The least change that a number of 1e8 can have is above 1e-9 as printed, and below as corrected."""
    size = 1e8
    change = float(np.spacing(size))
    assert change / max(change, 1.0) > 1e-9 > change / max(size, 1.0)
    assert all(abs(x / max(x, 1.0)) == abs(x) for x in (1e-10, 1e-3, -5.0))  # no scaling below 1


def test_closure():
    problem = four_bar()
    lengths = np.array([problem.parameters[name] for name in ("L1", "L2", "L3")])
    angles = np.array([q[2::3] for _, q, _ in true_states(problem, PHASES)]).T
    sine = lengths @ np.sin(angles)
    printed = sine + lengths[2] * (np.cos(angles[2]) - np.sin(angles[2]))
    assert np.abs(sine).max() < 1e-12 and np.abs(printed).max() > 0.1


def test_energy_at_y3_of_0():
    """The other assembly of the same linkage passes 0 with what bars 1 and 2 have lost since the start."""
    problem = four_bar(branch=1)
    truth = MinimalFourBar.from_parameters(problem.parameters)
    q, v = truth.states(np.linspace(0.0, truth.period, 4001))
    assert problem.energy is not None
    k = np.flatnonzero((q[7, 1:-1] < 0.0) & (q[7, 2:] >= 0.0))[0] + 1  # before it passes
    share = -q[7, k] / (q[7, k + 1] - q[7, k])
    kinetic = problem.energy(0.0, q, v) - problem.energy(0.0, q, 0.0 * v)
    lengths = np.array([problem.parameters[name] for name in ("L1", "L2")])
    lost = 9.81 * lengths @ (q[[1, 4], :1] - q[[1, 4]])
    at_0 = [x[k] + share * (x[k + 1] - x[k]) for x in (kinetic, lost)]
    assert q[7].max() > 0.1 and at_0[0] > 1.0 and at_0[0] == pytest.approx(at_0[1], rel=1e-3)
