"""Results in files, written after a run or as its states come, and read back."""

import json
import os
import shutil
import signal
import subprocess
import sys
import tracemalloc
import warnings
from contextlib import nullcontext
from dataclasses import fields

import numpy as np
import pytest

import twoloop
from tests.problems import at_one, pendulum, quick, run, swing, worst
from tests.processes import ROOT
from twoloop import Result, Statistics, Status
from twoloop.bodies import PlanarModel
from twoloop.mechanisms import closed_chain, four_bar
from twoloop.run import loop

FIELDS = [field.name for field in fields(Result) if field.name != "sol"]
COMPARED = [name for name in FIELDS if name not in ("stats", "system", "redundant")]


def same(first, second, names=FIELDS):
    for name in names:
        a, b = getattr(first, name), getattr(second, name)
        if isinstance(a, list):
            assert len(a) == len(b)
            assert all((x == y).all() and x.shape == y.shape for x, y in zip(a, b, strict=True)), name
        elif isinstance(a, np.ndarray):
            assert a.dtype == b.dtype and a.shape == b.shape and (a == b).all(), name
        else:
            assert type(a) is type(b) and a == b, name


@pytest.mark.parametrize("method", quick(["Taylor", "Gauss12", "BDF", "RadauIIA13"], 2))
def test_there_and_back(default_four_bar, tmp_path, method):
    result = run(default_four_bar, 1.0, method=method, dense_output=True, events=at_one())
    result.save(tmp_path / "run.npz")
    loaded = twoloop.load(tmp_path / "run.npz", default_four_bar.system)
    same(result, loaded)
    loaded.save(tmp_path / "again.npz")  # what is between its steps cannot be found anew
    loaded = twoloop.load(tmp_path / "again.npz", default_four_bar.system)
    t = np.linspace(0.0, 1.0, 57)
    expected, actual = result.sol(t), loaded.sol(t)
    assert np.abs(expected.q - actual.q).max() < 1e-12 and np.abs(expected.v - actual.v).max() < 1e-11
    assert np.abs(expected.lam - actual.lam).max() < 1e-9 and (loaded.sol.t_min, loaded.sol.t_max) == (0.0, 1.0)


SAYS = {
    "certificate": (lambda result: result.certify(), "certify needs the system"),
    "citation": (twoloop.citation, ""),
}
SAYS["reactions"] = lambda result: result.reactions("O").force.tolist(), "reactions"


@pytest.mark.parametrize(("says", "needs"), SAYS.values(), ids=SAYS)
def test_a_result_from_a_file_says_what_it_said(default_four_bar, tmp_path, says, needs):
    result = run(default_four_bar, 0.5, dense_output=True)
    result.save(tmp_path / "run.npz")
    assert says(twoloop.load(tmp_path / "run.npz", default_four_bar.system)) == says(result)
    with pytest.raises(ValueError, match=rf"{needs}.*twoloop\.load\(path, system\)") if needs else nullcontext():
        says(twoloop.load(tmp_path / "run.npz"))


def test_failures_and_what_foreign_solvers_do_not_tell(tmp_path):
    swing(max_steps=3).save(tmp_path / "failed.npz")
    assert twoloop.load(tmp_path / "failed.npz").status is Status.MAX_STEPS
    row = np.zeros((1, 2))
    result = Result(row[0], row, row, row, row, row[0], Status.SOLVER_FAILED, "said: äöü", Statistics(n_outer=3))
    result.save(tmp_path / "foreign.npz")
    same(result, twoloop.load(tmp_path / "foreign.npz"))


@pytest.mark.parametrize("content", [b"", b"no archive", None, "pickled"])
def test_other_files_are_refused(tmp_path, content):
    path = tmp_path / "other.npz"
    if content is None:
        np.savez(path, t=np.zeros(3))
    elif content == "pickled":
        np.savez(path, words=np.array([{"format": 1}], dtype=object))
    else:
        path.write_bytes(content)
    with pytest.raises(ValueError, match=r"path must lead to a file written by Result.save; .*other.npz"):
        twoloop.load(path)


# --- runs whose states go to the disk as they come
STORED = [
    {},
    {"t_eval": np.linspace(0.1, 0.9, 30), "dense_output": True, "events": at_one()},
    {"dense_output": True, "events": [at_one(True)]},
    {"max_steps": 5, "t_eval": [0.3], "dense_output": True},
    {"method": "RadauIIA13", "dense_output": True},
    {"step_size": 0.01, "t_eval": [0.5, 0.8], "method": "Gauss12"},
    {"t_eval": [0.0, 0.1, 0.2, 0.9], "events": at_one(True)},
]


@pytest.mark.parametrize("options", quick(STORED, 4))
def test_a_stored_run_is_the_same_as_another(default_four_bar, tmp_path, options):
    expected, stored = (run(default_four_bar, 1.0, **options, **store) for store in ({}, {"store": tmp_path / "run"}))
    loaded = twoloop.load(tmp_path / "run", default_four_bar.system)
    between = "t_eval" in options and "step_size" not in options  # where other times make another partition
    same(expected, stored, [name for name in COMPARED if not (between and name in ("a", "lam"))])
    assert worst(stored.a, expected.a) < 1e-10 and worst(stored.lam, expected.lam) < 1e-10
    same(stored, loaded, COMPARED)
    assert loaded.stats == stored.stats
    if expected.sol is not None:
        t = np.linspace(expected.sol.t_min, expected.sol.t_max, 101)
        state, states = expected.sol(t), (stored.sol(t), loaded.sol(t))
        assert all(
            (getattr(state, name) == getattr(other, name)).all() for other in states for name in ("q", "v", "lam")
        )


@pytest.mark.parametrize("options", quick([{}, {"t_eval": True}, {"dense_output": True}]))
def test_the_memory_holds_a_part_only(tmp_path, options, monkeypatch):
    """Counted is what NumPy asks for: files that are mapped are not among it."""
    monkeypatch.setattr(loop, "BUFFER_ROWS", 64)
    problem, peaks, stored = closed_chain(12), [], []
    run(problem, 0.1, dense_output=True)  # traced and compiled
    for end in (20.0, 40.0):
        times = {"t_eval": np.linspace(0.0, end, int(200.0 * end))} if options.get("t_eval") else {}
        tracemalloc.start()
        result = run(problem, end, rtol=1e-7, atol=1e-7, max_step=0.005, **options | times, store=tmp_path / f"{end}")
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        stored.append(sum(getattr(result, name).nbytes for name in ("t", "q", "v", "a", "lam")))
    assert peaks[1] - peaks[0] < 0.2 * (stored[1] - stored[0])
    before = result.q[0, 0]
    result.q[0, 0] = 7.0  # as in memory, and not in the file
    assert twoloop.load(tmp_path / "40.0").q[0, 0] == before


def test_a_callback_that_raises_leaves_what_was_there(tmp_path):
    def broken(t, q, v):
        if t > 0.5:
            raise RuntimeError("broken")
        return np.array([0.0, -9.81])

    with pytest.raises(RuntimeError, match="broken"):
        swing(system=pendulum(force=broken), max_step=0.001, store=tmp_path / "run")
    found = twoloop.load(tmp_path / "run")
    assert found.status is Status.INTERRUPTED and "The run was interrupted" in found.message
    assert found.t[-1] > 0.0 and found.h.size == found.t.size - 1
    shutil.copytree(tmp_path / "run", tmp_path / "killed")  # by a signal, with one array written and others not
    np.save(tmp_path / "killed" / "t.npy", found.t[:-1])
    found = twoloop.load(tmp_path / "killed")
    assert found.q.shape == found.v.shape == (2, found.t.size) and found.lam.shape == (1, found.t.size)


DIES = """
import os, signal, sys
from twoloop import solve_dae
from twoloop.mechanisms import four_bar
signal.signal(signal.SIGINT, signal.default_int_handler)  # which a shell takes away in the background
problem, seen = four_bar(), []
def event(t, q, v):
    if t > 3.0 and not seen:
        seen.append(t)
        os.kill(os.getpid(), getattr(signal, sys.argv[2]))
    return 1.0
result = solve_dae(problem.system, (0.0, 5.0), problem.q0, problem.v0, max_step=1e-3, events=event, store=sys.argv[1])
print(result.status.name, result.t[-1], result.t.size)
"""


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
@pytest.mark.parametrize("name", quick(["SIGKILL", "SIGINT"]))
def test_ctrl_c_and_the_death_of_the_process(default_four_bar, tmp_path, name):
    command = [sys.executable, "-c", DIES, str(tmp_path / "run"), name]
    out = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    stored = twoloop.load(tmp_path / "run", default_four_bar.system)
    assert stored.status is Status.INTERRUPTED and 1.0 < stored.t[-1] < 4.5
    expected = run(default_four_bar, 5.0, max_step=1e-3)
    assert worst(stored.q, expected.q[:, : stored.t.size]) < 1e-10
    if name == "SIGINT":
        assert "Interrupted from the keyboard" in stored.message
        assert out.stdout.split() == ["INTERRUPTED", str(stored.t[-1]), str(stored.t.size)]
    else:
        assert out.returncode == -signal.SIGKILL and "The run was interrupted" in stored.message
        assert stored.h.size in (stored.t.size - 1, stored.t.size)


# --- files of results with anything in them: a `ValueError` that names the field, and never a crash
@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    path = tmp_path_factory.mktemp("saved") / "run.npz"
    run(four_bar(), 0.5, method="Gauss12", dense_output=True, events=at_one()).save(path)
    return path


def changed(saved, folder, change):
    """The file with other contents, as a file of before there were check sums."""
    with np.load(saved) as file:
        arrays = {name: file[name] for name in file.files}
    words = json.loads(str(arrays.pop("words")))
    del words["check_sums"]
    change(arrays, words)
    path = folder / "changed.npz"
    np.savez(path, words=np.array(json.dumps(words)), **arrays)
    return path


def entry(name, place, value):
    def change(arrays, words):
        arrays[name][place] = value

    return change


def array(name, make):
    def change(arrays, words):
        arrays[name] = make(arrays[name])

    return change


def word(name, value):
    return lambda arrays, words: words.update({name: value})


def gone(name):
    return lambda arrays, words: (arrays if name in arrays else words).pop(name)


CASES = {
    "no times": ("t ", gone("t")),
    "a time that is none": ("t ", entry("t", 2, np.nan)),
    "times out of order": ("t ", array("t", lambda t: t[::-1].copy())),
    "a time twice": ("sol_t", entry("sol_t", slice(2, 4), 0.01)),
    "fewer columns": ("v ", array("v", lambda v: v[:, :-1])),
    "fewer coordinates": ("a ", array("a", lambda a: a[:-1])),
    "single precision": ("q ", array("q", lambda q: q.astype(np.float32))),
    "text": ("lam", array("lam", lambda lam: lam.astype("U5"))),
    "narrower rows": ("sol_states", array("sol_states", lambda x: x[:, :-1])),
    "a state that is no number": ("sol_states", entry("sol_states", (1, 3), np.nan)),
    "a kind beyond all": ("sol_kinds", entry("sol_kinds", 0, 4)),
    "kinds for more steps": ("sol_kinds", array("sol_kinds", lambda kinds: np.append(kinds, 2))),
    "interior times without states": ("sol_interior_states", gone("sol_interior_states")),
    "interior times elsewhere": ("sol_interior_t", entry("sol_interior_t", (1, 0), 0.123456)),
    "interior states that are no numbers": ("sol_interior_states", entry("sol_interior_states", (1, 1, 0), np.nan)),
    "no rank": ("sol_ranks", word("sol_ranks", [3, 8])),
    "ranks beyond the rows": ("sol_ranks", word("sol_ranks", [8, 10**9])),
    "an end outside": ("sol_end", word("sol_end", 1e9)),
    "a number of any digits": ("sol_rtol", word("sol_rtol", 10**400)),
    "counts below zero": ("rejected_error", entry("rejected_error", 0, -1)),
    "rows that are none": ("redundant", array("redundant", lambda rows: np.array([99]))),
    "events that are missing": ("t_events_1", word("n_events", 2)),
    "events of other coordinates": ("q_events_0", array("q_events_0", lambda q: q[:, :-1])),
    "a status of none": ("status", word("status", 17)),
    "statistics of none": ("stats", word("stats", {"n_accepted": -3})),
    "no message": ("message", gone("message")),
    "sizes of steps below zero": ("h ", entry("h", 0, -1.0)),
}


@pytest.mark.parametrize("case", CASES)
def test_what_a_field_may_not_hold(case, saved, tmp_path):
    field, change = CASES[case]
    path = changed(saved, tmp_path, change)
    with pytest.raises(ValueError, match=f"(?s){field}.*(must be|are)"):
        twoloop.load(path, four_bar().system)


def test_a_field_whose_bytes_changed_is_named(saved, tmp_path):
    content = bytearray(saved.read_bytes())
    content[content.index(b"lam.npy") + 400] ^= 1
    path = tmp_path / "flipped.npz"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"flipped.npz' is none: lam cannot be read"):
        twoloop.load(path)


ODD = [-1, 0, 3, 10**9, 1e308, float("nan"), None, "x", [], {}, True, [3, 8], [9, 9]]


def test_nothing_in_a_file_ends_the_process(saved, tmp_path):
    rng, content, path = np.random.default_rng(4), saved.read_bytes(), tmp_path / "fuzzed.npz"

    def alter(arrays, words):
        name, way = list(arrays)[rng.integers(len(arrays))], rng.integers(4)
        array = arrays[name] = np.ascontiguousarray(arrays[name])
        if way == 0:
            words[list(words)[rng.integers(len(words))]] = ODD[rng.integers(len(ODD))]
        elif way == 1:
            arrays[name] = array.astype([np.float32, np.int64, bool][rng.integers(3)])
        elif way == 2:
            arrays[name] = array[..., : rng.integers(array.shape[-1] + 1)]
        elif array.size:
            array.view(np.uint8).reshape(-1)[rng.integers(array.nbytes)] ^= 1 << rng.integers(8)

    refused = []
    for k in range(120):
        if k % 2:
            changed(saved, tmp_path, alter).rename(path)
        else:
            other = bytearray(content)
            other[rng.integers(len(other))] ^= 1 << rng.integers(8)
            path.write_bytes(other[: rng.integers(len(other))] if k % 6 == 0 else other)
        try:
            with warnings.catch_warnings(action="ignore"):
                result = twoloop.load(path, four_bar().system)
                refused.append(False)
                assert result.sol is None or result.sol([result.sol.t_min, result.sol.t_max]).a.shape == (9, 2)
        except ValueError:
            refused.append(True)
    assert sum(refused) > 60 and not all(refused)  # both ways were tried


@pytest.mark.filterwarnings("ignore:the constraints of:twoloop.ConstraintWarning")
def test_a_dense_result_with_more_rows_than_coordinates_is_read_back(tmp_path):
    model = PlanarModel()
    model.rod("rod", (0.0, 0.0), (1.0, 0.0), mass=1.0)
    model.revolute("ground", "rod", at=(0.0, 0.0), name="hinge")
    for name in ("drive", "the same again"):
        model.drive("hinge", lambda t: 2.0 * t, name=name)
    problem = model.problem((0.0, 1.0))
    result = run(problem, 1.0, dense_output=True)
    result.save(tmp_path / "result.npz")
    np.testing.assert_allclose(twoloop.load(tmp_path / "result.npz", problem.system).sol(0.3).q, result.sol(0.3).q)
