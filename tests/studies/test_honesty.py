"""The honesty study: the rule of the outcomes, a process that hangs, and ours on a few traps."""

import time
from dataclasses import replace
from functools import partial

import pandas as pd
import pytest

from studies import honesty
from studies.render import render
from studies.traps import FORCE, INPUT, MISTAKE, forces, of_linkages, traps, under_forces
from twoloop import solve_dae
from twoloop.methods import PRESETS

TRAPS = {trap.name: trap for trap in traps(quick=True)}
SOUND = TRAPS["redundant row"]


DOP853 = partial(honesty.own, "DOP853")


def row_of(trap, call=DOP853):
    return honesty.run("x", call, trap, honesty.right_answer(trap))


def test_a_right_answer():
    row = row_of(SOUND)
    assert row["outcome"] == honesty.RIGHT
    assert row["error"] < 1e-6


def test_a_wrong_answer_with_success_is_silent():
    def wrong(trap):
        result = solve_dae(trap.sane, (0.0, trap.t_end), trap.q0, trap.v0)
        return replace(result, q=result.q + 0.1)

    assert row_of(SOUND, wrong)["outcome"] == honesty.SILENT


def test_a_warning_is_saying_so():
    made = {"status": "REACHED_END", "error": 1.0, "warned": "beware", "asked": True, "message": ""}
    assert honesty.outcome(made, SOUND, True) == honesty.SAID
    assert honesty.outcome(made | {"warned": ""}, SOUND, True) == honesty.SILENT
    assert honesty.outcome(made | {"error": 1e-9, "warned": ""}, SOUND, True) == honesty.RIGHT
    assert honesty.outcome(made | {"error": None, "warned": ""}, SOUND, False) == honesty.SILENT


def test_a_call_that_does_not_come_back_hangs(monkeypatch):
    monkeypatch.setattr(honesty, "GRACE", 0.1)
    short = replace(SOUND, time_limit=0.2)
    assert honesty.run("x", lambda trap: time.sleep(60.0), short, None)["outcome"] == honesty.HANG


def test_what_was_never_evaluated_is_told_from_what_was_missed():
    pulse = TRAPS["pulse of 1 ms"]
    assert row_of(pulse)["outcome"] == honesty.UNASKED
    assert row_of(TRAPS["pulse of 1 ms, max_step half of it"])["outcome"] == honesty.RIGHT

    def coarse(trap):  # ends before the pulse has: it has seen it
        return solve_dae(trap.system, (0.0, 1.0005), trap.q0, trap.v0, method="DOP853", max_step=1e-3)

    assert row_of(pulse, coarse)["outcome"] == honesty.SILENT


def test_steps_without_error_control_may_say_so():
    made = {"status": "REACHED_END", "error": 1.0, "warned": "", "asked": True, "message": ""}
    assert honesty.outcome(made, SOUND, True) == honesty.SILENT
    assert honesty.outcome(made | {"message": f"Done; {honesty.UNCONTROLLED}."}, SOUND, True) == honesty.SAID


def test_traps_in_the_motion_have_a_known_end():
    traps_of = {trap.name: trap for trap in of_linkages()}
    for name in ("dead point", "assemblies nearly meet"):
        row = row_of(traps_of[name])
        assert row["outcome"] == honesty.RIGHT, row


def test_a_solver_of_compiled_functions_is_not_asked_for_python():
    trap = TRAPS["exception in a Python callback after 1 s"]
    assert honesty.why_not(honesty.IDA_C, trap)
    assert not honesty.why_not("BDF (two-loop)", trap)
    assert honesty.why_not("LSODA, index 1", TRAPS["first step of 1 s"])


@pytest.mark.parametrize(
    "name",
    [
        "inconsistent positions",
        "NaN in the force after 1 s",
        "one wrong entry of C_q",
        "exception in a Python callback after 1 s",
        "wrong shape from a Python callback after 1 s",
    ],
)
@pytest.mark.parametrize("method", ["SunRadau5", "DOP853", "BDF"])
def test_ours_say_so(name, method):
    assert row_of(TRAPS[name], partial(honesty.own, method))["outcome"] == honesty.SAID


def test_sentences_turn_with_the_rows():
    lines = [
        {
            "group": MISTAKE,
            "trap": trap,
            "mechanism": "chain of 2",
            "solver": solver,
            "outcome": honesty.RIGHT,
            "error": 1e-9,
        }
        for trap in ("a", "b")
        for solver in ("BDF (two-loop)", "LSODA, index 1")
    ]
    rows = pd.DataFrame(lines)

    def text(rows):
        tables = dict.fromkeys(("cells", "input", "forces", "solvers"), "")
        return render("honesty", honesty.findings_of(rows), tables, stamp="stamp", quick=False)

    assert "None of ours is wrong and silent" in text(rows) and "All that are run are right: a; b." in text(rows)
    assert "run but one are right" not in text(rows)
    rows.loc[3, "outcome"] = honesty.SAID
    told = text(rows)
    assert "All that are run but one are right, and it says so: b (LSODA, index 1)." in told and "are right: a." in told
    rows.loc[rows["trap"] == "b", "outcome"] = honesty.SILENT
    told = text(rows)
    assert "or hang: 1. BDF (two-loop) on *b*, chain of 2: wrong and silent, error 1e-9 m." in told
    assert "run but one are right" not in told
    assert "All that are run are right: a." in told and "All that are run say so" not in told
    assert "No solver notices: b" in told


OURS, COMPILED, OTHER, THEIRS = honesty.DEFAULT, honesty.DEFAULT_COMPILED, "BDF (two-loop)", "LSODA, index 1"


def rows_of_forces(wrong=()):
    """Two runs of each solver, one on a mistake and one under a force; those of `wrong` are wrong and silent."""
    return pd.DataFrame(
        [
            {
                "group": group,
                "trap": "gust" if group == FORCE else "a",
                "mechanism": "pendulum",
                "solver": solver,
                "outcome": honesty.SILENT if (solver, group) in wrong else honesty.RIGHT,
                "error": 1e-9,
            }
            for solver in (OURS, COMPILED, OTHER, THEIRS)
            for group in (MISTAKE, FORCE)
        ]
    )


def told_of_forces(rows):
    found = honesty.findings_of(rows)
    tables = dict.fromkeys(("cells", "input", "forces", "solvers"), "")
    return found, render("honesty", found, tables, stamp="stamp", quick=False)


def test_runs_that_never_evaluate_a_force_are_wrong_ones_and_refusals_are_no_runs():
    rows = rows_of_forces().assign(message="Reached the end, t = 3.")
    rows.loc[rows["solver"] == OURS, "outcome"] = honesty.UNASKED
    refused = (rows["solver"] == COMPILED) & (rows["group"] == FORCE)
    rows.loc[refused, ["outcome", "message"]] = [
        honesty.SAID,
        "ValueError: compiled=True needs equations that can be written down; force of 'crane': it branches",
    ]
    trust = told_of_forces(rows)[0]["trust"]
    assert trust["default"] == {"n": 2, "wrong": 2, "unasked": 2}
    assert trust["compiled"] == {"n": 1, "wrong": 0, "unasked": 0}


def test_trust_is_counted_over_mistakes_and_forces():
    found, text = told_of_forces(rows_of_forces())
    assert found["trust"]["default"] == {"n": 2, "wrong": 0, "unasked": 0}
    assert "None of ours is wrong and silent." in text
    found, text = told_of_forces(rows_of_forces([(COMPILED, FORCE), (OTHER, FORCE), (THEIRS, MISTAKE)]))
    assert {name: each["wrong"] for name, each in found["trust"].items()} == {
        "default": 0,
        "compiled": 1,
        "ours": 1,
        "others": 1,
    }
    assert "the default 0 of 2 runs, compiled 1 of 2, our other methods 1 of 2, other projects' solvers 1 of 2." in text
    assert "gust (BDF, auto, compiled)." in text
    line = found["forces"]["families"][0]
    assert line["ours"][honesty.SILENT] == 2 and line["others"][honesty.RIGHT] == 1


def test_checks_of_the_input_are_counted_apart():
    line = rows_of_forces().assign(group=INPUT, trap="inconsistent positions", outcome=honesty.SILENT)
    found, text = told_of_forces(pd.concat([rows_of_forces(), line], ignore_index=True))
    assert {name: each["wrong"] for name, each in found["trust"].items()} == dict.fromkeys(found["trust"], 0)
    assert found["n_traps"] == 1 and found["input"]["n_traps"] == 1
    assert "6 of 6 runs of ours" in text and "2 of 2 of others" in text


def test_a_force_has_a_known_end_and_all_presets_are_asked():
    trap = next(trap for trap in under_forces(quick=False) if trap.name == "tanh friction, width 0.1")
    assert trap.mechanism == "pendulum"
    assert row_of(trap)["outcome"] == honesty.RIGHT
    assert row_of(replace(trap, system=TRAPS["drag"].system))["outcome"] == honesty.SILENT
    asked = {name.removesuffix(" (two-loop)").split(",")[0] for name in honesty.solvers(False, FORCE)}
    assert set(PRESETS) - asked == {"PaperIRK", "PaperNewmark"}


def test_forces_are_on_three_mechanisms():
    made = [(family, bodies.__name__) for family, bodies in forces(quick=False)]
    assert len({name for name, _ in made}) >= 15
    for bodies in ("pendulum", "bars", "slider_in_space"):
        assert ("gust of 3 ms", bodies) in made
