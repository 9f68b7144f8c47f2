"""Results as tables and figures: names, energy, violation; and results in other processes."""

import pickle
import re
from dataclasses import replace

import numpy as np
import pytest

import twoloop
from tests.problems import pendulum, run, swing
from tests.processes import run_node
from twoloop import mechanisms, solve_dae
from twoloop.result.views import violation

pytest.importorskip("pandas")  # not among the oldest versions
pytest.importorskip("matplotlib")


@pytest.fixture(scope="module")
def result(default_four_bar):
    return run(default_four_bar, 0.5)


def test_a_table_with_the_names_of_the_mechanism(result, default_four_bar):
    table = result.to_dataframe()
    assert table.index.name == "t (s)" and len(table.columns) == 3 * 9 + 8 + 1
    np.testing.assert_array_equal(table.index, result.t)
    np.testing.assert_array_equal(table["angle (rad) of bar 3"], result.q[8])
    np.testing.assert_array_equal(table["angle of bar 3, velocity (rad/s)"], result.v[8])
    np.testing.assert_array_equal(table["x of bar 1, acceleration (m/s^2)"], result.a[0])
    np.testing.assert_array_equal(table["lam7"], result.lam[7])
    np.testing.assert_array_equal(table["energy (J)"], default_four_bar.energy(result.t, result.q, result.v))


def test_energy_needs_a_problem(result, default_four_bar):
    assert result.energy.shape == result.t.shape and np.ptp(result.energy) < 1e-6
    with pytest.raises(ValueError, match=r"this result knows no energy: put the system into a problem"):
        assert swing().energy is None
    foreign = replace(result, system=None)
    with pytest.raises(ValueError, match=r"dataclasses.replace\(result, system=problem.system\)"):
        assert foreign.energy is None
    np.testing.assert_array_equal(replace(foreign, system=default_four_bar.system).energy, result.energy)


def test_a_result_from_a_file_knows_what_its_system_knows(result, default_four_bar, tmp_path):
    result.save(tmp_path / "run.npz")
    assert twoloop.load(tmp_path / "run.npz").coordinates[0] == "q0"
    table, loaded = result.to_dataframe(), twoloop.load(tmp_path / "run.npz", default_four_bar.system).to_dataframe()
    assert list(loaded.columns) == list(table.columns)
    np.testing.assert_allclose(
        loaded, table, rtol=1e-13
    )  # of another layout in memory, the energy is rounded otherwise


def test_panels_for_units_energy_and_violation(result, tmp_path):
    figure = result.plot(tmp_path / "run.png")
    assert (tmp_path / "run.png").read_bytes().startswith(b"\x89PNG")
    assert max(figure.get_size_inches()) < 12.0  # fits a page
    labels = [panel.get_ylabel() for panel in figure.axes]
    assert labels == ["q (m)", "q (rad)", "energy − start (J)", "largest violation"] and len(figure.axes[0].lines) == 6
    np.testing.assert_array_equal(figure.axes[1].lines[2].get_ydata(), result.q[8])
    np.testing.assert_array_equal(figure.axes[2].lines[0].get_ydata(), result.energy - result.energy[0])


def test_violation_is_that_of_the_rows(result, default_four_bar):
    q, v = result.q.copy(), result.v.copy()
    q[0, 3] += 1e-3
    v[1, 5] += 1e-2
    positions, velocities = violation(replace(result, q=q, v=v))
    assert positions[3] == pytest.approx(1e-3) and velocities[5] == pytest.approx(1e-2)
    assert np.delete(positions, 3).max() < 1e-12 and np.delete(velocities, [3, 5]).max() < 1e-12


def test_results_of_lambdas_travel_without_their_system():
    done = solve_dae(pendulum(force=lambda t, q, v: np.array([0.0, -1.0])), (0.0, 0.1), [-1.0, 0.0], [0.0, 0.0])
    unpickled = pickle.loads(pickle.dumps(done))
    assert unpickled.system is None and done.system is not None
    np.testing.assert_array_equal(unpickled.q, done.q)


# --- animations: pages, GIFs and films of results. No browser is needed: the script of a page runs under node
pytest.importorskip("PIL")  # not among the oldest versions
# a document with what the page asks of it; counts what is drawn, and lets time pass frame by frame
DOCUMENT = """
const elements = {};
let drawn = [], due = null, listeners = {};
const brush = new Proxy({}, {
  get: (known, name) => known[name] ?? ((...numbers) => drawn.push([name, ...numbers])),
  set: (known, name, value) => { known[name] = value; return true; }
});
const element = name => ({
  width: 1440, height: 960, getContext: () => brush,
  addEventListener: (what, act) => { listeners[name + "." + what] = act; }
});
globalThis.document = { getElementById: name => elements[name] ??= element(name) };
globalThis.addEventListener = (what, act) => { listeners[what] = act; };
globalThis.requestAnimationFrame = act => { due = act; };
"""
PLAYED = """
const said = {first: elements.time.textContent, drawn: [...drawn]};
due(0);
due(1000);
said.second = elements.time.textContent;
listeners["play.click"]();
due(2000);
said.paused = elements.time.textContent;
elements.frame.value = "3";
listeners["frame.input"]();
said.chosen = elements.time.textContent;
if (listeners["view.pointerdown"]) {
  drawn = [];
  listeners["view.pointerdown"]({clientX: 0, clientY: 0});
  listeners["view.pointermove"]({clientX: 100, clientY: 20});
  said.turned = drawn;
}
console.log(JSON.stringify(said));
"""


@pytest.fixture(scope="module")
def swung():
    problem = mechanisms.pendulum()
    return solve_dae(problem.system, (0.0, 1.0), problem.q0, problem.v0)


@pytest.fixture(scope="module")
def crank():
    problem = mechanisms.spatial_slider_crank()
    return solve_dae(problem.system, (0.0, 0.2), problem.q0, problem.v0, dense_output=True)


def played(path):
    script = re.search(r"<script>(.*)</script>", path.read_text(encoding="utf-8"), re.DOTALL)[1]
    return run_node(f"{DOCUMENT}{script}{PLAYED}")


def test_the_script_of_a_planar_page(swung, tmp_path):
    drawing = played(swung.animate(tmp_path / "swing.html"))
    times = [drawing[when] for when in ("first", "second", "paused", "chosen")]  # the second after a second of three
    assert times == ["t = 0.00 s", "t = 0.333 s", "t = 0.333 s", "t = 0.0400 s"]
    calls = [name for name, *_ in drawing["drawn"]]
    assert calls.count("fillRect") == 1 and calls.count("arc") == 1 and "lineTo" in calls
    assert all(x is not None for _, *numbers in drawing["drawn"] for x in numbers)  # NaN is null in JSON
    (_, x, y, _, _), *_ = [call for call in drawing["drawn"] if call[0] == "fillRect"]
    assert 0 < x < 1440 and 0 < y < 960


def test_a_spatial_page_can_be_turned(crank, tmp_path):
    drawing = played(crank.animate(tmp_path / "crank.html", seconds=1.0))
    lines = [call for call in drawing["turned"] if call[0] == "lineTo"]
    assert lines and all(0 < x < 1440 and 0 < y < 960 for _, x, y in lines)
    first = [call for call in drawing["drawn"] if call[0] == "lineTo"]
    assert first[0] != lines[0]
