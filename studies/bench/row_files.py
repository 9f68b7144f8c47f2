"""Write runs in the format of `twoloop.rows`, from the medians that tables are made of."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from studies.bench.cli import StudyError, processor, version_of
from studies.bench.collector import FILE
from studies.bench.tables import SETTINGS
from twoloop import __version__
from twoloop.rows.leaderboard import ARCHIVE
from twoloop.rows.row_format import REACHED_END, SCHEMA, Row, read_rows

READY = {  # by the names of their problems, where these are others
    "Andrews' squeezing mechanism": "andrews",
    "SUNDIALS slider-crank": "sundials_slider_crank",
    "A01 pendulum": "pendulum",
    "A02, N = 2": "n_four_bar",
    "A04 Bricard": "bricard",
    "A05 governor": "governor",
    "closed chain of 4": "closed_chain",
    "four-bar 1, 2, 1.5 m on 3 m": "four_bar",
    "four-bar 0.8, 1.2, 1 m on 2 m": "four_bar_second",
    "ANCF beam, 4 elements, E = 2e+08 N/m^2, start='node'": "moderately_stiff_beam",
    "ANCF beam, 4 elements, E = 2e+06 N/m^2, start='node'": "very_flexible_beam",
}


def mechanism_of(name: str) -> str:
    """The name in rows of a problem, or of a case."""
    return READY.get(name) or re.sub(r"\W+", "_", name).strip("_").lower()


COMPARED_PACKAGES = (
    *("heyoka", "scikit-sundae", "scipy", "extensisq", "diffrax", "casadi", "cyrk", "solve-dae", "exudyn"),
)
PACKAGES = {"SUNDIALS": "scikit-sundae", "solve_dae": "solve-dae"}  # of families that are called otherwise
QUALITY = ("violation_q", "violation_v", "error_lam", "energy")
DIGITS = 4  # significant, of numbers that are measured, not of ...
EXACT = ("t_end", "value", "evaluations")  # ... these
LONGEST = 120  # letters of a message


def versions() -> dict[str, str]:
    """Of the packages compared, those that are installed."""
    return {package: told for package in COMPARED_PACKAGES if (told := version_of(package, ""))}


def in_format(run: Mapping[str, Any], columns: Mapping[str, str], versions: Mapping[str, str]) -> Row:
    """Return the row of a run, a line of `tables.medians`; `columns`: columns of its known errors and floors."""
    family, done = run["family"], run["status"] == REACHED_END
    setting = next(name for name in SETTINGS if run.get(name) == run.get(name, float("nan")))
    row = {"schema": SCHEMA, "mechanism": mechanism_of(run["case"]), "t_end": run["t_end"], "solver": run["solver"]}
    row |= {name: run[name] for name in ("family", "called_from", "status")}
    row["keeps_constraints"] = None if family == FILE else run["keeps_constraints"]
    if family == "two-loop":
        row["version"] = ", ".join([__version__, *([run["commit"]] if "commit" in run else [])])
    else:
        row["version"] = versions.get(run["solver"]) or versions.get(PACKAGES.get(family, family.lower())) or "unknown"
    row |= {"processor": run.get("processor") or processor(), "setting": setting, "value": run[setting]}
    row |= {"times_s": [rounded(time) for time in run["times"]] if done else []}
    row["evaluations"] = None if pd.isna(run["n_evaluations"]) else int(run["n_evaluations"])
    if not done:
        row["message"] = " ".join(str(run["message"]).split())[:LONGEST]
    else:
        row |= {name: run[name] for name in ("used", "calibration", "calibration_s") if name in run}
        row |= {name: run[column] for name, column in columns.items()}
        row |= {name: abs(run[name]) for name in QUALITY if run[name] is not None}
        row["astray"] = True if run.get("astray") in (True, "True") else None
    known = {name: value for name, value in row.items() if value not in (None, "") and value == value}
    return {name: value if name in EXACT else rounded(value) for name, value in known.items()}


def rows_of_file(file: str) -> list[Row]:
    """Return the rows of a file, or of the shipped "archive"; raise StudyError if there are none or one is wrong."""
    try:
        return read_rows(ARCHIVE if file == "archive" else Path(file))
    except ValueError as error:
        raise StudyError(str(error)) from None


def rounded(value: Any) -> Any:
    """A number of few digits, a whole one as an integer; all else as it is."""
    if not isinstance(value, float):
        return value
    short = float(f"{value:.{DIGITS}g}")
    return int(short) if short.is_integer() and short < 1e15 else short
