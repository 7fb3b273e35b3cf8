"""Formulas as MathML, which browsers draw themselves: no script is fetched, so the manual reads offline."""

from __future__ import annotations

from docutils import nodes
from docutils.utils.math import MathError, latex2mathml
from sphinx.application import Sphinx
from sphinx.errors import ExtensionError
from sphinx.util.typing import ExtensionMetadata
from sphinx.writers.html5 import HTML5Translator


def write_formula(self: HTML5Translator, node: nodes.Element) -> None:
    """Write a formula, displayed or inline; LaTeX that docutils does not know stops the build."""
    block = isinstance(node, nodes.math_block)
    try:
        formula = latex2mathml.tex2mathml(node.astext(), as_block=block)
    except MathError as error:
        raise ExtensionError(f"{node.source}:{node.line}: {node.astext()!r}: {error}") from error
    self.body.append(f'<div class="math">{formula}</div>' if block else formula)
    raise nodes.SkipNode


def setup(app: Sphinx) -> ExtensionMetadata:
    """Register the renderer under the name `mathml`."""
    writers = (write_formula, None)
    app.add_html_math_renderer("mathml", inline_renderers=writers, block_renderers=writers)
    return {"version": "1", "parallel_read_safe": True, "parallel_write_safe": True}
