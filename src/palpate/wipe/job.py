"""The whole job: see, hold, wipe, check."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

from .result import JobResult, Observer
from .scene import BoardScene
from .strokes import Motion

Clock: TypeAlias = Literal["simulated", "wall"]
Task: TypeAlias = Literal["looking", "holding", "planning", "moving", "wiping", "parking", "safe", "ended"]
"""what the mediator does"""


@dataclass(frozen=True, slots=True)
class JobOptions:
    """How a board is to be wiped."""

    speed: float = 0.1
    """of the eraser on the board [m/s]"""
    normal_force: float = 2.5
    """[N]"""
    max_force: float = 5.0
    """bound of the commanded force's norm [N]"""
    max_torque: float = 2.0
    """of the moment's [N m]"""
    passes: int = 3
    """at most"""
    hold: Literal["always", "needed", "never"] = "always"
    """the other arm takes the board: before wiping; when it was seen to move; or it is left loose"""
    colour: tuple[str, ...] | None = None
    """wipe these colours only"""
    within: tuple[tuple[float, float], ...] | None = None
    """outline of a region to wipe, board coordinates [m]"""
    without: tuple[tuple[float, float], ...] | None = None
    """outline of a region to leave alone"""
    seed: int = 0
    """of the sensors' noise"""


class WipeJob:
    """Wipe the board of a scene.

    >>> job = WipeJob(scene, JobOptions(speed=0.1))  # doctest: +SKIP
    >>> result = job.run(observer=MyObserver())  # doctest: +SKIP
    >>> result.verdict, result.ink_left  # doctest: +SKIP

    Args:
        scene: with both arms where they are; the job parks them first.
        options: None: as the defaults say.
    """

    def __init__(self, scene: BoardScene, options: JobOptions | None = None) -> None:
        self.scene = scene
        self.options = options or JobOptions()

    def run(
        self, *, observer: Observer | None = None, clock: Clock = "simulated", limit: float = 600.0
    ) -> JobResult:
        """Until the board is clean, the passes are used up, or it was stopped or had to stop.

        After a stop with ``resumable`` another call goes on where it was.

        Args:
            observer: told everything while it runs.
            clock: simulated: as fast as it goes, the same seed the same run; wall: no faster than real time.
            limit: simulated time at most [s].
        """
        raise NotImplementedError

    def pause(self) -> None:
        """Both arms come to rest and hold; from any thread."""
        raise NotImplementedError

    def resume(self) -> None:
        """Go on after a pause."""
        raise NotImplementedError

    def stop(self) -> None:
        """End safely: lift, let both arms rest; from any thread."""
        raise NotImplementedError

    @property
    def progress(self) -> tuple[float, float]:
        """Part done of the pass's strokes (0 to 1), and simulated seconds left of it by the plan."""
        raise NotImplementedError
