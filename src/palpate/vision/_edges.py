"""From a rough quadrangle around a board to the edges of its writing surface, to a fraction of a pixel."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ..arm import Array
from ._image import Float, Image
from ._quads import homographies, mapped

ALONG = 96
"""samples along a side"""
PIECES = 12
"""a side is looked at in so many pieces"""
OUTWARD, INWARD = 0.04, 0.16
"""how far from the rough side the surface's edge is looked for, relative to the board"""
MOST = 0.6
"""part of the pieces in which an edge must be seen"""


@dataclass(frozen=True, slots=True)
class Edges:
    """Sides of a writing surface."""

    corners: Array
    """(4, 2) where the fitted sides meet [pixels]"""
    seen: Array
    """(4,) part of each side where its edge was found"""
    spread: Array
    """(4,) deviation of the edge points from the fitted line [pixels]"""


def fit(grey: Image, corners: Array, border: Array) -> Edges:
    """Find the inner edges and fit lines to them.

    Args:
        grey: (H, W).
        corners: (4, 2) rough, clockwise.
        border: (4,) bool: this side is the picture's border and stays.
    """
    smooth = cv2.GaussianBlur(grey, (0, 0), 1.0)
    inner = _inner(smooth, corners, border)
    found = _fitted(smooth, inner, border, 5.0)
    return _fitted(smooth, found.corners, border, 3.0)


def strip(grey: Image, corners: Array, side: int, low: float, high: float, count: int) -> tuple[Float, Array, float]:
    """The picture along one side: rows from outside to inside.

    Args:
        grey: (H, W).
        corners: (4, 2).
        side: from corner `side` to the next.
        low, high: first and last row, relative to the board's extent across the side; negative: outside.
        count: rows.

    Returns:
        brightness (count, ALONG); the points (count, ALONG, 2); pixels per row.
    """
    H = homographies(np.roll(corners, -side, 0)[None])
    u = np.linspace(0.04, 0.96, ALONG)
    v = np.linspace(low, high, count)
    points = mapped(H, np.stack(np.meshgrid(u, v), -1).reshape(-1, 2))[0].reshape(count, ALONG, 2)
    level = cv2.remap(grey, points.astype(np.float32), None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    step = float(np.linalg.norm(points[-1] - points[0], axis=1).mean()) / (count - 1)
    return level.astype(np.float32), points, step


def _inner(grey: Image, corners: Array, border: Array) -> Array:
    """The quadrangle of the innermost edges near the rough one."""
    moved = np.zeros(4)
    for side in range(4):
        if border[side]:
            continue
        a, b, c, d = np.roll(corners, -side, 0)
        across = 0.5 * (np.linalg.norm(d - a) + np.linalg.norm(c - b))
        rows = int(np.clip((INWARD + OUTWARD) * across, 24, 160))
        level, _, _ = strip(grey, corners, side, -OUTWARD, INWARD, rows)
        at = _innermost(level, OUTWARD / (INWARD + OUTWARD) * (rows - 1))
        moved[side] = -OUTWARD + (INWARD + OUTWARD) * at / (rows - 1)
    u = np.array([[moved[3], moved[0]], [1 - moved[1], moved[0]], [1 - moved[1], 1 - moved[2]], [moved[3], 1 - moved[2]]])
    return mapped(homographies(corners[None]), u)[0]


def _innermost(level: Float, start: float) -> float:
    """Row of the writing surface's edge in a strip (rows, ALONG), from outside to inside; `start`: the rough one."""
    rows = len(level)
    step = np.zeros_like(level)
    step[1:-1] = level[2:] - level[:-2]
    # per piece the median over its columns: a stroke or a magnet covers few of them
    pieces = np.median(step.reshape(rows, PIECES, -1), 2)
    noise = 1.4826 * np.median(np.abs(pieces)) if rows > 8 else 0.0
    threshold = max(4.0, 4.0 * float(noise))
    # an edge may slant by a row or two within the strip
    wide = cv2.dilate(np.abs(pieces).astype(np.float32), np.ones((3, 1), np.uint8))
    share = (wide > threshold).mean(1)
    strength = np.median(wide, 1)
    peak = strength >= cv2.dilate(strength, np.ones((5, 1), np.uint8)).ravel() - 1e-6
    near = slice(max(0, int(start) - 4), int(start) + 5)
    reference = max(float(strength[near].max()), 0.5 * float(strength.max()))
    edges = np.flatnonzero(peak & (share >= MOST) & (strength > 0.25 * reference))
    if not len(edges):
        return start
    return float(edges.max())


def _fitted(grey: Image, corners: Array, border: Array, reach: float) -> Edges:
    """Lines through the strongest step within `reach` pixels of each side."""
    lines = np.zeros((4, 3))
    seen, spread = np.ones(4), np.zeros(4)
    for side in range(4):
        p, q = corners[side], corners[(side + 1) % 4]
        direction = (q - p) / np.linalg.norm(q - p)
        inward = np.array([-direction[1], direction[0]])
        lines[side] = *inward, inward @ p
        if border[side]:
            continue
        t = np.linspace(0.04, 0.96, ALONG)
        v = np.arange(-reach - 1.5, reach + 1.6, 0.5)
        points = (p + t[:, None] * (q - p))[None] + v[:, None, None] * inward
        level = cv2.remap(
            grey, points.astype(np.float32), None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        ).astype(np.float32)
        step = level[2:] - level[:-2]
        sign = np.sign(np.median(step[np.abs(np.median(step, 1)).argmax()]))
        score = step * sign
        best = score[1:-1].argmax(0) + 1
        columns = np.arange(ALONG)
        middle, before, after = (score[best + k, columns] for k in (0, -1, 1))
        bend = before - 2.0 * middle + after
        shift = np.where(bend < -1e-3, 0.5 * (before - after) / np.where(bend < -1e-3, bend, -1.0), 0.0)
        at = v[1:-1][best] + 0.5 * np.clip(shift, -1, 1)
        good = middle > max(3.0, 0.3 * float(np.median(middle)))
        seen[side] = good.mean()
        if good.sum() < 8:
            continue
        a, b, spread[side] = _robust(t[good], at[good])
        ends = np.array([p + (a + b * 0.0) * inward, q + (a + b) * inward])
        direction = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
        normal = np.array([-direction[1], direction[0]])
        lines[side] = *normal, normal @ ends[0]
    met = np.array([np.linalg.solve(lines[[k - 1, k], :2], lines[[k - 1, k], 2]) for k in range(4)])
    return Edges(met, seen, spread)


def _robust(t: Array, y: Array) -> tuple[float, float, float]:
    """y = a + b t by reweighted least squares (Tukey), started from a median of slopes; and the spread."""
    half = len(t) // 2
    slopes = (y[half : 2 * half] - y[:half]) / (t[half : 2 * half] - t[:half])
    b = float(np.median(slopes))
    a = float(np.median(y - b * t))
    scale = 1.0
    for _ in range(5):
        off = y - a - b * t
        scale = max(1.4826 * float(np.median(np.abs(off))), 0.1)
        weight = np.maximum(1.0 - (off / (4.0 * scale)) ** 2, 0.0) ** 2
        total = weight.sum()
        tm, ym = (weight @ t) / total, (weight @ y) / total
        b = float((weight * (t - tm)) @ (y - ym) / max((weight * (t - tm)) @ (t - tm), 1e-9))
        a = float(ym - b * tm)
    return a, b, scale
