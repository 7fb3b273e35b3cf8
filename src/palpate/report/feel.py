"""The report on what pushed an arm: a single HTML file, from the contacts down to the settings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from palpate.errors import InputError

from . import _files, _page
from ._series import Array
from ._style import LIGHT, drawing
from ._text import escape, status_text
from .figures import joints_figure, torque_figure
from .weigh import fact, footer, header, panels

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_POINTS = 600
"""drawn of each curve"""
_AXES = ("x", "y", "z")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FeelReport:
    """What was felt: N samples of an arm with n joints. For a prismatic joint read N for N m.

    Values that are not finite are shown as gaps. Text may come from anywhere: it is escaped.

    Raises:
        InputError: an array has the wrong shape.
    """

    title: str
    arm: str
    time_s: Array
    """(N,) [s]"""
    joint_names: Sequence[str]
    joint_kinds: Sequence[str]
    """"revolute" or "prismatic" for each joint"""
    external_torque: Array
    """(N, n) torque of the environment on the joints [N m]"""
    external_torque_std: Array
    """(N, n) [N m]"""
    level: Array
    """(N, n) test statistic of contact over its threshold [1]"""
    force: Array
    """(N, 3) at the hand [N]"""
    force_std: Array
    """(N, 3) [N]"""
    moment: Array
    """(N, 3) [N m]"""
    moment_std: Array
    """(N, 3) [N m]"""
    singular: npt.NDArray[np.bool_]
    """(N, 6) force before moment: the pose tells (almost) nothing about it"""
    wrench_status: npt.NDArray[np.uint8]
    """(N,) palpate.Status values"""
    pushes: Sequence[Mapping[str, str]]
    """the contacts in words, all with the same keys"""
    spans: Sequence[tuple[float, float]]
    """begin and end of each contact [s]"""
    rate: str
    """the stated rate of false alarms and what it rests on"""
    settings: Mapping[str, object] = field(default_factory=dict)
    repair: Sequence[str] = ()
    provenance: Sequence[str] = ()

    def __post_init__(self) -> None:
        rows, n = len(self.time_s), len(self.joint_names)
        shapes = {"external_torque": n, "external_torque_std": n, "level": n, "singular": 6}
        shapes |= {"force": 3, "force_std": 3, "moment": 3, "moment_std": 3}
        for name, columns in shapes.items():
            shape = np.shape(getattr(self, name))
            if shape != (rows, columns):
                raise InputError(f"{name} must have shape {(rows, columns)}, got {shape}")
        if len(self.joint_kinds) != n or len(self.spans) != len(self.pushes):
            raise InputError("joint_kinds must name every joint, and spans every contact")


def write_feel_report(report: FeelReport, path: str | PathLike[str]) -> Path:
    """Write one self-contained HTML file; the same bytes for the same data.

    Raises:
        InputError: the file cannot be written.
        MissingExtraError: matplotlib is not installed.
    """
    with drawing():
        sections = [header(report.title, report.arm, report.time_s), _card(report), _contacts(report)]
        sections += [_torques(report), _levels(report), *_wrench(report)]
        if report.settings:
            sections.append(_page.section("Settings", _page.mapping_table(report.settings)))
        if report.repair:
            sections.append(_page.section("What was repaired in the log", _page.lines(report.repair)))
        if report.provenance:
            sections.append(_page.section("Where arm and data come from", _page.lines(report.provenance)))
        sections.append(
            footer("“±” of a contact is 95 % (1.96 standard deviations), bands are two standard deviations.")
        )
    return _files.write(path, _page.page(report.title, (s for s in sections if s)))


def _card(report: FeelReport) -> str:
    count = len(report.pushes)
    words = f'<div class="number">{count} <small>contact{"" if count == 1 else "s"}</small></div>'
    facts = f'<dl class="facts">{fact("false alarms", report.rate)}</dl>'
    return f'<div class="card"><div class="words">{words}{facts}</div></div>'


def _contacts(report: FeelReport) -> str:
    if not report.pushes:
        return ""
    head = ["", *report.pushes[0]]
    rows = [[str(k + 1), *(escape(v) for v in push.values())] for k, push in enumerate(report.pushes)]
    note = _page.read(
        "The link is the one moved by the last joint that feels the contact; a push across a joint's axis is not felt "
        "by it, so a farther link may have been touched. The force is what would do the same at the grasp point, along "
        "the axes of the base: it is the true one only where the tip was touched. Torques are what joints feel beyond "
        "what was there at the onset."
    )
    return _page.section("Contacts", _page.table(head, rows), note)


def _mark(figure: Figure, report: FeelReport) -> Figure:
    """Shade the contacts."""
    for ax in figure.axes:
        for begin, end in report.spans:
            ax.axvspan(begin, end, color=LIGHT["orange"], alpha=0.16, linewidth=0.0, zorder=0.5)
    return figure


_CONTACT = ("contact", "orange", "area")


def _torques(report: FeelReport) -> str:
    def build(j: int) -> Figure:
        figure = torque_figure(
            report.time_s,
            report.external_torque[:, j : j + 1],
            report.external_torque_std[:, j : j + 1],
            [report.joint_names[j]],
            unit="N" if report.joint_kinds[j] == "prismatic" else "N m",
            columns=1,
            key=False,
            points=_POINTS,
        )
        return _mark(figure, report)

    key = _page.key([("estimated", "blue", "line"), ("± 2 standard deviations", "blue", "area"), _CONTACT])
    text = (
        "What the surroundings do to each joint, found without a force sensor; the band holds the errors of drives, "
        "velocity and friction. At rest it is as wide as stiction: there a joint may bear that much without showing it."
    )
    figures = panels(report.joint_names, build, "external torque", "e")
    return _page.section("External torques", key, figures, _page.read(text))


def _levels(report: FeelReport) -> str:
    def build(j: int) -> Figure:
        figure = joints_figure(
            report.time_s,
            {"estimated": np.minimum(report.level[:, j : j + 1], 1.2)},
            [report.joint_names[j]],
            quantity="level",
            unit="1",
            columns=1,
            key=False,
            points=_POINTS,
        )
        figure.axes[0].axhline(1.0, color=LIGHT["red"], linewidth=0.9)
        figure.axes[0].set_ylim(-0.05, 1.25)
        for note in list(figure.axes[0].texts):  # nothing is beyond this scale
            note.remove()
        return _mark(figure, report)

    key = _page.key([("test statistic", "blue", "line"), ("threshold", "red", "line"), _CONTACT])
    text = (
        "The evidence of contact at each joint, over the threshold that the stated rate of false alarms asks for. What "
        "is expected, noise, the model's slow errors, friction at rest and at reversals, has been taken out before."
    )
    figures = panels(report.joint_names, build, "level", "l")
    return _page.section("Evidence of contact", key, figures, _page.read(text))


def _wrench(report: FeelReport) -> list[str]:
    values = np.hstack((report.force, report.moment))
    std = np.hstack((report.force_std, report.moment_std))
    bad = ~np.isin(report.wrench_status, (0, 6))
    hidden = np.asarray(report.singular, dtype=bool) | bad[:, None]
    shown, spread = np.where(hidden, np.nan, values), np.where(hidden, np.nan, std)
    names = [f"force {a}" for a in _AXES] + [f"moment {a}" for a in _AXES]
    share = 100.0 * hidden.mean(axis=0) if len(hidden) else np.zeros(6)

    def build(k: int) -> Figure:
        figure = joints_figure(
            report.time_s,
            {"estimated": shown[:, k : k + 1]},
            [names[k]],
            quantity=names[k].split()[0],
            unit="N" if k < 3 else "N m",
            std=spread[:, k : k + 1],
            notes=[f"not seen {share[k]:.0f} % of the time" if share[k] >= 0.5 else ""],
            columns=1,
            key=False,
            points=_POINTS,
        )
        return _mark(figure, report)

    key = _page.key([("estimated", "blue", "line"), ("± 2 standard deviations", "blue", "area"), _CONTACT])
    text = (
        "Force and moment that would explain the torques if they acted at the grasp point, along the axes of the base. "
        "Where the pose tells (almost) nothing about a component, it is singular and left out: no number is shown."
    )
    status = status_text(6)
    note = f"{status.name}: {status.meaning}."
    return [
        _page.section(
            "Wrench at the hand", key, panels(names, build, "wrench", "w"), _page.read(f"{text} {note}")
        )
    ]
