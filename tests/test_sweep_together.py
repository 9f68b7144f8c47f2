"""Runs of a sweep that share their callbacks are made together, and their rows are those of single runs."""

import os

import numpy as np
import pytest

from tests.test_sweep_rows import energy, force
from twoloop import ConstrainedSystem, solve_dae, sweep
from twoloop.mechanisms import Problem, four_bar
from twoloop.sweeps import shared_out, shared_runs

pd = pytest.importorskip("pandas")  # not among the oldest versions
N = 20
TIMES = [0.0, 0.5, 1.0]
TOGETHER = {"parallel": "threads", "workers": 1}
LENGTH = 1.0


@pytest.fixture(autouse=True)
def _in_one_task(monkeypatch):
    monkeypatch.setattr("twoloop.ensembles.in_turn.CALL", 1e9)
    monkeypatch.setattr(shared_out, "OF_SHARED", 1)  # task per worker


def linkage(third, theta3=0.1):
    return four_bar((1.0, 2.0, third), theta3=theta3)


LINKAGES = [{"third": 1.4 + 0.01 * k} for k in range(N)]


def ends_of(problem, result):
    loads = {"a": result.a[0, -1], "lam": np.abs(result.lam[:, -1]).max(), "energy": result.energy[-1]}
    return {"x": result.q[0, -1], "y": result.v[1, 1], "n_t": result.t.size, **loads}


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


def test_by_default_counts_and_energy_are_of_the_same_size():
    rows = sweep(linkage, LINKAGES, t_span=(0.0, 1.0), **TOGETHER)
    assert sum(in_lanes(rows)) == N - 2 and rows["t"].tolist() == [1.0] * N
    assert rows["energy_error"].between(1e-15, 1e-6).all()
    for name in ("n_accepted", "n_evaluations"):
        assert rows[name].between(0.2 * rows.loc[0, name], 5.0 * rows.loc[0, name]).all(), rows[name].tolist()
    assert (rows["n_evaluations"] > 5 * rows["n_accepted"]).all()


@pytest.mark.parametrize("method", ["DOP853", "RadauIIA5"])
def test_evaluations_of_other_methods_are_counted(method):
    rows = sweep(linkage, LINKAGES, t_span=(0.0, 0.5), method=method, **TOGETHER)
    assert sum(in_lanes(rows)) == N - 2
    attempts = {"DOP853": 12, "RadauIIA5": 3}[method]  # evaluations of one
    assert (rows["n_evaluations"] >= attempts * rows["n_accepted"]).all()
    assert (rows["n_evaluations"] <= 40 * rows["n_accepted"]).all()


def test_a_run_is_made_singly_where_measures_ask_for_more():
    def longest(problem, result):
        return {"h": result.h.max()}

    def rank(problem, result):
        return {"rank": result.rank}

    for measure in (longest, rank):
        rows = sweep(linkage, LINKAGES[:5], measure=measure, t_span=(0.0, 0.3), t_eval=[0.3], **TOGETHER)
        assert not any(in_lanes(rows)) and set(rows["status"]) == {"REACHED_END"}
        compare(rows, linkage, measure, (0.0, 0.3), rel=1e-12, t_eval=[0.3])


def test_every_step_is_only_there_in_single_runs():
    rows = sweep(linkage, LINKAGES[:5], measure=ends_of, t_span=(0.0, 0.3), **TOGETHER)
    assert not any(in_lanes(rows)) and (rows["n_t"] > 2).all()
    rows = sweep(linkage, LINKAGES[:5], t_span=(0.0, 0.3), max_step=0.1, **TOGETHER)
    assert not any(in_lanes(rows))


def either(kind, angle):
    return four_bar(theta3=angle) if kind == "four-bar" else swinging(9.81, 1.0 + angle)


def test_several_systems_in_one_table():
    given = [{"kind": kind, "angle": 0.1 + 0.01 * k} for k in range(6) for kind in ("four-bar", "swing")]
    given.append({"kind": "four-bar", "angle": 2.0})  # cannot be assembled
    rows = sweep(either, given, measure=ends_of, t_span=(0.0, 1.0), t_eval=TIMES, **TOGETHER)
    assert rows["status"].tolist() == ["REACHED_END"] * 12 + ["ERROR"]
    assert sum(in_lanes(rows)) == 9  # not the first of all, nor those of each system in the task
    compare(rows[:12], either, ends_of, (0.0, 1.0), t_eval=TIMES)


def test_spans_of_their_own():
    def released(third):
        problem = linkage(third)
        span = (0.0, 1.0) if third < 1.5 else (0.0, 0.5)
        return Problem("linkage", problem.system, problem.q0, problem.v0, span, problem.energy)

    rows = sweep(released, LINKAGES, **TOGETHER)
    assert rows["t"].tolist() == [1.0 if each["third"] < 1.5 else 0.5 for each in LINKAGES]
    assert sum(in_lanes(rows)) == N - 3


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


# --- functions of one's own
def pull(t, q, v, p):
    return np.array([0.0, -p[0]])


def rod(t, q, p):
    return np.array([q[0] ** 2 + q[1] ** 2 - p[1] ** 2])


def swinging(gravity, length):
    system = ConstrainedSystem.from_python(
        n_q=2, n_c=1, mass=np.eye(2), force=pull, constraint=rod, parameters=[gravity, length]
    )
    return Problem("swing", system, np.array([-length, 0.0]), np.zeros(2), (0.0, 1.0), energy)


def test_plain_functions_with_parameters_go_together():
    given = [{"gravity": 9.0 + 0.1 * k, "length": 1.0 + 0.02 * k} for k in range(10)]
    rows = sweep(swinging, given, measure=ends_of, t_eval=TIMES, **TOGETHER)
    assert sum(in_lanes(rows)) == 8
    compare(rows, swinging, ends_of, (0.0, 1.0), t_eval=TIMES)


def test_functions_that_enclose_numbers_do_not():
    def enclosing(gravity):
        system = ConstrainedSystem.from_python(
            n_q=2,
            n_c=1,
            mass=np.eye(2),
            force=lambda t, q, v: np.array([0.0, -gravity]),
            constraint=lambda t, q: np.array([q @ q - 1.0]),
        )
        return Problem("swing", system, np.array([-1.0, 0.0]), np.zeros(2), (0.0, 1.0), energy)

    given = [{"gravity": 9.0 + 0.1 * k} for k in range(5)]
    rows = sweep(enclosing, given, measure=ends_of, t_eval=TIMES, **TOGETHER)
    assert not any(in_lanes(rows))
    compare(rows, enclosing, ends_of, (0.0, 1.0), t_eval=TIMES)


def rod_of_a_global(t, q):
    return np.array([q[0] ** 2 + q[1] ** 2 - LENGTH**2])


def by_a_global(length):
    globals()["LENGTH"] = length
    system = ConstrainedSystem.from_python(n_q=2, n_c=1, mass=np.eye(2), force=force, constraint=rod_of_a_global)
    return Problem("swing", system, np.array([-length, 0.0]), np.zeros(2), (0.0, 1.0), energy)


@pytest.mark.parametrize("lengths", [(1.0, 1.1, 1.2, 1.3), (1.0, 1.0, 1.0, 1.3, 1.4)])  # the second run changes nothing
def test_what_problems_leave_in_globals_is_seen(lengths):
    rows = sweep(by_a_global, [{"length": x} for x in lengths], measure=ends_of, t_eval=TIMES, **TOGETHER)
    assert not any(in_lanes(rows)) and set(rows["status"]) == {"REACHED_END"}
    compare(rows, by_a_global, ends_of, (0.0, 1.0), t_eval=TIMES)


# --- tasks
def test_rows_are_the_same_however_they_are_shared_out(monkeypatch):
    options = {"measure": ends_of, "t_span": (0.0, 1.0), "t_eval": TIMES, "parallel": "threads"}
    monkeypatch.setattr(shared_out, "SHARED", 7)
    some = sweep(linkage, LINKAGES, workers=2, **options)
    monkeypatch.setattr(shared_out, "SHARED", 1)
    alone = sweep(linkage, LINKAGES, workers=1, **options)
    assert sum(in_lanes(some)) == N - 1 - 3 and not any(in_lanes(alone))
    told = ["seconds", "message"]
    pd.testing.assert_frame_equal(some.drop(columns=told), alone.drop(columns=told), rtol=1e-5, atol=1e-7)


def test_a_task_of_a_cluster_is_an_ensemble():
    distributed = pytest.importorskip("dask.distributed")
    with (
        distributed.LocalCluster(n_workers=1, threads_per_worker=2, processes=False, dashboard_address=None) as cluster,
        distributed.Client(cluster) as client,
    ):
        rows = sweep(linkage, LINKAGES, measure=ends_of, client=client, workers=1, t_span=(0.0, 1.0), t_eval=TIMES)
    assert sum(in_lanes(rows)) == N - 2
    compare(rows, linkage, ends_of, (0.0, 1.0), t_eval=TIMES)


def dying(third):
    if third == LINKAGES[3]["third"]:
        os._exit(3)
    return linkage(third)


def test_a_worker_that_dies_in_a_task_costs_one_run():
    rows = sweep(dying, LINKAGES[:6], t_span=(0.0, 0.1), workers=1)
    assert [k for k, status in enumerate(rows["status"]) if status != "REACHED_END"] == [3]
    assert rows.loc[3, "message"] == "the worker process ended with exit code 3 in this run"


def test_what_cannot_be_read_leaves_runs_single(tmp_path):
    with (tmp_path / "log").open("w") as log:

        def logged(third):
            log.write(f"{third}\n")
            return linkage(third)

        rows = sweep(logged, LINKAGES[:4], t_span=(0.0, 0.1), **TOGETHER)
    assert set(rows["status"]) == {"REACHED_END"} and not any(in_lanes(rows))


def test_long_runs_are_not_kept_in_one_task(monkeypatch):
    sizes = []

    def watched(work, given):
        sizes.append(len(given))
        return shared_runs.batch(work, given)

    monkeypatch.setattr(shared_out, "batch", watched)
    monkeypatch.setattr(shared_out, "LONGEST", 5.5e-3)  # s, and a call takes at least 1e-3
    sweep(linkage, LINKAGES, t_span=(0.0, 0.1), **TOGETHER)
    assert sum(sizes) == N - 1 and max(sizes) <= 5


def test_what_a_result_in_lanes_can_do_is_that_of_single_runs():
    def reaction(problem, result):
        at = result.reactions("1-2")
        table = result.to_dataframe()
        return {"force": at.force[0, -1], "angle": table["angle (rad) of bar 3"].iloc[-1]}

    rows = sweep(linkage, LINKAGES[:6], measure=reaction, t_span=(0.0, 1.0), t_eval=TIMES, **TOGETHER)
    assert sum(in_lanes(rows)) == 4
    compare(rows, linkage, reaction, (0.0, 1.0), t_eval=TIMES)


def test_starts_that_change_one_another_are_seen():
    start = np.array([-1.0, 0.0])

    def released(height):
        system = swinging(9.81, 1.0).system
        start[:] = -np.sqrt(1.0 - height**2), height
        return Problem("swing", system, start, np.zeros(2), (0.0, 1.0), energy)

    def from_there(problem, result):
        return {"y": result.q[1, 0], "x": result.q[0, -1]}

    heights = [{"height": 0.1 * k} for k in range(4)]
    rows = sweep(released, heights, measure=from_there, t_eval=TIMES, **TOGETHER)
    assert rows["y"].tolist() == pytest.approx([0.0, 0.1, 0.2, 0.3])
    compare(rows, released, from_there, (0.0, 1.0), t_eval=TIMES)


def test_room_is_bounded(monkeypatch):
    monkeypatch.setattr(shared_runs, "ROOM", 5 * 2 * 9 * len(TIMES))  # numbers: five runs
    rows = sweep(linkage, LINKAGES, measure=ends_of, t_span=(0.0, 1.0), t_eval=TIMES, **TOGETHER)
    assert sum(in_lanes(rows)) == N - 1 - 4
    compare(rows, linkage, ends_of, (0.0, 1.0), t_eval=TIMES)
