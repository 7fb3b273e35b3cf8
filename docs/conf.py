"""Sphinx configuration of the manual. Builds without a network; `make docs` turns warnings into errors."""

from __future__ import annotations

import sys
from importlib.metadata import version as installed_version
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "_ext"))

project = "palpate"
author = "The palpate contributors"
copyright = author
version = release = installed_version("palpate")

extensions = ["command_help", "mathml", "myst_parser"]
myst_enable_extensions = ["dollarmath", "colon_fence", "deflist"]
myst_heading_anchors = 3
myst_dmath_double_inline = True
html_math_renderer = "mathml"

html_theme = "furo"
html_title = f"palpate {version}"
html_copy_source = False
exclude_patterns = ["_build"]
