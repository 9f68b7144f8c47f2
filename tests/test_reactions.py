"""Reactions against Newton's and Euler's laws, body by body, from accelerations and applied forces alone."""

import warnings
from itertools import pairwise

import numpy as np
import pytest

from tests.problems import held_twice
from twoloop import ConstraintWarning, Joint, mechanisms, solve_dae
from twoloop.bodies.rotation import G, rotation_matrix

DOWN = np.array([0.0, -9.81])


def run(problem, t_end):
    """A few states of a run."""
    with warnings.catch_warnings(action="ignore", category=ConstraintWarning):
        times = np.linspace(0.0, t_end, 6)
        result = solve_dae(problem.system, (0.0, t_end), problem.q0, problem.v0, "DOP853", t_eval=times)
    assert result.success
    return result


def sums(result, dimension):
    """Force and torque about the origin of space on each body, by the names of the joints, "kind body-other"."""
    forces, torques = {}, {}
    for joint in result.system.joints:
        reaction = result.reactions(joint.name)
        n_t = result.t.size
        assert reaction.force.shape == reaction.point.shape == (dimension, n_t)
        assert reaction.torque.shape == ((n_t,) if dimension == 2 else (3, n_t))
        torque = reaction.torque + moment(reaction.point, reaction.force)
        kind, _, bodies = joint.name.partition(" ")
        ends = [bodies.split(" of ")[1], "ground"] if kind == "drive" else bodies.split("-")
        for body, sign in zip(ends, (1.0, -1.0), strict=True):
            forces[body] = forces.get(body, 0.0) + sign * reaction.force
            torques[body] = torques.get(body, 0.0) + sign * torque
    return forces, torques


def moment(arm, force):
    """Of a force about the origin: a number, planar, or a vector."""
    return arm[0] * force[1] - arm[1] * force[0] if len(arm) == 2 else np.cross(arm, force, axis=0)


def close(actual, expected, scale):
    assert np.abs(actual - expected).max() < 1e-9 * max(1.0, np.abs(scale).max())


# --- planar bodies: x, y of the centre, angle
N_BAR = mechanisms.n_four_bar(3, "bodies")
PLANAR = {
    "redundant slider-crank": (mechanisms.redundant_slider_crank, ("crank", "rod", "slider"), 0.5),
    "driven slider-crank": (mechanisms.driven_slider_crank, ("crank", "rod", "slider"), 0.5),
    "driven crank": (mechanisms.driven_crank, ("crank", "rod"), 0.5),
    "N-four-bar": (lambda: N_BAR, [name.removeprefix("x (m) of ") for name in N_BAR.coordinates[::3]], 0.2),
}


def check_planar(result, names, masses, inertias, forces, torques):
    for body, name in enumerate(names):
        centre, acceleration = (array[3 * body : 3 * body + 2] for array in (result.q, result.a))
        inertial = masses[body] * (acceleration - DOWN[:, None])
        close(forces[name], inertial, inertial)
        spun = inertias[body] * result.a[3 * body + 2] + moment(centre, inertial)
        close(torques[name], spun, np.abs(inertial))


@pytest.mark.parametrize("name", PLANAR)
def test_planar_bodies(name):
    make, names, t_end = PLANAR[name]
    problem = make()
    result = run(problem, t_end)
    mass = problem.system.mass(0.0, problem.q0).diagonal()
    check_planar(result, names, mass[::3], mass[2::3], *sums(result, 2))


def test_pins_of_the_four_bar():
    """Each is at the end of a bar, and the beginning of the next, and carries no torque."""
    problem = mechanisms.four_bar()
    result = run(problem, 1.0)
    lengths = np.array([problem.parameters[name] for name in ("L1", "L2", "L3")])
    pins = [result.reactions(name) for name in ("O", "1-2", "2-3", "A")]
    forces, torques = {}, {}
    for bar, (before, after) in enumerate(pairwise(pins)):
        last = 1.0 if bar == 2 else -1.0  # that of the ground acts on the bar
        forces[bar] = before.force + last * after.force
        torques[bar] = moment(before.point, before.force) + last * moment(after.point, after.force)
    check_planar(result, range(3), lengths, lengths**3 / 12.0, forces, torques)
    assert all(np.abs(pin.torque).max() < 1e-10 * np.abs(pin.force).max() and pin.unique for pin in pins)


def test_knife_edge():
    problem = mechanisms.knife_edge()
    result = run(problem, 2.0)
    blade = result.reactions("blade")
    m, slope = problem.parameters["mass"], problem.parameters["slope"]
    inertial = m * (result.a[:2] - np.array([[9.81 * np.sin(slope)], [0.0]]))
    close(blade.force, inertial, inertial)
    close(blade.torque, problem.parameters["inertia"] * result.a[2], inertial)
    along = np.stack([np.cos(result.q[2]), np.sin(result.q[2])])
    assert np.abs((blade.force * along).sum(axis=0)).max() < 1e-12  # across the blade


@pytest.mark.parametrize("make", [mechanisms.pendulum, mechanisms.double_pendulum, lambda: mechanisms.closed_chain(7)])
def test_point_masses_on_links(make):
    problem = make()
    result = run(problem, 0.5)
    n, gravity = problem.system.n_q // 2, problem.parameters["gravity"]
    total = np.zeros_like(result.q)
    for joint in problem.joints:
        link = result.reactions(joint.name)
        own = list(joint.translation)
        total[own] += link.force
        number = int(joint.name.removeprefix("link").strip() or 1)
        if number == n + 1:
            continue  # from the last mass to the ground
        if number > 1:
            total[[own[0] - 2, own[1] - 2]] -= link.force
        assert (link.torque == 0.0).all() and link.unique
    inertial = problem.parameters["mass"] * (result.a + gravity * np.tile([[0.0], [1.0]], (n, 1)))
    close(total, inertial, inertial)


@pytest.mark.parametrize("make", [mechanisms.very_flexible_beam, mechanisms.moderately_stiff_beam])
def test_the_base_of_the_beam(make):
    """Weight and reaction change the momentum; the motion x = y = const of all nodes has that of the whole beam."""
    problem = make(2)
    result = run(problem, 0.05)
    M = problem.system.mass(0.0, problem.q0)
    rigid = np.zeros((2, problem.system.n_q))
    rigid[0, 0::6] = rigid[1, 1::6] = 1.0
    mass = rigid[0] @ M @ rigid[0]
    force = result.reactions("base").force
    close(force, rigid @ M @ result.a - mass * DOWN[:, None], force)


# --- spatial bodies: centre of mass and Euler parameters
SPATIAL = {
    "heavy top": (mechanisms.heavy_top, 0.05),
    "spatial four-bar": (mechanisms.spatial_four_bar, 0.3),
    "spatial slider-crank": (mechanisms.spatial_slider_crank, 0.3),
}


def states(result, k):
    """Euler parameters and the angular velocity along the axes of the body whose coordinates begin at k."""
    return [(e, 2.0 * G(e) @ u) for e, u in zip(result.q[k + 3 : k + 7].T, result.v[k + 3 : k + 7].T, strict=True)]


@pytest.mark.parametrize("name", SPATIAL)
def test_spatial_bodies(name):
    make, t_end = SPATIAL[name]
    problem = make()
    result = run(problem, t_end)
    names = [coordinate.removeprefix("x (m) of ") for coordinate in problem.coordinates[::7]]
    forces, torques = sums(result, 3)
    M = problem.system.mass(0.0, problem.q0)
    for body, label in enumerate(names):
        k = 7 * body
        mass, e0 = M[k, k], problem.q0[k + 3 : k + 7]
        inertia = G(e0) @ M[k + 3 : k + 7, k + 3 : k + 7] @ G(e0).T / 4.0
        inertial = mass * (result.a[k : k + 3] - np.array([[0.0], [0.0], [-9.81]]))
        spun = np.empty_like(inertial)
        for i, (e, spin) in enumerate(states(result, k)):
            turning = inertia @ (2.0 * G(e) @ result.a[k + 3 : k + 7, i]) + np.cross(spin, inertia @ spin)
            spun[:, i] = rotation_matrix(e) @ turning
        spun += moment(result.q[k : k + 3], inertial)
        close(forces[label], inertial, inertial)
        close(torques[label], spun, inertial)
    assert all(result.reactions(joint.name).unique for joint in problem.joints)


def test_bars_by_rotation_matrices_with_a_redundant_row():
    """Bricard: hinges share a load in any proportion, the sum on each bar is that of Newton and Euler."""
    problem = mechanisms.bricard()
    result = run(problem, 0.3)
    assert (result.rank, problem.system.n_c) == (59, 60)
    forces, torques = sums(result, 3)
    moments = np.array([1.0 / 12.0, 0.01 / 12.0, 0.01 / 12.0])  # kg m^2, the second moments along the columns
    for bar in range(5):
        k = 12 * bar
        inertial = 1.0 * (result.a[k : k + 3] - np.array([[0.0], [-9.81], [0.0]]))
        columns, turning = (array[k + 3 : k + 12].reshape(3, 3, -1) for array in (result.q, result.a))
        spun = sum(moments[i] * np.cross(columns[i], turning[i], axis=0) for i in range(3))
        spun = spun + moment(result.q[k : k + 3], inertial)
        close(forces[f"bar {bar + 1}"], inertial, 10.0)
        close(torques[f"bar {bar + 1}"], spun, 10.0)
    assert not any(result.reactions(joint.name).unique for joint in problem.joints)


def test_a_redundant_row_is_said_to_leave_single_joints_open():
    """Another choice of the multipliers of the same motion changes single joints, and no sum on a body."""
    problem = mechanisms.redundant_slider_crank()
    result = run(problem, 0.3)
    rows = problem.system.rows(0.0, problem.q0)
    idle = np.linalg.svd(rows)[0][:, result.rank :]
    assert idle.shape == (9, 1)
    changed = {
        joint.name: bool(np.abs(rows[list(joint.rows)].T @ idle[list(joint.rows)]).max() > 1e-6)
        for joint in problem.joints
    }
    assert {name: not result.reactions(name).unique for name in changed} == changed
    assert changed["pin rod-crank"] and changed["distance slider-crank"] and not changed["pin crank-ground"]


BOB = [0.0, -1.0], [0.0, 0.0]


@pytest.mark.parametrize("equations", [None, np.array([[1.0, 0.0], [1.0, 2.0]])], ids=["rows", "sums of rows"])
@pytest.mark.parametrize(("rows", "unique"), [((1,), False), ((0, 1), True)])
def test_rows_that_depend_on_one_another_leave_what_has_all_of_them_unique(rows, unique, equations):
    system = held_twice(joints=[Joint("link", rows, (0, 1), equations=equations)])
    with pytest.warns(ConstraintWarning):
        result = solve_dae(system, (0.0, 0.1), *BOB)
    link = result.reactions("link")
    assert result.rank == 1 and link.unique == unique
    if unique:
        assert np.abs(link.force - [[0.0], [9.81]]).max() < 1e-12


def test_a_drive_does_work_by_its_torque():
    problem = mechanisms.driven_crank()
    times = np.linspace(0.4, 0.5, 41)
    result = solve_dae(problem.system, (0.0, 1.0), problem.q0, problem.v0, "Gauss12", 1e-11, 1e-11, t_eval=times)
    torque = result.reactions("drive of angle of crank").torque
    energy = problem.energy(result.t, result.q, result.v)
    power = torque * result.v[2]
    weights = np.tile([2.0, 4.0], 20)
    work = (power[:-1] @ weights + power[-1] - power[0]) * (times[1] - times[0]) / 3.0  # Simpson's rule
    assert work == pytest.approx(energy[-1] - energy[0], rel=1e-8)
