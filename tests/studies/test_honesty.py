"""The honesty study: the rule of the outcomes, a process that hangs, and ours on a few traps."""

import time
from dataclasses import replace
from functools import partial

import numpy as np
import pandas as pd
import pytest

from studies.bench.cli import StudyError
from studies.honesty import again, short_forces
from studies.honesty import solvers as honesty_solvers
from studies.honesty import study as honesty
from studies.honesty.again import told
from studies.honesty.solvers import DEFAULT, IDA_C, KINDS, LIMITED, LOOK, kind_of, own, solvers, why_not
from studies.honesty.traps import (
    FORCE,
    GROWN,
    HELD_OUT,
    INPUT,
    KINK,
    MISTAKE,
    SHORT,
    forces,
    held_out,
    of_linkages,
    traps,
    under_forces,
)
from tests.studies.of_study import said
from twoloop import solve_dae
from twoloop.methods.presets import PRESETS

TRAPS = {trap.name: trap for trap in traps(quick=True)}
SOUND = TRAPS["redundant row"]
DOP853 = partial(own, "DOP853")


def row_of(trap, call=DOP853):
    return honesty.run("x", call, trap, honesty.right_answer(trap))


def test_a_right_answer():
    row = row_of(SOUND)
    assert row["outcome"] == honesty.RIGHT and row["error"] < 1e-6


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


def test_what_was_never_evaluated_is_wrong_and_silent_too():
    pulse = TRAPS["pulse of 1 ms"]
    assert row_of(pulse)["outcome"] == honesty.RIGHT  # as long as the time between two looks, and at one

    def coarse_and_fixed(trap):
        return solve_dae(trap.system, (0.0, trap.t_end), trap.q0, trap.v0, method="DOP853", step_size=0.1)

    row = row_of(pulse, coarse_and_fixed)
    assert row["outcome"] in (honesty.SILENT, honesty.SAID) and not row["asked"]
    assert row_of(TRAPS["pulse of 1 ms, max_step half of it"])["outcome"] == honesty.RIGHT

    def coarse(trap):  # ends before the pulse has: it has seen it
        return solve_dae(trap.system, (0.0, 1.0005), trap.q0, trap.v0, method="DOP853", max_step=1e-3)

    row = row_of(pulse, coarse)
    assert row["outcome"] == honesty.SILENT and row["asked"]


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
    assert why_not(IDA_C, trap) and not why_not("BDF (twoloop)", trap)
    assert why_not("LSODA, index 1", TRAPS["first step of 1 s"])


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
    assert row_of(TRAPS[name], partial(own, method))["outcome"] == honesty.SAID


OURS, COMPILED, OTHER, THEIRS = DEFAULT, "auto, compiled (twoloop)", "BDF (twoloop)", "LSODA, index 1"
BOUND = THEIRS + LIMITED


def row(group, trap, solver, outcome=honesty.RIGHT):
    about = {"group": group, "trap": trap, "mechanism": "pendulum", "solver": solver, "outcome": outcome}
    return about | {"status": "REACHED_END", "asked": True, "error": 1e-9}


def rows_of_forces(wrong=()):
    """Two runs of each solver, one on a mistake and one under a force; those of `wrong` are wrong and silent."""
    return pd.DataFrame(
        [
            row(group, trap, solver, honesty.SILENT if (solver, group) in wrong else honesty.RIGHT)
            for solver in (OURS, COMPILED, OTHER, THEIRS, BOUND)
            for group, trap in ((MISTAKE, "a"), (FORCE, "gust"))
        ]
    )


def test_sentences_turn_with_the_rows():
    rows = pd.DataFrame([row(MISTAKE, trap, solver) for trap in ("a", "b") for solver in (OTHER, THEIRS)])
    _, text = said(honesty, rows)
    assert "None of ours is silently wrong" in text and "On 2 of the 2 traps, every run" in text
    rows.loc[3, "outcome"] = honesty.SAID
    assert "On 2 of the 2 traps, every run is correct or reports failure." in said(honesty, rows)[1]
    rows.loc[rows["trap"] == "b", "outcome"] = honesty.SILENT
    _, text = said(honesty, rows)
    assert "- Of ours 1 run is silently wrong or hangs: b." in text
    assert "On 1 of the 2 traps, every run" in text and "\n| b | 1/0/0 | 1/0/0 |" in text and "\n| a |" not in text
    assert "No solver detects: b" in text


def test_trust_is_counted_over_mistakes_and_forces():
    found, text = said(honesty, rows_of_forces())
    none = dict.fromkeys(("wrong", "unasked", "gross", "slight", "refused"), 0)
    assert found["trust"]["default"] == none | {"n": 2, "solvers": 1}
    found, text = said(honesty, rows_of_forces([(COMPILED, FORCE), (OTHER, FORCE), (THEIRS, MISTAKE)]))
    wrong = dict.fromkeys(KINDS, 0) | {"ours": 1, "set": 1, "scipy": 1, "others": 1}
    assert {name: each["wrong"] for name, each in found["trust"].items()} == wrong
    assert "| our 1 other methods | 0 | 0 | 0 | 2 | 0 | 1 |" in text
    assert "| some of these with `compiled` set | 0 | 0 | 0 | 2 | 0 | 1 |" in text
    assert "| SciPy | 0 | 0 | 0 | 2 | 0 | 1 |" in text and "| heyoka |" not in text
    assert "| other projects' solvers with `max_step` | 0 | 0 | 0 | 2 | 0 | 0 |" in text
    line = found["forces"]["families"][0]
    assert line["ours"][honesty.SILENT] == 2 and line["others"][honesty.RIGHT] == line["limited"][honesty.RIGHT] == 1


def test_an_error_is_large_or_small_and_a_run_without_an_end_is_large():
    rows = rows_of_forces([(OURS, MISTAKE), (OURS, FORCE), (THEIRS, FORCE)])
    rows.loc[rows["solver"] == OURS, "error"] = [2.0 * honesty.EXACT, 0.5 * honesty.EXACT]
    rows.loc[(rows["solver"] == THEIRS) & (rows["group"] == FORCE), ["outcome", "error"]] = honesty.HANG, np.nan
    found, text = said(honesty, rows)
    got = {who: (found["trust"][who]["gross"], found["trust"][who]["slight"]) for who in ("default", "scipy")}
    assert got == {"default": (1, 1), "scipy": (1, 0)}
    assert "| the default | 0 | 0 | 0 | 2 | 1 | 1 |" in text and "| 1e-5 to 1e-3 |" in text


def test_every_solver_is_of_one_kind():
    named = {name: kind_of(name) for name in solvers(False, FORCE)}
    assert set(named.values()) == set(KINDS)
    assert [name for name, kind in named.items() if kind == "heyoka"] == ["heyoka, Taylor"]
    assert {name.split(",")[0] for name, kind in named.items() if kind == "scipy"} == {*honesty_solvers.SCIPY}
    assert all(name.startswith(("IDA", "CVODE")) for name, kind in named.items() if kind == "sundials")


def test_a_force_that_was_never_evaluated_stays_among_the_wrong_ones():
    rows = rows_of_forces([(OURS, MISTAKE), (THEIRS, MISTAKE), (THEIRS, FORCE)])
    rows.loc[rows["group"] == MISTAKE, "asked"] = False
    found, text = said(honesty, rows)
    assert (found["trust"]["default"]["wrong"], found["trust"]["default"]["unasked"]) == (1, 1)
    assert (found["trust"]["others"]["wrong"], found["trust"]["others"]["unasked"]) == (2, 1)
    assert found["traps"][0]["silent"] == [OURS, THEIRS]
    assert "| a | 1/0/2 | 1/0/0 |" in text
    assert "- Of ours 1 run is silently wrong or hangs: a." in text and "None of ours is silently wrong or" not in text
    assert "In 2 silently wrong runs under a 1 ms pulse, the force was never evaluated" in text


@pytest.mark.parametrize(
    "message",
    [
        "NotSymbolic: force of 'chain of 2': it branches on what depends on t",
        "ValueError: compiled=True needs equations that can be written down; force of 'chain of 1': it branches",
        "ValueError: method='Taylor' needs callbacks whose operations it can see; force of 'chain of 1'",
        "ValueError: mass of 'spatial slider-crank' must be positive definite; at t = 0.0 it is not",
    ],
)
def test_a_refusal_is_no_run(message):
    raised = {"status": "RAISED", "message": message, "error": None, "warned": "", "asked": True}
    assert honesty.outcome(raised, SOUND, True) == honesty.NOT_RUN
    assert honesty.outcome(raised | {"message": "KeyError: of a callback"}, SOUND, True) == honesty.SAID
    rows = rows_of_forces()
    changed = (rows["solver"] == COMPILED) & (rows["group"] == MISTAKE)
    rows.loc[changed, ["outcome", "status"]] = honesty.NOT_RUN, "RAISED"
    found, text = said(honesty, rows)
    assert found["trust"]["set"]["n"] == found["trust"]["set"]["refused"] == 1
    words = "some of these with `compiled` set"
    assert f"| {words} | 0 | 0 | 0 | 1 | 0 | 0 |" in text and "1 of ours with `compiled` set." in text


def test_what_a_refusal_says_is_what_is_said():
    trap = next(trap for trap in under_forces(quick=False) if trap.name == "square wave")
    for method in ("auto, compiled", "Taylor"):
        assert honesty.run("x", partial(own, method), trap, None)["outcome"] == honesty.NOT_RUN


def test_a_second_line_has_the_longest_step_of_ours(monkeypatch):
    asked = []
    monkeypatch.setattr(honesty_solvers, "solve_index1", lambda *arguments, **options: asked.append(options))
    every = solvers(False, FORCE)
    pulse = TRAPS["pulse of 1 ms"]
    every["LSODA, index 1"](pulse)
    every["LSODA, index 1" + LIMITED](pulse)
    every["LSODA, index 1"](TRAPS["pulse of 1 ms, max_step half of it"])
    assert [options["max_step"] for options in asked] == [None, pytest.approx(pulse.t_end * LOOK), 5e-4]
    others = {name for name in every if not name.endswith(honesty.OURS)}
    assert {name + LIMITED for name in others if not name.endswith(LIMITED)} < others
    assert why_not("LSODA, index 1" + LIMITED, TRAPS["pulse of 1 ms, max_step half of it"])


def test_an_impulse_is_asked_of_forms_that_hold_it():
    kink = next(trap for trap in under_forces(quick=True) if trap.name == KINK)
    assert kink.impulse and not any(trap.impulse for trap in under_forces(quick=True) if trap.name != KINK)
    for name in solvers(False, FORCE):
        assert bool(why_not(name, kink)) == (not name.endswith(honesty.OURS) and not name.startswith("IDA"))


def test_a_solver_is_warmed_up_once_for_the_same_callbacks():
    dead_points, called, compiled = list(of_linkages())[2:4], [], set()
    for trap in dead_points:
        honesty.warm_up("auto (twoloop)", called.append, trap, compiled)
    assert len(called) == len(compiled) == 1 and called[0].t_end == 1e-6


def test_forces_held_out_are_others_and_counted_apart():
    first, held = list(under_forces(quick=True)), list(held_out(quick=True))
    assert [(trap.name, trap.mechanism) for trap in first] == [(trap.name, trap.mechanism) for trap in held]
    for one, other in zip(first, held, strict=True):
        assert other.group == HELD_OUT and not np.array_equal(one.system.parameters, other.system.parameters)
    assert row_of(held[0])["outcome"] == honesty.RIGHT and GROWN < honesty.LOOSENESS
    again = rows_of_forces([(OURS, FORCE)])
    apart = again[again["group"] == FORCE].assign(group=HELD_OUT)
    found, text = said(honesty, pd.concat([rows_of_forces(), apart], ignore_index=True))
    assert "`max_step`, here 30 ms, which is coarser" in text  # of rows that do not hold it
    fine = pd.concat([rows_of_forces(), apart.assign(max_step=LOOK * 3.0)], ignore_index=True)
    assert (
        "`max_step`, here 1.5 ms. " in said(honesty, fine)[1] or "`max_step`, here 1.5 ms.\n" in said(honesty, fine)[1]
    )
    assert found["trust"]["default"]["wrong"] == 0 and found["held_out"]["trust"]["default"]["wrong"] == 1
    assert "Ours (error): the default, gust, pendulum (1e-9)." in text and "until these two agree" in text


def test_checks_of_the_input_are_counted_apart():
    line = rows_of_forces().assign(group=INPUT, trap="inconsistent positions", outcome=honesty.SILENT)
    found, text = said(honesty, pd.concat([rows_of_forces(), line], ignore_index=True))
    assert {name: each["wrong"] for name, each in found["trust"].items()} == dict.fromkeys(found["trust"], 0)
    assert found["n_traps"] == 1 and found["input"]["n_traps"] == 1
    assert "6 of 6 runs of ours" in text and "2 of 2 of others (inconsistent positions)" in text


def test_a_force_has_a_known_end_and_all_presets_are_asked():
    trap = next(trap for trap in under_forces(quick=False) if trap.name == "tanh friction, width 0.1")
    assert trap.mechanism == "pendulum" and row_of(trap)["outcome"] == honesty.RIGHT
    assert row_of(replace(trap, system=TRAPS["drag"].system))["outcome"] == honesty.SILENT
    asked = {name.removesuffix(" (twoloop)").split(",")[0] for name in solvers(False, FORCE)}
    assert set(PRESETS) - asked == {"PaperIRK", "PaperNewmark"}


def test_forces_are_on_three_mechanisms():
    made = [(family, bodies.__name__) for family, bodies in forces(quick=False)]
    assert len({name for name, _ in made}) >= 15
    for bodies in ("pendulum", "bars", "slider_in_space"):
        assert ("gust of 3 ms", bodies) in made


def test_a_gust_shorter_than_a_look_is_a_rate_over_random_times():
    made = list(short_forces.traps(quick=True))
    assert {trap.group for trap in made} == {SHORT} and {trap.name for trap in made} == {
        "gust of 1 ms",
        "pulse of 1 ms",
    }
    assert len({(trap.name, trap.mechanism) for trap in made}) == len(made) == 4
    assert len({tuple(trap.system.parameters) for trap in made}) == 4
    assert {"CVODE from C, Adams", "heyoka, Taylor", "IDA from C", "DOP853, index 1"} < set(solvers(False, SHORT))
    assert {"IDA from C", "CyRK, DOP853"} < {
        name.removesuffix(LIMITED) for name in solvers(False, SHORT) if name.endswith(LIMITED)
    }
    lines = [("gust of 1 ms", OURS, honesty.SILENT, 0.1), ("gust of 1 ms", OURS, honesty.SILENT, 1e-4)]
    lines += [("gust of 10 ms", OURS, honesty.RIGHT, 1e-9), ("gust of 1 ms", THEIRS, honesty.HANG, np.nan)]
    lines += [("gust of 1 ms", THEIRS, honesty.NOT_RUN, np.nan)]
    rows = rows_of_forces()
    short = rows.iloc[[0] * len(lines)].reset_index(drop=True).assign(group=SHORT, mechanism="pendulum, draw 0")
    short[["trap", "solver", "outcome", "error"]] = lines
    found, text = said(honesty, pd.concat([rows, short], ignore_index=True))
    gusts = found["short"]["gust"]
    assert gusts["widths"] == [1e-3, 1e-2] and found["short"]["pulse"]["n"] == 0
    some, none = {"n": 2, "gross": 1, "widths": [1e-3]}, {"n": 1, "gross": 0, "widths": [1e-2]}
    assert gusts["default"] == {"some": some, "none": none}
    assert "| the default | 1/2 | 0/1 |" in text and "| SciPy, LSODA, index 1 | 1/1 | – |" in text
    assert "## Short forces" not in said(honesty, rows)[1]


def test_groups_of_other_commits_stand_beside_that_of_the_newest_rows():
    stamp = "`python -m studies.honesty`; 2026-11-26; commit abc; AMD EPYC, 2 cores"
    rows = pd.DataFrame(
        {"group": ["input", "short", "force"], "commit": ["abc", "def", "def"], "processor": "Xeon (6)"}
    )
    assert told(stamp, rows[:1], "abc") == stamp
    assert told(stamp, rows, "abc") == stamp.replace("abc", "abc (short, force: commit def, Xeon (6))")
    assert "commit abc (input: commit not kept, not kept)" in told(stamp, rows[["group"]][:1], "abc")
    with pytest.raises(StudyError, match="give groups of traps"):
        again.main(["long"])
