"""The lines of reports/errata.md, by computation: the printed form fails, the corrected one holds."""

from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import DOP853, RK45

from references.paper.four_bar_minimal import MinimalFourBar
from references.paper.paper_step import Step, choice, independents, kkt, true_states
from studies.bench.render import render
from studies.claims.study import ERRATA
from twoloop.mechanisms import four_bar, very_flexible_beam
from twoloop.methods.tableaux import sun_radau_iib

SUN = sun_radau_iib(3)
PHASES = 20  # instants of a period at which an equation is looked at


def test_every_line_names_a_test_that_is_there():
    here = Path(__file__).read_text() + (Path(__file__).parents[1] / "test_tableaux.py").read_text()
    text = render("errata", ERRATA, {}, stamp="a stamp")
    for entry in (*ERRATA["errata"], *ERRATA["gaps"], *ERRATA["confirmed"]):
        assert not entry["test"] or f"def {entry['test']}(" in here, entry["place"]
        assert f"| {entry['place']} |" in text


def test_newmark_beta():
    """A step of q'' = -q from q = 0: the leading error is beta - 1/6 times h^3, with 1/2 four times that with 1/4."""
    h, errors = 0.01, []
    for beta in (0.5, 0.25):
        q = h / (1.0 + h * h * beta)  # the acceleration at the start is 0
        errors.append((np.sin(h) - q) / h**3)
        assert errors[-1] == pytest.approx(beta - 1.0 / 6.0, rel=1e-3)
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=1e-3)


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


def test_components():
    problem = four_bar()
    assert len(np.concatenate([problem.q0, problem.v0])) == 2 * problem.system.n_q != problem.system.n_q


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


def test_gamma():
    """Largest error of C'' = C_q q'' - Q_d along a path, for a pendulum whose pivot moves, by differences."""
    rate, worst, d = 3.0, 0.0, 1e-3

    def violation(t):
        return float((np.cos(t) + 0.3 * np.sin(2.0 * t) - 0.5 * np.sin(rate * t)) ** 2 + np.sin(1.3 * t) ** 2 - 1.0)

    for t in np.linspace(0.1, 2.0, 20):
        q = np.array([np.cos(t) + 0.3 * np.sin(2.0 * t), np.sin(1.3 * t)])
        v = np.array([-np.sin(t) + 0.6 * np.cos(2.0 * t), 1.3 * np.cos(1.3 * t)])
        a = np.array([-np.cos(t) - 1.2 * np.sin(2.0 * t), -1.69 * np.sin(1.3 * t)])
        X, dX, ddX = 0.5 * np.sin(rate * t), 0.5 * rate * np.cos(rate * t), -0.5 * rate**2 * np.sin(rate * t)
        C_q = np.array([2.0 * (q[0] - X), 2.0 * q[1]])
        Q_d = -(2.0 * v @ v - 4.0 * dX * v[0] + 2.0 * dX**2 - 2.0 * (q[0] - X) * ddX)
        values = [violation(t + k * d) for k in (-2, -1, 0, 1, 2)]
        second = (-values[0] + 16.0 * values[1] - 30.0 * values[2] + 16.0 * values[3] - values[4]) / (12.0 * d * d)
        worst = max(worst, abs(float(C_q @ a - Q_d) - second))
    assert worst < 1e-7


def test_formulas():
    """Relative difference of (7), (8) from the direct solution of (6)."""
    system, worst = four_bar().system, 0.0
    for t, q, v in true_states(four_bar(), PHASES):
        a, lam = kkt(system, t, q, v)
        C_q, M, Q, Q_d = system.jacobian(t, q), system.mass(t, q), system.force(t, q, v), system.gamma(t, q, v)
        lam_7 = np.linalg.solve(C_q @ np.linalg.solve(M, C_q.T), C_q @ np.linalg.solve(M, Q) - Q_d)
        a_8 = np.linalg.solve(M, Q) - np.linalg.solve(M, C_q.T @ lam_7)
        worst = max(worst, *(float(np.abs(x - y).max() / np.abs(y).max()) for x, y in ((lam_7, lam), (a_8, a))))
    assert worst < 1e-10


def test_rearranging():
    """Relative difference of (14), (15) from the solution with coordinates rearranged."""
    system, worst = four_bar().system, 0.0
    for t, q, v in true_states(four_bar(), PHASES):
        off = q + 1e-3 * np.sin(1.0 + np.arange(system.n_q))
        C, C_q = system.constraint(t, off), system.jacobian(t, off)
        i = independents(C_q)
        d = [k for k in range(system.n_q) if k not in i]
        matrix, direct = np.vstack([C_q, choice(system.n_q, i)]), np.zeros((2, system.n_q))
        direct[0, i], direct[0, d] = v[i], np.linalg.solve(C_q[:, d], -C_q[:, i] @ v[i])
        direct[1, d] = np.linalg.solve(C_q[:, d], -C)
        found = np.linalg.solve(matrix, np.column_stack([np.r_[np.zeros(len(d)), v[i]], np.r_[-C, np.zeros(len(i))]])).T
        worst = max(worst, float((np.abs(found - direct).max(axis=1) / np.abs(direct).max(axis=1)).max()))
    assert worst < 1e-10


def test_exponent():
    """On y' = cos y the difference of one step and two falls with h^6."""

    def step(y, h):
        K = np.full(3, np.cos(y))
        for _ in range(60):
            K = np.cos(y + h * SUN.A @ K)
        return float(y + h * SUN.b @ K)

    differences = [abs(step(0.3, h) - step(step(0.3, 0.5 * h), 0.5 * h)) for h in (0.4, 0.2)]
    assert np.log2(differences[0] / differences[1]) == pytest.approx(6.0, abs=0.3)


@pytest.mark.parametrize(
    ("A", "b"),
    [
        (np.zeros((1, 1)), np.ones(1)),
        (np.array([[0.0, 0.0], [0.5, 0.0]]), np.array([0.0, 1.0])),
        (RK45.A, RK45.B),
        (DOP853.A, DOP853.B),
    ],
)
def test_explicit_methods(A, b):
    """On the diagonal of b_i a_ij + b_j a_ji - b_i b_j stands -b_i^2, and the weights are not all zero."""
    square = np.zeros((b.size, b.size))
    square[: A.shape[0], : A.shape[1]] = A
    bA = b[:, None] * square
    assert np.diag(bA + bA.T - np.outer(b, b)).min() < -1e-3


def test_elastic_force():
    """Relative difference of the beam's force from the slope of its energy, at bent and stretched states."""
    problem, rng, worst, d = very_flexible_beam(), np.random.default_rng(1), 0.0, 1e-6
    rest = np.zeros_like(problem.q0)
    assert problem.energy is not None
    for _ in range(5):
        q = problem.q0 + 0.05 * rng.standard_normal(problem.q0.size)
        way = rng.standard_normal(q.size)
        ahead, behind = (problem.energy(0.0, q + sign * d * way, rest) for sign in (1.0, -1.0))
        force = problem.system.force(0.0, q, rest)
        worst = max(worst, abs((behind - ahead) / (2.0 * d) - force @ way) / float(np.abs(force * way).sum()))
    assert worst < 1e-6
