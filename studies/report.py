"""What every study writes: rows with a stamp (CSV), markdown, figures; and how it is called."""

import argparse
from io import StringIO
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from studies.cli import Call
from studies.cli import stamp as stamp  # studies that are not on the bench yet take it from here

mpl.use("Agg")

Array = NDArray[np.floating]

ROOT = Path(__file__).parent.parent
REPORTS = ROOT / "reports"

mpl.rcParams.update(
    {
        "figure.dpi": 130,
        "savefig.bbox": "tight",
        "axes.grid": True,
        "grid.alpha": 0.3,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "font.size": 9,
        "legend.frameon": False,
    }
)


def parse(name: str, description: str | None, words: list[str] | None, command: str | None) -> Call:
    """Read the command line of a study."""
    parser = argparse.ArgumentParser(prog=f"python -m studies.{name}", description=description)
    parser.add_argument("--quick", action="store_true", help="a small version in seconds, into reports/quick")
    parser.add_argument("--out", type=Path, help="folder for the report (default: reports)")
    parser.add_argument("--redraw", action="store_true", help="write report and figures again from the saved rows")
    given = parser.parse_args(words)
    out = given.out or (REPORTS / "quick" if given.quick else REPORTS)
    out.mkdir(parents=True, exist_ok=True)
    line = command or " ".join([f"python -m studies.{name}", *(["--quick"] if given.quick else [])])
    return Call(name, given.quick, out, given.redraw, line)


def save_rows(path: Path, rows: pd.DataFrame, line: str) -> None:
    """Write the rows, the stamp above them as a comment."""
    path.write_text(f"# {line}\n" + rows.to_csv(index=False))


def load_rows(path: Path) -> tuple[pd.DataFrame, str]:
    """Read what `save_rows` wrote."""
    first, rest = path.read_text().split("\n", 1)
    return pd.read_csv(StringIO(rest)), first.removeprefix("# ")


def save_series(path: Path, series: dict[str, Array]) -> None:
    """Write named arrays, of which figures are drawn, beside the rows."""
    with path.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **{name: np.asarray(x, np.float32) for name, x in series.items()})


def load_series(path: Path) -> dict[str, Array]:
    """Read what `save_series` wrote."""
    with np.load(path) as stored:
        return {name: stored[name] for name in stored.files}


def markdown_table(header: list[str], rows: list[list[str]]) -> str:
    """A markdown table of ready strings; the first column to the left, the others to the right."""
    lines = ["| " + " | ".join(header) + " |", "|---" + "|--:" * (len(header) - 1) + "|"]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows])


def number(value: float, digits: int = 2) -> str:
    """A number for a table: few digits, powers of ten only where needed; a dash for what does not exist."""
    if value is None or pd.isna(value):
        return "–"
    if value == 0.0:
        return "0"
    if 1e-2 <= abs(value) < 1e4:
        return f"{value:.{digits + 1}g}" if abs(value) < 10 else f"{value:.4g}"
    mantissa, exponent = f"{value:.{max(digits - 1, 0)}e}".split("e")
    return f"{mantissa}e{int(exponent)}"
