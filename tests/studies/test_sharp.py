"""Sharp forces: mechanisms under them against their motion in independent coordinates, and the rule of a run."""

import numpy as np
import pandas as pd
import pytest

from studies.bench import sharp_callbacks
from studies.bench.sharp_forces import DRIVE_A, SIZE, T_END, families, force_along, made
from studies.bench.sharp_mechanisms import bars, chain, row, slider_crank, slider_in_space
from studies.bench.sharp_motion import LOOSENESS, RIGHT, SAID, SILENT, Motion, allowed, judged, march, off, positions
from studies.robustness import sharp_runs
from twoloop.mechanisms import four_bar, spatial_slider_crank

FORCE = made("gust", 3, (5.0, 0.1, 0.4), windows=((0.0, 1.1),))
TWO = np.array([1.0, 0.7])
MECHANISMS = {
    "pendulum": lambda force: chain(force, TWO[:1], TWO[1:], np.array([0.6]), np.array([1.0])),
    "chain": lambda force: chain(force, TWO, TWO[::-1], np.array([0.6, 0.2]), np.array([1.0, -1.0])),
    "row": lambda force: row(force, np.array([3.0, 8.0]), TWO, 0.2, 0.1),
    "slider-crank": lambda force: slider_crank(force, 0.4, 1.0, TWO, 0.8, 3.0),
    "four-bar": bars,
    "in space": slider_in_space,
}


def known(mechanism):
    return Motion(positions(mechanism, march(mechanism, "DOP853", 1e-10, mechanism.y0)), 0.0, 10.0)


def test_their_machine_code_is_kept_on_disk():
    """What cannot be watched is compiled in every process that imports it, for seconds."""
    forces = (sharp_callbacks.chain_force, sharp_callbacks.crank_force, sharp_callbacks.row_force)
    for force in (*forces, sharp_callbacks.slider_force):
        assert force.stats.cache_path is not None


@pytest.mark.parametrize("name", MECHANISMS)
def test_callbacks_and_independent_coordinates_agree(name):
    mechanism = MECHANISMS[name](FORCE)
    truth = known(mechanism)
    right = judged(mechanism, truth, "DOP853", 1e-9, 20.0)
    assert right["outcome"] == RIGHT and right["error"] < 1e-6, right
    without = known(MECHANISMS[name](made("none", 0, ())))
    assert off(without.q, truth.q) > 1e-3  # the force is felt
    assert judged(mechanism, without, "DOP853", 1e-9, 20.0)["outcome"] == SILENT


def test_ready_mechanisms_without_a_force_are_those_of_the_library():
    for made_of, problem in ((bars, four_bar()), (slider_in_space, spatial_slider_crank())):
        mechanism = made_of(made("none", 0, ()))
        q, v = problem.q0 + 0.01, problem.v0 + 0.02
        assert np.array_equal(mechanism.system.force(0.3, q, v), problem.system.force(0.3, q, v))


@pytest.mark.parametrize("name", ["pendulum", "chain", "row"])
def test_a_kinked_drive_gives_an_impulse(name):
    kink = made("kink", 1, (0.6, 0.0, 1.0), drives=True, breaks=(1.0,))
    soft = made("step", 3, (0.3, 1e-4, 1.0), drives=True)
    assert kink.driven and soft.parameters[DRIVE_A] == 0.3
    mechanism = MECHANISMS[name](kink)
    truth = known(mechanism)
    before = judged(mechanism, truth, "DOP853", 1e-9, 20.0)  # explicit steps: what momentum demands
    assert before["outcome"] == RIGHT, before


def test_an_error_is_said_and_a_failed_run_too():
    mechanism = MECHANISMS["pendulum"](made("square wave", 7, (5.0, 3.0)))
    truth = known(mechanism)
    assert judged(mechanism, truth, "Taylor", 1e-9, 20.0)["status"] == "RAISED"
    made_row = judged(mechanism, truth, "DOP853", 1e-9, 20.0, max_steps=3)
    assert made_row["outcome"] == SAID and made_row["error"] is None


def test_what_is_allowed_grows_with_the_errors():
    truth = Motion(np.zeros((1, 1)), 0.0, 7.0)
    assert allowed(truth, 1e-8) == pytest.approx(LOOSENESS * 7e-8)
    assert allowed(truth, 1e-14) == allowed(truth, 1e-13) > 0.0


def test_every_family_is_finite_and_can_be_drawn_again():
    for draw in families().values():
        one, two = (draw(np.random.default_rng(3)) for _ in range(2))
        assert np.array_equal(one.parameters, two.parameters) and one.parameters.size == SIZE
        assert all(0.0 < t < T_END for t in one.breaks)
        p = one.on(2.0, 0.1, 1.0, 1.0)
        values = [force_along(t, x, v, p) for t in (0.0, 1.3, T_END) for x in (-0.4, 0.6) for v in (-1.5, 0.2)]
        assert np.isfinite(values).all() and (one.driven or np.ptp([*values, 0.0]) > 0.0 or one.windows or one.breaks)


def test_the_runs_go_round_methods_and_tolerances():
    keys = [key for key, _ in sharp_runs.random_mechanisms(quick=False)]
    assert len(set(keys)) == len(keys) and len(keys) * len(sharp_runs.METHODS) >= 3000
    assert ({key.split(" ", 2)[2] for key in keys}) == set(families())


def test_counts_of_runs():
    about = {"group": "sharp", "what": "drag", "name": "pendulum", "value": 0.0, "method": "auto", "message": "x"}
    about |= {"tol": 1e-4, "error": 0.02, "allowed": 0.01}
    found = sharp_runs.counts(pd.DataFrame([about | {"outcome": each} for each in (RIGHT, SILENT, SAID, RIGHT)]))
    assert (found["n"], found[RIGHT], found[SAID], found[SILENT], found["n_mechanisms"]) == (4, 2, 1, 1, 1)
    assert found["silent"] == [{"method": "auto", "what": "drag", "n": 1}] and found["loose"] == {
        "tolerance": 1e-4,
        "error": 1e-2,
        "n": 2,
    }
    assert found["allowed"] == [{"tol": 1e-4, "median": 0.01, "most": 0.01}]
    assert found["default"]["n"] == 4 and [line["error"] for line in found["default"]["wrong"]] == [0.02]
