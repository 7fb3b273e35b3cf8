"""Eyes for the wiping arm: where a whiteboard is in a picture, what is written on it, and both in metres.

>>> from palpate import vision
>>> sight = vision.see(vision.load("photo.jpg"), size=(0.60, 0.45))  # doctest: +SKIP
>>> sight.board.corners, sight.dirty, sight.ink_polygons  # doctest: +SKIP

Needs ``palpate[vision]`` (OpenCV).
"""

from __future__ import annotations

try:
    import cv2 as _cv2  # noqa: F401  the rest of the package needs it
except ImportError:
    from ..errors import MissingExtraError

    raise MissingExtraError("vision", "seeing a whiteboard") from None

from ._image import load, png
from ._ink import Ink
from .board import Board, detect
from .camera import Camera, Plane, aspect, calibrate_charuco, calibrate_poses, charuco, plane
from .compare import Change, compare
from .frames import average
from .published import Region
from .published import detect as detect_published
from .sight import DIRTY, METHODS, Method, Sight, annotated, ink, see

__all__ = [
    "DIRTY",
    "METHODS",
    "Board",
    "Camera",
    "Change",
    "Ink",
    "Method",
    "Plane",
    "Region",
    "Sight",
    "annotated",
    "aspect",
    "average",
    "calibrate_charuco",
    "calibrate_poses",
    "charuco",
    "compare",
    "detect",
    "detect_published",
    "ink",
    "load",
    "plane",
    "png",
    "see",
]
