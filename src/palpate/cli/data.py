"""``palpate data``: recordings of real robots."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

from ..errors import LogError
from ._common import Json, emit, examples, group, say

_Name = Annotated[str, typer.Argument(metavar="NAME", help="The data set; palpate data list names them.")]


def add(app: typer.Typer) -> None:
    """Make the verbs known."""
    verbs = group(
        app,
        "data",
        "Get published recordings of real robots.\n\n"
        "palpate carries none: they are fetched from where they were published.",
    )
    verbs.command(
        "list", help="What there is, and what is on this machine.", epilog=examples("palpate data list")
    )(names)
    verbs.command(
        "get",
        help="Show the licence of a data set, ask, and download it.",
        epilog=examples("palpate data get lara8", "palpate data get lara8 --yes"),
    )(get)
    verbs.command(
        "path",
        help="Print the folder of a data set on this machine.",
        epilog=examples("ls $(palpate data path lara8)"),
    )(path)


def names(json: Json = False) -> int:
    """List the data sets."""
    from .. import data

    places = {s.name: data.path(s.name) for s in data.list_sets()}
    if json:
        sets = [
            {
                "name": s.name,
                "title": s.title,
                "size_bytes": s.size,
                "licence": s.licence,
                "origin": s.origin,
                "path": None if places[s.name] is None else str(places[s.name]),
            }
            for s in data.list_sets()
        ]
        emit({"sets": sets})
        return 0
    for s in data.list_sets():
        where = places[s.name]
        say(f"{s.name}: {s.title}")
        say(f"  {s.size / 1e6:.1f} MB, {s.licence_name}, {s.origin}")
        say(f"  {'here: ' + str(where) if where is not None else 'not here: palpate data get ' + s.name}")
    return 0


def get(
    name: _Name,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Accept the licence without being asked.")] = False,
    json: Json = False,
) -> int:
    """Fetch a data set."""
    from .. import data

    def ask(terms: str) -> bool:
        # to standard error, so that the path alone is on standard output
        print(terms, file=sys.stderr)
        if yes:
            return True
        if not sys.stdin.isatty():
            raise LogError(f"nobody is here to accept the licence of {name!r}: read it above and say --yes")
        return typer.confirm("Accept and download?", err=True)

    folder = data.get(name, accept_licence=ask)
    if json:
        emit({"name": name, "path": str(folder)})
    else:
        say(str(folder))
    return 0


def path(name: _Name, json: Json = False) -> int:
    """Print where a data set is."""
    from .. import data

    folder = data.path(name)
    if folder is None:
        raise LogError(f"data set {name!r} is not on this machine: palpate data get {name}")
    if json:
        emit({"name": name, "path": str(folder)})
    else:
        say(str(folder))
    return 0
