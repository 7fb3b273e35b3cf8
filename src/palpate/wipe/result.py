"""What a job tells: every control cycle while it runs, every look, everything that happened, and the verdict."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from ..arm import Array
from ..vision import Sight
from .strokes import Plan

Kind: TypeAlias = Literal["task", "activity", "force", "board", "fault", "person"]
"""of an event: what the job does next; a life cycle; contact and yielding; the board moved or was held; something
failed; somebody paused, resumed or stopped it"""
Verdict: TypeAlias = Literal["clean", "dirty", "stopped"]


@dataclass(frozen=True, slots=True, eq=False)
class Tick:
    """One cycle of the robot activity. Base axes are those of the eraser's arm; truth is the simulation's."""

    time_ns: int
    """since the job began [ns]"""
    q: Array
    """(n,) measured, eraser's arm [rad]"""
    dq: Array
    """(n,) [rad/s]"""
    tau: Array
    """(n,) measured joint torque [N m]; NaN where its channel is lost"""
    q_holder: Array
    dq_holder: Array
    tau_holder: Array
    commanded: Array
    """(6,) force [N] and moment [N m] on the tool that were commanded, base axes"""
    estimated: Array
    """(6,) of the board on the tool by the joint torques, base axes [N, N m]; NaN where it is not to be believed"""
    estimated_std: Array
    """(6,) standard deviation"""
    wanted_force: float
    """along the board's normal [N]; 0: not pressing"""
    normal_force: float
    """of the board on the eraser along the normal, estimated [N]; NaN where it is not to be believed"""
    true_force: Array
    """(3,) MuJoCo's contact force on the eraser, world axes [N]"""
    true_normal: float
    """its part along the board's normal [N]"""
    T_world_tool: Array
    """(4, 4) of the felt's face, by forward kinematics"""
    T_world_board: Array
    """(4, 4) of the board, truly"""
    T_world_board_seen: Array | None
    """(4, 4) where the job believes the board is; None: it has not seen it yet"""
    task: str
    """what the mediator does, see :class:`palpate.wipe.job.Task`"""
    number: int
    """pass, from 1; 0 before the first"""
    stroke: int
    """index into the pass's plan; -1: none"""
    phase: str
    """approach, touch, slide or lift; empty: none of them"""
    yielding: bool
    held: bool
    """the other arm holds the board"""
    activities: Mapping[str, str]
    """life-cycle state of each activity by name"""


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """A picture and what was seen in it."""

    time_ns: int
    image: npt.NDArray[np.uint8]
    """(H, W, 3) BGR"""
    sight: Sight
    why: str
    """before, after, or check: between two strokes"""


@dataclass(frozen=True, slots=True)
class Event:
    """Something happened."""

    time_ns: int
    kind: Kind
    text: str
    """one sentence"""


@dataclass(frozen=True, slots=True, eq=False)
class Pass:
    """Once over everything that was seen to be dirty."""

    plan: Plan
    begin_ns: int
    end_ns: int
    ink: float
    """under visible ink at its beginning, truly [m^2]"""
    seen: float
    """part of the surface under ink as seen at its beginning"""


@dataclass(frozen=True, slots=True)
class Timing:
    """Wall time of an activity's cycles."""

    period: float
    """[s]"""
    cycles: int
    median: float
    """[s]"""
    p99: float
    """[s]"""
    worst: float
    """[s]"""


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """One row for each cycle of the robot activity, for figures and statistics."""

    time: Array
    """(N,) [s]"""
    phase: npt.NDArray[np.str_]
    """(N,) approach, touch, slide, lift, or empty"""
    wanted: Array
    """(N,) normal force set [N]"""
    estimated: Array
    """(N,) normal force estimated [N]"""
    normal: Array
    """(N,) normal force, truly [N]"""
    contact: Array
    """(N,) norm of the contact force, truly [N]"""
    force: Array
    """(N,) norm of the commanded force [N]"""
    moment: Array
    """(N,) norm of the commanded moment [N m]"""
    tool: Array
    """(N, 3) of the eraser's centre over the board as believed, board coordinates, z the height [m]; NaN before"""
    moved: Array
    """(N,) the board's origin from where it was when the wiping of this pass began [m]; NaN before"""
    yielding: npt.NDArray[np.bool_]
    """(N,)"""
    held: npt.NDArray[np.bool_]
    """(N,) the other arm holds the board"""

    def within(self, band: float) -> float:
        """Part of the time of sliding in which the true normal force is within `band` [N] of its set point."""
        slide = (self.phase == "slide") & ~self.yielding
        if not slide.any():
            return float("nan")
        return float(np.mean(np.abs(self.normal[slide] - self.wanted[slide]) <= band))


@dataclass(frozen=True, slots=True, eq=False)
class JobResult:
    """How a job ended."""

    verdict: Verdict
    """clean or dirty as the camera sees it; stopped: it did not get to its end"""
    reason: str
    """one sentence: why it is not clean, why it stopped, or what marks do not come off; else empty"""
    resumable: bool
    """stopped, and :meth:`palpate.wipe.WipeJob.run` goes on where it was"""
    passes: tuple[Pass, ...]
    ink_before: float
    """under visible ink, truly [m^2]"""
    ink_after: float
    """[m^2]"""
    before: Look | None
    after: Look | None
    """the last look at a board without an arm in front of it"""
    coverage: npt.NDArray[np.float32]
    """(H, W) work of the felt on the surface, in the ink's texels [J/m^2]"""
    events: tuple[Event, ...]
    track: Track
    timing: Mapping[str, Timing]
    """by activity; and "simulation": a cycle of the simulated world"""
    simulated: float
    """[s]"""
    wall: float
    """[s]"""

    @property
    def ink_left(self) -> float:
        """Part of the ink's area that is left, truly; NaN if there was none."""
        return self.ink_after / self.ink_before if self.ink_before > 0.0 else float("nan")


class Observer:
    """Told while a job runs, in the thread that runs it; override what is wanted.

    It may call :meth:`palpate.wipe.WipeJob.pause`, ``resume`` and ``stop``, and play tricks on the scene.
    """

    def tick(self, tick: Tick) -> None:
        """After each cycle of the robot activity."""

    def look(self, look: Look) -> None:
        """After each picture."""

    def event(self, event: Event) -> None:
        """When something happened."""
