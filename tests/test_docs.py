"""The documentation and the README: their code as printed, links, what they say of every status, generated pages."""

import inspect
import re
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from tests.test_rooms import documentation
from tests.testing.planted import FAULTS
from twoloop import Result, Status, mechanisms, solve_dae
from twoloop.bodies import PlanarModel, SpatialModel
from twoloop.methods.presets import PRESETS
from twoloop.run.record import explained

mpl = pytest.importorskip("matplotlib")  # not among the oldest versions
ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted(page.stem for page in DOCS.glob("*.md"))
ELSEWHERE = {"compare": "studies/test_compare.py"}  # whose code other tests run
WITHOUT_CODE = {"errors", "how_it_is_built", "method", "reference"}


def blocks(page):
    """The Python code of a page."""
    return [part.split("```")[0] for part in (ROOT / page).read_text(encoding="utf-8").split("```python\n")[1:]]


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


def pictures(page):
    """Sizes of the pictures that the code of a page has written."""
    return {path.name: path.stat().st_size for path in page["_folder"].glob("*.png")}


@pytest.mark.parametrize("page", [page for page in PAGES if page not in ELSEWHERE])
def test_the_code_of_a_page_runs(page, names, recwarn):
    assert (len(blocks(f"docs/{page}.md")) == 0) == (page in WITHOUT_CODE)
    names(page)


def test_code_that_is_run_elsewhere_is(names):
    for page, test in ELSEWHERE.items():
        assert f"docs/{page}.md" in (DOCS.parent / "tests" / test).read_text(encoding="utf-8")


def test_the_code_of_the_readme(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for block in blocks("README.md"):
        exec(block, {})
    assert {path.name for path in tmp_path.iterdir()} == {"run.png", "run.html"}


# --- what the pages promise
def test_start_here_has_the_right_motion(names):
    page = names("start")
    assert page["result"].success and page["other"].success and page["error"] < 1e-7 and page["violation"] < 1e-13
    assert np.ptp(page["energies"]) < 1e-6
    drawing, corners = page["problem"].drawing, [page[name] for name in "OABD"]
    ends = drawing.at(page["result"].q)[np.array(drawing.bars)]
    bars = sorted(np.linalg.norm(b - a, axis=0).mean() for a, b in ends)
    assert bars == pytest.approx(sorted(np.linalg.norm(np.subtract(b, a)) for a, b in pairwise(corners)))
    assert page["by_hand"].success and np.abs(page["by_hand"].q[:2, -1] - page["corner"]).max() < 1e-6


def test_a_fit_with_the_step_that_the_page_names_finds_the_masses(names):
    page = names("your_mechanism")
    assert page["fit"].success and page["fit"].x == pytest.approx([page["m2"], page["m3"]], rel=1e-4)


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
    assert page["linkage"].freedom.degrees == 1 and page["turning"].success


@pytest.mark.parametrize(("tol", "step"), [(1e-8, 1e-4), (1e-12, 1.5e-8)])
def test_so_are_the_derivatives_right_with_each_of_its_two_remedies(names, tol, step):
    slider, masses = names("your_mechanism")["slider"], np.array([2.0, 1.5])
    for k in range(2):
        change = np.where(np.arange(2) == k, masses, 0.0)
        smooth = (slider(masses + 1e-3 * change, 1e-13) - slider(masses - 1e-3 * change, 1e-13)) / 2e-3
        by_steps = (slider(masses + step * change, tol) - slider(masses, tol)) / step
        assert np.linalg.norm(by_steps - smooth) < 0.02 * np.linalg.norm(smooth)


def test_every_kind_of_constraint_does_what_its_section_says(names):
    page = names("constraints")
    assert "on which assembly" in str(page["error_text"])
    assert "docs/constraints.md#redundant-rows" in str(page["caught"][0].message)
    assert np.abs(page["bars"] - page["bars"][:, :1]).max() < 1e-9
    assert np.linalg.matrix_rank(page["system"].mass(0.0, page["q0"])) == 6
    slope = page["slide"].q[:, -1]
    scale = 9.81 * np.sin(0.4) / (2.0 * 1.7**2)
    assert slope == pytest.approx([scale * np.sin(17.0) ** 2, scale * (17.0 - 0.5 * np.sin(34.0)), 17.0], abs=1e-7)


def test_the_adapter_of_the_page_has_the_order_of_its_method(names):
    page = names("benchmark")
    errors = page["rows"].query("solver == 'RATTLE'")["error_q"].to_numpy()
    assert errors[0] / errors[1] == pytest.approx(100.0, rel=0.1) and (page["rows"]["status"] == "REACHED_END").all()


def test_many_runs(names):
    page = names("many_runs")
    assert page["runs"].success.all() and page["q0"].shape == (2000, 9)
    assert page["result"].success and page["again"].success and np.ptp(page["high"] - page["low"]) > 1e-3
    sizes = pictures(page)
    assert min(sizes["tolerances.png"], sizes["workspace.png"]) > 5000


def test_the_red_example_is_as_printed(names):
    page, text = names("check_simulator"), (DOCS / "check_simulator.md").read_text(encoding="utf-8")
    assert not page["report"].passed and page["repaired"].passed
    assert all(failure.hint in text for failure in page["report"].failures)
    assert f"Of {len(FAULTS)} faults planted" in text
    assert all(f"    {failure.property}: " in text for failure in page["report"].failures)


def test_dense_output(names):
    page = names("between_steps")
    assert page["state"].q.shape == (9, 10_001) and np.isfinite(page["state"].lam).all()
    assert (page["again"].sol(3.21).q == page["_results"][0].sol(3.21).q).all()


def test_reactions(names):
    page = names("between_steps")
    pin = page["pin"]
    assert pin.force.shape == (2, 1001) and np.abs(pin.torque).max() < 1e-10 * np.abs(pin.force).max()
    assert page["clamp"].force[:, -1] == pytest.approx([0.0, 29.43], abs=1e-10)
    assert page["clamp"].torque[-1] == pytest.approx(14.715, abs=1e-10)


def test_the_third_event_ends_the_run(names):
    result = names("between_steps")["result"]
    assert result.status == 1 and result.t_events[0].size == 3 and np.abs(result.q_events[0][:, 8] - 1.0).max() < 1e-14
    assert (result.v_events[0][:, 8] > 0.0).all()


def test_impacts(names):
    page = names("between_steps")
    assert pictures(page)["impacts.png"] > 10_000
    arcs, problem = page["rebounds"].arcs, page["problem"]
    assert len(arcs) > 3
    for before, after in pairwise(arcs):
        assert abs(before.q[8, -1] - 1.0) < 1e-14 and after.t[0] == before.t[-1]
        assert after.v[8, 0] == pytest.approx(-0.6 * before.v[8, -1], rel=1e-12)
        # one degree of freedom: of the kinetic energy 0.36 is left
        q, v = before.q[:, -1], before.v[:, -1]
        kinetic = 0.5 * v @ problem.system.mass(0.0, q) @ v
        lost = problem.energy(before.t, before.q, before.v)[-1] - problem.energy(after.t, after.q, after.v)[0]
        assert lost == pytest.approx(0.64 * kinetic, rel=1e-9)
    assert max(arc.q[8].max() for arc in arcs) < 1.0 + 1e-14
    assert max(arc.sol(np.linspace(arc.t[0], arc.t[-1], 200)).q[8].max() for arc in arcs) < 1.0 + 1e-12
    assert page["landed"].q[1:, -1] == pytest.approx([0.2, 0.0], abs=1e-8)


def test_a_sampled_controller(names):
    page = names("between_steps")
    y, h = np.array([-0.5 * np.pi, 0.0]), 1e-3
    for _ in range(1000):  # the classical formula of order four, a step a sample
        torque = 40.0 * (0.3 - y[0]) - 8.0 * y[1]
        slopes = [np.zeros(2)]
        for share in (0.0, 0.5, 0.5, 1.0):
            angle, rate = y + share * h * slopes[-1]
            slopes.append(np.array([rate, 3.0 * (torque - 0.5 * 9.81 * np.cos(angle))]))
        y = y + h / 6.0 * (slopes[1] + 2.0 * slopes[2] + 2.0 * slopes[3] + slopes[4])
    assert page["sample"].q[page["angle"]] == pytest.approx(y[0], abs=1e-9)


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
    assert page["turned"].q[[0, 2], -1] == pytest.approx(ends[0][[0, 2]], abs=1e-5)  # SymPy's joints
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
    assert page["problem"].conserved and not page["start"].conserved
    assert page["heavier"].system.given == page["problem"].system.given and page["heavier"].parameters["m3"] == 3.0
    assert np.ptp(page["swing"].energy(page["swung"].t, page["swung"].q, page["swung"].v)) < 1e-4


# --- statuses
@pytest.mark.parametrize("status", [status for status in Status if status < 0], ids=lambda status: status.name)
def test_every_failure_leads_to_a_section_with_cause_and_remedy(status):
    assert explained(status) == f" See docs/when_it_fails.md#{status.name.lower()}."
    text = (DOCS / "when_it_fails.md").read_text(encoding="utf-8")
    section = re.search(rf"### {status.name}\n(.*?)(?=\n##)", text, re.DOTALL)
    assert section is not None and {"**Cause.**", "**Remedy.**"} <= set(section[1].split())


def test_the_message_of_a_failed_run_ends_with_it(names):
    result = names("when_it_fails")["result"]
    assert result.status is Status.NOT_FINITE and result.message.endswith(explained(Status.NOT_FINITE))


def test_success_is_not_explained():
    assert explained(Status.REACHED_END) == explained(Status.EVENT) == ""


# --- the reference has an entry for all that a user can import
ENTRIES = set(
    re.findall(
        r"^\.\. auto(?:class|function|exception):: (\S+)", (DOCS / "reference.md").read_text("utf-8"), re.MULTILINE
    )
)


@pytest.mark.parametrize("package", [f"twoloop{each}" for each in ("", ".audit", ".bodies", ".symbolic", ".testing")])
def test_every_name_of_a_package_has_an_entry(package):
    module = pytest.importorskip(package, exc_type=ImportError)
    assert {f"{package}.{name}" for name in module.__all__} <= ENTRIES


def test_so_has_every_method_that_a_name_stands_for():
    kinds = {type(method).__qualname__ for method in PRESETS.values()}
    assert kinds <= {entry.rpartition(".")[2] for entry in ENTRIES}


# --- links, and what is generated
def test_links_lead_to_files_that_are_there():
    """Also on GitHub, but for the pages that only the build makes; headings are checked by the build."""
    for page in PAGES:
        text = (DOCS / f"{page}.md").read_text(encoding="utf-8")
        for link in re.findall(r"\]\(([^)#]+)", text):
            if not link.startswith(("http", "generated/")):
                assert (DOCS / link).is_file(), f"{page}.md: {link}"


def test_the_front_page_shows_what_its_code_writes(tmp_path):
    for name in ("gallery", "shapes", "joints", "rooms"):
        documentation(name)
    documentation("generate").run_the_front_page(tmp_path / "front")
    assert {file.name for file in (tmp_path / "front").iterdir()} == {"run.png", "run.html"}
    text = (DOCS / "index.md").read_text(encoding="utf-8")
    assert '<iframe src="front/run.html"' in text and "generated/extra/front/run.png" in text
    assert "{include} generated/takes.md" in text  # the table "your mechanism, take"


def test_the_page_of_joints_shows_every_joint(tmp_path, monkeypatch):
    documentation("shapes")
    page = documentation("joints")
    monkeypatch.setattr(page, "STEPS", 3)  # smooth ways are for the build
    page.write(tmp_path / "joints.md")  # runs the code of each, and moves its bodies
    plane, space = (tmp_path / "joints.md").read_text(encoding="utf-8").split("## In space")
    for text, model in ((plane, PlanarModel), (space, SpatialModel)):
        joints = {
            name for name, each in inspect.getmembers(model, inspect.isfunction) if is_joint(each) and name[0] != "_"
        }
        assert joints - {"drive"} == set(re.findall(r"model\.(\w+)\(", text))
    pictures = re.findall(r"\]\((joint-[\w-]+\.svg)\)", plane + space)
    assert len(set(pictures)) == len(pictures) == 20
    assert all((tmp_path / picture).stat().st_size > 1000 for picture in pictures)
    assert (
        "With it, the body has 1 degree of freedom" in plane and "With it, the body has 5 degrees of freedom" in space
    )


def is_joint(method):
    return inspect.signature(method).return_annotation == "ModelJoint"


def test_the_gallery_shows_every_ready_mechanism(tmp_path, monkeypatch):
    gallery = documentation("gallery")
    monkeypatch.setattr(gallery, "LONGEST", 0.01)  # s: whole motions are for the build
    gallery.write(tmp_path / "gallery.md", tmp_path / "animations")
    text = (tmp_path / "gallery.md").read_text(encoding="utf-8")
    makers = {name for name in mechanisms.__all__ if name[0].islower()} - {"ancf_beam"}
    assert {line[3:] for line in text.splitlines() if line.startswith("## ")} == makers
    assert text.count("- *Tests*: ") == len(makers)
    if hasattr(Result, "animate"):
        assert {file.stem for file in (tmp_path / "animations").iterdir()} == makers
        assert all(f"../animations/{name}.html" in text for name in makers)
