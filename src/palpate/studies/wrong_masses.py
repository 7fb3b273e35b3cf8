"""The arm's links do not weigh what the model says: twenty seconds of motion with an empty hand correct it."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from .._core import ExtendedKalman, PayloadFilter
from ..arm import Arm, Array
from ..control import Quintic, Setpoint
from ..pipeline import Pipeline, tare
from . import Progress, Row, _bench, _figures
from ._bench import MASS, POSES, TWO_PERCENT, FeedbackLaw, PublishedLaw, Work, late_percent, rms, settled
from ._rows import at_most, told

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WRONG = 0.2
"""how wrong each link's mass and inertia are, relative [1]"""
RANDOM = 10
WAY = ("Take3", "StandBy", "Take4", "goal", "Take2")
"""of the tare, from the hanging arm"""
LEG, REST = 3.5, 0.5
"""[s]; five legs and rests are 20 s"""


@dataclass(frozen=True, slots=True)
class Job:
    """One arm, in every pose."""

    name: str
    factors: tuple[float, ...]
    """true over modelled masses [1]"""
    seed: int
    poses: tuple[str, ...]


class Found(NamedTuple):
    """What came of an arm."""

    job: Job
    factors: Array
    """(n,) by the tare"""
    std: Array
    time: Array
    errors: dict[tuple[str, str], Array]
    """(N,) [kg] by pose and filter"""
    changes: dict[str, int]
    """false load changes by filter"""
    wrong: dict[str, float]
    """share of samples marked ok and more than 10 % wrong, by filter"""


TARED, TARED_ONLY, UNTARED = "after the tare", "after the tare, mass only", "without tare"


def tour(arm: Arm, factors: Sequence[float], seed: int) -> Any:
    """The log of the tare's motion: 20 s, nothing held, moved by what is believed of the arm."""
    goals = [np.zeros(arm.n), *(np.array(POSES[name]) for name in WAY)]
    legs = [Quintic(a, b, LEG) for a, b in itertools.pairwise(goals)]

    def setpoint(t: float) -> Setpoint:
        k = min(int(t / (LEG + REST)), len(legs) - 1)
        return legs[k].sample(t - k * (LEG + REST))

    law = FeedbackLaw(Pipeline(arm, observer=ExtendedKalman(), payload=None))
    seconds = len(legs) * (LEG + REST)
    return _bench.simulate(_bench.scaled(arm, factors), law, setpoint, seconds=seconds, seed=seed).log()


def measure(job: Job) -> Found:
    """Run one job."""
    model = _bench.reference_arm()
    true = _bench.scaled(model, job.factors)
    found = tare(model, tour(model, job.factors, 1000 + job.seed))
    filters = {
        TARED: Pipeline(found.arm),
        TARED_ONLY: Pipeline(found.arm, payload=PayloadFilter()),
        UNTARED: Pipeline(model),
    }
    errors: dict[tuple[str, str], Array] = {}
    changes, wrong = dict.fromkeys(filters, 0), dict.fromkeys(filters, 0.0)
    for pose in job.poses:
        motion = _bench.simulate(true, PublishedLaw(model), POSES[pose], load=_bench.brick(), seed=job.seed)
        for name, pipeline in filters.items():
            payload = motion.weigh(pipeline).payload
            errors[pose, name] = payload.mass - MASS
            changes[name] += int(payload.changes[-1])
            wrong[name] += _bench.trusted(payload, MASS) / len(job.poses)
    return Found(job, found.factors, found.std, motion.time, errors, changes, wrong)


def run(progress: Progress, quick: bool) -> tuple[list[Row], Mapping[str, Figure], list[str]]:
    """Measure; `quick` with two random arms and three poses."""
    n = _bench.reference_arm().n
    rng = np.random.default_rng(0)
    poses = ("StandBy", "Take3", "goal") if quick else tuple(POSES)
    cases = {"all 20 % lighter": np.full(n, 1.0 - WRONG), "all 20 % heavier": np.full(n, 1.0 + WRONG)}
    for k in range(2 if quick else RANDOM):
        cases[f"random {k + 1}"] = rng.uniform(1.0 - WRONG, 1.0 + WRONG, n)
    jobs = [Job(name, tuple(f.tolist()), seed, poses) for seed, (name, f) in enumerate(cases.items())]
    with Work(progress, len(jobs)) as work:
        found = work.map(measure, jobs)

    rows = []
    for name in (TARED, TARED_ONLY, UNTARED):
        each = _percents(found, name)
        times = [settled(f.time, f.errors[p, name], TWO_PERCENT) for f in found for p in poses]
        wrong = 100.0 * float(np.mean([f.wrong[name] for f in found]))
        note = f"{each.size} runs, median {np.median(each):.3f} %; within 2 % for good: median "
        note += f"{np.median(times):.2f} s, "
        note += f"worst {max(times):.2f} s; false load changes: {sum(f.changes[name] for f in found)}; "
        note += f"samples marked ok and more than 10 % wrong: {wrong:.1f} %"
        what = f"{name}: RMS error over the last 5 s, worst run"
        rows.append(at_most(what, 2.0, float(each.max()), "%", note, judged=name != UNTARED))
    off = np.array([f.factors - np.array(f.job.factors) for f in found])
    std = np.array([f.std for f in found])
    note = f"RMS {100.0 * rms(off):.2f} %; RMS of error / std {rms(off / std):.2f}"
    rows.append(told("tare: a link's mass, largest error", float(100.0 * np.abs(off).max()), "%", note))
    for f in found:
        tared, only, untared = (_percents([f], name).max() for name in (TARED, TARED_ONLY, UNTARED))
        note = f"mass only {only:.3f} %; without tare {untared:.1f} %"
        rows.append(told(f"{f.job.name}: worst RMS error over the last 5 s", float(tared), "%", note))
    notes = [
        "Masses and inertias of the true links differ from the model's; centres of mass are right. Tare: 20 s "
        "through "
        "five poses with an empty hand, controlled by an extended Kalman filter on the wrong model; then the "
        "published "
        "bench and controller, which still believes in the wrong masses.",
    ]
    return rows, _figures.drawn(lambda: _draw(found)), notes


def _percents(found: Sequence[Found], name: str) -> Array:
    return np.array(
        [late_percent(f.time, e) for f in found for (_, filtered), e in f.errors.items() if filtered == name]
    )


def _draw(found: Sequence[Found]) -> dict[str, Any]:
    time = found[0].time
    kept = time >= 0.5
    curves = {}
    for name in (TARED, TARED_ONLY, UNTARED):
        each = [e for f in found for (_, filtered), e in f.errors.items() if filtered == name]
        curves[name] = (time[kept], 100.0 * np.sqrt(np.mean(np.square(each), axis=0))[kept] / MASS)
    return {
        "RMS error of the mass over all runs": _figures.curves(
            curves, "error [%]", log=True, level=(2.0, "2 %"), limits=(0.0, time[-1], 1e-2, 1e3)
        )
    }
