"""Table 3 of the paper: the 32 cells beside IDA and Exudyn; with --full also the other solvers and readings."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import chain, product
from typing import Any, Literal

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator
from scipy.optimize import least_squares

from studies.bench import adaptive, cli, figures, four_bar, solvers, tables
from studies.bench.cli import StudyError
from studies.bench.collector import REPEATS, Case, Run, Solver, Warm, collect, row_of
from studies.bench.headline import OWN_CODE
from studies.bench.metrics import ASTRAY, LOST
from studies.bench.render import number, power, table
from studies.bench.solvers import CATALOGUE, ERR_IN, IRK, IRK_LINE, NEWMARK, QUARTER
from studies.bench.store import Array, Output, Row
from studies.bench.study import Study, saved, write_index
from studies.bench.tables import where
from twoloop import Result, RungeKutta, solve_dae
from twoloop.methods.tableaux import gauss, sun_radau_iib

Geometry = tuple[tuple[float, float, float], float]  # lengths of the bars and distance of the ground joints, m

TOLERANCES = solvers.ERR_OUT  # of err_in, too
FAMILIES = {"Table 3: IRK": IRK, "Table 3: Newmark": NEWMARK}
# Table 3 as printed: [err_in][err_out] in seconds; None is the star, "no reasonable result in long time simulation"
PAPER_IRK = ((1.95, 1.98, 2.00, 2.08), (2.12, 2.23, 2.31, 2.31), (2.64, 2.85, 2.85, 2.99), (3.37, 3.46, 3.55, 3.60))
PAPER_NEWMARK = (
    (None, 2.71, 12.62, 49.73),
    (None, 2.74, 12.36, 49.68),
    (None, 3.10, 12.68, 49.66),
    (None, 3.09, 13.40, 50.93),
)
PRINTED: dict[str, tuple[tuple[float | None, ...], ...]] = dict(zip(FAMILIES, (PAPER_IRK, PAPER_NEWMARK), strict=True))
PRINTED_RATIO = float(PAPER_NEWMARK[3][3] or 0.0) / PAPER_IRK[3][3]  # 50.93 s over 3.60 s
PAPER_END = 100.0  # s, of the paper's runs
CELL_REPEATS = 3  # the times of a cell differ by a few per cent; an odd number has a middle one
BESIDE = {  # solver and settings, loose to tight: tolerances, or steps in s of Exudyn, whose run at 1e-4 s takes 10 s
    solvers.GIVEN: (1e-4, 1e-6, 1e-8),
    solvers.IDA_C: (1e-4, 1e-6, 1e-8, 1e-10),
    "Exudyn, GeneralizedAlpha": (1e-2, 4e-3, 1e-3),
    "Exudyn, TrapezoidalIndex2": (1e-2, 4e-3, 1e-3),
}


def machine(rows: pd.DataFrame, group: str, err_in: float, err_out: float) -> pd.Series | None:
    """Return the run of a cell."""
    found = where(rows, group=group, err_in=err_in, err_out=err_out)
    return None if found.empty else found.iloc[0]


def least(run: pd.Series) -> float:
    """Return the least time of the repetitions of a run, the one that other processes have prolonged least."""
    times = run.get("times")
    return float(min(times) if isinstance(times, tuple) and times else run["call_s"])


def cell_runs(case: Case, repeats: int) -> list[Run]:
    """List the 32 cells."""
    procedures = zip(FAMILIES, (solvers.paper_irk_at, solvers.paper_newmark_at), strict=True)
    grid = product(procedures, TOLERANCES, TOLERANCES)
    return [Run(case, at(e_in), e_out, group, repeats) for (group, at), e_in, e_out in grid]


def short_runs(case: Case, quick: bool) -> list[Run]:
    """List the cells and the solvers beside them, of which the default, with the shortest times, is repeated."""
    repeats = 1 if quick else CELL_REPEATS
    made = cell_runs(case, repeats)
    for name, values in BESIDE.items():
        each = repeats if name == solvers.GIVEN else 1
        made += [Run(case, CATALOGUE[name], value, "beside", each) for value in (values[:1] if quick else values)]
    return made


def make_short(output: Output, geometry: Geometry | None = None) -> pd.DataFrame:
    """Make all rows, of the assumed geometry or of another."""
    try:
        quick = output.call.quick
        case = four_bar.cases(quick)[0] if geometry is None else four_bar.case_of(*geometry, quick)
        _ = case.reference
    except ValueError as error:
        raise StudyError(f"no run with these lengths: {error}") from None
    # the calls of a cell are long enough to be timed one by one
    with output.kept() as kept:
        rows = collect(output.call.wanted(short_runs(replace(case, timed=0.0), quick)), kept)
    return rows.assign(assumed=geometry is None)


def ratios(rows: pd.DataFrame, group: str) -> Array:
    """Return the paper's time over our least, err_in by err_out; NaN where either has no result that is of use."""
    found = np.array(PRINTED[group], dtype=float)
    for (i, e_in), (j, e_out) in product(enumerate(TOLERANCES), repeat=2):
        run = machine(rows, group, e_in, e_out)
        found[i, j] /= np.nan if run is None or run["lost"] else least(run)
    return found


def short_findings(rows: pd.DataFrame) -> dict[str, Any]:
    """Compute what the report says."""
    irk, newmark = (machine(rows, group, ERR_IN, ERR_IN) for group in FAMILIES)
    if irk is None or newmark is None:
        raise StudyError("the rows lack cells of Table 3; make them again by python -m studies.table3")
    found: dict[str, Any] = {"t_end": float(rows["t_end"].iloc[0]), "assumed": bool(rows["assumed"].iloc[0])}
    for name, column in (("time_ratio", "call_s"), ("evaluation_ratio", "n_evaluations")):
        found[name] = newmark[column] / irk[column]
    for name, group in zip(("irk", "newmark"), FAMILIES, strict=True):
        over, cells = ratios(rows, group), rows[rows["group"] == group]
        kept = over[np.isfinite(over)]
        found[f"{name}_over"] = [float(kept.min()), float(kept.max())] if kept.size else []
        for what in ("lost", "astray"):
            which = sorted(cells[cells[what].astype(bool)]["err_out"].unique(), reverse=True)
            found[f"{name}_{what}"] = list(map(power, which))
    found["newmark_only_astray"] = [e for e in found["newmark_astray"] if e not in found["newmark_lost"]]
    found |= {"lost_limit": LOST, "astray_limit": ASTRAY, "failed": int((rows["status"] != "REACHED_END").sum())}
    answer = f"Newmark takes {number(found['time_ratio'])} times as long as Runge–Kutta at the tightest tolerances"
    if found["t_end"] == PAPER_END:
        answer = f"The pattern comes out in part, not the times: {answer}, in the paper {number(PRINTED_RATIO)} times."
    else:
        answer += f"; the paper's {number(PRINTED_RATIO)} is for {number(PAPER_END)} s."
    return found | {"answer": answer}


def grid(rows: pd.DataFrame, group: str, paper: bool) -> str:
    """Make a table of times in s, err_in by err_out: ours, or with `paper` those that are printed."""
    lines = []
    for e_in, own in zip(TOLERANCES, PRINTED[group], strict=True):
        ours = [machine(rows, group, e_in, e_out) for e_out in TOLERANCES]
        times = own if paper else [None if run is None else run["call_s"] for run in ours]
        lines.append([power(e_in), *(number(time, 4 if paper else 2) for time in times)])
    return table(["err_in \\ err_out", *map(power, TOLERANCES)], lines)


def beside(rows: pd.DataFrame) -> str:
    """Make a table of the solvers beside the procedures, with these at their tightest, from the largest error down."""
    own = rows[rows["group"].isin(FAMILIES) & (rows["err_in"] == ERR_IN) & (rows["err_out"] == ERR_IN)]
    chosen = pd.concat([own, rows[rows["group"] == "beside"]])
    lines = []
    for _, run in chosen.sort_values("error_q", ascending=False).iterrows():
        lines.append([run["solver"], tables.setting(run), number(run["call_s"]), number(run["error_q"])])
    return table(["solver", "setting", "CPU time (s)", "largest error (m, rad)"], lines)


def short_figures(rows: pd.DataFrame, found: dict[str, Any]) -> dict[str, Figure]:
    """Draw the ratio of the paper's time to twoloop's, for both procedures, without runs shorter than the paper's."""
    if found["t_end"] != PAPER_END:
        return {}
    known = {group: ratios(rows, group) for group in FAMILIES}
    every = np.concatenate([np.ravel(each) for each in known.values()])
    norm = LogNorm(np.nanmin(every), max(np.nanmax(every), 1.01 * np.nanmin(every)))
    figure, panels = plt.subplots(1, 2, figsize=(7.4, 3.4), sharey=True, layout="constrained")
    colours, labels = plt.get_cmap("viridis").with_extremes(bad="#e6e6e6"), [power(e) for e in TOLERANCES]
    for axes, (group, name) in zip(panels, FAMILIES.items(), strict=True):
        image = axes.imshow(known[group], norm=norm, cmap=colours)
        for (i, j), value in np.ndenumerate(known[group]):
            text, size = ("no result", 7) if np.isnan(value) else (number(value), None)
            color = "black" if np.isnan(value) or norm(value) >= 0.6 else "white"
            axes.text(j, i, text, ha="center", va="center", color=color, fontsize=size)
        places = range(len(TOLERANCES))
        axes.set(xticks=places, xticklabels=labels, yticks=places, yticklabels=labels, xlabel="err_out")
        axes.set_title(name, fontsize=9)
        axes.grid(False)
    panels[0].set_ylabel("err_in")
    ticks = LogLocator(subs=(1.0, 2.0, 3.0, 4.0, 6.0, 8.0))
    scale = figure.colorbar(image, ax=panels, shrink=0.8, ticks=ticks, format=lambda value, _: number(value))
    scale.set_label("paper's time / that of twoloop")
    least_, most = number(np.nanmin(every)), number(np.nanmax(every))
    figures.message(figure, f"The paper's times are {least_} to {most} times those of twoloop: not one factor")
    return {"table3_ratios": figure}


def short_tables(rows: pd.DataFrame, found: dict[str, Any]) -> dict[str, str]:
    """Make the tables of the report, and print those of the times."""
    ready = {"beside": beside(rows)}
    for name, group in zip(("irk", "newmark"), FAMILIES, strict=True):
        ready |= {name: grid(rows, group, paper=False), f"{name}_paper": grid(rows, group, paper=True)}
        print(f"\n{group}, CPU time in s over {number(found['t_end'])} s\n{ready[name]}")
        if found["t_end"] == PAPER_END:
            print(f"as printed in the paper\n{ready[f'{name}_paper']}")
    print(f"\nbeside them\n{ready['beside']}")
    return ready


def study_of(geometry: Geometry | None = None) -> Study:
    """Return the study, with the geometry that is assumed or with another."""
    make_rows = partial(make_short, geometry=geometry)
    return Study("table3", __doc__, make_rows, short_findings, short_figures, short_tables, medians=True)


UNEQUAL = 1.2  # times of the same run, largest over least, beyond which they are no result
FLAT = 1.5  # a cause explains the pattern if the largest ratio over the smallest is at most this
Reading = Literal["all", "independent"]
READINGS: dict[Reading, str] = {"all": "all of z", "independent": "y_i only"}  # what criterion (32) is taken over


def cells(rows: pd.DataFrame, exchanged: bool = False) -> pd.DataFrame:
    """List cells of both: printed time, our least time and counts; exchanged: err_in and err_out of the IRK swapped."""
    lines = []
    for group, (i, e_in), (j, e_out) in product(FAMILIES, enumerate(TOLERANCES), enumerate(TOLERANCES)):
        swapped = exchanged and group == "Table 3: IRK"
        paper = PRINTED[group][j][i] if swapped else PRINTED[group][i][j]
        ours = machine(rows, group, e_in, e_out)
        if paper is not None and ours is not None:
            attempts = float(ours["n_steps"]) + float(ours["n_rejected"])
            lines.append((group, paper, least(ours), *ours[["n_evaluations", "n_inner"]].astype(float), attempts))
    return pd.DataFrame(lines, columns=["group", "paper", "call_s", "evaluations", "inner", "attempts"])


def span(ratio: pd.Series) -> float:
    """Return the largest over the smallest: 1 if one factor explains all."""
    return float(ratio.max() / ratio.min())


def fit(table: pd.DataFrame) -> dict[str, float]:
    """Fit, in logs, the cost model: printed time = e (evaluations + i inner iterations + p attempted steps).

    i is at most 1, because an evaluation contains inner iterations, none of which can cost more.
    """

    def cost(x: np.ndarray) -> np.ndarray:
        scale, inner, attempt = np.exp(x)
        model = scale * (table["evaluations"] + inner * table["inner"] + attempt * table["attempts"])
        return np.asarray(np.log(model / table["paper"]), dtype=float)

    found = least_squares(cost, np.log([2e-5, 0.2, 4.0]), bounds=(np.log(1e-9), np.log([1.0, 1.0, 1e3])))
    residual = cost(found.x)
    rms, span = np.sqrt(np.mean(residual**2)), np.exp(residual.max() - residual.min())
    return {"attempt": float(np.exp(found.x[2])), "rms": float(rms), "span": float(span)}


def partition_cost(rows: pd.DataFrame) -> float:
    """Return the seconds of one partition by full pivoting, from runs with and without it in every step.

    The partition is `partition="symmetric"`, in fixed steps of the midpoint rule, which has few evaluations.
    """
    solvers = (f"fixed step, {name}" for name in ("lasting", "symmetric"))
    kept, every = (where(rows, group="partition", solver=name).iloc[0] for name in solvers)
    evaluation = kept["call_s"] / kept["n_evaluations"]
    # the two runs do not iterate equally often
    extra = every["call_s"] - evaluation * every["n_evaluations"]
    return float(extra / every["n_steps"])


def _paper_irk(test: Reading, case: Case, err_out: float, repeat: int) -> Result:
    method = RungeKutta(sun_radau_iib(3), "paper", "richardson-paper", ERR_IN, err_out, outer_test=test)
    return solve_dae(*case.start, method=method, rtol=solvers.PAPER_TOL, atol=solvers.PAPER_TOL)


def readings(rows: pd.DataFrame) -> list[dict[str, Any]]:
    """Tell how far evaluations along err_out of each reading of (32) are from the printed row, and whether in phase."""
    found = []
    for what in READINGS.values():
        runs = where(rows, group="reading", solver=f"{IRK}, (32) on {what}", err_in=ERR_IN)
        runs = runs.set_index("err_out").reindex(TOLERANCES)
        if runs["status"].eq("REACHED_END").all():
            apart = np.log(runs["n_evaluations"].to_numpy(float) / PAPER_IRK[-1])
            # about its mean, as the factor between both is free
            found.append({"over": what, "rms": float(np.std(apart)), "astray": bool(runs["astray"].iloc[0])})
    return found


def causes(rows: pd.DataFrame) -> dict[str, Any]:
    """Find the paper's times over ours by procedure, and what each cause and reading leaves of the pattern."""
    table = cells(rows)
    partition = partition_cost(rows)
    by_time = table["paper"] / table["call_s"]
    found: dict[str, Any] = {"flat": FLAT, "one_constant": span(by_time) <= FLAT, "span_time": span(by_time)}
    by_count = span(table["paper"] / table["evaluations"])
    by_partition = span(table["paper"] / (table["call_s"] + partition * table["attempts"]))
    found |= {"span_evaluations": by_count, "evaluations_explain": by_count <= FLAT, "partition_us": 1e6 * partition}
    found |= {"span_partition": by_partition, "partition_explains": by_partition <= FLAT}
    found["fits"] = {"as labelled": fit(table), "exchanged": fit(cells(rows, exchanged=True))}
    literal, exchanged = found["fits"].values()
    found["exchanged_fits_better"] = exchanged["rms"] < literal["rms"]
    return found | {"readings": readings(rows)}


TARGETS = (1e-2, 1e-4, 1e-6)
PAPER = (NEWMARK, QUARTER, IRK_LINE)
LOOPS = (1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10)  # err_out of Newmark
# all coordinates, projected: not the paper's procedure
EXPLICIT = (solvers.OWN_EXPLICIT, solvers.TAYLOR, solvers.ADAMS)
# for seconds: no quick runs
COMPILED = (
    *(OWN_CODE, solvers.HEYOKA, solvers.CYRK, solvers.CVODE_C, solvers.IDA_INDEX_1, "IDA, stabilised"),
    *("LSODA, index 1", "DOP853, index 1", "DOP853, projected"),
)
OTHERS = (
    *(solvers.DEFAULT, "SunRadau5", "Gauss6", "Gauss12", "BDF", *EXPLICIT, solvers.IDA_C, *COMPILED),
    *("Exudyn, GeneralizedAlpha", "Exudyn, TrapezoidalIndex2"),
)
DRAWN = (OWN_CODE, NEWMARK, IRK_LINE, solvers.HEYOKA, solvers.CYRK, solvers.IDA_C)
FOLDER = "given_lengths"  # in reports/, for another geometry: the reports there are of the assumed one
STEP = 0.01  # s, of the runs that tell what a partition costs


def _fixed(partition: str, case: Case, step: float, repeat: int) -> Result:
    return solve_dae(*case.start, method=RungeKutta(gauss(1), partition=partition), step_size=step)  # type: ignore[arg-type]


def runs(first: Case, second: Case, quick: bool) -> list[Run]:
    """List the runs for the table, a partition's cost, both readings of (32) along err_out, and the other solvers."""
    made, repeats = list[Run](), 1 if quick else REPEATS
    for test, what in READINGS.items():
        fixed, run = {"err_in": ERR_IN, "outer_test": test}, partial(_paper_irk, test)
        solver = Solver(f"{IRK}, (32) on {what}", "two-loop", "compiled", True, "err_out", run, fixed=fixed)
        made += [Run(first, solver, err_out, "reading", 1) for err_out in TOLERANCES]
    made += cell_runs(first, repeats) + [run for run in cell_runs(second, 1) if run.solver.fixed["err_in"] == run.value]
    for partition in ("lasting", "symmetric"):
        solver = Solver(f"fixed step, {partition}", "two-loop", "compiled", True, "h", partial(_fixed, partition))
        made.append(Run(first, solver, STEP, "partition", 3 if quick else 9))  # they differ by little
    for case, names in ((first, (*PAPER, *OTHERS)), (second, () if quick else PAPER)):
        for solver in (CATALOGUE[name] for name in names if not (quick and name in COMPILED)):
            values = LOOPS if solver.name in (NEWMARK, QUARTER) else solver.grid(case)
            made += [Run(case, solver, x, "comparison", repeats) for x in (values[1:3] if quick else values)]
    return made


def make(output: Output) -> pd.DataFrame:
    """Make all rows, with the height of bar 3's centre, by which the paper judges energy."""

    def highest(run: Run, result: Result) -> dict[str, float]:
        return {"y3_max": float(result.q[four_bar.Y3].max()) if result.t.size else float("nan")}

    def row(run: Run, repeat: int, built: Warm) -> Row:
        return row_of(run, repeat, highest, built)

    quick = output.call.quick
    first, second = four_bar.cases(quick)
    todo, errors = output.call.wanted(runs(first, second, quick)), () if quick else TARGETS
    compared = [run for run in todo if run.group == "comparison"]
    with output.kept() as kept:
        rows = collect([run for run in todo if run.group != "comparison"], kept, highest)
        more = adaptive.collect(compared, kept, row, lambda run: True, errors, adaptive.is_ours)
    return pd.concat([rows, more], ignore_index=True)


def findings_of(rows: pd.DataFrame) -> dict[str, Any]:
    """Compute what the report says, of the first geometry."""
    first = rows[rows["problem"] == rows["problem"].iloc[0]]
    fine = _compared(rows)
    same = tables.where(first, solver=NEWMARK, err_in=ERR_IN, err_out=ERR_IN)
    times = [time for own in same["times"] for time in own]  # of all its repetitions, in whatever group
    if not times:
        raise StudyError("the rows lack cells of Table 3; make them again by python -m studies.table3 --full")
    found: dict[str, Any] = {"t_end": float(first["t_end"].iloc[0]), "newmark_times": [min(times), max(times)]}
    found["times_unequal"] = max(times) > UNEQUAL * min(times)
    ratios = _newmark_over_irk(fine)
    over = list(chain(*ratios.values()))
    found |= {"newmark_over_irk": [min(over), max(over)] if over else [], "newmark_errors": list(ratios)}
    found["cheapest"] = [line for error in TARGETS if (line := _cheapest(fine, error)) is not None]
    dearer = [irk for each in found["cheapest"] if (irk := each["paper_times"])]
    found |= {"paper_times": [min(dearer), max(dearer)] if dearer else [], "explicit": _explicit(fine)}
    failed = rows[rows["status"] != "REACHED_END"]
    found |= {"failed": len(failed), "failed_two_loop": int((failed["family"] == "two-loop").sum())}
    answer = "No error is reached by both the paper's Runge–Kutta procedure and another solver."
    if dearer:
        answer = "At equal error, the paper's Runge–Kutta procedure takes "
        answer += " to ".join(map(number, found["paper_times"])) + " times as long as the cheapest solver."
    return found | causes(first) | {"answer": answer}


def _cheapest(first: pd.DataFrame, error: float) -> dict[str, Any] | None:
    """Find the cheapest solver at an error, and how many times as long the paper's procedure takes."""
    ranked = tables.ranking(first, error)
    if ranked.empty:
        return None
    times = dict(zip(ranked["solver"], ranked["call_s"] / ranked["call_s"].iloc[0], strict=True))
    return {"error": error, "paper_times": times.get(IRK_LINE)} | (tables.best(ranked) or {})


def _newmark_over_irk(fine: pd.DataFrame) -> dict[str, list[float]]:
    """CPU time of Newmark, with either beta, over that of Runge-Kutta, at errors that both reach or pass."""
    found: dict[str, list[float]] = {}
    for target in (0.1, 0.03, 0.01, 0.003):  # a solution worse than these is of no use
        half, quarter, irk = (
            tables.time_for(runs_, target) if target <= runs_["error_q"].max() else np.nan
            for runs_ in (fine[fine["solver"] == solver] for solver in PAPER)
        )
        ratios = [float(newmark / irk) for newmark in (half, quarter) if not np.isnan(newmark / irk)]
        found |= {number(target): ratios} if ratios else {}
    return found


def _explicit(fine: pd.DataFrame) -> list[float]:
    """Divide the time of the paper's Runge-Kutta procedure by that of the cheapest explicit method of `EXPLICIT`."""
    over = []
    for error in TARGETS:
        paper, *explicit = (tables.time_for(fine[fine["solver"] == name], error) for name in (IRK_LINE, *EXPLICIT))
        over.append(float(paper / np.fmin.reduce(explicit)))  # of those that get there
    return [ratio for ratio in over if not np.isnan(ratio)]


def _compared(rows: pd.DataFrame) -> pd.DataFrame:
    """Select the runs of the first geometry to compare at equal error: of the cells those of the finest inner loop."""
    fine = (rows["err_in"].isna() | (rows["err_in"] == ERR_IN)) & (rows["problem"] == rows["problem"].iloc[0])
    return rows[rows["group"].isin(("comparison", *FAMILIES)) & fine]


def figures_of(rows: pd.DataFrame, found: dict[str, Any]) -> dict[str, Figure]:
    """Draw CPU time over error."""
    most = f"{' to '.join(map(number, found['paper_times']))} times" if found["paper_times"] else "more"
    title = f"The paper's Runge–Kutta procedure takes {most} the least time"
    return {"table3_full": figures.work_precision(_compared(rows), DRAWN, title, coded=True)}


def tables_of(rows: pd.DataFrame, found: dict[str, Any]) -> dict[str, str]:
    """Make the table of the report."""
    lines = tables.work_precision(_compared(rows), TARGETS, DRAWN, coded=True)
    return {"work": table(["solver", *map(power, TARGETS)], [[solver, *times] for solver, _, *times in lines])}


STUDY = Study("table3_full", __doc__, make, findings_of, figures_of, tables_of, medians=True)


def main(words: Sequence[str] | None = None) -> None:
    """Run the study for a command line."""

    def inside(words: Sequence[str] | None) -> None:
        parser = cli.parser("table3", __doc__, parts=True)
        parser.add_argument("--full", action="store_true", help="the long study, into table3_full.*: about 20 minutes")
        parser.add_argument("--lengths", nargs=3, type=float, metavar=("L1", "L2", "L3"), help="of the bars, m")
        parser.add_argument("--ground", type=float, metavar="G", help="distance of the ground joints, m")
        given = parser.parse_args(words)
        if (given.lengths is None) != (given.ground is None):
            raise StudyError("--lengths L1 L2 L3 and --ground G go together: the paper's Table 2 has all four")
        geometry = None if given.lengths is None else (tuple(given.lengths), given.ground)
        if geometry is not None and given.full:
            raise StudyError("--full is for the assumed geometry; leave it out with --lengths")
        if geometry is not None and given.out is None:
            given.out = cli.REPORTS / FOLDER
        call = cli.call_of("table3", given, words)
        chosen = STUDY if given.full else study_of(geometry)
        with Output(replace(call, study=chosen.name)) as output:
            chosen.report(output, *saved(output, chosen.make))
            write_index(output)
        print(f"wrote the files of {chosen.name} to {output.path}")

    cli.main(inside, words)


if __name__ == "__main__":
    main()
