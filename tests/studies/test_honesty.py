"""The honesty study: the rule of the outcomes, a process that hangs, twoloop on a few traps, and what is counted."""

import time
from dataclasses import replace
from functools import partial
from itertools import islice

import numpy as np
import pandas as pd
import pytest

from studies.bench.sharp_forces import families
from studies.bench.sharp_mechanisms import Motion
from studies.honesty import study as honesty
from studies.honesty import traps as catalogue
from studies.honesty.study import DEFAULT, LIMITED, NOT_RUN, RIGHT, SAID, SILENT, own
from tests.studies.of_study import found_of, said
from twoloop import solve_dae
from twoloop.methods.presets import PRESETS

TRAPS = {trap.name: trap for trap in catalogue.traps(quick=True, groups=catalogue.GROUPS[:3])}
SOUND = TRAPS["redundant row"]
DOP853 = partial(own, "DOP853")


def row_of(trap, call=DOP853):
    return honesty.run("x", call, trap, honesty.right_answer(trap))


def test_a_right_answer_and_a_wrong_one_with_success():
    row, run = row_of(SOUND), partial(solve_dae, SOUND.sane, (0.0, SOUND.t_end), SOUND.q0, SOUND.v0)
    assert row["outcome"] == RIGHT and row["error"] < 1e-6
    assert row_of(SOUND, lambda trap: replace(result := run(), q=result.q + 0.1))["outcome"] == SILENT


def test_the_rule_of_outcomes():
    """Warnings, but not those of redundant rows, and steps without error control are reports; errors may grow."""
    quiet = {"status": "REACHED_END", "error": 5e-5, "warned": "", "message": ""}
    redundant = {"warned": "the constraints of 'x' have rank 5 of 6"}
    more = {"warned": f"{redundant['warned']} / beware"}, {"message": f"Done; {honesty.UNCONTROLLED}."}
    cases = ({}, SILENT), ({"error": 1e-9}, RIGHT), (redundant, SILENT), *((each, SAID) for each in more)
    for change, expected in cases:
        assert honesty.outcome(quiet | change, SOUND, True) == expected
    assert honesty.outcome(quiet | {"error": None}, SOUND, False) == SILENT
    assert honesty.outcome(quiet, replace(SOUND, sensitivity=10.0), True) == RIGHT


def test_a_call_that_does_not_come_back_hangs(monkeypatch):
    monkeypatch.setattr(honesty, "GRACE", 0.1)
    row = honesty.run("x", lambda trap: time.sleep(60.0), replace(SOUND, time_limit=0.2), None)
    assert row["outcome"] == honesty.HANG


def test_a_pulse_that_was_never_evaluated():
    pulse = TRAPS["pulse of 1 ms"]

    def solved(t_end, **options):
        return lambda trap: solve_dae(trap.system, (0.0, t_end), trap.q0, trap.v0, method="DOP853", **options)

    row = row_of(pulse, solved(pulse.t_end, step_size=0.1))
    assert row["outcome"] in (SILENT, SAID) and not row["evaluated"]
    row = row_of(pulse, solved(1.0005, max_step=1e-3))  # ends within the pulse
    assert row["outcome"] == SILENT and row["evaluated"]
    assert row_of(pulse)["outcome"] == row_of(TRAPS["pulse of 1 ms, max_step half of it"])["outcome"] == RIGHT


WRONG_SHAPE = "wrong shape from a Python callback after 1 s"
MISTAKES = ["inconsistent positions", "NaN in the force after 1 s", "one wrong entry of C_q", WRONG_SHAPE]


@pytest.mark.parametrize("name", MISTAKES)
@pytest.mark.parametrize("method", ["SunRadau5", "DOP853", "BDF"])
def test_mistakes_are_reported(name, method):
    assert row_of(TRAPS[name], partial(own, method))["outcome"] == SAID


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
    raised = {"status": "RAISED", "message": message, "error": None, "warned": ""}
    assert honesty.outcome(raised, SOUND, True) == NOT_RUN
    assert honesty.outcome(raised | {"message": "KeyError: of a callback"}, SOUND, True) == SAID


def test_refusals_have_these_messages():
    mechanism = catalogue.pendulum(families()["square wave"](np.random.default_rng(1)))
    trap = catalogue.of_force(catalogue.FORCE, mechanism, Motion(np.zeros((1, 2)), 0.0, 1.0), 1)
    for method in ("auto, compiled", "Taylor"):
        assert honesty.run("x", partial(own, method), trap, None)["outcome"] == NOT_RUN


@pytest.mark.parametrize("fault", catalogue.FAULTS)
def test_certificates_refuse_faulty_results(fault, monkeypatch):
    monkeypatch.setattr(catalogue, "REGULAR", ["long slider-crank"])
    trap = next(trap for trap in catalogue.certificates() if trap.name == fault)
    assert row_of(trap)["outcome"] == (RIGHT if fault == catalogue.SOUND else SAID)
    passing = replace(trap, solve=lambda *run, **options: solve_dae(*run, **options))  # a certificate that passes all
    assert row_of(passing)["outcome"] == (RIGHT if fault == catalogue.SOUND else SILENT)


def test_what_is_right_of_signals_of_impacts_of_accelerations_and_of_torques_that_change():
    """And a swallowed exception, impacts by the other law, and wrong accelerations are seen."""
    assert row_of(next(catalogue.signals(1)))["outcome"] == RIGHT
    assert catalogue.rung(lambda: time.sleep(0.01), 99.0).error == np.inf
    stops = next(catalogue.several_stops(1))
    assert row_of(stops)["outcome"] == RIGHT
    assert row_of(stops, lambda trap: solve_dae(trap.system, (0.0, trap.t_end), trap.q0, trap.v0))["outcome"] == SILENT
    trap = next(catalogue.little_inertia(1))
    wrong = row_of(trap, lambda trap: replace(result := own("DOP853", trap), a=1.001 * result.a))
    assert row_of(trap)["outcome"] == RIGHT and wrong["outcome"] == SILENT
    assert {row_of(torque)["outcome"] for torque in catalogue.changing_torques(1)} == {SAID}


@pytest.mark.slow
def test_motions_and_forces_have_known_ends():
    known = {trap.name: trap for trap in catalogue.of_linkages()}
    lined_up = catalogue.singular_positions(), catalogue.many_folds()
    passing = [next(traps) for traps in lined_up], islice(catalogue.folds(), 0, None, 8 * catalogue.N_STARTS)
    for trap in (known["dead point"], known["assemblies nearly meet"], *passing[0], *passing[1]):
        row = row_of(trap, partial(own, "auto"))
        assert row["outcome"] == RIGHT, row
    for trap in catalogue.random_linkages(1):
        assert row_of(trap)["outcome"] == RIGHT
        assert row_of(replace(trap, q0=trap.q0[::-1].copy()))["outcome"] == SAID
    force = next(catalogue.under_forces(quick=True))
    assert row_of(force)["outcome"] == RIGHT
    assert row_of(replace(force, system=TRAPS["gust of 30 ms"].system))["outcome"] == SILENT


def test_singular_positions_are_run_at_every_size_and_tolerance():
    made = list(catalogue.singular_positions())
    assert len({trap.mechanism for trap in made}) == len(made) == 396 and all(trap.singular for trap in made)
    others = [name for name in honesty.solvers_of(False, catalogue.SINGULAR) if "twoloop" not in name]
    assert others == [honesty.IDA, honesty.IDA_C] and not any(honesty.why_not(name, made[0]) for name in others)


def test_who_is_run_on_what():
    python, first, why = TRAPS["exception in a Python callback after 1 s"], TRAPS["first step of 1 s"], honesty.why_not
    assert why(honesty.IDA_C, python) and not why("BDF (twoloop)", python) and why("LSODA, index 1", first)
    kink = next(trap for trap in catalogue.under_forces(quick=True) if trap.name == catalogue.KINK)
    assert kink.impulse and not TRAPS["drag"].impulse
    named = {name: honesty.kind_of(name) for name in honesty.solvers_of(False, catalogue.FORCE)}
    assert set(named.values()) == set(honesty.KINDS)
    for name, kind in named.items():  # an impulse has no accelerations
        assert bool(honesty.why_not(name, kink)) == (kind not in ("default", "own") and not name.startswith("IDA"))
    assert {name.split(",")[0] for name, kind in named.items() if kind == "scipy"} == {*honesty.SCIPY}
    asked = {name.removesuffix(" (twoloop)").split(",")[0] for name in named}
    # Lobatto16 is what "auto, compiled" takes wherever it can
    assert set(PRESETS) - asked == {"Lobatto16", "PaperIRK", "PaperNewmark"}
    gusts = {bodies.__name__ for name, bodies in catalogue.forces(quick=False) if name == "gust of 3 ms"}
    assert gusts == {"pendulum", "bars", "slider_in_space"}


def test_other_solvers_are_run_with_a_largest_step_too(monkeypatch):
    asked = []
    monkeypatch.setattr(honesty, "solve_index1", lambda *arguments, **options: asked.append(options))
    every, pulse = honesty.solvers_of(False, catalogue.FORCE), TRAPS["pulse of 1 ms"]
    half = TRAPS["pulse of 1 ms, max_step half of it"]
    every["LSODA, index 1"](pulse)
    every["LSODA, index 1" + LIMITED](pulse)
    every["LSODA, index 1"](half)
    assert [options["max_step"] for options in asked] == [None, pytest.approx(pulse.t_end * honesty.LOOK), 5e-4]
    assert honesty.why_not("LSODA, index 1" + LIMITED, half)


def test_short_forces_come_at_random_times():
    made = list(catalogue.short_forces(quick=True))
    assert {trap.name for trap in made} == {"gust of 1 ms", "pulse of 1 ms"} and len(made) == 4
    assert len({tuple(trap.system.parameters) for trap in made}) == 4
    assert row_of(made[0], lambda trap: own("auto", trap))["error"] < 1e3 * catalogue.AGREE


OTHER, THEIRS = "BDF (twoloop)", "LSODA, index 1"
WRONG, SLIGHT = 2.0 * honesty.EXACT, 0.5 * honesty.EXACT


def made_up(*lines):
    """Rows of (group, trap, solver, outcome, error)."""
    names = ("group", "trap", "solver", "outcome", "error")
    about = {"mechanism": "pendulum", "tol": 1e-8, "status": "REACHED_END", "evaluated": True}
    return pd.DataFrame([about | dict(zip(names, line, strict=True)) for line in lines])


def test_silent_failures_are_counted_by_trap_and_solver():
    lines = [("force", "drag", solver, RIGHT, 1e-9) for solver in (DEFAULT, OTHER, THEIRS, THEIRS + LIMITED)]
    lines += [("force", "gust", DEFAULT, SILENT, SLIGHT), ("force", "gust", THEIRS, honesty.HANG, np.nan)]
    lines += [("force", "gust", OTHER, SAID, np.nan), ("force", "gust", OTHER, NOT_RUN, np.nan)]
    lines += [("short", "gust of 1 ms", DEFAULT, SILENT, WRONG), ("short", "gust of 3 ms", DEFAULT, RIGHT, 0.0)]
    lines += [("short", "pulse of 0.1 ms", DEFAULT, SILENT, WRONG), ("singular", "", DEFAULT, RIGHT, 0.0)]
    lines += [("mistake", "dead point", THEIRS, SILENT, WRONG), ("linkage", "a bar", DEFAULT, RIGHT, 0.0)]
    lines += [("fold", "", DEFAULT, SILENT, WRONG), ("certificate", catalogue.SOUND, DEFAULT, SAID, np.nan)]
    lines += [(group, "", DEFAULT, RIGHT, 0.0) for group in ("many folds", "stops", "inertia", "signal", "calls")]
    found, text = said(honesty, made_up(*lines))
    counted = {key: (line["default"]["n"], line["default"]["wrong"]) for key, line in found["table"].items()}
    assert counted == {
        **{"sharp": (2, 1), "gust_long": (1, 0), "gust_short": (1, 1), "pulse_short": (1, 1)},
        **{"singular": (1, 0), "folds": (1, 1), "linkages": (1, 0), "mistakes": (0, 0), "certificates": (1, 0)},
        **dict.fromkeys(("many", "stops", "inertia", "signals", "calls"), (1, 0)),
    }
    assert found["passed"] == {"n": 1, "right": 0} and "0 of 1 right ones pass" in text
    sharp = found["table"]["sharp"]
    assert (sharp["default"]["gross"], sharp["default"]["slight"]) == (0, 1)
    assert (sharp["others"]["n"], sharp["others"]["gross"], sharp["own"]["failed"]) == (2, 1, 1)
    answer = "The default is silently wrong in 1 of 2 runs under sharp forces, 2 of 2 under forces shorter than 1/2000 "
    assert found["answer"] == answer + "of the run, 1 of 3 at singular positions."
    assert f"**Answer**: {found['answer']}" in text and "|sharp forces¹|2|1|2|0|2|1|" in text
    assert found["wrong_traps"] == [{"trap": "dead point", "wrong": 1}] and found["pulses"]["wrong"] == [(1e-4, 1)]
    (figure,) = honesty.figures_of(pd.DataFrame(), found).values()
    assert [text.get_text() for text in figure.axes[0].texts][-3:] == ["  1 of 2", "  0 of 2", "  1 of 2"]


def test_published_mechanisms_and_the_authors_conditions_stand_in_the_table(tmp_path, unsaved):
    about = {"case": "A01", "family": "two-loop", "solver": "the default", "tol": 1e-8, "floor": 1e-14, "status": "x"}
    about |= {"group": np.nan, "outcome": "right", "error_q": 1e-9, "warnings": 0}
    authors = about | {"group": honesty.JUDGED}
    lines = [about, about | {"outcome": "inexact", "error_q": 2e-5}, about | {"outcome": SAID, "error_q": np.nan}]
    lines += [authors, authors | {"outcome": "wrong", "error_q": 1e-9}, authors | {"outcome": "wrong", "warnings": 1}]
    lines += [about | {"solver": "BDF (twoloop)", "outcome": NOT_RUN}, about | {"family": "SciPy", "solver": THEIRS}]
    pd.DataFrame(lines).to_csv(tmp_path / "x.csv", index=False)
    (tmp_path / "validation.csv").write_text("# full validation; stamp\n" + (tmp_path / "x.csv").read_text())
    table = found_of(honesty, tmp_path, made_up((catalogue.FORCE, "drag", DEFAULT, RIGHT, 1e-9)))["table"]
    got = {key: [line["default"][what] for what in ("n", "ended", "wrong", "gross")] for key, line in table.items()}
    assert got == {"sharp": [1, 1, 0, 0], "published": [3, 2, 1, 0], "authors": [3, 2, 1, 1]}
    assert [table["published"][who]["n"] for who in ("own", "others")] == [0, 1]
