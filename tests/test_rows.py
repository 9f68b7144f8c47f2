"""Rows of solvers: their format, what is wrong with a file, and the leaderboard of those that are shipped."""

import gzip
import inspect
import json
from pathlib import Path

import pytest

from twoloop import mechanisms
from twoloop.__main__ import main
from twoloop.rows import leaderboard, row_format
from twoloop.rows.leaderboard import ARCHIVE, boards, seconds, select_rows
from twoloop.rows.row_format import FIELDS, find_errors, format_rows, read_rows

ROW = {"schema": 1, "mechanism": "four_bar", "t_end": 10, "solver": "mine", "family": "me", "version": "3"}
ROW |= {"processor": "abacus", "setting": "tol", "value": 1e-6, "status": "REACHED_END", "times_s": [0.1, 0.11, 0.09]}
ROW |= {"error_end": 5e-7, "floor_end": 1e-13}


def row(**more):
    return {name: value for name, value in (ROW | more).items() if value is not ...}


@pytest.mark.parametrize(
    ("more", "says"),
    [
        ({"schema": 2}, "schema: given 2, expected 1"),
        ({"schema": True}, "schema: given true, expected 1"),
        ({"speed": 1.0}, "speed: there is no such field"),
        ({"solver": ...}, "solver: missing, expected printable text"),
        ({"solver": "a\nb"}, r'solver: given "a\\nb", expected printable text'),
        ({"t_end": 0}, "t_end: given 0, expected a number > 0"),
        ({"t_end": "10"}, 't_end: given "10", expected a number > 0'),
        ({"value": 10**400}, "value: given 1000"),
        ({"value": True}, "value: given true"),
        ({"setting": "rtol"}, 'setting: given "rtol", expected one of tol, h, err_out'),
        ({"times_s": 0.1}, "times_s: given 0.1, expected a list of numbers > 0"),
        ({"times_s": []}, "expected a time at least of a run that is REACHED_END"),
        ({"error_end": ...}, "error: missing, expected it, or error_end"),
        ({"floor_end": ...}, "floor_end: missing, expected a number >= 0 beside error_end"),
        ({"astray": 0}, "astray: given 0, expected true or false"),
        ({"called_from": "C"}, 'called_from: given "C", expected compiled or Python'),
        ({"calibration_s": 0.1}, "calibration: expected beside calibration_s"),
        ({"status": "reached end"}, 'status: given "reached end", expected REACHED_END in these letters'),
        ({"solver": "mine "}, 'solver: given "mine ", expected printable text, no blanks around it'),
    ],
)
def test_a_mistake_is_named_by_line_and_field(more, says):
    rows, found = find_errors(
        ["", format_rows([row()]), format_rows([row(value=1e-7, **{}) | {}]), format_rows([row(**more)])]
    )
    assert len(rows) == 2 and found and all(each.startswith("line 4: ") for each in found)
    assert any(says.replace("\\\\", "\\") in each for each in found), found


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("{", 'given "{", expected a JSON object on a line of its own: '),
        (json.dumps(row(value=float("nan"))), "value: given NaN, expected a number > 0; leave out what is not known"),
        (json.dumps(row(times_s=[0.1, float("nan")])), "times_s: given [0.1, NaN], expected a list of numbers > 0"),
        (format_rows([row()])[:-2] + ',"t_end":3}', "t_end stands twice"),
        (format_rows([row(times_s=[5.0])]), "the run of line 1 again"),
        ("[" * 100_000, "expected a JSON object"),
    ],
)
def test_lines_that_are_no_rows(line, says):
    rows, found = find_errors([format_rows([row()]), line])
    assert len(rows) == 1 and len(found) == 1 and found[0].startswith("line 2: ") and says in found[0]


def test_files_are_checked_from_the_command_line(tmp_path, capsys, monkeypatch):
    good, bad, none = (tmp_path / name for name in ("good.jsonl.gz", "bad.jsonl", "none.jsonl"))
    good.write_bytes(
        gzip.compress(format_rows([row(), row(status="RAISED", times_s=[], error_end=..., value=1)]).encode())
    )
    main(["rows", "check", str(good)])
    assert "2 good rows, of 1 solvers on 1 mechanisms" in capsys.readouterr().out
    bad.write_text(30 * format_rows([row(schema=0)]))
    none.write_text("\n")
    with pytest.raises(SystemExit, match="1"):
        main(["rows", "check", str(good), str(bad)])
    out = capsys.readouterr().out
    assert "bad.jsonl: line 1: schema: given 0, expected 1" in out and "0 good rows" in out and "30 mistakes" in out
    for path, says in ((bad, "line 1: schema"), (none, "has no rows"), (tmp_path, "cannot be read")):
        with pytest.raises(ValueError, match=says):
            read_rows(path)
    mark = tmp_path / "mark.jsonl"
    mark.write_bytes(b"\xef\xbb\xbf" + format_rows([row(mechanism="fuor_bar")]).encode())
    main(["rows", "check", str(mark)])
    assert "'fuor_bar' is taken for one of your own; the ready one is 'four_bar'" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        main(["rows", "check", str(none)])
    assert "there is no row" in capsys.readouterr().out
    monkeypatch.setattr(row_format, "MAX_BYTES", 50)
    with pytest.raises(ValueError, match=r"good\.jsonl\.gz cannot be read: more than 5e"):
        read_rows(good)
    monkeypatch.undo()
    (tmp_path / "cut.jsonl.gz").write_bytes(good.read_bytes()[:-12])
    (tmp_path / "bent.jsonl.gz").write_bytes(good.read_bytes()[:15] + b"\xff" + good.read_bytes()[16:])
    for name in ("cut", "bent"):
        with pytest.raises(ValueError, match="cannot be read"):
            read_rows(tmp_path / f"{name}.jsonl.gz")


def run(solver, error, time, n=5, **more):
    times = [time * (1.0 + 0.01 * k) for k in range(n)]
    return row(**{"solver": solver, "error_end": error, "value": error, "times_s": times} | more)


def test_solvers_are_compared_at_equal_error_on_one_processor():
    rows = [run("fast", 10.0**-5.5, 0.1), run("fast", 10.0**-6.5, 0.4), run("slow", 1e-6, 0.8)]
    rows += [run("near", 1e-6, 0.205)]
    rows += [run("once", 1e-6, 0.3, 1), run("precise", 1e-12, 0.01), run("coarse", 1e-3, 0.01)]
    rows += [run("fast", 1e-6, 0.001, processor="another"), run("dead", ..., 1.0, 0, value=1e-6, status="RAISED")]
    rows[-1]["message"] = "it fell"
    here, there = boards(rows, 1e-6)
    assert [each.solver for each in here.entries] == ["fast", "near", "once", "slow"]
    assert [each.doubt for each in here.entries] == ["undecided", "undecided", "few runs", ""]
    assert here.entries[0].seconds == pytest.approx(0.204, rel=1e-6)  # on the log-log line of medians
    assert there.entries[0].seconds == pytest.approx(0.00102) and there.processor == "another"
    assert dict(here.others) == {
        "precise": "at most 10.2 ms, of a run with the error 1e-12",
        "coarse": "least error 0.001",
        "dead": "raised: it fell",
    }
    assert "abacus" in str(here) and "few runs" in str(here) and not boards([], 1e-6)
    assert not boards([run("fast", 1e-5, 0.1)], 1e-14)[0].entries
    assert boards([run("fast", 1e-5, 0.1)], 1e-14)[0].others[0][1] == "the reference resolves 1e-13"
    both = row(error=1e-6, floor=1e-13)
    assert [board.measure for board in boards([both], 1e-6)] == ["error_end", "error"]
    assert [seconds(value) for value in (2.0, 0.0123, 4.56e-5, 0.9999)] == ["2 s", "12.3 ms", "45.6 us", "1 s"]


def test_the_rows_that_are_shipped(tmp_path):
    rows = read_rows(ARCHIVE)
    assert ARCHIVE.stat().st_size < 1_000_000
    assert len({each["mechanism"] for each in rows}) > 20 and {each["family"] for each in rows} > {"two-loop", "SciPy"}
    assert all(each["version"] not in ("", "unknown") for each in rows)
    ready = {name for name in mechanisms.__all__ if inspect.isfunction(getattr(mechanisms, name))}
    assert len(ready & {each["mechanism"] for each in rows}) >= 18
    assert all(each["t_end"] == 10 for each in select_rows(rows, "four_bar", 10.0))
    here, *others = boards(select_rows(rows, "four_bar", 10.0), 1e-6)
    assert not others and len(here.entries) > 20 and here.measure == "error_end"


@pytest.fixture
def small(tmp_path, monkeypatch):
    """An archive of two rows."""
    (tmp_path / "small.jsonl").write_text(format_rows([row(), row(t_end=100, processor="slate")]))
    monkeypatch.setattr(leaderboard, "ARCHIVE", tmp_path / "small.jsonl")


@pytest.mark.usefixtures("small")
def test_the_leaderboard(tmp_path, capsys):
    mine = tmp_path / "mine.jsonl"
    mine.write_text(format_rows([row(solver="yours", times_s=[1e-3] * 5, calibration="a", calibration_s=1e-2)]))
    main(["leaderboard", "--mechanism", "four_bar", "--t-end", "10", "--with", str(mine)])
    out = capsys.readouterr().out
    assert out.count("four_bar to 10 s") == 1 and "100 s" not in out and "time: CPU time of the whole call" in out
    title, _, yours, other = out.splitlines()[:4]
    assert "abacus" in title and yours.split() == ["yours", "1", "ms", "1", "0.1", "3"]
    assert other.split()[:4] == ["mine", "100", "ms", "100"]
    for words, says in (
        (["--mechanism", "five_bar"], "there are no rows of the mechanism 'five_bar'; there are some of four_bar"),
        (["--mechanism", "four_bar", "--t-end", "3"], "rows of four_bar end at 10, 100 s; given 3 s"),
        (["--mechanism", "four_bar", "--error", "0"], "--error must be between 0 and 1"),
        (["--mechanism", "four_bar", "--error", "nan"], "--error must be between 0 and 1"),
        (["--mechanism", "four_bar", "--with", "none.jsonl"], "none.jsonl cannot be read"),
    ):
        with pytest.raises(SystemExit, match=f"error: {says}"):
            main(["leaderboard", *words])


def test_the_page_says_what_the_fields_are():
    page = (Path(__file__).parents[1] / "docs" / "reference" / "rows.md").read_text(encoding="utf-8")
    for name, field in FIELDS.items():
        assert f"| `{name}` | {field.expected} | {field.about}{'' if field.needed else '; may be left out'} |" in page
