"""Several pictures of the same view made into one with less noise."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from ..errors import InputError
from ._image import Image, Mask, checked

CELL = 8
"""pictures are compared in squares of so many pixels"""
STILL, GRAIN = 0.06, 3.0
"""part by which a square changes, the light's own change taken away, if something moved, and so much more of 255"""


def average(pictures: Sequence[npt.ArrayLike]) -> tuple[Image, Mask]:
    """The mean (H, W, 3) BGR of pictures from a camera at rest, and a mask (H, W) of what moved between them.

    Light and exposure may change from picture to picture: each is first brought to the light of the brightest, channel
    by channel. N pictures have 1/sqrt(N) of the noise of one. Where something moved, the last picture is given.

    Args:
        pictures: each (H, W, 3) BGR, (H, W) grey or (H, W, 4), uint8, all of one size.

    Raises:
        InputError: no picture, not a picture, pictures of different sizes.
    """
    views = [checked(p) for p in pictures]
    if not views:
        raise InputError("average: at least one picture is needed")
    if any(v.shape != views[0].shape for v in views):
        raise InputError(f"average: pictures must be of one size, got {sorted({v.shape for v in views})}")
    height, width = views[0].shape[:2]
    size = (max(1, width // CELL), max(1, height // CELL))
    small = [cv2.resize(v, size, interpolation=cv2.INTER_AREA).astype(np.float32) + 1.0 for v in views]
    first = max(small, key=lambda s: float(np.median(s)))
    total = np.zeros(views[0].shape, np.float32)
    moved = np.zeros(small[0].shape[:2], bool)
    for view, cells in zip(views, small, strict=True):
        ratio = first / cells
        gain = np.median(ratio, axis=(0, 1))
        # what burnt out in one of them tells nothing
        told = np.maximum(first, cells) < 250.0
        moved |= ((np.abs(first - gain * cells) > STILL * first + GRAIN) & told).any(2)
        now = cv2.multiply(view, (*gain.tolist(), 0.0), dtype=cv2.CV_32F)
        total += now
    total /= len(views)
    where: Mask = cv2.resize(moved.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0
    if where.any():
        total[where] = now[where]
    mean: Image = cv2.convertScaleAbs(total)  # rounds and keeps to 255
    return mean, where
