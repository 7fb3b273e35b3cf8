"""The published whiteboard detector, step by step: a region of one hue grows, its outline is the board, its holes dirt.

Source: the whiteboard-erasing project of the ARCS course, KU Leuven, "Perception" (github.com/denizsoysal/ARCS). It
assumes that the board is the biggest evenly coloured rectangle in the picture. Thresholds that the report does not give
are arguments here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from ..arm import Array
from ._image import Image, Mask, checked

Channel: TypeAlias = Literal["hue", "saturation", "value"]
CHANNELS: tuple[Channel, ...] = ("hue", "saturation", "value")
SEEDS = (0.25, 0.5, 0.75)
"""along the middle line, relative to the width"""
EPSILONS = tuple(0.005 * k for k in range(1, 21))
"""how far the polygon may be from the outline, relative to the outline's length"""


@dataclass(frozen=True, slots=True)
class Region:
    """What grew from one seed."""

    seed: tuple[int, int]
    """column and row [pixels]"""
    mask: Mask
    """(H, W) the region"""
    corners: Array | None
    """(4, 2) polygon of the largest outline [pixels], clockwise as seen; None: no check was passed"""
    epsilon: float
    """that made it four-cornered, relative to the outline's length; infinite if none does"""
    holes: tuple[Array, ...]
    """internal contours (M, 2) [pixels]: the dirt"""


def detect(
    image: npt.ArrayLike,
    *,
    channel: Channel = "hue",
    tolerance: int = 2,
    aspect: tuple[float, float] = (1.0, 2.2),
    angle: float = 25.0,
    area: float = 0.05,
) -> Region | None:
    """The published detector; None where no seed passes the checks.

    Args:
        image: (H, W, 3) BGR, (H, W) grey or (H, W, 4), uint8.
        channel: on which the region grows; published: hue.
        tolerance: a neighbour joins if it differs by less from the pixel it joins [levels; a turn of hue is 180].
        aspect: bounds of the longer side over the shorter one.
        angle: how far a corner may be from 90 degrees [degrees].
        area: least area, relative to the picture.
    """
    found = [r for r in regions(image, channel=channel, tolerance=tolerance) if r.corners is not None]
    size = np.asarray(image).shape[0] * np.asarray(image).shape[1]
    good = [
        r
        for r in found
        if r.corners is not None
        and rectangular(r.corners, aspect, angle)
        and cv2.contourArea(r.corners.astype(np.float32)) >= area * size
    ]
    return min(good, key=lambda r: r.epsilon, default=None)


def regions(image: npt.ArrayLike, *, channel: Channel = "hue", tolerance: int = 2) -> list[Region]:
    """What grows from the three seeds on the middle line."""
    picture = checked(image)
    plane = np.ascontiguousarray(cv2.cvtColor(picture, cv2.COLOR_BGR2HSV)[..., CHANNELS.index(channel)])
    height, width = plane.shape
    return [_grown(plane, (int(s * width), height // 2), tolerance) for s in SEEDS]


def rectangular(corners: Array, aspect: tuple[float, float], angle: float) -> bool:
    """The published checks: ratio of the sides, angles near 90 degrees."""
    sides = np.roll(corners, -1, 0) - corners
    length = np.linalg.norm(sides, axis=1)
    pairs = sorted((length[0] + length[2], length[1] + length[3]))
    cosine = np.einsum("ij,ij->i", sides, np.roll(sides, -1, 0)) / (length * np.roll(length, -1))
    return bool(
        aspect[0] <= pairs[1] / pairs[0] <= aspect[1] and np.all(np.abs(cosine) <= np.sin(np.radians(angle)))
    )


def _grown(plane: Image, seed: tuple[int, int], tolerance: int) -> Region:
    height, width = plane.shape
    filled = np.zeros((height + 2, width + 2), np.uint8)
    step = max(tolerance - 1, 0)  # "less than", on whole numbers
    cv2.floodFill(plane, filled, seed, 0, step, step, 4 | cv2.FLOODFILL_MASK_ONLY | (255 << 8))
    mask = np.ascontiguousarray(filled[1:-1, 1:-1])
    outlines, tree = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
    outer = [i for i in range(len(outlines)) if tree[0][i][3] < 0]
    largest = max(outer, key=lambda i: cv2.contourArea(outlines[i]))
    holes = tuple(
        outlines[i].reshape(-1, 2).astype(np.float64)
        for i in range(len(outlines))
        if tree[0][i][3] == largest
    )
    length = cv2.arcLength(outlines[largest], True)
    for epsilon in EPSILONS:
        polygon = (
            cv2.approxPolyDP(outlines[largest], epsilon * length, True).reshape(-1, 2).astype(np.float64)
        )
        if len(polygon) < 4:
            break
        if len(polygon) == 4 and cv2.isContourConvex(polygon.astype(np.float32)):
            if cv2.contourArea(polygon.astype(np.float32), oriented=True) < 0:
                polygon = polygon[::-1]
            return Region(seed, mask > 0, polygon, epsilon, holes)
    return Region(seed, mask > 0, None, float("inf"), holes)
