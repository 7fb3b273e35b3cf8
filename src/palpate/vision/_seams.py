"""Two boards beside each other whose outer edges look like those of one: what lies between them.

Two frames, or a gap, make a band from border to border that differs from the surface on both of its sides. So does a
line that somebody drew from border to border, but it is as narrow as a pen and ends short of the frame. The board is
laid flat; across it, in stretches along the band, every step of brightness that most stretches show may be one of the
band's edges. Two of them with the surface's own level beyond both are a band; what it is, a logistic regression tells.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ..arm import Array
from ._image import Float, Image, Index
from ._quads import homographies, mapped

ACROSS = 320
"""the board is looked at in so many columns across"""
STRETCHES, EACH = 15, 4
"""in so many stretches along the band, of so many rows"""
ENDS = 0.04
"""part of the board left out at either end"""
SHORT = 0.012
"""so far from the border it is looked whether the band gets there"""
LEANS = np.array([-4, -2, 0, 2, 4])
"""columns by which a band may lean from end to end"""
AGREE, MOST = 0.35, 0.8
"""a stretch agrees with a step if it shows this part of it; so many must"""
STEP = 4.0
"""least step [grey levels]"""
SIDE = 0.1
"""what a board is wide at least, of both"""
WIDEST = 0.12
"""band, of both boards"""
FILLED = 0.25
"""a column differs from a side by this part of the band's contrast"""
PEN = -3.7
"""log of the part of a board that no pen is as wide as"""
SOFT, BLURRED = 4, 0.35
"""so many columns beside a frame's edge less than this part of its step is left on one side; not so of a light's"""
LEAST = 0.1
"""of its contrast that a band has at its ends"""
BESIDE = 7
"""columns beside a band that tell the surface's level"""

FEATURES = (
    "width",  # log of the band's part of the board, at most PEN
    "reaches",  # log of its contrast at the end where there is less, relative to the middle; at least LEAST, at most 1
    "net",  # difference between the levels on both sides, relative to the band's contrast
    "filled",  # part of its columns that are neither side's level
)
WEIGHTS = np.array([2.0, 2.0, -1.1, 1.7])
BIAS = 8.4
"""fitted to other views than scripts/fit_seam_weights.py draws, which says how they do beside its own"""


@dataclass(frozen=True, slots=True)
class Seam:
    """What runs across a quadrangle."""

    first: int
    """the band goes from the side from this corner to the next, to the opposite one"""
    begin: float
    """its edges, as parts of those sides"""
    end: float
    features: Array
    """(F,), see FEATURES"""

    @property
    def chance(self) -> float:
        """That it lies between two boards, 0 to 1."""
        return float(1.0 / (1.0 + np.exp(-(self.features @ WEIGHTS + BIAS))))

    def halves(self, corners: Array) -> tuple[Array, Array]:
        """(4, 2) each, the boards on both sides of it."""
        H = homographies(np.roll(corners, -self.first, 0)[None])
        u = np.array([[[0.0, self.begin]], [[self.end, 1.0]]])[..., [0, 1, 1, 0]][:, 0]
        v = np.array([0.0, 0.0, 1.0, 1.0])
        first, second = (np.roll(mapped(H, np.column_stack([x, v]))[0], self.first, 0) for x in u)
        return first, second


def find(grey: Image, corners: Array) -> Seam | None:
    """The likeliest seam in a quadrangle (4, 2) of a grey picture (H, W); None: nothing runs across it."""
    found = [seam for first in (0, 1) for seam in bands(grey, corners, first)]
    return max(found, key=lambda seam: seam.chance, default=None)


def bands(grey: Image, corners: Array, first: int) -> list[Seam]:
    """What runs across a quadrangle from the side `first`, or from the next one."""
    H = homographies(np.roll(corners, -first, 0)[None])[0]
    middle = _rows(grey, H, ENDS, 1.0 - ENDS, STRETCHES * EACH).reshape(STRETCHES, EACH, ACROSS)
    profile = np.sort(middle, 1)[:, 1:3].mean(1)  # strokes that cross it are few of the rows
    step = profile[:, 2:] - profile[:, :-2]
    along = (np.arange(STRETCHES) + 0.5) / STRETCHES - 0.5
    at = np.arange(ACROSS - 2) + np.rint(LEANS[:, None] * along)[..., None].astype(np.int64)
    leaning = step[np.arange(STRETCHES)[:, None], np.clip(at, 0, ACROSS - 3)]
    mean = np.sort(leaning, 1)[:, STRETCHES // 2]  # medians; numpy's own take longer
    agree = (leaning * np.sign(mean)[:, None] > AGREE * np.abs(mean)[:, None]).mean(1)
    lean = (np.abs(mean) * agree).argmax(0)
    mean, agree = (x[lean, np.arange(ACROSS - 2)] for x in (mean, agree))
    edges = np.sort(np.concatenate([_peaks(mean, agree), _peaks(-mean, agree)]))
    level = np.sort(profile, 0)[STRETCHES // 2]
    ends = np.stack([_rows(grey, H, v, v, 1)[0] for v in (SHORT, 1.0 - SHORT)])
    found = []
    for k, x in enumerate(edges):
        for y in edges[k + 1 :]:
            if y - x > WIDEST * ACROSS:
                break
            left, right = level[x - BESIDE : x].mean(), level[y + 3 : y + 3 + BESIDE].mean()
            band = slice(x + 1, y + 2)
            off = _off(level[band], left, right)
            contrast = max(float(off.max()), 1.0)
            reaches = min(
                float(_off(end[band], end[x - BESIDE : x].mean(), end[y + 3 : y + 3 + BESIDE].mean()).max())
                for end in ends
            )
            features = (
                min(np.log((y - x) / ACROSS), PEN),
                np.log(np.clip(reaches / contrast, LEAST, 1.0)),
                min(abs(left - right) / contrast, 2.0),
                float(np.mean(off > FILLED * contrast)),
            )
            found.append(Seam(first, (x + 1) / (ACROSS - 1), (y + 1) / (ACROSS - 1), np.array(features)))
    return found


def _rows(grey: Image, H: Array, begin: float, end: float, count: int) -> Float:
    """(count, ACROSS) of the unit square of H, from v = begin to end."""
    pitch = (end - begin) / max(count - 1, 1)
    place = np.array([[1.0 / (ACROSS - 1), 0.0, 0.0], [0.0, pitch, begin], [0.0, 0.0, 1.0]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    rows = cv2.warpPerspective(grey, H @ place, (ACROSS, count), flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return rows.astype(np.float32)


def _peaks(step: Float, agree: Float) -> Index:
    """Columns where a positive step is the largest nearby, and sharply so on one side at least."""
    low, high = int(SIDE * ACROSS), int((1.0 - SIDE) * ACROSS)
    near = np.lib.stride_tricks.sliding_window_view(np.pad(step, SOFT, mode="edge"), 2 * SOFT + 1)
    aside = np.minimum(np.abs(near[:, 0]), np.abs(near[:, -1]))
    peak = (step >= near[:, SOFT - 2 : SOFT + 3].max(1)) & (step > STEP)
    return low + np.flatnonzero((peak & (agree >= MOST) & (aside < BLURRED * step))[low:high])


def _off(band: Float, left: float, right: float) -> Float:
    """How far what lies between two levels is from the nearer of them."""
    return np.minimum(np.abs(band - left), np.abs(band - right))
