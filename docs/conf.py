"""Configuration of the documentation: make docs."""

import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent), str(HERE)]  # the packages, and the modules beside this file

import for_sphinx  # noqa: E402
import gallery  # noqa: E402

import twoloop  # noqa: E402

GENERATED = HERE / "generated"

project = "twoloop"
author = "The twoloop contributors"
copyright = author
version = release = twoloop.__version__

# Sphinx links the word for a type in a docstring to attributes of that name, of which classes may share one
suppress_warnings = ["ref.python"]
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.mathjax"]
exclude_patterns = ["_build", "generated/extra"]
html_extra_path = ["generated/extra"]  # the animations, copied as they are
default_role = "py:obj"  # a name in single backticks, as numpydoc has them, is a link where there is such an object
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3  # as on GitHub: a link to page.md#heading works in both
napoleon_google_docstring = False
napoleon_use_ivar = True
autodoc_typehints = "none"  # the docstrings have types and shapes
autodoc_member_order = "bysource"
python_maximum_signature_line_length = 100

html_theme = "furo"
html_title = f"twoloop {release}"
html_static_path = ["static"]
html_css_files = ["wide.css"]
html_show_sourcelink = False
html_copy_source = False


def prepare(app, config):
    """Copy linked files and write the animations before Sphinx looks for files."""
    for_sphinx.copy_linked_files(GENERATED)
    gallery.animate(GENERATED / "extra" / "animations")


def read(app, name, source):
    """Change a page from plain Markdown to what Sphinx needs."""
    source[0] = for_sphinx.page_for_sphinx(name, source[0], GENERATED)


def escape_bars(app, what, name, obj, options, lines):
    """Let |x| in a docstring be the magnitude that it means, not a substitution of reStructuredText."""
    for k, line in enumerate(lines):
        parts = line.split("`")
        parts[::2] = [part.replace("|", "\\|") for part in parts[::2]]
        lines[k] = "`".join(parts)


def setup(app):
    """Connect the functions above to Sphinx."""
    app.connect("config-inited", prepare)
    app.connect("source-read", read)
    app.connect("autodoc-process-docstring", escape_bars)
