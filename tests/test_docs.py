"""The documentation and the README: their code as printed, links, statuses, the reference, and generated pages."""

import csv
import inspect
import re
import tomllib
from collections import Counter
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from tests.marks import slow
from tests.test_rooms import documentation
from twoloop import Status, ensemble, mechanisms, solve_dae
from twoloop.bodies import PlanarModel, SpatialModel
from twoloop.mechanisms import four_bar, pendulum
from twoloop.methods.presets import PRESETS
from twoloop.run.record import failure_link

mpl = pytest.importorskip("matplotlib")  # not among the oldest versions
ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted(page.stem for page in DOCS.glob("*.md"))
IN_EXAMPLES = (  # pages whose code tests/test_examples.py runs
    *("check_simulator", "coming_from_exudyn", "coming_from_mujoco", "coming_from_scipy", "coming_from_sundials"),
    *("controller", "fit_parameters", "from_a_file", "many_runs", "spatial_mechanism", "start"),
)
ELSEWHERE = {"compare": "studies/test_compare.py"} | dict.fromkeys(IN_EXAMPLES, "test_examples.py")
WITHOUT_CODE = {"benchmark", "errors", "faq", "glossary", "how_it_is_built", "method", "planted_errors", "reference"}
DEVELOPER = ["CONTRIBUTING.md", *(f"docs/{page}.md" for page in PAGES if page.startswith(("add_", "how_", "bench")))]
LINKED = sorted(
    path.relative_to(ROOT).as_posix()
    for pattern in ("*.md", "docs/*.md", "docs/reference/*.md", "reports/*.md", "examples/*.md")
    for path in ROOT.glob(pattern)
)


def text_of(page):
    """The text of a file of the repository."""
    return (ROOT / page).read_text(encoding="utf-8")


def blocks(page):
    """The Python code of a page."""
    return [part.split("```")[0] for part in text_of(page).split("```python\n")[1:]]


@pytest.fixture(scope="module")
def names(tmp_path_factory):
    """What the code of a page defines, run once, in a folder of its own; `_results`: `result` after each block."""
    mpl.use("Agg")
    made = {}

    def run(page):
        if page not in made:
            folder = tmp_path_factory.mktemp(page)
            made[page] = {"__name__": page, "_folder": folder, "_results": []}
            with pytest.MonkeyPatch.context() as patch:
                patch.chdir(folder)
                for block in blocks(f"docs/{page}.md"):
                    exec(block, made[page])
                    made[page]["_results"].append(made[page].get("result"))
        return made[page]

    return run


CODE = [page for page in PAGES if page not in ELSEWHERE]


@pytest.mark.parametrize("page", [slow(page) if page == "certificate" else page for page in CODE])
def test_the_code_of_a_page_runs(page, names, recwarn):
    assert (len(blocks(f"docs/{page}.md")) == 0) == (page in WITHOUT_CODE)
    names(page)


def test_code_that_is_run_elsewhere_is(names):
    for page, test in ELSEWHERE.items():
        assert f"docs/{page}.md" in (DOCS.parent / "tests" / test).read_text(encoding="utf-8")


def test_the_code_of_the_readme(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code = blocks("README.md")
    for block in code:
        exec(block, {})
    written = re.findall(r"\.(?:plot|animate)\(\"(\S+)\"", "\n".join(code))
    assert written and {path.name for path in tmp_path.iterdir()} == set(written)


# --- what the pages promise
def test_the_models_of_the_page_of_bodies(names):
    page = names("bodies")
    six, result = page["problem"], page["result"]
    assert result.success and six.freedom.degrees == 1 and not six.conserved
    bars = [np.linalg.norm(b - a, axis=0) for a, b in six.drawing.at(result.q)[np.array(six.drawing.bars[:-1])]]
    assert max(np.ptp(length) for length in bars) < 1e-9
    other = solve_dae(six.system, six.t_span, six.q0, six.v0, "RadauIIA9", rtol=1e-11, atol=1e-11)
    assert np.abs(other.q[:, -1] - result.q[:, -1]).max() < 1e-6
    assert "does not close" in str(page.get("error", "does not close")) and page["runs"].success.all()
    t, run = page["run"].t, page["run"]
    torque = 2.0 / 3.0 * -7.2 * np.sin(3.0 * t) + 9.81 * np.sin(0.8 * np.sin(3.0 * t))  # J a + m g l / 2 sin
    assert run.reactions("servo").torque == pytest.approx(torque, abs=1e-5)


def test_every_kind_of_constraint_does_what_its_section_says(names):
    page = names("constraints")
    assert "on which assembly" in str(page["error_text"])
    assert "docs/constraints.md#redundant-rows" in str(page["caught"][0].message)
    assert np.abs(page["bars"] - page["bars"][:, :1]).max() < 1e-9
    assert np.linalg.matrix_rank(page["system"].mass(0.0, page["q0"])) == 6
    slope = page["slide"].q[:, -1]
    scale = 9.81 * np.sin(0.4) / (2.0 * 1.7**2)
    assert slope == pytest.approx([scale * np.sin(17.0) ** 2, scale * (17.0 - 0.5 * np.sin(34.0)), 17.0], abs=1e-7)


def test_between_steps(names):
    page = names("between_steps")
    assert page["state"].q.shape == (9, 10_001) and np.isfinite(page["state"].lam).all()
    assert (page["again"].sol(3.21).q == page["_results"][0].sol(3.21).q).all()
    assert page["pin"].force.shape == (2, 1001) and np.abs(page["pin"].torque).max() < 1e-9
    assert page["clamp"].force[:, -1] == pytest.approx([0.0, 29.43], abs=1e-10)
    assert page["clamp"].torque[-1] == pytest.approx(14.715, abs=1e-10)
    result = page["result"]  # the third event ends it
    assert result.status == 1 and result.t_events[0].size == 3 and np.abs(result.q_events[0][:, 8] - 1.0).max() < 1e-14
    arcs = page["rebounds"].arcs
    assert len(arcs) > 3 and max(arc.q[8].max() for arc in arcs) < 1.0 + 1e-14
    for before, after in pairwise(arcs):
        assert abs(before.q[8, -1] - 1.0) < 1e-14 and after.t[0] == before.t[-1]
        assert after.v[8, 0] == pytest.approx(-0.6 * before.v[8, -1], rel=1e-12)
    assert page["landed"].q[1:, -1] == pytest.approx([0.2, 0.0], abs=1e-8)


def test_all_three_are_one_mechanism(names):
    page = names("your_mechanism")
    systems = page["plain"], page["compiled"], page["problem"].system
    generic = np.random.default_rng(2)
    for _ in range(5):
        q, v = generic.normal(size=3), generic.normal(size=3)
        for kind, state in (("mass", [q]), ("force", [q, v]), ("constraint", [q]), ("jacobian", [q])):
            first, *others = (system.evaluate(kind, 0.0, *state) for system in systems)
            assert all(np.abs(other - first).max() < 1e-13 * max(1.0, np.abs(first).max()) for other in others)
    ends = [solve_dae(s, (0.0, 2.0), page["q0"], page["v0"], rtol=1e-8, atol=1e-8).q[:, -1] for s in systems]
    assert np.ptp(ends, axis=0).max() < 1e-5 and page["problem"].q0 == pytest.approx(page["q0"], abs=1e-14)
    assert np.ptp(page["energy"]) < 1e-5


def test_the_drawing_of_the_page_is_its_mechanism(names):
    page, drawing = names("your_mechanism"), names("your_mechanism")["drawing"]
    run = solve_dae(page["compiled"], (0.0, 2.0), page["q0"], page["v0"], rtol=1e-8, atol=1e-8)
    lengths = [np.linalg.norm(b - a, axis=0) for a, b in drawing.at(run.q)[np.array(drawing.bars)]]
    assert lengths[0] == pytest.approx(page["r"], abs=1e-12) and lengths[1] == pytest.approx(page["l"], abs=1e-12)
    by_hand = page["total_energy"](run.t, run.q, run.v)
    assert by_hand == pytest.approx(page["problem"].energy(run.t, run.q, run.v), abs=1e-12)  # SymPy's
    assert "slider-crank" in (page["_folder"] / "slider_crank.html").read_text(encoding="utf-8")


def test_what_the_page_says_of_the_others(names):
    page = names("your_mechanism")
    assert page["problem"].conserved
    assert page["heavier"].system.given == page["problem"].system.given and page["heavier"].parameters["m3"] == 3.0


# --- statuses
@pytest.mark.parametrize("status", [status for status in Status if status < 0], ids=lambda status: status.name)
def test_every_failure_leads_to_a_section_with_cause_and_remedy(status):
    assert failure_link(status) == f" See docs/when_it_fails.md#{status.name.lower()}."
    text = (DOCS / "when_it_fails.md").read_text(encoding="utf-8")
    section = re.search(rf"### {status.name}\n(.*?)(?=\n##)", text, re.DOTALL)
    assert section is not None and {"**Cause.**", "**Remedy.**"} <= set(section[1].split())


def test_only_a_failed_run_names_its_section(names):
    result = names("when_it_fails")["result"]
    assert result.status is Status.MAX_STEPS and result.message.endswith(failure_link(Status.MAX_STEPS))
    assert failure_link(Status.REACHED_END) == failure_link(Status.EVENT) == ""


# --- developer pages
def test_the_method_of_the_page_has_order_five_and_keeps_tolerance_and_constraints(names):
    page, problem, errors = names("add_a_method"), pendulum(), []
    for h in (0.05, 0.025):
        method = page["DormandPrince5"]()
        end = solve_dae(problem.system, (0.0, 1.0), problem.q0, problem.v0, method, step_size=h).q[:, -1]
        errors.append(np.abs(end - problem.motion(1.0)[0]).max())
    assert 4.5 < np.log2(errors[0] / errors[1]) < 6.5
    system, result = four_bar().system, page["result"]
    assert result.success and result.method == "DormandPrince5" and page["error"] < 1e-6
    assert max(np.abs(system.constraint(t, q)).max() for t, q in zip(result.t, result.q.T, strict=True)) < 1e-13


def test_one_line_gives_the_method_of_the_page_a_name(names, monkeypatch):
    page, problem = names("add_a_method"), pendulum()
    run = problem.system, (0.0, 1.0), problem.q0, problem.v0
    monkeypatch.setitem(PRESETS, "DormandPrince5", page["DormandPrince5"]())
    result, dense = solve_dae(*run, "DormandPrince5"), solve_dae(*run, "DormandPrince5", dense_output=True)
    assert result.method == "DormandPrince5" and np.abs(result.q[:, -1] - problem.motion(1.0)[0]).max() < 1e-5
    assert np.abs(dense.sol(0.7).q - problem.motion(0.7)[0]).max() < 1e-4
    runs = ensemble(*run[:2], np.tile(run[2], (3, 1)), run[3], method="DormandPrince5")
    assert runs.success.all() and runs.singly.all() and np.abs(runs.q[:, :, -1] - result.q[:, -1]).max() == 0.0


def test_the_solver_of_the_page_has_order_two_and_is_a_line_of_the_benchmark(names):
    page = names("add_a_solver_or_study")
    errors = np.array(page["errors"])
    assert np.abs(errors[:-1] / errors[1:] - 4.0).max() < 0.1
    (line,) = page["LINES"]
    problem = four_bar()
    run = line.solve(problem.system, (0.0, 1.0), problem.q0, problem.v0, step=1e-3)
    assert run.success and run.stats.n_accepted == 1000
    assert not line.solve(problem.system, (0.0, 1.0), problem.q0, problem.v0, step=1e-4, time_limit=1e-6).success


@pytest.mark.parametrize("page", DEVELOPER)
def test_files_that_a_page_names_exist(page):
    named = set(re.findall(r"`((?:twoloop|references|studies|tests|docs|kernels|examples)/[\w/.]+)`", text_of(page)))
    missing = [name for name in named if not (ROOT / name).exists() and not (ROOT / "twoloop" / name).exists()]
    assert missing == []


def test_how_it_is_built_lists_the_layers_in_the_order_of_imports():
    table = text_of("docs/how_it_is_built.md").split("## Layers")[1].split("\n## ")[0]
    listed = [
        name.replace("/", ".").removesuffix(".py").strip(".") for name in re.findall(r"^\| \**`(\S+)`", table, re.M)
    ]
    layers = documentation("rooms").ROOMS
    assert Counter(listed) == Counter(layers)
    assert [name for name in listed if name not in ("rows", "audit")] == [
        name for name in layers if name not in ("rows", "audit")
    ]  # neither of the two imports the other


def test_the_glossary_has_at_most_fifty_words_in_order():
    words = re.findall(r"^\| ([\w][^|]*) \| (?!---)", text_of("docs/glossary.md"), re.MULTILINE)[1:]
    assert 30 <= len(words) <= 50 and [word.lower() for word in words] == sorted(word.lower() for word in words)


# --- the reference has an entry for all that a user can import
ENTRIES = set(re.findall(r"^- `([\w.]+)`: ", text_of("docs/reference.md"), re.MULTILINE))


@pytest.mark.parametrize("package", [f"twoloop{name}" for name in ("", ".audit", ".bodies", ".symbolic", ".testing")])
def test_every_name_of_a_package_has_an_entry(package):
    module = pytest.importorskip(package, exc_type=ImportError)
    assert {f"{package}.{name}" for name in module.__all__} <= ENTRIES


def test_so_has_every_method_that_a_name_stands_for():
    kinds = {type(method).__qualname__ for method in PRESETS.values()}
    assert kinds <= {entry.rpartition(".")[2] for entry in ENTRIES}


def test_the_build_replaces_every_entry_by_its_docstring():
    for_sphinx = documentation("for_sphinx")
    text = for_sphinx.with_docstrings(text_of("docs/reference.md"))
    directives = dict(re.findall(r"^\.\. auto(\w+):: (\S+)$", text, re.MULTILINE)[::-1])
    assert set(re.findall(r"^\.\. auto\w+:: (\S+)$", text, re.MULTILINE)) == ENTRIES
    assert set(directives) == {"module", "exception", "class", "function"} and set(for_sphinx.MEMBERS) <= ENTRIES


# --- links
@cache
def anchors(path):
    """The anchors of the headings of a page, as GitHub names them; a repeated one gets a number."""
    seen, found = Counter(), set()
    text = re.sub(r"^```.*?^```", "", path.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    for heading in re.findall(r"^#+ +(.*?) *#*$", text, re.MULTILINE):
        plain = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", heading)
        slug = re.sub(r"[^\w\- ]", "", plain.lower()).replace(" ", "-")
        found.add(f"{slug}-{seen[slug]}" if seen[slug] else slug)
        seen[slug] += 1
    return found


def dead_links(page):
    """The relative links of a page, pictures among them, whose file or heading does not exist."""
    text = re.sub(r"^```.*?^```|`[^`\n]*`", "", text_of(page), flags=re.MULTILINE | re.DOTALL)
    for link in re.findall(r"\]\(([^)\s]+)", text):
        if not re.match(r"\w+:", link):
            file, _, anchor = link.partition("#")
            target = (ROOT / page).parent / file if file else ROOT / page
            if not target.exists() or (anchor and (target.suffix != ".md" or anchor not in anchors(target.resolve()))):
                yield link


@pytest.mark.parametrize("page", LINKED)
def test_every_link_leads_to_a_file_and_a_heading(page):
    assert list(dead_links(page)) == []


def test_messages_and_comments_name_pages_that_exist():
    sources = [path for folder in ("twoloop", "references", "studies") for path in (ROOT / folder).rglob("*.py")]
    named = {
        link
        for path in sources
        for link in re.findall(r"\b(docs/\w+\.md(?:#[\w-]+)?)", path.read_text(encoding="utf-8"))
    }
    assert named
    for link in named:
        file, _, anchor = link.partition("#")
        assert (ROOT / file).is_file() and (not anchor or anchor in anchors(ROOT / file)), link


def test_pages_are_plain_markdown_and_use_the_words_of_the_glossary():
    for page in LINKED:
        text = text_of(page)
        assert not re.search(r"^(:::|```\{|---$)", text, re.MULTILINE), page
        assert not re.search(r"rival|rows not kept", text, re.IGNORECASE), page


@pytest.mark.parametrize(
    ("pattern", "words"),
    [
        ("README.md", 900),
        ("CHANGELOG.md", 1200),
        ("CONTRIBUTING.md", 1200),
        ("docs/*.md", 22_000),
        ("reports/*.md", 7500),
    ],
)
def test_pages_stay_short(pattern, words):
    pages = [path for path in ROOT.glob(pattern) if path.name != "errors.md"]  # a list for searching
    assert 0 < sum(len(path.read_text(encoding="utf-8").split()) for path in pages) <= words


def test_the_menu_has_every_page_once():
    for_sphinx = documentation("for_sphinx")
    pages = Counter(page for _, section in for_sphinx.menu(text_of("docs/index.md")) for page in section)
    reference = {f"reference/{path.stem}" for path in (DOCS / "reference").glob("*.md")}
    reports = {f"../reports/{path.stem}" for path in (ROOT / "reports").glob("*.md")}
    assert {*PAGES, *reference, *reports} - {"index", "errors"} <= set(pages) and set(pages.values()) == {1}
    assert for_sphinx.with_menu(text_of("docs/index.md")).count("```{toctree}") == 7


# --- pages that follow from the code
@pytest.mark.parametrize("name", ["gallery", "joints", "command_line"])
def test_committed_pages_are_what_the_code_gives(name):
    documentation("shapes")
    assert text_of(f"docs/reference/{name}.md") == documentation(name).text(), "renew it: python docs/generate.py"


def test_the_page_of_joints_shows_every_joint():
    plane, space = text_of("docs/reference/joints.md").split("## In space")
    for text, model in ((plane, PlanarModel), (space, SpatialModel)):
        methods = inspect.getmembers(model, inspect.isfunction)
        joints = {name for name, method in methods if inspect.signature(method).return_annotation == "ModelJoint"}
        shown = set(re.findall(r"model\.(\w+)\(", text))
        assert {name for name in joints if name[0] != "_"} - {"drive", "drive_point"} == shown
    assert "With it, the body has 1 degree of freedom" in plane
    assert "With it, the body has 5 degrees of freedom" in space


def test_a_joint_is_drawn_by_moving_it(tmp_path, monkeypatch):
    documentation("shapes")
    joints = documentation("joints")
    monkeypatch.setattr(joints, "STEPS", 3)
    revolute = joints.PLANAR[0]
    model, problem = joints.problem_of(revolute, joints.planar)
    first, *_, last = joints.positions(revolute, model, problem)
    assert (last == problem.q0).all() and np.abs(first - last).max() > 0.1
    assert np.abs(problem.system.constraint(0.0, first)).max() < 1e-12
    joints.picture(revolute, model, problem, tmp_path / "joint.png")
    assert (tmp_path / "joint.png").stat().st_size > 1000
    forbidden = replace(revolute, motions=({"b": (1.0, 0.0, 0.0)},))
    with pytest.raises(ValueError, match="is not free"):
        list(joints.positions(forbidden, *joints.problem_of(forbidden, joints.planar)))


MAKERS = {name for name in mechanisms.__all__ if name[0].islower()} - {"ancf_beam"}


def test_the_gallery_shows_every_ready_mechanism():
    text = text_of("docs/reference/gallery.md")
    assert set(re.findall(r"^## (\w+)$", text, re.MULTILINE)) == MAKERS and text.count("- *Tests*: ") == len(MAKERS)


@pytest.mark.slow
def test_the_gallery_animates_every_ready_mechanism(tmp_path, monkeypatch):
    documentation("shapes")
    gallery = documentation("gallery")
    text = text_of("docs/reference/gallery.md")
    monkeypatch.setattr(gallery, "LONGEST", 0.01)  # s: whole motions are for the build
    gallery.animate(tmp_path)
    assert {file.stem for file in tmp_path.iterdir()} == MAKERS
    shown = documentation("for_sphinx").with_animations(text)
    assert set(re.findall(r'src="\.\./animations/(\w+)\.html"', shown)) == MAKERS and "![" not in shown
    problem = four_bar()
    gallery.picture(problem, gallery.motion(problem), tmp_path / "four_bar.png")
    assert (tmp_path / "four_bar.png").stat().st_size > 1000


def test_columns_that_several_files_share_are_explained():
    explained_here = set(re.findall(r"`(\w+)`(?=[^|\n]*\|[^|\n]+\|$)", text_of("docs/reference/csv_columns.md"), re.M))
    files = Counter()
    for path in (ROOT / "reports").glob("*.csv"):
        lines = path.read_text(encoding="utf-8").splitlines()
        files.update(next(csv.reader(line for line in lines if not line.startswith("#"))))
    assert {column for column, count in files.items() if count >= 4} <= explained_here


def test_the_citation_file_has_no_address_that_is_not_there():
    assert not re.search(r"example\.|TODO|<.*>", text_of("CITATION.cff"))
    urls = tomllib.loads(text_of("pyproject.toml"))["project"].get("urls", {})
    assert not any("example" in url or "OWNER" in url for url in urls.values())
