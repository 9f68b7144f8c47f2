"""Sharp forces: mechanisms under them against their motion in independent coordinates, and the rule of a run."""

import numpy as np
import pytest

from references.paper.four_bar_minimal import MinimalFourBar
from studies.bench import sharp_mechanisms
from studies.bench.linkages import GRASHOF, KINDS, NEAR, draw, end_of, four_lengths
from studies.bench.sharp_forces import DRIVE_A, SIZE, T_END, families, force_along, made
from studies.bench.sharp_mechanisms import Motion, bars, chain, march, off, positions, row, slider_in_space
from tests.differential_motions import LOOSENESS, RIGHT, SAID, SILENT, allowed, crank_force, judged, slider_crank
from tests.marks import slow
from twoloop import solve_dae
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
    forces = (sharp_mechanisms.chain_force, crank_force, sharp_mechanisms.row_force)
    for force in (*forces, sharp_mechanisms.slider_force):
        assert force.stats.cache_path is not None


@pytest.mark.parametrize("name", [slow(name) if name in ("in space", "four-bar") else name for name in MECHANISMS])
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
    for force in families().values():
        one, two = (force(np.random.default_rng(3)) for _ in range(2))
        assert np.array_equal(one.parameters, two.parameters) and one.parameters.size == SIZE
        assert all(0.0 < t < T_END for t in one.breaks)
        p = one.on(2.0, 0.1, 1.0, 1.0)
        values = [force_along(t, x, v, p) for t in (0.0, 1.3, T_END) for x in (-0.4, 0.6) for v in (-1.5, 0.2)]
        assert np.isfinite(values).all() and (one.driven or np.ptp([*values, 0.0]) > 0.0 or one.windows or one.breaks)


def excess(lengths):
    s = np.sort(lengths)
    return s[1] + s[2] - s[0] - s[3]


def test_random_linkages_are_of_their_kind_and_the_other_assembly_is_another_motion():
    generator = np.random.default_rng(1)
    for kind in KINDS:
        for _ in range(20):
            got = excess(four_lengths(kind, generator))
            assert abs(got) < 0.0101 if kind == NEAR else (got > 0.0) == (kind == GRASHOF)
    drawn = None
    while drawn is None:
        drawn = draw(NEAR, generator, 1.0)
    (problem, q, growth), p = drawn, drawn[0].parameters
    other = four_bar((p["L1"], p["L2"], p["L3"]), p["L"], p["theta3"], -p["branch"])
    for each, same in ((problem, True), (other, False)):
        end = solve_dae(each.system, (0.0, 1.0), each.q0, each.v0, "DOP853", 1e-8, 1e-8).q[:, -1]
        assert (np.abs(end - q).max() <= 1e-5 * max(1.0, growth)) == same


def test_the_minimal_coordinate_takes_a_density_for_each_bar():
    given, known = ((1.0, 2.0, 1.5), 3.0, 0.0, -1), end_of(four_bar(), 0.3)
    same, heavy = (MinimalFourBar(*given, (1.0, rho, 1.0), 9.81).states([0.3])[0][:, 0] for rho in (1.0, 5.0))
    assert np.abs(same - known).max() < 1e-12 and np.abs(heavy - known).max() > 1e-4
    with pytest.raises(ValueError, match="density must be positive"):
        MinimalFourBar(*given, (1.0, -5.0, 1.0), 9.81)
