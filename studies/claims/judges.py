"""Claims and their judges: from the rows of other studies to a verdict and the numbers that decide."""

import itertools
import tomllib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from studies.bench import solvers, tables
from studies.bench.cli import StudyError
from studies.bench.metrics import ASTRAY, LOST
from studies.bench.render import number
from studies.bench.solvers import GEAR_ORDERS, IDA_C, IRK, IRK_LINE, NEWMARK, OWN_BDF, QUARTER, gear
from studies.bench.store import Array, read_rows
from studies.energy import NO_DRIFT, verdict
from studies.reproduction import ablation
from studies.reproduction.beam import HALF_A_DECADE, PAPER_SECONDS, PAPER_STEPS, PARAMETERS, SOFT, STIFF
from studies.reproduction.motion import PASSES, VISIBLE
from studies.reproduction.violation import grows
from studies.table3 import FAMILIES, FLAT, PRINTED_RATIO, TOLERANCES, cells
from twoloop.mechanisms import four_bar

STUDIES = ("table3_full", "energy", "motion", "step_size", "violation", "beam", "ablation")
DEFAULT = four_bar().name
LONG = 100.0  # s, the length of the paper's runs
BEAM_END = 2.0  # s, of a full run of the beams
BEAMS = (SOFT, STIFF)


class NotRun(Exception):
    """Raised where there is no row to judge by; the text says which."""


def read(folder: Path) -> dict[str, pd.DataFrame]:
    """Read one row a run of every study that has rows in the folder. Raises StudyError if a file is damaged."""
    paths = [path for name in STUDIES if (path := folder / f"{name}.csv").is_file()]
    return {path.stem: _one_a_run(path.stem, read_rows(path)[0]) for path in paths}


def _one_a_run(name: str, table: pd.DataFrame) -> pd.DataFrame:
    if name == "beam" and "error_tip" in table:  # the error by which the beams are judged
        table["error_q"] = table["error_tip"]
    if {"repeat", "error_q", "call_s"} <= set(table):
        repeated = table[table["repeat"].notna()]
        table = pd.concat([tables.medians(repeated), table[table["repeat"].isna()]], ignore_index=True)
    for column in {"lost", "astray"} & set(table):  # no value: the run gave no result
        table[column] = table[column].map(lambda x: str(x) not in ("False", "0", "0.0"))
    return table.assign(floor=table["floor"].fillna(0.0) if "floor" in table else 0.0)


@dataclass(frozen=True)
class Rows:
    """Hold what judges read: one row a run of each study, and the numbers of `experiments.py`."""

    tables: Mapping[str, pd.DataFrame]
    experiments: Mapping[str, float]

    def number(self, key: str) -> float:
        """Return a number of `experiments.py`."""
        if self.experiments.get(key) is None:
            raise NotRun(f"the experiment {key} was not made")
        return float(self.experiments[key])

    def pick(self, study: str, least: float = 0.0, named: str = "", **equal: Any) -> pd.DataFrame:
        """Select rows by columns (values or tuples) and part of the solver's name; not run if none covers `least` s."""
        if study not in self.tables:
            raise NotRun(f"there is no {study}.csv")
        found = self.tables[study]
        found = found[found["solver"].astype(str).str.contains(named, regex=False)]
        found = tables.where(found, **equal)
        if found.empty:
            raise NotRun(f"{study}.csv has no row of {named} with {', '.join(f'{c} = {v}' for c, v in equal.items())}")
        if least and not found["t_end"].max() >= least:
            raise NotRun(f"quick rows: they cover {found['t_end'].max():g} s, and the claim is about {least:g} s")
        return found

    def long(self, study: str, named: str = "", **equal: Any) -> pd.DataFrame:
        """Select rows of runs as long as the paper's."""
        return self.pick(study, LONG, named, **equal)

    def cell(self, group: str, err_in: float, err_out: float, problem: str = DEFAULT) -> pd.Series:
        """Return a cell of Table 3."""
        return self.long("table3_full", group=group, problem=problem, err_in=err_in, err_out=err_out).iloc[0]

    def beam(self, case: str, named: str, **equal: Any) -> pd.DataFrame:
        """Select full runs of a beam."""
        return self.pick("beam", BEAM_END, named, case=case, group="run", **equal)


FILE = Path(__file__).with_name("claims.toml")


class Verdict(StrEnum):
    """What the rows say of a claim."""

    HOLDS = "holds"
    PART = "holds in part"
    FAILS = "does not hold"
    CONSISTENT = "consistent"
    ASSUMED = "not reproduced (inputs assumed)"
    CIRCULAR = "holds by construction"
    NOT_RUN = "not run"


UNTESTABLE = (Verdict.CONSISTENT, Verdict.ASSUMED, Verdict.CIRCULAR)  # our runs cannot decide, whatever they give


@dataclass(frozen=True)
class Judgement:
    """Hold a verdict, the numbers that decide (a list: least and largest), and why a claim was not judged."""

    verdict: Verdict
    values: Mapping[str, Any] = field(default_factory=dict)
    why: str = ""


def decide(met: Iterable[Any], in_part: Any = None, **values: Any) -> Judgement:
    """Decide by conditions: all met, or some of the cases of which the claim speaks, or none."""
    conditions = [bool(condition) for condition in met]
    if all(conditions):
        return Judgement(Verdict.HOLDS, values)
    part = any(conditions) if in_part is None else in_part
    return Judgement(Verdict.PART if part else Verdict.FAILS, values)


def span(values: Iterable[Any]) -> list[float]:
    """Return the least and the largest; NaN where a value is."""
    array = np.asarray(list(values), dtype=float)
    return [float(array.min()), float(array.max())]


def span_known(ratios: Array) -> list[float]:
    """Return the least and the largest of the known values."""
    if not (known := ratios[np.isfinite(ratios)]).size:
        raise NotRun("no error that both sides reach")
    return span(known)


@dataclass(frozen=True)
class Claim:
    """A claim of the paper, as `claims.toml` has it; that file says what its keys mean."""

    key: str
    section: str
    statement: str
    criterion: str
    fixed: str
    judge: str
    number: str
    options: Mapping[str, Any] = field(default_factory=dict)
    circular: str = ""
    stand_in: str = ""
    inputs: str = ""
    assumed: bool = False

    def judgement(self, judge: Callable[..., Judgement], rows: Rows) -> Judgement:
        """Judge the claim from the rows; "not run" where there is nothing to judge by."""
        try:
            found = judge(rows, **self.options)
        except NotRun as reason:
            return Judgement(Verdict.NOT_RUN, why=str(reason))
        except KeyError as column:
            return Judgement(Verdict.NOT_RUN, why=f"the rows lack {column}")
        if not np.isfinite(np.hstack(list(found.values.values()))).all():
            return Judgement(Verdict.NOT_RUN, why="the rows lack a value that decides")
        holds = Verdict.CONSISTENT if self.stand_in or self.inputs else Verdict.HOLDS
        marked = {Verdict.HOLDS: Verdict.CIRCULAR if self.circular else holds}
        marked[Verdict.FAILS] = Verdict.ASSUMED if self.inputs else Verdict.FAILS
        return replace(found, verdict=marked.get(found.verdict, found.verdict))

    def text(self, found: Judgement) -> str:
        """Tell the numbers of a judgement in the words of `claims.toml`."""
        if found.verdict is Verdict.NOT_RUN:
            return found.why
        values = {name: value if isinstance(value, list) else [value] for name, value in found.values.items()}
        texts = {name: " to ".join(dict.fromkeys(map(number, value))) for name, value in values.items()}
        return self.number.format(**texts)


def load() -> list[Claim]:
    """Load the claims in the order of the paper."""
    return [Claim(key, **entry) for key, entry in tomllib.loads(FILE.read_text()).items()]


FACTOR = 2.0  # within which an estimate, or a limit, counts as the same
STIFFER = 10.0  # times w_max of the very flexible beam, whose modulus is a hundredth
FOLLOWS = 1e-3  # m, of the tip over the run
A_LOT = 5.0  # times; the frequencies grow by 10
TIPS = (1e-2, 1e-3, 1e-4)  # m or rad, errors over the run at which costs are compared: tip, or the linkage
WIDTH = 0.02  # m, about the width of a line in a figure of the tip
PARTED = 10.0  # times the change until 1.2 s

EXPLICIT = (
    *(solvers.OWN_EXPLICIT, solvers.ADAMS, solvers.HEYOKA, solvers.DIFFRAX, solvers.CYRK, "CyRK, Vern8"),
    *("DOP853, projected", "DOP853, index 1", "Pr9, index 1"),
)
FIXED_POINT = (IRK, NEWMARK, QUARTER, solvers.CVODE_C, "CVODE, Adams", "CVODES, CasADi, Adams")
CHOOSING = (solvers.DEFAULT, *solvers.COMPILED, "LSODA, index 1", "CyRK, LSODA")  # between explicit and implicit
# in names of implicit methods by Newton's iteration
BY_NEWTON = ("Radau", "Gauss", "BDF", "TRBDF2", "ESDIRK", "IDA", "CVODES", "collocation")


def common_costs(
    first: pd.DataFrame,
    second: pd.DataFrame,
    targets: tuple[float, ...],
    cost: Callable[[pd.DataFrame, float], float] = tables.time_for,
) -> list[float]:
    """Divide times of the first solver by those of the second at errors that both reach; `cost`: cost(runs, error)."""
    ratios = [cost(first, error) / cost(second, error) for error in targets]
    ratios = [ratio for ratio in ratios if np.isfinite(ratio)]
    if not ratios:
        raise NotRun(f"{first['solver'].iloc[0]} and {second['solver'].iloc[0]} have no error in common")
    return ratios


def cheapest(runs: pd.DataFrame, target: float, what: str) -> float:
    """Find the least cost of any solver at an error; NaN where none has it."""
    return float(
        np.fmin.reduce([tables.time_for(own, target, what) for _, own in runs.groupby("solver")], initial=np.nan)
    )


def kind_of(solver: str) -> str:
    """Tell how a solver steps. Raises StudyError for one that is in no list: it would count as something else."""
    if solver in EXPLICIT:
        return "explicit"
    if solver in (*CHOOSING, *FIXED_POINT):
        return "neither"
    if any(name in solver for name in BY_NEWTON):
        return "Newton"
    raise StudyError(f"whether {solver!r} is explicit is not known: add it to a list of {__name__}")


def jacobian_difficult(rows: Rows) -> Judgement:
    """Compare costs only; whether Jacobians are hard to get was not tested."""
    counts = [rows.number(f"Newton over fixed point, {case}") for case in ("linkage", *BEAMS)]
    seconds = [[tables.as_good(rows.beam(case, name), TIPS[-1]) for name in ("SunRadau5", IRK)] for case in BEAMS]
    times = [newton / paper for newton, paper in seconds]
    return decide((ratio > 1.0 for ratio in (*counts, *times)), evaluations=span(counts), times=span(times))


def stiff_applicable(rows: Rows) -> Judgement:
    limit = rows.pick("beam", named="latest stages", group="limit").iloc[0]
    runs = [_paper_on(rows, case) for case in BEAMS]
    reached = sum(map(_follows, runs))
    h_omega = [run["h_median"] * limit["w_max"] * factor for run, factor in zip(runs, (1.0, STIFFER), strict=True)]
    limited = max(h_omega) < limit["theory"] and max(h_omega) < FACTOR * min(h_omega)  # h goes as 1 / w_max
    return decide([reached == len(runs) and not limited], reached == len(runs), h_omega=span(h_omega), reached=reached)


def implicit_needed(rows: Rows) -> Judgement:
    ratios = {}
    for key, case in zip(("soft", "stiff"), BEAMS, strict=True):
        runs = rows.beam(case, "")
        kinds = runs["solver"].map(kind_of)
        for name, what in ((key, "call_s"), (f"{key}_evaluations", "n_evaluations")):
            sides = (runs[kinds == kind] for kind in ("explicit", "Newton"))
            explicit, newton = (np.array([cheapest(side, tip, what) for tip in TIPS]) for side in sides)
            ratios[name] = span_known(explicit / newton)
    return decide((ratio > 1.0 for bounds in ratios.values() for ratio in bounds), **ratios)


def _paper_on(rows: Rows, case: str) -> pd.Series:
    return rows.beam(case, IRK, tol=solvers.PAPER_TOL).iloc[0]


def step_order(rows: Rows, case: str) -> Judgement:
    median = float(_paper_on(rows, case)["h_median"])
    return decide([abs(np.log10(median / PAPER_STEPS[case])) <= HALF_A_DECADE], median=median)


def beams_work(rows: Rows) -> Judgement:
    runs = [_paper_on(rows, case) for case in BEAMS]
    worst = max(float(run[column]) for run in runs for column in ("error_q", "floor"))  # what the reference resolves
    return decide(map(_follows, runs), worst=worst)


def _follows(run: pd.Series) -> bool:
    return bool(run["status"] == "REACHED_END" and run["error_q"] < FOLLOWS)


def grows_a_lot(rows: Rows) -> Judgement:
    soft, stiff = (_paper_on(rows, case) for case in BEAMS)
    time, evaluations = (float(stiff[what] / soft[what]) for what in ("call_s", "n_evaluations"))
    return decide([min(time, evaluations) >= A_LOT], time=time)


def beam_seconds(rows: Rows) -> Judgement:
    over = [PAPER_SECONDS[case] / float(_paper_on(rows, case)["call_s"]) for case in BEAMS]
    return decide([max(over) <= FLAT * min(over)], soft=over[0], stiff=over[1])


def parting(rows: Rows) -> Judgement:
    soft, stiff = (rows.pick("beam", BEAM_END, case=case, group="sensitivity", solver=PARAMETERS) for case in BEAMS)
    before, after, other = (float(x.max()) for x in (soft["before"], soft["largest"], stiff["largest"]))
    return decide([before < WIDTH and after > PARTED * before and other < WIDTH], before=before, after=after)


IRK_GROUP, NEWMARK_GROUP = FAMILIES
GSTIFF_GROUP = "GSTIFF stand-in"
COARSEST, FINEST = TOLERANCES[0], TOLERANCES[-1]

GROWTH = 10.0  # of the violation from the first tenth of a run to its last: it drifts
SATISFIED = 1e-12  # violation that counts as rounding
LOOSE = 1e-8  # tolerance, from which on what is not solved is off by more
DEARER = 1.2  # times the cost: beyond the noise of times
AGREE = 1e-10  # m or rad
STEP = 0.02  # s
MAIN = 2.0  # times a logarithm must exceed another for its tolerance to be the one that governs
CHANGE = 1.1  # times the steps: a tolerance affects them
TARGETS = (1e-1, *TIPS)
FINER = (*TIPS, 1e-5, 1e-6)  # m, on the stiffer beam no run of Newmark's method is much worse
# of the linkage's solvers: with multipliers for the velocities' constraints too, and independent coordinates alone
PROJECTING = ("IDA, stabilised", IDA_C)
STATE_SPACE = (IRK_LINE, NEWMARK, QUARTER, "SunRadau5", "Gauss6", "Gauss12", OWN_BDF)
ERRORS = (0.1, 0.03, 0.01)  # the same for Newmark's method on the linkage, which reaches no less


def low_index_on_index_3(rows: Rows) -> Judgement:
    runs = rows.long("motion", group=GSTIFF_GROUP)
    runs = runs[~runs["solver"].str.contains("ramp")]
    good = (runs["status"] == "REACHED_END") & ~runs["astray"]
    return decide([not good.any()], not good.all(), bad=int((~good).sum()), runs=len(runs))


def index_1_drifts(rows: Rows) -> Judgement:
    runs = rows.long("table3_full", solver=("DOP853, index 1", "LSODA, index 1", "IDA, index1"), problem=DEFAULT)
    growth = runs["violation_late"] / runs["violation_early"]
    return decide(growth > GROWTH, growth=span(growth))


def baumgarte_inexact(rows: Rows) -> Judgement:
    runs = rows.long("violation", "Baumgarte", group="tolerances")
    size, tol = runs["violation_q"].astype(float), runs["tol"].astype(float)
    off = size > SATISFIED
    return decide(off[tol > LOOSE / 2.0], off.any(), off=int(off.sum()), runs=len(off))


def projection_exact(rows: Rows) -> Judgement:
    """Judge runs that are in phase: a solution that is astray says nothing of a form of the equations."""
    worst = []
    for name in ("DOP853, projected", "IDA, stabilised"):
        runs = rows.long("table3_full", solver=name, problem=DEFAULT)
        worst.append(runs[~runs["astray"]].set_index("tol")["violation_q"].astype(float))
    at_loose = worst[1][np.isclose(worst[1].index.to_numpy(float), LOOSE, rtol=1e-6, atol=0.0)]
    values = {"projected": float(worst[0].max()), "multipliers": float(at_loose.iloc[0]) if len(at_loose) else np.nan}
    return decide((violation.max() < SATISFIED for violation in worst), **values)


def projection_inefficient(rows: Rows) -> Judgement:
    def seconds(solvers: tuple[str, ...]) -> Array:  # of the cheapest, at each error that counts
        runs = rows.long("table3_full", solver=solvers, group="comparison", problem=DEFAULT)
        return np.array([cheapest(runs, target, "call_s") for target in TARGETS])

    against = {"paper": (IRK_LINE,), "best": STATE_SPACE}
    spans = {name: span_known(seconds(PROJECTING) / seconds(solvers)) for name, solvers in against.items()}
    return decide((least > DEARER for least, _ in spans.values()), **spans)


def extra_multipliers(rows: Rows) -> Judgement:
    table = rows.pick("ablation", ablation.T_END)
    costs = [ablation.ratios(table, ablation.STABILISED, what) for what in ("n_evaluations", ablation.TIME)]
    if not all(costs):
        raise NotRun(f"ablation.csv has no error common to {ablation.STABILISED} and {ablation.PAPER}")
    least, median = (min(map(function, costs)) for function in (min, np.median))
    return decide([least > DEARER], median > DEARER, time=span(costs[1]))


def constraints_kept(rows: Rows) -> Judgement:
    run = rows.long("violation", solver=IRK, group="line-up").iloc[0]
    worst = max(float(run[f"violation_{level}"]) for level in "qva")
    return decide([worst < SATISFIED and not grows(run)], levels=worst)


def _steady(runs: pd.DataFrame) -> pd.Series:
    """Tell which runs reach their end without drift of the energy, by the verdict of the study of energy."""
    return runs.apply(verdict, axis=1) == NO_DRIFT


def symplectic_stable(rows: Rows) -> Judgement:
    """Judge in part if no run loses its energy, yet one drifts: stability then has another reason."""
    runs = rows.pick("energy", 10.0 * LONG, solver=("Sun Radau IIB(3)", IRK), partition="lasting")
    runs = runs[runs["t_end"] == runs["t_end"].max()]
    drifts, change = ~_steady(runs), runs["slope"].abs() * runs["t_end"]
    stable = (runs["status"] == "REACHED_END") & ~runs["lost"] & (change / runs["kinetic"] < LOST)
    values = {"drifting": int(drifts.sum()), "runs": len(runs), "most": float(change.max())}
    return decide([stable.all(), not drifts.any()], bool(stable.all()), **values)


def newmark_symplectic(rows: Rows) -> Judgement:
    steady = _steady(rows.pick("energy", 10.0 * LONG, named="Newmark", partition="lasting"))
    return decide([steady.any()], steady=int(steady.sum()), runs=len(steady))


def euler_predictor(rows: Rows) -> Judgement:
    """Judge in part if the other prediction saves anything: any limit would be ours."""
    euler, continued = rows.number("iterations from Euler"), rows.number("iterations from the step before")
    return decide([continued >= euler], True, euler=euler, continued=continued)


def share_right(rows: Rows, right: str, of: str, part: float) -> Judgement:
    """Judge by how many cases of an experiment are right: all, or in part more than a share `part`."""
    n_right, n = (int(rows.number(key)) for key in (right, of))
    return decide([n_right == n], n_right > part * n, right=n_right, of=n)


def dependents_in_the_loop(rows: Rows) -> Judgement:
    table = rows.pick("ablation", ablation.T_END)
    ratio = ablation.frozen_ratios(table)
    if not ratio:
        raise NotRun("ablation.csv has no run as good as the best with dependents frozen")
    orders = [ablation.order(table, name) for name in table["tableau"].unique()]
    return decide([min(ratio) > DEARER, max(orders) < ablation.ONE], ratio=span(ratio))


def agree_and_reach(rows: Rows) -> Judgement:
    runs = rows.long("motion", solver=(IRK, NEWMARK), group="line-up")
    met = (runs["error_y3_short"] < VISIBLE).all() & (runs["top"] < PASSES) & (runs["top_late"] > -PASSES)
    return decide(met, short=float(runs["error_y3_short"].max()))


def energy_bounds_y3(rows: Rows) -> Judgement:
    passing, linkages = (int(rows.number(key)) for key in ("linkages passing", "linkages"))
    own_keeps = rows.number("highest y3, assumed") <= PASSES
    return decide([own_keeps, passing == 0], own_keeps, passing=passing, linkages=linkages)


def gstiff(rows: Rows, part: str) -> Judgement:
    """Count the orders for which a statement is true; one order must meet both, as the paper does not name it."""
    met: dict[str, set[int]] = {"short": set(), "long": set()}
    for order in GEAR_ORDERS:
        runs = rows.long("motion", group=GSTIFF_GROUP, solver=gear(order)).set_index("h")
        coarse, fine = runs.loc[STEP], runs.loc[STEP / 2]
        # written so that a failed run is off, too
        if not coarse["error_y3_short"] <= VISIBLE and fine["error_y3_short"] <= VISIBLE:
            met["short"].add(order)
        if not fine["error_y3"] <= ASTRAY * fine["range_y3"]:
            met["long"].add(order)
    return decide([met["short"] & met["long"]], orders=len(met[part]), of=len(GEAR_ORDERS))


def stand_in_as_foil(rows: Rows) -> Judgement:
    ours = rows.long("table3_full", solver=IRK_LINE, problem=DEFAULT)
    ratios = common_costs(rows.long("motion", group=GSTIFF_GROUP, solver=gear(5)), ours, TIPS)
    return decide((ratio > 1.0 for ratio in ratios), ratio=span(ratios))


def large_steps(rows: Rows) -> Judgement:
    runs = rows.long("step_size", solver=(IRK, NEWMARK, QUARTER), group="paper").groupby("solver").first()
    ratios = runs["h_median"][IRK] / runs["h_median"].drop(IRK)
    return decide([runs["share_time"][IRK] > 0.5, (ratios > 1.0).all()], ratio=span(ratios))


def tolerances_and_steps(rows: Rows) -> Judgement:
    changes = []
    for group, loose in itertools.product(FAMILIES, ((COARSEST, FINEST), (FINEST, COARSEST))):
        changes.append(float(rows.cell(group, FINEST, FINEST)["n_steps"] / rows.cell(group, *loose)["n_steps"]))
    affected = [max(change, 1.0 / change) > CHANGE for change in changes]
    return decide(affected, affected=sum(affected), changes=changes)


def _influence(rows: Rows, group: str, coarsest: float) -> tuple[float, ...]:
    """Return mean factors in time from `coarsest` to 1e-9: of err_in at every err_out from there on; the reverse."""
    out = [e for e in TOLERANCES if e <= coarsest]
    by_in = [rows.cell(group, FINEST, e)["call_s"] / rows.cell(group, coarsest, e)["call_s"] for e in out]
    by_out = [rows.cell(group, e, FINEST)["call_s"] / rows.cell(group, e, coarsest)["call_s"] for e in out]
    return tuple(float(np.exp(np.log(np.asarray(ratios, dtype=float)).mean())) for ratios in (by_in, by_out))


def newmark_tolerances(rows: Rows) -> Judgement:
    by_in, by_out = _influence(rows, NEWMARK_GROUP, 1e-5)
    return decide([np.log(by_out) > MAIN * abs(np.log(by_in))], by_out=by_out, by_in=by_in)


def irk_tolerances(rows: Rows) -> Judgement:
    by_in, by_out = _influence(rows, IRK_GROUP, 1e-3)
    return decide([by_in > max(by_out, 1.0 / by_out)], by_in=by_in, by_out=by_out)


def newmark_star(rows: Rows) -> Judgement:
    runs = rows.long("table3_full", group=NEWMARK_GROUP, problem=DEFAULT)
    coarse, fine = runs[runs["err_out"] == COARSEST], runs[runs["err_out"] < COARSEST]
    values = {"lost": int(coarse["lost"].sum()), "cells": len(coarse), "fine_lost": int(fine["lost"].sum())}
    return decide([coarse["lost"].all() and not fine["lost"].any()], **values, fine=len(fine))


def irk_star(rows: Rows) -> Judgement:
    runs = rows.long("table3_full", group=IRK_GROUP, problem=DEFAULT, err_out=COARSEST)
    good = ~runs["lost"] & ~runs["astray"] & (runs["y3_max"] < PASSES)
    return decide([good.all()], lost=int(runs["lost"].sum()), cells=len(runs))


def fourteen_times(rows: Rows) -> Judgement:
    ratios = []
    for problem in dict.fromkeys(rows.long("table3_full", group=IRK_GROUP)["problem"]):
        slow, fast = (rows.cell(group, FINEST, FINEST, problem) for group in (NEWMARK_GROUP, IRK_GROUP))
        ratios.append([float(slow[what] / fast[what]) for what in ("call_s", "n_evaluations")])
    return decide([np.min(ratios) >= PRINTED_RATIO / FLAT], times=ratios[0][0], evaluations=ratios[0][1])


def table_3_seconds(rows: Rows) -> Judgement:
    parts = (cells(rows.long("table3_full", problem=DEFAULT, group=group)) for group in FAMILIES)
    irk, newmark = (span(part["paper"] / part["call_s"]) for part in parts)
    return decide([max(irk + newmark) <= FLAT * min(irk + newmark)], irk=irk, newmark=newmark)


def works_long(rows: Rows) -> Judgement:
    run = rows.long("motion", solver=IRK, group="line-up").iloc[0]
    return decide([not run["lost"] and not run["astray"]], error=float(run["error_y3"]))


def _along(rows: Rows, solver: str, problem: str) -> pd.DataFrame:
    """Select the runs of the linkage by one solver along its setting, with err_in = 1e-9."""
    runs = rows.long("table3_full", solver=solver, problem=problem)
    return runs[runs["err_in"].isna() | (runs["err_in"] == FINEST)]


def _newmark_over_irk(rows: Rows) -> dict[str, list[float]]:
    """Divide times of Newmark, both beta, by Runge-Kutta's: at equal errors on linkages, of runs as good on beams.

    On the beams no run of Runge-Kutta has errors as large, so that errors are not equal: the cheapest run of each that
    is at least as accurate counts.
    """
    ratios: dict[str, list[float]] = {"linkage": [], "soft": [], "stiff": []}
    for name in (NEWMARK, QUARTER):
        for problem in dict.fromkeys(rows.long("table3_full")["problem"]):
            newmark, irk = (_along(rows, solver, problem) for solver in (name, IRK_LINE))
            ratios["linkage"] += common_costs(newmark, irk, tuple(e for e in ERRORS if e < newmark["error_q"].max()))
        for key, case in zip(("soft", "stiff"), BEAMS, strict=True):
            ratios[key] += common_costs(rows.beam(case, name), rows.beam(case, IRK), FINER, tables.as_good)
    return ratios


def more_efficient(rows: Rows) -> Judgement:
    ratios = {name: span(values) for name, values in _newmark_over_irk(rows).items()}
    return decide((low > 1.0 for low, _ in ratios.values()), **ratios)


def because_of_order(rows: Rows) -> Judgement:
    slopes = []
    for solver in (IRK_LINE, NEWMARK):
        runs = _along(rows, solver, DEFAULT)
        runs = runs[~runs["astray"]]
        if runs["error_q"].nunique() < 2:
            raise NotRun(f"fewer than two runs of {solver} follow the motion")
        x, y = (np.log(runs[column].astype(float)) for column in ("error_q", "n_evaluations"))
        slopes.append(-float(np.polyfit(x, y, 1)[0]))
    near = (abs(slope * order - 1.0) < 0.25 for slope, order in zip(slopes, (5, 2), strict=True))
    won = [min(ratios) > 1.0 for ratios in _newmark_over_irk(rows).values()]
    least = slopes[0] < slopes[1]
    return decide([*near, least, *won], least and any(won), won=sum(won), cases=len(won))


def values_alone(rows: Rows) -> Judgement:
    worst, given, differenced = (rows.number(key) for key in ("difference", "calls given", "calls differenced"))
    return decide([worst < AGREE, differenced <= given], worst < AGREE, given=given, differenced=differenced)


def nonholonomic(rows: Rows) -> Judgement:
    error, violation = rows.number("non-holonomic error"), rows.number("non-holonomic violation")
    return decide([error < FOLLOWS, violation < SATISFIED], error=error)
