"""Figures of studies. Functions from data to a matplotlib Figure, in the reports' style."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from ..arm import Array
from ..report._style import LIGHT, OTHERS, drawing

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Curve = tuple[Array, Array]
_POINTS = 1500
_COLOURS = ("blue", *OTHERS)


def drawn(draw: Callable[[], Mapping[str, Figure]]) -> Mapping[str, Figure]:
    """The figures, or none where matplotlib is not installed."""
    return draw() if importlib.util.find_spec("matplotlib") else {}


def colour(index: int) -> str:
    """Of the curve number `index`."""
    return LIGHT[_COLOURS[index % len(_COLOURS)]]


def curves(
    lines: Mapping[str, Curve],
    label: str,
    *,
    level: tuple[float, str] | None = None,
    marks: Mapping[str, tuple[Sequence[float], Sequence[float]]] | None = None,
    band: tuple[Array, Array, Array] | None = None,
    limits: tuple[float, float, float, float] | None = None,
    log: bool = False,
    across: str = "time [s]",
) -> Figure:
    """Curves over time by name.

    Args:
        lines: (x, y) by name.
        label: of the vertical axis, with unit.
        level: a horizontal line and its name.
        marks: points by name.
        band: x, lower and upper edge, in the first curve's colour.
        limits: left, right, bottom, top.
        log: vertical axis logarithmic.
        across: label of the horizontal axis.
    """
    from matplotlib.figure import Figure

    with drawing():
        figure = Figure(figsize=(8.4, 3.4), layout="constrained")
        ax = figure.add_subplot()
        _plot(ax, lines, log)
        if band is not None:
            x, low, high = np.array(band)[:, :: max(1, len(band[0]) // _POINTS)]
            ax.fill_between(x, low, high, color=colour(0), alpha=0.2, linewidth=0.0)
        if level is not None:
            ax.axhline(level[0], color=LIGHT["ink"], linewidth=0.8, linestyle=(0, (4, 3)), label=level[1])
        for name, points in (marks or {}).items():
            ax.plot(*points, "o", color=LIGHT["ink"], markersize=4, fillstyle="none", label=name, zorder=5)
        if limits is not None:
            ax.set_xlim(*limits[:2])
            ax.set_ylim(*limits[2:])
        ax.set_xlabel(across)
        ax.set_ylabel(label)
        ax.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
        return figure


def _plot(ax: Axes, lines: Mapping[str, Curve], log: bool) -> None:
    for index, (name, (x, y)) in enumerate(lines.items()):
        step = max(1, len(x) // _POINTS)
        ax.plot(np.asarray(x)[::step], np.asarray(y)[::step], color=colour(index), linewidth=1.1, label=name)
    if log:
        ax.set_yscale("log")
