"""Runs of a sweep that share their callbacks are made together, and their rows are those of single runs."""

from types import SimpleNamespace

import numpy as np
import pytest

from tests.problems import quick
from tests.test_sweeps import energy
from twoloop import ConstrainedSystem, solve_dae, sweep
from twoloop.mechanisms import Problem, four_bar
from twoloop.sweeps import shared_out, shared_runs

pd = pytest.importorskip("pandas")  # not among the oldest versions
N = 20
TIMES = [0.0, 0.5, 1.0]
TOGETHER = {"parallel": "threads", "workers": 1}


@pytest.fixture(autouse=True)
def _in_one_task(monkeypatch):
    monkeypatch.setattr("twoloop.ensembles.in_turn.CALL", 1e9)
    monkeypatch.setattr(shared_out, "OF_SHARED", 1)  # task per worker
    monkeypatch.setattr(shared_runs, "DEAR", 1e9)  # on a busy machine, too
    monkeypatch.setattr(shared_runs, "LONGEST", 1e9)  # s, also where kernels have to be compiled


def linkage(third, theta3=0.1):
    return four_bar((1.0, 2.0, third), theta3=theta3)


LINKAGES = [{"third": 1.4 + 0.01 * k} for k in range(N)]


def ends_of(problem, result):
    loads = {"a": result.a[0, -1], "lam": np.abs(result.lam[:, -1]).max(), "energy": result.energy[-1]}
    return {"x": result.q[0, -1], "y": result.v[1, -1], "n_t": result.t.size, **loads}


def in_lanes(rows):
    return rows["message"].str.contains("in lanes").tolist()


def singly(problem_of, given, measure, span, **options):
    problem = problem_of(**given)
    return measure(problem, solve_dae(problem.system, span, problem.q0, problem.v0, **options))


def compare(rows, problem_of, measure, span, rel=1e-5, **options):
    for number, row in rows.iterrows():
        given = {name: row[name] for name in rows.columns[: rows.columns.get_loc("status")]}
        known = singly(problem_of, given, measure, span, **options)
        assert {name: row[name] for name in known} == pytest.approx(known, rel=rel, abs=1e-7), number


def test_measures_get_states_accelerations_and_multipliers():
    rows = sweep(linkage, LINKAGES, measure=ends_of, t_span=(0.0, 1.0), t_eval=TIMES, **TOGETHER)
    # one made here, one at the beginning of the only task
    assert in_lanes(rows)[2:] == [True] * (N - 2) and not any(in_lanes(rows)[:2])
    assert set(rows["status"]) == {"REACHED_END"} and (rows["seconds"] > 0.0).all()
    compare(rows, linkage, ends_of, (0.0, 1.0), t_eval=TIMES)


MORE = {
    "joints": lambda problem, result: {"force": result.reactions("1-2").force[0, -1]},
    "steps": lambda problem, result: {"h": result.h.max(), "x": int(np.size(result.h))},
    "counts": lambda problem, result: {"n": result.stats.n_partitions or 0, "m": result.stats.n_accepted},
    "of steps": lambda problem, result: {"n": int(np.size(result.rejected_error)), "none": result.untested is None},
    "of the run": lambda problem, result: {"rank": result.rank or 0, "n": len(result.redundant), "d": result.defect},
    "names": lambda problem, result: {"auto": result.method == "auto", "compiled": result.compiled},
}


@pytest.mark.parametrize("name", quick(MORE, 2))
def test_what_lanes_do_not_know_is_that_of_a_single_run(name):
    rows = sweep(linkage, LINKAGES[:6], measure=MORE[name], t_span=(0.0, 0.3), t_eval=[0.3], **TOGETHER)
    assert sum(in_lanes(rows)) == 4
    compare(rows, linkage, MORE[name], (0.0, 0.3), rel=1e-12, t_eval=[0.3])


def either(kind, angle):
    return four_bar(theta3=angle) if kind == "four-bar" else swing_of(9.81, 1.0 + angle)


def test_several_systems_in_one_table():
    given = [{"kind": kind, "angle": 0.1 + 0.01 * k} for k in range(6) for kind in ("four-bar", "swing")]
    given.append({"kind": "four-bar", "angle": 2.0})  # cannot be assembled
    rows = sweep(either, given, measure=ends_of, t_span=(0.0, 1.0), t_eval=TIMES, **TOGETHER)
    assert rows["status"].tolist() == ["REACHED_END"] * 12 + ["ERROR"]
    assert sum(in_lanes(rows)) == 9  # not the first of all, nor those of each system in the task
    compare(rows[:12], either, ends_of, (0.0, 1.0), t_eval=TIMES)


def off(third):
    problem = linkage(third)
    if third in (1.41, 1.45):
        problem.q0[0] += 1e-3
    return problem


def test_a_start_off_the_constraints_is_a_row():
    rows = sweep(off, LINKAGES[:10], t_span=(0.0, 0.3), **TOGETHER)
    assert [k for k, status in enumerate(rows["status"]) if status == "ERROR"] == [1, 5]  # 1 is the first of its task
    assert "ValueError: q0 is not consistent with the constraints" in rows.loc[5, "message"]
    assert sum(in_lanes(rows)) == 6


def pull(t, q, v, p):
    return np.array([0.0, -p[0]])


def rod(t, q, p):
    return np.array([q[0] ** 2 + q[1] ** 2 - p[1] ** 2])


SWING = ConstrainedSystem.from_python(
    n_q=2, n_c=1, mass=np.eye(2), force=pull, constraint=rod, parameters=[9.81, 1.0], compile=True
)


def swing_of(gravity, length):
    system = SWING.with_parameters([gravity, length])
    return Problem("swing", system, np.array([-length, 0.0]), np.zeros(2), (0.0, 1.0), energy)


SWINGS = [{"gravity": 9.0 + 0.1 * k, "length": 1.0 + 0.02 * k} for k in range(10)]


def test_compiled_functions_with_parameters_go_together():
    rows = sweep(swing_of, SWINGS, measure=ends_of, t_eval=TIMES, **TOGETHER)
    assert sum(in_lanes(rows)) == 8
    compare(rows, swing_of, ends_of, (0.0, 1.0), t_eval=TIMES)


KEPT = SimpleNamespace(gravity=0.0, n=0)


def test_problems_that_depend_on_the_runs_before_them_are_those_of_single_runs():
    def counting(gravity, length):
        import tests.test_sweep_together as module

        return swing_of(gravity + module.KEPT.n, length)

    def count(problem, result):
        import tests.test_sweep_together as module

        module.KEPT.n += 1
        return {"g": problem.system.parameters[0], "x": result.q[0, -1]}

    KEPT.n = 0
    rows = sweep(counting, SWINGS, measure=count, t_eval=TIMES, **TOGETHER)
    assert rows["g"].tolist() == pytest.approx([each["gravity"] + k for k, each in enumerate(SWINGS)])
    for number, each in enumerate(SWINGS):
        known = singly(swing_of, each | {"gravity": rows.loc[number, "g"]}, last_place, (0.0, 1.0))
        assert rows.loc[number, "x"] == pytest.approx(known["x"], rel=1e-5)


def last_place(problem, result):
    return {"x": result.q[0, -1]}


def test_rows_are_the_same_however_they_are_shared_out(monkeypatch):
    options = {"measure": ends_of, "t_span": (0.0, 1.0), "t_eval": TIMES, "parallel": "threads"}
    monkeypatch.setattr(shared_out, "LARGEST_SHARED", 7)
    some = sweep(linkage, LINKAGES, workers=2, **options)
    monkeypatch.setattr(shared_out, "LARGEST_SHARED", 1)
    alone = sweep(linkage, LINKAGES, workers=1, **options)
    assert sum(in_lanes(some)) == N - 1 - 3 and not any(in_lanes(alone))
    told = ["seconds", "message"]
    pd.testing.assert_frame_equal(some.drop(columns=told), alone.drop(columns=told), rtol=1e-5, atol=1e-7)
