"""Sphinx configuration of the manual. Builds without a network; `make docs` turns warnings into errors."""

from __future__ import annotations

import sys
from importlib.metadata import version as installed_version
from pathlib import Path

from sphinx.application import Sphinx

sys.path.insert(0, str(Path(__file__).parent / "_ext"))

project = "palpate"
author = "The palpate contributors"
copyright = author
version = release = installed_version("palpate")

extensions = [
    "command_help",
    "result_rows",
    "mathml",
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
]
autodoc_typehints = "none"  # the signatures carry them
autodoc_member_order = "bysource"
myst_enable_extensions = ["dollarmath", "colon_fence", "deflist"]
myst_heading_anchors = 3
myst_dmath_double_inline = True
html_math_renderer = "mathml"

html_theme = "furo"
html_title = f"palpate {version}"
html_copy_source = False
exclude_patterns = ["_build"]


def setup(app: Sphinx) -> None:
    """Keep napoleon from reading `unit: remark` in a field's docstring as `type: description`."""
    app.connect("autodoc-process-docstring", _dash_for_colon, priority=400)


def _dash_for_colon(
    app: Sphinx, what: str, name: str, thing: object, options: object, lines: list[str]
) -> None:
    if what in ("attribute", "property"):
        lines[:] = [line.replace(": ", " – ") for line in lines]
