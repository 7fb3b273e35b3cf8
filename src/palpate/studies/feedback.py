"""What is weighed is fed back to the controller: does the arm reach its goal, and how soon?"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..arm import Array
from ..pipeline import Pipeline
from . import Progress, Row, _bench, _bound, _figures
from ._bench import LIMIT, POSES, FeedbackLaw, PublishedLaw, Work, settled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SEEDS = 10
REACHED = 0.01
"""[rad]"""
STRONG = 5.0
"""a torque limit that allows every pose [N m]"""
END = 1.0
"""of a run, over which the last position is averaged [s]"""
FOURTH = 3
"""joint 4, of which the report says where it ends"""


@dataclass(frozen=True, slots=True)
class Job:
    """One run."""

    pose: str
    seed: int
    published: bool
    limit: float = LIMIT
    """of every torque [N m]"""


class Found(NamedTuple):
    """A run."""

    time: Array
    q: Array
    """(N, n) [rad]"""
    wanted: Array
    """(N, n) [rad]"""
    end: Array
    """(n,) mean of the last second [rad]"""
    reached: float
    """from when on every joint is within 0.01 rad of the goal [s]"""
    rested: float
    """from when on every joint is within 0.01 rad of where it ends [s]"""


def measure(job: Job) -> Found:
    """Run one job."""
    arm = _bench.reference_arm()
    if job.limit != LIMIT:
        limits = (j.limits for j in arm.joints)
        stronger = (dataclasses.replace(x, effort=job.limit) for x in limits)
        arm = arm.replace(
            joints=tuple(j.replace(limits=x) for j, x in zip(arm.joints, stronger, strict=True))
        )
    law: Any = PublishedLaw(arm) if job.published else FeedbackLaw(Pipeline(arm), limit=job.limit)
    goal = np.array(POSES[job.pose])
    motion = _bench.simulate(arm, law, goal, load=_bench.brick(), seed=job.seed)
    end = motion.q[motion.time >= motion.time[-1] - END].mean(axis=0)
    return Found(
        motion.time,
        motion.q,
        motion.wanted[:, 0],
        end,
        settled(motion.time, np.abs(motion.q - goal).max(axis=1), REACHED),
        settled(motion.time, np.abs(motion.q - end).max(axis=1), REACHED),
    )


def run(progress: Progress, quick: bool) -> tuple[list[Row], Mapping[str, Figure], list[str]]:
    """Measure; `quick` with one seed."""
    seeds = 1 if quick else SEEDS
    jobs = [
        Job(pose, seed, published) for published in (False, True) for pose in POSES for seed in range(seeds)
    ]
    jobs += [Job(pose, seed, False, STRONG) for pose in POSES for seed in range(seeds)]
    with Work(progress, len(jobs)) as work:
        found = dict(zip(jobs, work.map(measure, jobs), strict=True))
    arm = _bench.reference_arm()
    loaded = _bound.holding(arm, _bench.brick())
    ours = {
        pose: [f for j, f in found.items() if j.pose == pose and not j.published and j.limit == LIMIT]
        for pose in POSES
    }
    theirs = {pose: [f for j, f in found.items() if j.pose == pose and j.published] for pose in POSES}
    strong = {pose: [f for j, f in found.items() if j.pose == pose and j.limit == STRONG] for pose in POSES}
    needed = {pose: loaded.gravity_torque(goal) for pose, goal in POSES.items()}
    allowed = {pose: float(np.abs(torque).max()) <= LIMIT for pose, torque in needed.items()}

    rows = []
    for pose, goal in POSES.items():
        torque = needed[pose]
        joint = int(np.abs(torque).argmax())
        off, where = _off(ours[pose], goal)
        before, published = _off(theirs[pose], goal)
        note = f"needs {abs(torque[joint]):.2f} N m at joint {joint + 1} to stay there; joint {where + 1} is off the most"
        if not allowed[pose]:
            note += f"; beyond the limit of {LIMIT} N m"
        note += f"; published controller: {before:.3f} rad off at joint {published + 1}"
        rows.append(
            Row(
                f"pose {pose}: goal missed by, worst joint and run", f"<= {REACHED}" if allowed[pose] else None, off, None,
                off <= REACHED if allowed[pose] else None, "rad", note,
            )
        )  # fmt: skip
    for pose in POSES:
        mine, rested = _median(ours[pose], "reached"), _median(theirs[pose], "rested")
        reached = _median(theirs[pose], "reached")
        note = f"at rest within 0.01 rad of where it ends: {_median(ours[pose], 'rested'):.2f} s, published {rested:.2f} s"
        note += "" if math.isfinite(reached) else "; the published controller never reaches the goal"
        rows.append(
            Row(
                f"pose {pose}: within 0.01 rad of the goal for good, median",
                None,
                mine,
                None,
                None,
                "s",
                note,
            )
        )
    end = float(np.mean([f.end[FOURTH] for f in ours["goal"]]))
    before = float(np.mean([f.end[FOURTH] for f in theirs["goal"]]))
    wanted = POSES["goal"][FOURTH]
    rows.append(
        Row(
            "published goal: joint 4 ends at", wanted, end, REACHED, abs(end - wanted) <= REACHED, "rad",
            f"published 0.55; with the published controller here {before:.3f}",
        )
        if allowed["goal"]
        else Row(
            "published goal: joint 4 ends at", wanted, end, None, None, "rad",
            f"published 0.55; with the published controller here {before:.3f}; the torque limit does not allow this goal",
        )
    )  # fmt: skip
    missed = {pose: _off(strong[pose], goal)[0] for pose, goal in POSES.items()}
    worst = max(missed, key=lambda pose: missed[pose])
    fourth = float(np.mean([f.end[FOURTH] for f in strong["goal"]]))
    rows.append(
        Row(
            f"torque limit {STRONG:g} N m instead: goal missed by, worst pose, joint and run", f"<= {REACHED}", missed[worst], None,
            None, "rad", f"pose {worst}; published goal: joint 4 ends at {fourth:.3f}, within 0.01 rad of the goal after "
            f"{_median(strong['goal'], 'reached'):.2f} s",
        )
    )  # fmt: skip
    can = [pose for pose in POSES if allowed[pose]]
    notes = [
        f"{seeds} seeds per pose; gains, torque limit and noise as published. Ours: inverse dynamics of the arm with what it is "
        "found to hold (default filter), on the filter's state.",
        f"The limit of {LIMIT} N m allows {len(can)} of {len(POSES)} poses: {', '.join(can)}.",
    ]
    return rows, _figures.drawn(lambda: _draw(found)), notes


def _off(group: Sequence[Found], goal: Sequence[float]) -> tuple[float, int]:
    off = np.array([np.abs(f.end - goal) for f in group])
    return float(off.max()), int(off.max(axis=0).argmax())


def _median(group: Sequence[Found], what: str) -> float:
    return float(np.median([getattr(f, what) for f in group]))


def _draw(found: Mapping[Job, Found]) -> dict[str, Any]:
    from ..report import joints_figure

    figures = {}
    for pose in ("goal", "Take3"):
        ours, theirs = found[Job(pose, 0, False)], found[Job(pose, 0, True)]
        figures[f"Joint positions on the way to {pose}"] = joints_figure(
            ours.time,
            {"load fed back": ours.q, "published controller": theirs.q, "desired": ours.wanted},
            _bench.reference_arm().joint_names,
        )
    return figures
