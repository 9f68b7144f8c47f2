"""Many runs at once: the same numbers as one by one, failures as rows, and going on after an interruption."""

import os
import sys
from functools import partial

import numpy as np
import pytest

from tests.problems import pendulum as bare_pendulum
from twoloop import solve_dae, sweep
from twoloop.mechanisms import Problem, four_bar
from twoloop.sweeps import one_run
from twoloop.sweeps import sweep as sweep_module

pd = pytest.importorskip("pandas")  # not among the oldest versions
THREADS = {"parallel": "threads"}
ANGLES = [{"theta3": angle} for angle in (0.0, 0.1, 2.0, -0.2, 0.3, 0.05)]  # 2.0 cannot be assembled
MADE = []  # by `counted`, of threads


def linkage(theta3):
    return four_bar(theta3=theta3)


def counted(theta3):
    MADE.append(theta3)
    return four_bar(theta3=theta3)


def interrupted(theta3):
    if theta3 == -0.2:
        raise KeyboardInterrupt
    return four_bar(theta3=theta3)


def swinging(k):
    return Problem("swing", bare_pendulum(force=force), np.array([-1.0, 0.0]), np.zeros(2), (0.0, 0.01), energy)


def force(t, q, v):
    return np.array([0.0, -GRAVITY])


def energy(t, q, v):
    return 0.5 * (v * v).sum(axis=0) + GRAVITY * q[1]


def heights(problem, result):
    return {"lowest": result.q[1::3].min(), "system": problem.system.name}


@pytest.fixture(scope="module")
def rows():
    return sweep(linkage, ANGLES, measure=heights, workers=1, t_span=(0.0, 0.3), rtol=1e-6)


@pytest.mark.slow
def test_rows_are_those_of_single_runs(rows):
    assert list(rows.columns) == ["theta3", "status", "message", "seconds", "lowest", "system"]
    assert rows.index.tolist() == list(range(6)) and rows.index.name == "run"
    assert rows["theta3"].tolist() == [each["theta3"] for each in ANGLES]
    for number in (0, 1, 3, 4, 5):
        problem = linkage(**ANGLES[number])
        single = solve_dae(problem.system, (0.0, 0.3), problem.q0, problem.v0, rtol=1e-6)
        assert rows.loc[number, "lowest"] == single.q[1::3].min() and rows.loc[number, "status"] == "REACHED_END"
        assert rows.loc[number, "system"] == "four-bar"


@pytest.mark.slow
def test_a_failure_is_a_row(rows):
    assert rows.loc[2, "status"] == "ERROR"
    assert rows.loc[2, "message"].startswith("ValueError: the linkage cannot be assembled with theta3 = 2")
    assert np.isnan(rows.loc[2, "lowest"])
    stopped = sweep(linkage, ANGLES[:2], parallel="threads", t_span=(0.0, 1.0), max_steps=5)
    assert stopped["status"].tolist() == ["MAX_STEPS", "MAX_STEPS"] and stopped["n_accepted"].tolist() == [5, 5]


@pytest.mark.slow
def test_threads_give_the_same_numbers(rows):
    by_threads = sweep(linkage, ANGLES, measure=heights, workers=2, parallel="threads", t_span=(0.0, 0.3), rtol=1e-6)
    pd.testing.assert_frame_equal(by_threads.drop(columns="seconds"), rows.drop(columns="seconds"))


@pytest.mark.slow
def test_a_dask_cluster_gives_the_same_numbers(rows):
    distributed = pytest.importorskip("dask.distributed")
    with (
        distributed.LocalCluster(n_workers=1, threads_per_worker=2, processes=False, dashboard_address=None) as cluster,
        distributed.Client(cluster) as client,
    ):
        by_dask = sweep(linkage, ANGLES, measure=heights, client=client, t_span=(0.0, 0.3), rtol=1e-6)
    pd.testing.assert_frame_equal(by_dask.drop(columns="seconds"), rows.drop(columns="seconds"))


def test_an_interrupted_sweep_goes_on(tmp_path, monkeypatch):
    out = tmp_path / "rows.parquet"
    options = {"parallel": "threads", "workers": 1, "t_span": (0.0, 0.1), "out": out}
    monkeypatch.setattr(
        sweep_module, "sweep_settings", lambda work: one_run.Settings("the same", {})
    )  # of both functions
    with pytest.raises(KeyboardInterrupt):
        sweep(interrupted, ANGLES, **options)
    saved = pd.read_parquet(out)
    assert 0 < len(saved) < len(ANGLES) and "INTERRUPTED" not in set(saved["status"])
    MADE.clear()
    rows = sweep(counted, ANGLES, **options)
    assert sorted(MADE) == sorted(each["theta3"] for k, each in enumerate(ANGLES) if k not in saved.index)
    assert len(rows) == len(ANGLES) and (rows.loc[saved.index, "seconds"] == saved["seconds"]).all()
    MADE.clear()
    repeated = sweep(counted, ANGLES, **options)
    assert MADE == []
    pd.testing.assert_frame_equal(repeated, rows)
    extended = sweep(counted, [*ANGLES, {"theta3": 0.15}], **options)
    assert MADE == [0.15] and len(extended) == 7


def test_rows_of_another_sweep_are_refused(tmp_path):
    out = tmp_path / "rows.parquet"
    options = {"parallel": "threads", "t_span": (0.0, 0.1), "out": out}
    sweep(linkage, ANGLES[:2], **options)
    with pytest.raises(ValueError, match=r"holds runs of .*linkage.*; this sweep is of .*rtol=1e-05.*another file"):
        sweep(linkage, ANGLES[:2], rtol=1e-5, **options)
    with pytest.raises(ValueError, match=r"holds other runs: 1 has {'theta3': 0.1}, {'theta3': 0.2}"):
        sweep(linkage, [ANGLES[0], {"theta3": 0.2}], **options)
    with pytest.raises(ValueError, match=r"runs: 1 has .*not asked for"):
        sweep(linkage, ANGLES[:1], **options)
    pd.DataFrame({"x": [1]}).to_parquet(out)
    with pytest.raises(ValueError, match="holds something else"):
        sweep(linkage, ANGLES[:2], **options)
    out.write_text("no table")
    with pytest.raises(ValueError, match="cannot be read"):
        sweep(linkage, ANGLES[:2], **options)
    with pytest.raises(ValueError, match="out must be a file in a folder that exists"):
        sweep(linkage, ANGLES[:2], t_span=(0.0, 0.1), out=tmp_path / "nowhere" / "rows.parquet")


OF_LINKAGES = linkage, ANGLES


@pytest.mark.parametrize(
    ("arguments", "options", "error", "words"),
    [
        ((None, ANGLES), {}, TypeError, "problem_of must be a function that returns a Problem; given None"),
        ((linkage, []), {}, ValueError, "parameters must contain at least one run"),
        ((linkage, [0.1]), {}, TypeError, r"parameters\[0\] must be a mapping of names to values; given 0.1"),
        ((linkage, [{"theta3": 0.1}, {"x": 1}]), {}, ValueError, r"all have the same names; .*\[1\] \['x'\]"),
        ((lambda status: None, [{"status": 1}]), {}, ValueError, "the name of a standard column; given 'status'"),
        (OF_LINKAGES, {"parallel": "fork"}, ValueError, "must be 'processes' or 'threads'; given 'fork'"),
        (OF_LINKAGES, {"method": "Guass8"}, ValueError, r"method must be one of .*given 'Guass8'"),
        (OF_LINKAGES, {"rtol": 0.0}, ValueError, "rtol must be positive"),
        (OF_LINKAGES, {"measure": lambda p, r: {}}, TypeError, "measure cannot be sent to another process"),
        (OF_LINKAGES, {"measure": len, "parallel": "threads"}, TypeError, r"len\(\) takes exactly one argument"),
        (OF_LINKAGES, THREADS | {"measure": lambda p, r: 1.0}, TypeError, "must return a mapping of columns"),
        (OF_LINKAGES, THREADS | {"measure": lambda p, r: {"theta3": 1}}, TypeError, "that the row has not already"),
        (OF_LINKAGES, THREADS | {"measure": lambda p, r: {"x": [1.0]}}, TypeError, r"'x' is \[1.0\] of type list"),
        ((swinging, [{"k": 1.0}, {"k": "one"}]), THREADS, TypeError, "'k' has numbers, and 'one'"),
        ((swinging, [{"k": 2**63}]), THREADS, TypeError, "must be a number"),
    ],
)
def test_mistakes_come_through_at_once(arguments, options, error, words):
    with pytest.raises(error, match=words):
        sweep(*arguments, **{"t_span": (0.0, 0.01)} | options)


# --- rows of a sweep: kept ones are of the same functions, whatever their names, and none is lost, whatever a run does
GRAVITY = 9.81
TABLE = np.linspace(0.0, 1.0, 2000)  # its repr leaves most of it out
QUICK = {"t_span": (0.0, 0.01), "check_derivatives": False}
RUNS = [{"k": k} for k in range(6)]


def plain(problem, result):
    return {"process": os.getpid()}


def dying(k):
    """Its process ends at once in run 1, and is asked to end in run 2."""
    if k == 1:
        os._exit(3)
    if k == 2:
        sys.exit("enough")
    return swinging(k)


@pytest.fixture
def resumes(tmp_path):
    """Whether a sweep of a second function goes on from the file of a first."""

    def resumed(first, second, **options):
        common = {"parallel": "threads", "workers": 1, "out": tmp_path / "rows.parquet", **QUICK}
        sweep(swinging, RUNS[:1], measure=first, **common)
        try:
            sweep(swinging, RUNS[:1], measure=second, **common | options)
        except ValueError as error:
            assert "functions or values that have changed: measure (its code" in str(error)
            return False
        return True

    return resumed


class Scaled:
    """A measure whose repr says nothing of its factor."""

    def __init__(self, factor):
        self.factor = factor

    def __call__(self, problem, result):
        return {"x": self.factor}

    def __repr__(self):
        return "Scaled"


def enclosing(value):
    return lambda problem, result: {"x": value if np.isscalar(value) else 0.0}


def helped(value):
    helper = lambda: value  # noqa: E731
    return lambda problem, result: {"x": helper()}


OTHER = np.array(TABLE)
OTHER[1000] += 1e-9
PAIRS = {
    "two lambdas of one name": (lambda p, r: {"x": 1.0}, lambda p, r: {"x": 2.0}),
    "an enclosed array": (enclosing(TABLE), enclosing(OTHER)),
    "an enclosed function's enclosed number": (helped(1.0), helped(2.0)),
    "a default": (lambda p, r, x=1.0: {"x": x}, lambda p, r, x=2.0: {"x": x}),
    "objects of equal repr": (Scaled(1.0), Scaled(2.0)),
    "a partial": (partial(Scaled.__call__, Scaled(1.0)), partial(Scaled.__call__, Scaled(2.0))),
}


@pytest.mark.parametrize("name", PAIRS)
def test_rows_of_another_function_of_the_same_name_are_refused(name, resumes, monkeypatch):
    first, second = PAIRS[name]
    monkeypatch.setattr("twoloop.sweeps.one_run._in_words", lambda value: "the same words")
    assert resumes(first, first) and not resumes(first, second)


def test_a_global_that_is_reached_counts_and_others_do_not(tmp_path, monkeypatch):
    options = {"parallel": "threads", "workers": 1, "measure": plain, "out": tmp_path / "rows.parquet", **QUICK}
    rows = sweep(swinging, RUNS[:2], **options)
    monkeypatch.setitem(globals(), "PAIRS", {})
    pd.testing.assert_frame_equal(sweep(swinging, RUNS[:2], **options), rows)
    monkeypatch.setitem(globals(), "GRAVITY", 1.62)  # by `force`, which `swinging` names
    with pytest.raises(ValueError, match=r"have changed: problem_of .*Give another file"):
        sweep(swinging, RUNS[:2], **options)


@pytest.mark.slow
def test_a_worker_that_dies_costs_its_own_run_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(sweep_module, "RENEWED_AFTER", 0)  # processes grow with what they compile: each ends with a run
    out = tmp_path / "rows.parquet"
    rows = sweep(dying, RUNS[:4], measure=plain, workers=2, out=out, **QUICK)
    assert rows["status"].tolist() == ["REACHED_END", "ERROR", "ERROR", "REACHED_END"]
    assert rows.loc[1, "message"] == "the worker process ended with exit code 3 in this run"
    assert rows.loc[2, "message"] == "SystemExit: enough"
    assert rows.loc[0, "process"] == os.getpid() != rows.loc[3, "process"]
    pd.testing.assert_frame_equal(pd.read_parquet(out), rows, check_dtype=False)
