"""Four lines that could enclose a board, and what speaks for it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ..arm import Array
from ._image import Float, Image, Index, Mask
from ._lines import Gradient, Lines

SIDE = 0.35
"""least part of a side that an edge must support"""
SHORTEST = 0.07
"""shortest side, relative to the picture's longer one"""
SMALLEST = 0.025
"""smallest area, relative to the picture"""
CORNER = 12.0
"""how far around a corner its sides are looked at [pixels]"""
OUT_OF_VIEW = 0.5
"""support that the picture's border is taken to give a side"""
SHORTLIST = 64
"""quadrangles looked at more closely"""
GRID = 12
"""points per direction at which the inside is looked at"""
LEAST_SINE = 0.42
"""of the angle between neighbouring sides"""
TINT = 0.2
"""saturation that a lamp's colour gives a white surface"""
WHITE = 0.65
"""a white surface in the shade has this part of the picture's brightest level"""
BURNT = 250
"""a pixel with all channels above is as white as it gets"""


@dataclass(frozen=True, slots=True)
class Quads:
    """Candidates, best first."""

    corners: Array
    """(K, 4, 2) [pixels], clockwise as seen"""
    border: Mask
    """(K, 4) bool: the side from corner i to i+1 is the picture's border"""
    features: Array
    """(K, F), see FEATURES"""
    score: Array
    """(K,) log odds"""


FEATURES = (
    "support",  # mean support of the sides
    "weakest",  # least support of a side
    "junction",  # sides end at corners, they do not run on
    "flat",  # part of the inside without edges
    "even",  # part of the inside that a smooth surface explains
    "bright",  # surface against the brightest of the picture
    "coloured",  # saturation of the surface
    "size",  # log of the area
    "contrast",  # other brightness outside than inside, mean over sides
    "painted",  # saturation of the surface beyond what a lamp's colour gives white
    "dark",  # surface against the brightest of the picture, by which it is less than WHITE
    "burnt",  # part of the inside that is as white as the picture can be, beyond half: a lamp, a window, the sun
)
WEIGHTS = np.array([7.5, 5.4, 4.6, 0.8, 2.5, 3.1, -4.2, 1.2, 2.0, -12.0, -8.0, -12.0])
BIAS = -17.9


def find(lines: Lines, gradient: Gradient, image: Image, grey: Image) -> Quads:
    """Quadrangles of four of the lines, or of three and the picture's border."""
    height, width = grey.shape
    normal = np.vstack([lines.normal, [[1, 0], [1, 0], [0, 1], [0, 1]]])
    offset = np.append(lines.offset, [0.0, width - 1.0, 0.0, height - 1.0])
    border = np.arange(len(offset)) >= len(lines.offset)
    support = _Support(normal, offset, border, gradient)
    n = len(offset)
    i, j = np.triu_indices(n, 1)
    # side[a, p]: support of line a between its crossings with the two lines of pair p
    side, ends, valid = support.sides(i, j, SHORTEST * max(width, height))
    crossed = valid.sum(0) >= 2  # two lines have a side between these two
    i, j, side, ends, valid = i[crossed], j[crossed], side[:, crossed], ends[:, crossed], valid[:, crossed]
    first = valid[i] & valid[j]  # (pair, pair)
    p, q = np.nonzero(first & first.T)
    p, q = p[p < q], q[p < q]
    keep = border[i[p]].astype(int) + border[j[p]] + border[i[q]] + border[j[q]] <= 1
    p, q = p[keep], q[keep]
    if not len(p):
        return _none()
    order = np.stack([i[p], i[q], j[p], j[q]], 1)  # lines in turn
    corners = np.stack([support.crossing[order[:, k - 1], order[:, k]] for k in range(4)], 1)
    supports = np.stack([side[i[p], q], side[i[q], p], side[j[p], q], side[j[q], p]], 1)
    junctions = np.stack([ends[i[p], q], ends[i[q], p], ends[j[p], q], ends[j[q], p]], 1)
    area = _area(corners)
    turned = area < 0
    # corner k lies between lines k-1 and k: reversing the walk keeps that when the lines are reversed too
    corners[turned] = corners[turned][:, [0, 3, 2, 1]]
    order[turned], supports[turned], junctions[turned] = (
        x[turned][:, ::-1] for x in (order, supports, junctions)
    )
    area = np.abs(area)
    keep = _convex(corners) & (area > SMALLEST * width * height)
    order, corners, supports, junctions, area = (x[keep] for x in (order, corners, supports, junctions, area))
    if not len(order):
        return _none()
    quick = (
        supports.mean(1) + 0.5 * supports.min(1) + 0.3 * junctions.mean(1) + 0.12 * np.log(area / area.max())
    )
    best = np.argsort(-quick, kind="stable")[:SHORTLIST]
    order, corners, supports, junctions, area = (x[best] for x in (order, corners, supports, junctions, area))
    flat, even, bright, coloured, burnt = _inside(corners, image, grey, gradient)
    features = np.column_stack(
        [
            supports.mean(1),
            supports.min(1),
            junctions.mean(1),
            flat,
            even,
            bright,
            coloured,
            np.log(area / (width * height)),
            _contrast(corners, grey),
            np.maximum(coloured - TINT, 0.0),
            np.maximum(WHITE - bright, 0.0),
            np.maximum(burnt - 0.5, 0.0),
        ]
    )
    score = features @ WEIGHTS + BIAS
    rank = np.argsort(-score, kind="stable")
    return Quads(corners[rank], border[order][rank], features[rank], score[rank])


def _none() -> Quads:
    return Quads(np.zeros((0, 4, 2)), np.zeros((0, 4), bool), np.zeros((0, len(FEATURES))), np.zeros(0))


class _Support:
    """Which points of the lines lie on edges."""

    def __init__(self, normal: Array, offset: Array, border: Mask, gradient: Gradient) -> None:
        height, width = gradient.x.shape
        self.along = np.stack([-normal[:, 1], normal[:, 0]], 1)
        centre = np.array([width / 2.0, height / 2.0])
        self.origin = centre + (offset - normal @ centre)[:, None] * normal
        self.half = int(np.hypot(width, height) / 2.0) + 20
        self.border = border
        t = np.arange(-self.half, self.half + 1, dtype=np.float32)
        origin, along, across = (x.astype(np.float32)[:, None] for x in (self.origin, self.along, normal))
        at = origin + along * t[:, None]
        beside = np.stack([at - across, at, at + across])
        both = cv2.merge([gradient.x, gradient.y])
        maps = beside.reshape(-1, len(t), 2)
        edge = cv2.remap(both, maps, None, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
        gx, gy = np.moveaxis(edge.reshape(*beside.shape), 3, 0)
        nx, ny = normal.astype(np.float32).T[:, :, None]
        across, aside = np.abs(gx * nx + gy * ny), np.abs(gx * ny - gy * nx)
        hit = ((across > gradient.noise) & (aside < 0.6 * across)).any(0)
        support = hit.astype(np.float64)
        support[border] = OUT_OF_VIEW
        self.total = np.concatenate([np.zeros((len(offset), 1)), np.cumsum(support, 1)], 1)
        # crossings
        sine = normal[:, 0][:, None] * normal[:, 1][None] - normal[:, 1][:, None] * normal[:, 0][None]
        self.crosses = np.abs(sine) > LEAST_SINE
        safe = np.where(self.crosses, sine, 1.0)
        x = (offset[:, None] * normal[:, 1][None] - offset[None] * normal[:, 1][:, None]) / safe
        y = (offset[None] * normal[:, 0][:, None] - offset[:, None] * normal[:, 0][None]) / safe
        self.crossing = np.stack([x, y], 2)
        slack = 2.0
        self.crosses &= (x > -slack) & (x < width - 1 + slack) & (y > -slack) & (y < height - 1 + slack)
        self.t = np.where(
            self.crosses, np.einsum("abk,ak->ab", self.crossing - self.origin[:, None], self.along), 0.0
        )

    def sides(self, i: Index, j: Index, shortest: float) -> tuple[Array, Array, Mask]:
        """Of every line between its crossings with lines i and j: support, junctions, whether it may be a side."""
        n = len(self.t)
        rows = np.arange(n)[:, None]
        ti, tj = self.t[:, i], self.t[:, j]
        low, high = np.minimum(ti, tj), np.maximum(ti, tj)
        length = high - low

        def mean(begin: Array, end: Array) -> Array:
            a = np.clip(np.rint(begin).astype(np.int64) + self.half, 0, 2 * self.half + 1)
            b = np.clip(np.rint(end).astype(np.int64) + self.half, 0, 2 * self.half + 1)
            return (self.total[rows, b] - self.total[rows, a]) / np.maximum(b - a, 1)

        side = mean(low, high)
        valid = self.crosses[:, i] & self.crosses[:, j] & (length > shortest) & (side >= SIDE)
        # before and behind every crossing, in the direction of growing t
        before, behind = mean(self.t - CORNER, self.t - 2.0), mean(self.t + 2.0, self.t + CORNER)
        at_low = np.where(ti < tj, (behind - before)[:, i], (behind - before)[:, j])
        at_high = np.where(ti < tj, (before - behind)[:, j], (before - behind)[:, i])
        return side, 0.5 * (at_low + at_high), valid


def _area(corners: Array) -> Array:
    x, y = corners[..., 0], corners[..., 1]
    return 0.5 * (x * np.roll(y, -1, 1) - y * np.roll(x, -1, 1)).sum(1)


def _convex(corners: Array) -> Mask:
    edge = np.roll(corners, -1, 1) - corners
    after = np.roll(edge, -1, 1)
    cross = edge[..., 0] * after[..., 1] - edge[..., 1] * after[..., 0]
    return np.all(cross > 0, 1)


def homographies(corners: Array) -> Array:
    """(K, 3, 3) from the unit square (0,0), (1,0), (1,1), (0,1) to corners (K, 4, 2). Heckbert 1989."""
    x, y = corners[..., 0], corners[..., 1]
    dx1, dx2, sx = x[:, 1] - x[:, 2], x[:, 3] - x[:, 2], x[:, 0] - x[:, 1] + x[:, 2] - x[:, 3]
    dy1, dy2, sy = y[:, 1] - y[:, 2], y[:, 3] - y[:, 2], y[:, 0] - y[:, 1] + y[:, 2] - y[:, 3]
    det = dx1 * dy2 - dx2 * dy1
    g, h = (sx * dy2 - dx2 * sy) / det, (dx1 * sy - sx * dy1) / det
    rows = [
        [x[:, 1] - x[:, 0] + g * x[:, 1], x[:, 3] - x[:, 0] + h * x[:, 3], x[:, 0]],
        [y[:, 1] - y[:, 0] + g * y[:, 1], y[:, 3] - y[:, 0] + h * y[:, 3], y[:, 0]],
        [g, h, np.ones_like(g)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def mapped(H: Array, points: Array) -> Array:
    """Points (M, 2) through homographies (K, 3, 3): (K, M, 2)."""
    p = points @ np.swapaxes(H[:, :, :2], 1, 2) + H[:, None, :, 2]
    return p[..., :2] / p[..., 2:]


def picked(channel: Image | Float, points: Array) -> Array:
    """The nearest pixels of a one-channel picture at points (..., 2)."""
    height, width = channel.shape
    x = np.clip(points[..., 0] + 0.5, 0, width - 1).astype(np.int32)
    y = np.clip(points[..., 1] + 0.5, 0, height - 1).astype(np.int32)
    return channel[y, x].astype(np.float32)


def _inside(
    corners: Array, image: Image, grey: Image, gradient: Gradient
) -> tuple[Array, Array, Array, Array, Array]:
    """Flat part, part explained by a smooth surface, brightness, saturation, burnt part."""
    u = np.linspace(0.05, 0.95, GRID)
    grid = np.stack(np.meshgrid(u, u), -1).reshape(-1, 2)
    at = mapped(homographies(corners), grid)
    level = picked(grey, at)
    slope = np.maximum(np.abs(picked(gradient.x, at)), np.abs(picked(gradient.y, at)))
    flat = slope < gradient.noise
    usable = flat + 1e-3
    # a plane of brightness, fitted twice: the second time without what is off
    basis = np.column_stack([np.ones(len(grid)), grid - 0.5])
    squares = (basis[:, :, None] * basis[:, None]).reshape(-1, 9)
    weight = usable
    for _ in range(2):
        normal = (weight @ squares).reshape(-1, 3, 3) + 1e-6 * np.eye(3)
        right = (weight * level) @ basis
        plane = np.linalg.solve(normal, right[..., None])[..., 0] @ basis.T
        off = np.abs(level - plane)
        weight = usable * (off < np.maximum(12.0, 0.12 * plane))
    even = (off < np.maximum(12.0, 0.12 * np.abs(plane))).mean(1)
    surface = weight > 0.5
    count = np.maximum(surface.sum(1), 1)
    bright = (level * surface).sum(1) / count / max(float(np.percentile(grey[::4, ::4], 98)), 1.0)
    blue, green, red = (picked(image[..., c], at) for c in range(3))
    top, bottom = np.maximum(np.maximum(blue, green), red), np.minimum(np.minimum(blue, green), red)
    colour = ((1.0 - bottom / np.maximum(top, 1.0)) * surface).sum(1) / count
    return flat.mean(1), even, bright, colour, (bottom >= BURNT).mean(1)


def _contrast(corners: Array, grey: Image) -> Array:
    """Difference of brightness between both sides of the border, relative, mean over the four sides."""
    t = np.linspace(0.1, 0.9, 12)[None, None, :, None]
    a, b = corners[:, :, None], np.roll(corners, -1, 1)[:, :, None]
    at = a + (b - a) * t
    edge = (b - a)[:, :, 0]
    inward = np.stack([-edge[..., 1], edge[..., 0]], -1) / np.linalg.norm(edge, axis=-1, keepdims=True)
    inner = np.median(picked(grey, at + 4.0 * inward[:, :, None]), 2)
    outer = np.stack([np.median(picked(grey, at - d * inward[:, :, None]), 2) for d in (2.0, 5.0, 9.0)], -1)
    off = np.abs(outer - inner[..., None]).max(-1) / np.maximum(inner, 20.0)
    return np.minimum(off, 0.3).mean(1) / 0.3
