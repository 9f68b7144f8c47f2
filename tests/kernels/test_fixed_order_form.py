"""Test large systems by sparse factors in the fixed-order form, against dense algebra in NumPy and the dense forms."""

import tracemalloc

import numpy as np
import pytest

import twoloop.run.workspace as workspace_module
from studies.bench.large import LEVEL, PLANAR, closed_chain, grid, ladder
from tests.kernels.random_assemblies import PlanarAssembly, SpatialAssembly, dense_solution, drawn
from tests.large_systems import spatial_chain, started_run
from tests.marks import slow
from tests.problems import worst
from twoloop import ConstrainedSystem, solve_dae
from twoloop.bodies import PlanarModel, SpatialModel
from twoloop.checks.callbacks import MAX_ENTRIES
from twoloop.kernels import advance
from twoloop.kernels.data import indices
from twoloop.kernels.linalg import symbolic_factorization
from twoloop.run.workspace import fixed_order_form, make_kit, workspace


class Started:
    """The fixed-order form of a system with its factors at a state; None of `code` but DONE."""

    def __init__(self, system, q, v):
        form, n = fixed_order_form(system, 0.0, q), system.n_q
        assert form is not None
        self.kit = make_kit(system, 0.0, q, None, form)
        ranks = (None, None)
        for _ in range(2):
            self.work = workspace(system, self.kit, np.zeros((0, 0)), q, 1e-8, 0.0, ranks, form)
            state = np.concatenate([q, v, np.zeros(n + system.n_c)])
            self.code = advance.start(self.kit, self.work, 0.0, state)
            if self.code != indices.RANK_DIFFERS:
                break
            ranks = (int(self.work.notes[indices.RANK]),) * 2
        self.a, self.lam, self.rank = state[2 * n : 3 * n], state[3 * n :], len(self.work.rows_v)


def compare(assembly):
    """The error of accelerations and multipliers of a random assembly; None where dense has to decide."""
    system = assembly.system("random")
    v = assembly.v(system)
    exact, started = dense_solution(system, assembly.q, v), Started(system, assembly.q, v)
    if started.code == indices.NEEDS_DENSE:
        return None
    assert started.code == indices.DONE and started.rank == exact.rank
    return exact.error(started.a, started.lam)


@pytest.fixture
def any_size(large, monkeypatch):
    """The fixed-order form also for what is too small for it to pay."""
    monkeypatch.setattr(workspace_module, "MAX_SHARE", 1e9)


@pytest.mark.parametrize(
    ("kind", "number", "most"),
    [
        (PlanarAssembly, 16, 80),
        (SpatialAssembly, 12, 30),
        slow(PlanarAssembly, 130, 300),
        slow(SpatialAssembly, 70, 300),
    ],
)
def test_random_assemblies_agree_with_dense_algebra(any_size, kind, number, most):
    """Trees and loops of 5 bodies and more, most with redundant rows; the two hundred that are slow take a minute."""
    found = [compare(drawn(kind, seed, most)) for seed in range(number)]
    assert max(error for error in found if error is not None) < 1e-9 and found.count(None) <= number // 12


@pytest.mark.parametrize("method", ["DOP853", *(slow(name) for name in ("Adams", "Taylor", "auto"))])
def test_runs_are_those_of_the_other_forms(both, method):
    options = {"method": method, "rtol": 1e-10, "atol": 1e-10, "compiled": False, "dense_output": True}

    def run():
        system, q, _ = closed_chain(18)
        return solve_dae(system, (0.0, 0.05), q, np.zeros_like(q), **options)

    one, other = both(run)
    system = other.system
    assert one.success and other.success and worst(one.q[:, -1], other.q[:, -1]) < 1e-10
    assert worst(one.lam[:, -1], other.lam[:, -1]) < 1e-8
    assert abs(one.stats.n_evaluations - other.stats.n_evaluations) <= 0.1 * one.stats.n_evaluations
    times = np.linspace(0.0, 0.05, 23)
    ours, theirs = other.sol(times), one.sol(times)
    assert worst(ours.q, theirs.q) < 1e-9 and worst(ours.a, theirs.a) < 1e-5 * np.abs(theirs.a).max()
    assert max(worst(system.constraint(0.0, q), 0.0) for q in ours.q.T) < 1e-13
    name = system.joints[5].name
    assert worst(one.reactions(name).force[:, -1], other.reactions(name).force[:, -1]) < 1e-7


@pytest.mark.parametrize(("end", "partitions", "drift"), [(0.09, 10, 1e-6), slow(0.15, 20, 1e-5)])
def test_a_ladder_whose_parallelograms_pass_their_flat_position(end, partitions, drift):
    """Which is a singular one: steps cross it. Rungs stay parallel, and the rails each other's images.

    By 0.15 s such positions follow one another within a step, and stages beside the constraints have wrong
    accelerations there: such steps are refused at first.
    """
    made, left = ladder(99), 66
    result = solve_dae(made.system, (0.0, end), made.q, 0.0 * made.q, "DOP853", 1e-6, 1e-6, compiled=False)
    assert result.success and result.stats.n_evaluations < 5000
    assert result.stats.n_partitions < partitions  # the fixed-order form all along
    angles = result.q[2::3]
    assert worst(angles[left:], LEVEL) < 1e-8 and worst(angles[:left:2], angles[1:left:2]) < 1e-8
    crossing = result.q.T[(result.t > 0.07) & (result.t < 0.08)]
    assert min(np.linalg.svd(made.system.jacobian(0.0, q), compute_uv=False)[-1] for q in crossing) < 1e-3
    energy = made.bodies.energy(result.t, result.q, result.v)
    assert np.ptp(energy) < drift * np.abs(energy).max()


@pytest.mark.slow
def test_programs_grow_with_the_bodies_and_no_faster(large):
    for make in PLANAR:
        updates = {}
        for n in (99, 499):
            system, q, _ = make(n)
            updates[n] = int(fixed_order_form(system, 0.0, q).program[symbolic_factorization.N_UPDATES])
            run = started_run(system, q)
            assert run.fixed_order is not None
            assert run.work.notes.base.size + run.work.counters.base.size < 120 * system.n_q  # nothing n_c x n_q
        assert updates[499] <= (18.0 if make is grid else 5.3) * updates[99]  # of a grid like n^1.5, at best
        assert updates[499] <= (800 if make is grid else 150) * 499


@pytest.mark.slow
def test_starts_make_no_full_matrix_beyond_those_of_four_million_numbers():
    for size in (40, 1000):  # the first one loads the kernels
        made = ladder(size)
        system = made.system
        tracemalloc.start()
        solve_dae(system, (0.0, 1.0), made.q, 0.0 * made.q, "DOP853", max_steps=2, compiled=False)
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert system.n_c * system.n_q > MAX_ENTRIES and most < 0.7 * 8 * system.n_c * system.n_q


def test_rods_of_ten_micrometres_a_metre_from_the_origin(any_size, both):
    """Rounding of their positions turns them by 2e-11, which is more than corrections of 1 m may keep."""
    angles = np.linspace(-1.0, 1.0, 12)
    ways = 1e-5 * np.stack([np.cos(angles), np.sin(angles)], axis=1)

    def run(place):
        model, pin, before = PlanarModel(gravity=(0.0, -9.81)), np.array(place), "ground"
        for k, (angle, way) in enumerate(zip(angles, ways, strict=True)):
            rod = model.body(str(k), mass=1e-5, inertia=1e-15 / 12.0, position=pin + 0.5 * way, angle=angle)
            model.revolute(before, rod, at=pin)
            before, pin = rod, pin + way
        model.revolute(before, "ground", at=pin)
        problem = model.problem((0.0, 5e-4))
        return solve_dae(problem.system, problem.t_span, problem.q0, problem.v0, "DOP853", 1e-8, 1e-8, compiled=False)

    near = run((0.0, 0.0))
    for far in both(lambda: run((1.0, 0.5))):
        assert far.success and far.stats.n_rejected_convergence == 0 and far.stats.n_accepted < 40
        assert worst(far.q[2::3, -1], near.q[2::3, -1]) < 1e-6 < worst(far.q[2::3, -1], angles)


def test_bodies_whose_mass_matrix_is_singular(any_size, both):
    """Four Euler parameters a body: M has rank 6 of 7, and the rows of their norms stiffen it."""

    def run():
        system, q, v = spatial_chain(6)
        return solve_dae(system, (0.0, 0.1), q, v, "DOP853", 1e-9, 1e-9, compiled=False)

    one, other = both(run)
    system, q = other.system, other.q[:, 0]
    assert one.success and other.success
    assert (fixed_order_form(system, 0.0, q) is not None) and started_run(system, q).fixed_order is not None
    assert worst(one.q[:, -1], other.q[:, -1]) < 1e-11
    assert worst(one.lam[:, -1], other.lam[:, -1]) < 1e-9 * np.abs(one.lam[:, -1]).max()


@pytest.mark.filterwarnings("ignore::twoloop.ConstraintWarning")
def test_a_hub_whose_stiffening_row_other_rows_imply(any_size, both, monkeypatch):
    monkeypatch.setattr(symbolic_factorization, "MAX_JOINTS", 2)
    model, axis = SpatialModel(gravity=(0.0, 0.0, -9.81)), (0.0, 1.0, 0.0)
    model.body("hub", mass=2.0, inertia=(0.1, 0.1, 0.1), position=(0.0, 0.0, 0.0))
    model.revolute("ground", "hub", at=(0.0, 0.0, 0.0), axis=axis)
    for k, (x, z) in enumerate(((0.4, 0.5), (-0.3, 0.6), (0.2, -0.6))):
        for name in ("link", "rocker"):
            at = (x + 0.5, k, z + 0.2) if name == "link" else (x + 1.1, k, 0.5 * z + 0.2)
            model.body(f"{name} {k}", mass=0.5, inertia=(0.02, 0.02, 0.02), position=at)
        model.revolute("hub", f"link {k}", at=(x, k, z), axis=axis)
        model.revolute(f"link {k}", f"rocker {k}", at=(x + 1.0, k, z + 0.4), axis=axis)
        model.revolute(f"rocker {k}", "ground", at=(x + 1.2, k, 0.0), axis=axis)
    problem = model.problem((0.0, 0.1))
    one, other = both(lambda: solve_dae(problem.system, (0.0, 0.1), problem.q0, problem.v0, "DOP853", 1e-9, 1e-9))
    assert one.success and started_run(problem.system, problem.q0).fixed_order is not None
    assert worst(one.q[:, -1], other.q[:, -1]) < 1e-11


def test_an_entry_that_comes_up_on_the_way_ends_the_fixed_order_form(both):
    """Coordinates that are held, the first of which comes to lean on another where the second is beyond 0.5."""
    n = 12

    def beyond(x, order=0):
        return [1.0, 4.0, 12.0][order] * max(0.0, x - 0.5) ** (4 - order)

    def jacobian(t, q):
        made = np.eye(n, 2 * n)
        made[0, 1], made[0, n] = beyond(q[1], 1) * q[n], beyond(q[1])
        return made

    def gamma(t, q, v):
        return -np.eye(n)[0] * (beyond(q[1], 2) * q[n] * v[1] ** 2 + 2.0 * beyond(q[1], 1) * v[1] * v[n])

    system = ConstrainedSystem.from_python(
        n_q=2 * n,
        n_c=n,
        mass=np.eye(2 * n),
        force=lambda t, q, v: np.ones(2 * n),
        constraint=lambda t, q: q[:n] + np.eye(n)[0] * beyond(q[1]) * q[n] - np.eye(n)[1] * t,
        constraint_rate=lambda t, q: -np.eye(n)[1],
        jacobian=jacobian,
        gamma=gamma,
    )
    start = (0.0, 1.2), np.zeros(2 * n), np.eye(2 * n)[1]
    one, other = both(lambda: solve_dae(system, *start, "DOP853", time_limit=20.0))
    assert one.success and other.success and abs(one.q[0, -1]) > 0.05 and worst(one.q[:, -1], other.q[:, -1]) < 1e-9


@pytest.mark.filterwarnings("ignore:the constraints of:twoloop.ConstraintWarning")
def test_a_large_model_with_more_rows_than_coordinates():
    """A bar on 44 parallel cranks in space: each hinge takes five freedoms, and only one freedom is left."""
    n, angle = 44, 0.9
    model, tip = SpatialModel(gravity=(0.0, 0.0, -9.81)), np.array([np.cos(angle), 0.0, np.sin(angle)])
    model.rod("bar", tip, tip + np.array([n, 0.0, 0.0]), mass=2.0, radius=0.01)
    for i in range(n):
        foot = np.array([i, 0.0, 0.0])
        model.rod(f"crank {i}", foot, foot + tip, mass=1.5, radius=0.01)
        model.revolute("ground", f"crank {i}", at=foot, axis=(0.0, 1.0, 0.0))
        model.revolute(f"crank {i}", "bar", at=foot + tip, axis=(0.0, 1.0, 0.0))
    problem = model.problem((0.0, 0.01))
    assert problem.system.n_c > problem.system.n_q
    result = solve_dae(problem.system, problem.t_span, problem.q0, problem.v0, "DOP853")
    assert result.success, result.message
    inertia = n * 1.5 * (1.0 / 3.0 + 0.01**2 / 4.0) + 2.0
    turn = -(n * 1.5 * 0.5 + 2.0) * 9.81 * np.cos(angle) / inertia  # angular acceleration at the start
    np.testing.assert_allclose(np.linalg.norm(result.a[:3, 0]), abs(turn), rtol=1e-9)
