"""Runs the shell lines of a Markdown page as a reader would type them: ``run_page.py README.md "In C++"``.

All ``sh`` blocks under that heading, from the top of the tree, with a home folder of their own.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path


def lines(page: str, heading: str) -> str:
    """The ``sh`` blocks under a heading, one after the other."""
    part = re.split(r"^#+ ", page, flags=re.MULTILINE)
    found = [p for p in part if p.splitlines() and p.splitlines()[0].strip() == heading]
    if len(found) != 1:
        sys.exit(f"{len(found)} headings {heading!r}; expected one")
    return "".join(re.findall(r"^```sh\n(.*?)^```", found[0], flags=re.MULTILINE | re.DOTALL))


def main(page: str, heading: str) -> int:
    top = Path(__file__).resolve().parent.parent
    script = lines((top / page).read_text(encoding="utf-8"), heading)
    if not script:
        sys.exit(f"{page}: no lines to run under {heading!r}")
    home = top / "build" / "home"
    home.mkdir(parents=True, exist_ok=True)
    env = dict(os.environ, HOME=str(home))
    return subprocess.run(
        ["bash", "-xeuo", "pipefail", "-c", script], cwd=top, env=env, check=False
    ).returncode


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
