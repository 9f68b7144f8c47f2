"""Results in files, written after a run or as its states come, and read back."""

import os
import shutil
import signal
import subprocess
import sys
import tracemalloc
from contextlib import nullcontext
from dataclasses import fields

import numpy as np
import pytest

import twoloop
from tests.problems import at_one, pendulum, run, swing, worst
from tests.processes import ROOT
from twoloop import Result, Statistics, Status
from twoloop.mechanisms import closed_chain
from twoloop.run import course

EVERY = [field.name for field in fields(Result) if field.name != "sol"]
TELLS = [name for name in EVERY if name not in ("stats", "system", "redundant")]


def same(one, other, names=EVERY):
    for name in names:
        a, b = getattr(one, name), getattr(other, name)
        if isinstance(a, list):
            assert len(a) == len(b)
            assert all((x == y).all() and x.shape == y.shape for x, y in zip(a, b, strict=True)), name
        elif isinstance(a, np.ndarray):
            assert a.dtype == b.dtype and a.shape == b.shape and (a == b).all(), name
        else:
            assert type(a) is type(b) and a == b, name


@pytest.mark.parametrize("method", ["SunRadau5", "Gauss12", "BDF", "RadauIIA5", "RadauIIA13", "Taylor"])
def test_there_and_back(default_four_bar, tmp_path, method):
    result = run(default_four_bar, 1.0, method=method, dense_output=True, events=at_one())
    result.save(tmp_path / "run.npz")
    again = twoloop.load(tmp_path / "run.npz", default_four_bar.system)
    same(result, again)
    again.save(tmp_path / "again.npz")  # what is between its steps cannot be found anew
    again = twoloop.load(tmp_path / "again.npz", default_four_bar.system)
    t = np.linspace(0.0, 1.0, 57)
    one, other = result.sol(t), again.sol(t)
    assert np.abs(one.q - other.q).max() < 1e-12 and np.abs(one.v - other.v).max() < 1e-11
    assert np.abs(one.lam - other.lam).max() < 1e-9 and (again.sol.t_min, again.sol.t_max) == (0.0, 1.0)


@pytest.mark.parametrize(
    ("says", "needs"),
    [
        (lambda result: result.certify(), "certify needs the system"),
        (lambda result: result.reactions("O").force.tolist(), "reactions"),
        (twoloop.citation, ""),
    ],
    ids=["certificate", "reactions", "citation"],
)
def test_a_result_from_a_file_says_what_it_said(default_four_bar, tmp_path, says, needs):
    result = run(default_four_bar, 0.5, dense_output=True)
    result.save(tmp_path / "run.npz")
    assert says(twoloop.load(tmp_path / "run.npz", default_four_bar.system)) == says(result)
    with pytest.raises(ValueError, match=rf"{needs}.*twoloop\.load\(path, system\)") if needs else nullcontext():
        says(twoloop.load(tmp_path / "run.npz"))


def test_a_run_that_an_event_ended(default_four_bar, tmp_path):
    result = run(default_four_bar, 1.0, dense_output=True, events=[at_one(True), at_one()])
    result.save(tmp_path / "run.npz")
    again = twoloop.load(str(tmp_path / "run.npz"), default_four_bar.system)
    same(result, again)
    assert again.status is Status.EVENT
    with pytest.raises(ValueError, match="must lie within the run"):
        again.sol(result.t[-1] + 1e-6)


def test_what_ends_alone_serve_best_is_read_back(tmp_path):
    """No steps divide an interval before a force that has no value from there on."""
    falling = twoloop.ConstrainedSystem.from_python(
        n_q=2,
        n_c=1,
        mass=np.eye(2),
        force=lambda t, q, v: np.array([np.nan if t > 1.0 else 0.0, -9.81]),
        constraint=lambda t, q: np.array([0.5 * (q @ q - 1.0)]),
    )
    result = twoloop.solve_dae(falling, (0.0, 3.0), [1.0, 0.0], [0.0, 0.0], dense_output=True)
    assert result.status is Status.NOT_FINITE
    result.save(tmp_path / "run.npz")
    again = twoloop.load(tmp_path / "run.npz", falling)
    t = np.linspace(0.9, result.t[-1], 20)
    assert (again.sol(t).q == result.sol(t).q).all()


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
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"t_eval": np.linspace(0.0, 1.0, 30)},
        {"t_eval": np.linspace(0.1, 0.9, 30), "dense_output": True, "events": at_one()},
        {"method": "RadauIIA13", "dense_output": True},
        {"step_size": 0.01, "t_eval": [0.5, 0.8], "method": "Gauss12"},
        {"method": "Newmark", "rtol": 1e-4, "atol": 1e-4},
        {"dense_output": True, "events": [at_one(True)]},
        {"t_eval": [0.0, 0.1, 0.2, 0.9], "events": at_one(True)},
        {"max_steps": 5},
        {"max_steps": 5, "t_eval": [0.3], "dense_output": True},
    ],
)
def test_a_stored_run_is_the_same_as_another(default_four_bar, tmp_path, options):
    expected, found = (run(default_four_bar, 1.0, **options, **more) for more in ({}, {"store": tmp_path / "run"}))
    again = twoloop.load(tmp_path / "run", default_four_bar.system)
    between = "t_eval" in options and "step_size" not in options  # where other times make another partition
    same(expected, found, [name for name in TELLS if not (between and name in ("a", "lam"))])
    assert worst(found.a, expected.a) < 1e-10 and worst(found.lam, expected.lam) < 1e-10
    same(found, again, TELLS)
    assert again.stats == found.stats
    if expected.sol is not None:
        t = np.linspace(expected.sol.t_min, expected.sol.t_max, 101)
        one, others = expected.sol(t), (found.sol(t), again.sol(t))
        assert all((getattr(one, name) == getattr(other, name)).all() for other in others for name in ("q", "v", "lam"))


@pytest.mark.parametrize("options", [{}, {"t_eval": True}, {"dense_output": True}])
def test_the_memory_holds_a_part_only(tmp_path, options, monkeypatch):
    """Counted is what NumPy asks for: files that are mapped are not among it."""
    monkeypatch.setattr(course, "BUFFER_ROWS", 64)
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


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
@pytest.mark.parametrize("name", ["SIGINT", "SIGKILL"])
def test_ctrl_c_and_the_death_of_the_process(default_four_bar, tmp_path, name):
    command = [sys.executable, "-c", DIES, str(tmp_path / "run"), name]
    out = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    found = twoloop.load(tmp_path / "run", default_four_bar.system)
    assert found.status is Status.INTERRUPTED and 1.0 < found.t[-1] < 4.5
    known = run(default_four_bar, 5.0, max_step=1e-3)
    assert worst(found.q, known.q[:, : found.t.size]) < 1e-10
    if name == "SIGINT":
        assert "Interrupted from the keyboard" in found.message
        assert out.stdout.split() == ["INTERRUPTED", str(found.t[-1]), str(found.t.size)]
    else:
        assert out.returncode == -signal.SIGKILL and "The run was interrupted" in found.message
        assert found.h.size in (found.t.size - 1, found.t.size)
