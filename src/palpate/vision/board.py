"""Where a whiteboard is in a picture: the four corners of its writing surface, and how sure.

A board is four straight edges, each supported by the picture along most of its length, that meet at corners and do not
run on, around a surface that is even and light and has other brightness than what lies beyond. Candidates come from
the straight lines of a small copy of the picture; they are judged by that evidence, and the borders of the best ones'
surfaces are looked for at full resolution.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from ..arm import Array
from . import _edges, _lines, _quads
from ._image import Mask, checked, rescaled, shrunk

ROUGH = 512
"""longer side of the copy in which boards are looked for [pixels]"""
FINE = 1280
"""longer side of the copy in which edges are fitted [pixels]"""
LINES = 40
"""straight lines looked at"""
SURE = 0.3
"""least confidence of a board that is reported"""


@dataclass(frozen=True, slots=True)
class Board:
    """A writing surface in a picture."""

    corners: Array
    """(4, 2) [pixels], clockwise as seen, from the one nearest to the top left; whole numbers are pixel centres"""
    confidence: float
    """0 to 1: how likely it is a board found rightly"""
    in_view: Mask
    """(4,): the side from corner i to the next is the board's own edge; False: it is where the picture ends"""
    spread: Array
    """(4,) deviation of the edge from a straight line, per side [pixels]"""
    sigma: Array
    """(4,) standard deviation of the corners: root of the mean square distance to where they are [pixels]; if it is a
    board, which is what ``confidence`` is about; NaN: not known"""

    @property
    def complete(self) -> bool:
        """The whole board is in view."""
        return bool(self.in_view.all())


def detect(image: npt.ArrayLike, *, most: int = 3) -> tuple[Board, ...]:
    """Boards in a picture, best first; none where there is none.

    Args:
        image: (H, W, 3) BGR, (H, W) grey or (H, W, 4), uint8.
        most: at most so many.

    Raises:
        InputError: not a picture.
    """
    picture = checked(image)
    fine, fine_scale = shrunk(picture, FINE)
    rough, scale = shrunk(fine, ROUGH)
    grey = cv2.cvtColor(rough, cv2.COLOR_BGR2GRAY)
    quads = _quads.find(_lines.find(grey, LINES), _lines.gradient(grey), rough, grey)
    sharp = cv2.cvtColor(fine, cv2.COLOR_BGR2GRAY)
    boards: list[Board] = []
    taken = np.zeros(grey.shape, bool)
    for i in range(len(quads.score)):
        confidence = float(1.0 / (1.0 + np.exp(-quads.score[i])))
        if confidence < SURE or len(boards) == most:
            break
        x, y = np.clip(quads.corners[i].mean(0).astype(int), 0, np.array(grey.shape[::-1]) - 1)
        if taken[y, x]:  # quicker than what follows
            continue
        inside = _filled(quads.corners[i], grey.shape)
        if taken[inside].mean() > 0.1:
            continue
        edges = _edges.fit(sharp, rescaled(quads.corners[i], 1.0 / scale), quads.border[i])
        taken |= inside
        turn = int(np.argmin(edges.corners.sum(1)))
        boards.append(
            Board(
                rescaled(np.roll(edges.corners, -turn, 0), 1.0 / fine_scale),
                confidence,
                ~np.roll(quads.border[i], -turn),
                np.roll(edges.spread, -turn) / fine_scale,
                np.roll(edges.sigma, -turn) / fine_scale,
            )
        )
    return tuple(boards)


def _filled(corners: Array, shape: tuple[int, ...]) -> Mask:
    """The inside of a quadrangle as a mask."""
    mask = np.zeros(shape, np.uint8)
    cv2.fillConvexPoly(mask, np.rint(corners * 16.0).astype(np.int32), 1, shift=4)
    return mask > 0
