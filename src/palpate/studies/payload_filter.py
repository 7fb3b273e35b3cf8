"""The payload Kalman filter on the published bench: how fast, how exact, how honest, how near to what is "
"possible."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from .._core import JointFormula, SlidingModeObserver
from ..arm import Arm, Array
from ..pipeline import Pipeline
from . import Progress, Row, _bench, _bound, _figures
from ._bench import (
    COVERED_FROM,
    DEFAULT,
    INTERVAL,
    MASS,
    MASS_ONLY,
    POSES,
    TWO_PERCENT,
    FeedbackLaw,
    Motion,
    PublishedLaw,
    Work,
    rms,
    settled,
)
from ._rows import at_most, told

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SEEDS = 20
RESTED = 12.0
"""when a filter is started on the arm at rest [s]"""
SHORT = 8.0
"""of a run that starts in the pose [s]"""

KINDS = {"white": "bound", "rounding": "bound with rounding that stays"}
"""Cramér-Rao bounds by the encoders' rounding: as white noise, or an error that stays while a joint stands"""
ASKED = "mass only, told the unrounded torque"


@dataclass(frozen=True, slots=True)
class Job:
    """One run."""

    pose: str
    seed: int
    start: str = "hanging"
    """"hanging": zero pose, published controller; "pose": in the pose, published; "held": in the pose, fed "
    "back"""
    bound: bool = False


class Weighed(NamedTuple):
    """What one filter made of one run."""

    error: Array
    """(N,) [kg]"""
    std: Array
    """(N,) [kg]"""
    changes: int
    """grasps and releases it saw; there were none"""

    def within(self, time: Array) -> float:
        """From when on the error stays within 2 % [s]."""
        return settled(time, self.error, TWO_PERCENT)


class Found(NamedTuple):
    """A run."""

    time: Array
    stopped: float
    filters: dict[str, Weighed]
    published: Array | None
    """(N,) mass by the published method [kg]"""
    rested: float
    """time to 2 % of a filter started on the arm at rest, after its start [s]"""
    bound: dict[str, Array]
    """bounds of the standard deviation by name, (N,) [kg]"""


def weighed(motion: Motion, pipeline: Pipeline, *, asked: bool = False) -> Weighed:
    """A fresh pipeline over the run."""
    payload = motion.weigh(pipeline, asked=asked).payload
    return Weighed(payload.mass - MASS, payload.mass_std, int(payload.changes[-1]))


def bounds(arm: Arm, motion: Motion, prior: float, *, substeps: int = 1) -> dict[str, Array]:
    """Cramér-Rao bounds along a run, by name; `prior` of the mass [kg]."""
    count = np.array([j.sensing.position_resolution for j in arm.joints])
    noise = np.array([j.sensing.position_std for j in arm.joints])
    F = _bound.transitions(
        arm, _bench.brick(), motion.q, motion.dq, motion.effort, motion.time[1], substeps=substeps
    )
    white = np.sqrt(noise**2 + count**2 / 12.0)
    return {
        "white": _bound.mass_std(F, white, prior, _bench.VELOCITY_PRIOR),
        "rounding": _bound.mass_std(F, noise, prior, _bench.VELOCITY_PRIOR, count=count, q=motion.q),
    }


def measure(job: Job) -> Found:
    """Run one job."""
    arm = _bench.reference_arm()
    filters = _bench.payload_filters(arm)
    goal = POSES[job.pose]
    if job.start != "hanging":
        law: Any = PublishedLaw(arm) if job.start == "pose" else FeedbackLaw(Pipeline(arm))
        motion = _bench.simulate(
            arm, law, goal, start=goal, load=_bench.brick(), seed=job.seed, seconds=SHORT
        )
        return Found(
            motion.time, math.nan, {k: weighed(motion, p) for k, p in filters.items()}, None, math.nan, {}
        )
    motion = _bench.simulate(arm, PublishedLaw(arm), goal, load=_bench.brick(), seed=job.seed)
    results = {name: weighed(motion, p) for name, p in filters.items()}
    results[ASKED] = weighed(motion, filters[MASS_ONLY], asked=True)
    late = int(np.searchsorted(motion.time, RESTED - 1e-9))
    filters[MASS_ONLY].reset()
    rested = filters[MASS_ONLY].run(motion.log()[late:]).payload.mass - MASS
    published = Pipeline(
        _bench.as_published(arm),
        observer=SlidingModeObserver(friction=False, solver="rk4", substeps=2),
        payload=JointFormula(joint=5, lever=0.205),  # the true lever: nothing but the method is compared
    )
    return Found(
        motion.time,
        motion.stopped(),
        results,
        motion.weigh(published, asked=True).payload.mass,
        settled(motion.time[late:], rested, TWO_PERCENT) - RESTED,
        bounds(arm, motion, float(results[MASS_ONLY].std[0])) if job.bound else {},
    )


def run(progress: Progress, quick: bool) -> tuple[list[Row], Mapping[str, Figure], list[str]]:
    """Measure; `quick` with 2 seeds."""
    seeds = 2 if quick else SEEDS
    hanging = [Job(pose, seed, bound=seed == 0) for pose in POSES for seed in range(seeds)]
    stretched = [
        Job(pose, seed, start) for start in ("pose", "held") for pose in POSES for seed in range(seeds)
    ]
    with Work(progress, len(hanging) + len(stretched)) as work:
        found = work.map(measure, [*hanging, *stretched])
    runs = found[: len(hanging)]
    by_start = {
        start: [f for f, j in zip(found[len(hanging) :], stretched, strict=True) if j.start == start]
        for start in ("pose", "held")
    }
    by_pose = _bench.by_pose(runs, hanging)
    rows = [
        *time_rows(runs, MASS_ONLY, judged=True),
        *_stopped_rows(runs),
        *_stretched_rows(runs, by_start),
        *accuracy_rows(runs, MASS_ONLY, judged=True),
        *honesty_rows(runs, MASS_ONLY, judged=True),
        *bound_rows(by_pose, MASS_ONLY),
    ]
    for name in (DEFAULT, ASKED):
        rows += [*time_rows(runs, name), *accuracy_rows(runs, name), *honesty_rows(runs, name)]
    rows += _pose_rows(by_pose)
    notes = [
        f"{len(POSES)} poses x {seeds} seeds; 12-bit encoders with -2..2 counts of noise, torque in 1023 "
        "steps, 250 Hz, "
        f"{_bench.SECONDS:g} s, published controller. Every number from the estimate itself, whatever its "
        "status.",
        "The filter is told the torque that was applied (write() returns it); rows 'told the unrounded torque' "
        "give it the "
        "one that was asked for, as the published observer had it.",
        f"Coverage: every sample from {COVERED_FROM:g} s on, all runs pooled. Samples of one run are strongly "
        "correlated.",
        "Bound (Cramér-Rao): information along the true trajectory, exact sensitivities, white noise of the "
        "encoders' whole "
        "variance, no other error. The bound of the time is the median of an efficient estimator, whose error "
        "is a Brownian "
        "motion in its own variance. 'Rounding that stays': the encoder's rounding is an error that stays "
        "while a joint "
        "stands, which no averaging removes, and is another after a fifth of a count.",
        f"The arm has stopped when ||dq|| stays below 0.02 rad/s; the planned motion ends at {_bench.MOVING:g} "
        "s.",
    ]
    return rows, _figures.drawn(lambda: _draw(runs, by_pose)), notes


# --- rows ------------------------------------------------------------------------------------------------------------


def time_rows(runs: Sequence[Found], name: str, *, judged: bool = False) -> list[Row]:
    """Time until within 2 % for good."""
    times = np.array([f.filters[name].within(f.time) for f in runs])
    seen = sum(f.filters[name].changes for f in runs)
    note = f"{len(runs)} runs; load changes seen, though there was none: {seen}"
    return [
        at_most(f"{name}: within 2 % for good, median", 2.2, float(np.median(times)), "s", judged=judged),
        at_most(f"{name}: within 2 % for good, worst", 2.6, float(times.max()), "s", note, judged=judged),
    ]


def _stopped_rows(runs: Sequence[Found]) -> list[Row]:
    margin = np.array([f.stopped - f.filters[MASS_ONLY].within(f.time) for f in runs])
    stopped = np.array([f.stopped for f in runs])
    published = np.array(
        [settled(f.time, f.published - MASS, 0.05 * MASS) for f in runs if f.published is not None]
    )
    five = np.array([settled(f.time, f.filters[MASS_ONLY].error, 0.05 * MASS) for f in runs])
    least = float(margin.min())
    note = f"the arm stops at {stopped.min():.1f} to {stopped.max():.1f} s, median {np.median(stopped):.1f} s"
    beside = f"with the true lever; worst {published.max():.1f} s; the filter to 5 %: median "
    beside += f"{np.median(five):.2f} s, "
    beside += f"worst {five.max():.2f} s"
    return [
        Row("weighed so long before the arm stopped, least", "> 0", least, None, least > 0.0, "s", note),
        told(
            "published method: within 5 % for good, median",
            float(np.median(published)),
            "s",
            beside,
            beside="about 9",
        ),
    ]


def _stretched_rows(runs: Sequence[Found], by_start: Mapping[str, Sequence[Found]]) -> list[Row]:
    """Arm already stretched out: the published bench is judged to the worst run, what only helps to judge it "
    "is told."""
    rows = []
    texts = {
        "pose": "starts in the pose, published controller",
        "held": "starts in the pose, what is weighed fed back",
    }
    for start, text in texts.items():
        times = np.array([f.filters[MASS_ONLY].within(f.time) for f in by_start[start]])
        default = np.array([f.filters[DEFAULT].within(f.time) for f in by_start[start]])
        note = f"median {np.median(times):.2f} s; default filter: median {np.median(default):.2f}, "
        note += f"worst {default.max():.2f} s"
        what = f"{MASS_ONLY}: {text}: within 2 % for good, worst"
        rows.append(at_most(what, 1.0, float(times.max()), "s", note, judged=start == "pose"))
    rested = np.array([f.rested for f in runs])
    note = f"worst {rested.max():.2f} s; nothing moves but the noise"
    what = f"{MASS_ONLY}: started on an arm at rest: within 2 % for good, median"
    rows.append(at_most(what, 1.0, float(np.median(rested)), "s", note))
    return rows


def accuracy_rows(runs: Sequence[Found], name: str, *, judged: bool = False) -> list[Row]:
    """Error at the end."""
    each = np.array([rms(f.filters[name].error[_bench.last(f.time)]) for f in runs])
    note = f"all runs together {1e3 * rms(each):.3f} g"
    what = f"{name}: RMS error over the last 5 s, worst run"
    return [at_most(what, 0.3, 1e3 * float(each.max()), "g", note, judged=judged)]


def honesty_rows(runs: Sequence[Found], name: str, *, judged: bool = False) -> list[Row]:
    """Does the standard deviation tell the truth?"""
    error, std = _pooled(runs, name, COVERED_FROM)
    inside = 100.0 * float(np.mean(np.abs(error) <= INTERVAL * std))
    at = {t: _coverage(runs, name, t) for t in (2.0, 5.0, 10.0, 20.0)}
    note = "one sample per run, at " + ", ".join(f"{t:g} s: {c:.1f}" for t, c in at.items())
    ok = bool(90.0 <= inside <= 99.0) if judged else None
    rows = [Row(f"{name}: 95 % interval holds the truth", "90 to 99", inside, None, ok, "%", note)]
    error, std = _pooled(runs, name, 0.0)
    for top in (1e-1, 1e-2, 1e-3, 1e-4) if judged else ():
        chosen = (std < top) & (std >= 0.1 * top)
        if chosen.any():
            what = f"{name}: RMS of error / std while std is {100.0 * top:g} to {1e3 * top:g} g"
            note = f"{int(chosen.sum())} samples"
            rows.append(told(what, rms(error[chosen] / std[chosen]), "1", note, beside=1.0))
    return rows


def _pooled(runs: Sequence[Found], name: str, begin: float) -> tuple[Array, Array]:
    late = runs[0].time >= begin - 1e-9
    return (
        np.concatenate([f.filters[name].error[late] for f in runs]),
        np.concatenate([f.filters[name].std[late] for f in runs]),
    )


def _coverage(runs: Sequence[Found], name: str, second: float) -> float:
    k = int(np.searchsorted(runs[0].time, second - 1e-9))
    filters = [f.filters[name] for f in runs]
    return 100.0 * float(np.mean([abs(w.error[k]) <= INTERVAL * w.std[k] for w in filters]))


def bound_of(group: Sequence[Found]) -> dict[str, Array]:
    """The bounds of a pose: the noise hardly moves the trajectory, so one run's serve all seeds."""
    return next(f.bound for f in group if f.bound)


def pooled_bound_time(by_pose: Mapping[str, Sequence[Found]], bound: float) -> float:
    """Median over all poses of the time after which an efficient estimator stays within +-bound [kg], in "
    "[s]."""
    time = next(iter(by_pose.values()))[0].time
    share = np.mean(
        [_bound.still_inside(np.square(bound_of(g)["white"]), bound) for g in by_pose.values()], axis=0
    )
    settled_already = np.flatnonzero(share >= 0.5)
    return float(time[settled_already[0]]) if settled_already.size else math.inf


def bound_rows(by_pose: Mapping[str, Sequence[Found]], name: str) -> list[Row]:
    """How near to what is possible. Judged against the bound for white noise."""
    runs = [f for group in by_pose.values() for f in group]
    median = float(np.median([f.filters[name].within(f.time) for f in runs]))
    possible = pooled_bound_time(by_pose, TWO_PERCENT)
    note = f"{median:.2f} s, bound {possible:.2f} s"
    rows = [at_most(f"{name}: median time to 2 % over the bound", 1.5, median / possible, "1", note)]
    time, late = runs[0].time, runs[0].time >= COVERED_FROM - 1e-9
    end = _bench.last(time)
    error = rms([rms(f.filters[name].error[end]) for f in runs])
    for kind, text in KINDS.items():
        least = rms([rms(bound_of(g)[kind][end]) for g in by_pose.values()])
        note = f"{1e3 * error:.4f} g, bound {1e3 * least:.4f} g"
        what = f"{name}: RMS error over the last 5 s over the {text}"
        rows.append(at_most(what, 1.5, error / least, "1", note, judged=kind == "white"))
    for kind, text in KINDS.items():
        ratio = {
            pose: np.median([f.filters[name].std for f in group], axis=0) / bound_of(group)[kind]
            for pose, group in by_pose.items()
        }
        pose, worst = max(((p, float(r[late].max())) for p, r in ratio.items()), key=lambda x: x[1])
        when = float(time[late][int(np.argmax(ratio[pose][late]))])
        note = f"pose {pose} at {when:.1f} s; all poses at " + ", ".join(
            f"{t:g} s: {_at(ratio, time, t):.2f}" for t in (2.0, 5.0, 10.0, 20.0)
        )
        what = f"{name}: stated standard deviation over the {text}, largest from 2 s on"
        rows.append(at_most(what, 1.5, worst, "1", note, judged=kind == "white"))
    return rows


def _at(ratio: Mapping[str, Array], time: Array, second: float) -> float:
    return rms([r[int(np.searchsorted(time, second - 1e-9))] for r in ratio.values()])


def _pose_rows(by_pose: Mapping[str, Sequence[Found]]) -> list[Row]:
    rows = []
    for pose, group in by_pose.items():
        times = [f.filters[MASS_ONLY].within(f.time) for f in group]
        possible = _bound.settling_time(group[0].time, bound_of(group)["white"], TWO_PERCENT)
        median = float(np.median(times))
        note = f"worst {max(times):.2f}; bound {possible:.2f} s, ratio {median / possible:.2f}; "
        note += f"arm stops at {np.median([f.stopped for f in group]):.1f} s"
        rows.append(told(f"pose {pose}: {MASS_ONLY}: within 2 % for good, median", median, "s", note))
    return rows


# --- figures ---------------------------------------------------------------------------------------------------------


def _draw(runs: Sequence[Found], by_pose: Mapping[str, Sequence[Found]]) -> dict[str, Any]:
    from ..report import coverage_figure

    time = runs[0].time
    kept = time >= 0.2
    curves = {}
    for name, text in ((MASS_ONLY, "mass only"), (DEFAULT, "default")):
        curves[f"stated, {text}"] = (
            time[kept],
            1e3 * _over_runs(runs, lambda f, n=name: f.filters[n].std)[kept],
        )
        curves[f"true RMS error, {text}"] = (
            time[kept],
            1e3 * _over_runs(runs, lambda f, n=name: f.filters[n].error)[kept],
        )
    for kind, text in KINDS.items():
        each = np.array([bound_of(group)[kind] for group in by_pose.values()])
        curves[text] = (time[kept], 1e3 * np.sqrt(np.mean(np.square(each), axis=0))[kept])
    goal = by_pose["goal"][0]
    assert goal.published is not None
    mass, std = goal.filters[MASS_ONLY].error + MASS, goal.filters[MASS_ONLY].std
    figures = {
        "Standard deviation of the mass: stated, true, and least possible; all poses and seeds": _figures.curves(
            curves, "[g]", log=True, limits=(0.0, time[-1], 5e-3, 500.0)
        ),
        "One run to the published goal: payload filter with its 95 % band, and the published method": _figures.curves(
            {"payload filter": (time, 1e3 * mass), "published method": (time, 1e3 * goal.published)},
            "mass [g]",
            level=(1e3 * MASS, "true"),
            band=(time, 1e3 * (mass - INTERVAL * std), 1e3 * (mass + INTERVAL * std)),
            limits=(0.0, time[-1], 150.0, 420.0),
        ),
        "Time until within 2 % for good, sorted": _figures.curves(
            {
                pose: (
                    np.sort([f.filters[MASS_ONLY].within(time) for f in group]),
                    np.linspace(0.0, 1.0, len(group)),
                )
                for pose, group in by_pose.items()
            },
            "share of runs",
        ),
    }
    at = [int(np.searchsorted(time, t - 1e-9)) for t in (2.0, 5.0, 10.0, 20.0)]
    figures["Is the interval true? Every run at 2, 5, 10 and 20 s"] = coverage_figure(
        np.concatenate([f.filters[MASS_ONLY].error[at] for f in runs]),
        np.concatenate([f.filters[MASS_ONLY].std[at] for f in runs]),
    )
    return figures


def _over_runs(runs: Sequence[Found], pick: Any) -> Array:
    total: Array = np.zeros(len(runs[0].time))
    for f in runs:
        total = total + np.square(pick(f))
    return np.sqrt(total / len(runs))
