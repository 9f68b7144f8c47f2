"""Every mechanism against the rivals: ratios and verdicts follow from the rows."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from studies.bench import headline, tables
from studies.bench.render import render
from studies.bench.solvers import CATALOGUE, OWN, OTHER_SOLVERS
from studies.bench.store import KeptRows
from studies.work_precision import rivals
from studies.work_precision import study as work_precision
from tests.studies.of_study import median
from twoloop.rows.equal_error import LOOSEST


def rows(*lines, case="four-bar"):
    """Medians of (solver, family, called from, error, seconds), of five equal repetitions, at the loosest setting."""
    told = {"group": rivals.GROUP, "case": case, "tol": LOOSEST}
    return pd.DataFrame(
        [
            median(solver, error, cpu, family=family, called_from=called_from, times=(cpu,) * 5, **told)
            for solver, family, called_from, error, cpu in lines
        ]
    )


def compared(own, heyoka, python=9.0, error=1e-14):
    kinds = ("heyoka", "heyoka", "compiled", error, heyoka), ("LSODA, index 1", "SciPy", "Python", error, python)
    return rows(("Adams", "two-loop", "compiled", error, own), *kinds)


@pytest.mark.parametrize(("own", "behind"), [(1.0, 0), (3.0, len(rivals.DECADES)), (2.0, 0)])
def test_ahead_and_behind_follow_the_rows(own, behind):
    found = rivals.findings_of(compared(own, 2.0))
    assert found["n"] == len(rivals.DECADES)
    assert found["behind"] == ({"heyoka": behind} if behind else {})
    given, own_code, plain, best = found["standings"]
    assert best["ahead"] == (len(rivals.DECADES) if own == 1.0 else 0) and best["behind"] == behind
    assert given["missed"] == own_code["missed"] == plain["missed"] == best["n"] == len(rivals.DECADES)  # none was run


def test_drift_is_that_of_the_fastest_rivals_at_the_errors_where_the_default_is_slower():
    table = rows(
        (rivals.given_on("four-bar"), "two-loop", "compiled", 1e-14, 3.0),
        ("CyRK, DOP853", "CyRK", "compiled", 1e-8, 1.0),
        ("CyRK, DOP853", "CyRK", "compiled", 1e-14, 2.0),
    )
    leaving = table.assign(keeps_constraints=[True, False, False], violation_q=[9.0, 2e-8, 3e-14])
    over = sorted((2e-8 if error >= 1e-8 else 3e-14) / error for error in rivals.DECADES)
    assert rivals.findings_of(leaving)["drift"] == pytest.approx({"median": float(np.median(over)), "most": over[-1]})
    assert rivals.findings_of(leaving.assign(keeps_constraints=True))["drift"] is None


def test_who_gets_how_far_at_singular_positions_counts_rivals_too():
    lines = [("auto", 1e-5), ("auto, compiled", 1e-4), ("DOP853, projected", 1e-8), ("heyoka", 1.0)]
    ours = {"auto", "auto, compiled"}
    table = rows(
        *((name, "two-loop" if name in ours else "others", "compiled", error, 1.0) for name, error in lines),
        case="A02, N = 1",
    )
    given = rivals.given_on("A02, N = 1")
    told, decades = rivals.reached(table), rivals.DECADES
    reach = {name: sum(error <= at for at in decades) for name, error in lines}
    assert told["n"] == reach["DOP853, projected"] and told["default"] == reach[given]
    assert told["by"] == {name: reach[name] for name in ours}
    assert told["rivals"] == {"DOP853, projected": told["n"], "heyoka": 0}
    assert told["missed"] == told["n"] - reach[given] > 0


def test_the_headline_names_the_default_with_code_without_and_the_best_in_this_order():
    """Every sentence is made again from the rows."""
    lines = [("auto", 3.0), ("auto, compiled", 2.0), ("Adams", 0.5), ("heyoka", 1.0)]
    table = rows(*((name, "heyoka" if name == "heyoka" else "two-loop", "compiled", 1e-14, s) for name, s in lines))
    slow = table[table["solver"] == "heyoka"].assign(times=[(1.0, 9.0, 0.5, 8.0, 0.7)])  # scatters about 2
    undecided = pd.concat([table[table["solver"] != "heyoka"], slow.assign(call_s=1.0)]).assign(case="four-bar, second")
    missed = table[table["solver"] == "heyoka"].assign(error_q=0.1, tol=tables.TIGHTEST)
    alone = pd.concat([table[table["solver"] != "heyoka"], missed]).assign(case="knife edge")
    standings = rivals.findings_of(pd.concat([table, undecided, alone]))["standings"]
    text = render("standings", {}, {}, standings=standings)
    n = len(rivals.DECADES)
    head, _, *lines = (line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("|"))
    assert head[0] == f"of {3 * n} pairs of mechanism and error"
    assert [line[0] for line in lines] == [
        "**the default**",
        "`compiled=True`",
        "`compiled=False`",
        "our best in hindsight",
    ]
    # ahead, behind, undecided, alone, alone of those asked, missed
    assert lines[0][1:] == lines[1][1:] == lines[2][1:] == [str(count) for count in (0, n, n, n, 0, 0)]
    assert standings[0]["unbeaten"] == 2
    assert int(lines[3][1]) >= n


def test_where_one_side_does_not_come_there_is_no_ratio():
    table = pd.concat([compared(1.0, 2.0, error=1e-4), compared(1.0, 2.0, error=1e-14)[1:]], ignore_index=True)
    at = {round(-np.log10(at["error"])): at for at in rivals.findings_of(table)["mechanisms"][0]["at"]}
    assert at[3]["ratio"] == 2.0 and at[4]["ratio"] == 2.0
    assert at[5]["ratio"] is None and at[5]["ours"] is None and at[5]["others"]["solver"] == "heyoka"
    assert [rivals.cell(at[3]["standing"][who]) for who in ("auto", "best of ours")] == ["others", "2.0"]
    assert rivals.cell(at[6]["standing"]["best of ours"]) == "others"


def test_what_ours_alone_reaches_is_named_apart():
    alone = rows(("Adams", "two-loop", "compiled", 1e-14, 1.0), case="knife edge")
    found = rivals.findings_of(pd.concat([compared(1.0, 2.0), alone], ignore_index=True))
    assert found["alone"] == ["knife edge"]


def test_figures_are_drawn_of_rows():
    table = pd.concat([compared(1.0, 2.0), compared(0.5, 1.0, error=1e-3)], ignore_index=True)
    (axes,) = rivals.picture(table).axes
    assert len(axes.lines) == 3 and len(rivals.heat_map(rivals.findings_of(table)).axes) == 3


def test_every_solver_has_its_settings_and_every_mechanism_is_there():
    todo = rivals.runs(False)
    assert {run.solver.name for run in todo} == {*OWN, *OTHER_SOLVERS} <= set(CATALOGUE)
    assert len({run.key(0) for run in todo}) == len(todo) and len({run.case.name for run in todo}) >= 23
    heyoka = [run.value for run in todo if run.solver.name == "heyoka" and run.case.name == "four-bar"]
    assert heyoka == list(rivals.BUILT) and all(run.repeats == 5 for run in todo)


def test_the_reference_of_the_second_geometry_is_held_by_a_second_way():
    assert rivals.problems(False)["four-bar, second"].reference.digits["q"] > 11.5


class Kept(dict):
    add, made = dict.__setitem__, KeptRows.made


def test_repetitions_are_interleaved_and_what_is_refused_is_asked_once():
    todo = [run for run in rivals.runs(True) if run.solver.name in ("DOP853 (twoloop)", "CVODE from C, Adams")]
    pytest.importorskip("sksundae")
    pytest.importorskip("solve_dae")  # whose adapter has no rows A v + b = 0
    like = (run for run in todo if run.case.name == "knife edge" and run.solver.name == "CVODE from C, Adams")
    todo += [replace(run, solver=CATALOGUE["Radau, solve_dae"]) for run in like]
    kept = Kept()
    table = rivals.collect(todo, kept)
    refused = table[table["solver"] == "Radau, solve_dae"]
    assert len(refused) == 1 and refused["status"].iloc[0] == "RAISED"
    good = table[table["case"] == "four-bar"]
    assert (good["error_q"].astype(float) < 0.1).all() and (good["call_s"] > 0.0).all()
    n_rows = len(kept)
    rivals.collect(todo, kept)  # goes on from what is kept
    assert len(kept) == n_rows


@pytest.mark.parametrize(
    ("ours", "theirs", "near_us", "near_them", "verdict"),
    [
        (1.0, 2.0, None, None, "ahead"),
        (1.0, 2.0, None, (1.2, 1.9), "ahead"),  # nearly there, and slower as well
        (1.0, 2.0, None, (1.2, 0.9), "undecided"),
        (1.0, 2.0, None, (1.2, 1.0), "undecided"),  # as fast
        (1.0, 2.0, None, (1.3, 0.1), "ahead"),  # too far from the error
        (1.0, 2.0, (1.2, 0.1), (1.2, 0.9), "undecided"),  # the winner's own near misses do not count
        (2.0, 1.0, None, None, "behind"),
        (2.0, 1.0, (1.2, 1.9), None, "behind"),
        (2.0, 1.0, (1.2, 0.9), None, "undecided"),
        (2.0, 1.0, (1.3, 0.1), None, "behind"),
        (None, 1.0, (1.2, 0.1), None, "missed"),
    ],
)
def test_a_win_and_a_loss_hold_against_near_misses_too(ours, theirs, near_us, near_them, verdict):
    error, lines = 1e-6, []
    for solver, family, good, near in (("auto", "two-loop", ours, near_us), ("heyoka", "heyoka", theirs, near_them)):
        runs = [(0.01, good)] if good else []  # more than a decade better: nothing is interpolated
        runs += [(near[0], near[1])] if near else []
        lines += [(solver, family, "compiled", times * error, seconds) for times, seconds in runs]
    found = headline.of_errors(rows(*lines), [error])[0]
    assert found["auto"]["verdict"] == found[headline.BEST]["verdict"] == verdict


def test_violations_are_those_of_ours_on_the_four_bars():
    table = pd.concat([compared(1.0, 2.0), rows(("Adams", "two-loop", "compiled", 1e-3, 1.0), case="beam")])
    table["violation_q"] = [3e-15, 1.0, 1.0, 1.0]
    assert work_precision.violation(table) == 3e-15


def stated(own, **changed):
    """The text of the report, of rows of the four-bar."""
    table = compared(own, 2.0, python=9.0)
    found = {"cases": [], "first_calls": [], "minimal": [], "default": "auto", "violation": 1e-15}
    found |= {"rivals": rivals.findings_of(table), "measured": {"commits": 1, "processors": ["this"]}}
    found["asked"] = {"n": 4, "refused": 1, "fewer": 0, "far": 20.0, "close": 5.0, "running": 2, "limit": 1.0}
    return render("work_precision", found | changed, {}, stamp="", quick=False)


def test_sentences_follow_the_rows():
    text = stated(0.5)
    assert "in hindsight | 11 | 0 | 0 |" in text and "our best is behind" not in text
    assert "our adapters refuse 1 of the 4 pairs of rival and mechanism." in text
    assert "lies beyond 5 %, also with runs of the slower side whose errors are up to 25 % too large." in text
    text = stated(4.0)
    assert "Where our best is behind, the fastest rival is `heyoka` in 11 of 11 pairs." in text
