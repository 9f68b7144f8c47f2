"""Write the committed pages of docs/reference that follow from the code: python docs/generate.py.

The tests compare the pages with what this would write. Pictures are drawn again with --pictures.
"""

import sys
from pathlib import Path

import command_line
import gallery
import joints

REFERENCE = Path(__file__).resolve().parent / "reference"
PAGES = {"gallery": gallery, "joints": joints, "command_line": command_line}


def main() -> None:
    """Write all pages, and the pictures if the command line asks for them."""
    for name, module in PAGES.items():
        (REFERENCE / f"{name}.md").write_text(module.text(), encoding="utf-8")
    if "--pictures" in sys.argv:
        gallery.draw(REFERENCE)
        joints.draw(REFERENCE)


if __name__ == "__main__":
    main()
