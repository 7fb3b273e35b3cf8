"""From a rough quadrangle around a board to the edges of its writing surface, to a fraction of a pixel."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ..arm import Array
from ._image import Float, Image, Index, Mask
from ._quads import homographies, mapped

ALONG = 60
"""samples along a side"""
PIECES = 12
"""a side is looked at in so many pieces"""
OUTWARD, INWARD = 0.03, 0.11
"""how far from the rough side the surface's edge is looked for, relative to the board"""
ROWS = 110
"""steps looked at across a side"""
SLANTS = np.array([[-0.02, 0.02], [0.02, -0.02], [-0.045, 0.045], [0.045, -0.045], [0.0, 0.06], [0.06, 0.0]])
"""how a side may run askew, relative to the board at its two ends"""
FAINT = 0.12
"""an edge is at least so strong, relative to the strongest along its side"""
GAP = 0.08
"""a frame shows an edge at least every so often, relative to the board"""
BOW = 0.4
"""a side is straight if its middle is nearer to its chord [pixels]"""
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


def fit(image: Image, corners: Array, border: Mask) -> Edges:
    """Find the inner edges and fit lines to them.

    Args:
        image: (H, W, 3).
        corners: (4, 2) rough, clockwise.
        border: (4,) bool: this side is the picture's border and stays.
    """
    return _fitted(image, _inner(image, corners, border), border, 3.5)


def _sampled(image: Image, points: Array) -> Float:
    """The picture (H, W, 3) at points (R, C, 2), between pixels linearly: (R, C, 3)."""
    at = points.astype(np.float32)
    return cv2.remap(image, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(np.float32)


@dataclass(frozen=True, slots=True)
class _Steps:
    """Edges along a whole side, from outside to inside, as fractions of the board's extent across the side."""

    begin: Array
    """(M,) distance from the rough side at its first corner"""
    end: Array
    """(M,) at its second corner"""
    strength: float
    """of all of them together [grey levels over two rows]"""

    @property
    def middle(self) -> Array:
        return 0.5 * (self.begin + self.end)


def _inner(image: Image, corners: Array, border: Mask) -> Array:
    """The quadrangle of the innermost edges near the rough one."""
    around = [np.roll(corners, -side, 0) for side in range(4)]
    found = _steps(image, np.array(around), np.zeros((4, 2)))
    for side in range(4):
        if len(found[side].begin) < 2 and not border[side]:
            # the rough side may run askew, from the frame's outer edge to the inner one
            askew = _steps(image, np.array([around[side]] * len(SLANTS)), SLANTS)
            found[side] = max(found[side], *askew, key=lambda steps: steps.strength)
    lines = np.zeros((4, 3))
    for side, steps in enumerate(found):
        i = None if border[side] else _innermost(steps, None if border[side - 2] else found[side - 2])
        v = (0.0, 0.0) if i is None else (steps.begin[i], steps.end[i])
        p, q = mapped(homographies(around[side][None]), np.array([[0.0, v[0]], [1.0, v[1]]]))[0]
        lines[side] = *_normal(p, q), _normal(p, q) @ p
    return _met(lines)


def _normal(p: Array, q: Array) -> Array:
    """Unit normal of the line from p to q, to the right in a picture whose y points down."""
    along = (q - p) / np.linalg.norm(q - p)
    return np.array([-along[1], along[0]])


def _met(lines: Array) -> Array:
    """Corners of four lines (n_x, n_y, c) in turn: corner k where sides k-1 and k meet."""
    return np.array([np.linalg.solve(lines[[k - 1, k], :2], lines[[k - 1, k], 2]) for k in range(4)])


def _steps(image: Image, around: Array, slants: Array) -> list[_Steps]:
    """Where edges run along sides.

    Args:
        image: (H, W, 3).
        around: (S, 4, 2) corners; the side is the one from the first to the second.
        slants: (S, 2) where rows begin and end, relative to the side, as ``begin`` and ``end`` of the result.
    """
    u = np.linspace(0.04, 0.96, ALONG)
    v = np.linspace(-OUTWARD, INWARD, ROWS + 2)
    strips = len(around)
    grid = np.stack(np.meshgrid(u, v), -1).reshape(-1, 2)
    points = np.empty((strips, ROWS + 2, ALONG, 2))
    for k, H in enumerate(homographies(around)):
        lean = slants[k, 0] + (slants[k, 1] - slants[k, 0]) * grid[:, :1]
        points[k] = mapped(H[None], grid + lean * np.array([0.0, 1.0])).reshape(ROWS + 2, ALONG, 2)
    level = np.stack([cv2.blur(_sampled(image, p), (1, 3)) for p in points])
    step = level[:, 2:] - level[:, :-2]
    # per piece the median over its columns: a stroke or a magnet covers few of them
    pieces = np.sort(step.reshape(strips, ROWS, PIECES, -1, 3), 3)[:, :, :, ALONG // PIECES // 2]
    noise = 1.4826 * np.median(np.abs(pieces[:, -ROWS // 3 :]), axis=(1, 2, 3))  # mostly surface
    threshold = np.tile(np.clip(4.0 * noise, 2.5, 8.0), 2)[:, None]
    signed = np.concatenate([pieces, -pieces])
    size = np.maximum(np.maximum(signed[..., 0], signed[..., 1]), np.maximum(signed[..., 2], 0.0))
    path, total = _paths(np.minimum(size / threshold[:, :, None], 3.0))
    sizes = np.take_along_axis(size, path, 1)
    strength = np.sort(sizes, 2)[:, :, PIECES // 2]
    clear = ((sizes > threshold[:, :, None]).mean(2) >= MOST) & (strength > threshold)
    strongest = np.where(clear, strength, 0.0).reshape(2, strips, ROWS).max((0, 2))
    clear &= strength > FAINT * np.tile(strongest, 2)[:, None]
    padded = np.pad(total, ((0, 0), (3, 3)))
    clear &= total >= np.max([padded[:, k : k + ROWS] for k in range(7)], 0)
    along = (np.arange(PIECES) + 0.5) / PIECES * 0.92 - 0.46
    found = []
    for k in range(strips):
        which, row = np.nonzero(clear[k::strips])
        which = which * strips + k
        weight, at = np.minimum(sizes[which, row], threshold[k]) + 1e-3, path[which, row] + 1.0
        whole = weight.sum(1)
        mean, centre = (weight * at).sum(1) / whole, (weight * along).sum(1) / whole
        off = along - centre[:, None]
        slope = (weight * off * at).sum(1) / (weight * off**2).sum(1)
        mean -= slope * centre
        ends = np.stack([mean - 0.5 * slope, mean + 0.5 * slope], 1)
        kept: list[int] = []
        for i in np.argsort(-strength[which, row], kind="stable"):  # one edge, one entry
            if not kept or np.abs(ends[kept] - ends[i]).max(1).min() > 2.5:
                kept.append(int(i))
        kept.sort(key=lambda i: ends[i].sum())
        place = v[0] + (v[1] - v[0]) * ends[kept]
        found.append(
            _Steps(
                place[:, 0] + slants[k, 0],
                place[:, 1] + slants[k, 1],
                float(strength[which[kept], row[kept]].sum()),
            )
        )
    return found


def _paths(weight: Array) -> tuple[Index, Array]:
    """Best ways along strips (S, rows, pieces) through every row of the middle piece, moving by one row at most.

    Returns:
        rows of the way (S, rows, pieces) and its sum of weights (S, rows).
    """
    strips, rows, pieces = weight.shape
    start = pieces // 2
    path = np.empty(weight.shape, np.int64)
    total = weight[:, :, start].copy()
    path[:, :, start] = np.arange(rows)
    padded = np.full((strips, rows + 2), -1.0)
    for order in (range(start + 1, pieces), range(start - 1, -1, -1)):
        best = np.zeros((strips, rows))
        moves = []
        for k in reversed(order):  # from the end towards the middle: the best way from every row on
            padded[:, 1:-1] = best + weight[:, :, k]
            here, up, down = padded[:, 1:-1], padded[:, :-2], padded[:, 2:]
            best = np.maximum(np.maximum(here, up), down)
            moves.append(np.where(here >= best, 0, np.where(up >= best, -1, 1)))
        total += best
        row = np.tile(np.arange(rows), (strips, 1))
        for k, move in zip(order, reversed(moves), strict=True):
            row = row + np.take_along_axis(move, row, 1)
            path[:, :, k] = row
    return path, total


def _innermost(steps: _Steps, opposite: _Steps | None) -> int | None:
    """Which of the edges along a side bounds the writing surface.

    The innermost one, unless a wide even strip lies outside of it: then it is the edge of a shadow or a reflection, or
    the frame is that wide, and then the opposite side has it too.
    """
    place = steps.middle
    for n in range(len(place) - 1, -1, -1):
        if n == 0 or place[n] - place[n - 1] < GAP:
            return n
        if opposite is not None and np.any(np.abs(opposite.middle - place[n]) < 0.3 * abs(place[n]) + 0.004):
            return n
    return None


def _fitted(image: Image, corners: Array, border: Mask, reach: float) -> Edges:
    """Curves through the step nearest to each side, within `reach` pixels, and where they meet."""
    sides: list[tuple[Array, Array, Array]] = []
    seen, spread = np.ones(4), np.zeros(4)
    for side in range(4):
        p, q = corners[side], corners[(side + 1) % 4]
        inward = _normal(p, q)
        found = None if border[side] else _side(image, p, q, inward, reach)
        curve = np.zeros(3)
        if found is not None:
            curve, seen[side], spread[side] = found
        elif not border[side]:
            seen[side] = 0.0
        # the point at t is x + t (y - x) + t^2 z
        sides.append((p + curve[0] * inward, q + (curve[0] + curve[1]) * inward, curve[2] * inward))
    return Edges(np.array([_corner(sides[k - 1], sides[k]) for k in range(4)]), seen, spread)


def _corner(before: tuple[Array, Array, Array], after: tuple[Array, Array, Array]) -> Array:
    """Where the end of one side meets the begin of the next."""
    t = np.array([1.0, 0.0])
    for _ in range(4):  # Newton; straight sides need one step
        (x, y, z), (u, v, w) = before, after
        here = x + t[0] * (y - x) + t[0] ** 2 * z
        there = u + t[1] * (v - u) + t[1] ** 2 * w
        slope = np.stack([y - x + 2.0 * t[0] * z, u - v - 2.0 * t[1] * w], 1)
        t = t - np.linalg.solve(slope, here - there)
    u, v, w = after
    return u + t[1] * (v - u) + t[1] ** 2 * w


def _side(image: Image, p: Array, q: Array, inward: Array, reach: float) -> tuple[Array, float, float] | None:
    """The step nearest to the line from p to q.

    Returns:
        its distance from the line at t = 0 to 1 as the coefficients (3,) of 1, t and t^2 [pixels], the part of the side
        where it is seen, and the deviation from that curve [pixels]; None: there is none.
    """
    t = np.linspace(0.04, 0.96, ALONG)
    v = np.arange(-reach - 1.5, reach + 1.6, 0.5)
    points = (p + t[:, None] * (q - p))[None] + v[:, None, None] * inward
    level = cv2.blur(_sampled(image, points), (3, 3))
    step = level[2:] - level[:-2]
    v = v[1:-1]
    rough = _rough_line(step, t, v)
    if rough is None:
        return None
    curve, colour = rough
    step = step @ colour
    score = np.where(np.abs(v[:, None] - _at(curve, t)) <= 1.6, step, -np.inf)
    best = score[1:-1].argmax(0) + 1
    columns = np.arange(ALONG)
    middle, before, after = (step[best + k, columns] for k in (0, -1, 1))
    bend = before - 2.0 * middle + after
    shift = np.where(bend < -1e-3, 0.5 * (before - after) / np.where(bend < -1e-3, bend, -1.0), 0.0)
    place = v[best] + 0.5 * np.clip(shift, -1, 1)
    good = middle > max(3.0, 0.3 * _middle(middle))
    if good.sum() < 8:
        return None
    curve, spread = _curve(t[good], place[good])
    return curve, float(good.mean()), spread


def _at(curve: Array, t: Array) -> Array:
    return curve[0] + t * (curve[1] + t * curve[2])


def _rough_line(step: Float, t: Array, v: Array) -> tuple[Array, Array] | None:
    """The edge nearest to the middle in steps (rows, ALONG, 3) at distances v.

    Returns:
        coefficients (3,) of v in t, and the unit colour (3,) along which the picture gets brighter there, going in;
        None: no edge.
    """
    pieces = np.sort(step.reshape(len(v), PIECES, -1, 3), 2)[:, :, ALONG // PIECES // 2]
    size = np.abs(pieces).max(2)
    typical = _middle(size.max(0))
    if typical < 2.0:
        return None
    peak = (size[1:-1] >= size[:-2]) & (size[1:-1] >= size[2:]) & (size[1:-1] > max(2.0, 0.15 * typical))
    row = 1 + np.where(peak, np.abs(v[1:-1, None] - 0.3), np.inf).argmin(0)
    usable = np.flatnonzero(peak.any(0))
    if len(usable) < 4:
        return None
    middle = t.reshape(PIECES, -1).mean(1)[usable]
    row = row[usable]
    curve, _ = _curve(middle, v[row])
    on_line = pieces[row, usable][np.abs(v[row] - _at(curve, middle)) < 1.5]
    if not len(on_line):
        return None
    colour = np.sort(on_line, 0)[len(on_line) // 2]
    length = float(np.linalg.norm(colour))
    return (curve, colour / length) if length > 0.5 else None


def _curve(t: Array, y: Array) -> tuple[Array, float]:
    """y in t by reweighted least squares (Tukey), started from a median of slopes, and the spread.

    A line; a parabola where a line leaves clearly more (a lens bends straight edges).
    """
    half = len(t) // 2
    b = _middle((y[half : 2 * half] - y[:half]) / (t[half : 2 * half] - t[:half]))
    line, spread = _reweighted(t, y, np.array([_middle(y - b * t), b, 0.0]), 2)
    if len(t) < 10 or spread < 0.5 * BOW:  # a sum of noise and bow cannot be less than the bow
        return line, spread
    parabola, left = _reweighted(t, y, line, 3)
    bowed = 0.25 * abs(parabola[2]) > BOW and left < 0.8 * spread
    return (parabola, left) if bowed else (line, spread)


def _reweighted(t: Array, y: Array, curve: Array, terms: int) -> tuple[Array, float]:
    basis = np.stack([np.ones_like(t), t, t * t][:terms], 1)
    scale = 1.0
    for _ in range(3):
        off = y - _at(curve, t)
        scale = max(1.4826 * _middle(np.abs(off)), 0.1)
        weighted = basis * np.maximum(1.0 - (off / (4.0 * scale)) ** 2, 0.0)[:, None] ** 2
        curve = np.zeros(3)
        curve[:terms] = np.linalg.solve(weighted.T @ basis + 1e-9 * np.eye(terms), weighted.T @ y)
    return curve, scale


def _middle(x: Array) -> float:
    """A median; numpy's own takes longer than all the rest on a few numbers."""
    return float(np.sort(x)[len(x) // 2])
