"""A repeated call costs little beside its steps: calls of functions are counted."""

import copy
import cProfile
import pickle
import pstats
from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest

from twoloop import BDF, DOP853, Integrator, Newmark, RungeKutta, Taylor, mechanisms, solve_dae
from twoloop.checks.consistency import Look
from twoloop.kernels.layout import MOST_FREE, _free, give_back, make_work
from twoloop.methods.presets import paper_irk
from twoloop.methods.tableaux import gauss, radau_iia

# calls of functions in a second run, which compares callbacks again at four states, in one that makes arrays for the
# next, in a third, which does so and may compare callbacks at turning points, in a fifth, which uses these arrays, and
# in a sixth, which begins as that one did
MANY, FEW, THIRD, FEWER, FEWEST = 780, 450, 690, 115, 77
# in a run from another start, which names the redundant rows there, and in one with other parameters, of which hundreds
# of numbers in the code of spatial mechanisms are formulas; of these runs a twentieth more with the oldest versions
ANOTHER = {
    "four_bar": (88, 1000),
    "andrews": (88, 750),
    "redundant_slider_crank": (92, 1430),
    "heavy_top": (108, 770),  # whose starts ask for two codes in turn
    "spatial_four_bar": (106, 1200),
    "spatial_slider_crank": (106, 1600),
    "closed_chain": (88, 740),
    "bricard": (92, 640),
}
AT_ENDS, DENSE = 55, 250  # more where the end alone is wanted, and with the solution between the steps
ACROSS = 330  # in one from another start that crosses singular positions


def run(problem, rtol=1e-6, **options):
    return solve_dae(problem.system, (0.0, 1.0), problem.q0, problem.v0, rtol=rtol, atol=rtol, **options)


@pytest.mark.parametrize("options", [{}, {"compiled": True}, {"method": "DOP853"}, {"method": "RadauIIA5"}], ids=str)
def test_a_repeated_call_takes_few_calls_of_functions(options):
    problem, other, calls = mechanisms.four_bar(), mechanisms.pendulum(), []
    for _ in range(3):
        run(other, **options)  # a process looks up addresses of functions once
    for _ in range(6):
        profile = cProfile.Profile()
        profile.enable()
        run(problem, **options)
        profile.disable()
        calls.append(pstats.Stats(profile).total_calls)
    assert calls[1] < MANY and calls[2] < THIRD  # the first compiles, or checks derivatives
    assert calls[4] < FEWER and calls[5] < FEWEST


OF_OBJECTS = 110  # calls more where the method is an object, which is compared with those before by its options


@pytest.mark.parametrize(
    "make",
    [
        lambda: Taylor(order=12),
        lambda: RungeKutta(gauss(3)),
        lambda: RungeKutta(radau_iia(3), outer="newton"),
        lambda: Newmark(beta=0.3),
        lambda: BDF(max_order=3),
        lambda: paper_irk(inner_tol=1e-8),
    ],
)
def test_a_repeated_call_with_an_equal_method_object_takes_few_calls_of_functions(make):
    problem, calls = mechanisms.four_bar(), []
    for _ in range(6):
        method = make()
        calls.append(calls_of(lambda method=method: run(problem, method=method)))
    assert calls[4] < FEWER + OF_OBJECTS and calls[5] < FEWEST + OF_OBJECTS, calls


@pytest.mark.parametrize(
    ("method", "most"), [("auto", FEWEST), ("DOP853", FEWEST), (Taylor(order=12), FEWEST + OF_OBJECTS)]
)
def test_a_repeated_run_of_an_integrator_takes_few_calls_of_functions(method, most):
    problem = mechanisms.four_bar()
    integrator = Integrator(problem.system, method, 1e-6, 1e-6)
    calls = [calls_of(lambda: integrator.run((0.0, 1.0), problem.q0, problem.v0)) for _ in range(6)]
    assert calls[5] < most, calls


EVENTS, A_LOOK, A_ROOT = 800, 6, 220  # calls of a run with an event, and for each value and each root of it


def test_a_repeated_call_with_an_event_takes_few_calls_of_functions():
    problem, values = mechanisms.four_bar(), []

    def event(t, q, v):
        values.append(t)
        return v[0]

    for _ in range(6):
        results, before = [], len(values)
        calls = calls_of(lambda results=results: results.append(run(problem, events=event)))
    n_roots = results[0].t_events[0].size
    assert n_roots > 0 and calls < EVENTS + A_LOOK * (len(values) - before) + A_ROOT * n_roots
    assert values[0] == 0.0 and len(values) - before < 450 + 15 * n_roots


def test_a_method_of_other_options_makes_a_run_of_its_own():
    problem = mechanisms.four_bar()
    orders = [8, 12, 8, 12, 8, 12, 8, 12]
    ends = [run(problem, method=Taylor(order=order)).q[:, -1].tolist() for order in orders]
    assert ends[0] != ends[1] and all(end == ends[k % 2] for k, end in enumerate(ends))


class Changing:
    """A method whose steps change."""

    name = "changing"

    def __init__(self):
        self.now = DOP853()

    def plan(self, *given):
        return self.now.plan(*given)


def test_nothing_is_kept_for_a_method_that_may_change():
    problem, method = mechanisms.four_bar(), Changing()
    before = [run(problem, method=method).h.size for _ in range(4)]
    method.now = RungeKutta(gauss(3))
    after = [run(problem, method=method).h.size for _ in range(4)]
    assert len({*before}) == len({*after}) == 1 and before[0] != after[0]


def test_a_tableau_that_was_written_to_makes_a_run_of_its_own():
    problem, tableau, other = mechanisms.four_bar(), gauss(3), radau_iia(3)
    before = [run(problem, method=RungeKutta(tableau)).q[:, -1].tolist() for _ in range(4)]
    for name in ("A", "b", "c"):
        getattr(tableau, name)[...] = getattr(other, name)
    after = [run(problem, method=RungeKutta(tableau)).q[:, -1].tolist() for _ in range(4)]
    again = [run(problem, method=RungeKutta(gauss(3))).q[:, -1].tolist() for _ in range(2)]
    assert before[0] == before[-1] == again[0] == again[1] and after[0] == after[-1] != before[0]


def calls_of(function):
    profile = cProfile.Profile()
    profile.runcall(function)
    return pstats.Stats(profile).total_calls


@pytest.mark.parametrize("name", ANOTHER)
@pytest.mark.filterwarnings("ignore::twoloop.ConstraintWarning")
def test_a_call_from_another_start_or_with_other_parameters_takes_few_calls_of_functions(name):
    """The median of calls: some compare callbacks once more."""
    problem = mechanisms.closed_chain(4) if name == "closed_chain" else getattr(mechanisms, name)()
    system, span = problem.system, 0.004 if name == "andrews" else 0.2
    motion = solve_dae(system, (0.0, span), problem.q0, problem.v0, t_eval=np.linspace(0.0, span, 12))
    states = list(zip(motion.t.tolist(), motion.q.T.copy(), motion.v.T.copy(), strict=True))
    for _ in range(2):
        starts = [calls_of(lambda s=s: solve_dae(system, (s[0], s[0] + 0.5 * span), *s[1:])) for s in states]
    others = [system.with_parameters(system.parameters) for _ in range(5)]
    p = [calls_of(lambda s=s: solve_dae(s, (0.0, 0.5 * span), problem.q0, problem.v0)) for s in others]
    assert (np.median(starts) < ANOTHER[name][0]) and (np.median(p) < ANOTHER[name][1]), (starts, p)


NEXT_TO_START = {
    **dict.fromkeys(
        ("spatial_slider_crank", "spatial_four_bar", "governor"), 106
    ),  # with numbers that are next to zero
    **{f"n_four_bar {n}": ACROSS for n in (1, 2)},
    "n_four_bar 2 bodies": ACROSS,
}


@pytest.mark.parametrize("name", NEXT_TO_START)
@pytest.mark.filterwarnings("ignore::twoloop.ConstraintWarning")
def test_a_call_next_to_the_usual_start_takes_few_calls_of_functions(name):
    """There rows are short by their position, and rounding of the geometry exceeds that of the coordinates."""
    word, *given = name.split()
    problem = getattr(mechanisms, word)(*map(int, given[:1]), *given[1:])
    solution = solve_dae(problem.system, (0.0, 1e-5), problem.q0, problem.v0, rtol=1e-12, atol=1e-12, dense_output=True)
    calls, span = [], 3.0 if given else 0.05
    for t in np.arange(1, 25) * 1e-8:
        start = (float(t), float(t) + span), solution.sol(t).q, solution.sol(t).v
        calls.append(calls_of(lambda start=start: solve_dae(problem.system, *start, rtol=1e-6, atol=1e-6)))
    assert np.median(calls[4:]) < NEXT_TO_START[name], calls


@pytest.mark.parametrize("name", ["andrews", "redundant_slider_crank", "spatial_four_bar"])
@pytest.mark.filterwarnings("ignore::twoloop.ConstraintWarning")
def test_a_call_for_the_end_or_for_a_dense_solution_takes_few_calls_of_functions_more(name):
    problem, span = getattr(mechanisms, name)(), 0.004 if name == "andrews" else 0.2
    solution = solve_dae(problem.system, (0.0, span), problem.q0, problem.v0, dense_output=True).sol

    def calls(end, **options):
        states, made = [solution(t) for t in np.linspace(0.0, 0.5 * span, 12)], []
        for s in states:
            asked = {"t_eval": [float(s.t) + 0.5 * span]} if end else options
            start = (float(s.t), float(s.t) + 0.5 * span), s.q, s.v
            made.append(calls_of(lambda start=start, asked=asked: solve_dae(problem.system, *start, **asked)))
        return np.median(made)

    few = ANOTHER[name][0]
    assert calls(True) < few + AT_ENDS and calls(False, dense_output=True) < few + DENSE


@pytest.mark.parametrize("make", [mechanisms.spatial_four_bar, mechanisms.spatial_slider_crank, mechanisms.heavy_top])
def test_coordinates_that_are_zero_but_for_rounding_need_no_closer_look(make):
    """Another processor leaves 1e-50 in place of 0, and rows of such coordinates above the rounding of their terms."""
    problem, generic = make(), np.random.default_rng(6)
    look = Look(problem.system)
    off = generic.standard_normal(problem.system.n_q)
    for size, seen in ((0.0, True), (1e-50, True), (1e-35, True), (1e-12, False)):
        found = look.at(0.0, problem.q0 + size * off, problem.v0)
        assert bool(found & look.flags.CONSISTENT) is seen


def test_a_call_that_crosses_singular_positions_takes_few_calls_and_measures_them_when_its_message_is_read():
    problem = mechanisms.n_four_bar(1)
    solution = solve_dae(problem.system, (0.0, 1e-3), problem.q0, problem.v0, dense_output=True).sol

    def across(state):
        span = float(state.t), float(state.t) + 3.0
        return solve_dae(problem.system, span, state.q, state.v, rtol=1e-8, atol=1e-8, compiled=True)

    calls, results, states = [], [], [solution(t) for t in np.linspace(1e-3, 0.0, 11)]
    for state in states:
        calls.append(calls_of(lambda state=state: results.append(across(state))))
    crossed = [k for k in range(2, 11) if not isinstance(vars(results[k])["message"], str)]  # not all, by rounding
    assert min(calls[k] for k in crossed) < ACROSS
    result = results[crossed[0]]
    assert calls_of(lambda: result.message) > 500 and calls_of(lambda: result.message) < 10
    assert "singular value" in result.message
    other = results[crossed[-1]]
    copies = copy.deepcopy(other), pickle.loads(pickle.dumps(other)), replace(other, changes="some")
    assert len({each.message for each in (other, *copies, across(states[crossed[-1]]))}) == 1
    with pytest.raises(FrozenInstanceError):
        other.message = "another"


def test_workspaces_of_other_sizes_do_not_keep_that_of_a_repeated_call_out():
    problem, before = mechanisms.four_bar(), dict(_free)
    for n_q in range(2, 3 + MOST_FREE):
        for _ in range(2):
            give_back(make_work(n_q, 1))
    calls = [calls_of(lambda: run(problem)) for _ in range(4)]
    assert min(calls) < FEW and sum(map(len, _free.values())) <= MOST_FREE
    many = [make_work(4, 2) for _ in range(2 * MOST_FREE)]  # threads that end at a time
    for work in many:
        give_back(work)
    assert sum(map(len, _free.values())) <= MOST_FREE
    _free.clear()
    _free.update(before)
