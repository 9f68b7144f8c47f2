"""What is kept between calls changes nothing, and lets nothing wrong pass."""

from dataclasses import replace
from functools import partial
from itertools import chain

import numpy as np
import pytest

from tests.problems import pendulum
from twoloop import ConstrainedSystem, callback, mechanisms, solve_dae
from twoloop.checks.consistency import check_start
from twoloop.generate.choices import Choice
from twoloop.generate.exact_derivatives import Territory, exact_derivatives, generic_states
from twoloop.generate.families import family_of
from twoloop.generate.straight_code import SharedCode
from twoloop.generate.straight_line import StraightLine
from twoloop.generate.traced_values import unchecked
from twoloop.kernels.layout import _free
from twoloop.methods.plans_for import MOST, plans_for
from twoloop.methods.presets import PRESETS
from twoloop.run import comparison

OFF_ROUNDING = ("bricard", "redundant_slider_crank", "closed_chain", "spatial_slider_crank", "spatial_four_bar")


@pytest.mark.parametrize("name", OFF_ROUNDING)
@pytest.mark.filterwarnings("ignore::twoloop.ConstraintWarning")
def test_what_starts_have_shown_lets_no_other_start_pass(name):
    """The size of coordinates that a start has shown spares the next a closer look, which would say the same."""
    problem = mechanisms.closed_chain(4) if name == "closed_chain" else getattr(mechanisms, name)()
    known, times = problem.system, [0.0, 1e-6, 0.1, 0.2]  # near some starts rows are short by their position
    motion = solve_dae(known, (0.0, 0.2), problem.q0, problem.v0, t_eval=times)
    for k in range(4):
        check_start(known, motion.t[k], motion.q[:, k], motion.v[:, k])
    generic, refused = np.random.default_rng(5), []
    for size in 10.0 ** np.arange(-17, -4):
        off = size * generic.standard_normal(known.n_q) * (generic.random(known.n_q) < 0.3)
        for k in range(4):
            said = []
            for system in (known, known.with_parameters(known.parameters)):
                try:
                    check_start(system, motion.t[k], motion.q[:, k] + off, motion.v[:, k], derivatives=False)
                    said.append("")
                except ValueError as error:
                    said.append(str(error))
            assert said[0] == said[1]
            refused.append(bool(said[0]))
    assert 0 < sum(refused) < len(refused)


@callback("constraint")
def on_a_drawn_in_string(t, q, p, C):
    C[0] = q[0] ** 2 + q[1] ** 2 - q[2] ** 2


@callback("jacobian")
def of_a_drawn_in_string(t, q, p, Cq):
    Cq[0, 0], Cq[0, 1], Cq[0, 2] = 2.0 * q[0], 2.0 * q[1], -2.0 * q[2]


@callback("mass")
def three_equal_masses(t, q, p, M):
    M[0, 0] = M[1, 1] = M[2, 2] = 1.0


@callback("force")
def no_force(t, q, v, p, Q):
    pass


@pytest.mark.parametrize("length", [1e-6, 1e-4, 1e-2, 1.0, 1e5])
def test_what_a_start_of_a_large_mechanism_has_shown_lets_no_start_of_a_small_one_pass(length):
    """The length of a string is a coordinate: rounding of a long one is far beyond what a short one may be off."""
    callbacks = {"constraint": on_a_drawn_in_string, "jacobian": of_a_drawn_in_string, "force": no_force}
    system = ConstrainedSystem(n_q=3, n_c=1, mass=three_equal_masses, constant_mass=True, **callbacks)
    for angle in (0.3, 0.31, 0.32):  # off by more than rounding: so sizes are found
        start = 1e6 * np.array([np.cos(angle) * (1.0 + 3e-13), np.sin(angle), 1.0])
        assert solve_dae(system, (0.0, 1e-3), start, np.zeros(3)).success
    assert "sizes" in system.made
    for off in (1e-7, 1e-5):
        with pytest.raises(ValueError, match="q0 is not consistent"):
            solve_dae(
                system, (0.0, 1e-3), length * np.array([np.cos(0.3) * (1.0 + off), np.sin(0.3), 1.0]), np.zeros(3)
            )


@callback("constraint")
def of_a_small_crank(t, q, p, C):
    C[0], C[1] = q[0] - 1e-6 * np.cos(q[2] - 1e4), q[1] - np.sin(q[2] - 1e4)


@callback("jacobian")
def turned(t, q, p, Cq):
    Cq[0, 0], Cq[0, 2] = 1.0, 1e-6 * np.sin(q[2] - 1e4)
    Cq[1, 1], Cq[1, 2] = 1.0, -np.cos(q[2] - 1e4)


def test_what_is_shown_where_an_entry_vanishes_lets_no_start_pass_where_it_does_not():
    """At a dead centre C_q does not tell the micrometres of the first coordinate from the 1e4 rad of the last."""
    callbacks = {"constraint": of_a_small_crank, "jacobian": turned, "force": no_force, "mass": three_equal_masses}

    def refused(system, angle, off):
        start = np.array([1e-6 * np.cos(angle) * (1.0 + off), np.sin(angle), 1e4 + angle])
        try:
            check_start(system, 0.0, start, np.zeros(3))
        except ValueError:
            return True
        return False

    known = ConstrainedSystem(n_q=3, n_c=2, constant_mass=True, **callbacks)
    assert not refused(known, 1e-9, 1e-9)
    assert "sizes" in known.made
    places = [(angle, off) for angle in (1e-9, 1e-3, 0.3, 1.0) for off in (1e-7, 1e-6, 1e-5, 1e-4)]
    assert all(refused(known, *place) for place in places)


WAYS = [
    *({}, {"rtol": 1e-5}, {"compiled": False, "rtol": 1e-5}, {"max_step": 0.01, "max_steps": 5}),
    *({"method": name, "dense_output": True} for name in ("auto", "Taylor", "DOP853", "Adams", "Gauss8", "BDF")),
    *({"method": name, "dense_output": True} for name in ("RadauIIA5", "RadauIIA9", "TRBDF2")),
]
SIZES = {"closed_chain": (20,), "n_four_bar": (2,)}
EVERY = ("four_bar", "redundant_slider_crank", "heavy_top", "knife_edge", "driven_crank", "spatial_four_bar")
EVERY += ("spatial_slider_crank", *SIZES)


def told(result):
    """All that a result says but its time."""
    arrays = [getattr(result, part) for part in ("t", "q", "v", "a", "lam")]
    if result.sol is not None:
        arrays.append(result.sol(np.linspace(result.t[0], result.t[-1], 20)).q)
    counts = replace(result.stats, cpu_time=0.0)
    return [array.tobytes() for array in arrays], result.message, result.rank, result.widest_gap, counts


@pytest.mark.parametrize("name", EVERY)
@pytest.mark.filterwarnings("ignore::twoloop.ConstraintWarning")
def test_a_call_is_that_of_a_new_system_whatever_was_called_before(name):
    """The same call again, to other ends, from other starts, in used workspaces; and no later call changes a result."""
    make = partial(getattr(mechanisms, name), *SIZES.get(name, ()))
    problem = make()
    motion = solve_dae(problem.system, (0.0, 0.2), problem.q0, problem.v0, t_eval=[0.0, 0.1, 0.2])

    def call(system, k, span, options):
        t = float(motion.t[k])
        return solve_dae(system, (t, t + span), motion.q[:, k].copy(), motion.v[:, k].copy(), **options)

    for options in WAYS[EVERY.index(name) % 2 :: 2]:
        calls, results = [(0, 0.05), (0, 0.05), (0, 0.05), (0, 0.03), (1, 0.05), (2, 0.05), (1, 0.05)], []
        new = {each: told(call(make().system, *each, options)) for each in calls}
        for each in calls:
            results.append((each, call(problem.system, *each, options)))
            for work in chain.from_iterable(_free.values()):
                work.notes.base[:], work.counters.base[:] = np.nan, 10**6  # whatever a run has left
        for each, result in results:
            assert told(result) == new[each], (options, each)


@pytest.mark.parametrize("options", [{}, {"t_eval": [10.0]}, {"t_eval": [2.5, 8.0]}, {"dense_output": True}], ids=str)
@pytest.mark.parametrize("given", [(1,), (2, "bodies")], ids=str)
@pytest.mark.filterwarnings("ignore::twoloop.ConstraintWarning")
def test_a_call_that_crosses_singular_positions_is_that_of_a_new_system(given, options):
    def call(system, state):
        return solve_dae(system, (float(state.t), 10.0), state.q, state.v, rtol=1e-7, atol=1e-7, **options)

    problem = mechanisms.n_four_bar(*given)
    solution = solve_dae(problem.system, (0.0, 1e-3), problem.q0, problem.v0, dense_output=True).sol
    states = [solution(t) for t in (0.0, 2e-4, 4e-4, 6e-4, 8e-4, 9e-4, 1e-3)]
    results = [call(problem.system, state) for state in states]  # later ones change none of these
    new = [call(mechanisms.n_four_bar(*given).system, state) for state in states]
    assert list(map(told, results)) == list(map(told, new))
    assert sum("singular value" in result.message for result in results) > 2


def test_plans_are_kept_for_few_tolerances():
    problem = mechanisms.pendulum()
    for k in range(2 * MOST):
        solve_dae(problem.system, (0.0, 1.0), problem.q0, problem.v0, rtol=1e-6 * (1.0 + k))
    assert len(problem.system.made["plans"]) == MOST


STATE = (0.3, np.array([0.6, -0.8]), np.array([0.8, 0.6]))


def test_right_derivatives_are_those_of_what_was_traced():
    problem = mechanisms.spatial_slider_crank()
    exact = exact_derivatives(problem.system)
    states = generic_states([(0.0, problem.q0, problem.v0), (0.4, 1.01 * problem.q0, problem.v0)])
    assert exact.wrong(problem.system, states) is None


WRONG = {
    "jacobian": lambda t, q: (q + np.array([1e-4 * t * t, 0.0])).reshape((1, 2)),
    "constraint_rate": lambda t, q: np.array([1e-4 * t * t]),
    "gamma": lambda t, q, v: np.array([-(1.0 + 1e-4 * t * t) * (v[0] * v[0] + v[1] * v[1])]),
}


@pytest.mark.parametrize("kind", list(WRONG))
def test_an_error_that_is_nothing_at_the_start_is_seen_later(kind):
    system = pendulum(**{kind: WRONG[kind]})
    exact = exact_derivatives(system)
    assert exact.wrong(system, generic_states([(0.0, *STATE[1:])])) is None
    assert exact_derivatives(pendulum()).wrong(pendulum(), generic_states([STATE])) is None
    assert f"{kind} of" in exact.wrong(system, generic_states([STATE]))
    result = solve_dae(system, (0.0, 1.0), [0.6, -0.8], [0.0, 0.0], rtol=1e-6, atol=1e-6)
    assert result.status.name == "WRONG_DERIVATIVE" and f"{kind} of" in result.message


def test_a_run_that_goes_where_none_was_is_compared_there():
    """A gamma that is wrong from 1 s on, which has no kink that could be seen before."""

    def gamma(t, q, v):
        return np.array([-(v[0] * v[0] + v[1] * v[1]) * (1.0 + 1e-5 * max(t - 1.0, 0.0) ** 3)])

    def end(t1):
        return solve_dae(system, (0.0, t1), [0.6, -0.8], [0.0, 0.0], "DOP853", 1e-8, 1e-8).status.name

    system = pendulum(compile=True, gamma=gamma)
    assert [end(0.9) for _ in range(4)] == ["REACHED_END"] * 4 and end(4.0) == "WRONG_DERIVATIVE"
    assert end(4.0) == "WRONG_DERIVATIVE"  # what was wrong is not taken in


@pytest.mark.parametrize("make", [mechanisms.pendulum, mechanisms.double_pendulum])
def test_runs_along_one_motion_are_soon_compared_no_more(make, monkeypatch):
    """Turning points may lie between the states of a sample, and beyond all that were compared."""
    problem, looked, many = make(), [], 200
    solution = solve_dae(problem.system, (0.0, 0.1), problem.q0, problem.v0, dense_output=True).sol
    known = Territory.without_known
    monkeypatch.setattr(Territory, "without_known", lambda self, states: looked.append(1) or known(self, states))
    for t in np.linspace(0.0, 1e-4, many):
        state = solution(t)
        solve_dae(problem.system, (t, t + problem.reference.t), state.q, state.v, rtol=1e-6, atol=1e-6)
    assert len(looked) < many // 4  # without the turning points it is nearly every run
    looked.clear()
    state = solution(0.1)
    solve_dae(problem.system, (0.0, problem.reference.t), state.q, 9.0 * state.v, rtol=1e-6, atol=1e-6)
    assert looked  # at much higher speeds


def test_the_box_of_a_session():
    near, far = np.array([[0.0, 1.0], [1.0, 2.0]]), np.array([[0.5, 3.0], [0.5, 1.5]])
    territory = Territory()
    looked = []
    for _ in range(9):
        looked.append(territory.is_due() or len(territory.without_known(near)) > 0)
        territory.count()
        territory.add(near)
    assert [k + 1 for k, anew in enumerate(looked) if anew] == [1, 2, 4, 8]
    assert np.array_equal(territory.without_known(far), far[:1])
    assert len(territory.without_known(far[:1] - [0.0, 0.98])) and not len(
        territory.without_known(far[:1] - [0.0, 0.995])
    )
    territory.add(far[:1])
    assert not len(territory.without_known(np.array([[0.7, 2.5]])))


def test_a_box_that_grows_by_little_is_compared_in_the_end():
    territory, compared = Territory(), []
    territory.add(np.array([[0.0, 0.0], [1.0, 1.0]]))
    for t in np.linspace(1.0, 1.1, 101):
        new = territory.without_known(np.array([[t, 0.5]]))
        territory.add(new)
        compared += new[:, 0].tolist()
    assert np.allclose(np.diff([1.0, *compared]), 0.011, atol=0.002) and len(compared) > 8


def test_every_start_that_is_not_the_last_is_checked(monkeypatch):
    looked = []
    monkeypatch.setattr("twoloop.run.launch.check_start", lambda *given, **options: looked.append(given[2].copy()))
    problem = mechanisms.pendulum()
    starts = [sign * problem.q0 for sign in (1, 1, -1, 1, -1, -1, 1)]
    for q0 in starts:
        solve_dae(problem.system, (0.0, 0.1), q0, problem.v0)
    # the first and the last start are known, and the runs that two calls in a row asked for
    assert [np.array_equal(q, problem.q0) for q in looked] == [True, False, True]


def test_a_plan_is_that_of_the_choice_of_its_code():
    """Codes of two choices may have one structure, and differ in the numbers that they read."""
    problem = mechanisms.four_bar()
    choice = Choice.at(problem.system, 0.0, problem.q0)
    numbers = []
    for each in (choice, replace(choice, least=10.0 * choice.least), choice):
        family = family_of(problem.system)
        shared = SharedCode(StraightLine(problem.system, each, family.equations(problem.system)), family)
        code = shared.of(problem.system, family.evaluator(problem.system.parameters))
        code.traced.trusted = True
        plan, _ = plans_for(problem.system, PRESETS["DOP853"], 1e-6, 1e-6, False, code, unchecked)
        numbers.append(plan.numbers)
    assert np.array_equal(numbers[0], numbers[2]) and not np.array_equal(numbers[0], numbers[1])


def test_what_a_method_was_traced_to_is_compared_in_its_first_run(monkeypatch):
    compared, counts, look = [], [], comparison._traces
    monkeypatch.setattr(comparison, "_traces", lambda *given: compared.append(1) or look(*given))
    problem = mechanisms.four_bar()
    for method in ("DOP853", "DOP853", "DOP853", "auto", "auto", "auto"):
        solve_dae(problem.system, (0.0, 1.0), problem.q0, problem.v0, method, 1e-7, 1e-7)
        counts.append(len(compared))
    assert counts[:2] == [1, 2] and counts[4] == counts[2] + 2 and counts[5] <= 6  # a third run may find turning points
