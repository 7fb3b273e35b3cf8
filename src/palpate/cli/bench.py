"""``palpate bench``: palpate's own claims, measured."""

from __future__ import annotations

from pathlib import Path

import typer

from ._common import Json, Quiet, examples
from ._study import Hours, List, Minutes, Names, Out, Page, Quick
from ._study import run as run_studies


def add(app: typer.Typer) -> None:
    """Make the verb known."""
    app.command(
        "bench",
        help="Measure what palpate claims.\n\n"
        "Writes a page, a Markdown table and JSON per study. Exit code 1 if a row misses.",
        epilog=examples(
            "palpate bench --list",
            "palpate bench payload-filter",
            "palpate bench contacts --hours 10",
            "palpate bench session --minutes 1",
            "palpate bench view --minutes 5",
            "palpate bench --quick",
        ),
    )(run)


def run(
    names: Names = None,
    out: Out = Path("results"),
    page: Page = None,
    quick: Quick = False,
    hours: Hours = None,
    minutes: Minutes = None,
    listing: List = False,
    json: Json = False,
    quiet: Quiet = False,
) -> int:
    """Bench."""
    return run_studies(
        "bench",
        names,
        out=out,
        page=page,
        quick=quick,
        hours=hours,
        minutes=minutes,
        listing=listing,
        json=json,
        quiet=quiet,
    )
