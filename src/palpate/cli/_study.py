"""What ``palpate reproduce`` and ``palpate bench`` share: run studies, print and write their rows."""

from __future__ import annotations

import math
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..errors import InputError, suggest
from ._common import console, emit, make_folder, say

if TYPE_CHECKING:
    from ..studies import Study, StudyResult

Names = Annotated[
    list[str] | None,
    typer.Argument(metavar="NAME", help="Which ones; without a name all of them.", show_default=False),
]
Out = Annotated[Path, typer.Option(metavar="DIR", help="Folder for NAME.html, NAME.md and NAME.json.")]
Quick = Annotated[
    bool, typer.Option("--quick", help="Few repetitions, to see that it works; no row is judged.")
]
Hours = Annotated[
    float | None,
    typer.Option(
        metavar="H",
        help="Simulate so long instead of the hours asked for (contacts), of which what is done is kept in --out, so "
        "that a run with more hours goes on from there.",
        show_default=False,
    ),
]
Minutes = Annotated[
    float | None,
    typer.Option(
        metavar="MIN",
        help="Run so long by the clock instead of the time asked for (session, fri, rtde, servos, view).",
        show_default=False,
    ),
]
Page = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="Also keep the tables in this Markdown page, one section per study."),
]
List = Annotated[bool, typer.Option("--list", help="Name the studies and stop.")]


def run(
    verb: str,
    names: list[str] | None,
    *,
    out: Path,
    page: Path | None,
    quick: bool,
    listing: bool,
    json: bool,
    quiet: bool,
    hours: float | None = None,
    minutes: float | None = None,
) -> int:
    """Run the studies of a verb; 1 if a row misses."""
    from ..studies import STUDIES

    known = {name: study for name, study in STUDIES.items() if study.verb == verb}
    if listing:
        if json:
            emit({"studies": [{"name": s.name, "title": s.title} for s in known.values()]})
        else:
            for study in known.values():
                say(f"{study.name:20} {study.title}")
        return 0
    chosen = []
    for name in names or list(known):
        if name not in known:
            other = f"palpate {STUDIES[name].verb} {name}" if name in STUDIES else ""
            raise InputError(
                f"no study {name!r} here: it is {other}"
                if other
                else f"no study {name!r}; {suggest(name, known, 'there are')}"
            )
        chosen.append(known[name])
    for option, length, able, what in (
        ("--hours", hours, [s.name for s in known.values() if s.campaign], "a campaign is"),
        ("--minutes", minutes, [s.name for s in known.values() if s.timed], "by the wall's clock runs"),
    ):
        if length is None:
            continue
        if not (math.isfinite(length) and length > 0.0):
            raise InputError(f"{option}: expected a number > 0, got {length:g}")
        if quick:
            raise InputError(f"{option} and --quick: a quick run has its own length; give one of them")
        if fixed := [study.name for study in chosen if study.name not in able]:
            raise InputError(f"{option}: {', '.join(fixed)} runs for a fixed time; {what}: {', '.join(able)}")
    make_folder(out)
    results = [
        (study, *_measure(study, out, quick=quick, hours=hours, minutes=minutes, silent=json or quiet))
        for study in chosen
    ]
    if page is not None:
        from ..report import markdown_table, update_markdown

        for study, result, _ in results:
            head = f"## {study.title}\n\nMeasured by `palpate {verb} {study.name}{' --quick' if quick else ''}`.\n\n"
            update_markdown(page, study.name, head + markdown_table(result.rows))
    ok = all(result.ok for _, result, _ in results)
    if json:
        emit({"ok": ok, "quick": quick, "studies": [_plain(result, files) for _, result, files in results]})
    elif quiet:
        for study, result, _ in results:
            say(f"{study.name}: {_verdict(result)}")
    return 0 if ok else 1


def _measure(
    study: Study, out: Path, *, quick: bool, hours: float | None, minutes: float | None, silent: bool
) -> tuple[StudyResult, dict[str, str]]:
    """Run one study and write it; print it unless silent."""
    from ..report import write_study

    length: dict[str, Any] = {"folder": out, "hours": hours} if study.campaign else {}
    if study.timed:
        length["minutes"] = minutes
    result = study.run(None if silent else _Bar(study.name), quick=quick, **length)
    written = write_study(
        result.rows,
        result.figures,
        out / study.name,
        title=study.title,
        text=f"palpate {study.verb} {study.name}" + (" --quick" if quick else ""),
        provenance=result.notes,
    )
    files = {"html": str(written.html), "markdown": str(written.markdown), "json": str(written.json)}
    if not silent:
        _print(result, files)
    return result, files


class _Bar:
    """How far a study is, and the time left: a bar that goes away; without a terminal a line on stderr every minute."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._bar: Any = None
        self._row: Any = None
        self._told = time.monotonic()

    def __call__(self, done: int, total: int, seconds_left: float) -> None:
        out = console()
        left = f"{_time(seconds_left)} left" if math.isfinite(seconds_left) else ""
        if not out.is_terminal:
            if left and time.monotonic() - self._told >= 60.0:
                self._told = time.monotonic()
                sys.stderr.write(f"{self._name}: {done} of {total} jobs, {left}\n")
            return
        if self._bar is None:
            from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

            self._bar = Progress(
                TextColumn("{task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
                TextColumn("{task.fields[left]}"),
                console=out,
                transient=True,
            )
            self._bar.start()
            self._row = self._bar.add_task(self._name, total=total, left="")
        self._bar.update(self._row, completed=done, total=total, left=left)
        if done >= total:
            self._bar.stop()
            self._bar = None


def _time(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 90.0 else f"{seconds / 60.0:.0f} min"


def _verdict(result: StudyResult) -> str:
    judged = [row for row in result.rows if row.ok is not None]
    if not judged:
        return "no row judged"
    held = sum(row.ok is True for row in judged)
    return f"{held} of {len(judged)} rows hold"


def _print(result: StudyResult, files: dict[str, str]) -> None:
    from rich.table import Table
    from rich.text import Text

    table = Table(
        title=Text(result.title),
        title_justify="left",
        title_style="bold",
        header_style="dim",
        box=None,
        padding=(0, 2),
    )
    noted = any(row.note for row in result.rows)
    for i, name in enumerate(
        ("what", "published or required", "ours", "tolerance", "ok", *(("note",) if noted else ()))
    ):
        table.add_column(name, justify="right" if i in (1, 2, 3) else "left", overflow="fold")
    for row in result.rows:
        *cells, verdict = row.cells()
        style = {True: "green", False: "bold red", None: ""}[row.ok]
        table.add_row(
            *(Text(c) for c in cells),
            Text(verdict, style=style),
            *((Text(row.note, style="dim"),) if noted else ()),
        )
    out = console()
    out.print(table)
    for note in result.notes:
        out.print(Text(note, style="dim"))
    out.print(f"{_verdict(result)}, {result.seconds:.1f} s; {files['html']}")
    out.print()


def _plain(result: StudyResult, files: dict[str, str]) -> dict[str, Any]:
    def value(x: object) -> object:
        return None if isinstance(x, float) and not math.isfinite(x) else x

    return {
        "name": result.name,
        "title": result.title,
        "ok": result.ok,
        "seconds": result.seconds,
        "rows": [
            {
                "what": row.what,
                "required": value(row.required),
                "ours": value(row.ours),
                "tolerance": value(row.tolerance),
                "ok": row.ok,
                "unit": row.unit,
                "note": row.note,
            }
            for row in result.rows
        ],
        "notes": list(result.notes),
        "files": files,
    }
