"""The energy study: what its rows say of drift, and how they come to say it."""

import math

import numpy as np
import pandas as pd
import pytest

from studies import energy
from studies.energy import EnergyJob, instants, measure
from studies.energy_drift import (
    CREEPS,
    DRIFTS,
    GAUSS,
    IS_LOST,
    LOBATTO,
    MOMENTA_LASTING,
    MOMENTA_SYMMETRIC,
    NEWMARK_HALF,
    NEWMARK_QUARTER,
    NO_DRIFT,
    ONE,
    PAPER_IRK,
    PAPER_NEWMARK_HALF,
    RADAU,
    ROUNDS,
    SUN,
    SWITCHING,
    VELOCITIES_LASTING,
    VELOCITIES_SYMMETRIC,
    WANDERS,
    drift,
    pick,
    times_less,
    verdict,
    windows,
)
from studies.report import load_rows, save_rows

PERIOD = 2.2489859198


@pytest.fixture(scope="module")
def quick(tmp_path_factory):
    out = tmp_path_factory.mktemp("energy")
    energy.main(["--quick", "--out", str(out)])
    return out


@pytest.fixture(scope="module")
def rows(quick):
    return load_rows(quick / "energy.csv")[0]


def test_only_the_report_is_left(quick):
    names = {"README.md", "energy.md", "energy.csv", "energy_windows.csv", "energy_long.png", "energy_variable.png"}
    assert {path.name for path in quick.iterdir()} == names | {"energy_short.png", ".lock"}


def test_redraw_writes_the_same_report(quick):
    text = (quick / "energy.md").read_text()
    assert "is not a symplectic map" in text and "Assumed geometry" in text
    (quick / "energy_long.png").unlink()
    energy.main(["--quick", "--out", str(quick), "--redraw"])
    assert (quick / "energy.md").read_text() == text
    assert (quick / "energy_long.png").stat().st_size > 10_000


def test_a_failed_run_is_reported(quick, rows, tmp_path):
    for name in ("energy.csv", "energy_windows.csv"):
        (tmp_path / name).write_text((quick / name).read_text())
    failed = rows.copy()
    what = pick(rows, ONE, GAUSS, VELOCITIES_LASTING).name
    failed.loc[what, ["slope", "slope_error", "swing", "n_windows"]] = math.nan
    failed.loc[what, ["status", "t_reached", "verdict"]] = ["NOT_CONVERGED", 0.1, "failed at 0.1 s"]
    save_rows(tmp_path / "energy.csv", failed, "changed by a test")
    energy.main(["--quick", "--out", str(tmp_path), "--redraw"])
    assert "| failed at 0.1 s |" in (tmp_path / "energy.md").read_text()


def test_the_reference_conserves_energy(rows):
    assert rows["largest_exact"].max() < 2e-13


def test_sun_on_velocities_drifts_a_hundred_times_more(rows):
    sun = pick(rows, ONE, SUN, VELOCITIES_LASTING)
    assert abs(sun["slope"]) > 100.0 * sun["slope_error"]
    for solver, variant in (
        (SUN, MOMENTA_LASTING),
        (GAUSS, VELOCITIES_LASTING),
        (GAUSS, VELOCITIES_SYMMETRIC),
        (GAUSS, MOMENTA_LASTING),
        (LOBATTO, VELOCITIES_LASTING),
    ):
        row = pick(rows, ONE, solver, variant)
        assert row["verdict"] == NO_DRIFT and times_less(rows, row) > 100.0


def test_what_is_neither_symmetric_nor_symplectic_drifts(rows):
    assert pick(rows, ONE, RADAU, VELOCITIES_LASTING)["verdict"] == DRIFTS


def test_across_changes_of_partition_only_symmetry_helps(rows):
    for solver, variant in ((GAUSS, VELOCITIES_LASTING), (LOBATTO, VELOCITIES_LASTING), (SUN, VELOCITIES_LASTING)):
        assert pick(rows, SWITCHING, solver, variant)["verdict"] == DRIFTS
    for variant in (VELOCITIES_SYMMETRIC, MOMENTA_SYMMETRIC):
        assert pick(rows, SWITCHING, SUN, variant)["verdict"] == CREEPS
        for solver in (GAUSS, LOBATTO):
            row = pick(rows, SWITCHING, solver, variant)
            assert row["verdict"] == NO_DRIFT and times_less(rows, row) > 1e4


def test_newmark_does_not_drift_on_one_partition_and_does_across_changes(rows):
    for solver in (NEWMARK_QUARTER, NEWMARK_HALF):
        assert pick(rows, ONE, solver, VELOCITIES_LASTING)["verdict"] == NO_DRIFT
        assert pick(rows, SWITCHING, solver, VELOCITIES_LASTING)["verdict"] in (DRIFTS, IS_LOST)


def test_variable_steps_drift(rows):
    for solver, variant in ((PAPER_IRK, VELOCITIES_LASTING), (SUN, MOMENTA_LASTING), (GAUSS, VELOCITIES_LASTING)):
        row = pick(rows, ONE, solver, variant, fixed=False)
        assert row["verdict"] == DRIFTS and abs(row["slope"]) > 10.0 * row["slope_error"]


def test_a_run_that_fails_is_a_row():
    row = pd.Series(measure(EnergyJob(SWITCHING, 50.0, GAUSS, 0.04, None, *VELOCITIES_LASTING)))
    assert row["status"] == "NOT_CONVERGED" and row["slope"] is None and 0.0 < row["t_reached"] < 50.0
    assert verdict(row).startswith("failed at")


def row_of(**changes):
    numbers = {"status": "REACHED_END", "largest": 1e-6, "kinetic": 10.0, "t_end": 1e4, "n_steps": 1_000_000}
    return pd.Series(numbers | {"slope": 1e-9, "slope_error": 1e-11, "swing": 1e-6} | changes)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, DRIFTS),
        ({"slope": -1e-9}, DRIFTS),
        ({"swing": 1e-4}, CREEPS),
        ({"slope_error": 1e-9}, WANDERS),
        ({"slope_error": 1e-9, "swing": 1e-4}, NO_DRIFT),
        ({"slope": 1e-13, "slope_error": 1e-15}, ROUNDS),  # 1e-9 J; one rounding a step makes 2e-9 J
        ({"largest": 2.6}, IS_LOST),
        ({"status": "NOT_CONVERGED", "t_reached": 12.5}, "failed at 12.5 s"),
    ],
)
def test_verdict(changes, expected):
    assert verdict(row_of(**changes)) == expected


def test_drift_finds_a_slope_under_an_oscillation():
    t = np.arange(100.0)
    slope, error = drift(t, 1e-3 * t + np.sin(2.4 * t))
    assert abs(slope - 1e-3) < 3.0 * error < 0.05


def test_a_random_walk_is_seldom_called_a_drift():
    generator = np.random.default_rng(1)
    t = np.arange(100.0)
    called = 0
    for _ in range(300):
        slope, error = drift(t, np.cumsum(generator.standard_normal(100)))
        called += abs(slope) > 3.0 * error
    assert called < 0.05 * 300  # expected 1.5 %


def test_windows_are_whole_periods():
    t = np.linspace(0.0, 100.0, 200_001)
    seen = windows(t, 1e-3 * t + np.sin(2.0 * np.pi * t / PERIOD), PERIOD, 100.0)
    assert seen["t"].size == 44
    np.testing.assert_allclose(seen["mean"], 1e-3 * seen["t"], atol=1e-3)
    np.testing.assert_allclose(seen["range"], 2.0, atol=1e-2)


@pytest.mark.parametrize("h", [0.01, 0.02, None])
@pytest.mark.parametrize("period", [PERIOD, 1.5451930915])
def test_long_runs_are_sampled_evenly_over_the_phases(h, period):
    job = EnergyJob(ONE, 1e4, GAUSS if h else PAPER_NEWMARK_HALF, h, None if h else 1e-7, *VELOCITIES_LASTING)
    times = instants(job, period)
    assert times[0] == 0.0 and 1e4 - period < times[-1] <= 1e4
    if h:
        np.testing.assert_allclose(times / h, np.round(times / h), atol=1e-6)
    for first in (0, 3000):
        phases = np.sort(times[first : first + 200] / period % 1.0)
        assert np.diff(phases, append=phases[0] + 1.0).max() < 0.05


@pytest.mark.parametrize(("t_end", "h", "tol"), [(100.0, 0.02, None), (100.0, None, 1e-5), (1e4, None, 1e-5)])
def test_other_runs_are_not_changed_by_sampling(t_end, h, tol):
    assert instants(EnergyJob(ONE, t_end, GAUSS, h, tol, *VELOCITIES_LASTING), PERIOD) is None
