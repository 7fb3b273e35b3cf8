"""From a rough quadrangle around a board to the edges of its writing surface, to a fraction of a pixel."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

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

STRETCHES, EACH = 15, 12
"""for the border a side is looked at in so many stretches, of so many samples"""
PITCH = 0.75
"""in rows so far apart [pixels]"""
BEYOND, WITHIN = 9.0, 0.075
"""so far outward [pixels] and inward, relative to the board, of the edge known"""
SHEARS = np.arange(-6.0, 7.0, 3.0)
"""from one end of a side to the other the border may lean by this against the edge known [pixels]"""
STRAIGHT = len(SHEARS) // 2
APART = 3
"""rows from an edge to what is beside it"""
FAINTEST, SIGMAS, RELATIVE = 2.5, 4.5, 0.035
"""steepness of an edge over two rows [grey levels], relative to the noise and to the steepest edge"""
AGREE = 0.75
"""part of the stretches that show it"""
SOFT, WIDEST = 1.6, 5.0
"""the flank of a shadow is so many times as wide as an edge beside it, and wider than blur makes an edge [pixels]"""
KINK, ENDS, SHARE = 2, 8, 0.25
"""rows over which a bend is seen; rows inward in which an edge ends; relative to the strongest bend there"""
BLUR = 1.3
"""from the middle of an edge to its bend [pixels]"""
SAME = 0.8
"""edges so near to each other are the same [pixels]"""


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
    inner = _inner(image, corners, border)
    sides = [_Side(inner[k], inner[(k + 1) % 4], 0.0, 1.0, 0.0) for k in range(4)]
    sides = _border(image, _fitted(image, sides, border, 3.5), border)
    return Edges(_corners(sides), np.array([s.seen for s in sides]), np.array([s.spread for s in sides]))


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
    v = np.linspace(-OUTWARD, INWARD, ROWS + 2)
    strips = len(around)
    level = np.empty((strips, ROWS + 2, ALONG, 3), np.float32)
    for k, H in enumerate(homographies(around)):
        strip = _strip(image, H, (0.04, 0.96), (v[0], v[-1]), (ALONG, ROWS + 2), slants[k])
        level[k] = cv2.blur(strip.astype(np.float32), (1, 3))
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


@dataclass(frozen=True, slots=True)
class _Side:
    """A side as a curve: the point at t is p + t (q - p) + bow (t^2 - t) n, n pointing inward."""

    p: Array
    q: Array
    bow: float
    seen: float
    """part of it where its edge was found"""
    spread: float
    """deviation of the edge points from it [pixels]"""

    @property
    def inward(self) -> Array:
        return _normal(self.p, self.q)

    def moved(self, begin: float, end: float, bow: float, seen: float, spread: float) -> _Side:
        """Inward by so many pixels at its ends."""
        n = self.inward
        return _Side(self.p + begin * n, self.q + end * n, bow, seen, spread)


def _fitted(image: Image, sides: list[_Side], border: Mask, reach: float) -> list[_Side]:
    """Curves through the step nearest to each side, within `reach` pixels."""
    return [
        side if border[k] else (_nearest(image, side, reach) or replace(side, seen=0.0, spread=0.0))
        for k, side in enumerate(sides)
    ]


def _corners(sides: list[_Side]) -> Array:
    """(4, 2): corner k where sides k-1 and k meet."""
    return np.array([_corner(sides[k - 1], sides[k]) for k in range(4)])


def _corner(before: _Side, after: _Side) -> Array:
    """Where the end of one side meets the begin of the next."""
    (x, y, z), (u, v, w) = ((s.p, s.q - s.p - s.bow * s.inward, s.bow * s.inward) for s in (before, after))
    t = np.array([1.0, 0.0])
    for _ in range(4):  # Newton; straight sides need one step
        here = x + t[0] * (y + t[0] * z)
        there = u + t[1] * (v + t[1] * w)
        slope = np.stack([y + 2.0 * t[0] * z, -v - 2.0 * t[1] * w], 1)
        t = t - np.linalg.solve(slope, here - there)
    return u + t[1] * (v + t[1] * w)


def _border(image: Image, sides: list[_Side], border: Mask) -> list[_Side]:
    """From edges that are seen to the border of the writing surface, which may be fainter than the noise of a pixel.

    A frame has several edges, and the one towards a white surface is often the faintest. It is parallel to the edges
    known, and averaged over a whole side the noise is small.
    """
    corners = _corners(sides)
    found = _parallels(image, corners, sides)
    result = list(sides)
    for k, steps in enumerate(found):
        if border[k]:
            continue
        i = _innermost(steps, None if border[k - 2] else found[k - 2])
        if i is None:
            continue
        H = homographies(np.roll(corners, -k, 0)[None])
        p, q = mapped(H, np.array([[0.0, steps.begin[i]], [1.0, steps.end[i]]]))[0]
        n = sides[k].inward
        if max(abs((p - sides[k].p) @ n), abs((q - sides[k].q) @ n)) > SAME:
            result[k] = _Side(p, q, sides[k].bow, sides[k].seen, sides[k].spread)
    return result


def _parallels(image: Image, corners: Array, sides: list[_Side]) -> list[_Steps]:
    """Sharp edges along sides, faint ones too."""
    H = homographies(np.array([np.roll(corners, -k, 0) for k in range(4)]))
    ends = np.diff(mapped(H, np.array([[0.5, 0.0], [0.5, 0.01]])), axis=1)[:, 0]
    extent = [100.0 * float(d @ side.inward) for d, side in zip(ends, sides, strict=True)]
    v = np.arange(-BEYOND, max(WITHIN * max(extent), 14.0), PITCH)
    u = (np.arange(STRETCHES) + 0.5) / STRETCHES
    middles = mapped(H, np.stack([0.035 + 0.93 * u, np.zeros(STRETCHES)], 1))
    each = np.empty((4, len(SHEARS), len(v) - 2, 3, STRETCHES), np.float32)
    rows = np.arange(len(v) - 2)
    for k, side in enumerate(sides):
        size = (STRETCHES * EACH, len(v))
        level = _strip(image, H[k], (0.035, 0.965), (v[0] / extent[k], v[-1] / extent[k]), size)
        # means of medians of three far from each other: a stroke or a magnet covers few of them
        apart = np.moveaxis(level.reshape(len(v), STRETCHES, 3, EACH // 3, 3), 2, 0)
        profile = _between(*apart).mean(2, dtype=np.float32).swapaxes(1, 2)
        along = side.q - side.p
        t = (middles[k] - side.p) @ along / (along @ along)
        shift = np.rint((SHEARS[:, None] * (u - 0.5) + side.bow * (t * t - t)) / PITCH).astype(np.int64)
        at = np.clip(rows[None, :, None] + shift[:, None], 0, len(rows) - 1)
        each[k] = (profile[2:] - profile[:-2])[at[:, :, None], np.arange(3)[:, None], np.arange(STRETCHES)]
    v = v[1:-1]
    mean = _between(*np.moveaxis(each.reshape(*each.shape[:4], 3, -1), 4, 0)).mean(4)
    size = np.linalg.norm(mean, axis=3)
    colour = mean / np.maximum(size, 1e-6)[..., None]
    # a shadow and a round profile are slopes that go on: only what is steeper than both sides of it is an edge
    beside = [(mean[:, :, np.clip(rows + d, 0, len(v) - 1)] * colour).sum(3) for d in (-APART, APART)]
    # compression leaves false colours, hardly false brightness
    grey = np.maximum(np.abs(colour.sum(3)) / np.sqrt(3.0), 0.5)
    sharp = (size - np.maximum(np.maximum(*beside), 0.0)) * grey
    agree = ((colour[..., None, :] @ each)[..., 0, :] > 0.35 * size[..., None]).mean(3)
    found = []
    for k in range(4):
        inside = (v > 0.5 * WITHIN * extent[k]) & (v < WITHIN * extent[k])
        noise = float(np.median(size[k, STRAIGHT, inside]))
        floor = max(FAINTEST, SIGMAS * noise, RELATIVE * float(size[k].max()))
        clear = (sharp[k] > floor) & (agree[k] >= AGREE) & (v < max(WITHIN * extent[k], 14.0))
        found.append(_edges(v, np.where(clear, sharp[k], 0.0), mean[k], colour[k], floor, extent[k]))
    return found


def _between(a: npt.NDArray[Any], b: npt.NDArray[Any], c: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """The middle of three, elementwise."""
    return np.maximum(np.minimum(a, b), np.minimum(np.maximum(a, b), c))


def _strip(
    image: Image,
    H: Array,
    u: tuple[float, float],
    v: tuple[float, float],
    size: tuple[int, int],
    slant: Array | None = None,
) -> Image:
    """What lies along a side: columns from u[0] to u[1] and rows from v[0] to v[1] on the unit square of H.

    `slant` is added to v at u = 0 and 1.
    """
    du, dv = (u[1] - u[0]) / (size[0] - 1), (v[1] - v[0]) / (size[1] - 1)
    low, lean = (0.0, 0.0) if slant is None else (slant[0], slant[1] - slant[0])
    place = np.array([[du, 0.0, u[0]], [lean * du, dv, v[0] + low + lean * u[0]], [0.0, 0.0, 1.0]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpPerspective(image, H @ place, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)


def _edges(v: Array, sharp: Array, mean: Array, colour: Array, floor: float, extent: float) -> _Steps:
    """The edges of one side, as fractions of the board's extent across it.

    Args:
        v: (R,) distance of rows inward of the edge known [pixels].
        sharp: (SHEARS, R) how clear an edge is there, 0: none.
        mean, colour: (SHEARS, R, 3) change of the picture there over two rows, and its direction.
        floor: least change of an edge.
        extent: of the board across the side [pixels].
    """
    shear, best = sharp.argmax(0), sharp.max(0)
    padded = np.pad(best, 3)
    peak = (best > 0.0) & (best >= np.max([padded[i : i + len(best)] for i in range(7)], 0))
    peaks = [int(r) for r in 1 + np.flatnonzero(peak[1:-1])]
    # the edge known is among them as it is; what crosses it is the same edge once more
    known, reach = int(np.abs(v).argmin()), 0.5 * np.abs(SHEARS[shear])
    outer = [r for r in peaks if v[r] + reach[r] < -SAME]
    inner = [r for r in peaks if v[r] - reach[r] > 0.5 * APART * PITCH]
    shear[known] = STRAIGHT
    peaks = [*outer, known, *inner]
    slopes = [mean[shear[r]] @ colour[shear[r], r] for r in peaks]
    firm = _firm(v[peaks], np.array([_width(slope, r) for slope, r in zip(slopes, peaks, strict=True)]))
    if firm[len(outer)]:
        firm[: len(outer)] = False
    lean = 0.5 * SHEARS[shear[peaks]]
    place = np.array(
        [
            (0.0 if r == known else v[r] + PITCH * _vertex(slope[r - 1 : r + 2]))
            + _shoulder(np.cumsum(mean[shear[r]], 0), r, floor)
            for slope, r in zip(slopes, peaks, strict=True)
        ]
    )
    return _Steps(
        (place - lean)[firm] / extent, (place + lean)[firm] / extent, float(best[peaks][firm].sum())
    )


def _firm(place: Array, width: Array) -> Mask:
    """Which edges, from outside to inside, are none of a soft shadow that a frame throws.

    Its flank is wider than the edge that throws it.
    """
    wider = (width[:, None] > SOFT * width) & (width[:, None] > WIDEST)
    near = place[:, None] - place < 2.0 * width[:, None]
    shadow = np.tril(wider & near, -1)
    return np.array([not row.any() for row in shadow])


def _vertex(y: Array) -> float:
    """Where the parabola through three values has its peak, from -1 to 1."""
    bend = y[0] - 2.0 * y[1] + y[2]
    return float(np.clip(0.5 * (y[0] - y[2]) / bend, -1.0, 1.0)) if bend < -1e-3 else 0.0


def _width(slope: Array, row: int) -> float:
    """Of an edge at half its steepness [pixels]."""
    flat = slope < 0.5 * slope[row]
    flat[[0, -1]] = True
    return PITCH * float(flat[row:].argmax() + flat[row::-1].argmax() - 1)


def _shoulder(total: Array, row: int, floor: float) -> float:
    """How far inward of its steepest row the surface begins, where that is more than blur [pixels].

    An edge so near to another that blur joins them is no peak of steepness; where it ends the picture still bends.

    Args:
        total: (R, 3) sums of the changes over two rows.
    """
    rows = np.arange(max(row - 5, KINK), min(row + ENDS, len(total) - KINK))
    if len(rows) < 3:
        return 0.0
    bend = 0.5 * np.linalg.norm(total[rows + KINK] - 2.0 * total[rows] + total[rows - KINK], axis=1)
    high = max(SHARE * float(bend.max()), floor)
    peak = 1 + np.flatnonzero((bend[1:-1] >= bend[:-2]) & (bend[1:-1] >= bend[2:]) & (bend[1:-1] > high))
    end = (rows[peak[-1]] - row) * PITCH - BLUR if len(peak) else 0.0
    return float(end) if end > BLUR else 0.0


def _nearest(image: Image, side: _Side, reach: float) -> _Side | None:
    """The side moved onto the step nearest to it; None: there is none."""
    p, q, inward = side.p, side.q, side.inward
    t = np.linspace(0.04, 0.96, ALONG)
    v = np.arange(-reach - 1.5, reach + 1.6, 0.5)
    bow = side.bow * (t * t - t)
    points = (p + t[:, None] * (q - p) + bow[:, None] * inward)[None] + v[:, None, None] * inward
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
    return side.moved(
        curve[0], curve[0] + curve[1] + curve[2], side.bow + curve[2], float(good.mean()), spread
    )


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
