"""Test every mechanism to nine digits at a tolerance of 5e-11, against motions by other equations and SciPy."""

import numpy as np
import pytest

from tests.general.mechanisms import REDUNDANT, REGULAR, mechanism, relative_error, run
from tests.mechanisms.make_references import solution
from tests.problems import pendulum, worst
from twoloop import solve_dae
from twoloop.bodies import PlanarModel

METHODS = ("DOP853", "Gauss12", "Adams")
DIGITS = {"Adams": 1e-8}  # its errors are up to a hundred times the tolerance
# by default one method runs each mechanism, in turn; motions in space take seconds each
LONG = (
    "spatial slider-crank",
    "spatial four-bar",
    "A05 governor",
    "A04 Bricard",
    "closed chain of 4",
    "closed chain of 5",
    "SUNDIALS slider-crank",
)
CASES = [
    pytest.param(name, method, marks=[pytest.mark.slow] * (k % 3 != i or name in LONG))
    for k, name in enumerate(REGULAR)
    for i, method in enumerate(METHODS)
]


@pytest.mark.parametrize(("name", "method"), CASES)
def test_a_run_has_nine_digits_constraints_energy_multipliers_and_rank(name, method):
    m, (result, warned), digits = mechanism(name), run(name, method), DIGITS.get(method, 1e-9)
    system = m.system()
    assert result.success and result.t[-1] == m.end, result.message
    q, v = m.states(result.t)
    assert relative_error(result.q, q) < digits and relative_error(result.v, v) < 2.0 * digits
    for state in zip(result.t, result.q.T, result.v.T, strict=True):  # on redundant rows, too
        assert np.abs(system.constraint(*state[:2])).max(initial=0.0) < 1e-10
        assert np.abs(system.velocity_constraint(*state)).max(initial=0.0) < 1e-9 * max(1.0, np.abs(state[2]).max())
    if m.energy is not None:
        energies = np.array([m.energy(q, v) for q, v in zip(result.q.T, result.v.T, strict=True)])
        kinetic = 0.5 * max(v @ system.mass(t, q) @ v for t, q, v in zip(result.t, result.q.T, result.v.T, strict=True))
        assert np.ptp(energies) < 4e-9 * max(1.0, kinetic)
    # accelerations, and multipliers of least norm, [lam; mu], against the pseudoinverse of the whole matrix
    assert result.lam.shape == (system.n_c + system.n_a, result.t.size)
    a, lam = (np.array(each).T for each in zip(*(solution(system, t, *m.state(t)) for t in result.t), strict=True))
    assert relative_error(result.a, a) < 1e-7 and (result.lam.size == 0 or relative_error(result.lam, lam) < 1e-7)
    # rows that are not redundant are independent, and as many as the rank; the others are named once
    assert result.rank == m.rank and len(result.redundant) == len(result.lam) - m.rank
    kept = np.delete(system.rows(0.0, m.start[0]), result.redundant, axis=0)
    assert np.linalg.matrix_rank(kept, tol=1e-9) == m.rank == len(kept)
    assert len(warned) == (name in REDUNDANT) and all(str(row) in warned[0] for row in result.redundant)
    if name == "wobbling disc, redundant":  # the derivative of a row of positions does not replace that row
        assert list(result.redundant) == [3]


def swing(size, time, method, rtol):
    """Return q and v, in these units, of a damped pendulum of length `size` (m) that swings within `time` (s)."""
    weight = np.array([0.0, -9.81 * size / time**2])
    system = pendulum(
        gamma=False,
        force=lambda t, q, v: weight - 0.3 / time * v,
        constraint=lambda t, q: np.array([0.5 * (q[0] * q[0] + q[1] * q[1] - size * size)]),
    )
    times, start = np.linspace(0.0, 3.0 * time, 31), np.array([0.8 * size, -0.6 * size])
    atol = rtol * min(size, size / time)
    result = solve_dae(system, (0.0, times[-1]), start, np.zeros(2), method, rtol, atol, t_eval=times)
    assert result.success, result.message
    return np.concatenate([result.q / size, result.v / (size / time)])


@pytest.mark.parametrize("method", ["Lobatto16", "Gauss12", "RadauIIA5", "RadauIIA9", "TRBDF2", "ESDIRK4"])
@pytest.mark.parametrize(("size", "time"), [(1e-9, 1e3), (1e-6, 1e4), (1e6, 1e-3)])
def test_errors_in_tolerances_do_not_depend_on_units(method, size, time):
    rtol = 1e-11 if method in ("Lobatto16", "Gauss12", "RadauIIA9") else 1e-6
    assert worst(swing(size, time, method, rtol), swing(1.0, 1.0, "DOP853", 1e-12)) < 60.0 * rtol


def test_a_stiff_model_in_millimetres_takes_about_as_many_evaluations_as_in_metres():
    ends, counts = [], []
    for size in (1.0, 1e3):
        model = PlanarModel(gravity=(0.0, -9.81 * size))
        for k in range(2):
            model.rod(str(k), (k * size, 0.0), ((k + 1) * size, 0.0), mass=1.0)
            pin = model.revolute(str(k - 1) if k else "ground", str(k), at=(k * size, 0.0))
        model.torsion_spring(pin, stiffness=2e4 * size**2, damping=1e3 * size**2)
        p, units = model.problem((0.0, 1.0)), np.tile([size, size, 1.0], 2)
        options = {"rtol": 1e-8, "atol": 1e-8 * units, "compiled": False, "time_limit": 20.0}
        result = solve_dae(p.system, p.t_span, p.q0, p.v0, **options)
        assert result.success and "rank" not in result.message, result.message
        ends.append(result.q[:, -1] / units)
        counts.append(result.stats.n_evaluations)
    np.testing.assert_allclose(*ends, rtol=0.0, atol=1e-6)
    assert counts[1] < 3 * counts[0]


def test_points_in_millimetres_have_the_dependent_coordinates_of_metres():
    system = pendulum(
        n_q=4,
        n_c=2,
        gamma=False,
        mass=lambda t, q: np.eye(4),
        force=lambda t, q, v: np.array([0.0, -9810.0, 0.0, -9810.0]),
        constraint=lambda t, q: np.array([q[0] ** 2 + q[1] ** 2 - 1e6, (q[2] - q[0]) ** 2 + (q[3] - q[1]) ** 2 - 1e6]),
        jacobian=None,
    )
    result = solve_dae(system, (0.0, 1.0), [600.0, -800.0, 1200.0, -1600.0], np.zeros(4), "Gauss8", 1e-8, 1e-5)
    assert result.success and result.stats.n_partitions == 1
