"""Ink on a writing surface: thin strokes darker or of another colour than what is around them.

A stroke is narrow, so a morphological closing removes it: closing minus picture ("black hat", F. Meyer 1979) is what the
stroke took away from the light, channel by channel. Steps of brightness (shadows, edges of reflections) pass a closing
unchanged and leave nothing. A dark gap between two reflections would leave something; it is told from ink by the
surface's usual level around it, which ink falls below and a gap does not.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from ..arm import Array
from ._image import Image

Mask = npt.NDArray[np.bool_]

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
SPECK = 9
"""smallest connected piece [pixels]"""


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


def find(image: Image, corners: Array) -> Ink:
    """Ink in a picture (H, W, 3) within the quadrangle corners (4, 2) [pixels]."""
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
    surface = taken[inside > 0]
    if not surface.size:
        return Ink(np.zeros((height, width), bool), (), (), np.zeros(0))
    # the noise: half of a clean surface takes away less than the median, without strokes
    middle = float(np.median(surface))
    noise = 1.4826 * float(np.median(np.abs(surface[surface <= 2.0 * middle + 2.0] - middle)))
    faint = max(255.0 * FAINT, middle + SIGMAS * noise)
    clear = max(255.0 * CLEAR, middle + 1.6 * SIGMAS * noise)
    weak = ((taken > faint) & (below > 255.0 * BELOW) & (inside > 0)).astype(np.uint8)
    return _pieces(weak, taken, clear, low, (height, width), size)


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
    small = cv2.resize(board, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    part = cv2.resize(inside, size, interpolation=cv2.INTER_AREA).astype(np.float32)[..., None] / 255.0
    full = np.where(part > 0.5, small / np.maximum(part, 0.5), 0.0)
    # fill the outside from within, by wider and wider means
    for k in (9, 33, 129):
        weight = cv2.blur((part[..., 0] > 0.5).astype(np.float32) if k == 9 else (full.max(2) > 0).astype(np.float32), (k, k))
        mean = cv2.blur(full, (k, k)) / np.maximum(weight, 1e-3)[..., None]
        full = np.where(full.max(2, keepdims=True) > 0, full, mean)
    wide = cv2.medianBlur(np.clip(full, 0, 255).astype(np.uint8), 2 * (min(size) // 5) + 1)
    return cv2.resize(wide, (width, height), interpolation=cv2.INTER_LINEAR)


def _pieces(weak: Image, taken: Image, clear: float, low: Array, shape: tuple[int, int], size: int) -> Ink:
    """Connected pieces that are clear somewhere, sorted into ink and other things."""
    count, label, stats, _ = cv2.connectedComponentsWithStats(weak, connectivity=8)
    mask = np.zeros(shape, bool)
    polygons, objects, contrast = [], [], []
    if count > 1:
        strength = np.zeros(count, np.float64)
        ys, xs = np.nonzero(weak)
        names = label[ys, xs]
        values = taken[ys, xs].astype(np.float64)
        hits = np.bincount(names, values > clear, count)
        strength = np.bincount(names, np.where(values > clear, values, 0.0), count) / np.maximum(hits, 1)
        area = stats[:, cv2.CC_STAT_AREA]
        good = (hits >= np.maximum(3, 0.1 * area)) & (area >= SPECK)
        good[0] = False
        thick = cv2.distanceTransform(weak, cv2.DIST_L2, 3)
        radius = np.zeros(count)
        np.maximum.at(radius, names, thick[ys, xs])
        for i in np.flatnonzero(good):
            x, y, w, h = stats[i, :4]
            piece = (label[y : y + h, x : x + w] == i).astype(np.uint8)
            outline, _ = cv2.findContours(piece, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
            points = max(outline, key=len).reshape(-1, 2) + (x, y) + low
            compact = area[i] < 2.5 * np.pi * radius[i] ** 2 and radius[i] > 0.22 * size
            if compact:
                objects.append(points.astype(np.float64))
            else:
                polygons.append(points.astype(np.float64))
                contrast.append(strength[i] / 255.0)
                view = mask[low[1] + y : low[1] + y + h, low[0] + x : low[0] + x + w]
                view |= piece > 0
    return Ink(mask, tuple(polygons), tuple(objects), np.array(contrast))
