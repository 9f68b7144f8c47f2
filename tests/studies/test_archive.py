"""The rows in the wheel are those of work_precision.csv, and mechanisms have one name in all rows."""

import inspect

import pandas as pd

from studies.bench.cli import REPORTS
from studies.bench.row_files import PACKAGES, READY, mechanism_of, rounded
from studies.bench.store import read_rows
from studies.work_precision import archive
from studies.work_precision.study import with_one_name
from twoloop import mechanisms
from twoloop.rows.leaderboard import ARCHIVE
from twoloop.rows.row_format import find_errors, format_rows, read_lines

AGAIN = "make it again by python -m studies.work_precision.archive"


def test_the_archive_is_of_the_rows_of_the_report():
    rows = with_one_name(read_rows(REPORTS / "work_precision.csv")[0])
    kept = [line for line in read_lines(ARCHIVE) if '"mechanism":"four_bar_second"' in line]
    versions = {row["family"]: row["version"] for row in find_errors(kept)[0] if row["family"] != "two-loop"}
    versions |= {PACKAGES.get(family, family.lower()): version for family, version in versions.items()}
    made = archive.archived(rows[rows["case"] == "four-bar, second"], versions)
    assert format_rows(made).splitlines() == kept, AGAIN
    runs = rows[rows["group"] == archive.GROUP]
    settings = list({"case", "group", "solver", "tol", "h", "err_out", "t_end"} & {*runs})
    assert len(runs.drop_duplicates(settings)) == len([line for line in read_lines(ARCHIVE) if line]), AGAIN


def test_ready_mechanisms_are_called_by_their_functions():
    for name in mechanisms.__all__:
        maker = getattr(mechanisms, name)
        if inspect.isfunction(maker) and name != "ancf_beam":  # which has arguments
            assert mechanism_of(maker().name) == name
    assert all(hasattr(mechanisms, name) for title, name in READY.items() if "second" not in name)
    assert mechanism_of("My crane, 3 m (wet)") == "my_crane_3_m_wet"


def test_numbers_are_short_and_whole_ones_whole():
    rows = pd.DataFrame({"a": [1.23456e-7, 10.0, float("nan")]})
    assert [rounded(value) for value in rows["a"][:2]] == [1.235e-7, 10]
    assert isinstance(rounded(10.0), int) and rounded("x") == "x" and rounded(True) is True
