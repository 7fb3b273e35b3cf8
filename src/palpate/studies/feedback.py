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
from ._rows import at_most, near, told

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
    mine = [(j, f) for j, f in found.items() if not j.published]
    ours = {p: [f for j, f in mine if j.pose == p and j.limit == LIMIT] for p in POSES}
    strong = {p: [f for j, f in mine if j.pose == p and j.limit == STRONG] for p in POSES}
    theirs = {p: [f for j, f in found.items() if j.pose == p and j.published] for p in POSES}
    needed = {pose: loaded.gravity_torque(goal) for pose, goal in POSES.items()}
    can = [pose for pose in POSES if float(np.abs(needed[pose]).max()) <= LIMIT]

    rows = [_goal_row(pose, pose in can, needed[pose], ours[pose], theirs[pose]) for pose in POSES]
    rows += [_time_row(pose, ours[pose], theirs[pose]) for pose in POSES]
    rows += _fourth_rows(ours, strong, theirs, "goal" in can)
    notes = [
        f"{seeds} seeds per pose; gains, torque limit and noise as published. Ours: inverse dynamics of the "
        "arm with what "
        "it is found to hold (default filter), on the filter's state.",
        f"The limit of {LIMIT} N m allows {len(can)} of {len(POSES)} poses: {', '.join(can)}.",
    ]
    return rows, _figures.drawn(lambda: _draw(found)), notes


def _goal_row(pose: str, allowed: bool, needed: Array, ours: Sequence[Found], theirs: Sequence[Found]) -> Row:
    goal = POSES[pose]
    heaviest = int(np.abs(needed).argmax())
    off, where = _off(ours, goal)
    before, published = _off(theirs, goal)
    note = f"needs {abs(needed[heaviest]):.2f} N m at joint {heaviest + 1} to stay there"
    note += "" if allowed else f", beyond the limit of {LIMIT} N m"
    note += f"; joint {where + 1} is off the most; published controller: {before:.3f} rad off at joint "
    note += f"{published + 1}"
    what = f"pose {pose}: goal missed by, worst joint and run"
    return at_most(what, REACHED, off, "rad", note) if allowed else told(what, off, "rad", note)


def _time_row(pose: str, ours: Sequence[Found], theirs: Sequence[Found]) -> Row:
    note = f"at rest within 0.01 rad of where it ends: {_median(ours, 'rested'):.2f} s, "
    note += f"published controller {_median(theirs, 'rested'):.2f} s"
    if not any(math.isfinite(f.reached) for f in theirs):
        note += ", which never reaches the goal"
    return told(
        f"pose {pose}: within 0.01 rad of the goal for good, median", _median(ours, "reached"), "s", note
    )


def _fourth_rows(
    ours: Mapping[str, Sequence[Found]],
    strong: Mapping[str, Sequence[Found]],
    theirs: Mapping[str, Sequence[Found]],
    allowed: bool,
) -> list[Row]:
    end, before, stronger = (
        float(np.mean([f.end[FOURTH] for f in group["goal"]])) for group in (ours, theirs, strong)
    )
    missed = {pose: _off(strong[pose], goal)[0] for pose, goal in POSES.items()}
    worst = max(missed, key=lambda pose: missed[pose])
    note = f"published 0.55; with the published controller here {before:.3f}"
    note += "" if allowed else "; the torque limit does not allow this goal"
    what = f"with a torque limit of {STRONG:g} N m: goal missed by, worst pose, joint and run"
    reached = _median(strong["goal"], "reached")
    return [
        near(
            "published goal: joint 4 ends at",
            POSES["goal"][FOURTH],
            end,
            REACHED,
            "rad",
            note,
            judged=allowed,
        ),
        told(
            what,
            missed[worst],
            "rad",
            f"pose {worst}; published goal: joint 4 ends at {stronger:.3f}, goal reached after {reached:.2f} s",
        ),
    ]


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
