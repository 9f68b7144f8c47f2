"""The validation study: what counts as right, what its sentences say, and that it stops where a solver stops."""

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest

from studies.bench import end_states
from studies.bench.collector import Run
from studies.bench.solvers import CATALOGUE
from studies.validation import deceived
from studies.validation import study as validation
from tests.studies.of_study import said
from twoloop import mechanisms, solve_dae


def run_of(problem, solver="Gauss12", tolerance=1e-8, group=""):
    case = end_states.case_of(problem, judged=bool(group))
    return end_states.row_of(Run(case, CATALOGUE[solver], tolerance, group, repeats=1))


def with_reference(**changed):
    problem = mechanisms.double_pendulum()
    return replace(problem, reference=replace(problem.reference, **changed))


def test_a_good_run():
    row = run_of(mechanisms.double_pendulum())
    assert row["outcome"] == "right" and min(row["digits_q"], row["digits_v"], row["digits_lam"]) > 8.0
    assert row["energy"] < 1e-8 and max(row[f"violation_{level}"] for level in "qva") < 1e-9


def test_a_reference_that_is_off_makes_a_good_run_inexact_or_wrong():
    known = mechanisms.double_pendulum().reference
    row = run_of(with_reference(q=known.q + 1e-5))
    assert row["outcome"] == "inexact" and row["digits_q"] == pytest.approx(5.0, abs=0.3)
    assert run_of(with_reference(q=known.q + 1e-2))["outcome"] == "wrong"


def test_a_velocity_or_multiplier_that_is_not_known_is_not_counted():
    known = mechanisms.double_pendulum().reference
    row = run_of(with_reference(lam=None, v=np.full(4, np.nan)))
    assert row["digits_lam"] is None and row["digits_v"] is None and row["digits_q"] > 8.0 and known.lam is not None


def test_no_more_digits_than_the_reference_holds():
    assert run_of(with_reference(digits=dict.fromkeys(("q", "v", "lam"), 4.0)))["digits_q"] == 4.0


def test_the_condition_of_the_authors_is_judged_over_its_own_time():
    problem = mechanisms.n_four_bar(1)
    sound = replace(problem, condition=replace(problem.condition, t_end=0.5, n_outputs=20))
    row = run_of(sound, group=end_states.JUDGED)
    assert row["t_end"] == 0.5 and row["condition"] < 1e-5 and row["outcome"] == "right"
    strict = replace(sound, condition=replace(sound.condition, high=0.0))
    assert run_of(strict, group=end_states.JUDGED)["outcome"] == "wrong"


def test_what_an_adapter_does_not_take_is_not_counted_against_its_solver():
    pytest.importorskip("solve_dae")
    row = run_of(mechanisms.knife_edge(), "Radau, solve_dae")
    assert row["outcome"] == "not run" and "n_a = 1" in row["message"]


def made_up(**changed):
    """Rows of two problems and three solvers at all tolerances, errors as large as the tolerance."""
    lines = []
    for case in ("A02, N = 1", "double pendulum"):
        for solver, family in (("Gauss12", "two-loop"), ("BDF", "two-loop"), ("LSODA, index 1", "SciPy")):
            for tol in validation.TOLERANCES:
                line = {"group": "", "case": case, "solver": solver, "family": family, "tol": tol, "t_end": 3.0}
                line["called_from"] = "Python" if family == "SciPy" else "compiled"
                line |= {"status": "REACHED_END", "floor": 1e-15, "outcome": "right", "condition": np.nan}
                line |= {f"error_{level}": tol for level in ("q", "v", "lam")}
                line |= {f"digits_{level}": -np.log10(tol) for level in ("q", "v", "lam")}
                line |= {"energy": 1e-9, "n_evaluations": 100.0, **{f"violation_{level}": 1e-15 for level in "qva"}}
                if (case, solver) in changed.get("where", ()):
                    line |= changed["what"]
                lines.append(line)
    return pd.DataFrame(lines)


def alone_of(found):
    """Where ours alone are right: what became of the others, as far as anything did."""
    return {
        line["case"]: {what: names for what, names in line.items() if names and what not in ("case", "right", "errors")}
        for line in found["only_ours"]
    }


def test_findings_turn_with_the_rows():
    found = said(validation, made_up())[0]
    assert found["ours_always"] == ["Gauss12", "BDF"] and found["only_others"] == found["ours_short"] == []
    stopped = {"status": "STEP_TOO_SMALL", "outcome": "said so", "error_q": np.nan, "digits_q": np.nan}
    found = said(validation, made_up(where=[("A02, N = 1", "Gauss12"), ("A02, N = 1", "BDF")], what=stopped))[0]
    assert found["ours_always"] == [] and found["only_others"] == ["A02, N = 1"]
    assert [(line["case"], line["stopped"]) for line in found["ours_short"]] == [("A02, N = 1", ["Gauss12"])]
    wrong = {"outcome": "wrong", "error_q": 1e-3, "digits_q": 3.0}
    found, text = said(validation, made_up(where=[("double pendulum", "BDF")], what=wrong))
    assert "| all | 16 | 8 |\n| inexact | 0 | 0 |\n| wrong | 4 | 0 |\n" in text and "\nOf the" not in text
    (tight,) = found["ours_wrong_tight"]
    assert (tight["solver"], tight["case"], tight["error_q"]) == ("BDF", "double pendulum", 1e-3)
    assert found["n_wrong"] == {"ours": 4, "others": 0}
    refused = {"outcome": "not run", "status": "RAISED", "error_q": np.nan, "digits_q": np.nan}
    found = said(validation, made_up(where=[("double pendulum", "LSODA, index 1")], what=refused))[0]
    assert alone_of(found) == {"double pendulum": {"not run": ["LSODA, index 1"]}}
    found, text = said(validation, made_up(where=[("double pendulum", "LSODA, index 1")], what=wrong))
    assert "| wrong | 0 | 4 |\n\nOf the 4, 2 are at 1e-8 or tighter and 2 at looser tolerances, which bound" in text
    assert alone_of(found) == {"double pendulum": {"wrong": ["LSODA, index 1"]}}
    assert found["n_ended"] == {"ours": 16, "others": 8}
    stopped = stopped | {"status": "TIME_LIMIT"}
    found = said(validation, made_up(where=[("double pendulum", "LSODA, index 1")], what=stopped))[0]
    assert alone_of(found) == {"double pendulum": {"limit": ["LSODA, index 1"]}}  # our limit is no miss of theirs
    assert found["n_ended"] == {"ours": 16, "others": 4}
    found, text = said(validation, made_up(where=[("double pendulum", "Gauss12")], what=stopped))
    assert [(line["stopped"], line["limit"]) for line in found["ours_short"]] == [([], ["Gauss12"])]
    assert '- double pendulum: we stopped `method="Gauss12"` after' in text


def test_a_solver_that_was_run_and_was_inexact_is_not_called_one_that_was_not_run():
    inexact = {"outcome": "inexact", "error_q": 2e-5, "digits_q": 4.7}
    _, text = said(validation, made_up(where=[("double pendulum", "LSODA, index 1")], what=inexact))
    ours = '- On double pendulum only ours are right: `method="Gauss12"` and `method="BDF"`. The others are inexact: '
    assert ours + "`SciPy, LSODA, index 1` (2e-5).\n" in text and "not run" not in text


def test_cells_that_are_no_failures_are_hatched():
    rows = made_up()
    for k, (status, outcome) in enumerate((("TIME_LIMIT", "said so"), ("RAISED", "not run"), ("RAISED", "said so"))):
        place = rows.index[(rows["tol"] == validation.TIGHT)][k]
        rows.loc[place, ["status", "outcome", "digits_q"]] = status, outcome, np.nan
    (figure,) = validation.figures_of(rows, {}).values()
    shown = figure.axes[0]
    assert [text.get_text() for text in shown.texts][:3] == ["L", "–", "refused"]
    assert sum(bool(patch.get_hatch()) for patch in shown.patches) == 2
    plt.close(figure)


def deceived_row(problem, solver, tolerance):
    return deceived.row_of(Run(end_states.case_of(problem), CATALOGUE[solver], tolerance, deceived.DECEIVED, repeats=1))


def test_steps_that_keep_their_tolerance_and_steps_that_do_not():
    problem = mechanisms.double_pendulum()
    result = solve_dae(problem.system, (0.0, 10.0), problem.q0, problem.v0, "DOP853", 1e-6, 1e-6)
    assert (deceived.local_errors(problem, result, 1e-6) < 1.0).all()
    assert (deceived.local_errors(problem, result, 1e-12)[1:] > 1.0).sum() > 3
    wrong = replace(result, v=result.v + 1e-4 * (np.arange(result.t.size) == 5))
    errors = deceived.local_errors(problem, wrong, 1e-6, sampled=result.t.size)
    assert np.flatnonzero(errors > 1.0).tolist() == [4, 5]


def test_a_run_without_an_exact_motion_has_no_deceived_steps(monkeypatch):
    assert deceived_row(mechanisms.knife_edge(), "DOP853 (twoloop)", 1e-6)["n_sampled"] > 0

    def refuse(*arguments, **options):
        raise ValueError("none here")

    monkeypatch.setattr(deceived, "solve_index1", refuse)
    row = deceived_row(mechanisms.knife_edge(), "DOP853 (twoloop)", 1e-6)
    assert row["n_sampled"] == 0 and row["message"] == "no exact motion on index 1: none here"


def test_the_share_of_deceived_steps():
    problem, solver = mechanisms.double_pendulum(), "DOP853 (twoloop)"
    rows = pd.DataFrame([deceived_row(problem, solver, tolerance) for tolerance in (1e-6, 1e-8)])
    sound = validation.of_steps(solver, rows)
    assert (sound["n"], sound["deceived"]) == (50, 0.0)
    rows["n_deceived"] = [10, 0]
    assert validation.of_steps(solver, rows)["deceived"] == 0.2


def test_findings_of_steps_and_of_models_follow_their_rows():
    first = {"group": deceived.DECEIVED, "case": "double pendulum", "solver": "BDF", "tol": 1e-8, "n_sampled": 25}
    first |= {"n_deceived": 0, "worst_step": 0.3, "first_step": 8.0}
    exudyn = {"group": validation.MODELLED, "case": "heavy top", "solver": "Exudyn, HHT", "t_end": 1.0, "status": "x"}
    runs = [exudyn | {"h": 1.0 / n, "error_q": 100.0 / n**2} for n in (100, 400)]
    found, text = said(validation, pd.concat([made_up(), pd.DataFrame([first, *runs])]))
    assert found["models"]["n_steps"] == 400 and found["models"]["errors"] == pytest.approx([6.25e-4] * 2)
    cells = [
        line.strip("| ").split(" | ") for line in text.split("| deceived (%) |\n")[1].split("\n\n")[0].splitlines()[1:]
    ]
    assert {line[0]: line[-1] for line in cells} == {"Gauss12": "–", "BDF": "0", "SciPy, LSODA, index 1": "–"}
    assert found["models"]["orders"] == pytest.approx([2.0, 2.0]) and "converging at orders of 2.0 (theirs" in text
    found = said(validation, pd.concat([made_up(), pd.DataFrame([first | {"first_step": 0.5}])]))[0]
    assert found["models"] is None


def test_a_run_that_did_not_move_has_no_drift():
    problem = mechanisms.double_pendulum()
    result = CATALOGUE["Adams"].run(end_states.case_of(problem), 1e-6, 0)
    assert end_states.drift(problem, result) > 0.0
    at_rest = replace(result, t=result.t[:1], q=result.q[:, :1], v=result.v[:, :1])
    assert end_states.drift(problem, at_rest) is None
