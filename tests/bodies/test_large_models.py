"""Models of many bodies: values of entries beside dense matrices, and a cost in proportion to the bodies."""

import numpy as np
import pytest

from tests.bodies.random_models import Both
from tests.bodies.test_laws import PLANAR, SPATIAL
from twoloop import solve_dae
from twoloop.bodies import PlanarModel, SpatialModel, assembly
from twoloop.mechanisms.planar import GROUND, PlanarBodies


def with_everything(planar):
    """A chain of every joint, drives, and in a plane rows that are functions."""
    both, hinges, n = Both(5, planar, n=24 if planar else 11), [], 24 if planar else 11
    kinds = PLANAR if planar else SPATIAL
    for k in range(n):
        made = getattr(both, kinds[k % len(kinds)])(k - 1 if k else None, k)
        if kinds[k % len(kinds)] in ("revolute", "prismatic"):
            hinges += [made[0]] if kinds[k % len(kinds)] == "revolute" else []
            if k % 8 < 2:
                both.drive(k - 1 if k else None, k, *made, lambda t: 0.3 * np.sin(t))
    if planar:
        both.model.gear(hinges[1], hinges[2], ratio=-1.5)
        both.model.skate("b3", at=both.x[3, :2], axis=(1.0, 0.3))
    return both.model


@pytest.mark.parametrize("planar", [True, False])
def test_values_of_entries_are_those_of_the_dense_matrices(planar):
    system = with_everything(planar).problem().system
    assert set(system.entries) == {"mass", "jacobian"}
    for seed in range(3):
        q = np.random.default_rng(seed).normal(size=system.n_q)
        for dense, values, n in (("mass", "mass_values", system.n_q), ("jacobian", "jacobian_values", system.n_c)):
            made = np.zeros((n, system.n_q))
            np.add.at(made, system.entries[dense], getattr(system, values)(0.3, q))
            np.testing.assert_array_equal(made, getattr(system, dense)(0.3, q))


def test_a_long_chain_costs_what_the_tables_of_the_library_cost():
    """A chain of 200 rods: as many entries as those of `PlanarBodies` but for zeros, and the same motion."""
    n, names = 200, [f"rod {k}" for k in range(200)]
    model, tables = PlanarModel(), PlanarBodies(names, np.full(n, 0.1), np.full(n, 1e-3 / 12.0))
    for k, name in enumerate(names):
        model.rod(name, (0.1 * k, 0.0), (0.1 * k + 0.1, 0.0), mass=0.1)
        model.revolute(names[k - 1] if k else "ground", name, at=(0.1 * k, 0.0))
        tables.pin(k - 1 if k else GROUND, (0.05 * (k > 0), 0.0), k, (-0.05, 0.0))
    problem, system = model.problem((0.0, 0.05)), tables.system("chain")
    runs = [solve_dae(each, (0.0, 0.05), problem.q0, problem.v0, rtol=1e-6) for each in (problem.system, system)]
    np.testing.assert_allclose(runs[0].q[:, -1], runs[1].q[:, -1], atol=1e-8)
    assert runs[0].stats.n_evaluations <= 1.1 * runs[1].stats.n_evaluations
    sizes = [each.n_mass_values + each.n_jacobian_values for each in (problem.system, system)]
    assert sizes[0] <= 1.5 * sizes[1]


def hinges_in_a_row(n, closed, size=1.0, tilt=0.3):
    """A chain of n rods in space, from 0.3 rad to -0.3 rad, its axes across the plane but for `tilt`."""
    m, at, before = SpatialModel(gravity=(0.0, -9.81 * size, 0.0)), np.zeros(3), None
    for k in range(n):
        angle = 0.3 - 0.6 * k / n + 0.2 * np.sin(k)
        c, s = np.cos(angle), np.sin(angle)
        along = size / n * np.array([c, s, 0.0])
        turned = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        rod = m.body(f"rod {k}", mass=1.0, inertia=(1e-3 * size**2,) * 3, position=at + along / 2, rotation=turned)
        axis = (tilt * np.cos(2.0 * k), tilt * np.sin(2.0 * k), 1.0)
        m.revolute(before or m.ground, rod, at=at, axis=axis, name=f"pin {k}")
        before, at = rod, at + along
    if closed:
        m.revolute(before, m.ground, at=at, axis=(0.0, 0.0, 1.0), name="last")
    return m


@pytest.mark.parametrize("size", [1.0, 1e3, 1e-3])
@pytest.mark.parametrize(("closed", "tilt", "degrees"), [(False, 0.3, 40), (True, 0.3, 35), (True, 0.0, 38)])
def test_degrees_of_freedom_by_entries_and_by_dense_matrices(monkeypatch, size, closed, tilt, degrees):
    """No full matrix of the rows is made."""
    model, asked = hinges_in_a_row(40, closed, size, tilt), []
    monkeypatch.setattr(assembly, "_scaled", lambda *of, scaled=assembly._scaled: asked.append(of) or scaled(*of))
    problem = model.problem()
    system, q = problem.system, problem.q0
    found = assembly.freedom(system, 0.0, q, {})
    assert found.degrees == degrees and not asked
    dependent = closed and tilt == 0.0  # three rows follow from others
    assert (np.linalg.matrix_rank(system.jacobian(0.0, q), 1e-9) < system.n_c) == dependent
