"""Rows of a sweep: kept ones are of the same functions, whatever their names, and none is lost, whatever a run does."""

import gc
import importlib
import os
import sys
import weakref
from collections import defaultdict
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
import pytest

from tests.compiled import pendulum_under
from tests.problems import pendulum as bare_pendulum
from twoloop import sweep
from twoloop.generate import straight_code
from twoloop.kernels.compile.caches import Newest
from twoloop.mechanisms import Problem
from twoloop.sweeps import shared_out, workers
from twoloop.sweeps.digests import digest_of

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


MODULE = """
import helpers, twoloop
class Base:
    OFFSET = {0}
class Law(Base):
    def __init__(self): self.scale = helpers.SCALE
    def __call__(self): return self.scale + helpers.nested() + self.OFFSET
LAW = Law()
def measure(problem, result):
    return {{"x": LAW()}}
"""
HELPERS = "SCALE = {0}\nimport inner\ndef nested(): return inner.deep()\n"


def test_code_in_other_files_and_in_classes_counts(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    names, digests = ("inner", "helpers", "law"), {}
    for case, values in {
        "as it was": (1, 1, 1),
        "again": (1, 1, 1),
        "class": (2, 1, 1),
        "global": (1, 2, 1),
        "deep": (1, 1, 2),
    }.items():
        for name, text in zip(names, ("def deep(): return {2}\n", HELPERS.replace("{0}", "{1}"), MODULE), strict=True):
            (tmp_path / f"{name}.py").write_text(text.format(*values))
            sys.modules.pop(name, None)
        importlib.invalidate_caches()
        digests[case] = digest_of("measure", importlib.import_module("law").measure)
    for name in names:
        sys.modules.pop(name)
    assert digests.pop("again") == digests["as it was"] and len(set(digests.values())) == 4


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


def test_a_digest_ends_with_what_holds_itself():
    ring = [1.0]
    ring.append(ring)

    def again(n):
        return again(n - 1) if n else ring

    assert digest_of("it", again) == digest_of("it", again)


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


class Lost(ThreadPoolExecutor):
    """A cluster that loses every task with run 2 in it."""

    def get_executor(self, pure):
        return self

    def submit(self, function, work, given):
        if {"k": 2} in given:
            return super().submit(self.lose)
        return super().submit(function, work, given)

    def lose(self):
        raise RuntimeError("the worker was killed")


def test_a_cluster_that_loses_a_worker_loses_one_run(monkeypatch):
    monkeypatch.setattr(shared_out, "BATCHES", 1)
    rows = sweep(swinging, RUNS, measure=plain, client=Lost(1), workers=1, **QUICK)
    assert [k for k, status in enumerate(rows["status"]) if status != "REACHED_END"] == [2]
    assert rows.loc[2, "message"] == "RuntimeError: the worker was killed"


def fails_when_it_is_read(k):
    return swinging(k)


def test_a_worker_that_cannot_begin_is_an_error(monkeypatch):
    monkeypatch.setattr(fails_when_it_is_read, "__module__", "__main__")  # where no other process finds it
    monkeypatch.setattr(sys.modules["__main__"], "fails_when_it_is_read", fails_when_it_is_read, raising=False)
    with pytest.raises(RuntimeError, match=r"ended with exit code 1 before its first run.*if __name__ == '__main__'"):
        sweep(fails_when_it_is_read, RUNS[:3], measure=plain, workers=1, **QUICK)


# --- memory
def swinging_under(gravity):
    return Problem("swing", pendulum_under(gravity), np.array([-1.0, 0.0]), np.zeros(2), (0.0, 0.01), energy)


@pytest.mark.usefixtures("collected_alone")
def test_what_is_compiled_for_a_run_is_let_go(monkeypatch):
    monkeypatch.setattr("twoloop.kernels.compile.caches.MOST_HELD", 1)
    held, made = [], straight_code.SharedCode

    class Watched(made):
        def __init__(self, *given):
            super().__init__(*given)
            held.append(weakref.ref(self.functions))
            held.append(weakref.ref(self))

    monkeypatch.setattr(straight_code, "SharedCode", Watched)
    kept = defaultdict(Newest)
    monkeypatch.setattr("twoloop.kernels.compile.own_functions._MADE", kept)  # what other tests hold has no part in it
    options = {"measure": plain, "parallel": "threads", "workers": 1, "compiled": True, "method": "DOP853", **QUICK}
    # 0, 1 and -1 stand in the code
    rows = sweep(swinging_under, [{"gravity": gravity} for gravity in (9.0, 1.0, -1.0, 0.0)], **options)
    assert set(rows["status"]) == {"REACHED_END"}, rows["message"].tolist()
    assert len(held) == 8
    gc.collect()
    assert sum(each() is not None for each in held) <= 2 and len(kept["equations"]) == len(kept["stages"]) == 1
