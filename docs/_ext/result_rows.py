"""The directive `result-rows`: rows of a measured table, so that no page copies a figure by hand.

``{result-rows} accuracy`` with one beginning of a row's name per line shows those rows of that section of results.md.
A row that is not there stops the build.
"""

from __future__ import annotations

from pathlib import Path

from docutils import nodes
from docutils.parsers.rst import Directive
from docutils.statemachine import StringList
from sphinx.application import Sphinx
from sphinx.util.typing import ExtensionMetadata


class ResultRows(Directive):
    """Name, what was required, what was measured, and the note of chosen rows."""

    required_arguments = 1
    has_content = True

    def run(self) -> list[nodes.Node]:
        """Read the page of results at every build."""
        page = Path(__file__).parents[1] / "results.md"
        section = self.arguments[0]
        self.state.document.settings.record_dependencies.add(str(page))
        text = page.read_text(encoding="utf-8")
        begin, end = f"<!-- begin {section} -->", f"<!-- end {section} -->"
        if begin not in text or end not in text:
            raise self.error(f"results.md has no section {section!r}")
        rows = [
            [cell.strip() for cell in line.strip().strip("|").split(" | ")]
            for line in text.split(begin)[1].split(end)[0].splitlines()
            if line.startswith("| ")
        ]
        lines = ["| what | required | measured | |", "| --- | --- | --- | --- |"]
        for wanted in filter(None, map(str.strip, self.content)):
            found = [row for row in rows if row[0].startswith(wanted)]
            if not found:
                raise self.error(f"results.md, {section}: no row begins with {wanted!r}")
            lines += ["| " + " | ".join([row[0], row[1], row[2], row[-1]]) + " |" for row in found]
        node = nodes.container()
        self.state.nested_parse(StringList(lines, source=str(page)), self.content_offset, node)
        return node.children


def setup(app: Sphinx) -> ExtensionMetadata:
    """Register the directive."""
    app.add_directive("result-rows", ResultRows)
    return {"parallel_read_safe": True}
