"""The report on one wiping: a single HTML file, from the ink that is left down to the timing."""

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
from ._style import LIGHT, data_url, drawing, svg
from ._text import escape, number
from .figures import _axes, _figure, _line, _ticks, _time_limits
from .weigh import _both, fact, footer, header

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_POINTS = 2500
_WAYS = {"approach": "sky", "touch": "orange", "slide": "blue", "lift": "orange"}
"""colour of each phase"""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WipeReport:
    """What a job did: N cycles. Text may come from anywhere: it is escaped.

    Raises:
        InputError: an array has the wrong shape.
    """

    title: str
    arm: str
    verdict: str
    """clean, dirty or stopped"""
    reason: str
    """why it is not clean; empty if it is"""
    ink_before: float
    """under visible ink, truly [m^2]"""
    ink_after: float
    """[m^2]"""
    simulated: float
    """[s]"""
    wall: float
    """[s]"""
    max_force: float
    """bound of the commanded force [N]"""
    max_torque: float
    """[N m]"""
    band: float
    """half width within which the normal force should stay [N]"""
    time_s: Array
    """(N,) [s]"""
    phase: npt.NDArray[np.str_]
    """(N,) approach, touch, slide, lift, or empty"""
    wanted: Array
    """(N,) normal force set [N]; 0: not pressing"""
    estimated: Array
    """(N,) normal force felt [N]"""
    normal: Array
    """(N,) normal force, truly [N]"""
    contact: Array
    """(N,) norm of the contact force, truly [N]"""
    force: Array
    """(N,) norm of the commanded force [N]"""
    moment: Array
    """(N,) norm of the commanded moment [N m]"""
    tool: Array
    """(N, 3) eraser's centre, board coordinates [m]"""
    moved: Array
    """(N,) way of the board since the pass began [m]"""
    yielding: npt.NDArray[np.bool_]
    """(N,)"""
    size: tuple[float, float]
    """of the board [m]"""
    coverage: npt.NDArray[np.float32]
    """(H, W) work of the felt on the surface [J/m^2]"""
    before: bytes | None
    """PNG or JPEG: what the camera saw first, with what was found in it"""
    after: bytes | None
    passes: Sequence[Mapping[str, str]] = ()
    """in words, all with the same keys"""
    events: Sequence[tuple[float, str, str]] = ()
    """time [s], kind, one sentence"""
    timing: Sequence[Mapping[str, str]] = ()
    """in words, all with the same keys"""
    limited: bool = False
    """some ink was meant to stay"""
    settings: Mapping[str, object] = field(default_factory=dict)

    def __post_init__(self) -> None:
        rows = len(self.time_s)
        names = ("phase", "wanted", "estimated", "normal", "contact", "force", "moment", "moved", "yielding")
        for name, shape in {**dict.fromkeys(names, (rows,)), "tool": (rows, 3)}.items():
            if np.shape(getattr(self, name)) != shape:
                raise InputError(f"{name} must have shape {shape}, got {np.shape(getattr(self, name))}")
        if np.ndim(self.coverage) != 2:
            raise InputError(f"coverage must be (H, W), got {np.shape(self.coverage)}")

    @property
    def ink_left(self) -> float:
        """Part of the ink that is left; NaN if there was none."""
        return self.ink_after / self.ink_before if self.ink_before > 0.0 else float("nan")


def write_wipe_report(report: WipeReport, path: str | PathLike[str]) -> Path:
    """Write one self-contained HTML file; the same bytes for the same data.

    Raises:
        InputError: the file cannot be written.
        MissingExtraError: matplotlib is not installed.
    """
    with drawing():
        sections = [
            header(report.title, report.arm, report.time_s),
            _card(report),
            _pictures(report),
            _forces(report),
            _maps(report),
            _passes(report),
            _events(report),
            _timing(report),
        ]
        if report.settings:
            sections.append(_page.section("Settings", _page.mapping_table(report.settings)))
        sections.append(
            footer("True forces and the ink left are the simulation's; no sensor of the robot sees them.")
        )
    return _files.write(path, _page.page(report.title, (s for s in sections if s)))


def _slide(report: WipeReport) -> npt.NDArray[np.bool_]:
    return (report.phase == "slide") & ~report.yielding


def _largest(values: Array) -> float:
    good = values[np.isfinite(values)]
    return float(good.max()) if good.size else float("nan")


def _card(report: WipeReport) -> str:
    left = 100.0 * report.ink_left
    what = "all ink, some of which was to stay," if report.limited else "the ink"
    colour = {"clean": "green", "dirty": "orange"}.get(report.verdict, "red")
    meaning = {"clean": "the camera sees no more ink that should go", "dirty": "some ink is left"}
    words = [
        f'<div class="number">{number(left, 2)} <small>% of {what} left</small></div>',
        f'<p><span class="pill" style="--tone:var(--{colour})">{escape(report.verdict)}</span>'
        f"{escape(report.reason or meaning.get(report.verdict, ''), 400)}</p>",
    ]
    slide = _slide(report)
    facts = [
        fact(
            "ink before",
            f"{number(1e4 * report.ink_before, 3)} cm²",
            f"after {number(1e4 * report.ink_after, 2)} cm²",
        ),
        fact("passes", str(len(report.passes))),
        fact("time", f"{number(report.simulated, 3)} s", f"simulated in {number(report.wall, 3)} s"),
    ]
    if slide.any():
        inside = 100.0 * float(np.mean(np.abs(report.normal[slide] - report.wanted[slide]) <= report.band))
        facts.append(
            fact(f"within ± {number(report.band)} N", f"{number(inside, 3)} %", "of the time of sliding")
        )
    facts += [
        fact(
            "commanded force",
            f"{number(_largest(report.force), 3)} N",
            f"largest; bound {number(report.max_force)} N",
        ),
        fact("contact force", f"{number(_largest(report.contact), 3)} N", "largest, truly"),
    ]
    moved = _largest(report.moved)
    if np.isfinite(moved):
        facts.append(fact("board moved", f"{number(1e3 * moved, 2)} mm", "at most, within a pass"))
    words.append(f'<dl class="facts">{"".join(facts)}</dl>')
    return f'<div class="card"><div class="words">{"".join(words)}</div></div>'


def _pictures(report: WipeReport) -> str:
    shown = [(name, p) for name, p in (("before", report.before), ("after", report.after)) if p is not None]
    if not shown:
        return ""
    figures = "".join(
        f'<figure><img src="{data_url(picture)}" alt="the board {name} wiping">'
        f'<figcaption class="read">{name}</figcaption></figure>'
        for name, picture in shown
    )
    panels = f'<div class="pair">{figures}</div>'
    note = "As the camera saw it: outline of the writing surface found, ink in red, other things in purple."
    return _page.section("Before and after", panels, _page.read(note))


def _forces(report: WipeReport) -> str:
    if not len(report.time_s):
        return ""
    key = _page.key(
        [
            ("set point", "ink", "dash"),
            ("felt, from joint torques", "blue", "line"),
            ("true", "grey", "line"),
            ("bound", "red", "line"),
        ]
    )
    text = (
        "Above: the force along the board's normal while the eraser is pressed on it. In the middle: the norm of the "
        f"force that was commanded, with its bound of {number(report.max_force)} N, and of the true contact force; "
        "dotted: 20 % above the bound. Below: the norm of the commanded moment and its bound."
    )
    figures = _both(lambda narrow: force_figure(report, narrow=narrow), "forces over time", "force")
    return _page.section("Force", key, figures, _page.read(text))


def force_figure(report: WipeReport, *, narrow: bool = False) -> Figure:
    """Normal force, norms of force and moment over time, and their bounds."""
    width = 4.2 if narrow else 10.0
    heights = (1.7, 1.4, 0.9)
    figure = _figure(width, sum(heights) + 1.15)
    time, pressed = report.time_s, report.wanted > 0.0
    bottom = 0.4
    axes = []
    for height in reversed(heights):
        axes.append(_axes(figure, 0.5, bottom, width - 0.6, height))
        bottom += height + 0.3
    below, middle, above = axes
    _line(above, time, np.where(pressed, report.normal, np.nan), _POINTS, color=LIGHT["grey"], linewidth=1.2)
    _line(
        above, time, np.where(pressed, report.estimated, np.nan), _POINTS, color=LIGHT["blue"], linewidth=0.9
    )
    wanted = np.where(pressed, report.wanted, np.nan)
    _line(above, time, wanted, _POINTS, color=LIGHT["ink"], linewidth=0.8, linestyle=(0, (4, 3)))
    _line(middle, time, report.contact, _POINTS, color=LIGHT["grey"], linewidth=1.2)
    _line(middle, time, report.force, _POINTS, color=LIGHT["blue"], linewidth=0.9)
    middle.axhline(report.max_force, color=LIGHT["red"], linewidth=0.9)
    middle.axhline(1.2 * report.max_force, color=LIGHT["red"], linewidth=0.8, linestyle=(0, (1, 2)))
    _line(below, time, report.moment, _POINTS, color=LIGHT["blue"], linewidth=0.9)
    below.axhline(report.max_torque, color=LIGHT["red"], linewidth=0.9)
    for ax, label in ((above, "normal force [N]"), (middle, "force [N]"), (below, "moment [N m]")):
        _time_limits(ax, time)
        _ticks(ax, 4 if narrow else 10, 4)
        ax.set_ylim(0.0, None)
        ax.set_title(label, loc="left")
        if ax is not below:
            ax.tick_params(labelbottom=False)
    below.set_xlabel("time [s]")
    return figure


def _maps(report: WipeReport) -> str:
    key = _page.key(
        [("slide", "blue", "line"), ("touch and lift", "orange", "line"), ("through the air", "sky", "line")]
    )
    figures = (
        f"<figure>{svg(path_figure(report), 'way of the eraser on the board', 'path', fixed=True)}</figure>"
        f"<figure>{svg(coverage_map(report), 'work of the felt on the board', 'cover', fixed=True)}</figure>"
    )
    panels = f'<div class="pair">{figures}</div>'
    text = (
        "The way of the eraser's middle in board coordinates, and the work that the felt did on each place: fresh ink "
        "needs about 12 J/m², dry ink 45 J/m². Where nothing was to be wiped nothing need be covered."
    )
    return _page.section("Way and coverage", key, panels, _page.read(text))


def _board_axes(report: WipeReport) -> tuple[Figure, Axes]:
    w, h = report.size
    width = 5.0
    height = (width - 1.3) * h / w
    figure = _figure(width, height + 0.75)
    ax = _axes(figure, 0.5, 0.42, width - 1.3, height)
    ax.set_xlim(0.0, w)
    ax.set_ylim(h, 0.0)
    ax.grid(False)
    for side in ("top", "right"):
        ax.spines[side].set_visible(True)
    ax.set_xlabel("x [m]")
    ax.set_ylabel("y [m]")
    return figure, ax


def path_figure(report: WipeReport) -> Figure:
    """The way of the eraser's middle over the board, by phase."""
    figure, ax = _board_axes(report)
    every = max(1, len(report.time_s) // 4000)
    phase, at = report.phase[::every], report.tool[::every]
    for name, colour in _WAYS.items():
        mine = phase == name
        xy = np.where(mine[:, None], at[:, :2], np.nan)
        ax.plot(xy[:, 0], xy[:, 1], color=LIGHT[colour], linewidth=1.2 if name == "slide" else 0.8)
    ax.set_title("way of the eraser", loc="left")
    return figure


def coverage_map(report: WipeReport) -> Figure:
    """Work of the felt on each place of the board."""
    figure, ax = _board_axes(report)
    w, h = report.size
    every = max(1, max(report.coverage.shape) // 220)
    work = np.asarray(report.coverage)[::every, ::every]
    top = float(np.percentile(work, 99.5)) or 1.0
    image = ax.imshow(
        work,
        extent=(0.0, w, h, 0.0),
        cmap="Blues",
        vmin=0.0,
        vmax=top,
        aspect="auto",
        interpolation="nearest",
    )
    width, height = figure.get_size_inches()
    bar = _axes(figure, width - 0.7, 0.42, 0.12, height - 0.75)
    figure.colorbar(image, cax=bar)
    bar.set_title("J/m²", fontsize=7.5, loc="left")
    ax.set_title("work of the felt", loc="left")
    return figure


def _cells(rows: Sequence[Mapping[str, str]]) -> str:
    head = list(rows[0])
    return _page.table(
        head, [[escape(v) for v in row.values()] for row in rows], frozenset(range(1, len(head)))
    )


def _passes(report: WipeReport) -> str:
    return _page.section("Passes", _cells(report.passes)) if report.passes else ""


def _events(report: WipeReport) -> str:
    if not report.events:
        return ""
    rows = [[f"{t:.2f} s", escape(kind), escape(text, 400)] for t, kind, text in report.events]
    return _page.section("What happened", _page.table(("time", "kind", ""), rows))


def _timing(report: WipeReport) -> str:
    if not report.timing:
        return ""
    note = "Wall time of one cycle of each activity, on this machine, beside everything else that it did."
    return _page.section("Timing", _cells(report.timing), _page.read(note))
