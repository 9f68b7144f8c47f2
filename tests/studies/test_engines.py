"""The study of engines: orders and floors, prices and settings turn with the rows; without engines it says so."""

from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from studies import engines
from studies.bench.closed_loops import ASKEW, LIGHTENED, MECHANISMS, bricard, four_bar
from studies.bench.render import render
from studies.engines import Loop
from twoloop.audit import audit_mjcf
from twoloop.audit.simulator import order_and_floor

STEPS = np.array([1e-2, 3e-3, 1e-3, 3e-4])
RUNS = {"family": "MuJoCo", "status": "REACHED_END", "message": "", "floor": 1e-11, "gap": 1e-6, "span": 1.0}


def made(solver, errors, cost=1.0, case="four-bar", **more):
    family = solver.split(", ")[0]
    rows = []
    for k, (h, error) in enumerate(zip(STEPS, errors, strict=True)):
        own = (
            {"tol": h**2, "h": None, "n_steps": None}
            if family == "twoloop"
            else {"tol": None, "h": h, "n_steps": int(1.0 / h)}
        )
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


def test_the_default_is_compared_with_the_fastest_engine_at_each_error():
    slow, fast = made("MuJoCo, RK4, solref 2h", 10.0 * STEPS**2), made("Exudyn, trapezoidal", 10.0 * STEPS**2, cost=0.5)
    ours = made("twoloop, default", 1e-1 * STEPS**2, cost=0.1)
    compiled = made("twoloop, compiled=True", 1e-1 * STEPS**2, cost=0.01)  # not the default
    bricard = (each.assign(case="Bricard") for each in (slow.assign(call_s=0.01), ours))
    found, text = said(slow, fast, ours, compiled, *bricard)
    loose, tight = found["against"]["1e-2"], found["against"]["1e-6"]
    assert loose["compared"] == 2 and loose["ahead"] == 1 and loose["ratio"] == pytest.approx((5.0 + 0.1) / 2.0)
    assert loose["slower"] == {"Bricard": {"engine": "MuJoCo", "ratio": pytest.approx(0.1)}}
    assert loose["fastest"] == {"Exudyn": 1, "MuJoCo": 1} and tight["ahead"] == 1
    assert tight["ratio"] == pytest.approx((4.0 / 0.2 + 0.01 / 0.2) / 2.0)
    assert f"**Answer**: {found['answer']}" in text and "8 of" not in text
    assert found["answer"].startswith("For an error of 1e-2 twoloop is faster than every engine on 1 of 2 mechanisms")
    alone = said(ours)[0]
    assert alone["against"]["1e-2"]["compared"] == 0 and alone["answer"].startswith("No engine")


def test_orders_floors_and_times_follow_the_rows():
    flat = made("MuJoCo, default", [0.5, 0.3, 0.29, 0.28])
    good, ours = made("MuJoCo, RK4, solref 2h", 10.0 * STEPS**2), made("twoloop, default", 1e-1 * STEPS**2, cost=0.1)
    found, text = said(flat, good, ours)
    by_name = {each["name"]: each for each in found["configurations"]}
    assert by_name["MuJoCo, default"]["lost"] == 4 and by_name["MuJoCo, default"]["floor"] == 0.28
    best = by_name["MuJoCo, RK4, solref 2h"]
    assert (best["lost"], best["wrong"], best["order"]) == (0, 0, pytest.approx(2.0))
    assert found["best"]["MuJoCo"] == "MuJoCo, RK4, solref 2h" and found["absent"] == ["Drake"]
    at = found["times"]["MuJoCo"]
    assert at["1e-4"] == {"call_s": 2.0, "reached": 1} and said(flat, ours)[0]["times"].keys() == {"twoloop"}
    assert "MuJoCo 4.0.0" in text and "without rows: Drake." in text  # as the rows have it, whatever is installed


def test_a_mechanism_without_code_is_a_row(monkeypatch):
    def refused(*_, **__):
        raise ValueError("compiled=True needs equations that can be written down")

    monkeypatch.setattr(engines.Loop, "solve", refused)
    row = engines.run_row(four_bar, engines.CONFIGURATIONS[-1], 1e-3, [])
    assert row["status"] == "NOT_APPLICABLE" and "written down" in row["message"] and row["call_s"] is None


@pytest.mark.skipif(find_spec("mujoco") is None, reason="MuJoCo is not installed")
def test_the_settings_of_the_example_converge():
    audit = audit_mjcf(Path(__file__).parents[2] / "reports/engines/four_bar.xml", error=1e-3, t_end=2.0).audits[0]
    assert audit.reaching.step >= 2e-3 and audit.order > 1.8 and audit.floor is None


def test_probes_are_medians_in_which_a_failure_is_any_error():
    good = made("MuJoCo, RK4, solref 2h", 10.0 * STEPS**2)
    light = good.assign(group="mass", case=[f"{k}, a body 1e4 times lighter" for k in "abcd"])
    light = light.assign(error_q=[1.0, 2.0, 0.01, 0.03], n_steps=5000)
    light = light.assign(status=["REACHED_END", "FAILED", "REACHED_END", "REACHED_END"])
    probes = said(good, light)[0]["probes"]
    assert probes["positions, a light body"]["MuJoCo"] == pytest.approx(0.515) and probes["positions"]["MuJoCo"] is None


def test_the_changed_mechanisms_move_as_they_should():
    turned, upright = (Loop(replace(each, t_span=(0.0, 0.05))) for each in (bricard(ASKEW), bricard()))
    known, there = turned.reference[0], upright.reference[0]
    np.testing.assert_allclose(known.x, there.x @ ASKEW.T, atol=1e-9)
    light, heavy = (make().model.bodies[1].inertia for make in (LIGHTENED[2], MECHANISMS[1]))
    np.testing.assert_allclose(light, heavy / 100.0)
    assert len(LIGHTENED) == 2 * len(MECHANISMS) - 2


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


@pytest.mark.slow
def test_the_quick_run(tmp_path):
    engines.STUDY.main(["--quick", "--out", str(tmp_path)])
    assert "Quick run" in (tmp_path / "engines.md").read_text() and (tmp_path / "engines.png").is_file()
