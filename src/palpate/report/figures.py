"""Figures of estimates and their errors. Functions from data to a matplotlib Figure; nothing global is touched.

Each returns a Figure made without pyplot: write it with :func:`palpate.report.save_png`, put it into a page with
:func:`palpate.report.write_study`, or use its own ``savefig``.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from palpate.errors import InputError

from . import _files, _series
from ._series import Array
from ._style import LIGHT, OTHERS, decode_png, drawing, png
from ._text import TWO_SIDED_95, clean, mass_unit, number, rounded, status_text
from .study import StudyRow
from .weighing import WeighReport

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MASS_POINTS = 3000
"""points drawn of one curve that crosses the page"""

_LINES: Mapping[str, Mapping[str, Any]] = {
    "measured": {"color": LIGHT["grey"], "linewidth": 2.2, "solid_capstyle": "butt"},
    "estimated": {"color": LIGHT["blue"], "linewidth": 1.1},
    "desired": {"color": LIGHT["ink"], "linewidth": 0.8, "linestyle": (0, (4, 3))},
}
"""styles of the usual curves"""


def line_style(name: str, index: int = 0) -> dict[str, Any]:
    """How a curve is drawn: measured, estimated and desired the same everywhere, others by their index."""
    other = {"color": LIGHT[OTHERS[index % len(OTHERS)]], "linewidth": 1.1}
    return dict(_LINES.get(name, other))


def _figure(width: float, height: float) -> Figure:
    """[inch]"""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height))


def _axes(figure: Figure, left: float, bottom: float, width: float, height: float, **options: Any) -> Axes:
    """Axes placed in inches: the same place whatever the text."""
    w, h = figure.get_size_inches()
    return figure.add_axes((left / w, bottom / h, width / w, height / h), **options)


def _line(ax: Axes, x: Array, y: Array, points: int, **style: Any) -> None:
    """A curve in few points, broken where time or values are missing; a lone value is a dot."""
    x, y = _series.break_at_gaps(x, y)
    x, y = _series.envelope(x, y, points)
    if style.pop("steps", False):
        style["drawstyle"] = "steps-post"
    ax.plot(x, y, **style)
    lone = _series.alone(y)
    if lone.size:
        dots = {k: style[k] for k in ("color", "alpha") if k in style}
        ax.plot(x[lone], y[lone], linestyle="none", marker=".", markersize=4, **dots)


def _band(ax: Axes, x: Array, low: Array, high: Array, points: int, **style: Any) -> None:
    x, low, high = _series.break_at_gaps(x, low, high)
    if len(x) == 1:  # a band without width: show its height
        ax.vlines(x, low, high, color=style["color"], alpha=0.4)
        return
    x, low, high = _series.band(x, low, high, points)
    ax.fill_between(x, low, high, linewidth=0.0, **{"alpha": 0.2, **style})


def _time_limits(ax: Axes, time: Array) -> None:
    if len(time):
        low, high = float(time.min()), float(time.max())
        ax.set_xlim(low, high if high > low else low + 1.0)


def _ticks(ax: Axes, x: int, y: int) -> None:
    """About as many ticks as there is room for."""
    from matplotlib.ticker import MaxNLocator

    ax.xaxis.set_major_locator(MaxNLocator(x, steps=[1, 2, 2.5, 5, 10]))
    ax.yaxis.set_major_locator(MaxNLocator(y, steps=[1, 2, 2.5, 5, 10]))


def _off_scale(ax: Axes, curves: Sequence[tuple[Array, Array, str]], unit: str) -> None:
    """Say where a curve leaves the picture, so that nothing is hidden by the scale."""
    low, high = ax.get_ylim()
    left, right = ax.get_xlim()
    above = below = 0
    size = float(ax.yaxis.label.get_fontsize())
    for x, y, colour in curves:
        inside = np.isfinite(y) & (x >= left) & (x <= right)
        if not inside.any():
            continue
        for index, arrow in (
            (np.where(inside, y, -np.inf).argmax(), "↑"),
            (np.where(inside, y, np.inf).argmin(), "↓"),
        ):
            up = arrow == "↑"
            if (y[index] <= high) if up else (y[index] >= low):
                continue
            row = above if up else below
            above, below = (above + 1, below) if up else (above, below + 1)
            late = (x[index] - left) > 0.6 * (right - left)
            ax.annotate(
                f"{arrow} {number(float(y[index]), 3)} {unit}",
                (float(x[index]), 1.0 if up else 0.0),
                xycoords=ax.get_xaxis_transform(),
                xytext=(-3 if late else 3, -2 - 1.2 * size * row if up else 2 + 1.2 * size * row),
                textcoords="offset points",
                ha="right" if late else "left",
                va="top" if up else "bottom",
                color=colour,
                fontsize=0.85 * size,
                parse_math=False,
            )


def _apart(centres: Sequence[float], heights: Sequence[float]) -> list[float]:
    """Centres of labels in 0..1, moved as little as possible (least squares) so that they do not overlap."""
    order = sorted(range(len(centres)), key=lambda i: centres[i])
    offset, groups = 0.0, []
    offsets = []
    for k, i in enumerate(order):
        if k:
            offset += 0.5 * (heights[i] + heights[order[k - 1]])
        offsets.append(offset)
        groups.append([centres[i] - offset, 1.0])
        while len(groups) > 1 and groups[-2][0] > groups[-1][0]:  # pool neighbours that would overlap
            (a, n), (b, m) = groups[-2:]
            groups[-2:] = [[(a * n + b * m) / (n + m), n + m]]
    base = [value for value, count in groups for _ in range(int(count))]
    placed = [0.0] * len(order)
    lowest = 0.5 * heights[order[0]] if order else 0.0
    highest = max(1.0 - offset - 0.5 * heights[order[-1]], lowest) if order else 0.0
    for i, shift, at in zip(order, offsets, base, strict=True):
        placed[i] = shift + min(max(at, lowest), highest)
    return placed


def _label_ends(ax: Axes, labels: Sequence[tuple[float, str, str]], wrap: int, size: float = 8.0) -> None:
    """Name curves beside their right ends: (value, name, colour) each; wrapped to `wrap` letters of `size` points."""
    low, high = ax.get_ylim()
    texts = [textwrap.wrap(clean(name), wrap, max_lines=3, placeholder="…") or [""] for _, name, _ in labels]
    height = 72.0 * ax.get_window_extent().height / ax.figure.dpi
    heights = [(1.2 * size * len(t) + 0.4 * size) / height for t in texts]
    values = [min(max((v - low) / (high - low), 0.0), 1.0) for v, _, _ in labels]
    for y, text, (_, _, colour) in zip(_apart(values, heights), texts, labels, strict=True):
        ax.annotate(
            "\n".join(text),
            (1.0, y),
            xycoords="axes fraction",
            xytext=(0.6 * size, 0),
            textcoords="offset points",
            va="center",
            color=colour,
            fontsize=size,
            parse_math=False,
        )


def _shade(ax: Axes, spans: Sequence[tuple[float, float, int]]) -> None:
    for begin, end, status in spans:
        if status:
            ax.axvspan(
                begin, end, color=LIGHT[status_text(status).colour], alpha=0.13, linewidth=0.0, zorder=0.5
            )


def _ribbon(ax: Axes, spans: Sequence[tuple[float, float, int]], width: float) -> None:
    """The statuses as a strip under a time axis `width` inches long, named where there is room."""
    left, right = ax.get_xlim()
    for status in sorted({s for _, _, s in spans}):
        text = status_text(status)
        mine = [(b, e - b) for b, e, s in spans if s == status]
        ax.broken_barh(mine, (0.0, 1.0), color=LIGHT[text.colour], alpha=0.55, linewidth=0.0)
        begin, length = max(mine, key=lambda m: m[1])
        if length / (right - left) * width > 0.068 * len(text.name) + 0.06:
            ax.text(
                begin + 0.5 * length,
                0.46,
                text.name,
                ha="center",
                va="center",
                fontsize="small",
                clip_on=True,
            )
    ax.set_ylim(0.0, 1.0)
    ax.set_yticks([])
    ax.grid(False)
    ax.spines["left"].set_visible(False)


def _mass_range(report: WeighReport, factor: float) -> tuple[float, float]:
    """What the vertical axis shows: zero, the truth, and the estimates without their first wild moments."""
    ok = report.status == 0
    values: list[float] = [0.0]
    for curve, used in ((report.mass, ok), *((v, ok) for v in report.others.values())):
        finite = np.isfinite(curve)
        chosen = curve[finite & used] if (finite & used).any() else curve[finite]
        if chosen.size:
            values.extend(float(p) for p in np.percentile(chosen, (0.5, 99.5)))
    values.extend(float(v) for v in report.truth[1] if math.isfinite(v))
    headline, std = report.headline.mass, report.headline.std
    if math.isfinite(headline):
        values.append(headline)
        if math.isfinite(std) and std < abs(headline):
            values.extend((headline - TWO_SIDED_95 * std, headline + TWO_SIDED_95 * std))
    low, high = min(values) * factor, max(values) * factor
    margin = 0.12 * (high - low) or 1.0
    return low - (margin if low < 0.0 else 0.35 * margin), high + margin


def _truth_steps(report: WeighReport) -> tuple[Array, Array]:
    """The truth as corners of a staircase within the samples' time."""
    time = report.time_s
    low, high = float(time.min()), float(time.max())
    steps = report.truth[0]
    corners = np.concatenate(([low], steps[(steps > low) & (steps < high)], [high]))
    return corners, report.truth_at(corners)


def mass_figure(report: WeighReport, *, narrow: bool = False) -> Figure:
    """Mass over time with its 95 % band, the truth and other estimators; a close-up of the settled part.

    Args:
        report: the data; see :class:`WeighReport`.
        narrow: for a phone: the close-up below instead of beside, and no names at the curves.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    with drawing():
        points = MASS_POINTS // 3 if narrow else MASS_POINTS
        close_up = len(report.time_s) >= 20 and math.isfinite(report.headline.mass)
        width = 3.25 if narrow else (5.45 if close_up else 8.4)
        figure = _figure(4.0 if narrow else 10.4, (5.4 if close_up else 3.2) if narrow else 3.7)
        bottom = 2.75 if narrow and close_up else 0.62
        main = _axes(figure, 0.62, bottom, width, 2.35 if narrow else 2.8)
        strip = _axes(figure, 0.62, bottom - 0.2, width, 0.16, sharex=main)
        factor, unit = _draw_mass(main, report, points, labels=not narrow)
        spans = _series.spans(report.time_s, report.status)
        _ribbon(strip, spans, width)
        _ticks(main, 6 if narrow else 9, 6)
        main.tick_params(bottom=False, labelbottom=False)
        strip.set_xlabel("time [s]")
        if close_up:
            place = (0.62, 0.42, 3.25, 1.5) if narrow else (7.95, bottom, 2.3, 2.8)
            _draw_close_up(_axes(figure, *place), main, report, factor, unit, points)
        return figure


def _draw_mass(
    ax: Axes, report: WeighReport, points: int, *, labels: bool, size: float = 8.0, thick: float = 1.0
) -> tuple[float, str]:
    """Everything of the mass over the whole time; returns the unit's factor and name.

    `size` of the names at the curves in points; `thick` multiplies the widths of the lines.
    """
    time, mass, std = report.time_s, report.mass, report.std
    factor, unit = mass_unit([report.headline.mass, *report.truth[1].tolist()])
    ax.set_ylim(*_mass_range(report, factor))
    _time_limits(ax, time)
    ax.set_ylabel(f"mass [{unit}]")
    _shade(ax, _series.spans(time, report.status))
    # drawn beyond the picture a band of kilometres would only cost digits
    low, high = ax.get_ylim()
    far = 5.0 * (high - low)
    half = TWO_SIDED_95 * std
    _band(
        ax,
        time,
        np.maximum((mass - half) * factor, low - far),
        np.minimum((mass + half) * factor, high + far),
        points,
        color=LIGHT["blue"],
    )
    ends: list[tuple[float, str, str]] = []
    curves: list[tuple[Array, Array, str]] = []

    def draw(y: Array, where: npt.NDArray[np.bool_], **style: Any) -> None:
        _line(ax, time, np.where(where, np.clip(y * factor, low - far, high + far), np.nan), points, **style)

    def name_end(y: Array, name: str, colour: str) -> None:
        curves.append((time, y * factor, colour))
        known = np.flatnonzero(np.isfinite(y))
        if known.size:
            ends.append((float(y[known[-1]]) * factor, name, colour))

    for index, (name, other) in enumerate(report.others.items()):
        style = line_style("", index)
        draw(other, np.isfinite(other), color=style["color"], linewidth=1.1 * thick)
        name_end(other, name, style["color"])
    ok = report.status == 0
    draw(mass, ~ok | _series.beside(~ok), color=LIGHT["blue"], linewidth=0.7 * thick, alpha=0.5)
    draw(mass, ok, color=LIGHT["blue"], linewidth=1.5 * thick)
    name_end(mass, "palpate ± 95 %" if np.isfinite(std).any() else "palpate", LIGHT["blue"])
    if report.truth_known:
        corners, values = _truth_steps(report)
        ax.plot(
            corners,
            values * factor,
            color=LIGHT["ink"],
            linewidth=0.9 * thick,
            linestyle=(0, (5, 3)),
            drawstyle="steps-post",
        )
        ends.append((float(values[np.isfinite(values)][-1]) * factor, "truth", LIGHT["ink"]))
    for moment in np.asarray(report.changes)[:50]:
        ax.axvline(moment, color=LIGHT["muted"], linewidth=0.7 * thick, linestyle=(0, (1, 2)))
    _off_scale(ax, curves, unit)
    if labels:
        _label_ends(ax, ends, 15, size)
    return factor, unit


def _draw_close_up(ax: Axes, main: Axes, report: WeighReport, factor: float, unit: str, points: int) -> None:
    """The settled part, so near that the band has a width."""
    begin, end = report.settled
    time, mass, std = report.time_s, report.mass, report.std
    shown = (time >= begin) & (time <= end)
    headline = report.headline.mass
    deviations = [np.abs(mass[shown] - headline), 1.5 * TWO_SIDED_95 * std[shown]]
    deviations.append(np.abs(report.truth_at(time[shown]) - headline))
    spread = np.concatenate(deviations)
    spread = spread[np.isfinite(spread)]
    reach = 1.25 * float(np.percentile(spread, 99.0)) if spread.size else 0.0
    reach = max(reach, 1e-4 * abs(headline), 1e-9) * factor
    ax.set_ylim(headline * factor - reach, headline * factor + reach)
    ax.set_xlim(begin, end if end > begin else begin + 1.0)
    half = TWO_SIDED_95 * std
    _band(
        ax,
        time[shown],
        (mass - half)[shown] * factor,
        (mass + half)[shown] * factor,
        points // 2,
        color=LIGHT["blue"],
    )
    _line(ax, time[shown], mass[shown] * factor, points // 2, color=LIGHT["blue"], linewidth=1.5)
    truth = report.truth_at(time[shown]) * factor
    if np.isfinite(truth).any():
        _line(
            ax,
            time[shown],
            truth,
            points // 2,
            steps=True,
            color=LIGHT["ink"],
            linewidth=0.9,
            linestyle=(0, (5, 3)),
        )
    _ticks(ax, 4, 6)
    ax.set_title("close-up", loc="left", color=LIGHT["muted"])
    ax.set_xlabel("time [s]")
    ax.set_ylabel(f"mass [{unit}]")
    # where in the large picture this is
    across = main.get_xaxis_transform()
    main.plot([begin, end], [1.02, 1.02], transform=across, clip_on=False, color=LIGHT["grey"], linewidth=2.0)
    main.annotate(
        "close-up",
        (0.5 * (begin + end), 1.02),
        xycoords=across,
        xytext=(0, 3),
        textcoords="offset points",
        ha="center",
        fontsize="small",
        color=LIGHT["muted"],
    )


def _per_joint(value: npt.ArrayLike, shape: tuple[int, int] | None, what: str) -> Array:
    array = _series.finite(value)
    if array.ndim != 2 or (shape is not None and array.shape != shape):
        expected = "(N, n)" if shape is None else str(shape)
        raise InputError(f"{what} must have shape {expected}, got {array.shape}")
    return array


def joints_figure(
    time_s: npt.ArrayLike,
    curves: Mapping[str, npt.ArrayLike],
    joint_names: Sequence[str],
    *,
    quantity: str = "position",
    unit: str | Sequence[str] = "rad",
    std: npt.ArrayLike | None = None,
    notes: Sequence[str] | None = None,
    columns: int = 2,
    key: bool = True,
    points: int = 900,
) -> Figure:
    """One panel per joint with the same few curves in each.

    Args:
        time_s: (N,) [s].
        curves: by name, (N, n) each; "measured", "estimated" and "desired" look the same in every figure.
        joint_names: n names.
        quantity: what the vertical axes show.
        unit: of it, one for all or one per joint.
        std: (N, n) standard deviation of the last curve, drawn as a band of ± 2 of them.
        notes: n remarks, right above each panel.
        columns: panels beside each other.
        key: name the curves above the panels.
        points: drawn of each curve at most.

    Raises:
        InputError: shapes do not fit.
        MissingExtraError: matplotlib is not installed.
    """
    n = len(joint_names)
    time = _series.finite(time_s)
    if time.ndim != 1 or np.isnan(time).any():
        raise InputError(f"time_s must be finite and of shape (N,), got shape {time.shape}")
    lines = {name: _per_joint(v, (len(time), n), f"curve {name!r:.80}") for name, v in curves.items()}
    deviation = None if std is None else _per_joint(std, (len(time), n), "std")
    units = [unit] * n if isinstance(unit, str) else list(unit)
    if len(units) != n or (notes is not None and len(notes) != n):
        raise InputError(f"unit and notes must hold one text per joint, {n}")
    if columns < 1:
        raise InputError(f"columns must be >= 1, got {columns}")
    columns = min(columns, max(n, 1))
    rows = max(-(-n // columns), 1)
    with drawing():
        top = 0.32 if key else 0.02
        wide, high = 3.5, 1.72
        figure = _figure(columns * wide, rows * high + top)
        for joint, name in enumerate(joint_names):
            row, column = divmod(joint, columns)
            ax = _axes(figure, column * wide + 0.74, (rows - 1 - row) * high + 0.4, wide - 0.82, high - 0.66)
            last = None
            _time_limits(ax, time)
            shown = [v[:, joint] for v in lines.values()]
            if deviation is not None and shown:
                last = shown[-1]
                half = 2.0 * deviation[:, joint]
                ax.set_ylim(*_series.limits([last, *_middle(last, half)]))
                low, up = ax.get_ylim()
                far = 5.0 * (up - low)
                _band(
                    ax,
                    time,
                    np.maximum(last - half, low - far),
                    np.minimum(last + half, up + far),
                    points,
                    color=LIGHT["blue"],
                )
                ax.axhline(0.0, color=LIGHT["grey"], linewidth=0.7)
            elif shown:
                ax.set_ylim(*_series.limits(shown))
            drawn = []
            for index, (label, values) in enumerate(lines.items()):
                style = line_style(label, index)
                if len(lines) == 1:
                    style["linewidth"] = 1.1
                if deviation is not None:  # noise as wide as its band must leave the band to be seen
                    style["linewidth"] = 0.6
                _line(ax, time, values[:, joint], points, **style)
                drawn.append((time, values[:, joint], style["color"]))
            _off_scale(ax, drawn, clean(units[joint], 12))
            _ticks(ax, 6, 4)
            short = _short(name, 36 if notes is None else 22)
            ax.set_title(
                short, loc="left", y=1.0, parse_math=False
            )  # y given: not searched for, much quicker
            if notes is not None:
                ax.set_title(
                    clean(notes[joint], 60),
                    loc="right",
                    y=1.0,
                    fontsize="small",
                    color=LIGHT["muted"],
                    parse_math=False,
                )
            ax.set_ylabel(f"{clean(quantity, 20)} [{clean(units[joint], 12)}]", parse_math=False)
            ax.set_xlabel("time [s]", labelpad=1.0)
        if key:
            _key(figure, list(lines), deviation is not None)
        return figure


def _short(name: str, limit: int) -> str:
    """A name cut in the middle: joints often differ at the end."""
    text = clean(name)
    return text if len(text) <= limit else f"{text[: limit // 3]}…{text[-(limit - limit // 3 - 1) :]}"


def _middle(value: Array, half: Array) -> tuple[Array, Array]:
    """Typical lower and upper edge of a band that may be huge at first."""
    finite = half[np.isfinite(half)]
    usual = float(np.median(finite)) if finite.size else 0.0
    return value - usual, value + usual


def _key(figure: Figure, names: Sequence[str], banded: bool) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles: list[Any] = [Line2D([], [], **line_style(name, i)) for i, name in enumerate(names)]
    labels = [clean(name, 40) for name in names]
    if banded:
        handles.append(Patch(color=LIGHT["blue"], alpha=0.2, linewidth=0.0))
        labels.append("± 2 standard deviations")
    if not handles:
        return
    w, h = figure.get_size_inches()
    legend = figure.legend(
        handles,
        labels,
        loc="upper left",
        bbox_to_anchor=(0.5 / w, 1.0 - 0.04 / h),
        ncols=len(handles),
        frameon=False,
        borderaxespad=0.0,
        handlelength=1.8,
    )
    for text in legend.get_texts():
        text.set_parse_math(False)


def torque_figure(
    time_s: npt.ArrayLike,
    torque: npt.ArrayLike,
    std: npt.ArrayLike | None,
    joint_names: Sequence[str],
    *,
    unit: str | Sequence[str] = "N m",
    columns: int = 2,
    key: bool = True,
    points: int = 900,
) -> Figure:
    """External torque of each joint with a band of ± 2 standard deviations; > 0 when the environment pushes.

    Args:
        time_s: (N,) [s].
        torque: (N, n) [N m].
        std: (N, n) [N m], or None.
        joint_names: n names.
        unit: one for all or one per joint, N for a prismatic one.
        columns: panels beside each other.
        key: name the curves above the panels.
        points: drawn of each curve at most.

    Raises:
        InputError: shapes do not fit.
        MissingExtraError: matplotlib is not installed.
    """
    values = _per_joint(torque, None, "torque")
    units = [unit] * len(joint_names) if isinstance(unit, str) else list(unit)
    notes = []
    for joint in range(min(values.shape[1], len(units))):
        finite = np.flatnonzero(np.isfinite(values[:, joint]))
        if not finite.size:
            notes.append("no value")
            continue
        row = int(finite[-1])
        spread = math.nan if std is None else 2.0 * float(np.asarray(std, dtype=np.float64)[row, joint])
        value, half = rounded(float(values[row, joint]), spread)
        notes.append(f"{value} ± {half} {units[joint]} at the end" if half != "?" else f"{value} at the end")
    return joints_figure(
        time_s,
        {"estimated": values},
        joint_names,
        quantity="torque",
        unit=units,
        std=std,
        notes=notes,
        columns=columns,
        key=key,
        points=points,
    )


def normalised_error(report: WeighReport) -> Array:
    """(N,) error of the mass in its own standard deviations; NaN where status is not ok or truth is unknown."""
    mass, std = report.mass, report.std
    error = mass - report.truth_at(report.time_s)
    usable = (report.status == 0) & np.isfinite(error) & np.isfinite(std) & (std > 0.0)
    return np.divide(error, std, out=np.full(len(mass), np.nan), where=usable)


def error_figure(report: WeighReport, *, narrow: bool = False) -> Figure:
    """Error of the mass divided by its standard deviation, with the 95 % band; beyond ± 6 drawn at the edge.

    Args:
        report: the data, with a truth and standard deviations.
        narrow: for a phone.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    with drawing():
        figure = _figure(4.0, 2.0) if narrow else _figure(10.4, 2.1)
        ax = _axes(figure, 0.62, 0.45, 3.25 if narrow else 8.4, 1.45 if narrow else 1.55)
        time = report.time_s
        _time_limits(ax, time)
        ax.set_ylim(-6.3, 6.3)
        ax.axhspan(-TWO_SIDED_95, TWO_SIDED_95, color=LIGHT["blue"], alpha=0.14, linewidth=0.0)
        ax.axhline(0.0, color=LIGHT["ink"], linewidth=0.8, linestyle=(0, (5, 3)))
        _line(
            ax,
            time,
            np.clip(normalised_error(report), -6.0, 6.0),
            MASS_POINTS // (3 if narrow else 1),
            color=LIGHT["blue"],
            linewidth=1.0,
        )
        for moment in np.asarray(report.changes)[:50]:
            ax.axvline(moment, color=LIGHT["muted"], linewidth=0.7, linestyle=(0, (1, 2)))
        if not narrow:
            _label_ends(ax, [(0.0, "95 % band", LIGHT["blue"])], 15)
        _ticks(ax, 6 if narrow else 9, 6)
        ax.set_yticks([-6, -4, -2, 0, 2, 4, 6])
        ax.set_xlabel("time [s]")
        ax.set_ylabel("error / σ")
        return figure


def coverage_figure(error: npt.ArrayLike, std: npt.ArrayLike) -> Figure:
    """Are the stated standard deviations true? Share of errors inside each interval, and errors / σ counted.

    Args:
        error: (M,) estimate minus truth, one of each independent run.
        std: (M,) standard deviation stated with it, > 0. Runs with a value that is not finite are left out.

    Raises:
        InputError: shapes differ, or a standard deviation is not positive.
        MissingExtraError: matplotlib is not installed.
    """
    errors, spread = _series.finite(error), _series.finite(std)
    if errors.ndim != 1 or errors.shape != spread.shape:
        raise InputError(
            f"error and std must have the same shape (M,), got {errors.shape} and {spread.shape}"
        )
    if np.any(spread <= 0.0):
        raise InputError("std must be > 0")
    finite = np.isfinite(errors) & np.isfinite(spread)
    z = errors[finite] / spread[finite]
    with drawing():
        figure = _figure(7.2, 3.3)
        left = _axes(figure, 0.6, 0.5, 2.6, 2.45)
        right = _axes(figure, 4.1, 0.5, 2.9, 2.45)
        stated = np.linspace(0.0, 1.0, 101)
        left.plot(stated, stated, color=LIGHT["ink"], linewidth=0.9, linestyle=(0, (5, 3)))
        left.set_xlim(0.0, 1.0)
        left.set_ylim(0.0, 1.02)
        left.set_xlabel("stated probability")
        left.set_ylabel("share of runs inside")
        density = np.exp(-0.5 * np.square(grid := np.linspace(-4.0, 4.0, 161))) / math.sqrt(2.0 * math.pi)
        right.plot(grid, density, color=LIGHT["ink"], linewidth=0.9, linestyle=(0, (5, 3)))
        right.set_xlim(-4.0, 4.0)
        right.set_xlabel("error / σ; beyond ± 4 counted in the last bars")
        right.set_ylabel("density")
        if z.size:
            # P(|Z| < r) = erf(r / sqrt 2): the probability at which each run's interval just holds the truth
            level = np.sort([math.erf(abs(v) / math.sqrt(2.0)) for v in z])
            share = np.searchsorted(level, stated, side="right") / z.size
            chance = TWO_SIDED_95 * np.sqrt(stated * (1.0 - stated) / z.size)
            left.fill_between(
                stated, stated - chance, stated + chance, color=LIGHT["grey"], alpha=0.2, linewidth=0.0
            )
            left.plot(stated, share, color=LIGHT["blue"], linewidth=1.4, drawstyle="steps-post")
            inside = float(np.mean(np.abs(z) <= TWO_SIDED_95))
            left.plot([0.95], [inside], marker="o", markersize=4, color=LIGHT["blue"])
            left.annotate(
                f"95 % interval holds\nthe truth in {100 * inside:.1f} %\nof {z.size} runs",
                (0.95, inside),
                xytext=(0.94, 0.08),
                textcoords="axes fraction",
                ha="right",
                color=LIGHT["blue"],
            )
            left.text(
                0.04, 0.95, "grey: chance", transform=left.transAxes, color=LIGHT["muted"], fontsize="small"
            )
            bins = int(min(max(round(2.0 * math.sqrt(z.size)), 8), 40))
            right.hist(
                np.clip(z, -4.0, 4.0),
                bins=bins,
                range=(-4.0, 4.0),
                density=True,
                color=LIGHT["blue"],
                alpha=0.45,
            )
        left.set_title("calibration", loc="left")
        right.set_title("errors in units of σ", loc="left")
        return figure


def table_figure(rows: Sequence[StudyRow], *, title: str = "") -> Figure:
    """The rows of a study as a picture for a slide.

    Args:
        rows: at most 40.
        title: above the table.

    Raises:
        InputError: too many rows for one picture.
        MissingExtraError: matplotlib is not installed.
    """
    if len(rows) > 40:
        raise InputError(f"a table in a picture has at most 40 rows, got {len(rows)}")
    with drawing():
        height = 0.32 * (len(rows) + 1) + (0.55 if title else 0.2)
        figure = _figure(9.0, height)
        ax = _axes(figure, 0.2, 0.1, 8.6, height - 0.2)
        ax.set_axis_off()
        ax.set_xlim(0.0, 8.6)
        ax.set_ylim(height - 0.2, 0.0)
        y = 0.15
        if title:
            ax.text(0.0, y, clean(title, 110), fontsize=11, fontweight="bold", va="center", parse_math=False)
            y += 0.38
        places = (
            (0.0, "left", 52),
            (5.0, "right", 22),
            (6.4, "right", 22),
            (7.7, "right", 18),
            (8.5, "right", 8),
        )
        head = ("quantity", "published or required", "palpate", "tolerance", "")
        for line, cells in enumerate((head, *(row.cells() for row in rows))):
            for column, ((x, align, limit), text) in enumerate(zip(places, cells, strict=True)):
                colour = LIGHT["muted"] if line == 0 else LIGHT["ink"]
                if line and column == 4:
                    colour = LIGHT["green" if rows[line - 1].ok else "red"]
                ax.text(
                    x,
                    y,
                    clean(text, limit),
                    ha=align,
                    va="center",
                    color=colour,
                    fontsize=8.5,
                    parse_math=False,
                )
            y += 0.16
            ax.plot([0.0, 8.6], [y, y], color=LIGHT["grid"], linewidth=0.7)
            y += 0.16
        return figure


def save_png(figure: Figure, path: str | PathLike[str]) -> Path:
    """Write a figure as PNG at its own size and resolution; the same bytes for the same figure.

    Raises:
        InputError: the file cannot be written.
    """
    return _files.write(path, png(figure))


def hero_picture(report: WeighReport, path: str | PathLike[str]) -> Path:
    """One picture that says it all, 1600 x 700 pixels: the arm with its load, and the mass it finds.

    Args:
        report: the data, with a picture of the arm.
        path: PNG file to write.

    Raises:
        InputError: the report has no picture or a damaged one, or the file cannot be written.
        MissingExtraError: matplotlib is not installed.
    """
    if report.picture is None:
        raise InputError("hero_picture needs a report with a picture of the arm")
    pixels = decode_png(report.picture)
    with drawing():
        figure = _figure(16.0, 7.0)
        figure.set_facecolor(LIGHT["paper"])
        scene = _axes(figure, 0.0, 0.0, 6.2, 7.0)
        _cover(scene, pixels, 6.2 / 7.0)
        _draw_hero(figure, report)
    return save_png(figure, path)


def _cover(ax: Axes, pixels: npt.NDArray[np.uint8], aspect: float) -> None:
    """The middle of a picture, filling axes of width / height = aspect."""
    height, width = pixels.shape[:2]
    w, h = min(width, max(round(height * aspect), 1)), min(height, max(round(width / aspect), 1))
    left, top = (width - w) // 2, (height - h) // 2
    ax.imshow(pixels[top : top + h, left : left + w], aspect="auto", interpolation="lanczos")
    ax.set_axis_off()


def _draw_hero(figure: Figure, report: WeighReport) -> None:
    _, mass, std, _, truth = report.headline
    factor, unit = mass_unit([mass, *report.truth[1].tolist()])
    value, half = rounded(mass * factor, TWO_SIDED_95 * std * factor)
    words = [f"± {half} {unit} (95 %)"] if half != "?" else []
    if math.isfinite(truth):
        words.append(f"truth {number(truth * factor)} {unit}")
    if report.time_to_2_percent_s is not None and math.isfinite(report.time_to_2_percent_s):
        words.append(f"within 2 % after {number(report.time_to_2_percent_s, 3)} s")
    for x, y, text, size, colour, weight in (
        (6.7, 6.5, clean(report.title, 80), 15.0, "muted", "normal"),
        (6.68, 5.75, f"{value} {unit}", 44.0, "blue", "bold"),
        (6.7, 5.3, "   ·   ".join(words), 17.0, "muted", "normal"),
    ):
        figure.text(
            x / 16, y / 7, text, fontsize=size, color=LIGHT[colour], fontweight=weight, parse_math=False
        )
    ax = _axes(figure, 7.3, 0.85, 6.65, 4.0)
    for label in (ax.xaxis.label, ax.yaxis.label):
        label.set_fontsize(16.0)
    ax.tick_params(labelsize=15.0)
    _draw_mass(ax, report, MASS_POINTS, labels=True, size=15.0, thick=1.8)
    for name in ("left", "bottom"):
        ax.spines[name].set(linewidth=1.2, color=LIGHT["ink"])
    _ticks(ax, 7, 6)
    ax.set_xlabel("time [s]")
