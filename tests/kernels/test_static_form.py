"""Large systems by sparse factors with a static program, against dense algebra in NumPy and the other forms."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

import twoloop.run.static_form as static_module
from studies.bench.large import LEVEL, PLANAR, closed_chain, grid, in_space, ladder, open_chain
from studies.bench.random_assemblies import PlanarAssembly, SpatialAssembly, dense_solution, drawn
from tests.large_systems import spatial_chain, started_run
from tests.problems import worst
from twoloop import ConstraintWarning, Status, consistent_state, mechanisms, solve_dae
from twoloop.checks.values import MOST
from twoloop.kernels import advance
from twoloop.kernels.algebra import static_program
from twoloop.kernels.data import codes, noted
from twoloop.kernels.evaluation import tasks
from twoloop.mechanisms.planar import GROUND, PlanarBodies
from twoloop.methods.presets import PRESETS
from twoloop.run.static_form import static_form
from twoloop.run.workspace import kit_of, workspace


class Started:
    """The static form of a system with its factors at a state; None of `code` but DONE."""

    def __init__(self, system, q, v):
        form, n = static_form(system, 0.0, q), system.n_q
        assert form is not None
        self.system, self.kit = system, kit_of(system, 0.0, q, None, form)
        ranks = (None, None)
        for _ in range(2):
            self.work = workspace(system, self.kit, np.zeros((0, 0)), q, 1e-8, 0.0, ranks, form)
            state = np.concatenate([q, v, np.zeros(n + system.n_c)])
            self.code = advance.start(self.kit, self.work, 0.0, state)
            if self.code != codes.RANK_DIFFERS:
                break
            ranks = (int(self.work.notes[noted.RANK]),) * 2
        self.a, self.lam, self.rank = state[2 * n : 3 * n], state[3 * n :], len(self.work.rows_v)

    def project(self, q, v, theta=1e-13):
        q, v, a, lam = q.copy(), v.copy(), np.zeros_like(q), np.zeros_like(self.lam)
        code = self.kit.inner(self.kit, self.work, tasks.PROJECT, 0.0, q, v, theta, a, lam)
        assert code == codes.DONE
        return q, v


def compare(assembly):
    """The error of accelerations and multipliers of a random assembly; None where dense has to decide."""
    system = assembly.system("random")
    v = assembly.v(system)
    exact, started = dense_solution(system, assembly.q, v), Started(system, assembly.q, v)
    if started.code == codes.NEEDS_DENSE:
        return None
    assert started.code == codes.DONE and started.rank == exact.rank
    return exact.error(started.a, started.lam)


@pytest.fixture
def any_size(large, monkeypatch):
    """The static form also for what is too small for it to pay."""
    monkeypatch.setattr(static_module, "SPARSE", 1e9)


@pytest.mark.parametrize(
    ("kind", "number", "most"),
    [
        (PlanarAssembly, 16, 80),
        (SpatialAssembly, 12, 30),
        pytest.param(PlanarAssembly, 130, 300, marks=pytest.mark.slow),
        pytest.param(SpatialAssembly, 70, 300, marks=pytest.mark.slow),
    ],
)
def test_random_assemblies_agree_with_dense_algebra(any_size, kind, number, most):
    """Trees and loops of 5 bodies and more, most with redundant rows; the two hundred that are slow take a minute."""
    found = [compare(drawn(kind, seed, most)) for seed in range(number)]
    assert max(error for error in found if error is not None) < 1e-9 and found.count(None) <= number // 12


@pytest.mark.parametrize("ratio", [1e6, 1e10])
def test_mass_ratios(any_size, ratio):
    decided = 0
    for seed in range(12):
        assembly = PlanarAssembly(seed, 30, 2, 0, heaviest=ratio)
        system = assembly.system("heavy and light")
        v = np.zeros(system.n_q)
        started = Started(system, assembly.q, v)
        if started.code == codes.NEEDS_DENSE:
            continue
        decided += 1
        root, a = np.sqrt(np.diag(system.mass(0.0, assembly.q))), dense_solution(system, assembly.q, v).a
        assert worst(root * started.a, root * a) < 1e-10 * np.abs(root * a).max()
    assert decided >= 10


def test_projection_is_that_in_the_metric_of_the_masses(any_size):
    assembly = PlanarAssembly(3, 40, 4, 1)
    system = assembly.system("projected")
    started = Started(system, assembly.q, np.zeros(system.n_q))
    rng = np.random.default_rng(1)
    q = expected = assembly.q + 1e-4 * rng.normal(size=system.n_q)
    speeds = rng.normal(size=system.n_q)
    root = np.sqrt(np.diag(system.mass(0.0, q)))

    def least(values, at):
        return np.linalg.pinv(system.jacobian(0.0, at) / root, rcond=1e-5) @ values / root

    # beside the constraints redundant rows are so only nearly: the same that count are taken
    rows = np.sort(started.work.rows_v)

    def least_of(values, at):
        return np.linalg.pinv(system.jacobian(0.0, at)[rows] / root, rcond=1e-10) @ values[rows] / root

    for _ in range(6):
        expected = expected - least_of(system.constraint(0.0, expected), expected)
    found, v = started.project(q, speeds)
    assert worst(found, expected) < 1e-11
    found, v = started.project(found, speeds)
    assert worst(v, speeds - least(system.jacobian(0.0, found) @ speeds, found)) < 1e-9


@pytest.mark.parametrize("method", ["DOP853", "Adams", "Taylor", "auto"])
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


def test_the_default_of_large_systems_with_values_of_entries_is_explicit_by_dop853(large):
    """A projection, one a step, costs as much as an evaluation: Adams' many short steps take twice the time."""
    system, n = closed_chain(30).system, 90
    large(10**9)
    dense = closed_chain(30).system
    for given, name, tolerance in ((system, "DOP853", 1e-6), (system, "Adams", 1e-11), (dense, "Adams", 1e-6)):
        chosen = replace(PRESETS["auto"].for_system(given), series=None).plan(n, tolerance, tolerance, False)
        assert chosen.first == PRESETS[name].plan(n, tolerance, tolerance, False).step


def test_redundant_rows_are_named_and_held(both):
    assembly = PlanarAssembly(5, 24, 2, 2)
    system, q = assembly.system("redundant"), assembly.q

    def run():
        with pytest.warns(ConstraintWarning, match="depend on the others"):
            return solve_dae(assembly.system("redundant"), (0.0, 0.02), q, 0.0 * q, "DOP853", 1e-9, 1e-9)

    other, result = both(run)
    assert result.success and result.rank == other.rank == system.n_c - len(result.redundant)
    assert worst(result.q[:, -1], other.q[:, -1]) < 1e-9
    assert worst(result.lam[:, -1], other.lam[:, -1]) < 1e-6 * np.abs(other.lam[:, -1]).max()
    assert worst(system.constraint(0.02, result.q[:, -1]), 0.0) < 1e-12


def test_many_redundant_rows(any_size):
    """More than eighty, with multipliers of least norm."""
    assembly = PlanarAssembly(3, 60, 0, 90)
    system = assembly.system("many pins twice")
    v = assembly.v(system)
    a, lam, rank, _ = dense_solution(system, assembly.q, v)
    started = Started(system, assembly.q, v)
    assert started.rank == rank <= system.n_c - 80 and worst(started.a, a) < 1e-9 * np.abs(a).max()
    assert worst(started.lam, lam) < 1e-9 * np.abs(lam).max()


@pytest.mark.parametrize(("end", "partitions", "drift"), [(0.09, 10, 1e-6), (0.15, 20, 1e-5)])
def test_a_ladder_whose_parallelograms_pass_their_flat_position(end, partitions, drift):
    """Which is a singular one: steps cross it. Rungs stay parallel, and the rails each other's images.

    By 0.15 s such positions follow one another within a step, and stages beside the constraints have wrong
    accelerations there: such steps are refused at first.
    """
    made, left = ladder(99), 66
    result = solve_dae(made.system, (0.0, end), made.q, 0.0 * made.q, "DOP853", 1e-6, 1e-6, compiled=False)
    assert result.success and result.stats.n_evaluations < 5000
    assert result.stats.n_partitions < partitions  # the static form all along
    angles = result.q[2::3]
    assert worst(angles[left:], LEVEL) < 1e-8 and worst(angles[:left:2], angles[1:left:2]) < 1e-8
    crossing = result.q.T[(result.t > 0.07) & (result.t < 0.08)]
    assert min(np.linalg.svd(made.system.jacobian(0.0, q), compute_uv=False)[-1] for q in crossing) < 1e-3
    energy = made.bodies.energy(result.t, result.q, result.v)
    assert np.ptp(energy) < drift * np.abs(energy).max()


def test_programs_grow_with_the_bodies_and_no_faster(large):
    for make in PLANAR:
        updates = {}
        for n in (99, 499):
            system, q, _ = make(n)
            updates[n] = int(static_form(system, 0.0, q).program[static_program.N_UPDATES])
            run = started_run(system, q)
            assert run.static is not None
            assert run.work.notes.base.size + run.work.counters.base.size < 120 * system.n_q  # nothing n_c x n_q
        assert updates[499] <= (18.0 if make is grid else 5.3) * updates[99]  # of a grid like n^1.5, at best
        assert updates[499] <= (800 if make is grid else 150) * 499


@pytest.mark.parametrize("build", [pytest.param(open_chain, marks=pytest.mark.slow), ladder])
def test_starts_make_no_full_matrix_beyond_those_of_four_million_numbers(build):
    for size in (40, 1000):  # the first one loads the kernels
        made = build(size)
        system = made.system
        tracemalloc.start()
        solve_dae(system, (0.0, 1.0), made.q, 0.0 * made.q, "DOP853", max_steps=2, compiled=False)
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert system.n_c * system.n_q > MOST and most < 0.7 * 8 * system.n_c * system.n_q


def test_small_mechanisms_have_the_forms_that_they_had():
    for name in ("bricard", "closed_chain", "n_four_bar", "andrews", "spatial_slider_crank"):
        problem = getattr(mechanisms, name)()
        assert static_form(problem.system, 0.0, problem.q0) is None


def test_a_position_that_is_nearly_singular_is_left_to_the_dense_forms(any_size, both):
    """A parallelogram that comes to its flat position: every form stops there, or crosses it on the same branch."""
    bodies = PlanarBodies([f"bar {k}" for k in range(3)], np.ones(3), np.full(3, 0.1))
    bodies.pin(GROUND, (0.0, 0.0), 0, (-0.5, 0.0))
    bodies.pin(GROUND, (1.0, 0.0), 1, (-0.5, 0.0))
    bodies.pin(0, (0.5, 0.0), 2, (-0.5, 0.0))
    bodies.pin(1, (0.5, 0.0), 2, (0.5, 0.0))
    angle, speed = 0.3, 4.0
    c, s = np.cos(angle), np.sin(angle)
    q = np.array([0.5 * c, 0.5 * s, angle, 1.0 + 0.5 * c, 0.5 * s, angle, 0.5 + c, s, 0.0])
    v = -speed * np.array([-0.5 * s, 0.5 * c, 1.0, -0.5 * s, 0.5 * c, 1.0, -s, c, 0.0])
    options = {"method": "DOP853", "rtol": 1e-8, "atol": 1e-8, "compiled": False}
    runs = both(lambda: solve_dae(bodies.system("parallelogram"), (0.0, 0.2), q, v, **options))
    for result in runs:  # rounding decides whether a step ends beyond the position, in the motion of the parallelogram
        if result.success:
            energy = bodies.energy(result.t, result.q, result.v)
            assert worst(result.q[8], 0.0) < 1e-5 and np.ptp(energy) < 1e-6 * np.abs(energy).max()
        else:
            assert result.status is Status.STEP_TOO_SMALL and worst(result.q[2, -1], 0.0) < 1e-3


def test_starts_of_large_systems(both):
    for make in (open_chain, closed_chain, ladder):
        system, q, _ = make(36)
        rng = np.random.default_rng(2)
        guess, speeds = q + 1e-5 * rng.normal(size=len(q)), rng.normal(size=len(q))
        dense, state = both(lambda start=(system, 0.0, guess, speeds): consistent_state(*start))
        assert type(state) is not type(dense) and worst(state[0], dense[0]) < 1e-11 and worst(state[1], dense[1]) < 1e-9
        assert (state.moved_q.coordinate, len(state.dependent)) == (dense.moved_q.coordinate, system.n_c)
        assert abs(state.margin - dense.margin) < 1e-6


def test_bodies_whose_mass_matrix_is_singular(any_size, both):
    """Four Euler parameters a body: M has rank 6 of 7, and the rows of their norms stiffen it."""

    def run():
        system, q, v = spatial_chain(6)
        return solve_dae(system, (0.0, 0.1), q, v, "DOP853", 1e-9, 1e-9, compiled=False)

    one, other = both(run)
    system, q = other.system, other.q[:, 0]
    assert one.success and other.success
    assert (static_form(system, 0.0, q) is not None) and started_run(system, q).static is not None
    assert worst(one.q[:, -1], other.q[:, -1]) < 1e-11
    assert worst(one.lam[:, -1], other.lam[:, -1]) < 1e-9 * np.abs(one.lam[:, -1]).max()


@pytest.mark.parametrize(
    ("build", "n", "loops"),
    [
        (closed_chain, 60, 1),
        (ladder, 30, 10),
        pytest.param(closed_chain, 1000, 1, marks=pytest.mark.slow),
        pytest.param(ladder, 300, 100, marks=pytest.mark.slow),
    ],
)
def test_parallel_hinges_have_three_redundant_rows_a_loop(any_size, build, n, loops):
    made = build(n)
    hinged = in_space(made, 0.0)
    system, q = hinged.system, hinged.q
    v = 0.0 * q
    planar_one, one = Started(made.system, made.q, 0.0 * made.q), Started(system, q, v)
    assert (planar_one.code, one.code) == (codes.DONE, codes.DONE)
    assert (planar_one.rank, one.rank) == (made.system.n_c, system.n_c - 3 * loops)
    expected = planar_one.a.reshape(-1, 3)[:, :2]
    assert worst(one.a.reshape(-1, 7)[:, :2], expected) < 1e-8 * np.abs(expected).max()
    (rows, columns), (i, j) = system.entries["jacobian"], system.entries["mass"]
    reaction = np.bincount(columns, system.jacobian_values(0.0, q) * one.lam[rows], system.n_q)
    inertia = np.bincount(i, system.mass_values(0.0, q) * one.a[j], system.n_q)
    assert worst(inertia + reaction, system.force(0.0, q, v)) < 1e-8 * np.abs(reaction).max()


def test_a_large_program_is_made_where_it_is_sparse(monkeypatch):
    monkeypatch.setattr(static_program, "FEW_UPDATES", 0)
    none, n = (np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)), 300
    each = np.arange(n)
    chain = np.concatenate([each, each[1:]]), np.concatenate([each, each[:-1]])
    full = np.divmod(np.arange(n * n), n)
    assert static_program.program_in_order(each, n, chain, none, ()) is not None
    assert static_program.program_in_order(each, n, full, none, ()) is None
