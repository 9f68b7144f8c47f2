"""The page that compares solvers: its data are the rows, and its script draws what is chosen.

No browser is needed: the script runs under node, in a document that has as much as the page asks of it.
"""

import json
import math
import re
import shutil
import subprocess

import pandas as pd
import pytest

from studies import compare_page
from studies.cli import REPORTS, StudyError

STAMP = "# full work_precision; `made up`"
RUNS = [  # case, solver, family, called from, tolerance, repetition, CPU, status, message, evaluations, error, energy
    ("crane", "Adams", "two-loop", "compiled", 1e-4, 0, 0.01, "REACHED_END", "", 100, 1e-4, -1e-5),
    ("crane", "Adams", "two-loop", "compiled", 1e-4, 1, 0.03, "REACHED_END", "", 100, 1e-4, -1e-5),
    ("crane", "Adams", "two-loop", "compiled", 1e-4, 2, 0.02, "REACHED_END", "", 100, 1e-4, -1e-5),
    ("crane", "Adams", "two-loop", "compiled", 1e-8, 0, 0.2, "REACHED_END", "", 900, 1e-8, 1e-9),
    ("crane", "IDA <C>", "SUNDIALS", "Python", 1e-4, 0, 0.5, "REACHED_END", "", 400, 2e-4, None),
    ("crane", "IDA <C>", "SUNDIALS", "Python", 1e-8, 0, 9.0, "TIME_LIMIT", "Stopped. Try.", None, None, None),
    ("crane", "BDF", "two-loop", "compiled", 1e-9, 0, 1.0, "REACHED_END", "", 5000, 1e-13, 1e-12),
    ("swing", "Adams", "two-loop", "compiled", 1e-4, 0, 0.001, "REACHED_END", "", 50, 3e-5, 1e-6),
]
COLUMNS = ["case", "solver", "family", "called_from", "tol", "repeat", "call_s", "status", "message"]
COLUMNS += ["n_evaluations", "error_q", "energy"]
DOCUMENT = """
const elements = {}, listeners = {};
let replaced = null;
const empty = name => ({ innerHTML: "", textContent: "",
  addEventListener: (what, act) => { listeners[name + "." + what] = act; } });
globalThis.document = { getElementById: name => elements[name] ??= empty(name) };
globalThis.location = { hash: HASH };
globalThis.history = { replaceState: (a, b, hash) => { replaced = hash; } };
const said = [];
const look = () => said.push({ chart: elements.chart.innerHTML, runs: elements.runs.innerHTML, address: replaced,
  solvers: elements.solvers.innerHTML, mechanism: elements.mechanism.innerHTML, count: elements.count.textContent });
const change = (name, value, checked) => { listeners[name + ".change"]({ target: { value, checked } }); look(); };
const press = name => { listeners[name + ".click"](); look(); };
"""


@pytest.fixture
def folder(tmp_path):
    rows = pd.DataFrame(RUNS, columns=COLUMNS).assign(floor=1e-12, violation_q=1e-15)
    (tmp_path / "work_precision.csv").write_text(f"{STAMP}\n{rows.to_csv(index=False)}")
    return tmp_path


def played(path, acts, address=""):
    """What the page shows at first and after each act."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("node is not installed")
    script = re.search(r"<script>(.*)</script>", path.read_text(encoding="utf-8"), re.DOTALL)[1]
    document = DOCUMENT.replace("HASH", json.dumps(address))
    source = f"{document}{script}\nlook();\n{acts}\nconsole.log(JSON.stringify(said));"
    done = subprocess.run([node, "-"], input=source, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def circles(shown):
    return re.findall(r'<circle cx="([\d.]+)" cy="([\d.]+)".*?<title>(.*?)</title>', shown["chart"])


def made(folder):
    compare_page.main(["--out", str(folder)])
    return folder / "compare.html"


def test_the_data_are_the_rows(folder):
    data = compare_page.page_data(*compare_page.read(folder))
    assert [each["name"] for each in data["mechanisms"]] == ["crane (work_precision)", "swing (work_precision)"]
    assert [each["name"] for each in data["solvers"]] == ["Adams", "IDA <C>", "BDF"]
    place = {name: k for k, name in enumerate(data["columns"])}
    assert len(data["runs"]) == 6  # of the three repetitions the median
    first = data["runs"][0]
    assert [first[place[name]] for name in ("setting", "call_s", "error_q", "energy")] == ["tol 1e-4", 0.02, 1e-4, 1e-5]
    assert data["runs"][3][place["said"]] == "TIME_LIMIT: Stopped"
    assert data["runs"][3][place["error_q"]] is None


def test_first_view(folder):
    (first,) = played(made(folder), "")
    drawn = circles(first)
    assert len(drawn) == 3  # neither the run that failed, nor the one below the floor
    assert "Adams, tol 1e-4: error 1.0e-4, 0.02 s, 100 evaluations" in {title for *_, title in drawn}
    assert "IDA &lt;C&gt;" in first["chart"] and "IDA <C>" not in first["chart"] + first["solvers"] + first["runs"]
    assert first["runs"].count("<tr>") == 1 + 5 and "TIME_LIMIT: Stopped" in first["runs"]
    assert first["count"].startswith("3 of 5 runs are drawn")
    assert first["chart"].count("<polyline") == 2 and "NaN" not in first["chart"]
    places = {title.split(":")[0]: (float(x), float(y)) for x, y, title in drawn}
    assert places["Adams, tol 1e-8"][0] < places["Adams, tol 1e-4"][0] < places["IDA &lt;C&gt;, tol 1e-4"][0]
    assert places["Adams, tol 1e-4"][1] > places["Adams, tol 1e-8"][1]  # cheaper is below
    assert first["runs"].index("0.02") < first["runs"].index("0.2<")  # the cheapest first


def test_choices(folder):
    acts = """
change("solvers", "Adams", false); change("solvers", "Adams", true); press("none"); press("all");
change("error", "energy"); change("cost", "n_evaluations"); change("mechanism", "swing (work_precision)");
"""
    _, hidden, back, none, everything, energy, counts, swing = played(made(folder), acts)
    assert [len(circles(shown)) for shown in (hidden, back, none, everything)] == [1, 3, 0, 3]
    assert "No run of the solvers chosen" in none["chart"] and "hide=Adams" in hidden["address"]
    assert len(circles(energy)) == 3 and "energy error (J)" in energy["chart"]  # BDF's too: no floor for energies
    assert "evaluations" in counts["chart"] and "CPU time" not in counts["chart"]
    assert len(circles(swing)) == 1 and "IDA" not in swing["solvers"]
    assert 'value="swing (work_precision)" selected' in swing["mechanism"]


def test_a_view_can_be_linked_to(folder):
    path = made(folder)
    *_, last = played(path, 'change("error", "energy"); change("solvers", "BDF", false);')
    (again,) = played(path, "", address=last["address"])
    assert again == last
    (unknown,) = played(path, "", address="#mechanism=x&error=constructor&hide=y")
    assert len(circles(unknown)) == 3


@pytest.mark.skipif(
    any(
        "call_s" not in (REPORTS / f"{name}.csv").read_text().split("\n")[1].split(",") for name in compare_page.SOURCES
    ),
    reason="the reports are not made again since the whole call is timed",
)
def test_the_saved_rows_of_the_reports_can_be_shown(tmp_path):
    for name in compare_page.SOURCES:
        shutil.copy(REPORTS / f"{name}.csv", tmp_path)
    path = made(tmp_path)
    data = json.loads(re.search(r"^const data = (.*?);?$", path.read_text(), re.MULTILINE)[1])
    assert len(data["mechanisms"]) > 20 and path.stat().st_size < 1_000_000
    names = [each["name"] for each in data["mechanisms"]][::10]
    acts = "".join(f"change('mechanism', {json.dumps(name)});" for name in names)
    for name, shown in zip(names, played(path, acts)[1:], strict=True):
        assert circles(shown), name
        cells = re.sub(r'<td class="words">.*?</td>', "", shown["runs"])  # messages may speak of a NaN
        assert not re.search(r"NaN|Infinity|undefined", shown["chart"] + cells), name
        assert all(0.0 <= float(x) <= 860.0 and 0.0 <= float(y) <= 520.0 for x, y, _ in circles(shown))
    assert math.isfinite(sum(each["floor"] for each in data["mechanisms"]))


def test_it_needs_rows(tmp_path):
    with pytest.raises(StudyError, match=r"there are no rows in .*: run python -m studies.work_precision first"):
        compare_page.read(tmp_path)
    (tmp_path / "validation.csv").write_text("# full validation\nx\n1\n")
    with pytest.raises(StudyError, match=r"validation.csv is damaged .*python -m studies.validation"):
        compare_page.read(tmp_path)
    with pytest.raises(SystemExit, match=r"^error: .*is damaged"):
        compare_page.main(["--out", str(tmp_path)])


def test_the_page_needs_no_other_file(folder):
    text = made(folder).read_text(encoding="utf-8")
    assert not re.search(r"https?:|src=|<link", text)
    assert STAMP.removeprefix("# ") in text
