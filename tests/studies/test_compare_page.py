"""The page that compares solvers: its data are the rows, and what is chosen is drawn.

The script runs under node, where it is installed, in a document that has as much as the page asks of it and without the
plotting library.
"""

import json
import math
import re
from io import StringIO

import pandas as pd
import pytest

from studies import compare_page
from studies.bench import figures
from studies.bench.cli import REPORTS, StudyError
from tests.processes import run_node
from twoloop.rows import leaderboard
from twoloop.rows.row_format import text_of

STAMP = "# full work_precision; `made up`"
RUNS = [  # case, end, solver, family, called from, tolerance, repetition, CPU, status, message, evaluations, errors
    ("crane", 9.0, "RadauIIA5", "two-loop", "compiled", 1e-4, 0, 0.01, "REACHED_END", "", 100, 1e-4, -1e-5),
    ("crane", 9.0, "RadauIIA5", "two-loop", "compiled", 1e-4, 1, 0.03, "REACHED_END", "", 100, 1e-4, -1e-5),
    ("crane", 9.0, "RadauIIA5", "two-loop", "compiled", 1e-4, 2, 0.02, "REACHED_END", "", 100, 1e-4, -1e-5),
    ("crane", 9.0, "RadauIIA5", "two-loop", "compiled", 1e-8, 0, 0.2, "REACHED_END", "", 900, 1e-8, 1e-9),
    ("crane", 9.0, "IDA <C>", "SUNDIALS", "Python", 1e-4, 0, 0.5, "REACHED_END", "", 400, 2e-4, None),
    ("crane", 9.0, "IDA <C>", "SUNDIALS", "Python", 1e-8, 0, 9.0, "TIME_LIMIT", "Stopped. Try.", None, None, None),
    ("crane", 9.0, "BDF", "two-loop", "compiled", 1e-9, 0, 1.0, "REACHED_END", "", 5000, 1e-13, 1e-12),
    ("crane", 9.0, "Newmark", "two-loop", "compiled", 1e-4, 0, 4.0, "REACHED_END", "", 70, 1e-3, 1e-3),
    ("crane", 9.0, "LSODA", "SciPy", "Python", 1e-4, 0, 0.001, "REACHED_END", "", 50, 2.5, 1e-6),
    ("crane", 0.5, "RadauIIA5", "two-loop", "compiled", 1e-4, 0, 0.001, "REACHED_END", "", 50, 3e-5, 1e-6),
    ("swing", 1.0, "RadauIIA5", "two-loop", "compiled", 1e-4, 0, 0.001, "REACHED_END", "", 50, 3e-5, 1e-6),
]
COLUMNS = ["case", "t_end", "solver", "family", "called_from", "tol", "repeat", "call_s", "status", "message"]
COLUMNS += ["n_evaluations", "error_q", "energy"]
CRANE, SHORT, SWING = (f"{name} s (work_precision)" for name in ("crane, 9", "crane, 0.5", "swing, 1"))
LOOK = """
const said = [];
const line = ({ label, data, borderColor, pointStyle, pointRotation, borderDash }) => ({
  label, borderColor, pointStyle, pointRotation, dashed: borderDash.length > 0,
  told: data.map(point => told(point.run)), points: data.map(({ x, y }) => [x, y]) });
const look = () => said.push({ runs: element("runs").innerHTML, solvers: element("solvers").innerHTML,
  mechanism: state.mechanism, count: element("count").textContent, address: replaced,
  title: chart.options.plugins.title.text, lines: chart.data.datasets.map(line),
  axes: ["x", "y"].map(name => chart.options.scales[name].title.text) });
"""
IN_NODE = """
const elements = {}, listeners = {};
let replaced = null;
const empty = name => ({ innerHTML: "", textContent: "",
  addEventListener: (what, act) => { listeners[name + "." + what] = act; } });
globalThis.document = { getElementById: name => elements[name] ??= empty(name) };
globalThis.location = { hash: HASH };
globalThis.history = { replaceState: (a, b, hash) => { replaced = hash; } };
globalThis.Chart = class { constructor(canvas, config) { Object.assign(this, config); } destroy() {} };
const change = (name, value, checked) => { listeners[name + ".change"]({ target: { value, checked } }); look(); };
const press = name => { listeners[name + ".click"](); look(); };
"""


@pytest.fixture
def folder(tmp_path):
    rows = pd.DataFrame(RUNS, columns=COLUMNS).assign(floor=1e-12, violation_q=1e-15)
    rows["astray"] = rows["solver"] == "LSODA"
    (tmp_path / "work_precision.csv").write_text(f"{STAMP}\n{rows.to_csv(index=False)}")
    return tmp_path


def in_node(path, acts, address=""):
    """What the page shows at first and after each act."""
    script = re.findall(r"<script>(.*?)</script>", path.read_text(encoding="utf-8"), re.DOTALL)[-1]
    source = f"{IN_NODE.replace('HASH', json.dumps(address))}{script}{LOOK}"
    return run_node(f"{source}look();\n{acts}\nconsole.log(JSON.stringify(said));")


def points(shown):
    return {line["label"]: line["points"] for line in shown["lines"]}


def made(folder):
    compare_page.main(["--out", str(folder)])
    return folder / "compare.html"


def test_the_data_are_the_rows(folder):
    data = compare_page.page_data(*compare_page.read(folder))
    assert [each["name"] for each in data["mechanisms"]] == [CRANE, SHORT, SWING]
    assert [each["name"] for each in data["solvers"]] == ["RadauIIA5", "IDA <C>", "BDF", "Newmark", "LSODA"]
    place = {name: k for k, name in enumerate(data["columns"])}
    assert len(data["runs"]) == 9  # of the three repetitions the median
    first = data["runs"][0]
    assert [first[place[name]] for name in ("setting", "call_s", "error_q", "energy")] == ["tol 1e-4", 0.02, 1e-4, 1e-5]
    assert data["runs"][3][place["said"]] == "TIME_LIMIT: Stopped" and data["runs"][3][place["error_q"]] is None
    assert [run[place["said"]] for run in data["runs"] if run[place["error_q"]] == 2.5] == [
        "reached the end, but lost the motion"
    ]


def test_each_solver_has_a_look_of_its_own_that_of_the_figures_where_there_is_one():
    names = [*figures.STYLES, "a solver without a style", "a second one", "a third one"]
    looks = compare_page.looks({name: name for name in reversed(names)})
    assert len({tuple(look.values()) for look in looks.values()}) == len(names)
    for name in ("auto", "DOP853 (twoloop)", "IDA from C, stabilised"):
        assert looks[name]["color"] == figures.style(name)["color"]
    assert looks["BDF"] == {"color": figures.style("BDF")["color"], "point": "cross", "rotation": 0}


def test_solvers_have_the_names_of_the_figures(folder):
    """By what the default does on each mechanism; where that is not known, with the option."""
    path = folder / "work_precision.csv"
    rows = pd.read_csv(path, comment="#").replace({"solver": {"RadauIIA5": "auto", "BDF": "auto, compiled"}})
    path.write_text(f"{STAMP}\n{rows.to_csv(index=False)}")
    rows = compare_page.read(folder)[0]
    assert set(rows["solver"]) >= {"compiled=True", "compiled=False"}
    (folder / "work_precision.json").write_text(json.dumps({"with_code": ["crane"]}))
    rows = compare_page.read(folder)[0]
    names = {case: set(own["solver"]) for case, own in rows.groupby("case")}
    assert names["swing"] == {"the default"} and {"the default", "compiled=False"} < names["crane"]
    assert set(rows.loc[rows["solver"] == "the default", "look"]) == {"auto"}


def test_it_opens_on_the_four_bar(folder):
    path = folder / "work_precision.csv"
    path.write_text(path.read_text().replace("swing,1.0", "four-bar,10.0"))
    assert compare_page.page_data(*compare_page.read(folder))["opens"] == "four-bar, 10 s (work_precision)"


def test_the_first_view_has_the_best_of_ours_and_of_others(folder):
    (first,) = in_node(made(folder), "")
    # not the runs that failed, lost the motion or are below the floor; Newmark is beaten in both, error and cost
    assert points(first) == {"RadauIIA5": [[1e-8, 0.2], [1e-4, 0.02]], "IDA <C>": [[2e-4, 0.5]]}
    assert [line["dashed"] for line in first["lines"]] == [False, True]
    assert first["lines"][0]["told"][1] == [
        "RadauIIA5, tol 1e-4",
        "error 1e-4",
        "0.02 s, 100 evaluations",
        "called from compiled",
    ]
    assert "IDA &lt;C&gt;" in first["solvers"] and "IDA <C>" not in first["solvers"] + first["runs"]
    assert first["solvers"].count("<input") == 5 and first["solvers"].count("checked") == 2
    assert first["runs"].count("<tr>") == 1 + 4 and "TIME_LIMIT: Stopped" in first["runs"]
    assert first["count"].startswith("3 of 4 runs of 2 solvers (of 7 runs of 5) are drawn")
    assert first["runs"].index("0.02") < first["runs"].index("0.2<")  # the cheapest first


def test_choices(folder):
    acts = f"""
change("solvers", "RadauIIA5", false); change("solvers", "BDF", true); press("none"); press("all"); press("best");
change("error", "energy"); change("cost", "n_evaluations");
change("mechanism", "{SWING}"); change("mechanism", "{SHORT}");
"""
    _, hidden, with_bdf, none, everything, best, energy, counts, swing, short = in_node(made(folder), acts)
    assert list(points(hidden)) == list(points(with_bdf)) == ["IDA <C>"]  # the run of BDF is below the floor
    assert "show=IDA" in hidden["address"] and "show=BDF" in with_bdf["address"] and "show" not in best["address"]
    assert not none["lines"] and "No run of the solvers chosen" in none["title"][1] and none["runs"].count("<tr>") == 1
    assert list(points(everything)) == ["RadauIIA5", "IDA <C>", "Newmark"]
    assert everything["runs"].count("<tr>") == 1 + 7 and "but lost the motion" in everything["runs"]
    assert list(points(best)) == ["RadauIIA5", "IDA <C>"]
    assert list(points(energy)) == ["RadauIIA5", "BDF"]  # no floor for energies
    assert energy["axes"] == [compare_page.MEASURES["energy"], compare_page.COSTS["call_s"]]
    assert counts["axes"] == [compare_page.MEASURES["energy"], compare_page.COSTS["n_evaluations"]]
    assert (
        points(swing) == points(short) == {"RadauIIA5": [[1e-6, 50]]}
    )  # runs of another length are not among those of 9 s
    assert swing["mechanism"] == SWING and swing["solvers"].count("<input") == 1


def test_a_view_can_be_linked_to(folder):
    path = made(folder)
    *_, last = in_node(
        path, f'change("error", "energy"); change("mechanism", "{CRANE}"); change("solvers", "BDF", false);'
    )
    (again,) = in_node(path, "", address=last["address"])
    assert again == last and list(points(again)) == ["RadauIIA5"]
    (unknown,) = in_node(path, "", address="#mechanism=x&error=constructor&show=y")
    assert list(points(unknown)) == ["RadauIIA5", "IDA <C>"]


def test_the_saved_rows_of_the_reports_can_be_shown(tmp_path):
    kept: dict[str, float] = {}
    for name in compare_page.SOURCES:
        stamp, rest = (REPORTS / f"{name}.csv").read_text().split("\n", 1)
        rows = pd.read_csv(StringIO(rest), low_memory=False)
        in_phase = rows[rows["error_q"].notna() & ~rows.get("astray", pd.Series(False, rows.index)).isin((True,))]
        for case, error in in_phase.groupby("case")["error_q"].max().items():
            kept[str(case)] = max(error, kept.get(str(case), 0.0))
        some = ["four-bar", "very flexible beam", *rows["case"].unique()[::9]]  # all take twenty seconds
        (tmp_path / f"{name}.csv").write_text(f"{stamp}\n{rows[rows['case'].isin(some)].to_csv(index=False)}")
    path = made(tmp_path)
    data = json.loads(re.search(r"^const data = (.*?);?$", path.read_text(), re.MULTILINE)[1])
    assert data["opens"] == compare_page.OPENS
    looks = {(solver["color"], solver["point"], solver["rotation"]) for solver in data["solvers"]}
    assert len(looks) == len(data["solvers"]) > 15
    names = [each["name"] for each in data["mechanisms"]]
    acts = "".join(f"change('mechanism', {json.dumps(name)});" for name in names)
    for name, shown in zip(names, in_node(path, acts)[1:], strict=True):
        assert shown["lines"], name
        errors = [error for line in shown["lines"] for error, _ in line["points"]]
        assert "beam" not in name or max(errors) <= 1.01 * kept[name.rsplit(",", 1)[0]]  # without lost motions
        cells = re.sub(r'<td class="words">.*?</td>', "", shown["runs"])  # messages may speak of a NaN
        assert not re.search(r"NaN|Infinity|undefined", json.dumps(shown["lines"]) + cells), name
    assert math.isfinite(sum(each["floor"] for each in data["mechanisms"]))


def test_rows_of_files_are_beside_those_that_are_shipped(tmp_path):
    shipped = next(row for row in leaderboard.read_rows(leaderboard.ARCHIVE) if row["mechanism"] == "four_bar")
    mine = {name: shipped[name] for name in ("schema", "mechanism", "processor", "version")} | {"solver": "mine"}
    mine |= {"t_end": 10, "family": "me", "setting": "h", "value": 0.15, "status": "REACHED_END"}
    mine |= {"times_s": [0.3, 0.1, 0.2], "error_end": 1e-5, "floor_end": 1e-9}
    failed = {"value": 1, "status": "RAISED", "times_s": [], "error_end": None, "message": "it fell. Try"}
    (tmp_path / "mine.jsonl").write_text(text_of([mine, mine | failed]))
    files = ["archive", str(tmp_path / "mine.jsonl")]
    data = compare_page.page_data(*compare_page.read(tmp_path, files))
    place, names = {name: k for k, name in enumerate(data["columns"])}, [each["name"] for each in data["solvers"]]
    own = [run for run in data["runs"] if run[place["solver"]] == names.index("mine")]
    assert [[run[place[name]] for name in ("setting", "call_s", "error_q", "said")] for run in own] == [
        ["h 0.15", 0.2, 1e-5, ""],
        ["h 1.0", None, None, "RAISED: it fell"],
    ]
    (beside,) = {run[place["mechanism"]] for run in own}
    assert sum(run[place["mechanism"]] == beside for run in data["runs"]) > 100  # all on that processor
    assert data["mechanisms"][beside]["name"].startswith("four_bar, 10 s at the end, ")
    compare_page.main(["--out", str(tmp_path), "--with", *files])
    assert (tmp_path / "compare.html").stat().st_size > 300_000


def test_it_needs_rows(tmp_path):
    with pytest.raises(StudyError, match=r"there are no rows in .*: run python -m studies.work_precision first"):
        compare_page.read(tmp_path)
    (tmp_path / "validation.csv").write_text("# full validation\nx\n1\n")
    with pytest.raises(StudyError, match=r"validation.csv is damaged .*python -m studies.validation"):
        compare_page.read(tmp_path)
    with pytest.raises(SystemExit, match=r"^error: .*is damaged"):
        compare_page.main(["--out", str(tmp_path)])


def test_the_page_has_the_library_its_licence_and_the_stamps(folder):
    text = made(folder).read_text(encoding="utf-8")
    assert not re.search(r"\bsrc=|<link", text) and STAMP.removeprefix("# ") in text
    assert text.count("MIT License (MIT)") == 2 and "Chart.js v4" in text and "chartjs-plugin-zoom v2" in text
