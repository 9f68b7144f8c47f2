"""Time of each solver for an error on a mechanism, from the rows shipped or from the user's files."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.arguments import Array
from twoloop.rows.row_format import REACHED_END, Row, read_rows

ARCHIVE = Path(__file__).with_name("archive.jsonl.gz")
MEASURES = {"error_end": "at the end, over max(1, max |q_ref|)", "error": "over the motion, m or rad"}
Place = tuple[int, float | None]
DECADE = 10.0 * (1.0 + 1e-9)  # no interpolation between runs whose errors differ by more
NEAR = 2.0  # settings within this factor count as nearly equal
FEWEST = 3  # repetitions required for a confidence interval
LOOSEST = 1e-1  # loosest useful tolerance
# prefixes of solvers whose order depends on the tolerance, or whose loose runs do not follow a line
BY_TOLERANCE = ("heyoka", "Taylor", "auto", "the default", "ensemble", "solve_dae", "TRBDF2")
INTERVAL = (2.5, 97.5)  # percentiles of the bootstrap distribution
LEAST = 1.05  # smallest relevant ratio of times; less is within the variation of machine and order of calls
RESAMPLES, SEED = 1000, 25  # bootstrap resamples of the repetitions


@cache
def _resampled_rounds(n: int) -> NDArray[np.int64]:
    """Return resampled rounds (RESAMPLES, n): the same for all runs, because their repetitions are interleaved."""
    return np.random.default_rng(SEED).integers(0, n, (RESAMPLES, n))


def bootstrap_medians(times: Iterable[Sequence[float]]) -> Array:
    """Return bootstrap medians of the times of each run (n_runs, RESAMPLES); NaN for fewer than three repetitions."""
    return np.array([_bootstrap_medians(tuple(run_times)) for run_times in times]).reshape(-1, RESAMPLES)


@lru_cache(maxsize=20_000)
def _bootstrap_medians(times: tuple[float, ...]) -> Array:
    if len(times) < FEWEST:
        return np.full(RESAMPLES, np.nan)
    return np.asarray(np.median(np.array(times)[_resampled_rounds(len(times))], axis=1))


class Runs:
    """The runs of one solver on one case with a known error and cost, sorted by error, as arrays.

    Arrays, because sorting and slicing a table of 70 columns for every solver and error takes minutes.
    """

    def __init__(self, columns: Mapping[str, NDArray[Any]], rows: NDArray[np.int64], cost: str, solver: str):
        errors, settings = columns["error_q"][rows], columns["setting"][rows]
        order = np.argsort(errors, kind="stable")  # NaN sorts last
        order = order[~np.isnan(errors[order]) & ~np.isnan(columns[cost][rows][order])]
        self.columns, self.rows = columns, rows[order]
        self.floor = float(np.fmax.reduce(columns["floor"][self.rows], initial=-np.inf))
        self.errors = np.maximum(errors[order], columns["floor"][self.rows])
        self.settings, self.has_constant_order = settings[order], not solver.startswith(BY_TOLERANCE)
        best = float(settings[~np.isnan(errors)].max(initial=0.0))
        # the loosest setting that the solver can run: looser ones failed, or are of no use
        self.loosest = best if (settings[np.isnan(errors)] > best).any() else LOOSEST

    def column(self, column: str) -> NDArray[Any]:
        """Return a column."""
        return self.columns[column][self.rows]

    @cached_property
    def resamples(self) -> Array:
        """Return bootstrap medians of the times; NaN if they are unknown."""
        if "times" not in self.columns:
            return np.full((len(self.rows), RESAMPLES), np.nan)
        return bootstrap_medians(self.column("times"))

    def method_of(self, k: int) -> str:
        """Return the method used in a run by a solver that chooses its method."""
        method = self.column("used")[k] if "used" in self.columns else ""
        return method if isinstance(method, str) else ""


def locate_target(runs: Runs, target: float, include_unaimed: bool = False) -> Place | None:
    """Return the number of runs that reach a target error, and the position of the target on the log-log line.

    All runs below the target count, however accurate: a user takes the cheapest run that reaches the error. Return
    None if no run reaches it, or, unless `include_unaimed`, if no run aimed at it: none is within a decade below the
    target, at the loosest setting that the solver can run, or at nearly the same setting as a looser run above the
    target (the error jumps over the target). The position on the log-log line through the two runs around the target
    is None if they are more than a decade apart, or of different methods or orders.
    """
    errors, settings = runs.errors, runs.settings
    n_good = int((errors <= target).sum())
    if n_good == 0 or target < runs.floor:
        return None
    below, end = errors[n_good - 1], n_good == len(errors)
    joined = not end and 0.0 < errors[n_good] <= DECADE * below
    looser = settings[n_good:, None] / settings[:n_good]
    near = ((looser >= 1.0) & (looser <= NEAR)).any()
    aimed = below >= target / DECADE or joined or near or (settings[:n_good] >= runs.loosest).any()
    if not (aimed or include_unaimed):
        return None
    if not joined or not runs.has_constant_order or runs.method_of(n_good - 1) != runs.method_of(n_good):
        return n_good, None
    x = np.log(errors[n_good - 1 : n_good + 1])
    return n_good, float((np.log(target) - x[0]) / (x[1] - x[0]))


def interpolate_cost(costs: Array, place: Place) -> Array:
    """Return the least cost (per resample, if there are many) at a target; `costs`: one row per run, by error."""
    n_good, share = place
    best = np.fmin.reduce(costs[:n_good])  # NaN: runs without repetitions
    if share is None:
        return np.asarray(best)
    with np.errstate(invalid="ignore"):
        between = np.exp((1.0 - share) * np.log(costs[n_good - 1]) + share * np.log(costs[n_good]))
    return np.fmin(best, between)


def cheapest_run(runs: Runs, place: Place) -> int:
    """Return the index of the cheapest run at a target."""
    return int(runs.rows[np.argmin(runs.column("call_s")[: place[0]])])


CALL = (
    "time: CPU time of the whole call, median of its repetitions: of twoloop all of solve_dae; of another project's\n"
    "solver its own call, on an integrator built beforehand; of a solver from a file all of it, output included.\n"
    "ratio: over the cheapest. undecided: not told apart from it. few runs: too few for that to be asked.\n"
    "calibrated: over the time of the calibration, by which rows of several processors can be laid side by side.\n"
    "*: does not keep the positions on the constraints."
)


@dataclass(frozen=True)
class Entry:
    """A solver with its time at an error."""

    solver: str
    version: str
    called_from: str
    seconds: float  # interpolated log-log between two runs, or that of the cheapest run that reaches the error
    over: float  # time relative to that of the first
    # "undecided" unless it differs from the first, by a bootstrap of the repetitions and a margin of 5 %; or "few runs"
    doubt: str
    calibrated: float | None  # time relative to that of the calibration in the same process
    evaluations: float | None
    keeps_constraints: bool | None


@dataclass(frozen=True)
class Board:
    """Ranking of the solvers on one mechanism, on one processor, at one error."""

    mechanism: str
    t_end: float  # s
    measure: str  # key of MEASURES
    processor: str
    target: float  # target error
    entries: list[Entry]  # cheapest first
    others: list[tuple[str, str]]  # solvers without a time at the error, with reasons

    def __str__(self) -> str:
        error = f"error {self.target:g} {MEASURES[self.measure]}"
        cells = [("solver", "time", "ratio", "", "calibrated", "evaluations", "called from", "version")]
        for entry in self.entries:
            name = entry.solver + ("" if entry.keeps_constraints in (None, True) else " *")
            ratio, doubt = f"{entry.over:.3g}", entry.doubt if entry is not self.entries[0] else ""
            calibrated = "" if entry.calibrated is None else f"{entry.calibrated:.3g}"
            count = "" if entry.evaluations is None else f"{entry.evaluations:.0f}"
            numbers = seconds(entry.seconds), ratio, doubt, calibrated, count
            cells.append((name, *numbers, entry.called_from, entry.version))
        widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
        signs = "<>><>><<"
        lines = [f"{self.mechanism} to {self.t_end:g} s, {error}; {self.processor}"]
        for line in cells if self.entries else []:
            padded = [f"{text:{sign}{n}}" for text, sign, n in zip(line, signs, widths, strict=True)]
            lines.append(f"  {'  '.join(padded)}".rstrip())
        wide = max([widths[0], *(len(name) for name, _ in self.others)])
        lines += [f"  {name:<{wide}}  {why}" for name, why in self.others]
        return "\n".join(lines)


def seconds(value: float) -> str:
    """Return a time in s, ms or us with three digits."""
    size, unit = next((scale for scale in ((1.0, "s"), (1e-3, "ms")) if value >= 0.9995 * scale[0]), (1e-6, "us"))
    return f"{value / size:.3g} {unit}"


def make_columns(rows: Sequence[Row], measure: str) -> dict[str, NDArray[Any]]:
    """Return the columns that `Runs` requires, for rows of one mechanism and span."""
    floor = "floor" if measure == "error" else "floor_end"
    errors = [row.get(measure) if row["status"] == REACHED_END else None for row in rows]
    columns: dict[str, Any] = {
        "error_q": errors,
        "floor": [row.get(floor) for row in rows],
        "setting": [row["value"] for row in rows],
        "call_s": [np.median(row["times_s"]) if row["times_s"] else None for row in rows],
        "evaluations": [row.get("evaluations") for row in rows],
        "calibration_s": [row.get("calibration_s") for row in rows],
    }
    arrays = {name: np.array(values, dtype=float) for name, values in columns.items()}
    times = np.empty(len(rows), dtype=object)
    times[:] = [tuple(row["times_s"]) for row in rows]
    texts = {"used": np.array([row.get("used", "") for row in rows], dtype=object)}
    return arrays | texts | {"times": times, "astray": np.array([row.get("astray", False) for row in rows], dtype=bool)}


def boards(rows: Sequence[Row], target: float) -> list[Board]:
    """Return a board for each mechanism, span, processor and error measure in the rows."""
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["mechanism"], row["t_end"], row["processor"]), []).append(row)
    ranking = []
    for (mechanism, t_end, processor), own_rows in groups.items():
        for measure in MEASURES:
            if any(measure in row for row in own_rows):
                entries, others = _ranked(own_rows, measure, target)
                ranking.append(Board(mechanism, t_end, measure, processor, target, entries, others))
    return ranking


def _ranked(rows: Sequence[Row], measure: str, target: float) -> tuple[list[Entry], list[tuple[str, str]]]:
    """Return the solvers that reach an error, cheapest first, and the reasons for all others."""
    columns = make_columns(rows, measure)
    solvers = list(dict.fromkeys((row["solver"], row["version"], row["setting"]) for row in rows))
    ranked, unranked = [], []
    for solver in solvers:
        indices = [k for k, row in enumerate(rows) if (row["solver"], row["version"], row["setting"]) == solver]
        reached = [rows[k] for k in indices if rows[k]["status"] == REACHED_END]
        if reached and not any(measure in row for row in reached):
            continue  # has the other error measure
        runs = Runs(columns, np.array(indices), "call_s", solver[0])
        place = locate_target(runs, target)
        if place is None:
            unranked.append((solver[0], _reason(runs, [rows[k] for k in indices], target)))
            continue
        cost = float(interpolate_cost(runs.column("call_s"), place))
        ranked.append((cost, interpolate_cost(runs.resamples, place), rows[cheapest_run(runs, place)]))
    ranked.sort(key=lambda entry: entry[0])
    return [_entry(*entry, *ranked[0][:2]) for entry in ranked], unranked


def _entry(cost: float, resamples: NDArray[Any], row: Row, least: float, least_resamples: NDArray[Any]) -> Entry:
    lower_bound = float(np.percentile(resamples / least_resamples, INTERVAL[0]))
    calibration = row.get("calibration_s")
    return Entry(
        row["solver"],
        row["version"],
        row.get("called_from", ""),
        cost,
        cost / least,
        "few runs" if np.isnan(lower_bound) else "" if lower_bound > LEAST else "undecided",
        None if calibration is None else cost / calibration,
        row.get("evaluations"),
        row.get("keeps_constraints"),
    )


def _reason(runs: Runs, rows: Sequence[Row], target: float) -> str:
    """Return the reason why a solver has no time at an error."""
    if not runs.errors.size:
        row = rows[0]
        return f"{row['status'].lower().replace('_', ' ')}: {row.get('message', '')}".removesuffix(": ")
    good = runs.errors <= target
    if target < runs.floor:
        return f"the reference resolves {runs.floor:.2g}"
    if good.any():
        least = seconds(float(runs.column("call_s")[good].min()))
        return f"at most {least}, of a run with the error {runs.errors[good].max():.2g}"
    return f"least error {runs.errors.min():.2g}"


def select_rows(rows: Iterable[Row], mechanism: str, t_end: float | None = None) -> list[Row]:
    """Return the rows of a mechanism, and of a span if given; raise ValueError if there are none."""
    rows = list(rows)
    names = {row["mechanism"] for row in rows}
    if mechanism not in names:
        raise ValueError(
            f"there are no rows of the mechanism {mechanism!r}; there are some of {', '.join(sorted(names))}"
        )
    selected = [row for row in rows if row["mechanism"] == mechanism]
    ends = sorted({row["t_end"] for row in selected})
    if t_end is not None and t_end not in ends:
        raise ValueError(f"rows of {mechanism} end at {', '.join(f'{end:g}' for end in ends)} s; given {t_end:g} s")
    return [row for row in selected if t_end in (None, row["t_end"])]


def leaderboard(
    mechanism: str, target: float, files: Iterable[Path] = (), t_end: float | None = None, out: Path | None = None
) -> str:
    """Return the boards of a mechanism at an error as text, from the rows shipped and those in files.

    Raises ValueError if an argument is out of range, a file is not in the format, or there are no rows.
    """
    if not 0.0 < target < 1.0:
        raise ValueError(f"--error must be between 0 and 1; given {target:g}")
    rows = [row for path in (ARCHIVE, *files) for row in read_rows(path)]
    ranking = boards(select_rows(rows, mechanism, t_end), target)
    if out is not None:
        _plot(ranking, rows, out)
    return "\n\n".join([*map(str, ranking), CALL])


def _plot(ranking: Sequence[Board], rows: Sequence[Row], out: Path) -> None:
    """Plot error and time of all runs, one panel per board."""
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(
        1, len(ranking), figsize=(6.4 * len(ranking), 5.6), squeeze=False, layout="constrained"
    )
    for axes, board in zip(panels[0], ranking, strict=True):
        board_rows = [
            row
            for row in rows
            if (row["mechanism"], row["t_end"], row["processor"]) == (board.mechanism, board.t_end, board.processor)
        ]
        for k, entry in enumerate(board.entries[:10]):  # more would be indistinguishable
            runs = [row for row in board_rows if row["solver"] == entry.solver and row["version"] == entry.version]
            points = [(row[board.measure], np.median(row["times_s"])) for row in runs if row.get(board.measure)]
            axes.loglog(*zip(*sorted(points), strict=True), f"{'os^vDPX*d>'[k]}-", ms=4, lw=0.8, label=entry.solver)
        axes.axvline(board.target, color="0.6", lw=0.8)
        axes.invert_xaxis()
        axes.set(xlabel=f"error {MEASURES[board.measure]}", ylabel="CPU time of the whole call (s)")
        axes.set_title(f"{board.mechanism} to {board.t_end:g} s; {board.processor}", fontsize=9)
        if board.entries:
            axes.legend(fontsize=7)
    figure.savefig(out)
    plt.close(figure)
