"""The pages that are made anew with every build, in docs/generated: reports, which method, gallery."""

import shutil
from pathlib import Path

import gallery

from studies.which_method import page

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
    (folder / "which_method.md").write_text(page(ROOT / "reports"), encoding="utf-8")
    gallery.write(folder / "gallery.md", folder / "extra" / "animations")
