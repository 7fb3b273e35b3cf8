"""Straight lines of a picture: line segments, joined where they lie on one line, and how well a stretch of a line is
supported by edges.

Segments: R. Grompone von Gioi et al., "LSD: a line segment detector", IPOL 2012, as OpenCV has it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ..arm import Array
from ._image import Float, Image

QUANTUM = 1.2
"""error of a grey level that the segment detector reckons with; its own default, 2, is for pictures not shrunk"""
SEGMENT = 7.0
"""shortest segment used [pixels]"""
SEEDS = 100
"""longest segments that may start a line"""
REACH = 1.5
"""how far from a line the ends of its segments may lie [pixels]"""
ANGLE = 0.07
"""how far from a line's direction its segments may point [rad]"""


@dataclass(frozen=True, slots=True)
class Lines:
    """Infinite lines n·x = c in pixel coordinates."""

    normal: Array
    """(N, 2) unit normals"""
    offset: Array
    """(N,) [pixels]"""
    support: Array
    """(N,) length of the segments on it [pixels]"""


def find(grey: Image, count: int) -> Lines:
    """The `count` best supported lines of a grey picture."""
    found = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD, 0.8, 0.6, QUANTUM).detect(grey)[0]
    if found is None:
        return Lines(np.zeros((0, 2)), np.zeros(0), np.zeros(0))
    ends = found.reshape(-1, 2, 2).astype(np.float64)
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    order = np.argsort(-length)
    order = order[length[order] >= SEGMENT]
    ends, length = ends[order], length[order]
    if not len(ends):
        return Lines(np.zeros((0, 2)), np.zeros(0), np.zeros(0))
    direction = (ends[:, 1] - ends[:, 0]) / length[:, None]
    middle = ends.mean(1)
    # second moments of a segment about its middle: length^3/12 along it
    spread = length**3 / 12.0
    seeds = min(SEEDS, len(ends))
    # of a segment, per its length: about the origin
    squares = middle[:, [0, 1, 0]] * middle[:, [0, 1, 1]] + (spread / length)[:, None] * (
        direction[:, [0, 1, 0]] * direction[:, [0, 1, 1]]
    )
    normal = np.stack([-direction[:seeds, 1], direction[:seeds, 0]], 1)
    offset = np.einsum("ij,ij->i", normal, middle[:seeds])
    for reach in (REACH, REACH):
        away = np.maximum(
            np.abs(normal @ ends[:, 0].T - offset[:, None]), np.abs(normal @ ends[:, 1].T - offset[:, None])
        )
        cross = np.abs(normal @ direction.T)
        member = (away < reach) & (cross < np.maximum(ANGLE, 1.5 / length)[None])
        member[np.arange(seeds), np.arange(seeds)] = True
        weight = np.where(member, length, 0.0)
        total = weight.sum(1)
        mean = weight @ middle / total[:, None]
        xx, yy, xy = (weight @ squares - total[:, None] * mean[:, [0, 1, 0]] * mean[:, [0, 1, 1]]).T
        angle = 0.5 * np.arctan2(2.0 * xy, xx - yy)  # of the axis of largest spread
        normal = np.stack([-np.sin(angle), np.cos(angle)], 1)
        offset = np.einsum("ij,ij->i", normal, mean)
    return _distinct(Lines(normal, offset, total), member, ends, count)


def _distinct(lines: Lines, member: Array, ends: Array, count: int) -> Lines:
    """The best supported ones, without repetitions."""
    order = np.argsort(-lines.support, kind="stable")
    kept: list[int] = []
    # each line's support as its two extreme points
    along = np.stack([-lines.normal[:, 1], lines.normal[:, 0]], 1)
    t = along @ ends[:, 0].T, along @ ends[:, 1].T
    low = np.where(member, np.minimum(*t), np.inf).min(1)
    high = np.where(member, np.maximum(*t), -np.inf).max(1)
    foot = lines.normal * lines.offset[:, None]
    points = np.stack([foot + along * low[:, None], foot + along * high[:, None]], 1)
    distance = np.maximum(
        np.abs(lines.normal @ points[:, 0].T - lines.offset[:, None]),
        np.abs(lines.normal @ points[:, 1].T - lines.offset[:, None]),
    )
    for i in order:
        if len(kept) == count:
            break
        if not kept or distance[kept, i].min() > 1.2:
            kept.append(int(i))
    return Lines(lines.normal[kept], lines.offset[kept], lines.support[kept])


@dataclass(frozen=True, slots=True)
class Gradient:
    """Grey levels over two pixels, by the Sobel operator."""

    x: Float
    y: Float
    noise: float
    """an edge must exceed this [grey levels]"""


def gradient(grey: Image) -> Gradient:
    """Of a grey picture; the threshold is three standard deviations of the noise, within bounds."""
    x = cv2.Sobel(grey, cv2.CV_32F, 1, 0, scale=0.25)
    y = cv2.Sobel(grey, cv2.CV_32F, 0, 1, scale=0.25)
    sigma = float(np.median(np.abs(x[::4, ::4]))) / 0.6745
    return Gradient(x, y, float(np.clip(3.0 * sigma, 4.0, 9.0)))
