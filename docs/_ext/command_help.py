"""The directive `command-help`: what a command prints for `--help`, asked of the installed command at every build."""

from __future__ import annotations

import os
import subprocess
import sysconfig
from pathlib import Path

from docutils import nodes
from docutils.parsers.rst import Directive
from sphinx.application import Sphinx
from sphinx.util.typing import ExtensionMetadata

# A plain terminal of a fixed width, so that the manual does not depend on where it is built.
PLAIN = {"COLUMNS": "96", "NO_COLOR": "1", "TERM": "dumb", "TERMINAL_WIDTH": "96"}


class CommandHelp(Directive):
    """``{command-help} palpate weigh`` shows the output of ``palpate weigh --help``."""

    required_arguments = 1
    final_argument_whitespace = True

    def run(self) -> list[nodes.Node]:
        """Run the command; one that fails stops the build."""
        program, *verbs = self.arguments[0].split()
        path = Path(sysconfig.get_path("scripts")) / program
        result = subprocess.run(
            [str(path), *verbs, "--help"], capture_output=True, text=True, env={**os.environ, **PLAIN}
        )
        if result.returncode != 0:
            raise self.error(f"{self.arguments[0]} --help failed: {result.stderr.strip()}")
        text = "\n".join(line.rstrip() for line in result.stdout.strip().splitlines())
        return [nodes.literal_block(text, text, language="text")]


def setup(app: Sphinx) -> ExtensionMetadata:
    """Register the directive."""
    app.add_directive("command-help", CommandHelp)
    return {"version": "1", "parallel_read_safe": True, "parallel_write_safe": True}
