"""Where a page takes its numbers from, and to whom it passes on what a person asks for."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from ..arm import Array
from .history import SPANS
from .scene import Badge, Reading, ShownArm

Image = npt.NDArray[np.uint8]
"""(height, width, 3)"""


class Source(ABC):
    """One or more arms, and cameras.

    Everything is called from the page's thread, 30 times a second or seldom; nothing may wait for an arm. What a
    person can do is said by the protocols below: a source that has :class:`Moves` gets buttons to move by.
    """

    @property
    @abstractmethod
    def arms(self) -> tuple[ShownArm, ...]:
        """The arms; neither their number nor their order changes."""

    @abstractmethod
    def start(self) -> None:
        """Begin."""

    @abstractmethod
    def stop(self) -> None:
        """End; the drives are off and files are closed when it returns. As often as you like."""

    @abstractmethod
    def reading(self, arm: int) -> Reading | None:
        """The newest state of an arm; None: there is none yet."""

    @abstractmethod
    def curves(self, arm: int, span: float) -> tuple[Array, Array]:
        """Time (K,) [s] and rows (K, Channels.count) of the last `span` seconds, K a few hundred."""

    @property
    @abstractmethod
    def state(self) -> Badge:
        """What the source does, in words."""

    @property
    def spans(self) -> tuple[float, ...]:
        """Spans that :meth:`curves` knows [s]."""
        return SPANS

    def images(self) -> Mapping[str, Image]:
        """Newest picture of each camera by its name; the same array as long as there is no newer one."""
        return MappingProxyType({})

    def messages(self) -> list[str]:
        """What a person should be told, since the last call."""
        return []


@runtime_checkable
class Moves(Protocol):
    """Arms that go where they are told."""

    def go(self, arm: int, pose: str) -> None:
        """Go to a pose by name or by angles separated by commas [rad]; one under way is slowed down first.

        Raises:
            InputError: no such pose, or one beyond the joints' limits.
        """

    def halt(self, arm: int) -> None:
        """Slow down along the path and hold there."""


@runtime_checkable
class Powers(Protocol):
    """Real drives, to be switched on and off."""

    @property
    def powered(self) -> bool:
        """The drives are on."""

    def power(self, on: bool) -> None:
        """Switch them: on, they hold the arm where it is; off, somebody else must."""


@runtime_checkable
class Holds(Protocol):
    """Simulated hands."""

    def hold(self, arm: int, mass: float) -> None:
        """Put an object of so many kg into the hand; 0: nothing."""

    def held(self, arm: int) -> float:
        """What was put there last [kg]."""


@runtime_checkable
class Pushable(Protocol):
    """Simulated arms that can be pushed."""

    def push(self, arm: int, link: str, force: npt.ArrayLike) -> None:
        """Push a link with a force (3,) [N], base axes, from now on; 0: no longer."""


@runtime_checkable
class Records(Protocol):
    """Sources that write recordings."""

    @property
    def recording(self) -> Path | None:
        """The file being written."""

    def record(self) -> Path:
        """Begin a recording; the estimate starts anew with it, so that it replays bit for bit."""

    def end_recording(self) -> Path | None:
        """End it; the file."""


@runtime_checkable
class Tunes(Protocol):
    """Sources whose pipeline can be changed."""

    def options(self, arm: int) -> dict[str, Any]:
        """Of the pipeline in use, see :meth:`palpate.Pipeline.options`."""

    def tune(self, arm: int, options: Mapping[str, Any]) -> None:
        """Take another pipeline from the next sample on.

        Raises:
            InputError: an option is unknown or out of range, or a recording is being written.
        """


@runtime_checkable
class Plays(Protocol):
    """Recordings, whose time can be gone through."""

    @property
    def duration(self) -> float:
        """[s]"""

    @property
    def position(self) -> float:
        """[s] from the beginning"""

    @property
    def playing(self) -> bool:
        """Time goes on."""

    def play(self, on: bool) -> None:
        """Let time go on, or stand."""

    def seek(self, position: float) -> None:
        """Go to a time [s]."""

    def pace(self, speed: float) -> None:
        """Recorded seconds per second, > 0."""
