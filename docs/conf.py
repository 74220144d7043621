"""Sphinx: how the documentation site is made of these pages. `make docs` builds it."""

import sys
from pathlib import Path

import alidade

sys.path.insert(0, str(Path(__file__).parent))

project = "alidade"
author = "The alidade authors"
version = release = alidade.__version__

# MyST: the pages stay the Markdown that people read in the repository. No notebooks:
# tests/applications/test_docs.py runs what the
# pages show, commands with their exit codes and outputs included, so that building them runs nothing.
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "_site.docstrings",
    "_site.mathml",
    "_site.tables",
]
default_role = "code"
exclude_patterns = ["_site"]
myst_enable_extensions = ["deflist", "dollarmath"]
myst_heading_anchors = 4

html_theme = "furo"
html_title = f"alidade {version}"
html_copy_source = False
html_show_sphinx = False
html_show_copyright = False
html_static_path = ["_static"]
html_css_files = ["site.css"]
# MathML is part of HTML: no script, no font, nothing from a network.
html_math_renderer = "mathml"

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
napoleon_numpy_docstring = False
napoleon_use_ivar = True
