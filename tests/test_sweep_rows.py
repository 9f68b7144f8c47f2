"""Rows of a sweep: kept ones are of the same functions, whatever their names, and none is lost, whatever a run does."""

import os
import sys
from functools import partial

import numpy as np
import pytest

from tests.problems import pendulum as bare_pendulum
from twoloop import sweep
from twoloop.mechanisms import Problem
from twoloop.sweeps import workers

pd = pytest.importorskip("pandas")  # not among the oldest versions
GRAVITY = 9.81
TABLE = np.linspace(0.0, 1.0, 2000)  # its repr leaves most of it out
QUICK = {"t_span": (0.0, 0.01), "check_derivatives": False}
RUNS = [{"k": k} for k in range(6)]


def swinging(k):
    return Problem("swing", bare_pendulum(force=force), np.array([-1.0, 0.0]), np.zeros(2), (0.0, 0.01), energy)


def force(t, q, v):
    return np.array([0.0, -GRAVITY])


def energy(t, q, v):
    return 0.5 * (v * v).sum(axis=0) + GRAVITY * q[1]


def plain(problem, result):
    return {"process": os.getpid()}


def dying(k):
    """Its process ends at once in run 1, and is asked to end in run 2."""
    if k == 1:
        os._exit(3)
    if k == 2:
        sys.exit("enough")
    return swinging(k)


# --- other functions under the same names
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


def with_default(value):
    def measure(problem, result, value=value):
        return {"x": value}

    return measure


def helped(value):
    def helper():
        return value

    def measure(problem, result):
        return {"x": helper()}

    return measure


OTHER = np.array(TABLE)
OTHER[1000] += 1e-9
PAIRS = {
    "two lambdas of one name": (lambda p, r: {"x": 1.0}, lambda p, r: {"x": 2.0}),
    "an enclosed number": (enclosing(1.0), enclosing(2.0)),
    "an enclosed array": (enclosing(TABLE), enclosing(OTHER)),
    "an enclosed function's enclosed number": (helped(1.0), helped(2.0)),
    "a default": (with_default(1.0), with_default(2.0)),
    "objects of equal repr": (Scaled(1.0), Scaled(2.0)),
    "a method of such objects": (Scaled(1.0).__call__, Scaled(2.0).__call__),
    "a partial": (partial(Scaled.__call__, Scaled(1.0)), partial(Scaled.__call__, Scaled(2.0))),
}


@pytest.mark.parametrize("name", PAIRS)
def test_rows_of_another_function_of_the_same_name_are_refused(name, resumes, monkeypatch):
    first, second = PAIRS[name]
    monkeypatch.setattr("twoloop.sweeps.saved_sweep.described", lambda value: "the same words")
    assert resumes(first, first) and not resumes(first, second)


def test_a_global_that_is_reached_counts_and_others_do_not(tmp_path, monkeypatch):
    options = {"parallel": "threads", "workers": 1, "measure": plain, "out": tmp_path / "rows.parquet", **QUICK}
    rows = sweep(swinging, RUNS[:2], **options)
    monkeypatch.setitem(globals(), "PAIRS", {})
    pd.testing.assert_frame_equal(sweep(swinging, RUNS[:2], **options), rows)
    monkeypatch.setitem(globals(), "GRAVITY", 1.62)  # by `force`, which `swinging` names
    with pytest.raises(ValueError, match=r"have changed: problem_of .*Give another file"):
        sweep(swinging, RUNS[:2], **options)


def test_what_cannot_be_compared_is_refused_and_runs_without_a_file(tmp_path):
    with (tmp_path / "log").open("w") as log:

        def measure(problem, result):
            return {"closed": log.closed}

        options = {"measure": measure, "parallel": "threads", **QUICK}
        with pytest.raises(
            ValueError, match=r"measure reaches an object of type TextIOWrapper, whose state .*omit `out`"
        ):
            sweep(swinging, RUNS[:1], out=tmp_path / "rows.parquet", **options)
        assert sweep(swinging, RUNS[:1], **options)["closed"].tolist() == [False]


# --- cells
def test_a_parameter_that_is_no_number_goes_on(tmp_path):
    options = {"measure": plain, "parallel": "threads", "out": tmp_path / "rows.parquet", **QUICK}
    runs = [{"k": 1.0}, {"k": float("nan")}, {"k": np.float64("inf")}]
    rows = sweep(swinging, runs, **options)
    pd.testing.assert_frame_equal(sweep(swinging, runs, **options), rows)
    with pytest.raises(ValueError, match="holds other runs: 1 has"):
        sweep(swinging, [runs[0], {"k": 0.0}, runs[2]], **options)


ODD = [1.5, object(), "text", np.ones(2), 2**70, None, np.float64(2.5), "\udc80", 1j, True]


def odd(k):
    problem = swinging(k)
    problem.parameters["k"] = k
    return problem


def measured_odd(problem, result):
    return {"x": ODD[problem.parameters["k"]]}


def test_what_is_no_cell_is_a_row_that_says_so(tmp_path):
    out = tmp_path / "rows.parquet"
    options = {"measure": measured_odd, "parallel": "threads", "workers": 2, "out": out, **QUICK}
    rows = sweep(odd, [{"k": k} for k in range(len(ODD))], **options)
    good = [0, 5, 6]
    assert [k for k, status in enumerate(rows["status"]) if status == "REACHED_END"] == good
    assert rows.loc[good, "x"].tolist()[::2] == [1.5, 2.5]
    for k, words in {
        1: "'x' is <object object at .* of type object",
        2: "must fill a column with one kind; 'x' had numbers, now 'text'",
        4: "'x' is 1180591620717411303424 of type int",
        9: "'x' had numbers, now True",
    }.items():
        assert pd.Series([rows.loc[k, "message"]]).str.contains(words).all()
    pd.testing.assert_frame_equal(pd.read_parquet(out), rows, check_dtype=False)


@pytest.mark.parametrize(
    ("runs", "measure", "words"),
    [
        ([{"k": 1.0}, {"k": "one"}], plain, r"parameters must be of one kind .*'k' has numbers, and 'one' in \[1\]"),
        ([{"k": 2**63}], plain, r"parameters\[0\]\['k'\] must be a number"),
        (RUNS[:1], lambda p, r: {"x": [1.0]}, r"cells of a table; 'x' is \[1.0\] of type list"),
        (RUNS[:1], lambda p, r: {1: 1.0}, "must name its columns by strings; it returned 1"),
        (RUNS[:1], lambda p, r: {"run": 1.0}, "columns that the row has not already; it returned 'run'"),
    ],
)
def test_mistakes_in_cells_come_through_at_once(runs, measure, words):
    with pytest.raises(TypeError, match=words):
        sweep(swinging, runs, measure=measure, parallel="threads", **QUICK)


# --- workers that die
def test_a_worker_that_dies_costs_its_own_run_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(workers, "RENEWED_AFTER", 0)  # processes grow with what they compile: each ends after a run
    out = tmp_path / "rows.parquet"
    rows = sweep(dying, RUNS[:4], measure=plain, workers=2, out=out, **QUICK)
    assert rows["status"].tolist() == ["REACHED_END", "ERROR", "ERROR", "REACHED_END"]
    assert rows.loc[1, "message"] == "the worker process ended with exit code 3 in this run"
    assert rows.loc[2, "message"] == "SystemExit: enough"
    assert rows.loc[0, "process"] == os.getpid() != rows.loc[3, "process"]
    pd.testing.assert_frame_equal(pd.read_parquet(out), rows, check_dtype=False)


def fails_when_it_is_read(k):
    return swinging(k)


def test_a_worker_that_cannot_begin_is_an_error(monkeypatch):
    monkeypatch.setattr(fails_when_it_is_read, "__module__", "__main__")  # where no other process finds it
    monkeypatch.setattr(sys.modules["__main__"], "fails_when_it_is_read", fails_when_it_is_read, raising=False)
    with pytest.raises(RuntimeError, match=r"ended with exit code 1 before its first run.*if __name__ == '__main__'"):
        sweep(fails_when_it_is_read, RUNS[:3], measure=plain, workers=1, **QUICK)


# --- memory
