"""Where a whiteboard is in a picture: the four corners of its writing surface, and how sure.

A board is four straight edges, each supported by the picture along most of its length, that meet at corners and do not
run on, around a surface that is even and light and has other brightness than what lies beyond. Candidates come from
the straight lines of a small copy of the picture; they are judged by that evidence, and the borders of the best ones'
surfaces are looked for at full resolution. Where a band runs across one from border to border it may be two boards.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from ..arm import Array
from . import _edges, _lines, _quads, _seams
from ._image import Image, Mask, checked, rescaled, shrunk

ROUGH = 512
"""longer side of the copy in which boards are looked for [pixels]"""
FINE = 1280
"""longer side of the copy in which edges are fitted [pixels]"""
LINES = 40
"""straight lines looked at"""
BLIND = 6.0
"""a side along which the picture is burnt this far across is not seen [pixels]"""
UNSEEN = 2.0
"""what each of them takes from the log odds"""
APART, WITHIN = 0.1, 0.7
"""boards overlap by less than the first; what overlaps boards found by more than the second is one of them"""
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
    divided: float = 0.0
    """0 to 1: how likely it is that it is two boards beside each other; at most 0.5, else both are reported"""

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
    taken, divided = np.zeros(grey.shape, np.uint8), False
    u = np.linspace(0.1, 0.9, 6)
    points = _quads.mapped(_quads.homographies(quads.corners), np.stack(np.meshgrid(u, u), -1).reshape(-1, 2))
    for i in range(len(quads.score)):
        if _confidence(quads.score[i]) < SURE or len(boards) >= most:
            break
        part = float(_quads.picked(taken, points[i]).mean())
        if part > WITHIN or (part > APART and divided):
            continue
        found = _whole(sharp, rescaled(quads.corners[i], 1.0 / scale), quads.border[i], quads.score[i])
        if part > APART:  # one that was found and what is beside it: a second board if there is a seam
            divided = True
            found = [b for b in found if len(found) > 1 and not _over(b, boards)]
        for board in found:
            cv2.fillConvexPoly(
                taken, np.rint(rescaled(board.corners, scale) * 16.0).astype(np.int32), 1, shift=4
            )
        boards += found
    boards.sort(key=lambda b: -b.confidence)
    return tuple(_in_picture(b, fine_scale) for b in boards if b.confidence >= SURE)[:most]


def _whole(grey: Image, rough: Array, border: Mask, odds: float, sure: float = 1.0) -> list[Board]:
    """The board at a rough quadrangle, or the boards that it is divided into, with the log odds that it is one."""
    edges = _edges.fit(grey, rough, border)
    seam = None if border.any() else _seams.find(grey, edges.corners)
    chance = 0.0 if seam is None else seam.chance
    if seam is not None and chance > 0.5:
        halves = seam.halves(edges.corners)
        return [board for half in halves for board in _whole(grey, half, border, odds, sure * chance)]
    confidence = _confidence(odds - UNSEEN * np.count_nonzero(edges.blind > BLIND))
    return [
        Board(edges.corners, confidence * sure * (1.0 - chance), ~border, edges.spread, edges.sigma, chance)
    ]


def _confidence(odds: float) -> float:
    return float(1.0 / (1.0 + np.exp(-odds)))


def _in_picture(board: Board, scale: float) -> Board:
    """A board found in a copy `scale` times as large, its corners from the top left."""
    turn = int(np.argmin(board.corners.sum(1)))
    return replace(
        board,
        corners=rescaled(np.roll(board.corners, -turn, 0), 1.0 / scale),
        in_view=np.roll(board.in_view, -turn),
        spread=np.roll(board.spread, -turn) / scale,
        sigma=np.roll(board.sigma, -turn) / scale,
    )


def _over(board: Board, others: list[Board]) -> bool:
    """Its middle lies in one of the others."""
    x, y = board.corners.mean(0)
    return any(cv2.pointPolygonTest(o.corners.astype(np.float32), (x, y), False) >= 0 for o in others)
