"""A page to compare solvers in a browser: mechanism, error measure, cost and solvers to choose from, of saved rows."""

import html
import json
import re
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import pandas as pd

from studies.bench import cli, figures, tables
from studies.bench.cli import StudyError
from studies.bench.index import write_index
from studies.bench.names import label, looks_like
from studies.bench.render import TEMPLATES
from studies.bench.row_files import as_runs, rows_of_file
from studies.bench.solvers import CVODE_C, GIVEN, HEYOKA, IDA_C
from studies.bench.store import Output, plain, read_rows

FILE = "compare.html"
SOURCES = ("work_precision", "validation")
MEASURES = {"error_q": "error of positions (m, rad)", "error_v": "error of velocities"}
MEASURES |= {"error_lam": "error of multipliers", "energy": "energy error (J)"}
MEASURES |= {"violation_q": "largest violation of positions, |C|", "violation_v": "largest violation of velocities"}
COSTS = {"call_s": "CPU time of the call (s)", "n_evaluations": "evaluations"}
DIGITS = 4  # significant, of what the page holds; the CSV files have all
OPENS = "four-bar, 10 s (work_precision)"
ALWAYS = (GIVEN, "compiled=True", "compiled=False", HEYOKA, CVODE_C, IDA_C)  # shown at first beside the best
POINTS = {  # marker of the figures: shape and rotation (degrees) of the nearest one of the plotting library
    **{"o": ("circle", 0), "s": ("rect", 0), "D": ("rectRot", 0), "p": ("rectRounded", 0), "d": ("rectRounded", 45)},
    **{"^": ("triangle", 0), ">": ("triangle", 90), "v": ("triangle", 180), "<": ("triangle", 270)},
    **{"*": ("star", 0), "P": ("cross", 0), "X": ("crossRot", 0)},
}
VENDOR = Path(__file__).parent / "vendor"
LIBRARIES = ("chart-4.6.1", "chartjs-plugin-zoom-2.2.0")  # the second extends the first


def read(folder: Path, files: Sequence[str] = ()) -> tuple[pd.DataFrame, dict[str, str]]:
    """Read one row a run, of all studies in a folder and of files of rows, and where these are from.

    Raises StudyError if there are no rows at all, or a file is damaged.
    """
    parts, stamps = [], {}
    for name in SOURCES:
        path = folder / f"{name}.csv"
        if not path.is_file():
            continue
        rows, first = read_rows(path, "case", "solver", "t_end")
        rows = tables.medians(rows) if "repeat" in rows else rows
        rows = rows[rows["t_end"].notna()]  # not those that are times alone, of first calls and sizes
        # a study may run one mechanism for several lengths of time, whose costs cannot be compared
        parts.append(rows.assign(mechanism=rows["case"] + rows["t_end"].map(", {:g} s".format), study=name))
        stamps[name] = first.removeprefix("# ")
    given = {file: rows_of_file(file) for file in files}
    if given:  # together, so that rows of one's own are beside those that are shipped
        parts.append(as_runs([row for rows in given.values() for row in rows]).assign(study="rows"))
        stamps |= {file: f"{len(rows)} rows of files" for file, rows in given.items()}
    if not parts:
        raise StudyError(
            f"there are no rows in {folder}: run python -m studies.work_precision first, or give --with archive, "
            "the rows that are shipped"
        )
    return named(pd.concat(parts, ignore_index=True), folder), stamps


def named(rows: pd.DataFrame, folder: Path) -> pd.DataFrame:
    """Give solvers the names that they have in figures, and in the column "look" the row whose look each has."""
    path = folder / "work_precision.json"
    told = json.loads(path.read_text()) if path.is_file() else {}
    cases = rows.loc[rows["study"] == "work_precision", "case"].unique() if told else ()
    coded = {case: case in told.get("with_code", ()) for case in cases}
    pairs = [(solver, coded.get(case)) for solver, case in zip(rows["solver"], rows["case"], strict=True)]
    return rows.assign(solver=[label(*pair) for pair in pairs], look=[looks_like(*pair) for pair in pairs])


def page_data(rows: pd.DataFrame, stamps: dict[str, str]) -> dict[str, Any]:
    """Make the data of the page: mechanisms, solvers with their looks, and the runs as lists."""
    families = rows.groupby("solver", sort=False)["family"].first()
    seen = looks(dict(zip(rows["solver"], rows["look"], strict=True)))
    solvers = [{"name": name, "ours": family == "two-loop", **seen[name]} for name, family in families.items()]
    numbers = {name: k for k, name in enumerate(families.index)}
    mechanisms = [
        {"name": f"{name} ({of})", "floor": float(runs["floor"].max())}
        for (of, name), runs in rows.groupby(["study", "mechanism"], sort=False)
    ]
    places = {each["name"]: k for k, each in enumerate(mechanisms)}
    columns = [*COSTS, *MEASURES]
    runs = []
    for row in rows.reindex(columns=list(dict.fromkeys([*rows, *columns]))).to_dict("records"):
        values = [None if pd.isna(row[name]) else float(f"{abs(row[name]):.{DIGITS}g}") for name in columns]
        said = "reached the end, but lost the motion" if row.get("astray") in (True, "True") else ""
        if row["status"] != "REACHED_END":
            said = f"{row['status']}: {str(row['message']).split('. ')[0]}"
        mechanism = places[f"{row['mechanism']} ({row['study']})"]
        runs.append([mechanism, numbers[row["solver"]], tables.setting(row), row["called_from"], *values, said])
    found: dict[str, Any] = {"opens": OPENS if OPENS in places else mechanisms[0]["name"], "always": ALWAYS}
    found |= {"mechanisms": mechanisms, "solvers": solvers}
    found |= {"columns": ["mechanism", "solver", "setting", "called", *columns, "said"], "measures": MEASURES}
    return found | {"costs": COSTS, "runs": runs, "stamps": stamps}


def looks(solvers: Mapping[str, str]) -> dict[str, dict[str, Any]]:
    """Choose colour and point of each solver: those of the figures, or another pair where these are taken or missing.

    `solvers`: the name of the row of each.
    """
    known = sorted(solvers, key=lambda name: solvers[name] not in figures.STYLES)  # others take what is left
    free = list(product(dict.fromkeys(color for color, _ in figures.STYLES.values()), POINTS))
    made = {}
    for name in known:
        style = figures.style(solvers[name])
        pair = (str(style["color"]), str(style["marker"]))
        if pair not in free:
            pair = next((each for each in free if each[0] == pair[0]), free[0])
        free.remove(pair)
        point, rotation = POINTS[pair[1]]
        made[name] = {"color": pair[0], "point": point, "rotation": rotation}
    return made


def page(data: dict[str, Any]) -> str:
    """Render the page, which needs no further files."""
    text = json.dumps(plain(data), separators=(",", ":"), ensure_ascii=False).replace("</", "<\\/")
    stamps = "".join(f"<li>{html.escape(name)}: {html.escape(stamp)}</li>" for name, stamp in data["stamps"].items())
    template = (TEMPLATES / FILE).read_text(encoding="utf-8")
    scripts = "\n".join((VENDOR / f"{name}.min.js").read_text(encoding="utf-8") for name in LIBRARIES)
    licences = "\n".join(file.read_text(encoding="utf-8") for file in sorted(VENDOR.glob("*-LICENSE.md")))
    parts = {"STAMPS": stamps, "LICENCES": licences, "LIBRARY": scripts, "DATA": text}
    return re.sub("|".join(parts), lambda found: parts[found[0]], template)


def _work(words: Sequence[str] | None) -> None:
    parser = cli.parser("compare_page", __doc__)
    what = "rows to show, too (twoloop rows check); the word archive: those that are shipped"
    parser.add_argument("--with", dest="files", nargs="+", default=[], metavar="FILE.jsonl", help=what)
    given = parser.parse_args(words)
    with Output(cli.call_of("compare_page", given, words)) as output:
        output.write(FILE, page(page_data(*read(output.path, given.files))))
        if not given.files:
            write_index(output)
    print(f"wrote {output.path / FILE}")


def main(words: Sequence[str] | None = None) -> None:
    cli.main(_work, words)


if __name__ == "__main__":
    main()
