"""From a rough quadrangle around a board to the edges of its writing surface, to a fraction of a pixel.

A side is looked at in a strip along it: brightness as a function of the distance across, in stretches along the side.
Averaged over a whole side even an edge fainter than the noise of a pixel is clear. Every edge that runs along the whole
side, straight and perhaps a little askew, may be the border: those of a frame, of its groove, of the shadow that it
throws. Going from the surface outward the border is the first one that is none of a shadow, of writing or of
compression: each is judged by logistic regression on how clear, how sharp and how consistent it is and what lies on
both of its sides, and the chance that it is the border is that it is one and that none further inside was.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ..arm import Array
from ._image import Float, Image, Index, Mask
from ._quads import homographies, mapped

STRETCHES, EACH = 15, 12
"""a side is looked at in so many stretches, of so many samples"""
ENDS = 0.05
"""part of a side left out at either end"""
PITCH = 0.75
"""in rows so far apart [pixels]"""
OUTWARD, INWARD = 0.05, 0.14
"""from so far outside of the rough side to so far inside, relative to the board"""
LEAST_OUTWARD, LEAST_INWARD = 9.0, 18.0
"""at least so far [pixels]"""
SHEARS = np.concatenate([[-30.0, -22.5, -15.0], np.arange(-10.0, 10.1, 2.5), [15.0, 22.5, 30.0]])
"""from one end of a side to the other an edge may lean by this against the rough side [pixels]"""
STRAIGHT = len(SHEARS) // 2
ASKEW = 10.0
"""where one leans by more the strips are laid anew along what was found [pixels]"""
AGREE = 0.35
"""a stretch agrees with an edge if it steps by this part of the mean"""
APART = 3
"""rows from an edge to what is beside it"""
KINK = 2
"""rows over which a bend is seen"""
SHOULDER = 9
"""rows inward of an edge in which it may end"""
BLUR = 1.3
"""from the middle of an edge to its bend [pixels]"""
WRONG, WORST = 2.0, 4.0
"""a side is wrong if it is off by more than the first; below, and up to the second, less is better [pixels]"""
NEAR = 0.02
"""loss by a square pixel, relative to being wrong"""
LEFT = 0.25
"""what blur, compression and the lens leave of the place of the sharpest corner, standard deviation [pixels]"""
BURNT = 250.0
"""brightness from which nothing can be told apart [grey levels]"""
BLIND = 12.0
"""a burnt stretch this near to an edge may hide the border [pixels]"""
NEARLY = 240.0
"""brightness of a surface that burns where there is but a little more light [grey levels]"""
CRISP, DROP = 3.0, 40.0
"""a border is seen beside what is burnt if it is darker by the second so near to it [pixels], [grey levels]"""
BOTH_WAYS, BLIND_ROWS = 0.6, 120
"""and is followed so far outward and inward, relative to the board, in so many rows"""
BOW = 0.4
"""a side is straight if its middle is nearer to its chord [pixels]"""

FEATURES = (
    "size",  # log of the step over two rows [grey levels]
    "faint",  # the same, at most 1.5
    "signal",  # log of the step over the noise
    "doubtful",  # the same, at most 2.5
    "agree",  # part of the stretches that show it
    "unanimous",  # the same above 0.85
    "strong",  # log of its strength over that of the strongest along the side
    "inside",  # log of the strongest further inside over its own
    "busy",  # edges further inside half as strong, at most 3
    "width",  # at half its steepness [pixels]
    "soft",  # wider than a strong one close outside of it by this factor, less 1
    "sharp",  # log of the part by which it is steeper than what is beside it
    "outside",  # log of the difference between the surface and what lies outside of it
    "change",  # log of that difference over the one inside
    "brighter",  # the surface is, 1, or darker, -1
    "depth",  # distance from the rough side, in twentieths of the board
    "deep",  # the same where above 0.03 of the board
    "askew",  # pixels from end to end against the rough side, at most ASKEW, in thirds
    "shoulder",  # 1: no edge by itself, but where one ends
    "bend",  # log of its bend over the edge's step
    "steady",  # log of the step over its deviation among stretches
    "next",  # log of the strongest close outside over its own
    "below",  # 1: the strongest along the side lies further inside
    "beyond",  # log of the difference between the surface and what lies further outside of it, past a line or a groove
    "even",  # the same over that of the edge
    "repeated",  # steps further outside, of the other edges, half as strong, at most 3
)
WEIGHTS = np.array(
    [
        -0.161, 0.940, -0.095, 0.630, -0.150, 8.947, 0.707, -0.579, -0.488,
        -0.247, -0.750, 0.084, 0.459, 0.147, 0.456, -0.171, -2.580, -0.686,
        1.625, 0.303, -0.393, -0.055, 0.991, 0.013, 0.384, -0.677,
    ]
)  # fmt: skip
BIAS = -0.151


@dataclass(frozen=True, slots=True)
class Edges:
    """Sides of a writing surface."""

    corners: Array
    """(4, 2) where the fitted sides meet [pixels]"""
    spread: Array
    """(4,) deviation of the edge from the fitted line [pixels]"""
    sigma: Array
    """(4,) standard deviation of the corners [pixels]"""
    blind: Array
    """(4,) width of what is as white as a picture gets along a side: the border may be anywhere in it [pixels]"""


@dataclass(frozen=True, slots=True)
class _Side:
    """A side as a curve: the point at t is p + t (q - p) + bow (t^2 - t) n, n pointing inward."""

    p: Array
    q: Array
    bow: float
    spread: float
    """deviation of the edge points from it [pixels]"""
    sigma: float
    """standard deviation of its place [pixels]"""
    blind: float = 0.0
    """[pixels]"""

    @property
    def inward(self) -> Array:
        return _normal(self.p, self.q)


def fit(grey: Image, corners: Array, border: Mask) -> Edges:
    """Find the border of the surface along every side.

    Args:
        grey: (H, W).
        corners: (4, 2) rough, clockwise.
        border: (4,) bool: this side is the picture's border and stays.
    """
    sides, met = _around(grey, corners, border)
    moved = met - corners
    lean = [(moved[k - 3] - moved[k]) @ _normal(corners[k], corners[k - 3]) for k in range(4)]
    if max(map(abs, lean)) > ASKEW:
        sides, met = _around(grey, met, border)
    sigma = np.array([_corner_sigma(sides[k - 1], sides[k]) for k in range(4)])
    return Edges(met, np.array([s.spread for s in sides]), sigma, np.array([s.blind for s in sides]))


def _around(grey: Image, corners: Array, border: Mask) -> tuple[list[_Side], Array]:
    """The sides found near the rough ones, and the corners (4, 2) where they meet."""
    strips = _strips(grey, corners)
    sides = [
        _Side(corners[k], corners[(k + 1) % 4], 0.0, 0.0, 0.0) if border[k] else _side(grey, strips, k)
        for k in range(4)
    ]
    return sides, np.array([_corner(sides[k - 1], sides[k]) for k in range(4)])


@dataclass(frozen=True, slots=True)
class _Strips:
    """Four strips along the sides of a quadrangle. Rows go inward, PITCH apart."""

    corners: Array
    H: Array
    """(4, 3, 3) from the unit square, its first side the strip's"""
    extent: Array
    """(4,) of the board across [pixels]"""
    first: Array
    """(4,) distance of the first row from the rough side [pixels]"""
    rows: Index
    """(4,) rows that count"""
    level: Float
    """(4, R + 2) brightness, over the whole side"""
    step: Float
    """(4, R, STRETCHES) change over two rows, by stretch"""
    mean: Float
    """(4, SHEARS, R) the same over the whole side"""
    agree: Float
    """(4, SHEARS, R) part of the stretches that agree with it"""


def _strips(grey: Image, corners: Array) -> _Strips:
    around = np.array([np.roll(corners, -k, 0) for k in range(4)])
    H = homographies(around)
    ends = np.diff(mapped(H, np.array([[0.5, 0.0], [0.5, 0.01]])), axis=1)[:, 0]
    extent = np.array([100.0 * float(d @ _normal(*c[:2])) for d, c in zip(ends, around, strict=True)])
    first = -np.maximum(OUTWARD * extent, LEAST_OUTWARD)
    rows = ((np.maximum(INWARD * extent, LEAST_INWARD) - first) / PITCH).astype(np.int64)
    count = int(rows.max())
    profile = np.empty((4, count + 2, STRETCHES), np.float32)
    for k in range(4):
        v = (first[k] + PITCH * np.array([-1.0, count])) / extent[k]
        size = (STRETCHES * EACH, count + 2)
        strip = _strip(grey, H[k], (ENDS, 1.0 - ENDS), (float(v[0]), float(v[1])), size)
        # means of medians of three far from each other: a stroke or a magnet covers few of them
        apart = np.moveaxis(strip.reshape(count + 2, STRETCHES, 3, EACH // 3), 2, 0)
        profile[k] = _between(*apart).mean(2, dtype=np.float32)
    smooth = profile.copy()
    smooth[:, 1:-1] = 0.25 * (profile[:, :-2] + 2.0 * profile[:, 1:-1] + profile[:, 2:])
    step = smooth[:, 2:] - smooth[:, :-2]
    shift = np.rint(SHEARS[:, None] * _along() / PITCH).astype(np.int64)
    at = np.clip(np.arange(count)[None, :, None] + shift[:, None], 0, count - 1)
    leaning = step[:, at, np.arange(STRETCHES)]
    mean = _whole(leaning)
    agree = (leaning * np.sign(mean)[..., None] > AGREE * np.abs(mean)[..., None]).mean(3, dtype=np.float32)
    return _Strips(corners, H, extent, first, rows, _whole(profile), step, mean, agree)


def _along() -> Array:
    """(STRETCHES,) middles of the stretches, from -0.5 to 0.5 over the whole side."""
    return ((np.arange(STRETCHES) + 0.5) / STRETCHES - 0.5) * (1.0 - 2.0 * ENDS)


def _whole(x: Float) -> Float:
    """Over the stretches (last axis): means of medians of three far from each other."""
    return _between(*np.moveaxis(x.reshape(*x.shape[:-1], 3, -1), -2, 0)).mean(-1)


def _between(a: Float, b: Float, c: Float) -> Float:
    """The middle of three, elementwise."""
    return np.maximum(np.minimum(a, b), np.minimum(np.maximum(a, b), c))


def _strip(
    grey: Image, H: Array, u: tuple[float, float], v: tuple[float, float], size: tuple[int, int]
) -> Image:
    """What lies along a side: columns from u[0] to u[1] and rows from v[0] to v[1] on the unit square of H."""
    du, dv = (u[1] - u[0]) / (size[0] - 1), (v[1] - v[0]) / (size[1] - 1)
    place = np.array([[du, 0.0, u[0]], [0.0, dv, v[0]], [0.0, 0.0, 1.0]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpPerspective(grey, H @ place, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)


@dataclass(frozen=True, slots=True)
class _Candidates:
    """Edges along one side, from inside to outside."""

    row: Array
    """(M,) whole numbers: a peak of steepness; else: a shoulder"""
    shear: Index
    """(M,) of SHEARS"""
    features: Array
    """(M, F)"""


def _candidates(strips: _Strips, k: int) -> _Candidates:
    count = int(strips.rows[k])
    mean, agree = strips.mean[k, :, :count], strips.agree[k, :, :count]
    strength = np.abs(mean) * agree
    lean = strength.argmax(0)
    best = strength.max(0)
    padded = np.pad(best, 2)
    peak = (best > 0.3) & (best >= np.max([padded[i : i + count] for i in range(5)], 0))
    peaks = np.flatnonzero(peak[2:-2]) + 2
    noise = max(float(np.median(np.abs(mean[STRAIGHT, count // 2 :]))), 0.08)
    row, shear = [float(r) for r in peaks], [int(s) for s in lean[peaks]]
    bend, parent = [0.0] * len(row), [float(abs(mean[s, r])) for s, r in zip(shear, peaks, strict=True)]
    total = np.cumsum(mean, 1)
    for r, s, size in zip(peaks, lean[peaks], list(parent), strict=True):
        # an edge so near to another that blur joins them is no peak of steepness; where it ends the picture still bends
        at = np.arange(int(r) + KINK, min(int(r) + SHOULDER, count - KINK))
        if len(at) < 3:
            continue
        bends = 0.5 * np.abs(total[s, at + KINK] - 2.0 * total[s, at] + total[s, at - KINK])
        middle = bends[1:-1]
        clear = (middle >= bends[:-2]) & (middle > bends[2:]) & (middle > max(0.06 * size, 4.0 * noise))
        for i in np.flatnonzero(clear) + 1:
            ends = float(at[i]) - BLUR / PITCH
            if min(abs(ends - x) for x in row) * PITCH < 1.5:
                continue
            row.append(ends)
            shear.append(int(s))
            bend.append(float(bends[i]))
            parent.append(size)
    order = np.argsort(-np.array(row), kind="stable")
    place, leaning = np.array(row)[order], np.array(shear, np.int64)[order]
    features = _features(
        strips, k, place, leaning, np.array(bend)[order], np.array(parent)[order], best, noise
    )
    return _Candidates(place, leaning, features)


def _features(
    strips: _Strips, k: int, row: Array, shear: Index, bend: Array, parent: Array, best: Float, noise: float
) -> Array:
    """What speaks for each of the edges: FEATURES."""
    count, found = len(best), len(row)
    at = np.clip(np.rint(row).astype(np.int64), 0, count - 1)
    mean, level = strips.mean[k], strips.level[k].astype(np.float64)
    shoulder = bend > 0.0
    agree = strips.agree[k, shear, at].astype(np.float64)
    size = np.where(shoulder, bend, np.abs(mean[shear, at]))
    strength = np.maximum(size * agree, 1e-3)
    size = np.maximum(size, 1e-3)
    sums = np.concatenate([[0.0], np.cumsum(level)])

    def average(low: Index, high: Index) -> Array:
        low, high = np.clip(low, 0, count - 1), np.clip(high, 1, count)
        low = np.minimum(low, high - 1)
        return (sums[high] - sums[low]) / (high - low)

    surface = average(at + 8, at + 32)
    inner = np.abs(average(at + 4, at + 10) - surface)
    outer = np.abs(average(at - 5, at - 1) - surface)
    beyond = np.abs(average(at - 20, at - 10) - average(at + 4, at + 10))
    deeper = np.maximum.accumulate(best[::-1])[::-1]
    inside = np.where(at + 4 < count, deeper[np.minimum(at + 4, count - 1)], 0.0)
    width, sharp = np.zeros(found), np.zeros(found)
    for i in range(found):
        slope = mean[shear[i], :count] * np.sign(mean[shear[i], at[i]])
        width[i] = _width(slope, int(at[i]))
        beside = max(slope[max(at[i] - APART, 0)], slope[min(at[i] + APART, count - 1)], 0.0)
        sharp[i] = 1.0 - beside / max(float(slope[at[i]]), 1e-3)
    distance = (row[:, None] - row[None]) * PITCH  # i is so much further inside than j
    near = (distance > 1.0) & (distance < 2.5 * width[:, None] + 3.0)
    close = np.where(near, strength[None], 0.0).max(1, initial=0.0)
    rival = near & (strength[None] > 0.5 * strength[:, None])
    narrow = np.where(rival, width[None], width[:, None]).min(1, initial=np.inf)
    wider = np.maximum(width / narrow, 1.0) - 1.0
    busy = ((distance < -2.0) & (strength[None] > 0.5 * strength[:, None])).sum(1)
    shift = np.rint(SHEARS[shear, None] * _along() / PITCH).astype(np.int64)
    each = strips.step[k, np.clip(at[:, None] + shift, 0, count - 1), np.arange(STRETCHES)]
    off = np.sort(np.abs(np.abs(mean[shear, at])[:, None] - each * np.sign(mean[shear, at])[:, None]), 1)
    deviation = 1.4826 * off[:, STRETCHES // 2]
    depth = (strips.first[k] + PITCH * row) / strips.extent[k]
    strongest = int(strength.argmax()) if found else 0
    columns = (
        np.log(size),
        np.minimum(np.log(size), 1.5),
        np.log(size / noise),
        np.minimum(np.log(size / noise), 2.5),
        agree,
        np.maximum(agree - 0.85, 0.0),
        np.log(strength / strength.max(initial=1e-3)),
        np.log(np.maximum(inside, 0.15) / strength),
        np.minimum(busy, 3.0),
        width,
        np.minimum(wider, 3.0),
        np.log(np.maximum(sharp, 0.05)),
        np.log(outer + 0.5),
        np.log((outer + 0.3) / (inner + 0.3)),
        np.sign(mean[shear, at]),
        depth / 0.05,
        np.maximum(depth - 0.03, 0.0) / 0.05,
        np.minimum(np.abs(SHEARS[shear]), ASKEW) / 3.0,
        shoulder.astype(np.float64),
        np.log(np.where(shoulder, bend / parent, 1.0)),
        np.log(np.minimum(size / (deviation + 0.3), 30.0)),
        np.log((close + 0.3) / strength),
        (row[strongest] > row + 2.0).astype(np.float64) if found else np.zeros(0),
        np.log(beyond + 0.5),
        np.log((beyond + 0.3) / size),
        np.minimum(((distance > 8.0) & (strength[None] > 0.5 * strength[:, None])).sum(1), 3.0),
    )
    return np.column_stack(columns)


def _width(slope: Float, row: int) -> float:
    """Of an edge at half its steepness [pixels]."""
    flat = slope < 0.5 * slope[row]
    flat[[0, -1]] = True
    return PITCH * float(flat[row:].argmax() + flat[row::-1].argmax() - 1)


def _chances(features: Array) -> Array:
    """(M,) chance of each edge, from inside to outside, to be the border; with what is left they add up to 1."""
    is_one = 1.0 / (1.0 + np.exp(-(features @ WEIGHTS + BIAS)))
    return is_one * np.cumprod(np.append(1.0, 1.0 - is_one))[:-1]


def _side(grey: Image, strips: _Strips, k: int) -> _Side:
    """The border along side k."""
    found = _candidates(strips, k)
    if not len(found.row):
        p, q = strips.corners[k], strips.corners[(k + 1) % 4]
        blind = _blind(grey, strips, k, 0.0)
        return _Side(p, q, 0.0, 0.0, float(np.hypot(LEAST_OUTWARD, blind / np.sqrt(3.0))), blind)
    chance = _chances(found.features)
    place = strips.first[k] + PITCH * found.row
    best, left = _least_loss(place, chance)
    i = int(np.argmax(chance * (np.abs(place - best) <= WORST)))
    curve, spread, points = _refined(strips, k, float(found.row[i]), int(found.shear[i]))
    curve[0] += best - place[i]
    ends = np.array([[0.0, curve[0]], [1.0, curve.sum()]]) / [1.0, strips.extent[k]]
    p, q = mapped(strips.H[k][None], ends)[0]
    blind = _blind(grey, strips, k, best)
    # the edge found is one end of what is blind, the border anywhere in it
    sigma = float(np.sqrt(spread**2 / points + left + blind**2 / 3.0))
    return _Side(p, q, float(curve[2]), spread, sigma, blind)


def _blind(grey: Image, strips: _Strips, k: int, place: float) -> float:
    """How far the picture is burnt across side k from an edge at `place` [pixels]; 0 if a frame beside it is seen."""
    level = strips.level[k]
    row = (place - strips.first[k]) / PITCH + 1.0
    beyond, reach = max(round(row - CRISP / PITCH), 0), round(BLIND / PITCH)
    near = level[max(round(row) - reach, 0) : round(row) + reach + 1]
    outside = level[max(round(row) - reach, 0) : beyond + 1]
    # a surface that is nearly burnt all over ends where a frame that is not begins
    everywhere = np.count_nonzero(strips.level[np.arange(4), strips.rows] >= NEARLY) > 1
    crisp = level[beyond] < BURNT - DROP and outside.max() < BURNT
    if near.max() < BURNT or (everywhere and crisp):
        return 0.0
    size = (STRETCHES * EACH // 3, BLIND_ROWS)
    wide = _strip(grey, strips.H[k], (ENDS, 1.0 - ENDS), (-BOTH_WAYS, BOTH_WAYS), size)
    burnt = np.median(wide, 1) >= BURNT
    pitch = 2.0 * BOTH_WAYS * float(strips.extent[k]) / (BLIND_ROWS - 1)
    middle = place / pitch + 0.5 * (BLIND_ROWS - 1)
    at = np.flatnonzero(burnt)
    if not len(at):
        return 0.0
    begin = end = int(at[np.abs(at - middle).argmin()])
    while begin > 0 and burnt[begin - 1]:
        begin -= 1
    while end < BLIND_ROWS - 1 and burnt[end + 1]:
        end += 1
    return pitch * (end - begin + 1)


def _least_loss(place: Array, chance: Array) -> tuple[float, float]:
    """Where to put the border if it lies at one of the places [pixels], and the mean square error left there.

    Where it is least likely to be wrong: of two edges near to each other it may have to be between them.
    """
    at = np.append(np.linspace(place.min(), place.max(), max(2, round(float(np.ptp(place)) / 0.25))), place)
    off = np.abs(at[:, None] - place)
    i = int((((off > WRONG) + NEAR * np.minimum(off, WORST) ** 2) @ chance).argmin())
    return float(at[i]), float(off[i] ** 2 @ chance) / max(float(chance.sum()), 1e-6)


def _refined(strips: _Strips, k: int, row: float, shear: int) -> tuple[Array, float, int]:
    """A curve through the steps of all stretches nearest to an edge.

    Returns:
        distance inward of the rough side as a parabola in the place along it, (3,) [pixels]; its spread [pixels]; how
        many stretches it is fitted to, at least 1.
    """
    u = _along()
    middle = round(row)
    sign = np.sign(strips.mean[k, shear, min(max(middle, 0), int(strips.rows[k]) - 1)])
    begin = np.rint(middle + SHEARS[shear] * u / PITCH).astype(np.int64)
    window = np.clip(begin[:, None] + np.arange(-3, 4), 0, strips.step.shape[1] - 1)
    n = np.arange(STRETCHES)
    value = sign * strips.step[k, window, n[:, None]]
    best = value[:, 1:-1].argmax(1) + 1
    here, before, after = value[n, best], value[n, best - 1], value[n, best + 1]
    bend = before - 2.0 * here + after
    peak = np.where(bend < -1e-3, 0.5 * (before - after) / np.where(bend < -1e-3, bend, -1.0), 0.0)
    place = PITCH * (window[n, best] + np.clip(peak, -1.0, 1.0))
    good = here > 0.3 * _middle(here)
    curve, spread = np.array([PITCH * middle - 0.5 * SHEARS[shear], SHEARS[shear], 0.0]), 1.0
    if good.sum() >= 6:
        curve, spread = _curve(u[good] + 0.5, place[good], curve)
    curve[0] += strips.first[k] + PITCH * (row - middle)
    return curve, spread, max(int(good.sum()) - 2, 1)


def _normal(p: Array, q: Array) -> Array:
    """Unit normal of the line from p to q, to the right in a picture whose y points down."""
    along = (q - p) / np.linalg.norm(q - p)
    return np.array([-along[1], along[0]])


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


def _corner_sigma(before: _Side, after: _Side) -> float:
    """Root of the mean square distance of a corner whose sides may be moved [pixels]."""
    sine = float(before.inward[0] * after.inward[1] - before.inward[1] * after.inward[0])
    return float(np.hypot(np.hypot(before.sigma, after.sigma) / max(abs(sine), 0.1), LEFT))


def _at(curve: Array, t: Array) -> Array:
    return curve[0] + t * (curve[1] + t * curve[2])


def _curve(t: Array, y: Array, start: Array) -> tuple[Array, float]:
    """y in t by reweighted least squares (Tukey), and the spread.

    A line; a parabola where a line leaves clearly more (a lens bends straight edges).
    """
    line, spread = _reweighted(t, y, start, 2)
    if len(t) < 10 or spread < 0.5 * BOW:  # a sum of noise and bow cannot be less than the bow
        return line, spread
    parabola, left = _reweighted(t, y, line, 3)
    bowed = 0.25 * abs(parabola[2]) > BOW and left < 0.8 * spread
    return (parabola, left) if bowed else (line, spread)


def _reweighted(t: Array, y: Array, curve: Array, terms: int) -> tuple[Array, float]:
    basis = np.stack([np.ones_like(t), t, t * t][:terms], 1)
    scale = 1.0
    for _ in range(4):
        off = y - _at(curve, t)
        scale = max(1.4826 * _middle(np.abs(off)), 0.1)
        weighted = basis * np.maximum(1.0 - (off / (4.0 * scale)) ** 2, 0.0)[:, None] ** 2
        curve = np.zeros(3)
        curve[:terms] = np.linalg.solve(weighted.T @ basis + 1e-9 * np.eye(terms), weighted.T @ y)
    return curve, scale


def _middle(x: Array) -> float:
    """A median; numpy's own takes longer than all the rest on a few numbers."""
    return float(np.sort(x)[len(x) // 2])
