"""The validation study: what counts as right, what is counted, and that it stops where a solver stops."""

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest

from studies.bench import end_states
from studies.bench.collector import Run
from studies.bench.end_states import SAID
from studies.bench.solvers import CATALOGUE, GIVEN
from studies.validation import study as validation
from tests.studies.of_study import said
from twoloop import mechanisms


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


def test_what_the_reference_does_not_know_is_not_counted():
    known = mechanisms.double_pendulum().reference
    row = run_of(with_reference(lam=None, v=np.full(4, np.nan)))
    assert row["digits_lam"] is None and row["digits_v"] is None and row["digits_q"] > 8.0 and known.lam is not None
    assert run_of(with_reference(digits=dict.fromkeys(("q", "v", "lam"), 4.0)))["digits_q"] == 4.0


def test_the_condition_of_the_authors_is_judged_over_its_own_time():
    problem = mechanisms.n_four_bar(1)
    sound = replace(problem, condition=replace(problem.condition, t_end=0.5, n_outputs=20))
    row = run_of(sound, group=end_states.JUDGED)
    assert row["t_end"] == 0.5 and row["condition"] < 1e-5 and row["outcome"] == "right"
    strict = replace(sound, condition=replace(sound.condition, high=0.0))
    assert run_of(strict, group=end_states.JUDGED)["outcome"] == "wrong"


def test_what_an_adapter_does_not_take_is_not_counted_against_its_solver():
    problem, refused = mechanisms.double_pendulum(), {"status": "RAISED", "family": "SciPy", "error_q": None}
    assert end_states.outcome(refused, problem, 1e-8) == "not run"
    assert end_states.outcome(refused | {"family": "two-loop"}, problem, 1e-8) == SAID


THEIRS = "LSODA, index 1"


def made_up(where=(), **what):
    """Rows of two problems and three solvers at all tolerances, errors as large as the tolerance."""
    lines = []
    for case in ("A02, N = 1", "double pendulum"):
        for solver, family in ((GIVEN, "two-loop"), ("BDF", "two-loop"), (THEIRS, "SciPy")):
            for tol in validation.TOLERANCES:
                line = {"group": "", "case": case, "solver": solver, "family": family, "tol": tol, "t_end": 3.0}
                line |= {"status": "REACHED_END", "floor": 1e-15, "outcome": "right", "error_q": tol}
                line |= {f"digits_{level}": -np.log10(tol) for level in ("q", "v", "lam")}
                lines.append(line | (what if (case, solver) in where else {}))
    return pd.DataFrame(lines)


def test_who_is_right_where():
    found, text = said(validation, made_up())
    assert found["default"] == 2 and found["best_other"] == {"solver": THEIRS, "n": 2} and found["none"] == []
    assert found["answer"].startswith("At a tolerance of 1e-10, the default is right on 2 of 2 mechanisms, the best")
    assert f"**Answer**: {found['answer']}" in text and found["only"] == {"own": [], "others": []}
    stopped = {"status": "STEP_TOO_SMALL", "outcome": SAID, "error_q": np.nan, "digits_q": np.nan}
    own = [("A02, N = 1", GIVEN), ("A02, N = 1", "BDF")]
    found, text = said(validation, made_up(own, **stopped))
    assert found["only"]["others"] == found["short"] == ["A02, N = 1"] and found["default"] == 1
    assert found["counts"]["own"] == {"right": 8, "inexact": 0, "wrong": 0, SAID: 8, "ended": 8}
    assert "|the default|8|4|0|0|4|" in text and "|SciPy|8|8|0|0|0|" in text
    found = said(validation, made_up([*own, ("A02, N = 1", THEIRS)], **stopped))[0]
    assert found["none"] == ["A02, N = 1"] and found["answer"].endswith("on 1; on 1 no solver is.")


def test_wrong_runs_are_counted_by_tolerance_and_place():
    wrong = {"outcome": "wrong", "error_q": 1e-2, "digits_q": 2.0}
    found = said(validation, made_up([("double pendulum", THEIRS)], **wrong))[0]
    assert found["counts"]["others"]["wrong"] == 4 and found["only"]["own"] == ["double pendulum"]
    assert found["wrong_others"] == {"singular": 0, "given": 0, "tight": 2}
    found = said(validation, made_up([("A02, N = 1", THEIRS)], **wrong))[0]
    assert found["wrong_others"] == {"singular": 4, "given": 4, "tight": 0}
    limit = {"status": "TIME_LIMIT", "outcome": SAID, "error_q": np.nan, "digits_q": np.nan}
    assert said(validation, made_up([("A02, N = 1", THEIRS)], **limit))[0]["counts"]["others"][SAID] == 0


def test_cells_that_are_no_failures_are_hatched():
    rows = made_up()
    for k, (status, outcome) in enumerate((("TIME_LIMIT", SAID), ("RAISED", "not run"), ("RAISED", SAID))):
        place = rows.index[(rows["tol"] == validation.TIGHT)][k]
        rows.loc[place, ["status", "outcome", "digits_q"]] = status, outcome, np.nan
    (figure,) = validation.figures_of(rows, {"default": 0, "n": 2}).values()
    shown = figure.axes[0]
    assert [text.get_text() for text in shown.texts][:3] == ["L", "–", "refused"]
    assert sum(bool(patch.get_hatch()) for patch in shown.patches) == 2
    plt.close(figure)


def test_exudyns_own_models_converge():
    exudyn = {"group": validation.MODELLED, "case": "heavy top", "solver": "Exudyn, HHT", "t_end": 1.0, "status": "x"}
    models = pd.DataFrame([exudyn | {"h": 1.0 / n, "error_q": 100.0 / n**2} for n in (100, 400)])
    found, text = said(validation, pd.concat([made_up(), models]))
    assert found["models"]["n_steps"] == 400 and found["models"]["errors"] == pytest.approx([6.25e-4] * 2)
    assert found["models"]["orders"] == pytest.approx([2.0, 2.0]) and "at orders of 2.0 (theirs" in text
    assert said(validation, made_up())[0]["models"] is None


def test_a_run_that_did_not_move_has_no_drift():
    problem = mechanisms.double_pendulum()
    result = CATALOGUE["Adams"].run(end_states.case_of(problem), 1e-6, 0)
    assert end_states.drift(problem, result) > 0.0
    at_rest = replace(result, t=result.t[:1], q=result.q[:, :1], v=result.v[:, :1])
    assert end_states.drift(problem, at_rest) is None
