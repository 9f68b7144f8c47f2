"""Every mechanism with every solver: ratios, verdicts and counts follow from rows made by hand."""

import json
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from references import driver
from references.driver import user_call
from studies.bench import headline
from studies.bench.cli import REPORTS, StudyError
from studies.bench.collector import Run
from studies.bench.end_states import case_of
from studies.bench.render import number, render
from studies.bench.solvers import CATALOGUE, MINIMAL, MINIMAL_FAMILY, OTHER_SOLVERS, OWN
from studies.bench.store import KeptRows, read_rows
from studies.work_precision import first_calls, mechanisms, processors, study
from tests.studies.of_study import median
from twoloop.mechanisms import andrews
from twoloop.rows.leaderboard import LOOSEST

FOUR_BAR, N = mechanisms.HEADLINE, len(mechanisms.RESOLVED)
ANGLES, *_, CVODE = MINIMAL
OURS = {"auto", "auto, compiled", "Taylor", "Adams"}


def rows(*lines, case=FOUR_BAR):
    """Medians of (solver, error, seconds), of five equal repetitions, at the loosest setting: exact at every error."""
    told = {"group": mechanisms.GROUP, "case": case, "tol": LOOSEST, "t_end": 10.0, "processor": "AMD EPYC"}
    made = []
    for solver, error, seconds in lines:
        family = "two-loop" if solver in OURS else CATALOGUE[solver].family
        told |= {"family": family, "keeps_constraints": CATALOGUE[solver].keeps_constraints}
        made.append(median(solver, error, seconds, times=(seconds,) * 5, **told))
    return pd.DataFrame(made)


def found_of(table):
    return mechanisms.findings_of(mechanisms.standings_of(table), table)


@pytest.mark.parametrize(("own", "faster", "slower"), [(1.0, N, 0), (3.0, 0, N), (2.0, 0, 0)])
def test_faster_and_slower_follow_the_rows(own, faster, slower):
    found = found_of(rows(("auto, compiled", 1e-14, own), ("heyoka", 1e-14, 2.0), ("LSODA, index 1", 1e-14, 9.0)))
    for line in (found["default"], found["best"]):
        assert (line["n"], line["faster"], line["slower"]) == (N, faster, slower)
    assert found["fastest"] == ({"heyoka": N} if slower else {})
    for line in found["typical"]:
        assert line["median"] == line["least"] == line["most"] == 2.0 / own
        assert (line["faster"], line["slower"], line["of"]) == (bool(faster), bool(slower), 1)
    assert found["cells"][0]["ratio"] == [2.0 / own] * N


def test_the_default_has_code_where_a_mechanism_is_small_and_the_best_is_chosen_afterwards():
    lines = [("auto", 1e-14, 3.0), ("auto, compiled", 1e-14, 2.0), ("Adams", 1e-14, 0.5), ("heyoka", 1e-14, 1.0)]
    found = found_of(pd.concat([rows(*lines), rows(*lines, case="A04 Bricard")], ignore_index=True))
    assert found["with_code"] == [FOUR_BAR]
    assert [line["ratio"][0] for line in found["cells"]] == [1.0 / 2.0, 1.0 / 3.0]
    assert found["default"]["slower"] == found["best"]["faster"] == 2 * N
    assert found["typical"][0]["median"] == pytest.approx((1.0 / 2.0 + 1.0 / 3.0) / 2.0)


def test_what_one_side_alone_reaches_has_no_ratio_and_counts_against_the_default_only():
    ours, others = rows(("auto, compiled", 1e-5, 1.0)), rows(("heyoka", 1e-8, 2.0))
    found = found_of(pd.concat([ours, others], ignore_index=True))
    assert found["cells"][0]["verdict"] == ["ahead"] * 3 + ["missed"] * 3 + ["none"] * 2
    assert (found["default"]["n"], found["default"]["faster"], found["default"]["slower"]) == (6, 3, 3)
    found = found_of(pd.concat([ours.assign(error_q=1e-8), others.assign(error_q=1e-5)], ignore_index=True))
    assert found["cells"][0]["verdict"] == ["ahead"] * 3 + ["alone"] * 3 + ["none"] * 2
    assert (found["default"]["n"], found["default"]["faster"], found["default"]["slower"]) == (6, 3, 0)


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
def test_a_verdict_holds_against_near_misses_too(ours, theirs, near_us, near_them, verdict):
    error, lines = 1e-6, []
    for solver, good, near in (("auto", ours, near_us), ("heyoka", theirs, near_them)):
        runs = [(0.01, good)] if good else []  # more than a decade better: nothing is interpolated
        runs += [(near[0], near[1])] if near else []
        lines += [(solver, times * error, seconds) for times, seconds in runs]
    found = headline.of_errors(rows(*lines), [error])[0]
    assert found["auto"]["verdict"] == found[headline.BEST]["verdict"] == verdict


def test_drift_is_that_of_the_fastest_others_at_the_errors_where_the_default_is_slower():
    table = rows(("auto, compiled", 1e-14, 3.0), ("CyRK, DOP853", 1e-8, 1.0), ("CyRK, DOP853", 1e-14, 2.0))
    leaving = table.assign(violation_q=[9.0, 2e-8, 3e-14])
    over = sorted((2e-8 if error >= 1e-8 else 3e-14) / error for error in mechanisms.DECADES)
    assert found_of(leaving)["drift"] == pytest.approx({"median": float(np.median(over)), "most": over[-1]})
    assert found_of(leaving)["keeping"] == [] and "without keeping" in study.answer(found_of(leaving))
    assert found_of(leaving.assign(keeps_constraints=True))["drift"] is None
    keeping = found_of(rows(("auto, compiled", 1e-14, 3.0), ("DOP853, projected", 1e-14, 1.0)))
    assert keeping["keeping"] and "without keeping" not in study.answer(keeping)


def test_who_gets_how_far_at_singular_positions_counts_others_too():
    lines = {"auto": 1e-5, "auto, compiled": 1e-4, "DOP853, projected": 1e-8, "heyoka": 1.0}
    table = rows(*((name, error, 1.0) for name, error in lines.items()), case="A02, N = 1")
    told = found_of(table)["singular"]
    reach = {name: sum(error <= at for at in mechanisms.DECADES) for name, error in lines.items()}
    assert told["errors"] == told["best_other_reached"] == reach["DOP853, projected"]
    assert told["reached"] == reach[mechanisms.given_on("A02, N = 1")] and told["without_code"] == reach["auto"]
    assert told["best_other"] == "DOP853, projected" and told["names"] == ["A02"] and told["slower"] > 0
    assert found_of(table)["default"]["n"] == 0  # of smooth motion


CALLS = {"auto, compiled": 0.52, "auto": 3.1, "heyoka": 1.4, "CVODE from C, Adams": 2.3, "CVODE from C, BDF": 6.4}
CALLS |= {"IDA from C, stabilised": 8.8, "DOP853, index 1": 19.0, "LSODA, index 1": 15.0}


def called(table):
    firsts = pd.DataFrame([{"case": FOUR_BAR, "solver": "heyoka", "first_call_s": 0.77}])
    return {line["name"]: line for line in headline.calls(table, firsts, FOUR_BAR)["lines"]}


def test_a_call_is_that_of_the_cheapest_run_that_is_good_enough():
    table = rows(*((solver, 1e-14, 1e-3 * ms) for solver, ms in CALLS.items()))
    lines = called(table)
    best = {"CVODE from C": 2.3, "IDA from C": 8.8, "SciPy's best": 15.0, "heyoka": 1.4, "auto": 3.1}
    for name, ms in best.items():
        assert [at["call_s"] for at in lines[name]["at"]] == pytest.approx([1e-3 * ms] * 2)
    assert lines["CyRK"]["at"][0]["solver"] is None and lines["heyoka"]["first_s"] == 0.77
    assert [lines[name]["at"][0]["keeps"] for name in ("IDA from C", "heyoka")] == [True, False]
    near = rows(("heyoka", 1.1e-6, 4e-4)).assign(tol=1e-5)
    at = called(pd.concat([table, near], ignore_index=True))
    assert at["heyoka"]["at"][1]["near"] == {"error": 1.1e-6, "call_s": 4e-4} and at["auto"]["at"][1]["near"] is None
    assert headline.calls(table, table[:0], "no such mechanism") is None


def test_every_solver_has_its_settings_and_every_mechanism_is_there():
    todo = mechanisms.runs(False)
    assert {run.solver.name for run in todo} == {*OWN, *OTHER_SOLVERS} <= set(CATALOGUE)
    assert len({run.key(0) for run in todo}) == len(todo) and len({run.case.name for run in todo}) >= 23
    heyoka = [run.value for run in todo if run.solver.name == "heyoka" and run.case.name == FOUR_BAR]
    assert heyoka == list(mechanisms.BUILT) and all(run.repeats == mechanisms.REPEATS for run in todo)
    assert mechanisms.problems(False)["four-bar, second"].reference.digits["q"] > 11.5


class Kept(dict):
    add, made = dict.__setitem__, KeptRows.made


def everywhere():
    return rows(("auto", 1e-3, 4.0), ("auto, compiled", 1e-3, 1.0), ("Taylor", 1e-3, 9.0), ("heyoka", 1e-3, 2.0))


def in_angles(time, error=1e-3):
    made = rows((ANGLES, error, time), (CVODE, error, 2.0 * time))
    return made.assign(group=mechanisms.MINIMAL_GROUP, family=MINIMAL_FAMILY)


@pytest.mark.parametrize(("time", "slower", "faster"), [(0.5, 1, 0), (3.0, 0, 1)])
def test_our_best_is_compared_with_the_cheapest_in_minimal_coordinates(time, slower, faster):
    (found,) = mechanisms.minimal_findings(in_angles(time), everywhere())
    assert (found["kind"], found["n"], found["slower"], found["ours_faster"]) == ("loops", 1, slower, faster)
    assert found["median"] == time and found["mechanisms"] == 1 and found["wrong_by"] == {}


def test_without_rows_of_minimal_coordinates_nothing_is_said():
    assert mechanisms.minimal_findings(pd.DataFrame(), everywhere()) == []
    (unmatched,) = mechanisms.minimal_findings(in_angles(1.0), everywhere().assign(case="other"))
    assert unmatched["median"] is None and unmatched["slower"] == 1  # only the ODE reaches it


def test_a_run_in_angles_that_ends_with_a_wrong_state_is_told():
    wrong = pd.concat([in_angles(1.0), in_angles(0.1, error=0.7)], ignore_index=True).assign(tol=1e-9)
    (found,) = mechanisms.minimal_findings(wrong, everywhere())
    assert found["wrong_by"] == {name: {"wrong": 1, "n": 2} for name in (ANGLES, CVODE)} and found["median"] == 1.0
    assert mechanisms.minimal_findings(wrong.assign(tol=0.1), everywhere())[0]["wrong_by"] == {}


def test_pendulums_and_singular_positions_are_counted_apart():
    others = ("double pendulum", "A02, N = 1")
    both = pd.concat([in_angles(3.0), *(in_angles(0.5).assign(case=name) for name in others)], ignore_index=True)
    made = pd.concat([everywhere(), *(everywhere().assign(case=name) for name in others)], ignore_index=True)
    found = mechanisms.minimal_findings(both, made)
    counts = [(each["kind"], each["slower"], each["ours_faster"]) for each in found]
    assert counts == [("loops", 0, 1), ("pendulums", 1, 0), ("singular positions", 1, 0)]


def test_no_ranking_of_solvers_with_constraints_sees_equations_in_angles():
    assert not {*MINIMAL} & {*OWN, *OTHER_SOLVERS}
    table = pd.concat([everywhere(), in_angles(0.1)], ignore_index=True)
    assert not set(MINIMAL) & set(study.part(table, mechanisms.GROUP)["solver"])
    assert not {name for name, solver in CATALOGUE.items() if solver.family == MINIMAL_FAMILY} ^ {*MINIMAL}
    made = mechanisms.minimal_runs(True)
    assert {run.case.name for run in made} == {FOUR_BAR} and {run.solver.name for run in made} == {*MINIMAL}
    for solver in MINIMAL:
        row = mechanisms.row_at_end(Run(case_of(andrews()), CATALOGUE[solver], 1e-5, repeats=1), 0, set())
        assert row["status"] == "NOT_APPLICABLE" and "Andrews" in row["message"]


def test_only_what_ran_on_one_processor_is_compared():
    own = pd.DataFrame({"case": ["four-bar", "double pendulum"], "call_s": [1.0, 2.0], "processor": ["old", "new"]})
    others = own.assign(processor="new")
    assert study.on_the_same_processor(own, others)["call_s"].tolist() == [2.0]
    named = pd.DataFrame({"processor": ["AMD EPYC", "AMD EPYC (family 25)", "Xeon (family 6)"]})
    assert study.with_one_name(named)["processor"].tolist() == ["AMD EPYC", "AMD EPYC", "Xeon (family 6)"]


def test_sessions_and_their_speeds_are_told():
    lines = [("a", "1", 4.0), ("a", "2", 2.0), ("b", "1", 1.0), ("c", "3", 9.0)]
    made = pd.DataFrame(lines, columns=["case", "commit", "calibration_s"])
    told = study.measured_on(made.assign(group=mechanisms.GROUP, processor="Intel(R) Xeon(R) Processor (family 6)"))
    assert told == {"commits": 3, "sessions": 2, "speeds": 2.0, "processors": ["Intel Xeon"]}


STAMP = "full work_precision; commit 0123456789; A"


def of_processor(processor, ours, theirs):
    """Rows of one mechanism: `auto, compiled` takes `ours` seconds, heyoka `theirs`."""
    table = rows(("auto, compiled", 1e-6, ours), ("heyoka", 1e-6, theirs)).drop(columns="times")
    return table.loc[table.index.repeat(5)].assign(repeat=2 * list(range(5)), processor=processor)


def test_a_verdict_that_turns_between_two_processors_is_told():
    sides = [processors.verdicts(of_processor(name, *times), STAMP) for name, times in (("A", (1, 2)), ("B", (2, 1)))]
    (found,) = processors.findings_of(pd.concat(sides))
    assert found["n"] == found["turned"] == 4 and found["same_code"]
    assert found["processors"] == [{"name": "A", "faster": 4, "slower": 0}, {"name": "B", "faster": 0, "slower": 4}]
    same = [processors.verdicts(of_processor(name, 1.0, 2.0), f"commit {name}") for name in "AB"]
    (found,) = processors.findings_of(pd.concat(same))
    assert found["turned"] == 0 and not found["same_code"]


def test_rows_of_a_processor_replace_those_that_it_made_before(tmp_path):
    path = tmp_path / processors.FILE
    for name in "AB":
        made = processors.verdicts(of_processor(name, 1.0, 2.0), STAMP)
        processors.added(path, made).to_csv(path, index=False)
    again = processors.added(path, processors.verdicts(of_processor("A", 2.0, 1.0), STAMP))
    assert again["processor"].value_counts().to_dict() == {"A": len(again) // 2, "B": len(again) // 2}
    assert set(again[again["processor"] == "A"]["verdict"]) == {"behind"}
    with pytest.raises(StudyError, match="there is no"):
        processors.main([str(tmp_path)])


def test_first_calls_are_told_by_solver():
    made = pd.DataFrame({"solver": ["heyoka", "heyoka", "heyoka", "CyRK"], "first_call_s": [1.0, 4.0, 2.0, np.nan]})
    assert first_calls.findings_of(made) == [{"solver": "heyoka", "n": 3, "median": 2.0, "least": 1.0, "most": 4.0}]


@pytest.mark.slow
def test_the_first_call_builds_where_the_next_finds_all_built():
    row = first_calls.in_process(first_calls.__name__, FOUR_BAR, "auto, compiled")
    assert row["status"] == "REACHED_END" and row["first_call_s"] > row["call_s"]


@pytest.mark.parametrize(("marks", "spent"), [(True, 7.0), (False, 107.0)])
def test_the_first_call_ends_where_that_of_a_user_ends(marks, spent, monkeypatch):
    """A second run for the output, which builds once more, is ours; an adapter that marks nothing is timed whole."""
    ours, clock = CATALOGUE["DOP853 (twoloop)"], [0.0]

    def run(case, value, repeat):
        clock[0] += 5.0  # builds
        with user_call if marks else nullcontext():
            clock[0] += 2.0
        clock[0] += 60.0  # builds for the output
        with user_call if marks else nullcontext():
            clock[0] += 40.0
        return ours.run(case, value, repeat)

    for module in (driver, first_calls):
        monkeypatch.setattr(module, "cpu_time", lambda: clock[0])
    monkeypatch.setattr(first_calls, "_compiled_anew", lambda module: module)  # other tests hold its functions
    monkeypatch.setitem(CATALOGUE, "twice", replace(ours, name="twice", run=run))
    row = first_calls.times_of("heavy top", "twice")
    assert row["status"] == "REACHED_END" and row["first_call_s"] == spent


def test_the_committed_report_is_that_of_the_committed_findings():
    found = json.loads((REPORTS / "work_precision.json").read_text())
    text = (REPORTS / "work_precision.md").read_text()
    stamp = read_rows(REPORTS / "work_precision.csv")[1]
    assert text == render("work_precision", found, {}, stamp=stamp.partition("; ")[2], quick=False)
    for line in found["typical"]:  # and these follow from the cells of the picture
        column = mechanisms.RESOLVED.index(line["error"])
        ratios = [each["ratio"][column] for each in found["cells"] if not each["singular"]]
        assert line["median"] == pytest.approx(np.median([ratio for ratio in ratios if ratio]))
        assert f"|{number(line['median'])}|{number(line['least'])}|{number(line['most'])}|" in text
    verdicts = [verdict for each in found["cells"] if not each["singular"] for verdict in each["verdict"]]
    assert found["default"]["slower"] == verdicts.count("behind") + verdicts.count("missed")


@pytest.mark.slow
def test_the_quick_study_runs_and_is_drawn_again(tmp_path):
    words = ["--quick", "--out", str(tmp_path)]
    study.main(words)
    text = (tmp_path / "work_precision.md").read_text()
    assert "Quick run" in text and (tmp_path / "work_precision_ratios.png").exists()
    assert "work_precision.md" in (tmp_path / "README.md").read_text()
    study.main([*words, "--redraw"])
    assert (tmp_path / "work_precision.md").read_text() == text
