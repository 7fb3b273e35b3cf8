"""Ink on a writing surface: thin strokes darker or of another colour than what is around them.

A stroke is narrow, so a morphological closing removes it: closing minus picture ("black hat", F. Meyer 1979) is what
the stroke took away from the light, channel by channel. Steps of brightness (shadows, edges of reflections) pass a
closing unchanged and leave nothing. A dark gap between two reflections would leave something; it is told from ink by
the surface's usual level around it, which ink falls below and a gap does not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np

from ..arm import Array
from ._image import Image, Mask

STROKE = 0.055
"""widest stroke, relative to the board's shorter side"""
MARGIN = 0.006
"""left out along the border, relative to the board's shorter side"""
FAINT, CLEAR = 0.045, 0.09
"""part of the light that the weakest and the core of a stroke take away, at least"""
SIGMAS = 5.0
"""and by so many standard deviations of the noise"""
BELOW = 0.03
"""ink is darker than the surface usually is nearby by this part"""
RIM = 0.025
"""what touches the border and stays within this, relative to the board's shorter side, belongs to the frame"""
THING = 0.016
"""half width from which a filled piece is a thing rather than a stroke, relative to the board's shorter side"""
DARK = 0.5
"""a thing wider than a stroke takes away this part of the light at least, in one colour: no shadow is so deep"""
PALE = 0.25
"""a wide piece inside the board that takes away less of the light than this, and is darker than what lies around, is a
smudge, not a thing"""
EVEN = 0.11
"""standard deviation within a thing of what it takes away, relative to it: letters on a smudge make one filled piece"""
PATCH = 12
"""a pale piece wider than a stroke covers so many of every ninth pixels at least"""
SPECK = 9
"""smallest connected piece [pixels]"""
GRAIN = 0.05
"""a piece whose core takes away less of the light is larger in proportion: dust and grain are single pixels"""


@dataclass(frozen=True, slots=True)
class Ink:
    """What is on a writing surface."""

    mask: Mask
    """(H, W) ink"""
    polygons: tuple[Array, ...]
    """outlines of connected pieces of ink, each (M, 2) [pixels]"""
    objects: tuple[Array, ...]
    """outlines of other things: magnets, stickers, an eraser"""
    contrast: Array
    """(len(polygons),) part of the light that the piece takes away, at its core"""


def find(
    image: Image,
    corners: Array,
    *,
    faint: float = FAINT,
    clear: float = CLEAR,
    least: int | None = None,
) -> Ink:
    """Ink in a picture (H, W, 3) within the quadrangle corners (4, 2) [pixels].

    `faint` and `clear`: part of the light that the weakest and the core of a stroke take away, at least.
    `least`: pixels of a piece at least; None: SPECK, and more of a faint one.
    """
    height, width = image.shape[:2]
    low = np.clip(np.floor(corners.min(0)).astype(int) - 2, 0, None)
    high = np.minimum(np.ceil(corners.max(0)).astype(int) + 3, [width, height])
    part = image[low[1] : high[1], low[0] : high[0]]
    inside = np.zeros(part.shape[:2], np.uint8)
    cv2.fillConvexPoly(inside, np.rint((corners - low) * 16).astype(np.int32), 255, shift=4)
    shorter = float(np.sqrt(cv2.contourArea(corners.astype(np.float32)) * _shape(corners)))
    edge = 2 * max(1, round(MARGIN * shorter)) + 1
    inside = cv2.erode(inside, np.ones((edge, edge), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0)
    smooth = cv2.GaussianBlur(part, (3, 3), 0)
    board = cv2.bitwise_and(smooth, smooth, mask=inside)
    size = 2 * max(4, round(0.5 * STROKE * shorter)) + 1
    closed = cv2.morphologyEx(board, cv2.MORPH_CLOSE, np.ones((size, size), np.uint8))
    taken = _largest(cv2.divide(cv2.subtract(closed, board), closed, scale=255.0))
    below = _largest(cv2.divide(cv2.subtract(_level(board, inside), board), closed, scale=255.0))
    surface = taken[::3, ::3][inside[::3, ::3] > 0]
    if not surface.size:
        return Ink(np.zeros((height, width), bool), (), (), np.zeros(0))
    # the noise: half of a clean surface takes away less than the median, without strokes
    middle = float(np.median(surface))
    away = np.abs(surface[surface <= 2.0 * middle + 2.0] - middle)
    # the median distance of whole numbers is 0 or 1 where there is little noise; the mean one is finer
    noise = max(1.4826 * float(np.median(away)), math.sqrt(0.5 * math.pi) * float(np.mean(away)))
    weakest = max(255.0 * faint, middle + SIGMAS * noise)
    core = max(255.0 * clear, middle + 1.6 * SIGMAS * noise)
    darker = 255.0 * BELOW * min(1.0, faint / FAINT)
    weak = ((taken > weakest) & (below > darker) & (inside > 0)).astype(np.uint8)
    things = _things(below, inside, weak, size)
    patches = _patches(below, inside, weak, things, size, core)
    if patches is not None:
        weak |= patches
        taken = cv2.max(taken, cv2.bitwise_and(below, below, mask=patches))
    ink = _pieces(
        board,
        weak,
        taken,
        below,
        things,
        core,
        corners - low,
        low,
        (height, width),
        shorter,
        edge / 2.0,
        least,
    )
    found, _ = cv2.findContours(things, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    solid = tuple(3.0 * f.reshape(-1, 2) + 1.0 + low for f in found)
    return replace(ink, objects=ink.objects + solid)


def _things(below: Image, inside: Image, weak: Image, size: int) -> Image:
    """Where something wider than any stroke covers the surface, in every third pixel.

    Not where most of it is `weak`, that is narrow enough to be judged as a piece.
    """
    dark = ((below[1::3, 1::3] > 255.0 * DARK) & (inside[1::3, 1::3] > 0)).astype(np.uint8)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size // 3 + 1, size // 3 + 1))
    solid = cv2.morphologyEx(dark, cv2.MORPH_OPEN, disc)
    count, label = cv2.connectedComponents(solid)
    if count > 1:
        names = label.ravel()
        narrow = np.bincount(names, weak[1::3, 1::3].ravel(), count) / np.bincount(names, minlength=count)
        solid[narrow[label] > 0.8] = 0
    return solid


def _patches(below: Image, inside: Image, weak: Image, things: Image, size: int, core: float) -> Image | None:
    """Pale pieces wider than a stroke, which a closing fills: rests that were wiped about.

    Shadows are as pale and as wide. They fade at their rims or run out of the board, so a patch is what ends within the
    board in a step all around.
    """
    small = cv2.boxFilter(below, -1, (3, 3))[1::3, 1::3]
    dark = ((small > core) & (inside[1::3, 1::3] > 0)).astype(np.uint8)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size // 6 + 1, size // 6 + 1))
    solid = cv2.morphologyEx(dark, cv2.MORPH_OPEN, disc)
    count, label, stats, _ = cv2.connectedComponentsWithStats(solid, connectivity=8)
    out = np.zeros_like(solid)
    near = np.ones((3, 3), np.uint8)
    height, width = solid.shape
    for i in range(1, count):
        x, y, w, h, area = stats[i]
        window = np.s_[max(0, y - 4) : min(height, y + h + 4), max(0, x - 4) : min(width, x + w + 4)]
        piece = (label[window] == i).astype(np.uint8)
        if area < PATCH or np.any(piece & things[window]):
            continue
        if np.count_nonzero(piece & weak[1::3, 1::3][window]) > 0.8 * area:
            continue  # it is found as it is
        within = cv2.morphologyEx(piece, cv2.MORPH_GRADIENT, near) & piece
        beyond = cv2.dilate(piece, np.ones((7, 7), np.uint8)) - cv2.dilate(piece, np.ones((5, 5), np.uint8))
        beyond &= weak[1::3, 1::3][window] ^ 1
        if np.any(inside[1::3, 1::3][window][beyond > 0] == 0) or not np.any(beyond):
            continue
        values = small[window]
        usual = float(np.median(values[within > 0]))
        if float(np.percentile(values[beyond > 0], 80)) < 0.5 * usual:
            out[window] |= piece
    if not out.any():
        return None
    whole = np.zeros_like(weak)
    grown = cv2.resize(cv2.dilate(out, near), (3 * width, 3 * height), interpolation=cv2.INTER_NEAREST)
    whole[: grown.shape[0], : grown.shape[1]] = grown[: whole.shape[0], : whole.shape[1]]
    deep = cv2.compare(below, 0.5 * core, cv2.CMP_GT)  # the cells of nine pixels reach beyond it
    return cv2.bitwise_and(whole, deep, mask=inside)


def _shape(corners: Array) -> float:
    """Shorter side over longer side, as seen."""
    sides = np.linalg.norm(corners - np.roll(corners, -1, 0), axis=1)
    a, b = sides[0] + sides[2], sides[1] + sides[3]
    return float(min(a, b) / max(a, b))


def _largest(channels: Image) -> Image:
    blue, green, red = cv2.split(channels)
    return cv2.max(cv2.max(blue, green), red)


def _level(board: Image, inside: Image) -> Image:
    """The surface's usual colour nearby: a wide median; outside of the board the nearest inside."""
    height, width = inside.shape
    scale = max(1.0, max(height, width) / 80.0)
    size = (max(8, round(width / scale)), max(8, round(height / scale)))
    # every third pixel is enough for means of many
    small = cv2.resize(board[1::3, 1::3], size, interpolation=cv2.INTER_AREA).astype(np.float32)
    part = (
        cv2.resize(inside[1::3, 1::3], size, interpolation=cv2.INTER_AREA).astype(np.float32)[..., None]
        / 255.0
    )
    full = np.where(part > 0.5, small / np.maximum(part, 0.5), 0.0)
    # fill the outside from within, by wider and wider means
    for k in (9, 33, 129):
        weight = cv2.blur((full.max(2) > 0).astype(np.float32), (k, k))
        mean = cv2.blur(full, (k, k)) / np.maximum(weight, 1e-3)[..., None]
        full = np.where(full.max(2, keepdims=True) > 0, full, mean)
    wide = cv2.medianBlur(np.clip(full, 0, 255).astype(np.uint8), 2 * (min(size) // 5) + 1)
    return cv2.resize(wide, (width, height), interpolation=cv2.INTER_LINEAR)


def _darker(board: Image, weak: Image, piece: Mask, box: Array, strength: float) -> bool:
    """Whether a piece is darker than the surface around it, rather than a gap between lights that shine on it."""
    x, y, w, h = (int(v) for v in box)
    reach = 2 * max(w, h)
    window = np.s_[max(0, y - reach) : y + h + reach, max(0, x - reach) : x + w + reach]
    light = board[window]
    around = light[(weak[window] == 0) & (light.max(2) > 0)]
    if not len(around):
        return False
    # a coloured pen takes its light from some channels only
    usual = np.percentile(around, 10, axis=0)
    return bool(np.any(np.median(light[piece[window]], axis=0) < (1.0 - 0.5 * strength) * usual))


def _pieces(
    board: Image,
    weak: Image,
    taken: Image,
    below: Image,
    things: Image,
    clear: float,
    corners: Array,
    low: Array,
    shape: tuple[int, int],
    shorter: float,
    margin: float,
    least: int | None,
) -> Ink:
    """Connected pieces that are clear somewhere, sorted into ink and other things."""
    mask = np.zeros(shape, bool)
    count, label, stats, _ = cv2.connectedComponentsWithStats(weak, connectivity=8)
    if count == 1:
        return Ink(mask, (), (), np.zeros(0))
    points = cv2.findNonZero(weak).reshape(-1, 2)
    names = label[points[:, 1], points[:, 0]]
    order = np.argsort(names, kind="stable")  # the points, piece by piece
    points = points[order]
    begin = np.append(0, np.cumsum(stats[1:, cv2.CC_STAT_AREA]))[:-1]
    xs, ys = points[:, 0], points[:, 1]
    values = taken[ys, xs].astype(np.float32)
    core = values > clear
    hits = np.add.reduceat(core.astype(np.float32), begin)
    strength = np.add.reduceat(values * core, begin) / np.maximum(hits, 1.0) / 255.0
    area = stats[1:, cv2.CC_STAT_AREA].astype(np.float64)
    # of the largest disc within a piece
    radius = np.maximum.reduceat(cv2.distanceTransform(weak, cv2.DIST_L2, 3)[ys, xs], begin)
    inward = np.full(len(points), np.inf, np.float32)
    for p, q in zip(corners, np.roll(corners, -1, 0), strict=True):
        n = np.array([p[1] - q[1], q[0] - p[0]]) / np.linalg.norm(q - p)
        inward = np.minimum(inward, points @ n.astype(np.float32) - np.float32(n @ p))
    nearest, deepest = np.minimum.reduceat(inward, begin), np.maximum.reduceat(inward, begin)
    # shadow, dirt and rest of the frame: it touches the border and stays beside it
    rim = (nearest < margin + 3.0) & (deepest < max(4.0, RIM * shorter))
    # the rim of a thing
    around = cv2.dilate(things, np.ones((3, 3), np.uint8))
    last = np.array(around.shape[::-1]) - 1
    at = np.minimum(points // 3, last)
    beside = np.add.reduceat(around[at[:, 1], at[:, 0]].astype(np.float32), begin) > 0.3 * area
    enough = SPECK * np.maximum(1.0, GRAIN / np.maximum(strength, 1e-3)) if least is None else float(least)
    good = (hits >= np.maximum(3.0, 0.1 * area)) & (area >= enough) & ~rim & ~beside
    wide = THING * shorter + 1.5
    outlines, filled, uneven = {}, np.zeros(len(good)), np.zeros(len(good))
    for i in np.flatnonzero(good):
        x, y, w, h = stats[i + 1, :4]
        piece = (label[y : y + h, x : x + w] == i + 1).astype(np.uint8)
        found, _ = cv2.findContours(piece, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
        line = max(found, key=len).reshape(-1, 2)
        outlines[i] = piece, (line + low + np.array([x, y])).astype(np.float64)
        if radius[i] > wide:
            # without what blur adds around it, and without what joins letters that run together
            dark = below[y : y + h, x : x + w]
            core = 0.6 * float(np.percentile(dark[piece > 0], 90))
            solid = cv2.findNonZero(piece * (dark > core).astype(np.uint8))
            filled[i] = len(solid) / max(cv2.contourArea(cv2.convexHull(solid)), 1.0)
            inner = cv2.erode(
                piece * (dark > core).astype(np.uint8), np.ones((5, 5), np.uint8), borderValue=0
            )
            if inner.any():
                level, spread = cv2.meanStdDev(dark, mask=inner)
                uneven[i] = float(spread[0, 0] / max(level[0, 0], 1.0))
    # half of the ink is in pieces at most so thick; a filled piece tells nothing of a pen's width
    drawn = np.flatnonzero(good & (filled < 0.6))
    drawn = drawn[np.argsort(radius[drawn], kind="stable")]
    mass = np.cumsum(area[drawn])
    pen = float(radius[drawn[np.searchsorted(mass, 0.5 * mass[-1])]]) if len(drawn) else 0.0
    # a magnet, a sticker, an eraser, a hand: as wide as no stroke, and filled or reaching in from outside
    bold = filled > 0.9
    # where letters run together a pen seems thick, but what is round and much wider than a stroke is no letter
    compact = bold & (area < 2.2 * np.pi * radius**2) & (radius > 1.5 * wide)
    broad = radius > np.maximum(wide, np.where(compact, 1.2, 1.8) * pen)
    for i in np.flatnonzero(good & broad & bold & (strength < PALE)):
        bold[i] = not _darker(board, weak, label == i + 1, stats[i + 1, :4], float(strength[i]))
    bold &= (strength < PALE) | (uneven < EVEN) | (radius > 3.0 * wide)
    thing = broad & (bold | (nearest < margin + 3.0))
    polygons, objects, contrast = [], [], []
    for i, (piece, line) in outlines.items():
        if thing[i]:
            objects.append(line)
            continue
        x, y, w, h = stats[i + 1, :4]
        polygons.append(line)
        contrast.append(strength[i])
        view = mask[low[1] + y : low[1] + y + h, low[0] + x : low[0] + x + w]
        view |= piece > 0
    return Ink(mask, tuple(polygons), tuple(objects), np.array(contrast))
