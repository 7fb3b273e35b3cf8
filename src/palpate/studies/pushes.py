"""Somebody pushes on the arm while it weighs: is a wrong mass ever marked ok, and how soon is it right again?"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from .. import weigh
from .._core import ExtendedKalman, PayloadFilter, Status
from ..arm import Arm, Array
from ..drivers.mujoco import MujocoDriver
from ..logs import Log
from ..pipeline import Pipeline
from ..simulate import Attach, Push, ScenarioEvent, Schedule, SensorModel, StopPushing
from ..weigh.scenes import NOISE_COUNTS
from ..weigh.trial import Route, RouteControl
from . import Progress, Row, _figures
from ._bench import DEFAULT, INTERVAL, MASS_ONLY, Work
from ._rows import at_most, told

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ARMS: Mapping[str, float] = {"justina_left_arm": 0.25, "kuka_lbr_iiwa14": 4.0, "katana_450_6m90a": 0.3}
"""the heaviest object each is given [kg]"""
SEEDS = 40
FORCES = (0.5, 20.0)
"""[N]"""
LASTING = (0.5, 30.0)
"""[s]"""
AFTER = 5.0
"""watched after the push has ended [s]"""
BACK = 3.0
"""after a push it should be right again by then [s]"""
LEAST_LEVER = 0.06
"""of the load about the joint that feels it most [m]"""
HELD = 0.5
"""so long without a break it is then right [s]"""
WRONG = 3.0
"""a number is wrong that errs by more standard deviations than this"""
BANDS = (0.0, 10.0, 30.0, 60.0, 90.0)
"""between a push and the vertical, up or down [degree]"""


@dataclass(frozen=True, slots=True)
class Job:
    """One run."""

    arm: str
    seed: int


class Pushed(NamedTuple):
    """What was done to the arm."""

    arm: str
    mass: float
    """held all the time [kg]"""
    moving: bool
    begin: float
    """of the push [s]; 0: before the filter's first sample"""
    end: float
    force: float
    """[N]"""
    angle: float
    """to the vertical, up or down, 0 to 90 [degree]"""
    link: int
    """that was pushed, counted from 1"""
    grasp: bool
    """at the grasp point"""


class Seen(NamedTuple):
    """A run through the eyes of one filter."""

    pushed: Pushed
    filter: str
    time: Array
    error: Array
    """(N,) [kg]"""
    std: Array
    """(N,) [kg]"""
    ok: npt.NDArray[np.bool_]
    """(N,) whether the status was ok"""

    @property
    def during(self) -> npt.NDArray[np.bool_]:
        """(N,) whether it was pushed."""
        return (self.time >= self.pushed.begin) & (self.time < self.pushed.end)

    @property
    def wrong(self) -> npt.NDArray[np.bool_]:
        """(N,) whether it was ok and not right."""
        wrong: npt.NDArray[np.bool_] = self.ok & (np.abs(self.error) > WRONG * self.std)
        return wrong

    @property
    def back(self) -> float:
        """From the end of the push until the mass is ok and within 3 standard deviations, for HELD seconds [s]."""
        good = self.ok & (np.abs(self.error) <= WRONG * self.std)
        step = float(self.time[1] - self.time[0])
        held = round(HELD / step)
        after = np.convolve(good[self.time >= self.pushed.end], np.ones(held), "valid")
        right = np.flatnonzero(after > held - 0.5)
        return float(right[0]) * step if right.size else math.inf


def simulate(job: Job) -> tuple[Pushed, Arm, Log]:
    """An arm that holds something, at rest or in motion, is pushed; its controller knows what it holds and is exact.

    So the motion does not depend on what a filter makes of it.
    """
    heaviest = ARMS[job.arm]
    scene = weigh.scene(weigh.load_arm(job.arm), mass=heaviest)
    arm = scene.arm
    rng = np.random.default_rng([job.seed, list(ARMS).index(job.arm)])
    mass = heaviest * float(rng.uniform(0.2, 1.0))
    moving, early, at_grasp = (bool(rng.random() < p) for p in (0.5, 0.25, 0.5))
    start = _pose(scene, mass, rng)
    poses = tuple(_pose(scene, mass, rng) for _ in range(20)) if moving else (start,)
    begin = 0.0 if early else float(rng.uniform(3.0, 5.0))
    end = begin + float(np.exp(rng.uniform(*np.log(LASTING))))
    force = float(rng.uniform(*FORCES))
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    link = int(rng.integers(arm.n))
    grasp = at_grasp and link == arm.n - 1
    point = np.zeros(3) if grasp else rng.uniform(-0.05, 0.05, 3)
    down = float(direction @ arm.gravity) / float(np.linalg.norm(arm.gravity))
    angle = math.degrees(math.acos(min(abs(down), 1.0)))
    pushed = Pushed(job.arm, mass, moving, begin, end, force, angle, link + 1, grasp)

    task = weigh.Task(
        scene=scene, start=start, poses=poses, loads=((0.0, mass),), duration=end + AFTER, hold=1.0, move=2.0
    )
    route = Route(task)
    control = RouteControl(task, route)
    events: list[ScenarioEvent] = [
        Attach(0.0, mass),
        Push(begin, "grasp" if grasp else link, force * direction, point=point),
        StopPushing(end),
    ]
    sensor = SensorModel(arm, rate=task.rate, noise_counts=NOISE_COUNTS, seed=job.seed)
    driver = MujocoDriver(arm, sensor=sensor, schedule=Schedule(events), q=start)
    held = arm.core.load(mass, np.ascontiguousarray(arm.grasp))
    count = round(task.duration * task.rate)
    rows = np.empty((count, 2, arm.n))
    observer = Pipeline(arm, observer=ExtendedKalman(), payload=None)
    with driver:
        driver.enable()
        for k in range(count):
            sample = driver.read()
            assert sample is not None  # nothing is lost on this bench
            rows[k] = sample.position, sample.effort
            time = k / task.rate
            state = observer.step(sample)
            torque, _ = control.step(time, route.sample(time), state, held, 1.0 / task.rate)
            driver.write(torque)
    time_ns = np.rint(np.arange(count) * (1e9 / task.rate)).astype(np.int64)
    log = Log(time_ns=time_ns, position=rows[:, 0], effort=rows[:, 1], joint_names=arm.joint_names)
    return pushed, arm, log


def _pose(scene: weigh.Scene, mass: float, rng: np.random.Generator) -> Array:
    """A random pose in which the arm can hold the mass and feels it, (n,) [rad]."""
    arm = scene.arm
    lower = np.maximum([j.limits.lower + 0.2 for j in arm.joints], -1.2)
    upper = np.minimum([j.limits.upper - 0.2 for j in arm.joints], 1.2)
    effort = np.array([j.limits.effort for j in arm.joints])
    while True:
        q = rng.uniform(lower, upper)
        lever: Array = -arm.gravity @ arm.core.jacobian(q[None], arm.grasp)[0, :3]
        load = arm.gravity_torque(q) + mass * lever
        if np.max(np.abs(load) / effort) < 0.7 and np.max(np.abs(lever)) > LEAST_LEVER * np.linalg.norm(
            arm.gravity
        ):
            return q


def look(pushed: Pushed, arm: Arm, log: Log) -> list[Seen]:
    """What both filters make of a run."""
    seen = []
    for name, pipeline in ((MASS_ONLY, Pipeline(arm, payload=PayloadFilter())), (DEFAULT, Pipeline(arm))):
        payload = pipeline.run(log).payload
        time: Array = (log.time_ns - log.time_ns[0]) * 1e-9
        ok = payload.status == int(Status.ok)
        seen.append(Seen(pushed, name, time, payload.mass - pushed.mass, payload.mass_std, ok))
    return seen


def measure(job: Job) -> list[Seen]:
    """Run one job."""
    return look(*simulate(job))


def run(progress: Progress, quick: bool) -> tuple[list[Row], Mapping[str, Figure], list[str]]:
    """Measure; `quick` with 6 runs per arm."""
    seeds = 6 if quick else SEEDS
    jobs = [Job(arm, seed) for arm in ARMS for seed in range(seeds)]
    with Work(progress, len(jobs)) as work:
        seen = [s for found in work.map(measure, jobs) for s in found]
    rows = []
    for name in (DEFAULT, MASS_ONLY):
        mine = [s for s in seen if s.filter == name]
        for arm in ARMS:
            rows += _arm_rows([s for s in mine if s.pushed.arm == arm], f"{name}, {arm}")
        rows += _angle_rows(mine, name)
    notes = [
        f"{seeds} runs per arm: a point mass of 20 to 100 % of "
        + ", ".join(f"{mass:g} kg ({arm})" for arm, mass in ARMS.items())
        + f"; a random link, place within 5 cm and direction, {FORCES[0]:g} to {FORCES[1]:g} N, "
        f"{LASTING[0]:g} to {LASTING[1]:g} s; half of the arms move all the time, a quarter is pushed from before "
        "the filter's first sample. The controller knows the mass and has its state from an extended Kalman "
        "observer, so the motion does not depend on what is weighed. 12- and 16-bit encoders with -2..2 counts of "
        "noise, torques rounded, 250 Hz.",
        f"Right: ok, and within {WRONG:g} stated standard deviations of the truth. Wrong: ok, and not so. "
        f"Back: from the end of the push until it has been right for {HELD:g} s; each run ends {AFTER:g} s after "
        "its push.",
    ]
    return rows, _figures.drawn(lambda: _draw(seen)), notes


def _share(part: Sequence[npt.NDArray[np.bool_]], whole: Sequence[npt.NDArray[np.bool_]]) -> float:
    """Per cent of the samples of `whole` that are in `part` too."""
    count = sum(int(w.sum()) for w in whole)
    return 100.0 * sum(int((p & w).sum()) for p, w in zip(part, whole, strict=True)) / count if count else 0.0


def _arm_rows(group: Sequence[Seen], name: str) -> list[Row]:
    every = [np.ones_like(s.ok) for s in group]
    ok, during = [s.ok for s in group], [s.during for s in group]
    before = [s.time < s.pushed.begin for s in group]
    after = [s.time >= s.pushed.end for s in group]
    inside = [np.abs(s.error) <= INTERVAL * s.std for s in group]
    wrong = [s.wrong for s in group]

    def both(
        a: Sequence[npt.NDArray[np.bool_]], b: Sequence[npt.NDArray[np.bool_]]
    ) -> list[npt.NDArray[np.bool_]]:
        return [x & y for x, y in zip(a, b, strict=True)]

    covered = _share(inside, ok)
    note = ", ".join(
        f"{what} {_share(inside, both(ok, when)):.1f}"
        for what, when in (("before the push", before), ("during", during), ("after", after))
    )
    back = np.array([s.back for s in group])
    late = f"above: {int(np.sum(back > BACK))} of {len(back)}; median {np.median(back):.2f} s"
    marked = f"marked ok during a push: {_share(ok, during):.1f} %, before {_share(ok, before):.1f} %"
    return [
        Row(
            f"{name}: 95 % interval holds the truth while ok",
            ">= 90",
            covered,
            None,
            covered >= 90.0,
            "%",
            note,
        ),
        at_most(f"{name}: wrong, of all samples", 1.0, _share(wrong, every), "%", marked),
        told(f"{name}: wrong, of the samples during a push", _share(wrong, during), "%"),
        at_most(
            f"{name}: back after a push, nine of ten runs",
            BACK,
            float(np.quantile(back, 0.9, method="higher")),
            "s",
            late,
        ),
    ]


def _angle_rows(seen: Sequence[Seen], name: str) -> list[Row]:
    rows = []
    for low, high in itertools.pairwise(BANDS):
        group = [s for s in seen if low <= s.pushed.angle < high]
        during = [s.during for s in group]
        share = _share([s.wrong for s in group], during) if group else math.nan
        note = (
            f"{len(group)} runs; ok {_share([s.ok for s in group], during):.1f} %" if group else "no such run"
        )
        what = f"{name}: wrong during a push at {low:g} to {high:g} degrees to the vertical"
        rows.append(told(what, share if group else "-", "%", note))
    return rows


def _draw(seen: Sequence[Seen]) -> dict[str, Any]:
    back = {}
    for name in (DEFAULT, MASS_ONLY):
        for arm in ARMS:
            values = np.sort([s.back for s in seen if s.filter == name and s.pushed.arm == arm])
            back[f"{arm}, {name}"] = (values, np.linspace(0.0, 1.0, len(values)))
    return {
        "How long it takes after a push until the mass is right again, sorted": _figures.curves(
            back, "share of runs", across="time after the push [s]", limits=(0.0, AFTER, 0.0, 1.02)
        )
    }
