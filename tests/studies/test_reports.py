"""The committed reports, and the numbers of README.md, are those of the committed rows."""

import json
import re
import shutil
from functools import cache

import pytest

from studies.bench.cli import REPORTS, ROOT
from studies.bench.render import number
from studies.bench.study import REPORTS as INDEX
from studies.bench.study import run_study

README = (ROOT / "README.md").read_text()
ENGINES = ("MuJoCo", "Pinocchio", "Exudyn")
WORDS = {"README.md": 900, "CHANGELOG.md": 1200, "CONTRIBUTING.md": 1200}


@cache
def findings(name):
    """Return the committed findings of a report."""
    return json.loads((REPORTS / f"{name}.json").read_text())


def words(*texts):
    """Count words, and those of the cells of tables."""
    return sum(len(re.sub(r"(?m)^\|[-:|]+$|\|", " ", text).split()) for text in texts)


@pytest.fixture(scope="module")
def copy(tmp_path_factory):
    """Return a folder with the committed rows, in which reports can be written."""
    folder = tmp_path_factory.mktemp("reports")
    for path in REPORTS.iterdir():
        if path.suffix in (".csv", ".npz", ".json"):
            shutil.copy(path, folder)
    return folder


@pytest.mark.slow  # draws all figures
@pytest.mark.parametrize("name", [name for name in INDEX if name != "table3"])  # `make table3` writes its rows anew
def test_a_report_is_what_its_rows_say(copy, name):
    run_study(name, ["--redraw", "--out", str(copy)])
    assert (copy / f"{name}.md").read_text() == (REPORTS / f"{name}.md").read_text()
    assert json.loads((copy / f"{name}.json").read_text()) == findings(name)


def milliseconds(solver, error):
    """Return the median time of a call, as README prints it."""
    return number(1e3 * findings("engines")["times"][solver][error]["call_s"])


def test_readme_has_the_times_of_engines():
    loose, tight = ({name: milliseconds(name, error) for name in ("twoloop", *ENGINES)} for error in ("1e-2", "1e-6"))
    n_cases = len(findings("engines")["cases"])
    told = f"of {n_cases} mechanisms: {loose['twoloop']} ms (MuJoCo {loose['MuJoCo']}, Pinocchio {loose['Pinocchio']}, "
    assert f"{told}Exudyn {loose['Exudyn']})" in README
    assert f"{tight['twoloop']} ms (MuJoCo {tight['MuJoCo']}, Pinocchio {tight['Pinocchio']})" in README
    reached = [findings("engines")["times"][name]["1e-6"]["reached"] for name in ENGINES]
    told = f"at 1e-6: MuJoCo {reached[0]},\nPinocchio {reached[1]}, Exudyn {reached[2]}, twoloop {n_cases} of {n_cases}"
    assert told in README
    assert all(at["reached"] == 11 for at in findings("engines")["times"]["twoloop"].values())
    slower = findings("engines")["against"]
    assert len(slower["1e-2"]["slower"]) == 4 and not slower["1e-6"]["slower"]
    assert "At 1e-2 an engine is faster on four, at 1e-6 none" in README


def test_readme_has_the_numbers_of_its_other_reports():
    violation, million = findings("reproduction")["violation"], findings("ensembles")["million"]
    assert violation["ours_q"] <= 1e-15
    assert f"At most 1e-15 m of violation over {violation['t_end']:.0f} s" in README
    assert f"each of {violation['n_ours']} methods and settings" in README
    assert (million["n_runs"], million["n_threads"], million["n_failed"]) == (1e6, 2, 0)
    assert f"four-bar linkages, {million['t_end']:.0f} s each, in {number(million['wall'])} s on two cores" in README
    table = findings("honesty")["table"]
    assert table["sharp"]["default"]["wrong"] == 0
    assert f"None of {table['sharp']['default']['n']} runs with sharp forces" in README
    short = [table[name]["default"] for name in ("gust_short", "pulse_short")]
    assert f"{sum(own['wrong'] for own in short)} of {sum(own['n'] for own in short)} runs" in README
    singular = [table["singular"][who] for who in ("default", "own", "others")]
    told = [f"{own['ended'] - own['wrong']} of {own['n']}" for own in singular]
    assert f"right in {told[0]} runs, `DOP853` and `compiled=False` in {told[1]}, IDA in {told[2]}." in README
    typical = {at["error"]: at["median"] for at in findings("work_precision")["typical"]}
    ratios = [number(typical[error]) for error in (1e-4, 1e-8, 1e-10)]
    assert "{} times our time at 1e-4 (median), but {} times at 1e-8 and {} times at 1e-10".format(*ratios) in README
    first = next(each for each in findings("work_precision")["first_calls"] if each["solver"] == "auto, compiled")
    assert f"takes up to {number(first['most'])} s ({first['n']} timed)" in README
    counts, untestable = findings("claims")["counts"], findings("claims")["untestable"]
    told = (
        f"{counts['holds']} hold, {counts['holds in part']} hold in part, {counts['does not hold']} do not hold, and "
    )
    assert told + f"{untestable} cannot be tested" in README
    assert f"Of {counts['holds'] + counts['holds in part'] + counts['does not hold'] + untestable} claims" in README


def test_what_people_read_is_short():
    for name, most in WORDS.items():
        assert words((ROOT / name).read_text()) <= most, name
    assert README.count("\n") <= 120
    reports = [path.read_text() for path in REPORTS.glob("*.md")]
    assert words(*reports) <= 7500 and max(map(words, reports)) <= 600
    pages = (path for path in (ROOT / "docs").glob("*.md") if path.name != "errors.md")
    assert words(*(path.read_text() for path in pages)) <= 22_000


def test_the_words_of_a_private_dialect_are_gone():
    folders = [(ROOT / "docs").glob("*"), (ROOT / "docs" / "reference").glob("*"), REPORTS.rglob("*")]
    files = [ROOT / "README.md", *(path for folder in folders for path in folder if path.is_file())]
    texts = [path for path in files if path.suffix in (".md", ".py", ".csv", ".json", ".svg", ".html")]
    assert not [path.name for path in texts if re.search(r"rival|rows not kept", path.read_text(), re.IGNORECASE)]
