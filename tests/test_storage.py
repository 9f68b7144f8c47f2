"""Results written to files and read back."""

from dataclasses import fields

import numpy as np
import pytest

import twoloop
from tests.problems import event, run, swing
from twoloop import Result, Statistics, Status


def raised(t, q, v):
    return q[8] - 1.0


def same(one, other):
    """Whether all but the dense solution is the same."""
    for field in fields(Result):
        if field.name == "sol":
            continue
        a, b = getattr(one, field.name), getattr(other, field.name)
        if isinstance(a, list):
            assert len(a) == len(b)
            assert all((x == y).all() and x.shape == y.shape for x, y in zip(a, b, strict=True)), field.name
        elif isinstance(a, np.ndarray):
            assert a.dtype == b.dtype and a.shape == b.shape and (a == b).all(), field.name
        else:
            assert type(a) is type(b) and a == b, field.name


@pytest.mark.parametrize("method", ["SunRadau5", "Gauss12", "BDF", "RadauIIA5", "RadauIIA13", "Taylor"])
def test_there_and_back(default_four_bar, tmp_path, method):
    result = run(default_four_bar, 1.0, method=method, dense_output=True, events=raised)
    result.save(tmp_path / "run.npz")
    again = twoloop.load(tmp_path / "run.npz", default_four_bar.system)
    same(result, again)
    again.save(tmp_path / "again.npz")  # what is between its steps cannot be found anew
    again = twoloop.load(tmp_path / "again.npz", default_four_bar.system)
    t = np.linspace(0.0, 1.0, 57)
    one, other = result.sol(t), again.sol(t)
    assert np.abs(one.q - other.q).max() < 1e-12 and np.abs(one.v - other.v).max() < 1e-11
    assert np.abs(one.lam - other.lam).max() < 1e-9 and (again.sol.t_min, again.sol.t_max) == (0.0, 1.0)


def test_without_the_system_there_is_no_dense_solution(default_four_bar, tmp_path):
    run(default_four_bar, 0.2, dense_output=True).save(tmp_path / "run")
    assert twoloop.load(tmp_path / "run").sol is None  # the name is as given, without .npz


def test_a_run_that_an_event_ended(default_four_bar, tmp_path):
    end = event(lambda t, q, v: q[8] - 1.0, terminal=True)
    result = run(default_four_bar, 1.0, dense_output=True, events=[end, raised])
    result.save(tmp_path / "run.npz")
    again = twoloop.load(str(tmp_path / "run.npz"), default_four_bar.system)
    same(result, again)
    assert again.status is Status.EVENT
    with pytest.raises(ValueError, match="must lie within the run"):
        again.sol(result.t[-1] + 1e-6)


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


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(FileNotFoundError):
        twoloop.load(tmp_path / "nothing.npz")
