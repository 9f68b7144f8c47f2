"""The study of engines: orders and floors, prices and settings turn with the rows; without engines it says so."""

from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from studies.bench.changed_loops import IN_A_FRAME, LIGHTENED
from studies.bench.closed_loops import ASKEW, MECHANISMS, SPATIAL, four_bar
from studies.bench.engine_runs import Loop
from studies.bench.render import render
from studies.engines import study as engines
from twoloop.audit import audit_mjcf
from twoloop.audit.step_audit import order_and_floor

STEPS = np.array([1e-2, 3e-3, 1e-3, 3e-4])
RUNS = {"family": "MuJoCo", "status": "REACHED_END", "message": "", "floor": 1e-11, "gap": 1e-6, "span": 1.0}


def made(solver, errors, cost=1.0, case="four-bar", **more):
    family = solver.split(", ")[0]
    rows = []
    for k, (h, error) in enumerate(zip(STEPS, errors, strict=True)):
        own = {"tol": h**2, "h": None} if family == "twoloop" else {"tol": None, "h": h, "n_steps": int(1.0 / h)}
        rows.append({"group": "run", "case": case, "solver": solver, "error_q": error, "call_s": cost * 2.0**k, **own})
    return pd.DataFrame(rows).assign(**RUNS | {"family": family} | more, stepping_s=lambda each: each["call_s"])


def said(*parts):
    gates = [{"group": "gate", "case": "four-bar", "solver": name, "family": name} for name in ("MuJoCo", "Drake")]
    head = pd.DataFrame(gates).assign(status=["PASSED", "NOT_AVAILABLE"], message=["", "drake is not installed"])
    head["version"] = ["4.0.0", "not installed"]
    rows = pd.concat([head, *parts], ignore_index=True)
    found = engines.findings_of(rows)
    return found, render("engines", found, {}, stamp="stamp", quick=False, rows=rows)


def test_order_and_floor():
    order, floor = order_and_floor(STEPS, 50.0 * STEPS**2, 1e-12)
    assert order == pytest.approx(2.0) and floor is None
    order, floor = order_and_floor(STEPS, [1e-2, 1.2e-3, 1.1e-3, 1.1e-3], 1e-12)
    assert order is None and floor == 1.1e-3
    assert order_and_floor(STEPS, [1.9, 1.8, 1.9, 1.8], 1e-12) == (None, None)  # the motion is lost


def test_what_to_set_and_what_is_wrong_follow_the_rows():
    flat = made("MuJoCo, default", [0.5, 0.3, 0.29, 0.28])
    good = made("MuJoCo, RK4, solref 2h", 10.0 * STEPS**2)
    ours = made("twoloop, default", 1e-1 * STEPS**2, cost=0.1)
    found, text = said(flat, good, ours)
    by_name = {each["name"]: each for each in found["configurations"]}
    assert by_name["MuJoCo, default"]["silent"] == 4 and by_name["MuJoCo, default"]["lost"] == 1
    assert by_name["MuJoCo, default"]["floor"] == [0.28, 0.28]
    best = by_name["MuJoCo, RK4, solref 2h"]
    assert best["gross"] == 0 and best["silent"] == 0 and best["order"][1] == pytest.approx(2.0)
    assert found["wins_engines"][1] == {"MuJoCo": 1}
    assert "MuJoCo 4.0.0" in text  # as the rows have it, whatever is installed
    first = found["engines"][0]
    assert first["solver"] == "MuJoCo, RK4, solref 2h" and first["steps"] == {"four-bar": [1e-2, 1e-2, 3e-3]}
    assert "| four-bar | 10/10/3.0 |" in text and "Not installed, and so without rows: Drake." in text


def test_where_our_calls_cost_more_is_said():
    good, ours = made("MuJoCo, RK4, solref 2h", 10.0 * STEPS**2), made("twoloop, default", 1e-1 * STEPS**2, cost=0.1)
    compiled = made("twoloop, compiled=True", 1e-1 * STEPS**2, cost=0.01)
    found, text = said(good, ours, compiled, *(each.assign(case="RSSR") for each in (good.assign(call_s=0.01), ours)))
    over = found["call_over_engines"]
    assert over["twoloop, default"] == {"four-bar": pytest.approx(0.1), "RSSR": pytest.approx(10.0)}
    assert over["twoloop, compiled=True"] == {"four-bar": pytest.approx(0.01), "RSSR": None}
    assert "- `twoloop, the default`: no slower on 1, slower on RSSR (10 times)." in text
    assert "- `twoloop, compiled=True`: no slower on 1, not compared on RSSR." in text
    assert found["wins_engines"][1] == {"MuJoCo": 2}  # of engines alone
    assert "| twoloop, the default |" in text and "| twoloop, compiled=True |" not in text


def test_a_mechanism_without_code_is_a_row(monkeypatch):
    def refused(*_, **__):
        raise ValueError("compiled=True needs equations that can be written down")

    monkeypatch.setattr(engines.Loop, "ours", refused)
    row = engines.run_row(four_bar, engines.CONFIGURATIONS[-1], 1e-3, [])
    assert row["status"] == "NOT_APPLICABLE" and "written down" in row["message"] and row["call_s"] is None


@pytest.mark.skipif(find_spec("mujoco") is None, reason="MuJoCo is not installed")
def test_the_settings_of_the_first_screen_hold_on_a_file_by_hand():
    file = Path(__file__).parents[2] / "reports/engines/four_bar.xml"
    _, text = said(made("MuJoCo, RK4, solref 2h", 10.0 * STEPS**2))
    given = file.read_text()
    assert 'integrator="RK4"' in given and all(each in given for each in text.split('anchor="..." ')[1].split("/>")[:1])
    audit = audit_mjcf(file, error=1e-3, t_end=2.0).audits[0]
    assert audit.reaching.step >= 2e-3 and audit.order > 1.8 and audit.floor is None


def test_the_error_at_a_speed_is_that_of_calls_as_fast():
    slow = made("MuJoCo, RK4, solref 2h", [1e-2, 1e-3, 1e-4, 1e-5], cost=0.005)
    found, _ = said(slow.assign(span=1.0))
    assert found["engines"][0]["speeds"] == [1e-5, 1e-3]  # calls of 5, 10, 20 and 40 ms; 1 s and 10 ms are allowed
    found, text = said(slow.assign(span=0.1))
    assert found["engines"][0]["speeds"] == [1e-5, None] and "| 1e-5 | – |" in text


def test_motors_and_energies_stand_beside_what_they_change():
    good = made("MuJoCo, RK4, solref 2h", 10.0 * STEPS**2)
    motor = good.assign(group="motor", case=[f"{k}, driven" for k in "abcd"], error_q=[1.0, 2.0, 0.01, 0.03])
    motor = motor.assign(n_steps=5000, status=["REACHED_END", "FAILED", "REACHED_END", "REACHED_END"])
    energy = good[:1].assign(group="energy", n_steps=50_000, error_q=None, energy=0.03)
    skipped = energy.assign(case="other", energy=None, status="TIME_LIMIT")
    found, text = said(good, motor, energy, skipped)
    cells = {line["label"]: line["cells"] for line in found["probes"]}
    assert cells["driven; with a PD motor"] == [[None, None], [pytest.approx(0.515), None]]  # a failure is any error
    assert cells["energy, 100 s"] == [[None], [0.03]]
    assert found["cases"] == ["four-bar"] and "| driven; with a PD motor | –/– | 0.52/– |" in text


def test_the_changed_mechanisms_move_as_they_should():
    turned, upright = (Loop(replace(make(), t_span=(0.0, 0.05))) for make in (IN_A_FRAME[1], SPATIAL[1]))
    known, there = turned.reference[0], upright.reference[0]
    np.testing.assert_allclose(known.x, there.x @ ASKEW.T, atol=1e-9)
    light, heavy = (make().model.bodies[1].inertia for make in (LIGHTENED[2], MECHANISMS[1]))
    np.testing.assert_allclose(light, heavy / 100.0)
    assert turned.problem.name.endswith(", turned") and len(LIGHTENED) == 2 * len(MECHANISMS) - 2


def test_an_engine_that_is_not_there_is_a_row(monkeypatch):
    def absent(rigid, settings):
        raise RuntimeError("mujoco is not installed: make engines")

    found = {name: engine._replace(prepare=absent) for name, engine in engines.engines().items()}
    monkeypatch.setattr(engines, "engines", lambda: found)
    engines.gated.cache_clear()
    row = engines.run_row(four_bar, engines.CONFIGURATIONS[0], 100, [])
    engines.gated.cache_clear()
    assert row["status"] == "NOT_AVAILABLE" and "not installed" in row["message"] and row["error_q"] is None


def test_a_model_that_fails_its_gates_is_not_timed(monkeypatch):
    monkeypatch.setattr(engines, "gated", lambda build, engine: ("GATE_FAILED", "a loop is missing"))
    row = engines.run_row(four_bar, engines.CONFIGURATIONS[0], 100, [])
    assert row["status"] == "GATE_FAILED" and row["call_s"] is None


def test_ours_runs_without_any_engine():
    ours = next(each for each in engines.CONFIGURATIONS if each.engine == engines.OURS)
    row = engines.run_row(four_bar, ours, 1e-8, [])
    assert row["error_q"] < 1e-5 and row["gap"] < 1e-12 and row["energy"] < 1e-6 and row["error_f"] < 1e-5
    assert 0.0 < row["stepping_s"] <= row["call_s"]


def test_the_energy_over_a_long_time_is_of_the_whole_motion(monkeypatch):
    monkeypatch.setattr(engines, "LONG", 12.0)
    ours = next(each for each in engines.CONFIGURATIONS if each.engine == engines.OURS)
    row = engines.energy_row(four_bar, ours)
    assert 0.0 < row["energy"] < 1e-6 and row["group"] == "energy" and row["status"] == "REACHED_END"


@pytest.mark.slow
def test_the_quick_run(tmp_path):
    engines.STUDY.main(["--quick", "--out", str(tmp_path)])
    assert "Quick run" in (tmp_path / "engines.md").read_text() and (tmp_path / "engines.png").is_file()
