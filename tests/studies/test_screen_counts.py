"""Numbers of the first screen are computed again from the committed rows, by other code than that of the studies."""

import json
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from twoloop import ConstrainedSystem, solve_dae
from twoloop.kernels.control.sudden import PLACES
from twoloop.kernels.data.tolerances import LONGEST_UNSEEN

ROOT = Path(__file__).parents[2]
DEFAULT, LIMITED = "the default (twoloop)", ", max_step"  # in the rows of honesty
SINGULAR = "A02"  # how the mechanisms that pass singular positions are called in the rows
EVERY = "Ours evaluate forces that may change suddenly with time at least every * of a run (here"
PRICED = ("case", "solver", "family", "keeps_constraints", "tol", "h", "call_s", "error_q", "violation_q")


@pytest.fixture(scope="module")
def screen():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    return text.split("<!-- generated: begin -->")[1].split("<!-- generated: end -->")[0]


@pytest.fixture(scope="module")
def runs():
    """Runs of honesty that were made, and whether each reports success with an error over 1e-3."""
    table = pd.read_csv(ROOT / "reports" / "honesty.csv", comment="#", low_memory=False)
    table = table[table["outcome"] != "not run"]
    quiet = table["warned"].isna() & ~table["message"].fillna("").str.contains("no error was estimated")
    return table.assign(missed=table["status"].eq("REACHED_END") & (table["error"] > 1e-3) & quiet)


@pytest.fixture(scope="module")
def priced():
    """The columns of work_precision that the sentences need."""
    columns = [*PRICED, "group", "first_call_s"]
    return pd.read_csv(ROOT / "reports" / "work_precision.csv", comment="#", usecols=columns, low_memory=False)


@pytest.fixture(scope="module")
def compared(priced):
    """One row a run at the end of the motion: the repetition of median error, with the median time; inf: it failed."""
    rows = priced[priced["group"] == "every mechanism"].assign(setting=priced["h"].fillna(priced["tol"]))
    rows = rows.assign(error=rows["error_q"].fillna(np.inf)).sort_values("error", kind="stable")
    by_run = rows.groupby(["case", "solver", "setting"])
    place, n = by_run.cumcount(), by_run["error"].transform("size")
    return rows.assign(seconds=by_run["call_s"].transform("median"))[place == n // 2]


def numbers(screen, sentence):
    """The numbers that stand in place of the stars of a sentence."""
    pattern = re.escape(" ".join(sentence.split())).replace(r"\*", r"([\d.e-]*\d)")
    found = re.findall(pattern, " ".join(screen.split()))
    assert len(found) == 1, sentence
    return [float(each) for each in found[0]] if isinstance(found[0], tuple) else [float(found[0])]


def printed(values):
    """Values to the two digits that the screen has."""
    return [float(f"{value:.1e}") for value in values]


def test_runs_with_and_without_a_largest_step_are_counted_from_the_rows(screen, runs):
    told = numbers(
        screen,
        "rivals are silently wrong in * of * runs of the first row, the best of them in * of * gusts and * of * "
        "pulses, the default without it in * and *.",
    )
    held = runs[runs["solver"].str.endswith(LIMITED) & (runs["group"] == "held out")]
    assert told[:2] == [held["missed"].sum(), len(held)]
    short = runs[runs["group"] == "short"]
    for shape, of_rivals, of_default in (("gust", told[2:4], told[6]), ("pulse", told[4:6], told[7])):
        own = short[short["trap"].str.startswith(shape)]
        by = own[own["solver"].str.endswith(LIMITED)].groupby("solver")["missed"].agg(["sum", "size", "mean"])
        best = by[by["mean"] == by["mean"].min()]
        assert of_rivals in best[["sum", "size"]].to_numpy().tolist()
        assert of_default == own[own["solver"] == DEFAULT]["missed"].sum()


def test_the_table_of_silent_errors_is_counted_from_the_rows(screen, runs):
    (look,) = numbers(screen, "of a run (here * s), other forces")
    lines = screen.split("**Silently wrong**")[1].split("We chose")[0].strip().splitlines()[2:]
    (heads, _, *told) = ([cell.strip() for cell in line.strip("|").split("|")] for line in lines)
    held, short = (runs[runs["group"] == group] for group in ("held out", "short"))
    widths = short["trap"].str.extract(r"of (\S+) ms")[0].astype(float) / 1e3
    gusts, pulses = (short["trap"].str.startswith(shape) for shape in ("gust", "pulse"))
    parts = [[held]] + [[short[which & (widths < look)], short[which & (widths >= look)]] for which in (gusts, pulses)]
    for line, of_line in zip(told, parts, strict=True):
        for head, cell in zip(heads[1:], line[1:], strict=True):
            solver = DEFAULT if head == "the default" else head.removeprefix("SciPy, ")
            own = [part[part["solver"] == solver]["missed"] for part in of_line]
            assert cell == " / ".join(f"{each.sum()} of {len(each)}" if len(each) else "–" for each in own), head
    kinds = pd.Series(held["trap"].unique())
    n = [kinds.str.contains(word).sum() for word in ("gust", "friction")]
    assert (
        told[0][0]
        == f"{len(kinds)} kinds of sharp forces ({n[0]} gusts, {n[1]} frictions, {len(kinds) - sum(n)} others)"
    )


def test_what_is_reached_at_singular_positions_is_counted_from_the_rows(screen, compared):
    told = numbers(
        screen,
        "Of * errors on these variants that any solver with constraints reaches, the default reaches *, "
        "`compiled=False` *, the best single rival *.",
    )
    crossing = compared[compared["case"].str.startswith(SINGULAR)]
    ours = crossing["family"] == "two-loop"
    with_code = json.loads((ROOT / "reports" / "work_precision.json").read_text())["rivals"]["with_code"]
    given = crossing["solver"] == np.where(crossing["case"].isin(with_code), "auto, compiled", "auto")
    pairs = [(case, 10.0**-k) for case in crossing["case"].unique() for k in range(3, 14)]

    def reached(which):
        least = crossing[which].groupby("case")["error"].min()
        return sum(least.get(case, np.inf) <= error * (1.0 + 1e-9) for case, error in pairs)

    rivals = [reached(crossing["solver"] == solver) for solver in crossing[~ours]["solver"].unique()]
    assert told == [reached(slice(None)), reached(given), reached(crossing["solver"] == "auto"), max(rivals)]


def test_first_calls_are_taken_from_the_rows(screen, priced):
    n, *told = numbers(
        screen,
        "On * mechanisms they take * to * s with `compiled=True`, * to * s with `CyRK`, "
        "* to * s with `heyoka` (unrolled).",
    )
    known = priced[(priced["group"] == "first call") & priced["first_call_s"].notna()]
    times = [
        known[known["solver"] == solver]["first_call_s"] for solver in ("auto, compiled", "CyRK, DOP853", "heyoka")
    ]
    assert {len(own) for own in times} == {n}
    assert told == printed([value for own in times for value in (own.min(), own.max())])


def test_builds_are_taken_from_the_rows(priced):
    report = (ROOT / "reports" / "work_precision.md").read_text(encoding="utf-8")
    least, most, n, quick, asked, _, _, others, _ = numbers(
        report,
        "by * to * s on * mechanisms on which the default makes code (* of them at most * s), and by * to * s on * "
        "mechanisms on which it does not, in the median of * processes.",
    )
    own = priced[(priced["group"] == "build") & priced["first_call_s"].notna()]
    longer = (own["first_call_s"] - own["call_s"]).groupby(own["case"]).median()
    with_code = json.loads((ROOT / "reports" / "work_precision.json").read_text())["rivals"]["with_code"]
    known = longer[longer.index.isin(with_code)]
    assert [n, others, quick] == [len(known), len(longer) - len(known), (known <= asked).sum()]
    assert [least, most] == printed([known.min(), known.max()])


def test_how_far_the_fastest_rivals_drift_is_taken_from_the_rows(screen, compared):
    """Which rival is the fastest where the default is slower is taken from the findings."""
    told = numbers(
        screen,
        "drift: at the end by * times the error at which times are compared in the median, at most *",
    )
    mechanisms = json.loads((ROOT / "reports" / "work_precision.json").read_text())["rivals"]["mechanisms"]
    drifts = []
    for case, at in ((each["case"], at) for each in mechanisms for at in each["at"]):
        standing = at["standing"]["the default"]
        own = compared[(compared["case"] == case) & (compared["solver"] == standing["rival"]["solver"])]
        own = own[(own["error"] <= at["error"]) & own["violation_q"].notna() & own["keeps_constraints"].eq(False)]
        if standing["verdict"] == "behind" and len(own):
            drifts.append(own.sort_values("seconds")["violation_q"].iloc[0] / at["error"])
    assert told == printed([np.median(drifts), max(drifts)])


def test_the_intervals_of_looking_are_those_of_the_package(screen):
    (every,) = numbers(screen, EVERY)
    assert every == pytest.approx(LONGEST_UNSEEN / PLACES)
    assert "other forces every hundredth, and" in screen and pytest.approx(0.01) == LONGEST_UNSEEN


@pytest.mark.parametrize("method", ["auto", "DOP853", "RadauIIA5", "BDF"])
def test_forces_are_evaluated_as_often_as_the_screen_says(screen, method):
    (every,) = numbers(screen, EVERY)
    t_end, seen = 3.0, []

    def force(t, q, v):
        seen.append(t)
        return np.array([0.0, np.exp(-((t - 1.0) ** 2))])

    system = ConstrainedSystem.from_python(
        n_q=2,
        n_c=1,
        mass=np.eye(2),
        force=force,
        constraint=lambda t, q: np.array([0.5 * (q @ q - 1.0)]),
        jacobian=lambda t, q: q[None, :],
    )
    result = solve_dae(system, (0.0, t_end), [0.0, -1.0], [0.0, 0.0], method, 1e-3, 1e-3)
    times = np.unique([0.0, t_end, *(t for t in seen if isinstance(t, float))])  # symbols are among them, too
    assert result.success
    assert np.diff(times).max() <= every * t_end * (1.0 + 1e-9)
    assert np.diff(result.t).max() <= 0.01 * t_end * (1.0 + 1e-9)  # within which other forces are evaluated
