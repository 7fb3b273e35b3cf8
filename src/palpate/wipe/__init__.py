"""Wiping a whiteboard: see it, hold it, erase it with bounded force, and check. Needs ``palpate[wipe]``.

>>> from palpate import vision, wipe
>>> sight = vision.see(vision.load("photo.jpg"), size=(0.90, 0.60))  # doctest: +SKIP
>>> wipe.plan(sight.ink_polygons, (0.90, 0.60), keep=sight.object_polygons).legs  # doctest: +SKIP

The whole job in simulation:

>>> layer, setting = wipe.random_board(1)
>>> wipe.WipeJob(wipe.BoardScene(layer, setting)).run().verdict  # doctest: +SKIP
'clean'
"""

from __future__ import annotations

try:
    import cv2 as _cv2  # noqa: F401  the rest of the package needs these
    import scipy as _scipy  # noqa: F401
    import shapely as _shapely  # noqa: F401
    import statemachine as _statemachine  # noqa: F401
except ImportError:
    from ..errors import MissingExtraError

    raise MissingExtraError("wipe", "wiping a board") from None

from .boards import random_board
from .choice import COLOURS, Choice, choose, ink_colours
from .film import Film, Video
from .ink import InkLayer, handwriting
from .job import WipeJob
from .options import JobOptions
from .reach import Reach, inverse_kinematics, paced, reachable, tool_inertia, tool_poses
from .record import RunRecorder
from .result import Event, JobResult, Look, Observer, Pass, Tick, Timing, Track
from .scene import BoardScene, Setting
from .strokes import Eraser, Leg, Motion, Phase, Plan, plan, swept
from .summary import report, summary

__all__ = [
    "COLOURS",
    "BoardScene",
    "Choice",
    "Eraser",
    "Event",
    "Film",
    "InkLayer",
    "JobOptions",
    "JobResult",
    "Leg",
    "Look",
    "Motion",
    "Observer",
    "Pass",
    "Phase",
    "Plan",
    "Reach",
    "RunRecorder",
    "Setting",
    "Tick",
    "Timing",
    "Track",
    "Video",
    "WipeJob",
    "choose",
    "handwriting",
    "ink_colours",
    "inverse_kinematics",
    "paced",
    "plan",
    "random_board",
    "reachable",
    "report",
    "summary",
    "swept",
    "tool_inertia",
    "tool_poses",
]
