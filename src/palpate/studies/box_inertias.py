"""The same arm with inertias a body can have: what still weighs, and what says that it cannot."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from .._core import (
    Conditioner,
    JointFormula,
    MomentumObserver,
    MomentumSuperTwisting,
    Regression,
    SlidingModeObserver,
    Status,
)
from ..arm import Arm, Array
from ..pipeline import Pipeline
from . import Progress, Row, _bench, _bound, _figures, payload_filter
from ._bench import (
    DEFAULT,
    KD,
    MASS,
    MASS_ONLY,
    POSES,
    FeedbackLaw,
    Law,
    PublishedLaw,
    Work,
    last,
    late_percent,
    rms,
    settled,
)
from ._rows import at_most, told
from .payload_filter import Found

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ARM = "justina_left_arm_box"
SEEDS = 20
SOFT = 0.1
"""part of the published damping gains that these light links bear at 250 Hz"""
BANDWIDTH = 5.0
"""of the momentum observer [rad/s]: the differentiated 12-bit position is mostly noise above"""
POINTS = 16
"""of the slope that makes velocity from positions"""
MAX_RATE = 5.0
"""of the super-twisting observer [N m/s]"""
SUBSTEPS = 4
"""of the bound: friction here settles within a millisecond"""
SLIDING = "sliding mode as published"
OBSERVERS = (
    "momentum observer, regression",
    "momentum observer, joint formula",
    "super-twisting, regression",
    "super-twisting, joint formula",
)
UNSMOOTHED = OBSERVERS[-1]
"""nothing averages its noise: for information only"""


@dataclass(frozen=True, slots=True)
class Job:
    """One run; `gains`: with what damping, and by which controller."""

    pose: str
    seed: int
    gains: str = "soft"
    """"soft": a tenth of the published damping; "stiff": all of it; "published": the published controller"""
    bound: bool = False


class Light(NamedTuple):
    """A run on the light arm."""

    found: Found
    shares: dict[str, float]
    """share of samples with status ok, by estimator, after 2 s"""
    errors: dict[str, Array]
    """(N,) [kg] by estimator"""
    saturated: float
    """share of samples at which the sliding-mode observer says so, after 2 s"""
    needed: float
    """sup |M^-1 tau_ext|: the least alpha that would do [rad/s^2]"""
    speed: float
    """RMS of ||dq|| over the last seconds [rad/s]"""
    limited: float
    """share of torques at their limit over the last seconds"""


def estimators(arm: Arm) -> dict[str, Pipeline]:
    """Observers with their estimators, by name."""
    smooth = Conditioner(points=POINTS)
    sliding = Pipeline(_bench.as_published(arm), observer=SlidingModeObserver(), payload=JointFormula())
    observers = (MomentumObserver(bandwidth=BANDWIDTH), MomentumSuperTwisting(max_rate=MAX_RATE))
    made = [
        Pipeline(arm, observer=observer, payload=estimator, conditioner=smooth)
        for observer in observers
        for estimator in (Regression(), JointFormula())
    ]
    return {SLIDING: sliding, **dict(zip(OBSERVERS, made, strict=True))}


def measure(job: Job) -> Light:
    """Run one job."""
    arm = _bench.reference_arm(ARM)
    load = _bench.brick()
    kd = tuple((SOFT if job.gains == "soft" else 1.0) * k for k in KD)
    law: Law = PublishedLaw(arm) if job.gains == "published" else FeedbackLaw(Pipeline(arm), kd=kd)
    motion = _bench.simulate(arm, law, POSES[job.pose], load=load, seed=job.seed)
    late = last(motion.time)
    speed = rms(np.linalg.norm(motion.dq[late], axis=1))
    limited = float(np.mean(np.abs(motion.asked[late]) >= _bench.LIMIT * (1.0 - 1e-9)))
    if job.gains != "soft":
        return Light(Found(motion.time, math.nan, {}, None, math.nan, {}), {}, {}, 0.0, 0.0, speed, limited)

    filters = {n: payload_filter.weighed(motion, p) for n, p in _bench.payload_filters(arm).items()}
    bounds = {}
    if job.bound:
        prior = float(filters[MASS_ONLY].std[0])
        bounds = payload_filter.bounds(arm, motion, prior, substeps=SUBSTEPS)
    errors, shares, saturated = {}, {}, 0.0
    judged = motion.time >= 2.0 - 1e-9
    for name, pipeline in estimators(arm).items():
        touch = motion.weigh(pipeline)
        errors[name] = touch.payload.mass - MASS
        shares[name] = float(np.mean(touch.payload.status[judged] == int(Status.ok)))
        if name == SLIDING:
            saturated = float(np.mean(touch.external.status[judged] == int(Status.saturated)))
    # gravity's part of tau_ext; what the object's inertia adds comes on top
    pull = _bound.holding(arm, load).gravity_torque(motion.q) - arm.gravity_torque(motion.q)
    needed = np.abs(np.linalg.solve(arm.mass_matrix(motion.q), pull[..., None])).max()
    found = Found(motion.time, motion.stopped(), filters, None, math.nan, bounds)
    return Light(found, shares, errors, saturated, float(needed), speed, limited)


def run(progress: Progress, quick: bool) -> tuple[list[Row], Mapping[str, Figure], list[str]]:
    """Measure; `quick` with one seed."""
    seeds = 1 if quick else SEEDS
    jobs = [Job(pose, seed, bound=seed == 0) for pose in POSES for seed in range(seeds)]
    hard = [Job(pose, 0, gains) for gains in ("stiff", "published") for pose in POSES]
    with Work(progress, len(jobs) + len(hard)) as work:
        light = work.map(measure, [*jobs, *hard])
    soft, shaking = light[: len(jobs)], light[len(jobs) :]
    by_pose = {pose: [x.found for x in group] for pose, group in _bench.by_pose(soft, jobs).items()}
    runs = [x.found for x in soft]

    rows = [*_gain_rows(soft, hard, shaking), *_sliding_rows(soft), *_observer_rows(soft)]
    rows += [
        *payload_filter.time_rows(runs, MASS_ONLY, judged=True),
        *payload_filter.accuracy_rows(runs, MASS_ONLY, judged=True),
        *payload_filter.honesty_rows(runs, MASS_ONLY, judged=True),
        *payload_filter.bound_rows(by_pose, MASS_ONLY),
        *payload_filter.time_rows(runs, DEFAULT),
        *payload_filter.accuracy_rows(runs, DEFAULT),
        *payload_filter.honesty_rows(runs, DEFAULT),
    ]
    notes = [
        f"{len(POSES)} poses x {seeds} seeds from hanging; encoders, torque steps and rate as on the published "
        "bench, inertias "
        "of uniform boxes. Controller: inverse dynamics with the load fed back (default filter), "
        f"{SOFT:g} x the published damping gains.",
        f"Momentum observer: {BANDWIDTH:g} rad/s; super-twisting: {MAX_RATE:g} N m/s; both with velocities of "
        "a slope over "
        f"{POINTS} samples ({4 * POINTS} ms), since one 12-bit count in 4 ms is 0.38 rad/s.",
        "alpha must exceed sup |M^-1 tau_ext|, here of the load's weight alone.",
        "The filters take the object for a point; it is a brick.",
    ]
    return rows, _figures.drawn(lambda: _draw(soft, by_pose)), notes


def _gain_rows(soft: Sequence[Light], hard: Sequence[Job], shaking: Sequence[Light]) -> list[Row]:
    calm = max(x.speed for x in soft)
    rows = []
    for gains, text in (("stiff", "load fed back"), ("published", "published controller")):
        group = [x for x, job in zip(shaking, hard, strict=True) if job.gains == gains]
        limited = 100.0 * float(np.mean([x.limited for x in group]))
        note = (
            f"shakiest {max(x.speed for x in group):.2f}; {limited:.0f} % of torques at their limit; with a "
        )
        note += "tenth of "
        note += f"the damping at most {calm:.3f} rad/s"
        what = f"published damping gains, {text}: joint speed that remains, calmest pose"
        rows.append(told(what, min(x.speed for x in group), "rad/s", note))
    return rows


def _sliding_rows(soft: Sequence[Light]) -> list[Row]:
    least = 100.0 * min(x.saturated for x in soft)
    trusted = 100.0 * max(x.shares[SLIDING] for x in soft)
    late = [late_percent(x.found.time, x.errors[SLIDING]) for x in soft]
    needed = [x.needed for x in soft]
    note = (
        f"run with the least; alpha 4.2, needed at least {min(needed):.0f} to {max(needed):.0f} rad/s^2, by "
    )
    note += "pose and run"
    wrong = f"RMS error of the mass over the last 5 s: {np.median(late):.0f} %, median of the runs"
    share = "% of samples"
    return [
        Row(f"{SLIDING}: says saturated, from 2 s on", "always", least, None, least >= 99.9, share, note),
        Row(f"{SLIDING}: mass marked ok", "never", trusted, None, trusted == 0.0, share, wrong),
    ]


def _observer_rows(soft: Sequence[Light]) -> list[Row]:
    rows = []
    for name in OBSERVERS:
        each = np.array([late_percent(x.found.time, x.errors[name]) for x in soft])
        mean = np.array([100.0 * abs(float(x.errors[name][last(x.found.time)].mean())) / MASS for x in soft])
        times = [settled(x.found.time, x.errors[name], 0.05 * MASS) for x in soft]
        ok = 100.0 * float(np.mean([x.shares[name] for x in soft]))
        note = f"median {np.median(each):.2f} %; mean over the 5 s: worst {mean.max():.2f} %; within 5 % for "
        note += "good: median "
        note += f"{np.median(times):.2f} s; status ok in {ok:.0f} % of samples"
        what = f"{name}: RMS error over the last 5 s, worst run"
        rows.append(at_most(what, 2.0, float(each.max()), "%", note, judged=name != UNSMOOTHED))
    return rows


def _draw(soft: Sequence[Light], by_pose: Mapping[str, Sequence[Found]]) -> dict[str, Any]:
    goal = soft[list(POSES).index("goal") * (len(soft) // len(POSES))]
    time = goal.found.time
    kept = time >= 0.1
    curves = {name: (time, 1e3 * (goal.errors[name] + MASS)) for name in (*OBSERVERS, SLIDING)}
    curves["payload filter"] = (time, 1e3 * (goal.found.filters[MASS_ONLY].error + MASS))

    def over(values: Sequence[Array]) -> tuple[Array, Array]:
        return time[kept], 1e3 * np.sqrt(np.mean(np.square(values), axis=0))[kept]

    runs = [f for group in by_pose.values() for f in group]
    bounds = [payload_filter.bound_of(group) for group in by_pose.values()]
    return {
        "One run to the published goal": _figures.curves(
            curves, "mass [g]", level=(1e3 * MASS, "true"), limits=(0.0, time[-1], -50.0, 400.0)
        ),
        "Standard deviation of the mass by the payload filter: stated, true, and least possible": _figures.curves(
            {
                "stated": over([f.filters[MASS_ONLY].std for f in runs]),
                "true RMS error": over([f.filters[MASS_ONLY].error for f in runs]),
                "Cramér-Rao bound": over([b["white"] for b in bounds]),
                "bound, rounding stays": over([b["rounding"] for b in bounds]),
            },
            "[g]",
            log=True,
            limits=(0.0, time[-1], 1e-3, 500.0),
        ),
    }
