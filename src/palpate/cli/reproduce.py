"""``palpate reproduce``: published results, measured again."""

from __future__ import annotations

from pathlib import Path

import typer

from ._common import Json, Quiet, examples
from ._study import List, Names, Out, Page, Quick
from ._study import run as run_studies


def add(app: typer.Typer) -> None:
    """Make the verb known."""
    app.command(
        "reproduce",
        help="Reproduce published results, side by side with ours.\n\n"
        "Writes a page, a Markdown table and JSON per study. Exit code 1 if a row misses.",
        epilog=examples(
            "palpate reproduce --list",
            "palpate reproduce mass-estimation",
            "palpate reproduce --quick --json",
        ),
    )(run)


def run(
    names: Names = None,
    out: Out = Path("results"),
    page: Page = None,
    quick: Quick = False,
    listing: List = False,
    json: Json = False,
    quiet: Quiet = False,
) -> int:
    """Reproduce."""
    return run_studies(
        "reproduce", names, out=out, page=page, quick=quick, listing=listing, json=json, quiet=quiet
    )
