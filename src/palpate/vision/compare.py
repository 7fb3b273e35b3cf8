"""A board before and after: what is gone, what is left, what is new, and what cannot be told.

Both pictures are laid flat by their corners, so that camera and board may have moved between them. Ink is found in each
by itself, against its own light. Where something covers the board in either picture (an arm, given as a mask or seen as
a place whose colour changed more than light changes it), nothing is said.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from ..arm import Array
from ..errors import InputError
from . import _ink
from ._image import Image, Mask, checked

LONG = 800
"""longer side of a flat board [pixels]"""
NEAR = 5
"""two places of ink are the same within so many flat pixels"""
TINT = 0.16
"""change of the colour, one channel against the others, that no light makes"""
DARKER, LIGHTER = 0.45, 2.2
"""change of brightness against the whole board that is taken for something in front of it"""


@dataclass(frozen=True, slots=True)
class Change:
    """Two pictures of a board compared, in flat pixels: (h, w) for the board's width and height."""

    gone: Mask
    """ink before, none after"""
    left: Mask
    """ink before and after"""
    new: Mask
    """no ink before, ink after"""
    hidden: Mask
    """covered in one of the pictures"""

    @property
    def erased(self) -> float:
        """Part of the ink that is gone, of what can be told; NaN if there was none."""
        gone, left = int(self.gone.sum()), int(self.left.sum())
        return gone / (gone + left) if gone + left else float("nan")


def compare(
    before: npt.ArrayLike,
    after: npt.ArrayLike,
    corners_before: npt.ArrayLike,
    corners_after: npt.ArrayLike,
    *,
    size: tuple[float, float] | None = None,
    ignore: npt.ArrayLike | None = None,
) -> Change:
    """Compare.

    Args:
        before, after: pictures.
        corners_before, corners_after: (4, 2) of the writing surface in each, in the same order.
        size: width and height of the writing surface, any unit; None: as long as its sides are seen before.
        ignore: mask (H, W) of the picture after: not the board (the arm); None: found from the picture.

    Raises:
        InputError: something has the wrong shape.
    """
    a, b = checked(before, "before"), checked(after, "after")
    p, q = np.asarray(corners_before, np.float64), np.asarray(corners_after, np.float64)
    if p.shape != (4, 2) or q.shape != (4, 2):
        raise InputError(f"corners must be (4, 2), got {p.shape} and {q.shape}")
    if size is None:
        sides = np.linalg.norm(p - np.roll(p, -1, 0), axis=1)
        size = (float(sides[0] + sides[2]), float(sides[1] + sides[3]))
    scale = LONG / max(size)
    shape = (max(16, round(size[0] * scale)), max(16, round(size[1] * scale)))
    flat_a, flat_b = flat(a, p, shape), flat(b, q, shape)
    hidden = _covered(flat_a, flat_b)
    if ignore is not None:
        mask = np.asarray(ignore).astype(np.uint8)
        if mask.shape != b.shape[:2]:
            raise InputError(f"ignore must be a mask of the picture after, {b.shape[:2]}, got {mask.shape}")
        hidden |= flat(mask * np.uint8(255), q, shape) > 0
    near = np.ones((2 * NEAR + 1, 2 * NEAR + 1), np.uint8)
    hidden = cv2.dilate(hidden.astype(np.uint8), near) > 0
    whole = np.array([[0, 0], [shape[0], 0], [shape[0], shape[1]], [0, shape[1]]]) - 0.5
    first, second = (_ink.find(x, whole).mask & ~hidden for x in (flat_a, flat_b))
    wide_first, wide_second = (cv2.dilate(m.astype(np.uint8), near) > 0 for m in (first, second))
    return Change(first & ~wide_second, first & wide_second, second & ~wide_first, hidden)


def flat(image: Image, corners: Array, shape: tuple[int, int]) -> Image:
    """The writing surface laid flat: (h, w) or (h, w, 3) for `shape` (w, h)."""
    target = np.array([[0, 0], [shape[0], 0], [shape[0], shape[1]], [0, shape[1]]], np.float32) - np.float32(
        0.5
    )
    H = cv2.getPerspectiveTransform(corners.astype(np.float32), target)
    return cv2.warpPerspective(image, H, shape, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def _covered(a: Image, b: Image) -> Mask:
    """Where the board's surface, ink taken away, changed as no light changes it."""
    size = 2 * round(0.5 * _ink.STROKE * min(a.shape[:2])) + 1
    kernel = np.ones((size, size), np.uint8)
    surface = [
        cv2.blur(cv2.morphologyEx(x, cv2.MORPH_CLOSE, kernel), (7, 7)).astype(np.float32) + 2.0
        for x in (a, b)
    ]
    ratio = surface[1] / surface[0]
    bright = ratio.mean(2)
    usual = float(np.median(bright))
    tint = np.abs(ratio / bright[..., None] / np.median(ratio / bright[..., None], axis=(0, 1)) - 1.0).max(2)
    mask = (tint > TINT) | (bright < DARKER * usual) | (bright > LIGHTER * usual)
    return cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, np.ones((9, 9), np.uint8)) > 0
