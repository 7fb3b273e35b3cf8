"""Published results reproduced, and palpate's own claims measured: one module per study.

>>> from palpate.studies import STUDIES
>>> result = STUDIES["payload-filter"].run(quick=True)  # doctest: +SKIP
>>> [(row.what, row.ours) for row in result.rows]  # doctest: +SKIP

Studies run on two processes, started by ``spawn``: a script that runs one needs ``if __name__ == "__main__":``.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from ..errors import InputError
from ..report.study import StudyRow as Row

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["STUDIES", "Progress", "Row", "Study", "StudyResult"]

Progress: TypeAlias = Callable[[int, int, float], None]
"""called with (jobs done, jobs in all, seconds left by present pace; infinite until one is done)"""


@dataclass(frozen=True, slots=True)
class StudyResult:
    """What a study found."""

    name: str
    title: str
    rows: tuple[Row, ...]
    """what was published or is required, and what was measured; ``ok`` None: for information"""
    figures: Mapping[str, Figure] = field(default_factory=dict)
    """matplotlib figures by caption, in order; none if matplotlib is not installed"""
    notes: tuple[str, ...] = ()
    """how it was measured, and what surprised; one sentence or more each"""
    seconds: float = 0.0
    """how long it took [s]"""

    @property
    def ok(self) -> bool:
        """No row misses."""
        return all(row.ok is not False for row in self.rows)


@dataclass(frozen=True, slots=True)
class Study:
    """A study by name; its module is imported when it runs."""

    name: str
    title: str
    verb: Literal["reproduce", "bench"]
    """the command it belongs to: ``palpate reproduce NAME`` or ``palpate bench NAME``"""
    module: str = ""
    """within palpate.studies; empty: the name with underscores"""
    campaign: bool = False
    """it simulates for hours, as many as are wanted, and can keep what is done to go on another time"""
    timed: bool = False
    """it runs by the wall's clock, for as many minutes as are wanted"""

    def run(
        self,
        progress: Progress | None = None,
        quick: bool = False,
        *,
        folder: Path | None = None,
        hours: float | None = None,
        minutes: float | None = None,
    ) -> StudyResult:
        """Measure.

        Args:
            progress: told after every job how far it is.
            quick: few repetitions, to see that it works. The rows then say so and judge nothing.
            folder: where a campaign keeps what is done; None: nowhere.
            hours: simulated by a campaign [h]; None: as many as its figure asks for.
            minutes: of a timed study [min]; None: as many as its figure asks for.

        Raises:
            InputError: hours are given for a study that is no campaign, minutes for one that is not timed.
            MissingExtraError: the study needs an extra, mostly ``sim``.
        """
        module = importlib.import_module(f"{__name__}.{self.module or self.name.replace('-', '_')}")
        if hours is not None and not self.campaign:
            raise InputError(f"study {self.name!r} is no campaign: its length is fixed")
        if minutes is not None and not self.timed:
            raise InputError(f"study {self.name!r} does not run by the wall's clock: its length is fixed")
        options: dict[str, Any] = {"folder": folder, "hours": hours} if self.campaign else {}
        if self.timed:
            options["minutes"] = minutes
        begin = time.perf_counter()
        rows, figures, notes = module.run(progress or _silent, quick, **options)
        if quick:
            rows = [
                replace(row, ok=None, note=f"quick run, not comparable; {row.note}".rstrip("; "))
                for row in rows
            ]
            notes = ["Quick run: fewer repetitions than the figures ask for; no row is judged.", *notes]
        return StudyResult(
            self.name, self.title, tuple(rows), figures, tuple(notes), time.perf_counter() - begin
        )


def _silent(done: int, total: int, seconds_left: float) -> None:
    """Progress that nobody wants to see."""


_ALL = (
    Study("mass-estimation", "The published mass estimation with a sliding-mode observer", "reproduce"),
    Study("lara8", "A real NEURA LARA8 weighs 5.26 kg by its motor currents", "reproduce"),
    Study("sensorless-force", "External force of an ABB IRB 2400 from its phase currents alone", "reproduce"),
    Study("iiwa-velocity", "The velocity noise of a real KUKA LBR iiwa is two clocks", "reproduce"),
    Study(
        "whiteboard", "The whiteboard project's velocity controllers, as published and corrected", "reproduce"
    ),
    Study("teleoperation", "A hand feels what a light arm touches, without a force sensor", "reproduce"),
    Study("payload-filter", "The payload Kalman filter on the published bench", "bench"),
    Study("unknown-grasp", "The object is not held where it was thought", "bench"),
    Study("pushes", "Somebody pushes on the arm while it weighs", "bench"),
    Study("wrong-masses", "The arm's links do not weigh what the model says", "bench"),
    Study("grasp-and-release", "An object is taken and dropped at unknown times", "bench"),
    Study(
        "contacts",
        "Contacts found and not found: a real UR10e, and 100 h of two simulated arms",
        "bench",
        campaign=True,
    ),
    Study("feedback", "What is weighed is fed back to the controller", "bench"),
    Study(
        "teleoperation-episodes",
        "Ten thousand random teleoperators on bad networks: no energy is made",
        "bench",
    ),
    Study("box-inertias", "The same arm with inertias a body can have", "bench"),
    Study(
        "accuracy", "Recordings of real robots: identification, drive gains, loads, and the rivals", "bench"
    ),
    Study("replay", "Live, offline, replayed, chunked: the same bits; import time and size", "bench"),
    Study(
        "board-detection", "Whiteboards found in rendered views and photographs, and the ink on them", "bench"
    ),
    Study("session", "The real-time session at 1 kHz while the computer is busy", "bench", timed=True),
    Study("view", "The live page: first picture, updates, memory", "bench", timed=True),
    Study(
        "ros2",
        "ROS 2 beside Fast DDS, ros2-client and hiroz (Zenoh); the published graph as processes",
        "bench",
    ),
    Study(
        "servos",
        "Seven emulated Dynamixel servos weigh: rate, damaged answers, a dead servo",
        "bench",
        timed=True,
    ),
    Study("rtde", "An emulated UR at 500 Hz: age of the samples, a cut connection", "bench", timed=True),
    Study("fri", "An emulated KUKA LBR at 2 ms: the session holds, no stale command", "bench", timed=True),
    Study(
        "wipe",
        "Fifty boards wiped, from camera pixels to a clean board, without a force sensor",
        "bench",
        campaign=True,
    ),
    Study("speed", "Time per sample, beside the same written with Pinocchio", "bench"),
)

STUDIES: Mapping[str, Study] = MappingProxyType({study.name: study for study in _ALL})
"""every study by name"""
