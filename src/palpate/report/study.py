"""What a study found: rows of required and reached numbers, as HTML page, Markdown table and JSON."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np

from palpate.errors import InputError

from . import _files, _page
from ._style import svg
from ._text import clean, escape, number

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Value: TypeAlias = float | int | str | None


@dataclass(frozen=True, slots=True)
class StudyRow:
    """One number, or one statement, of a study."""

    what: str
    """the quantity, e.g. "mass after 20 s" """
    required: Value = None
    """as published, or what is demanded; a text for ranges, e.g. "<= 2.5" """
    ours: Value = None
    """what palpate reached"""
    tolerance: Value = None
    """how far ours may be from it"""
    ok: bool | None = None
    """True: holds; False: does not; None: for information"""
    unit: str = ""
    """of all three numbers"""
    note: str = ""
    """one line more"""

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            if isinstance(value, np.generic):
                object.__setattr__(self, f.name, value.item())
        if self.ok is not None and not isinstance(self.ok, bool):
            raise InputError(f"ok of {self.what!r:.80} must be True, False or None, got {self.ok!r}")

    def cells(self) -> tuple[str, str, str, str, str]:
        """The row as printed: quantity with unit, required, ours, tolerance, verdict."""
        what = f"{self.what} [{self.unit}]" if self.unit else self.what
        verdict = {True: "✓ ok", False: "✗ no", None: ""}[self.ok]
        return what, number(self.required), number(self.ours), number(self.tolerance), verdict


class StudyFiles(NamedTuple):
    """What :func:`write_study` wrote."""

    html: Path
    markdown: Path
    json: Path


_HEAD = ("quantity", "published or required", "palpate", "tolerance", "holds")


def _markdown(text: object) -> str:
    """Text as Markdown that shows exactly this text, also inside a table."""
    return re.sub(r"([\\|*_`\[\]~#])", r"\\\1", clean(text).replace("&", "&amp;").replace("<", "&lt;"))


def markdown_table(rows: Sequence[StudyRow]) -> str:
    """The rows as a Markdown table, ending with a line end; every text is escaped."""
    noted = any(row.note for row in rows)
    head = (*_HEAD, "note") if noted else _HEAD
    table = [head, ("---", "---:", "---:", "---:", ":---:", "---")[: len(head)]]
    table += [tuple(_markdown(c) for c in (*row.cells(), row.note)[: len(head)]) for row in rows]
    return "".join("| " + " | ".join(cells) + " |\n" for cells in table)


def update_markdown(path: str | PathLike[str], name: str, text: str, *, title: str = "Results") -> Path:
    """Replace what stands between ``<!-- begin NAME -->`` and ``<!-- end NAME -->`` in a Markdown file.

    A section that is not there yet is put at the end, a file that is not there is made with `title` as its heading.

    Args:
        path: the file, UTF-8.
        name: of the section: letters, digits, dots, dashes and underscores.
        text: Markdown, e.g. of :func:`markdown_table`; put in as it is.
        title: heading of a new file.

    Raises:
        InputError: a marker is missing or there twice, the name or text cannot be marked, or the file cannot be
            read or written.
    """
    if not re.fullmatch(r"[A-Za-z0-9._-]+", name):
        raise InputError(
            f"name of a section must be letters, digits, dots, dashes, underscores; got {name!r:.80}"
        )
    if re.search(r"<!--\s*(begin|end) [A-Za-z0-9._-]+\s*-->", text):
        raise InputError(f"text of section {name!r} holds a section marker itself")
    target = Path(path)
    begin, end = f"<!-- begin {name} -->", f"<!-- end {name} -->"
    try:
        old = target.read_bytes().decode("utf-8") if target.exists() else f"# {clean(title)}\n"
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read {target}: {error}") from error
    ends = "\r\n" if "\r\n" in old else "\n"
    body = f"{begin}\n\n{text.strip()}\n\n{end}".replace("\r\n", "\n").replace("\n", ends)
    counts = old.count(begin), old.count(end)
    if counts == (0, 0):
        new = old.rstrip() + ends * 2 + body + ends
    elif counts == (1, 1) and old.index(begin) < old.index(end):
        new = old[: old.index(begin)] + body + old[old.index(end) + len(end) :]
    else:
        raise InputError(
            f"{target}: expected one {begin!r} followed by one {end!r}, found {counts[0]} and {counts[1]}"
        )
    return _files.write(target, new)


def write_study(
    rows: Sequence[StudyRow],
    figures: Mapping[str, Figure],
    path: str | PathLike[str],
    *,
    title: str = "Study",
    text: str = "",
    settings: Mapping[str, object] | None = None,
    provenance: Sequence[str] = (),
) -> StudyFiles:
    """Write a study as NAME.html, NAME.md and NAME.json; the same bytes for the same data.

    Args:
        rows: what was required and what was reached.
        figures: figures by their captions, in the order to show.
        path: NAME.html, or NAME with any or no suffix of the three.
        title: heading.
        text: a few sentences below it.
        settings: options to list.
        provenance: where numbers come from, line by line.

    Raises:
        InputError: a file cannot be written.
        MissingExtraError: there are figures and matplotlib is not installed.
    """
    base = Path(path)
    if base.suffix in (".html", ".md", ".json"):
        base = base.with_suffix("")
    options = dict(settings or {})
    judged = [row for row in rows if row.ok is not None]
    held = sum(bool(row.ok) for row in judged)
    verdict = f"{held} of {len(judged)} hold" if judged else ""

    sections = [f"<header><h1>{escape(title)}</h1>"]
    sections.append(f'<p class="sub">{escape(text, 2000)}</p></header>' if text else "<br></header>")
    if verdict:
        tone = "green" if held == len(judged) else "red"
        sections.append(f'<p><span class="pill" style="--tone:var(--{tone})">{verdict}</span></p>')
    if rows:
        sections.append(_study_table(rows))
    for index, (caption, figure) in enumerate(figures.items()):
        drawn = svg(figure, clean(caption), f"f{index}", fixed=True)
        caption_html = f'<figcaption class="read">{escape(caption, 1000)}</figcaption>'
        sections.append(f'<figure><div class="scroll">{drawn}</div>{caption_html}</figure>')
    if options:
        sections.append(_page.section("Settings", _page.mapping_table(options)))
    if provenance:
        sections.append(_page.section("Where this comes from", _page.lines(provenance)))

    parts = [f"# {_markdown(title)}\n", f"{_markdown(clean(text, 2000))}\n" if text else ""]
    parts += [f"**{verdict}**\n" if verdict else "", markdown_table(rows) if rows else ""]
    if options:
        lines = "".join(f"| {_markdown(k)} | {_markdown(number(v, 6))} |\n" for k, v in options.items())
        parts.append("| setting | value |\n| --- | --- |\n" + lines)
    parts.append("".join(f"- {_markdown(line)}\n" for line in provenance))

    data = {
        "title": str(title),
        "text": str(text),
        "ok": all(row.ok for row in judged) if judged else None,
        "rows": [asdict(row) for row in rows],
        "settings": options,
        "provenance": [str(line) for line in provenance],
    }
    return StudyFiles(
        _files.write(_named(base, ".html"), _page.page(title, sections)),
        _files.write(_named(base, ".md"), "\n".join(p for p in parts if p)),
        _files.write(_named(base, ".json"), json.dumps(_plain(data), indent=2, ensure_ascii=True) + "\n"),
    )


def _named(base: Path, suffix: str) -> Path:
    return base.with_name(base.name + suffix)


def _study_table(rows: Sequence[StudyRow]) -> str:
    noted = any(row.note for row in rows)
    body = []
    for row in rows:
        *cells, verdict = (escape(c) for c in row.cells())
        mark = {True: "yes", False: "no", None: ""}[row.ok]
        line = [*cells, f'<span class="{mark}">{verdict}</span>' if mark else ""]
        body.append([*line, escape(row.note)] if noted else line)
    return _page.table((*_HEAD, "note") if noted else _HEAD, body, frozenset((1, 2, 3)))


def _plain(value: object) -> object:
    """What JSON can hold: numbers that are not finite become null, what it does not know becomes text."""
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, bool | int | str) else str(value)
