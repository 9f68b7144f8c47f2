"""The code of the README and of docs/between_steps.md, as printed."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

mpl = pytest.importorskip("matplotlib")  # not among the oldest versions

ROOT = Path(__file__).parents[1]


def blocks(page):
    """The Python code of a page."""
    return [part.split("```")[0] for part in (ROOT / page).read_text(encoding="utf-8").split("```python\n")[1:]]


@pytest.fixture(scope="module")
def names(tmp_path_factory):
    """What the page on dense output defines, run in a folder of its own."""
    mpl.use("Agg")
    known, folder = {}, tmp_path_factory.mktemp("page")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for block in blocks("docs/between_steps.md"):
            exec(block, known)
            known.setdefault("results", []).append(known["result"])
    assert (folder / "impacts.png").stat().st_size > 10_000
    return known


def test_many_runs(tmp_path, monkeypatch):
    mpl.use("Agg")
    known = {}
    monkeypatch.chdir(tmp_path)
    for block in blocks("docs/many_runs.md"):
        exec(block, known)
    assert known["runs"].success.all() and known["q0"].shape == (2000, 9)
    assert known["result"].success and known["again"].success
    assert np.ptp(known["high"] - known["low"]) > 1e-3
    for picture in ("tolerances.png", "workspace.png"):
        assert (tmp_path / picture).stat().st_size > 5000


def test_dense_output(names):
    assert names["state"].q.shape == (9, 10_001)
    assert np.isfinite(names["state"].lam).all()
    assert (names["again"].sol(3.21).q == names["results"][0].sol(3.21).q).all()


def test_reactions(names):
    pin = names["pin"]
    assert pin.force.shape == (2, 1001)
    assert np.abs(pin.torque).max() < 1e-10 * np.abs(pin.force).max()
    assert names["clamp"].force[:, -1] == pytest.approx([0.0, 29.43], abs=1e-10)
    assert names["clamp"].torque[-1] == pytest.approx(14.715, abs=1e-10)


def test_the_third_event_ends_the_run(names):
    result = names["result"]
    assert result.status == 1
    assert result.t_events[0].size == 3
    assert np.abs(result.q_events[0][:, 8] - 1.0).max() < 1e-14
    assert (result.v_events[0][:, 8] > 0.0).all()


def test_impacts(names):
    arcs, problem = names["arcs"], names["problem"]
    assert [arc.status for arc in arcs] == [1] * (len(arcs) - 1) + [0]
    assert len(arcs) > 3
    for before, after in pairwise(arcs):
        assert abs(before.q[8, -1] - 1.0) < 1e-14
        assert after.t[0] == before.t[-1]
        assert after.v[8, 0] == pytest.approx(-0.6 * before.v[8, -1], rel=1e-12)
        # one degree of freedom: of the kinetic energy 0.36 is left
        q, v = before.q[:, -1], before.v[:, -1]
        kinetic = 0.5 * v @ problem.system.mass(0.0, q) @ v
        lost = problem.energy(before.t, before.q, before.v)[-1] - problem.energy(after.t, after.q, after.v)[0]
        assert lost == pytest.approx(0.64 * kinetic, rel=1e-9)
    assert max(arc.q[8].max() for arc in arcs) < 1.0 + 1e-14
    assert max(arc.sol(np.linspace(arc.t[0], arc.t[-1], 200)).q[8].max() for arc in arcs) < 1.0 + 1e-12


def test_the_code_of_the_readme(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for block in blocks("README.md"):
        exec(block, {})
    assert {path.name for path in tmp_path.iterdir()} == {"run.png", "run.html"}
