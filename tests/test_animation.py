"""Animations: pages, GIFs and films of results. No browser is needed: the script of a page runs under node."""

import re
import stat
import sys

import pytest

from tests.processes import run_node
from twoloop import solve_dae
from twoloop.mechanisms import pendulum, spatial_slider_crank

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
    problem = pendulum()
    return solve_dae(problem.system, (0.0, 1.0), problem.q0, problem.v0)


@pytest.fixture(scope="module")
def crank():
    problem = spatial_slider_crank()
    return solve_dae(problem.system, (0.0, 0.2), problem.q0, problem.v0, dense_output=True)


def played(path):
    script = re.search(r"<script>(.*)</script>", path.read_text(encoding="utf-8"), re.DOTALL)[1]
    return run_node(f"{DOCUMENT}{script}{PLAYED}")


def test_the_script_of_a_planar_page(swung, tmp_path):
    said = played(swung.animate(tmp_path / "swing.html"))
    assert [said[when] for when in ("first", "second", "paused", "chosen")] == [
        "t = 0.00 s",
        "t = 0.333 s",  # after a second of three
        "t = 0.333 s",
        "t = 0.0400 s",
    ]
    calls = [name for name, *_ in said["drawn"]]
    assert calls.count("fillRect") == 1 and calls.count("arc") == 1 and "lineTo" in calls
    assert all(x is not None for _, *numbers in said["drawn"] for x in numbers)  # NaN is null in JSON
    (_, x, y, _, _), *_ = [call for call in said["drawn"] if call[0] == "fillRect"]
    assert 0 < x < 1440 and 0 < y < 960


def test_a_spatial_page_can_be_turned(crank, tmp_path):
    said = played(crank.animate(tmp_path / "crank.html", seconds=1.0))
    lines = [call for call in said["turned"] if call[0] == "lineTo"]
    assert lines and all(0 < x < 1440 and 0 < y < 960 for _, x, y in lines)
    first = [call for call in said["drawn"] if call[0] == "lineTo"]
    assert first[0] != lines[0]


def test_a_film_is_what_ffmpeg_gets(crank, tmp_path, monkeypatch):
    """A program in the place of ffmpeg, which this machine may not have, writes down what it was given."""
    program = tmp_path / "ffmpeg"
    program.write_text(
        f"#!{sys.executable}\nimport sys\n"
        "open(sys.argv[-1], 'w').write(f'{len(sys.stdin.buffer.read())} ' + ' '.join(sys.argv[1:]))\n"
    )
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", str(tmp_path))
    n_bytes, *words = crank.animate(tmp_path / "crank.mp4", seconds=0.2).read_text().split()
    width, height = map(int, words[words.index("-s") + 1].split("x"))
    assert int(n_bytes) == 6 * width * height * 3
    program.write_text(f"#!{sys.executable}\nimport sys\nsys.exit('no codec')\n")
    with pytest.raises(RuntimeError, match=r"ffmpeg could not write.*no codec"):
        crank.animate(tmp_path / "crank.mp4", seconds=0.2)
    program.unlink()
    with pytest.raises(RuntimeError, match=r"needs the program ffmpeg.*or write \.gif, \.html"):
        crank.animate(tmp_path / "crank.mp4", seconds=0.2)
