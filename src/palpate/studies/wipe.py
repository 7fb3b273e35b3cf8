"""Boards wiped in simulation from camera pixels to a clean board: ink, force, the held board, pushes, time."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np

from .. import _core, vision, wipe
from .._core import CartesianVelocityOptions
from ..control import CartesianTarget, CartesianVelocity
from ..wipe import mediator
from ..wipe.boards import random_board
from . import Progress, Row
from ._bench import Work
from ._kept import Kept
from ._rows import at_most, told

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Trial: TypeAlias = Literal["slow", "fast", "pushed", "slippery"]
BOARDS: Mapping[Trial, int] = {"slow": 50, "fast": 10, "pushed": 5, "slippery": 5}
"""held at 0.1 m/s; held at 0.25 m/s; a person pushes; not held, on a table on which felt drags the board along"""
SPEED: Mapping[Trial, float] = {"slow": 0.1, "fast": 0.25, "pushed": 0.1, "slippery": 0.1}
PUSH = 30.0
"""of a person [N]"""
PUSHING = 0.5
"""for so long [s]"""
LEFT = 0.005
"""part of the ink's area that may be left"""
NEEDED = 48
"""of the 50 boards"""
BOUND, MOMENT = 5.0, 2.0
"""of the commanded wrench [N], [N m]"""
MOVED = 3.0
"""of a held board at most [mm]"""
SECONDS = 40.0
"""simulated for one board, about"""
STEPS = 5.0
"""a control step at most [us]"""


@dataclass(frozen=True, slots=True)
class Job:
    """One board."""

    trial: Trial
    seed: int

    @property
    def name(self) -> str:
        """Of the job."""
        return f"{self.trial} {self.seed}"


@dataclass(frozen=True, slots=True)
class Found:
    """What came of a board."""

    verdict: str
    reason: str
    left: float
    """part of the ink's area, truly"""
    passes: int
    sliding: int
    """cycles"""
    within: tuple[int, int]
    """of them with the normal force within 0.5 N and within 1 N of its set point"""
    force: float
    """largest commanded [N]"""
    moment: float
    """[N m]"""
    contact: float
    """largest true force on the eraser [N]"""
    moved: float
    """of the board while it was held and wiped [mm]"""
    noticed: bool
    """that the board moved, and it was held from then on"""
    pushed_command: float
    """largest force commanded while a person pushed, from 50 ms after the push began [N]; NaN: nobody pushed"""
    pushed_contact: float
    """largest contact force then [N]"""
    simulated: float
    """[s]"""
    wall: float
    """[s]"""
    control: float
    """median wall time of the control activity's cycle [s]"""


class Pusher(wipe.Observer):
    """Pushes the eraser's arm away from the board and to the side, a second into the first stroke."""

    def __init__(self, scene: wipe.BoardScene) -> None:
        self._scene = scene
        self._begin: int | None = None
        self.command = self.contact = 0.0

    def tick(self, tick: wipe.Tick) -> None:
        """Push, and see what the arm does."""
        if self._begin is None:
            if tick.phase == "slide":
                self._begin = tick.time_ns
            return
        since = (tick.time_ns - self._begin) * 1e-9 - 1.0
        if since < 0.0:
            return
        pushing = since < PUSHING
        self._scene.push(PUSH * np.array([0.0, 0.8, 0.6]) if pushing else np.zeros(3))
        if pushing and since > 0.05:
            self.command = max(self.command, float(np.linalg.norm(tick.commanded[:3])))
            self.contact = max(self.contact, float(np.linalg.norm(tick.true_force)))


def measure(job: Job) -> Found:
    """Wipe a board."""
    layer, setting = random_board(job.seed)
    if job.trial == "slippery":
        # the felt drags it along, and it does not slide by itself
        setting = wipe.Setting(centre=(0.60, 0.0, 0.15), mass=1.5, friction=0.03, seed=job.seed)
    scene = wipe.BoardScene(layer, setting)
    pusher = Pusher(scene) if job.trial == "pushed" else None
    options = wipe.JobOptions(
        speed=SPEED[job.trial],
        hold="needed" if job.trial == "slippery" else "always",
        look_every=0.5,
        seed=job.seed,
    )
    try:
        result = wipe.WipeJob(scene, options).run(observer=pusher)
    finally:
        scene.close()
    track = result.track
    slide = (track.phase == "slide") & ~track.yielding
    error = np.abs(track.normal - track.wanted)[slide]
    still = track.moved[track.held & np.isfinite(track.moved)]
    return Found(
        result.verdict,
        result.reason,
        result.ink_left,
        len(result.passes),
        int(slide.sum()),
        (int((error <= 0.5).sum()), int((error <= 1.0).sum())),
        float(track.force.max()),
        float(track.moment.max()),
        float(track.contact.max()),
        1e3 * float(still.max()) if len(still) else 0.0,
        any("moved" in e.text for e in result.events if e.kind in ("fault", "board"))
        and bool(track.held.any()),
        pusher.command if pusher is not None else float("nan"),
        pusher.contact if pusher is not None else float("nan"),
        result.simulated,
        result.wall,
        result.timing["control"].median,
    )


def control_step() -> float:
    """Time of the core's controller for one step while it presses [us], of a thousand states."""
    scene = wipe.BoardScene(wipe.InkLayer((0.4, 0.3)))
    arm = scene.arms[0]
    controller = CartesianVelocity(
        arm, 0.008, CartesianVelocityOptions(**mediator.GAINS, max_force=BOUND, max_torque=MOMENT)
    )
    rng = np.random.default_rng(0)
    q = np.array([0.0, 0.6, 0.0, -1.5, 0.0, 1.0, 0.0]) + 0.1 * rng.standard_normal((1000, arm.n))
    dq = 0.1 * rng.standard_normal((1000, arm.n))
    force = rng.normal((0.0, 0.0, 2.5), 1.0, (1000, 3))
    target = CartesianTarget(np.array([0.5, 0.0, 0.2]), np.diag([1.0, -1.0, -1.0]), normal_force=2.5)
    best = float("inf")
    for _ in range(20):
        begin = time.perf_counter()
        controller.run(target, q, dq, force)
        best = min(best, (time.perf_counter() - begin) / len(q))
    return 1e6 * best


def effective_mass() -> tuple[float, float]:
    """Least and largest force per acceleration of the eraser in the plane of a level board [kg], over the board."""
    scene = wipe.BoardScene(wipe.InkLayer((0.45, 0.31)))
    arm, (width, height) = scene.arms[0], scene.ink.size
    spots = [(u * width, v * height, 0.0) for u in (0.1, 0.5, 0.9) for v in (0.1, 0.5, 0.9)]
    wanted = wipe.tool_poses(np.array(spots), scene.T_base_board(0), 0.0)
    poses = [q for T in wanted if (q := wipe.inverse_kinematics(arm, T)) is not None]
    scene.close()
    angle = np.linspace(0.0, np.pi, 16, endpoint=False)
    ways = np.stack([np.cos(angle), np.sin(angle), np.zeros(16)])
    force = np.linalg.norm(wipe.tool_inertia(arm, np.array(poses))[:, :3, :3] @ ways, axis=1)
    return float(force.min()), float(force.max())


def made_by() -> str:
    """What results depend on: the compiled core, and the sources of seeing, simulating and wiping."""
    digest = hashlib.sha256(Path(str(_core.__file__)).read_bytes())
    for package in (wipe, vision):
        for path in sorted(Path(str(package.__file__)).parent.glob("*.py")):
            digest.update(path.read_bytes())
    digest.update(Path(__file__).read_bytes())
    return digest.hexdigest()


def run(
    progress: Progress, quick: bool, folder: Path | None = None, hours: float | None = None
) -> tuple[list[Row], Mapping[str, Figure], list[str]]:
    """Wipe them all.

    Args:
        progress: told how far it is.
        quick: two boards.
        folder: where results are kept, so that it goes on where it was stopped.
        hours: simulated in all, instead of all boards [h].
    """
    jobs = [Job(trial, seed) for trial, count in BOARDS.items() for seed in range(1, count + 1)]
    if quick:
        jobs = [Job("slow", 2), Job("fast", 2)]
    elif hours is not None:
        jobs = jobs[: max(1, round(hours * 3600.0 / SECONDS))]
    kept = Kept(None if quick or folder is None else folder / "wipe.state.jsonl", made_by())
    left = [job for job in jobs if kept.get(job.name) is None]
    with Work(progress, len(left)) as work:
        work.map(measure, left, lambda k, found: kept.put(left[k].name, asdict(found)))
    found = {job.name: Found(**kept.get(job.name)) for job in jobs}
    every = [(job, found[job.name]) for job in jobs]
    rows: list[Row] = []
    for trial, judge in (
        ("slow", _ink),
        ("slow", _forces),
        ("fast", _forces),
        ("pushed", _pushes),
        ("slippery", _slips),
    ):
        mine = [f for job, f in every if job.trial == trial]
        if mine:
            rows += judge(mine, trial)  # type: ignore[arg-type]
    rows.append(
        at_most(
            "control step of the core while it presses", STEPS, control_step(), "us", "quietest of 20 rounds"
        )
    )
    least, largest = effective_mass()
    rows.append(
        told(
            "force over acceleration of the eraser along a level board, largest",
            largest,
            "kg",
            f"least {least:.2g} kg, nine places, every direction",
        )
    )
    pace = float(np.median([f.wall / f.simulated for f in found.values()]))
    rows.append(
        at_most(
            "wall time over simulated time of a whole job, median",
            1.0,
            pace,
            "1",
            f"control activity's cycle in Python, median {1e6 * np.median([f.control for f in found.values()]):.0f} us",
        )
    )
    notes = [
        "Boards, tables, light and ink are drawn from the seed: loose boards on a table tilted by up to 15 degrees, "
        "with words, drawings and smudges. The camera's picture is all that tells where board and ink are; ink left is "
        "counted on the texture. The arm feels by its joint torques alone (noise 0.02 N m); its model is that of the "
        "simulation, so errors of a model are not in these figures.",
        *(f"{job.name}: {f.verdict}, {100.0 * f.left:.2g} % left; {f.reason}" for job, f in every if _bad(f)),
    ]
    if kept.discarded:
        notes.append(f"{kept.discarded} kept results came from another version and were dropped.")
    return rows, {}, notes


def _bad(f: Found) -> bool:
    return f.verdict != "clean" or f.left > LEFT


def _ink(found: Sequence[Found], trial: Trial) -> list[Row]:
    clean = sum(f.left <= LEFT and f.passes <= 3 for f in found)
    agree = sum((f.verdict == "clean") == (f.left <= LEFT) for f in found)
    needed = NEEDED if len(found) == BOARDS["slow"] else len(found)
    worst = max(f.left for f in found)
    return [
        Row(
            f"boards with at most 0.5 % of the ink's area left after at most 3 passes, of {len(found)}",
            f">= {needed}",
            clean,
            None,
            clean >= needed,
            "",
            f"most left {100.0 * worst:.2g} %; passes {np.mean([f.passes for f in found]):.2f} in the mean",
        ),
        Row(
            f"the camera's verdict agrees with the texture, of {len(found)}",
            len(found),
            agree,
            None,
            agree == len(found),
            "",
            "",
        ),
        at_most(
            "held board: moved while it was wiped, largest", MOVED, max(f.moved for f in found), "mm", ""
        ),
        told("simulated time of a job, mean", float(np.mean([f.simulated for f in found])), "s"),
    ]


def _forces(found: Sequence[Found], trial: Trial) -> list[Row]:
    speed, band, k = SPEED[trial], *((0.5, 0) if trial == "slow" else (1.0, 1))
    part = 100.0 * sum(f.within[k] for f in found) / sum(f.sliding for f in found)
    worst = min(100.0 * f.within[k] / max(f.sliding, 1) for f in found)
    at = f"at {speed:g} m/s"
    # rounding in the last digit is no breach
    return [
        Row(
            f"{at}: normal force within {band:g} N of its set point, part of the time of sliding",
            ">= 95",
            part,
            None,
            part >= 95.0,
            "%",
            f"{len(found)} boards, the worst {worst:.1f} %",
        ),
        at_most(
            f"{at}: commanded force, largest norm", BOUND, round(max(f.force for f in found), 9), "N", ""
        ),
        at_most(
            f"{at}: commanded moment, largest norm", MOMENT, round(max(f.moment for f in found), 9), "N m", ""
        ),
        at_most(
            f"{at}: MuJoCo's contact force, largest", 1.2 * BOUND, max(f.contact for f in found), "N", ""
        ),
    ]


def _pushes(found: Sequence[Found], trial: Trial) -> list[Row]:
    clean = sum(not _bad(f) for f in found)
    return [
        at_most(
            "a person pushes with 30 N: force commanded meanwhile, largest",
            0.0,
            max(f.pushed_command for f in found),
            "N",
            f"from 50 ms after the push began, {len(found)} boards",
        ),
        at_most(
            "a person pushes with 30 N: MuJoCo's contact force, largest",
            1.2 * BOUND,
            max(f.pushed_contact for f in found),
            "N",
            "",
        ),
        Row(
            f"boards clean after a push, of {len(found)}",
            len(found),
            clean,
            None,
            clean == len(found),
            "",
            "",
        ),
    ]


def _slips(found: Sequence[Found], trial: Trial) -> list[Row]:
    seen = sum(f.noticed for f in found)
    clean = sum(not _bad(f) for f in found)
    return [
        Row(
            f"a board that slides along is noticed and then held, of {len(found)}",
            len(found),
            seen,
            None,
            seen == len(found),
            "",
            f"friction 0.03; clean in the end {clean}",
        )
    ]
