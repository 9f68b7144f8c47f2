"""What is made anew with every build, in docs/generated: reports, methods, gallery, joints, the front page."""

import contextlib
import io
import shutil
from pathlib import Path

import gallery
import joints
import rooms

from studies.which_method import page, table

ROOT = Path(__file__).resolve().parents[1]
SHOWN = (".md", ".png", ".svg", ".csv", ".json", ".html")  # files of a report that its pages show or link


def write(folder: Path) -> None:
    """Write all generated pages into a folder, which is emptied first."""
    shutil.rmtree(folder, ignore_errors=True)
    reports = folder / "reports"
    reports.mkdir(parents=True)
    for file in (ROOT / "reports").iterdir():
        if file.suffix in SHOWN:
            shutil.copy(file, reports)
    shutil.copytree(ROOT / "reports" / "engines", reports / "engines")  # scripts that a report links
    for report in reports.glob("*.md"):  # from docs/generated/reports the pages are two folders up
        report.write_text(report.read_text(encoding="utf-8").replace("](../docs/", "](../../"), encoding="utf-8")
    (folder / "which_method.md").write_text(page(ROOT / "reports"), encoding="utf-8")
    (folder / "takes.md").write_text(table(ROOT / "reports"), encoding="utf-8")
    rooms.draw(folder / "rooms.svg")
    joints.write(folder / "joints.md")
    run_the_front_page(folder / "extra" / "front")
    gallery.write(folder / "gallery.md", folder / "extra" / "animations")


def run_the_front_page(folder: Path) -> None:
    """Run the code that the front page shows, so that its plot and its animation are what that code writes."""
    folder.mkdir(parents=True)
    code = (ROOT / "docs" / "index.md").read_text(encoding="utf-8").split("```python\n")[1].split("```")[0]
    with contextlib.chdir(folder), contextlib.redirect_stdout(io.StringIO()):
        exec(code, {})
