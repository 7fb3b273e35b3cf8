"""Somebody pushes on the arm while it weighs: is a wrong mass ever marked ok, and how soon is it right again?"""

from __future__ import annotations

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
from ..simulate import Attach, Push, Schedule, SensorModel, StopPushing
from ..weigh.scenes import NOISE_COUNTS
from ..weigh.session import Route, RouteControl
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
    events = [
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
        if np.max(np.abs(load) / effort) < 0.7 and np.max(np.abs(lever)) > LEAST_LEVER * np.linalg.norm(arm.gravity):
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
