"""Two commits side by side: the same folder twice is equal, a slower side is seen, work trees come and go."""

import subprocess

import pytest

from studies import bench_commits
from studies.bench import cli
from studies.bench.cli import ROOT, StudyError
from studies.bench_commits import compared, measure, work_tree
from studies.bench_side import START, step
from twoloop import solve_dae
from twoloop.mechanisms import four_bar


def measured(cpu, **counts):
    return {"step": [{"cpu": each, "counts": counts} for each in cpu]}


@pytest.mark.slow
def test_the_same_folder_twice_does_the_same_work():
    found = measure({"a": ROOT, "b": ROOT}, (START, "Adams", "Unknown"), 2)
    a, b = found["a"]["Adams"], found["b"]["Adams"]
    assert len(a) == len(b) == 2 and a[0]["counts"] == b[0]["counts"]
    assert a[0]["counts"]["steps"] > 500 and a[0]["cpu"] > 0.0
    assert len(found["a"][START]) == 1  # of a start there is one
    assert "ValueError" in found["a"]["Unknown"][0]["error"]
    lines = {line[0]: line for line in compared(found, ("a", "b"))}
    assert lines["Unknown"][1:4] == ["ValueError", "ValueError", "–"] and "→" not in lines["Adams"][-1]


def test_medians_ratio_and_counts_are_of_both_sides():
    found = {"a": measured((1e-6, 9e-6, 2e-6), steps=5), "b": measured((4e-6, 4e-6, 4e-6), steps=6)}
    assert list(compared(found, ("a", "b"))) == [["step", "2.0", "4.0", "2.0", "5 → 6 steps"]]
    assert next(compared(found, ("a", "a")))[3] == "="


def test_a_side_that_ends_is_an_error(tmp_path):
    with pytest.raises(StudyError, match="the process of old ended without an answer to 'Adams'"):
        measure({"old": broken(tmp_path)}, ("Adams",), 1)


def broken(path):
    """A folder whose package cannot be imported."""
    (path / "twoloop").mkdir()
    (path / "twoloop" / "__init__.py").write_text("raise ImportError('nothing here')\n")
    return path


def test_a_work_tree_is_made_and_removed(tmp_path):
    def git(*words):
        identity = ["-c", "user.name=a", "-c", "user.email=a@b"]
        subprocess.run(["git", "-C", str(tmp_path), *identity, *words], check=True, capture_output=True)

    git("init")
    (tmp_path / "file").write_text("one")
    git("add", "file")
    git("commit", "-m", "first")
    with work_tree("HEAD", tmp_path) as folder:
        assert (folder / "file").read_text() == "one"
    assert not folder.exists()
    with pytest.raises(StudyError, match="there is no work tree of 'nothing'"), work_tree("nothing", tmp_path):
        pass


def test_the_same_commit_twice_is_refused():
    with pytest.raises(SystemExit, match="base and head are the same"):
        cli.main(bench_commits._work, ["HEAD", "--head", "HEAD"])


def test_a_step_is_timed_and_its_counts_are_told():
    made = step(solve_dae, four_bar(), "Adams")
    assert made["counts"]["evaluations"] > made["counts"]["steps"] > 500 and made["cpu"] > 0.0
    with pytest.raises(ValueError, match="method"):
        step(solve_dae, four_bar(), "Unknown")
