"""Settings of the documents' site, which `make docs` builds into site/; any warning fails it."""

import sys
from pathlib import Path

import warpgs

sys.path.insert(0, str(Path(__file__).parent))  # mathml.py

HIDDEN_COLON = "\N{OBJECT REPLACEMENT CHARACTER}"

project = "warpgs"
author = "The warpgs authors"
copyright = author
version = release = warpgs.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "mathml"]
myst_enable_extensions = ["dollarmath", "colon_fence"]
myst_heading_anchors = 4
myst_links_external_new_tab = False

html_theme = "furo"
html_title = f"warpgs {release}"
html_math_renderer = "mathml"
html_static_path = ["static"]
html_css_files = ["maths.css", "pages.css"]
html_show_sourcelink = False
html_copy_source = False

default_role = "py:obj"  # a name in single backticks links to what is in the reference
autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_preserve_defaults = True
napoleon_google_docstring = True
napoleon_numpy_docstring = False
python_use_unqualified_type_names = True
linkcheck_ignore = [r"https?://(127\.0\.0\.1|localhost)"]


def hide_colons(app, what: str, name: str, value: object, options: object, lines: list[str]) -> None:
    """Hide colons from napoleon, which reads the words before the first one in a field's docstring as its type."""
    if what in ("attribute", "property"):
        lines[:] = [line.replace(":", HIDDEN_COLON) for line in lines]


def show_colons(app, what: str, name: str, value: object, options: object, lines: list[str]) -> None:
    """Put the hidden colons back."""
    lines[:] = [line.replace(HIDDEN_COLON, ":") for line in lines]


def setup(app) -> None:
    """Connect to Sphinx, which calls this once the settings are read."""
    app.connect("autodoc-process-docstring", hide_colons, priority=400)  # napoleon has 500
    app.connect("autodoc-process-docstring", show_colons, priority=600)
