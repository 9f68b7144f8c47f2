"""Turn the plain pages of docs/ into what Sphinx needs: a menu, links to other folders, the reference, animations.

The pages are plain Markdown, so that they can be read in the repository. All directives of Sphinx come from here.
"""

import importlib
import inspect
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
LINK = re.compile(r"(?<=\]\()(?!https?:|mailto:|#)([^)\s#]+)")  # the file of a relative link
ORPHAN = "---\norphan: true\n---\n\n"  # no warning if a page is not in the menu
ALL = ":members:"
OF_MODELS = f"{ALL}\n:inherited-members:\n:exclude-members: assemble, bound, coordinate_of, mode, pull"
# options of autodoc for what shows members; all others show their docstring
MEMBERS = {
    "twoloop.impacts.joined.ArcSolution": ":members: __call__",
    "twoloop.ConstrainedSystem": ":members: from_python, parameters, with_parameters, evaluate, "
    "velocity_constraint, rows, rates, called_in_python",
    "twoloop.Drawing": ":members: at",
    "twoloop.Result": ALL,
    "twoloop.run.dense_solution.DenseSolution": ":members: __call__",
    "twoloop.Runs": ALL,
    "twoloop.Integrator": ":members: run, start, step, result",
    "twoloop.Taylor": ":exclude-members: program",
    "twoloop.methods.tableaux": ALL,
    "twoloop.bodies.PlanarModel": OF_MODELS,
    "twoloop.bodies.SpatialModel": OF_MODELS,
    "twoloop.bodies.model_problem.ModelProblem": ":members: actuator_forces, joint_coordinate, place, with_parameters",
    "twoloop.bodies.parts.Body": ":members: coordinates, point, direction",
    "twoloop.symbolic.SymbolicMechanism": ":members: system, energy, with_parameters, problem",
    "twoloop.testing.KnownProblem": ":members: acceleration, reaction",
    "twoloop.testing.Report": ":members: passed, failures, to_markdown",
    "twoloop.audit.MjcfAudit": ":members: write",
    "twoloop.audit.Audit": ":members: reaching",
    "twoloop.audit.AuditedRun": ":no-members:",
    "twoloop.mechanisms": f"{ALL}\n:imported-members:\n:exclude-members: Problem",  # which has an entry of its own
    "twoloop.mechanisms.planar.PlanarBodies": ALL,
    "twoloop.mechanisms.quadratic.QuadraticSystem": ALL,
}


def copy_linked_files(folder: Path) -> None:
    """Copy into a folder, which is emptied first, what pages link outside docs/, and what these files link in turn."""
    shutil.rmtree(folder, ignore_errors=True)
    queue, seen = list(DOCS.glob("*.md")) + list(DOCS.glob("reference/*.md")) + list(ROOT.glob("reports/*.md")), set()
    while queue:
        source = queue.pop()
        if source in seen:
            continue
        seen.add(source)
        outside = not source.is_relative_to(DOCS)
        copy = folder / source.relative_to(ROOT) if outside else source
        if outside:
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(source, copy)
        if source.suffix == ".md":
            text = source.read_text(encoding="utf-8")
            if outside:
                copy.write_text(ORPHAN + with_links_into(folder, text, source, copy), encoding="utf-8")
            targets = ((source.parent / link).resolve() for link in LINK.findall(text))
            queue += [target for target in targets if target.is_file() and target.is_relative_to(ROOT)]


def with_links_into(folder: Path, text: str, source: Path, page: Path) -> str:
    """Return text of a source in which links outside docs/ lead to copies in a folder, relative to the page."""

    def replaced(link: re.Match[str]) -> str:
        target = (source.parent / link[1]).resolve()
        if not target.is_relative_to(DOCS):
            target = folder / target.relative_to(ROOT)
        return os.path.relpath(target, page.parent)

    return LINK.sub(replaced, text)


def menu(text: str) -> Iterator[tuple[str, list[str]]]:
    """Yield the headings of the front page, and the pages that the list below each of them links."""
    for section in text.split("\n## ")[1:]:
        heading, _, rest = section.partition("\n")
        items = re.findall(r"^- .*", rest, re.MULTILINE)
        yield heading, [LINK.findall(item)[0].removesuffix(".md") for item in items]


def with_menu(text: str) -> str:
    """Return the front page with a hidden table of contents for each of its sections."""
    parts = [text]
    for heading, pages in menu(text):
        options = f":caption: {heading}\n:maxdepth: 1\n:hidden:\n"
        parts.append("\n".join([f"```{{toctree}}\n{options}", *pages, "```\n"]))
    return "\n".join(parts)


def with_docstrings(text: str) -> str:
    """Return the reference, where the list item of a name is replaced by its docstring."""
    return re.sub(r"^- `([\w.]+)`.*$", lambda item: directive(item[1]), text, flags=re.MULTILINE)


def directive(name: str) -> str:
    """Return the autodoc directive of a public name."""
    options = "".join(f"\n   {line}" for line in MEMBERS.get(name, "").splitlines())
    return f"```{{eval-rst}}\n.. auto{kind(name)}:: {name}{options}\n```"


def kind(name: str) -> str:
    """Return what autodoc calls the kind of a name: module, exception, class or function."""
    package, _, attribute = name.rpartition(".")
    try:
        entry = getattr(importlib.import_module(package), attribute)
    except AttributeError:
        entry = importlib.import_module(name)
    if inspect.ismodule(entry):
        return "module"
    if inspect.isclass(entry):
        return "exception" if issubclass(entry, Exception) else "class"
    return "function"


def with_animations(text: str) -> str:
    """Return the gallery with the animation of each mechanism in place of its picture."""
    frame = '<iframe src="../animations/{0}.html" title="{0} in motion" width="100%" height="560" loading="lazy" '
    frame += 'style="border: 0"></iframe>'
    return re.sub(r"^!\[.*\]\((\w+)\.png\)$", lambda p: f"```{{raw}} html\n{frame.format(p[1])}\n```", text, flags=re.M)


def without_menu(text: str) -> str:
    """Return a page that is in no menu, so that Sphinx does not warn of it."""
    return ORPHAN + text


CHANGES = {
    "index": with_menu,
    "reference": with_docstrings,
    "reference/gallery": with_animations,
    "errors": without_menu,
}


def page_for_sphinx(name: str, text: str, folder: Path) -> str:
    """Return the text of a page as Sphinx reads it; copies in the folder have been changed before."""
    source = DOCS / f"{name}.md"
    if not source.is_file() or source.is_relative_to(folder):
        return text
    text = with_links_into(folder, text, source, source)
    return CHANGES[name](text) if name in CHANGES else text
