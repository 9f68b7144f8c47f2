"""Test ensembles in SIMD lanes: runs are what they are alone, whatever the lanes, threads and order, or run alone."""

import signal
from contextlib import nullcontext

import numpy as np
import pytest

from tests.compiled import PENDULUM, circle_of_length, heavy
from tests.marks import slow
from tests.problems import event, pendulum, pendulum_state, unconstrained
from twoloop import ConstrainedSystem, ConstraintWarning, Status, callback, ensemble, mechanisms, solve_dae
from twoloop.ensembles.lanes import lane_methods

SPAN, TOLERANCE = (0.0, 2.0), 1e-8
TIMES = np.sort(np.concatenate([np.linspace(*SPAN, 9), [1e-4, 0.501, 0.5011, 1.99999]]))


# --- pendulums, each with parameters and a start of its own
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


@pytest.fixture(autouse=True)
def builds(monkeypatch):
    """Lanes are compiled however few runs there are."""
    monkeypatch.setattr("twoloop.ensembles.ensemble.CALL", 1e9)


@pytest.fixture(scope="module", params=["auto", *(slow(name) for name in ("DOP853", "RadauIIA9", "RadauIIA13"))])
def made(request):
    system, q, v, parameters = pendulums(140)
    options = {"method": request.param, "rtol": TOLERANCE, "atol": TOLERANCE, "t_eval": TIMES}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("twoloop.ensembles.ensemble.CALL", 1e9)
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
    C = 0.5 * ((runs.q**2).sum(axis=1) - parameters[:, 1:2] ** 2)  # every state is on its own constraints
    assert np.abs(C).max() < 1e-13 and np.abs((runs.q * runs.v).sum(axis=1)).max() < 1e-12


def test_steps_are_as_many_as_those_of_single_runs(made):
    system, q, v, parameters, options, runs = made
    for run in (3, 60):
        n_steps = solve_dae(system.with_parameters(parameters[run]), SPAN, q[run], v[run], **options).stats.n_accepted
        longer = 4.0 / 15.0 if options["method"] == "DOP853" else 1.0  # stages look at the equations, too
        assert 0.9 * longer * n_steps <= runs.n_steps[run] <= 1.5 * n_steps


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
    settings = {**options, "t_eval": None, "parameters": parameters[:20]}
    ends, far = (ensemble(system, (t0, t0 + 2.0), q[:20], v[:20], **settings) for t0 in (0.0, 1.7e9))
    assert ends.t.tolist() == [0.0, 2.0] and (ends.q[:, :, 0] == q[:20]).all()
    assert (ends.n_steps[1:] == runs.n_steps[1:20]).all() and np.abs(far.q - ends.q)[1:, :, 1].max() < 50.0 * TOLERANCE
    assert np.abs(ends.q[1:, :, 1] - runs.q[1:20, :, -1]).max() < 1e-13


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


STIFF = [(springs, "auto", 1e-4), slow(dampers, "auto", 1e-4)]
STIFF += [slow(dampers, "RadauIIA9", 1e-7), slow(springs, "RadauIIA5", 1e-5)]


@pytest.mark.parametrize(("make", "method", "tolerance"), STIFF)
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


@pytest.mark.slow  # the kernel of implicit methods in lanes is compiled for slow tests alone
def test_stiff_motion_takes_the_implicit_method_that_auto_takes_singly():
    system, q, p = dampers(4)
    runs = ensemble(system, (0.0, 0.3), q, 0 * q, parameters=p, rtol=1e-7, atol=1e-7)
    assert "3 in lanes by RadauIIA9" in runs.message and (runs.n_steps[1:] < 300).all()
    names = {tolerance: lane_methods("auto", True, 2, tolerance, 1.0)[0].name for tolerance in (1e-3, 1e-6, 1e-7)}
    assert list(names.values()) == ["RadauIIA5", "RadauIIA5", "RadauIIA9"]


def test_auto_goes_on_with_dop853_where_series_are_not_finite():
    """Drag from rest: its series has no coefficients there."""
    force = lambda t, q, v, p: -5.0 * v * np.sqrt(v @ v) - np.array([0.0, p[2]])  # noqa: E731
    _, q, v, parameters = pendulums(9)
    system = system_of(parameters, mass=np.eye(2), force=force)
    runs = ensemble(system, SPAN, q, v, parameters=parameters)
    assert "8 in lanes by DOP853" in runs.message and "Taylor" not in runs.message
    assert far_from_single_runs(runs, [2, 8], system, SPAN, q, v, parameters) < 1e-6


@pytest.mark.parametrize("method", ["DOP853", slow("RadauIIA9")])
@pytest.mark.filterwarnings("ignore:invalid value")
def test_a_force_that_ends_is_left_to_single_runs_and_others_are_not(method):
    _, q, v, parameters = pendulums(9)
    parameters[:, 2] = [9.0, 9.0, 9.0, 0.7, 9.0, 9.0, 9.0, 1.3, 9.0]
    force = lambda t, q, v, p: np.array([np.sqrt(p[2] - t), -9.81]) + 0.0 * v  # noqa: E731
    system = system_of(parameters, mass=np.eye(2), force=force)
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


@pytest.mark.parametrize("method", ["DOP853", slow("RadauIIA5")])
@pytest.mark.filterwarnings("ignore:invalid value")
def test_drives_whose_speed_jumps_are_left_to_single_runs(method):
    """Accelerations see nothing of the impulse, and a projection alone would hide it."""
    parameters = np.array([[0.31], [0.52], [0.43]])
    away = lambda t, p: np.sqrt((t - p[0]) * (t - p[0]))  # noqa: E731
    system = unconstrained(
        lambda t, q, v, p: np.array([0.0, 0.0, -9.81]),
        **{"n_q": 3, "n_c": 2, "parameters": parameters[0]},
        constraint=lambda t, q, p: np.array([q[0] - 0.5 * away(t, p), 0.5 * ((q[1] - q[0]) ** 2 + q[2] ** 2 - 1.0)]),
        constraint_rate=lambda t, q, p: np.array([-0.5 * (t - p[0]) / away(t, p), 0.0 * t]),
        gamma=lambda t, q, v, p: np.array([0.0 * t, -((v[1] - v[0]) ** 2) - v[2] ** 2]),
    )
    q = np.column_stack([0.5 * parameters, 0.5 * parameters + 0.6, np.full((3, 1), -0.8)])
    runs = ensemble(system, (0.0, 0.4), q, np.full((3, 3), [-0.5, -0.5, 0.0]), parameters=parameters, method=method)
    assert runs.singly.tolist() == [True, False, False]
    runs = ensemble(system, (0.0, 0.8), q, np.full((3, 3), [-0.5, -0.5, 0.0]), parameters=parameters, method=method)
    assert runs.singly.all()


NAMED = [slow("driven_slider_crank", "auto"), slow("redundant_slider_crank", "auto"), slow("andrews", "RadauIIA9")]
NAMED += [("redundant_slider_crank", "DOP853"), slow("heavy_top", "RadauIIA5"), slow("n_four_bar", "DOP853")]


@pytest.mark.parametrize(("name", "method"), NAMED)
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


@pytest.mark.parametrize("method", ["DOP853", slow("auto"), slow("RadauIIA9")])
def test_runs_through_a_singular_position_are_right_and_say_if_they_were_made_singly(method):
    problem, span = mechanisms.n_four_bar(), (0.0, 2.0)
    runs = ensemble(problem.system, span, np.tile(problem.q0, (3, 1)), problem.v0, method=method)
    known = solve_dae(problem.system, span, problem.q0, problem.v0)
    assert runs.success.all() and np.abs(runs.q[:, :, -1] - known.q[:, -1]).max() < 1e-6
    if method == "auto" and not runs.singly[1]:  # on wide lanes it takes Taylor, whose series reach beyond the position
        return
    assert runs.singly.all()
    assert runs.reasons[1] == runs.reasons[2] and f"2 runs (1, 2): {runs.reasons[1]}" in runs.message
    assert "lose rank" in runs.reasons[1] or "singular position" in runs.reasons[1]


def test_long_steps_stay_on_their_assembly():
    """Four-bars near a change of assembly, at a loose tolerance, end where series at a tight one have them end."""
    made, random = [], np.random.default_rng(17)
    while len(made) < 60:
        lengths = random.uniform(0.8, 1.5), random.uniform(1.0, 2.0), random.uniform(0.8, 1.6)
        ground = lengths[0] + lengths[1] - lengths[2] + 10.0 ** random.uniform(-6, -2) * random.choice((-1, 1))
        try:
            made.append(mechanisms.four_bar(lengths, ground, random.uniform(-1.0, 1.0), int(random.choice((-1, 1)))))
        except ValueError:
            continue
    q, v, p = (np.array(each) for each in zip(*((m.q0, m.v0, m.system.parameters) for m in made), strict=True))
    ends = {}
    for method, tolerance in (("Taylor", 1e-11), ("DOP853", 1e-4)):
        runs = ensemble(made[0].system, (0.0, 4.0), q, v, parameters=p, rtol=tolerance, atol=tolerance, method=method)
        ends[method] = runs.q[:, :, -1]
    assert runs.success.all() and (~runs.singly).sum() > 45
    off = np.abs(ends["DOP853"] - ends["Taylor"]).max(axis=1)
    assert (off < 0.1).all() and np.median(off) < 1e-3


def test_one_start_serves_all_parameters_and_one_set_of_parameters_all_starts():
    problem = mechanisms.four_bar()
    system, start = problem.system, (problem.q0, problem.v0)
    runs = ensemble(system, (0.0, 0.5), np.tile(start[0], (9, 1)), start[1])
    known = solve_dae(system, (0.0, 0.5), *start, rtol=1e-11, atol=1e-11)
    assert runs.singly.sum() == 1 and np.abs(runs.q[:, :, -1] - known.q[:, -1]).max() < 1e-7
    assert len(ensemble(system, (0.0, 0.1), *start, parameters=np.tile(system.parameters, (3, 1)))) == 3
    assert len(ensemble(system, (0.0, 0.1), *start)) == 1


BRANCHING = {
    "a branch": lambda t, q, v, p: np.array([0.0, -9.81 if q[0] > 0.5 else -p[2]]),
    "a number made of a parameter": lambda t, q, v, p: np.array([0.0, -float(p[2])]),
    "a branch on a parameter": lambda t, q, v, p: np.array([0.0, -p[2] if p[2] < 8.0 else -5.0]),
    "a parameter rounded": lambda t, q, v, p: np.array([0.0, -np.round(p[2])]),
}


UNSEEN = [("a branch", False), slow("a branch", True), slow("a number made of a parameter", False)]
UNSEEN += [slow(case, False) for case in ("a branch on a parameter", "a parameter rounded")]


@pytest.mark.parametrize(("case", "compiled"), UNSEEN)
def test_what_lanes_cannot_see_is_found_and_made_singly(case, compiled):
    q, v, parameters = drawn(8)
    system = system_of(parameters, mass=np.eye(2), force=BRANCHING[case], compile=compiled)
    runs = ensemble(system, (0.0, 1.0), q, v, parameters=parameters)
    assert runs.success.all() and far_from_single_runs(runs, range(8), system, (0.0, 1.0), q, v, parameters) < 1e-6
    assert runs.reasons.keys() == set(np.flatnonzero(runs.singly)) and all(runs.reasons.values())


@pytest.mark.parametrize("compiled", [False, slow(True)])
def test_one_run_of_many_that_is_unlike_the_others_is_found(compiled):
    """A branch on a parameter, for which there are no formulas, and a parameter that only one run has otherwise."""
    n_runs, one = 20, 17
    q, v, parameters = drawn(n_runs)
    parameters[:, 0], parameters[:, 2] = 1.0, 9.0
    parameters[one] = 2.0, parameters[one, 1], 20.0
    force = lambda t, q, v, p: np.array([p[0] - 3.0, -p[2] if p[2] < 15.0 else -3.0])  # noqa: E731
    # and no jacobian: it is derived
    system = system_of(parameters, mass=np.eye(2), force=force, jacobian=None, compile=compiled)
    runs = ensemble(system, (0.0, 0.5), q, v, parameters=parameters)
    assert runs.singly.all() and far_from_single_runs(runs, [5, one], system, (0.0, 0.5), q, v, parameters) < 1e-6


def test_what_cannot_go_in_lanes_says_why():
    system, q, v, parameters = pendulums(3)
    knife = mechanisms.knife_edge()
    runs = ensemble(knife.system, (0.0, 0.1), np.tile(knife.q0, (2, 1)), knife.v0)
    assert runs.singly.all() and "nonholonomic" in runs.message and "nonholonomic" in runs.reasons[1]
    runs = ensemble(system, (0.0, 0.1), q, v, parameters=parameters, method="Adams")
    assert runs.singly.all() and "Adams does not go in lanes" in runs.message
    runs = ensemble(system, SPAN, q, v, parameters=parameters, events=event(lambda t, q, v: q[1] + 0.2, terminal=True))
    assert runs.singly.all() and "events" in runs.message and (runs.status == Status.EVENT).any()
    assert np.isnan(runs.q[runs.status == Status.EVENT][:, :, -1]).all()


@pytest.mark.parametrize(("method", "by_state"), [slow("auto", False), slow("DOP853", False), ("auto", True)])
def test_what_is_narrow_and_acts_in_later_runs_alone_is_seen(method, by_state):
    """Of the first run, whose factor is zero, nothing tells that there is something."""

    def force(t, q, v, p):
        x = (q[0] - 0.1234) / 3e-3 if by_state else (t - 0.4321) / 3e-4
        return np.array([0.0, p[0] - 9.81 + p[2] * np.exp(-x * x)])

    q, v, parameters = drawn(9)
    parameters[:, 2] = np.linspace(0.0, 300.0 if by_state else 500.0, 9)
    system = system_of(parameters, mass=np.eye(2), force=force, compile=True)
    runs = ensemble(system, SPAN, q, v, parameters=parameters, method=method)
    assert far_from_single_runs(runs, [0, 4, 8], system, SPAN, q, v, parameters, max_step=5e-4) < 1e-5


def test_a_lane_that_fails_says_what_a_single_run_says():
    q, v, _ = pendulum_state(0.0)
    system = pendulum(force=lambda t, q, v: np.array([0.0, -9.81 - 1e3 * np.sqrt(0.5 - t)]))
    runs = ensemble(system, (0.0, 1.0), np.tile(q, (3, 1)), v)
    assert (runs.status < 0).all() and not runs.success.any() and np.isnan(runs.q[:, :, -1]).all()
    assert set(runs.messages) == {0, 1, 2} and "0 of 3 runs" in runs.message


def test_ctrl_c_ends_all_runs_and_not_one(interruptible):
    q, v, parameters = drawn(6)
    begun = []

    def force(t, q, v, p):
        if t > 0.1:
            begun.append(p[2])
            if p[2] == parameters[2, 2]:
                signal.raise_signal(signal.SIGINT)
        return np.array([0.0, -9.81])

    with pytest.raises(KeyboardInterrupt):
        ensemble(system_of(parameters, force=force), SPAN, q, v, parameters=parameters)
    assert set(begun) == set(parameters[:3, 2])


@pytest.mark.slow  # it takes the time of its limit
@pytest.mark.parametrize("branches", [False, True])
def test_a_run_that_does_not_end_takes_no_time_of_others(branches):
    """Some springs are so stiff that their runs take hours; in lanes, and one at a time."""
    force = lambda t, q, v, p: -p * q if not branches or q[0] < 10.0 else q  # noqa: E731
    stiff = np.full((30, 1), 2.0)
    stiff[[4, 11]] = 7e9
    system = unconstrained(force, parameters=[2.0])
    runs = ensemble(system, (0.0, 9.0), np.ones((30, 1)), [0.0], parameters=stiff, t_eval=[0.0, 9.0], time_limit=8.0)
    assert set(np.flatnonzero(runs.status == Status.TIME_LIMIT)) >= {4, 11} and runs.success.sum() > 20
    np.testing.assert_allclose(runs.q[runs.success, 0, -1], np.cos(9.0 * np.sqrt(2.0)), atol=1e-6)
    assert (runs.q[:, 0, 0] == 1.0).all() and "time_limit" in runs.messages[4]


def test_a_first_run_that_does_not_end_is_begun_once(monkeypatch):
    begun, system = [], unconstrained(lambda t, q, v: -1e13 * q)

    def solve(system, span, q, *rest, **options):
        return begun.append(q[0]) or solve_dae(system, span, q, *rest, **options)

    monkeypatch.setattr("twoloop.ensembles.ensemble.solve_dae", solve)
    for starts in ([[5.0]], [[5.0], [7.0]]):
        runs = ensemble(system, (0.0, 9.0), starts, [0.0], method="Gauss8", time_limit=0.3)
        assert (runs.status == Status.TIME_LIMIT).all() and (runs.q[:, 0, 0] == np.ravel(starts)).all()
    assert begun.count(5.0) == 2
