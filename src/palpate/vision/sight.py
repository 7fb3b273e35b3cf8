"""What a picture shows: the board, its ink, clean or dirty, in pixels and in board coordinates."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from ..arm import Array
from ..errors import InputError, suggest
from . import _ink, board, published
from ._image import Image, checked, rescaled, shrunk
from ._ink import Ink
from .board import Board
from .camera import Camera, Plane, plane

Method: TypeAlias = Literal["lines", "published", "saturation", "value"]
METHODS: tuple[Method, ...] = ("lines", "published", "saturation", "value")
"""palpate's own; the published growing by hue; the same by saturation and by value"""

DIRTY = 5e-4
"""part of the surface under ink from which a board is dirty: 5 cm of a 3 mm stroke on 60 cm x 45 cm"""
DIVIDED = 0.1
"""chance of two boards instead of one from which it is told"""


@dataclass(frozen=True, slots=True)
class Sight:
    """What was seen in a picture."""

    boards: tuple[Board, ...]
    """best first; empty: no board"""
    ink: Ink | None
    """on the best board, [pixels]; None: no board"""
    plane: Plane | None
    """board coordinates of the best board; None: no board"""
    picture: tuple[int, int]
    """width and height [pixels]"""

    @property
    def board(self) -> Board | None:
        """The best board."""
        return self.boards[0] if self.boards else None

    @property
    def covered(self) -> float:
        """Part of the writing surface under ink; NaN without a board."""
        if self.ink is None or not self.boards:
            return float("nan")
        return float(self.ink.mask.sum()) / max(
            float(cv2.contourArea(self.boards[0].corners.astype(np.float32))), 1.0
        )

    @property
    def dirty(self) -> bool | None:
        """There is ink to be wiped; None without a board."""
        return None if self.ink is None else self.covered > DIRTY

    @property
    def ink_polygons(self) -> tuple[Array, ...]:
        """Outlines of the ink in board coordinates, each (M, 2), in the unit of the plane's size."""
        if self.ink is None or self.plane is None:
            return ()
        return tuple(self.plane.to_board(p) for p in self.ink.polygons)

    @property
    def object_polygons(self) -> tuple[Array, ...]:
        """Outlines of other things on the board, as ``ink_polygons``."""
        if self.ink is None or self.plane is None:
            return ()
        return tuple(self.plane.to_board(p) for p in self.ink.objects)

    def remarks(self) -> list[str]:
        """What a person should know, one sentence each."""
        said = []
        if len(self.boards) > 1:
            said.append(f"{len(self.boards)} boards are in view; the first one is the best supported")
        if self.board is not None and self.board.divided > DIVIDED:
            said.append(
                f"a band runs across the board from border to border: two boards by a chance of "
                f"{100.0 * self.board.divided:.0f} %"
            )
        if self.board is not None and not self.board.complete:
            said.append("the board is partly out of view: where the picture ends is not the board's edge")
        if self.board is not None and self.plane is not None and self.plane.camera is None:
            said.append("the camera is not calibrated: lens distortion stays, the board's place is not known")
        if self.board is not None and self.plane is not None and not self.plane.metric:
            said.append("the board's size is not given: lengths are in units of its height")
        return said

    def plain(self) -> dict[str, Any]:
        """Everything but the mask, for JSON."""

        def rounded(points: Array, digits: int) -> list[Any]:
            return np.round(points, digits).tolist()

        result: dict[str, Any] = {
            "found": bool(self.boards),
            "width": self.picture[0],
            "height": self.picture[1],
            "boards": [
                {
                    "corners_px": rounded(b.corners, 2),
                    "corners_sigma_px": None if np.isnan(b.sigma).any() else rounded(b.sigma, 2),
                    "confidence": round(b.confidence, 4),
                    "divided": round(b.divided, 4),
                    "complete": b.complete,
                    "side_in_view": b.in_view.tolist(),
                }
                for b in self.boards
            ],
            "remarks": self.remarks(),
        }
        if self.ink is not None and self.plane is not None:
            T, base = self.plane.T_camera_board, self.plane.T_base_board
            result |= {
                "dirty": self.dirty,
                "ink_fraction": round(self.covered, 6),
                "size": [round(s, 5) for s in self.plane.size],
                "unit": "m" if self.plane.metric else "board heights",
                "T_camera_board": None if T is None else rounded(T, 6),
                "T_base_board": None if base is None else rounded(base, 6),
                "ink": [
                    {"board": rounded(q, 5), "px": rounded(p, 1), "contrast": round(float(c), 3)}
                    for p, q, c in zip(self.ink.polygons, self.ink_polygons, self.ink.contrast, strict=True)
                ],
                "objects": [
                    {"board": rounded(q, 5), "px": rounded(p, 1)}
                    for p, q in zip(self.ink.objects, self.object_polygons, strict=True)
                ],
            }
        return result


def see(
    image: npt.ArrayLike,
    *,
    method: Method = "lines",
    size: tuple[float, float] | None = None,
    camera: Camera | None = None,
    most: int = 3,
) -> Sight:
    """Find the board in a picture and the ink on it.

    Args:
        image: (H, W, 3) BGR, (H, W) grey or (H, W, 4), uint8.
        method: one of METHODS.
        size: width and height of the writing surface [m]; None: only its shape is estimated.
        camera: its calibration; None: not calibrated.
        most: at most so many boards.

    Raises:
        InputError: not a picture, no such method, a size that is not positive, a camera for other pictures.
    """
    if method not in METHODS:
        raise InputError(f"no method {method!r} to find a board; {suggest(method, METHODS, 'there are')}")
    picture = checked(image)
    extent = (picture.shape[1], picture.shape[0])
    if camera is not None:
        camera = camera.for_picture(*extent)
    if method == "lines":
        boards = board.detect(picture, most=most)
        if not boards:
            return Sight((), None, None, extent)
        return Sight(boards, ink(picture, boards[0].corners), _plane(boards[0], extent, size, camera), extent)
    # the published method works on the pixels as they are; a small copy is what it had
    small, scale = shrunk(picture, 640)
    channel: published.Channel = "hue" if method == "published" else method
    region = published.detect(small, channel=channel, tolerance=2 if channel == "hue" else 3)
    if region is None or region.corners is None:
        return Sight((), None, None, extent)
    turn = int(np.argmin(region.corners.sum(1)))
    corners = rescaled(np.roll(region.corners, -turn, 0), 1.0 / scale)
    found = Board(
        corners,
        1.0 - region.epsilon / published.EPSILONS[-1],
        np.ones(4, bool),
        np.zeros(4),
        np.full(4, np.nan),
    )
    holes = tuple(rescaled(h, 1.0 / scale) for h in region.holes)
    mask = np.zeros(picture.shape[:2], np.uint8)
    for hole in holes:
        cv2.fillPoly(mask, [np.rint(hole).astype(np.int32)], 1)
    dirt = Ink(mask > 0, holes, (), np.ones(len(holes)))
    return Sight((found,), dirt, _plane(found, extent, size, camera), extent)


def _plane(
    found: Board, extent: tuple[int, int], size: tuple[float, float] | None, camera: Camera | None
) -> Plane:
    return plane(found.corners, extent, size=size, camera=camera)


def ink(
    image: npt.ArrayLike,
    corners: npt.ArrayLike,
    *,
    faint: float = _ink.FAINT,
    clear: float = _ink.CLEAR,
    least: int | None = None,
) -> Ink:
    """Ink on a writing surface.

    Args:
        image: (H, W, 3) BGR, (H, W) grey or (H, W, 4), uint8.
        corners: (4, 2) of the surface [pixels], clockwise as seen.
        faint: part of the light, 0 to 1, that the weakest of a piece of ink takes away at least; less finds fainter
            rests, and marks of the surface too.
        clear: part that its core takes away at least.
        least: pixels of a piece, at 1280 pixels of the picture's longer side at most; None: 9, and more the fainter it
            is, because dust and grain are specks.

    Raises:
        InputError: not a picture; corners of another shape; not 0 < faint <= clear < 1; least below 1.
    """
    picture = checked(image)
    q = np.asarray(corners, np.float64)
    if q.shape != (4, 2) or not np.all(np.isfinite(q)):
        raise InputError(f"corners must be (4, 2) and finite, got {q.shape}")
    if not 0.0 < faint <= clear < 1.0:
        raise InputError(f"ink: expected 0 < faint <= clear < 1, got {faint!r} and {clear!r}")
    if least is not None and least < 1:
        raise InputError(f"ink: least must be at least 1 pixel, got {least!r}")
    fine, scale = shrunk(picture, board.FINE)
    found = _ink.find(fine, rescaled(q, scale), faint=faint, clear=clear, least=least)
    if scale == 1.0:
        return found
    mask = cv2.resize(
        found.mask.astype(np.uint8), (picture.shape[1], picture.shape[0]), interpolation=cv2.INTER_NEAREST
    )
    return replace(
        found,
        mask=mask > 0,
        polygons=tuple(rescaled(p, 1.0 / scale) for p in found.polygons),
        objects=tuple(rescaled(p, 1.0 / scale) for p in found.objects),
    )


def annotated(image: npt.ArrayLike, sight: Sight) -> Image:
    """The picture (H, W, 3) BGR with the boards' outlines, the ink and other things drawn in."""
    out = checked(image).copy()
    pen = max(1, round(max(out.shape[:2]) / 500))
    if sight.ink is not None:
        out[sight.ink.mask] = (0.35 * out[sight.ink.mask] + 0.65 * np.array([40, 40, 255])).astype(np.uint8)
        for thing in sight.ink.objects:
            cv2.polylines(out, [np.rint(thing).astype(np.int32)], True, (200, 60, 200), pen, cv2.LINE_AA)
    for k, found in enumerate(sight.boards):
        corners = np.rint(found.corners).astype(np.int32)
        for i in range(4):
            a, b = corners[i].tolist(), corners[(i + 1) % 4].tolist()
            colour = (70, 200, 40) if found.in_view[i] else (0, 160, 255)
            cv2.line(out, a, b, colour, 2 * pen if k == 0 else pen, cv2.LINE_AA)
        cv2.circle(out, corners[0].tolist(), 4 * pen, (255, 120, 30), -1, cv2.LINE_AA)
        verdict = "" if k else {True: ", dirty", False: ", clean", None: ""}[sight.dirty]
        text = f"{k + 1}: {100.0 * found.confidence:.0f} %{verdict}"
        place = (int(corners[0][0] + 8 * pen), int(corners[0][1] + 16 * pen))
        for colour, width in (((255, 255, 255), 3 * pen), ((30, 30, 30), pen)):
            cv2.putText(out, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.45 * pen, colour, width, cv2.LINE_AA)
    return out
