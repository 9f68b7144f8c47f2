"""Time of each solver for an error on a mechanism, from the rows shipped or from the user's files."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twoloop.rows.equal_error import INTERVAL, LEAST, Runs, cheapest, cost_at, place_of
from twoloop.rows.row_format import REACHED_END, Row, read_rows

ARCHIVE = Path(__file__).with_name("archive.jsonl.gz")
MEASURES = {"error_end": "at the end, over max(1, max |q_ref|)", "error": "over the motion, m or rad"}
CALL = (
    "time: CPU time of the whole call, median of its repetitions: of twoloop all of solve_dae; of another project's\n"
    "solver its own call, on an integrator built beforehand; of a solver from a file all of it, output included.\n"
    "ratio: over the cheapest. undecided: not told apart from it. few runs: too few for that to be asked.\n"
    "calibrated: over the time of the calibration, by which rows of several processors can be laid side by side.\n"
    "*: does not keep the positions on the constraints."
)


@dataclass(frozen=True)
class Entry:
    """A solver with its time at an error.

    Attributes
    ----------
    solver, version, called_from : str
    seconds : float
        Time at the error: interpolated log-log between two runs, or that of the cheapest run that reaches it.
    over : float
        Time relative to that of the first.
    doubt : {"", "undecided", "few runs"}
        Whether it differs significantly from the first, by a bootstrap of the repetitions and a margin of 5 %.
    calibrated : float or None
        Time relative to that of the calibration in the same process.
    evaluations : float or None
    keeps_constraints : bool or None
    """

    solver: str
    version: str
    called_from: str
    seconds: float
    over: float
    doubt: str
    calibrated: float | None
    evaluations: float | None
    keeps_constraints: bool | None


@dataclass(frozen=True)
class Board:
    """Ranking of the solvers on one mechanism, on one processor, at one error.

    Attributes
    ----------
    mechanism : str
    t_end : float
        s.
    measure : {"error_end", "error"}
    processor : str
    target : float
        Target error.
    entries : list of Entry
        Cheapest first.
    others : list of (str, str)
        Solvers without a time at the error, with reasons.
    """

    mechanism: str
    t_end: float
    measure: str
    processor: str
    target: float
    entries: list[Entry]
    others: list[tuple[str, str]]

    def __str__(self) -> str:
        title = (
            f"{self.mechanism} to {self.t_end:g} s, error {self.target:g} {MEASURES[self.measure]}; {self.processor}"
        )
        cells = [("solver", "time", "ratio", "", "calibrated", "evaluations", "called from", "version")]
        for each in self.entries:
            name = each.solver + ("" if each.keeps_constraints in (None, True) else " *")
            ratio, doubt = f"{each.over:.3g}", each.doubt if each is not self.entries[0] else ""
            calibrated = "" if each.calibrated is None else f"{each.calibrated:.3g}"
            count = "" if each.evaluations is None else f"{each.evaluations:.0f}"
            cells.append((name, seconds(each.seconds), ratio, doubt, calibrated, count, each.called_from, each.version))
        widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
        signs = "<>><>><<"
        lines = [title]
        for line in cells if self.entries else []:
            padded = [f"{text:{sign}{n}}" for text, sign, n in zip(line, signs, widths, strict=True)]
            lines.append(f"  {'  '.join(padded)}".rstrip())
        wide = max([widths[0], *(len(name) for name, _ in self.others)])
        lines += [f"  {name:<{wide}}  {why}" for name, why in self.others]
        return "\n".join(lines)


def seconds(value: float) -> str:
    """Return a time in s, ms or us with three digits."""
    size, unit = next((each for each in ((1.0, "s"), (1e-3, "ms")) if value >= 0.9995 * each[0]), (1e-6, "us"))
    return f"{value / size:.3g} {unit}"


def columns_of(rows: Sequence[Row], measure: str) -> dict[str, NDArray[Any]]:
    """Return the columns that `Runs` requires, for rows of one mechanism and span."""
    floor = "floor" if measure == "error" else "floor_end"
    known = [row.get(measure) if row["status"] == REACHED_END else None for row in rows]
    found: dict[str, Any] = {
        "error_q": known,
        "floor": [row.get(floor) for row in rows],
        "setting": [row["value"] for row in rows],
        "call_s": [np.median(row["times_s"]) if row["times_s"] else None for row in rows],
        "evaluations": [row.get("evaluations") for row in rows],
        "calibration_s": [row.get("calibration_s") for row in rows],
    }
    arrays = {name: np.array(values, dtype=float) for name, values in found.items()}
    times = np.empty(len(rows), dtype=object)
    times[:] = [tuple(row["times_s"]) for row in rows]
    texts = {"used": np.array([row.get("used", "") for row in rows], dtype=object)}
    return arrays | texts | {"times": times, "astray": np.array([row.get("astray", False) for row in rows], dtype=bool)}


def boards(rows: Sequence[Row], target: float) -> list[Board]:
    """Return a board for each mechanism, span, processor and error measure in the rows."""
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["mechanism"], row["t_end"], row["processor"]), []).append(row)
    found = []
    for (mechanism, t_end, processor), own in groups.items():
        for measure in MEASURES:
            if any(measure in row for row in own):
                entries, others = _ranked(own, measure, target)
                found.append(Board(mechanism, t_end, measure, processor, target, entries, others))
    return found


def _ranked(rows: Sequence[Row], measure: str, target: float) -> tuple[list[Entry], list[tuple[str, str]]]:
    """Return the solvers that reach an error, cheapest first, and the reasons for all others."""
    columns = columns_of(rows, measure)
    solvers = list(dict.fromkeys((row["solver"], row["version"], row["setting"]) for row in rows))
    timed, others = [], []
    for solver in solvers:
        own = [k for k, row in enumerate(rows) if (row["solver"], row["version"], row["setting"]) == solver]
        reached = [rows[k] for k in own if rows[k]["status"] == REACHED_END]
        if reached and not any(measure in row for row in reached):
            continue  # has the other error measure
        runs = Runs(columns, np.array(own), "call_s", solver[0])
        place = place_of(runs, target)
        if place is None:
            others.append((solver[0], _why_not(runs, [rows[k] for k in own], target)))
            continue
        drawn = cost_at(runs.drawn, place)
        timed.append((float(cost_at(runs.of("call_s"), place)), drawn, rows[cheapest(runs, place)]))
    timed.sort(key=lambda each: each[0])
    return [_entry(*each, *timed[0][:2]) for each in timed], others


def _entry(cost: float, drawn: NDArray[Any], row: Row, least: float, least_drawn: NDArray[Any]) -> Entry:
    low = float(np.percentile(drawn / least_drawn, INTERVAL[0]))
    calibration = row.get("calibration_s")
    return Entry(
        row["solver"],
        row["version"],
        row.get("called_from", ""),
        cost,
        cost / least,
        "few runs" if np.isnan(low) else "" if low > LEAST else "undecided",
        None if calibration is None else cost / calibration,
        row.get("evaluations"),
        row.get("keeps_constraints"),
    )


def _why_not(runs: Runs, rows: Sequence[Row], target: float) -> str:
    """Return the reason why a solver has no time at an error."""
    if not runs.errors.size:
        row = rows[0]
        return f"{row['status'].lower().replace('_', ' ')}: {row.get('message', '')}".removesuffix(": ")
    good = runs.errors <= target
    if target < runs.floor:
        return f"the reference resolves {runs.floor:.2g}"
    if good.any():
        least = seconds(float(runs.of("call_s")[good].min()))
        return f"at most {least}, of a run with the error {runs.errors[good].max():.2g}"
    return f"least error {runs.errors.min():.2g}"


def chosen(rows: Iterable[Row], mechanism: str, t_end: float | None = None) -> list[Row]:
    """Return the rows of a mechanism, and of a span if given.

    Raises ValueError if there are none.
    """
    rows = list(rows)
    names = {row["mechanism"] for row in rows}
    if mechanism not in names:
        raise ValueError(
            f"there are no rows of the mechanism {mechanism!r}; there are some of {', '.join(sorted(names))}"
        )
    own = [row for row in rows if row["mechanism"] == mechanism]
    ends = sorted({row["t_end"] for row in own})
    if t_end is not None and t_end not in ends:
        raise ValueError(f"rows of {mechanism} end at {', '.join(f'{end:g}' for end in ends)} s; given {t_end:g} s")
    return [row for row in own if t_end in (None, row["t_end"])]


def leaderboard(
    mechanism: str, target: float, files: Iterable[Path] = (), t_end: float | None = None, out: Path | None = None
) -> str:
    """Return the boards of a mechanism at an error as text, from the rows shipped and those in files.

    Raises ValueError if an argument is out of range, a file is not in the format, or there are no rows.
    """
    if not 0.0 < target < 1.0:
        raise ValueError(f"--error must be between 0 and 1; given {target:g}")
    rows = [row for path in (ARCHIVE, *files) for row in read_rows(path)]
    found = boards(chosen(rows, mechanism, t_end), target)
    if out is not None:
        _draw(found, rows, out)
    return "\n\n".join([*map(str, found), CALL])


def _draw(found: Sequence[Board], rows: Sequence[Row], out: Path) -> None:
    """Plot error and time of all runs, one panel per board."""
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(1, len(found), figsize=(6.4 * len(found), 5.6), squeeze=False, layout="constrained")
    for axes, board in zip(panels[0], found, strict=True):
        of_board = [
            row
            for row in rows
            if (row["mechanism"], row["t_end"], row["processor"]) == (board.mechanism, board.t_end, board.processor)
        ]
        for k, entry in enumerate(board.entries[:10]):  # more would be indistinguishable
            own = [row for row in of_board if row["solver"] == entry.solver and row["version"] == entry.version]
            points = [(row[board.measure], np.median(row["times_s"])) for row in own if row.get(board.measure)]
            axes.loglog(*zip(*sorted(points), strict=True), f"{'os^vDPX*d>'[k]}-", ms=4, lw=0.8, label=entry.solver)
        axes.axvline(board.target, color="0.6", lw=0.8)
        axes.invert_xaxis()
        axes.set(xlabel=f"error {MEASURES[board.measure]}", ylabel="CPU time of the whole call (s)")
        axes.set_title(f"{board.mechanism} to {board.t_end:g} s; {board.processor}", fontsize=9)
        if board.entries:
            axes.legend(fontsize=7)
    figure.savefig(out)
    plt.close(figure)
