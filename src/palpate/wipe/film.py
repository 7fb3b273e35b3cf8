"""A job as pictures for people: the cell, what the camera sees, the force, the way on the board."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from itertools import pairwise
from os import PathLike
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from ..errors import InputError
from .job import WipeJob
from .result import Event, Look, Observer, Tick

Picture = npt.NDArray[np.uint8]

WIDTH, HEIGHT = 1280, 720
RATE = 10.0
"""pictures per simulated second"""
CAMERA = (400, 225)
"""width and height of the camera's picture [pixel]"""
WINDOW = 12.0
"""the force is shown over so long [s]"""
_PAPER, _INK, _MUTED, _GRID = (250, 250, 250), (40, 36, 32), (130, 124, 118), (225, 222, 218)
_BLUE, _GREY, _RED, _GREEN = (178, 114, 0), (150, 150, 150), (60, 60, 200), (90, 150, 40)
"""BGR"""
_WORDS = {
    "parking": "the eraser goes out of the camera's view",
    "looking": "looking at the board",
    "holding": "the other arm takes the board",
    "planning": "planning strokes",
    "moving": "the eraser goes to the board",
    "wiping": "wiping",
    "safe": "something is wrong: standing still",
    "releasing": "the other arm lets the board go",
    "ended": "done",
}
"""a task in words"""


def told(tick: Tick, job: WipeJob) -> str:
    """What happens now, in words."""
    text = _WORDS.get(tick.task, tick.task)
    if tick.task == "wiping":
        text += f", pass {tick.number}" + (f", {tick.phase}" if tick.phase else "")
        _, left = job.progress
        if math.isfinite(left):
            text += f", about {left:.0f} s left"
    return text + (", giving way to a push" if tick.yielding else "")


class Film(Observer):
    """Draws the job as it runs.

    Args:
        job: what is shown.
        show: gets each picture (720, 1280, 3) BGR.
        rate: pictures per simulated second.

    Raises:
        InputError: the rate is not above 0, or above that of the job's cycles.
    """

    def __init__(self, job: WipeJob, show: Callable[[Picture], None], rate: float = RATE) -> None:
        if not 0.0 < rate <= 250.0:
            raise InputError(f"film: rate must be above 0 and at most 250 Hz, got {rate!r}")
        self._job, self._show = job, show
        self._every = round(1e9 / rate)
        self._next = 0
        self._force: deque[tuple[float, float, float, float]] = deque(maxlen=round(WINDOW * 250.0))
        self._path: list[tuple[float, float]] = []
        self._camera: Picture | None = None
        self._last = ""

    def look(self, look: Look) -> None:
        """Keep the picture with what was seen in it."""
        self._camera = shown(look, CAMERA)

    def event(self, event: Event) -> None:
        """Keep the line."""
        if event.kind != "activity":
            self._last = f"{event.time_ns * 1e-9:.1f} s  {event.text}"

    def tick(self, tick: Tick) -> None:
        """Draw, if it is time."""
        wanted = tick.wanted_force or math.nan
        felt = tick.normal_force if wanted == wanted else math.nan  # in the air it means nothing
        self._force.append((tick.time_ns * 1e-9, wanted, felt, tick.true_normal))
        if tick.phase == "slide" and tick.time_ns % 40_000_000 == 0:
            at = np.linalg.inv(tick.T_world_board) @ tick.T_world_tool[:, 3]
            self._path.append((float(at[0]), float(at[1])))
        if tick.time_ns < self._next:
            return
        self._next = tick.time_ns - tick.time_ns % self._every + self._every
        self._show(self._page(tick))

    def _page(self, tick: Tick) -> Picture:
        page = np.full((HEIGHT, WIDTH, 3), _PAPER, np.uint8)
        page[48 : 48 + 468, 16 : 16 + 832] = self._job.scene.overview(832, 468)[..., ::-1]
        _text(page, f"{tick.time_ns * 1e-9:6.1f} s", (16, 32), _INK, 0.62)
        _text(page, told(tick, self._job), (110, 32), _INK, 0.62)
        done, _ = self._job.progress
        cv2.rectangle(page, (864, 18), (1263, 32), _GRID, -1)
        if done > 0.0:
            cv2.rectangle(page, (864, 18), (864 + round(399 * done), 32), _BLUE, -1)
        _text(page, "what the camera saw last, ink marked", (864, 64), _MUTED, 0.45)
        if self._camera is not None:
            page[72 : 72 + CAMERA[1], 864 : 864 + CAMERA[0]] = self._camera
        _text(page, "the board now, and where the eraser slid", (864, 320), _MUTED, 0.45)
        self._board(page[328:516, 864:1264])
        self._forces(page[528:700, 16:1264])
        _text(page, self._last, (70, 714), _MUTED, 0.42)
        return page

    def _board(self, part: Picture) -> None:
        ink = self._job.scene.ink
        h, w = part.shape[:2]
        scale = min(w / ink.size[0], h / ink.size[1])
        size = (int(scale * ink.size[0]), int(scale * ink.size[1]))
        part[: size[1], : size[0]] = cv2.resize(ink.rgb[..., ::-1], size, interpolation=cv2.INTER_AREA)
        if len(self._path) > 1:
            way = np.rint(np.array(self._path) * scale).astype(np.int32)
            for a, b in pairwise(way):
                if np.abs(b - a).max() < 0.03 * scale:  # not across the air between two strokes
                    cv2.line(part, a.tolist(), b.tolist(), _BLUE, 1, cv2.LINE_AA)
        cv2.rectangle(part, (0, 0), (size[0] - 1, size[1] - 1), _MUTED, 1)

    def _forces(self, part: Picture) -> None:
        h, w = part.shape[:2]
        left, top, bottom = 54, 22, h - 16
        bound = self._job.options.max_force
        high = 1.25 * bound

        def y(force: float | npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
            return bottom - np.clip(np.asarray(force), 0.0, high) / high * (bottom - top)

        for force in (0.0, self._job.options.normal_force, bound):
            row = round(float(y(force)))
            cv2.line(part, (left, row), (w - 1, row), _RED if force == bound else _GRID, 1)
            _text(part, f"{force:g} N", (2, row + 5), _MUTED, 0.42)
        x0 = left
        for name, colour in (("set point", _INK), ("felt", _BLUE), ("true", _GREY), ("bound", _RED)):
            cv2.line(part, (x0, 8), (x0 + 22, 8), colour, 2)
            _text(part, name, (x0 + 28, 13), _MUTED, 0.42)
            x0 += 110
        _text(part, "force of the eraser on the board", (x0 + 20, 13), _MUTED, 0.42)
        rows = np.array(self._force)
        x = left + (w - left - 1) * (1.0 - (rows[-1, 0] - rows[:, 0]) / WINDOW)
        for column, colour in ((3, _GREY), (2, _BLUE), (1, _INK)):
            good = np.isfinite(rows[:, column])
            breaks = np.flatnonzero(np.diff(np.append(False, good).astype(int)) == 1)
            ends = np.flatnonzero(np.diff(np.append(good, False).astype(int)) == -1)
            for a, b in zip(breaks, ends, strict=True):
                line = np.stack([x[a : b + 1], y(rows[a : b + 1, column])], 1)
                cv2.polylines(part, [np.rint(line).astype(np.int32)], False, colour, 1, cv2.LINE_AA)


def shown(look: Look, size: tuple[int, int]) -> Picture:
    """What is around the board in a picture, of `size` (width, height) [pixel]: its outline, the ink in red, other
    things in purple."""
    h, w = look.image.shape[:2]
    low, part = np.zeros(2), np.array([w, h], np.float64)
    if look.sight.board is not None:
        corners = look.sight.board.corners
        extent = 1.4 * np.ptp(corners, axis=0)
        wide = min(max(float(extent[0]), float(extent[1]) * size[0] / size[1]), w, h * size[0] / size[1])
        part = np.array([wide, wide * size[1] / size[0]])
        low = np.clip(corners.mean(0) - 0.5 * part, 0.0, [w, h] - part)
    scale = size[0] / part[0], size[1] / part[1]
    M = np.array([[scale[0], 0.0, -scale[0] * low[0]], [0.0, scale[1], -scale[1] * low[1]]])
    picture = cv2.warpAffine(look.image, M, size, flags=cv2.INTER_AREA)
    if look.sight.ink is not None:
        ink = cv2.warpAffine(look.sight.ink.mask.astype(np.uint8), M, size, flags=cv2.INTER_NEAREST) > 0
        picture[ink] = (0.35 * picture[ink] + 0.65 * np.array([40, 40, 255])).astype(np.uint8)
        for thing in look.sight.ink.objects:
            _outline(picture, (thing - low) * scale, (200, 60, 200))
    if look.sight.board is not None:
        _outline(picture, (look.sight.board.corners - low) * scale, (70, 180, 40))
    return picture


def _outline(picture: Picture, corners: npt.NDArray[np.float64], colour: tuple[int, int, int]) -> None:
    cv2.polylines(picture, [np.rint(corners).astype(np.int32)], True, colour, 2, cv2.LINE_AA)


def _text(page: Picture, words: str, at: tuple[int, int], colour: tuple[int, int, int], size: float) -> None:
    cv2.putText(page, words, at, cv2.FONT_HERSHEY_SIMPLEX, size, colour, 1, cv2.LINE_AA)


class Video:
    """A file of pictures (720, 1280, 3) BGR, MPEG-4.

    Args:
        path: ``.mp4``.
        rate: pictures per second.

    Raises:
        InputError: another suffix, or the file cannot be written.
    """

    def __init__(self, path: str | PathLike[str], rate: float = RATE) -> None:
        self.path = Path(path)
        if self.path.suffix.lower() != ".mp4":
            raise InputError(f"{self.path}: a video needs a name that ends in .mp4")
        self._out = cv2.VideoWriter(str(self.path), cv2.VideoWriter.fourcc(*"mp4v"), rate, (WIDTH, HEIGHT))
        if not self._out.isOpened():
            raise InputError(f"{self.path}: no video can be written there")

    def show(self, picture: Picture) -> None:
        """Append a picture."""
        self._out.write(picture)

    def close(self) -> None:
        """Finish the file."""
        self._out.release()
