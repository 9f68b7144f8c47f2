"""The rows of the other studies, as the judges read them; all that depends on how a study writes them stands here."""

from collections.abc import Mapping
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from studies import tables
from studies.cli import StudyError
from twoloop.mechanisms import four_bar

STUDIES = ("table3", "motion", "step_size", "violation", "energy", "beam")
DEFAULT = four_bar().name
LONG = 100.0  # s, the length of the paper's runs
BEAM_END = 2.0  # s, of a full run of the beams
IRK_GROUP, NEWMARK_GROUP = "Table 3: IRK", "Table 3: Newmark"


class NotRun(Exception):
    """There is no row to judge by; the text says which."""


def read(folder: Path) -> dict[str, pd.DataFrame]:
    """One row a run of every study whose rows are in the folder.

    Raises
    ------
    StudyError
        If a file of rows is damaged.
    """
    found = {}
    for name in STUDIES:
        path = folder / f"{name}.csv"
        if path.is_file():
            try:
                found[name] = _one_a_run(name, pd.read_csv(StringIO(path.read_text().split("\n", 1)[1])))
            except (ValueError, IndexError) as error:
                raise StudyError(f"{path} is damaged ({error}); make it again by python -m studies.{name}") from None
    return found


def _one_a_run(name: str, table: pd.DataFrame) -> pd.DataFrame:
    if name == "beam" and "error_tip" in table:  # the error by which the beams are judged
        table["error_q"] = table["error_tip"]
    if {"repeat", "error_q", "cpu_s"} <= set(table):
        repeated = table[table["repeat"].notna()]
        table = pd.concat([tables.medians(repeated), table[table["repeat"].isna()]], ignore_index=True)
    for column in ("lost", "astray"):
        if column in table:  # no value: the run gave no result
            table[column] = table[column].map(lambda x: str(x) not in ("False", "0", "0.0"))
    if "floor" not in table:
        table["floor"] = 0.0
    return table.assign(floor=table["floor"].fillna(0.0))


class Rows:
    """What judges read.

    Parameters
    ----------
    tables : mapping
        Study to one row a run.
    experiments : mapping
        Numbers of the small computations in `experiments.py`.
    """

    def __init__(self, tables: Mapping[str, pd.DataFrame], experiments: Mapping[str, float]):
        self.tables, self.experiments = tables, experiments

    def number(self, key: str) -> float:
        """A number of `experiments.py`."""
        if self.experiments.get(key) is None:
            raise NotRun(f"the experiment {key} was not made")
        return float(self.experiments[key])

    def pick(self, study: str, **equal: Any) -> pd.DataFrame:
        """The rows in which each column named has that value, or one of a tuple of values."""
        if study not in self.tables:
            raise NotRun(f"there is no {study}.csv")
        found = self.tables[study]
        for column, value in equal.items():
            if column not in found:
                raise NotRun(f"{study}.csv has no column {column}")
            found = found[found[column].isin(value if isinstance(value, tuple) else (value,))]
        if found.empty:
            raise NotRun(f"{study}.csv has no row with {', '.join(f'{c} = {v}' for c, v in equal.items())}")
        return found

    @staticmethod
    def first(runs: pd.DataFrame, what: str) -> pd.Series:
        """The first of some rows."""
        if runs.empty:
            raise NotRun(f"there is no row of {what}")
        return runs.iloc[0]

    def long(self, study: str, **equal: Any) -> pd.DataFrame:
        """The rows, if they are of runs as long as the paper's."""
        return _as_long(self.pick(study, **equal), LONG)

    def cell(self, group: str, err_in: float, err_out: float, problem: str = DEFAULT) -> pd.Series:
        """A cell of Table 3."""
        return self.long("table3", group=group, problem=problem, err_in=err_in, err_out=err_out).iloc[0]

    def cells(self, group: str, **equal: Any) -> pd.DataFrame:
        """Cells of Table 3."""
        return self.long("table3", group=group, **equal)

    def beam(self, case: str, words: str, **equal: Any) -> pd.DataFrame:
        """Full runs of a beam by the solvers whose name contains the words."""
        runs = self.pick("beam", **equal)
        runs = runs[runs["group"] == "run"] if "run" in set(runs["group"]) else runs
        runs = runs[(runs["case"].astype(str).str.contains(case)) & runs["cpu_s"].notna()]
        runs = runs[runs["solver"].astype(str).str.contains(words, regex=False)]
        self.first(runs, f"the {case} beam by {words}")
        return _as_long(runs, BEAM_END)

    def sensitivity(self, case: str) -> pd.DataFrame:
        """The beam with E or g changed by 0.1 %."""
        runs = self.pick("beam", group="sensitivity")
        runs = runs[runs["case"].astype(str).str.contains(case)]
        runs = runs[runs["solver"].astype(str).str.contains("0.1 %", regex=False)]
        self.first(runs, "the beams with E or g changed by 0.1 %")
        return runs


def _as_long(runs: pd.DataFrame, least: float) -> pd.DataFrame:
    longest = float(runs["t_end"].max())
    if not longest >= least:
        raise NotRun(f"quick rows: they cover {longest:g} s, and the claim is about {least:g} s")
    return runs


def cost(runs: pd.DataFrame, target: float, what: str = "cpu_s") -> float:
    """Cost `what` for an error of at most `target`."""
    found = tables.time_for(runs, target, what)
    if np.isnan(found):
        raise NotRun(f"{runs['solver'].iloc[0]} has no run with an error of {target:g}")
    return found


def common_costs(one: pd.DataFrame, other: pd.DataFrame, targets: tuple[float, ...], what: str) -> list[float]:
    """Costs of `one` over those of `other` at the errors that both reach."""
    costs = [(tables.time_for(one, e, what), tables.time_for(other, e, what)) for e in targets]
    ratios = [a / b for a, b in costs if np.isfinite(a) and np.isfinite(b)]
    if not ratios:
        raise NotRun(f"{one['solver'].iloc[0]} and {other['solver'].iloc[0]} have no error in common")
    return ratios
