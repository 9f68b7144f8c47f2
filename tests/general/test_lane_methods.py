"""Methods in lanes: each is what it is in single runs, stiff ensembles too, whatever the lanes, threads and order."""

from contextlib import nullcontext

import numpy as np
import pytest

from tests.general.pendulums import far_from_single_runs, pendulums, system_of
from tests.problems import pendulum, unconstrained
from twoloop import ConstrainedSystem, ConstraintWarning, Status, ensemble, mechanisms, solve_dae
from twoloop.ensembles.in_lanes import LaneRuns
from twoloop.ensembles.lane_methods import STAGES, is_involved, lane_methods
from twoloop.ensembles.starts import Starts
from twoloop.methods.presets import PRESETS

SPAN, TOLERANCE = (0.0, 2.0), 1e-8
TIMES = np.sort(np.concatenate([np.linspace(*SPAN, 9), [1e-4, 0.501, 0.5011, 1.99999]]))


@pytest.fixture(autouse=True)
def builds(monkeypatch):
    """Lanes are compiled however few runs there are."""
    monkeypatch.setattr("twoloop.ensembles.in_turn.CALL", 1e9)


@pytest.fixture(scope="module", params=["auto", "DOP853", "RadauIIA5", "RadauIIA9", "RadauIIA13"])
def made(request):
    system, q, v, parameters = pendulums(140)
    options = {"method": request.param, "rtol": TOLERANCE, "atol": TOLERANCE, "t_eval": TIMES}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("twoloop.ensembles.in_turn.CALL", 1e9)
        runs = ensemble(system, SPAN, q, v, parameters=parameters, threads=1, **options)
    return system, q, v, parameters, options, runs


def test_runs_are_those_of_another_method_one_by_one(made):
    system, q, v, parameters, options, runs = made
    method, other, fewest = options["method"], "Taylor", 27 if options["method"] == "DOP853" else 100
    if method == "auto":
        method, other, fewest = "Taylor", "DOP853", 4
    assert runs.q.shape == runs.v.shape == (140, 2, TIMES.size) and (runs.t == TIMES).all() and len(runs) == 140
    assert runs.singly.tolist() == [True] + 139 * [False] and f"139 in lanes by {method}" in runs.message
    assert runs.success.all() and (runs.status == Status.REACHED_END).all() and (runs.n_steps >= fewest).all()
    for run in (0, 1, 7, 139):
        own = system.with_parameters(parameters[run])
        known = solve_dae(own, SPAN, q[run], v[run], method=other, rtol=1e-11, atol=1e-11, t_eval=TIMES)
        assert np.abs(runs.q[run] - known.q).max() < 1e-6 and np.abs(runs.v[run] - known.v).max() < 1e-6


def test_steps_are_as_many_as_those_of_single_runs(made):
    system, q, v, parameters, options, runs = made
    for run in (3, 60):
        n_steps = solve_dae(system.with_parameters(parameters[run]), SPAN, q[run], v[run], **options).stats.n_accepted
        longer = 4.0 / 15.0 if options["method"] == "DOP853" else 1.0  # stages look at the equations, too
        assert 0.9 * longer * n_steps <= runs.n_steps[run] <= 1.5 * n_steps


@pytest.mark.parametrize(("method", "tolerance"), [("DOP853", 1e-9), ("RadauIIA5", 1e-6), ("RadauIIA9", 1e-9)])
def test_errors_set_the_steps_of_long_runs(method, tolerance):
    """Of those above a hundredth of the run does."""
    system, q, v, parameters = pendulums(9)
    span, options = (0.0, 60.0), {"method": method, "rtol": tolerance, "atol": tolerance}
    runs = ensemble(system, span, q, v, parameters=parameters, **options)
    for run in (2, 5):
        own = system.with_parameters(parameters[run])
        n_steps = solve_dae(own, span, q[run], v[run], **options).stats.n_accepted
        known = solve_dae(own, span, q[run], v[run], method="Taylor", rtol=1e-12, atol=1e-12)
        assert 150 < 0.9 * n_steps <= runs.n_steps[run] <= 1.6 * n_steps
        assert np.abs(runs.q[run, :, -1] - known.q[:, -1]).max() < 1e3 * tolerance


def test_every_state_is_on_its_own_constraints(made):
    *_, parameters, _, runs = made
    C = 0.5 * ((runs.q**2).sum(axis=1) - parameters[:, 1:2] ** 2)
    assert np.abs(C).max() < 1e-13 and np.abs((runs.q * runs.v).sum(axis=1)).max() < 1e-12


def test_runs_depend_neither_on_threads_nor_on_their_order_nor_on_one_another(made):
    system, q, v, parameters, options, runs = made
    order = np.random.default_rng(0).permutation(140)
    other = ensemble(system, SPAN, q[order], v[order], parameters=parameters[order], threads=2, **options)
    lanes = ~runs.singly[order] & ~other.singly
    assert lanes.sum() == 138 and (other.n_steps[lanes] == runs.n_steps[order][lanes]).all()
    assert (other.q[lanes] == runs.q[order][lanes]).all()  # by the same code, in other lanes
    for n_runs in (2, 9):
        few = ensemble(system, SPAN, q[:n_runs], v[:n_runs], parameters=parameters[:n_runs], **options)
        assert (few.q[1:] == runs.q[1:n_runs]).all()


def test_times_at_which_states_are_wanted_change_no_step(made):
    system, q, v, parameters, options, runs = made
    ends = ensemble(system, SPAN, q[:20], v[:20], parameters=parameters[:20], **{**options, "t_eval": None})
    assert ends.t.tolist() == [0.0, 2.0] and (ends.q[:, :, 0] == q[:20]).all()
    assert (ends.n_steps[1:] == runs.n_steps[1:20]).all()
    assert np.abs(ends.q[1:, :, 1] - runs.q[1:20, :, -1]).max() < 1e-13


# stiff ensembles


def springs(n_runs):
    """A mass on a circle, and one hung on it by a stiff spring with a damper: stiffness, damping and length vary."""
    random = np.random.default_rng(1)
    p = np.column_stack([10.0 ** random.uniform(5, 6, n_runs), 10.0 ** random.uniform(1, 3, n_runs)])
    p = np.column_stack([p, random.uniform(0.8, 1.2, n_runs)])

    def force(t, q, v, p):
        x, y = q[2] - q[0], q[3] - q[1]
        length = (x * x + y * y) ** 0.5
        pull = (p[0] * (length - p[2]) + p[1] * ((x * (v[2] - v[0]) + y * (v[3] - v[1])) / length)) / length
        return np.array([pull * x, pull * y - 9.81, -pull * x, -pull * y - 9.81])

    circle = lambda t, q, p: np.array([0.5 * (q[0] ** 2 + q[1] ** 2 - 1.0)])  # noqa: E731
    system = unconstrained(force, 4, n_c=1, constraint=circle, parameters=p[0], name="masses on a stiff spring")
    angle = random.uniform(0.3, 1.2, n_runs)
    bob = np.column_stack([np.sin(angle), -np.cos(angle)])
    return system, np.hstack([bob, bob + p[:, 2:] * np.column_stack([np.sin(0.5 * angle), -np.cos(0.5 * angle)])]), p


def dampers(n_runs):
    """A pendulum in a stream that carries it along, through strong drag."""
    random = np.random.default_rng(2)
    p = np.column_stack([10.0 ** random.uniform(3, 5, n_runs), random.uniform(5.0, 12.0, n_runs)])
    system = pendulum(
        force=lambda t, q, v, p: np.array([-p[0] * (v[0] - np.cos(2.0 * t)), -p[0] * v[1] - p[1]]),
        **{"parameters": p[0], "jacobian": None, "gamma": False, "constant_mass": True, "name": "pendulum in a stream"},
    )
    angle = random.uniform(0.3, 2.0, n_runs)
    return system, np.column_stack([np.sin(angle), -np.cos(angle)]), p


def bushings(n_runs):
    """Two bars, the end of the second held on a line by a stiff bushing: stiffness, damping and a length vary."""
    random = np.random.default_rng(3)
    p = np.column_stack([10.0 ** random.uniform(5, 7, n_runs), 10.0 ** random.uniform(2, 4, n_runs)])
    p = np.column_stack([p, random.uniform(0.9, 1.1, n_runs)])

    def constraint(t, q, p):
        s, c, s2, c2 = np.sin(q[2]), np.cos(q[2]), np.sin(q[5]), np.cos(q[5])
        half = 0.5 * p[2]
        return np.array(
            [q[0] - 0.5 * c, q[1] - 0.5 * s, q[0] + 0.5 * c - q[3] + half * c2, q[1] + 0.5 * s - q[4] + half * s2]
        )

    def force(t, q, v, p):
        lever = 0.5 * p[2] * np.cos(q[5])
        push = -p[0] * (q[4] + 0.5 * p[2] * np.sin(q[5])) - p[1] * (v[4] + lever * v[5])
        return np.array([0.0, -9.81, 5.0, 0.0, -9.81 + push, lever * push])

    masses = np.diag([1.0, 1.0, 1.0 / 12.0] * 2)
    system = ConstrainedSystem.from_python(
        n_q=6, n_c=4, mass=masses, force=force, constraint=constraint, parameters=p[0], name="bars on a bushing"
    )
    first = random.uniform(0.2, 0.6, n_runs)
    second = -np.arcsin(np.sin(first) / p[:, 2])
    half = 0.5 * p[:, 2]
    q = [0.5 * np.cos(first), 0.5 * np.sin(first), first]
    q += [np.cos(first) + half * np.cos(second), np.sin(first) + half * np.sin(second), second]
    return system, np.column_stack(q), p


@pytest.mark.parametrize("make", [springs, dampers, bushings])
@pytest.mark.parametrize(("method", "tolerance"), [("auto", 1e-4), ("RadauIIA9", 1e-7), ("RadauIIA5", 1e-5)])
def test_stiff_runs_are_those_made_singly(make, method, tolerance):
    system, q, p = make(11)
    span, times = (0.0, 0.3), np.linspace(0.0, 0.3, 5)
    options = {"method": method, "rtol": tolerance, "atol": tolerance, "t_eval": times}
    runs = ensemble(system, span, q, np.zeros_like(q), parameters=p, **options)
    assert runs.success.all() and runs.singly.sum() == 1
    for run in (2, 9):
        own = system.with_parameters(p[run])
        known = solve_dae(own, span, q[run], 0 * q[run], method="RadauIIA9", rtol=1e-10, atol=1e-10, t_eval=times)
        assert np.abs(runs.q[run] - known.q).max() < 30.0 * tolerance


def test_stiff_motion_takes_the_implicit_method_that_auto_takes_singly():
    system, q, p = dampers(4)
    runs = ensemble(system, (0.0, 0.3), q, 0 * q, parameters=p, rtol=1e-7, atol=1e-7)
    assert "3 in lanes by RadauIIA9" in runs.message and (runs.n_steps[1:] < 300).all()
    names = {tolerance: lane_methods("auto", True, 2, tolerance, 1.0)[0].name for tolerance in (1e-3, 1e-6, 1e-7)}
    assert list(names.values()) == ["RadauIIA5", "RadauIIA5", "RadauIIA9"]


def test_an_iteration_that_has_ended_in_one_lane_goes_on_in_others_alone():
    system, q, p = springs(17)
    order = np.random.default_rng(5).permutation(17)
    options = {"method": "RadauIIA9", "rtol": 1e-4, "atol": 1e-4, "t_eval": np.linspace(0.0, 3.0, 7)}
    runs = ensemble(system, (0.0, 3.0), q, 0 * q, parameters=p, **options)
    other = ensemble(system, (0.0, 3.0), q[order], 0 * q, parameters=p[order], **options)
    lanes = ~runs.singly[order] & ~other.singly
    apart = np.abs(other.q[lanes] - runs.q[order][lanes]).max(axis=(1, 2))
    # with older versions of LLVM rounding depends on the lane, and with it where an iteration ends
    assert lanes.sum() >= 15 and (apart == 0.0).mean() > 0.5 and apart.max() < 1e-6


@pytest.mark.parametrize("tolerance", [1e-7, 1e-8])
def test_vibrations_that_do_not_matter_are_passed_over_as_singly_and_no_others(tolerance):
    """By the methods of the default, which look at what errors of velocities make of the positions."""
    p = np.column_stack([np.geomspace(1e2, 1e8, 9), np.full(9, 2.0)])
    force = lambda t, q, v, p: np.array([-p[0] * (q[0] - np.sin(40.0 * t)) - p[1] * v[0]])  # noqa: E731
    system = unconstrained(force, parameters=p[0], name="carried along by a spring")
    q, v, atol = np.zeros((9, 1)), np.full((9, 1), 40.0), np.full(1, tolerance)
    lanes = LaneRuns(system, Starts(0.0, q, v, p), lane_methods("auto", True, 1, tolerance, tolerance)[0])
    out = np.empty((2, 9, 1, 1))
    made, n_steps, _, _ = lanes.make(np.arange(9), 4.0, np.array([4.0]), tolerance, atol, 1, *out)
    options = {"method": PRESETS["auto"].tightest, "rtol": tolerance, "atol": tolerance}
    for run in (1, 5, 8):
        alone = solve_dae(system.with_parameters(p[run]), (0.0, 4.0), q[run], v[run], **options)
        assert made[run] == 1 and 130 < 0.9 * alone.stats.n_accepted <= n_steps[run] <= 1.3 * alone.stats.n_accepted
        # the motion itself: errors of single runs come to a hundred tolerances where steps pass over vibrations
        assert abs(out[0, run, 0, 0] - _carried_along(*p[run], 40.0, 4.0)) < 100.0 * tolerance


def _carried_along(k, c, w, t):
    """The solution of x'' = k (sin w t - x) - c x' that begins at 0 with velocity w."""
    size = (k - w * w) ** 2 + (c * w) ** 2
    sine, cosine = k * (k - w * w) / size, -k * c * w / size
    decay, frequency = -0.5 * c, np.sqrt(k - 0.25 * c * c)
    other = (w * (1.0 - sine) + decay * cosine) / frequency
    vibration = other * np.sin(frequency * t) - cosine * np.cos(frequency * t)
    return sine * np.sin(w * t) + cosine * np.cos(w * t) + np.exp(decay * t) * vibration


@pytest.mark.parametrize("name", STAGES)
def test_implicit_methods_in_lanes_are_the_presets(name):
    own, plan = lane_methods(name, False, 5, 1e-6, 1e-7)[0], PRESETS[name].plan(5, 1e-6, 1e-7, False)
    assert np.array_equal(own.options[-plan.options.size :], plan.options)
    assert np.array_equal(own.options[: len(plan.rule)], plan.rule) and own.options[len(plan.rule)] == plan.rough


# what one method cannot do


def test_auto_goes_on_with_dop853_where_series_are_not_finite():
    """Drag from rest: its series has no coefficients there."""

    def force(t, q, v, p):
        return -5.0 * v * np.sqrt(v @ v) - np.array([0.0, p[2]])

    _, q, v, parameters = pendulums(9)
    system = system_of(parameters, mass=np.eye(2), force=force)
    runs = ensemble(system, SPAN, q, v, parameters=parameters)
    assert "8 in lanes by DOP853" in runs.message and "Taylor" not in runs.message
    assert far_from_single_runs(runs, [2, 8], system, SPAN, q, v, parameters) < 1e-6


def test_auto_goes_on_with_dop853_where_series_are_too_long(monkeypatch):
    monkeypatch.setattr("twoloop.generate.lane_code.LARGEST", 3)
    system, q, v, parameters = pendulums(9)
    runs = ensemble(system, SPAN, q, v, parameters=parameters)
    assert "8 in lanes by DOP853" in runs.message
    assert far_from_single_runs(runs, [2, 8], system, SPAN, q, v, parameters) < 1e-6


@pytest.mark.parametrize("method", ["DOP853", "RadauIIA9"])
@pytest.mark.filterwarnings("ignore:invalid value")
def test_a_force_that_ends_is_left_to_single_runs_and_others_are_not(method):
    _, q, v, parameters = pendulums(9)
    parameters[:, 2] = [9.0, 9.0, 9.0, 0.7, 9.0, 9.0, 9.0, 1.3, 9.0]
    system = system_of(
        parameters, mass=np.eye(2), force=lambda t, q, v, p: np.array([np.sqrt(p[2] - t), -9.81]) + 0.0 * v
    )
    runs = ensemble(system, SPAN, q, v, parameters=parameters, method=method, t_eval=TIMES)
    assert np.flatnonzero(runs.singly).tolist() == [0, 3, 7] == [0, *sorted(runs.messages)]
    assert np.isnan(runs.q[[3, 7], :, -1]).all() and runs.success.sum() == 7
    assert runs.reasons.keys() == {0, 3, 7} and "first" in runs.reasons[0]
    assert all("no values" in runs.reasons[run] or "refused" in runs.reasons[run] for run in (3, 7))
    assert all(runs.reasons[run] in runs.message for run in runs.reasons)


@pytest.mark.filterwarnings("ignore:invalid value")
def test_steps_do_not_pass_over_places_without_a_force():
    """A step that meets such a place is refused, and the next ones could pass over it."""
    system = pendulum(force=lambda t, q, v: 0.02 * np.sqrt(0.95 + q[0]) * np.array([-q[1], q[0]]))
    v = np.outer(np.append(0.1, np.geomspace(20.0, 200.0, 8)), [0.0, 1.0])
    runs = ensemble(system, (0.0, 3.0), np.tile([1.0, 0.0], (9, 1)), v, rtol=1e-3, atol=1e-3)
    assert runs.success.tolist() == [True] + 8 * [False]


def test_a_stiff_run_among_others_does_not_go_on_for_ever():
    """By series: its steps are as many as its time scales, and nothing interrupts them."""
    parameters = np.array([[0.1], [1.0], [1e7], [10.0]])
    force = lambda t, q, v, p: np.array([-p[0] * (v[0] - np.cos(2.0 * t))])  # noqa: E731
    system = unconstrained(force, parameters=parameters[0])
    runs = ensemble(system, (0.0, 1.0), np.zeros(1), np.ones(1), parameters=parameters)
    assert runs.singly.tolist() == [True, False, True, False] and "2 in lanes by Taylor" in runs.message
    assert "100,000 steps" in runs.reasons[2] and "run 2: it takes more than 100,000" in runs.message
    assert runs.n_steps[2] < 1000 and abs(runs.q[2, 0, 1] - 0.5 * np.sin(2.0)) < 1e-6


@pytest.mark.parametrize("method", ["DOP853", "RadauIIA5"])
@pytest.mark.filterwarnings("ignore:invalid value")
def test_drives_whose_speed_jumps_are_left_to_single_runs(method):
    """Accelerations see nothing of the impulse, and a projection alone would hide it."""
    parameters = np.array([[0.31], [0.52], [0.43]])

    def away(t, p):
        return np.sqrt((t - p[0]) * (t - p[0]))

    system = ConstrainedSystem.from_python(
        n_q=3,
        n_c=2,
        mass=np.eye(3),
        force=lambda t, q, v, p: np.array([0.0, 0.0, -9.81]),
        constraint=lambda t, q, p: np.array([q[0] - 0.5 * away(t, p), 0.5 * ((q[1] - q[0]) ** 2 + q[2] ** 2 - 1.0)]),
        constraint_rate=lambda t, q, p: np.array([-0.5 * (t - p[0]) / away(t, p), 0.0 * t]),
        gamma=lambda t, q, v, p: np.array([0.0 * t, -((v[1] - v[0]) ** 2) - v[2] ** 2]),
        parameters=parameters[0],
    )
    q = np.column_stack([0.5 * parameters, 0.5 * parameters + 0.6, np.full((3, 1), -0.8)])
    runs = ensemble(system, (0.0, 0.4), q, np.full((3, 3), [-0.5, -0.5, 0.0]), parameters=parameters, method=method)
    assert runs.singly.tolist() == [True, False, False]
    runs = ensemble(system, (0.0, 0.8), q, np.full((3, 3), [-0.5, -0.5, 0.0]), parameters=parameters, method=method)
    assert runs.singly.all()


@pytest.mark.parametrize(
    ("name", "method"),
    [
        ("driven_slider_crank", "auto"),
        ("redundant_slider_crank", "auto"),
        ("redundant_slider_crank", "DOP853"),
        ("andrews", "RadauIIA9"),
        ("heavy_top", "RadauIIA5"),
        ("n_four_bar", "DOP853"),
    ],
)
def test_mechanisms(name, method):
    problem = getattr(mechanisms, name)()
    span = (0.0, 0.01 if name == "andrews" else 0.3)
    spread = 0.0 if name == "driven_slider_crank" else 0.1  # a drive allows one velocity
    v = problem.v0 * np.linspace(1.0 - spread, 1.0 + spread, 9)[:, None]
    q = np.tile(problem.q0, (9, 1))
    with pytest.warns(ConstraintWarning) if "redundant" in name else nullcontext():
        runs = ensemble(problem.system, span, q, v, method=method, rtol=1e-8, atol=1e-8)
        known = solve_dae(problem.system, span, q[4], v[4], method="DOP853", rtol=1e-11, atol=1e-11)
    assert runs.singly.sum() == 1 and np.abs(runs.q[4, :, -1] - known.q[:, -1]).max() < 1e-6


@pytest.mark.parametrize("method", ["auto", "DOP853", "RadauIIA9"])
def test_runs_through_a_singular_position_are_made_singly(method):
    problem, span = mechanisms.n_four_bar(), (0.0, 2.0)
    runs = ensemble(problem.system, span, np.tile(problem.q0, (3, 1)), problem.v0, method=method)
    known = solve_dae(problem.system, span, problem.q0, problem.v0)
    assert runs.singly.all() and np.abs(runs.q[:, :, -1] - known.q[:, -1]).max() < 1e-6
    assert runs.reasons[1] == runs.reasons[2] and f"2 runs (1, 2): {runs.reasons[1]}" in runs.message
    assert "lose rank" in runs.reasons[1] or "singular position" in runs.reasons[1]


# long steps


def test_auto_takes_stages_where_a_series_takes_many_operations():
    """Of the heavy top, down to a tolerance; not of Andrews' mechanism, the length of whose spring is a root."""
    involved = {name: is_involved(getattr(mechanisms, name)().system) for name in ("heavy_top", "andrews", "four_bar")}
    assert involved == {"heavy_top": True, "andrews": False, "four_bar": False}
    names = {tol: [m.name for m in lane_methods("auto", False, 7, tol, 1.0, True)] for tol in (1e-4, 1e-10)}
    assert names == {1e-4: ["DOP853", "Taylor"], 1e-10: ["Taylor", "DOP853"]}


def test_no_hundredth_of_a_run_is_without_a_stage_of_a_long_step():
    system, q, v, parameters = pendulums(4)
    runs = ensemble(system, (0.0, 1e-3), q, v, parameters=parameters, method="DOP853", rtol=1e-3, atol=1e-3)
    assert runs.singly.sum() == 1 and (runs.n_steps[1:] >= 27).all() and (runs.n_steps[1:] <= 40).all()


def test_long_steps_stay_on_their_assembly():
    """Four-bars near a change of assembly, at a loose tolerance, end where series at a tight one have them end."""
    made, random = [], np.random.default_rng(17)
    while len(made) < 120:
        lengths = random.uniform(0.8, 1.5), random.uniform(1.0, 2.0), random.uniform(0.8, 1.6)
        ground = lengths[0] + lengths[1] - lengths[2] + 10.0 ** random.uniform(-6, -2) * random.choice((-1, 1))
        try:
            made.append(mechanisms.four_bar(lengths, ground, random.uniform(-1.0, 1.0), int(random.choice((-1, 1)))))
        except ValueError:
            continue
    q, v, p = (
        np.array([get(m) for m in made]) for get in (lambda m: m.q0, lambda m: m.v0, lambda m: m.system.parameters)
    )
    ends = {}
    for method, tolerance in (("Taylor", 1e-11), ("DOP853", 1e-4)):
        runs = ensemble(made[0].system, (0.0, 4.0), q, v, parameters=p, rtol=tolerance, atol=tolerance, method=method)
        ends[method] = runs.q[:, :, -1]
    assert runs.success.all() and (~runs.singly).sum() > 90
    off = np.abs(ends["DOP853"] - ends["Taylor"]).max(axis=1)
    assert (off < 0.1).all() and np.median(off) < 1e-3


@pytest.mark.parametrize("name", ["andrews", "four_bar", "redundant_slider_crank"])
@pytest.mark.parametrize("method", ["Taylor", "DOP853", "RadauIIA5"])
def test_numbers_of_code_are_known_before_it_is_written(name, method):
    """Code that comes from the disk is not written again: it would read numbers that are not there."""
    problem = getattr(mechanisms, name)()
    starts = Starts(0.0, problem.q0[None], problem.v0[None], problem.system.parameters[None])
    code = LaneRuns(problem.system, starts, lane_methods(method, False, problem.system.n_q, 1e-6, 1e-6)[0]).own
    known = len(code.code.numbers.values), code.code.n_numbers
    code._write()
    assert (len(code.code.numbers.values), code.code.numbers.n_varying) == known
