"""The published test bench in simulation: arm, poses, controllers, noise, and how a run is measured.

Source of the figures: the mass-estimation report's Simulink model (RobotJustina/RCF-MathWorks-2020-14 @ c49314f).
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import get_context
from types import MappingProxyType, TracebackType
from typing import Any, Protocol, Self, TypeVar

import numpy as np
import numpy.typing as npt

from .. import robots
from .._core import PayloadFilter, PublishedKalman, PublishedKalmanFilter, Status
from ..arm import Arm, Array
from ..control import Controller, FeedforwardName, Quintic, Setpoint
from ..drivers.mujoco import MujocoDriver
from ..errors import PalpateError
from ..logs import Log, Sample
from ..pipeline import Payload, Pipeline, Touch
from ..simulate import Load, Schedule, SensorModel
from . import Progress

In = TypeVar("In")
Out = TypeVar("Out")

MASS = 0.25
"""of the object [kg]"""
MOVING = 3.0
"""duration of the motion to the pose [s]"""
SECONDS = 20.0
"""of a run [s]"""
NOISE_COUNTS = 2
"""encoder noise: whole counts, uniform from -2 to 2"""
KP = (5.0, 2.5, 2.5, 2.5, 2.5, 2.5, 2.5)
"""[N m/rad]"""
KD = (3.5, 1.0, 1.0, 1.5, 1.0, 1.0, 1.0)
"""[N m s/rad]"""
LIMIT = 2.5
"""of every torque [N m]"""
GRAVITY = 9.81
"""that the published observer and controller reckoned with [m/s^2]; the plant had 9.80665"""

POSES: Mapping[str, tuple[float, ...]] = MappingProxyType(
    {
        "StandBy": (-1.0, 0.0, 0.0, 1.5, 0.0, 0.9, 0.0),
        "StandBy2": (-0.5, 0.0, 0.0, 1.2, 0.0, 0.6, 0.0),
        "Take": (0.3, 0.0, 0.0, 0.5, 0.0, 0.7, 0.0),
        "Take2": (0.6, 0.0, 0.0, 0.4, 0.0, 0.6, 0.0),
        "Take3": (0.0, -0.5, 0.5, 1.0, 0.0, 1.0, -0.3),
        "Take4": (0.4, -0.1, 1.0, 0.8, 0.0, 0.7, -0.4),
        "goal": (0.5, -0.1, 1.0, 1.1, 0.0, 0.7, -0.4),
    }
)
"""the six useful predefined poses and the goal of the published run [rad]; the seventh, Zero, hangs"""

VELOCITY_PRIOR = 1.0
"""of the filters, one standard deviation at the start [rad/s]"""
TWO_PERCENT = 0.02 * MASS
"""[kg]"""
LAST = 5.0
"""at the end of a run, over which errors are averaged [s]"""
COVERED_FROM = 2.0
"""the interval is judged at every sample from then on [s]"""
INTERVAL = 1.959963984540054
"""half width of the 95 % interval in standard deviations"""
MASS_ONLY, DEFAULT = "mass only", "mass and first moment (default)"
"""the two payload filters under test"""


def brick(mass: float = MASS, offset: npt.ArrayLike = (0.0, 0.0, 0.0)) -> Load:
    """The published object: 70 x 70 mm, 10 000 kg/m^3, its centre `offset` (3,) [m] from the grasp point."""
    return Load.box(mass, (0.07, 0.07, mass / (10_000.0 * 0.07 * 0.07)), offset)


def scaled(arm: Arm, factors: npt.ArrayLike) -> Arm:
    """The arm with each link's mass and inertia times a factor, one or (n,)."""
    each = np.broadcast_to(np.asarray(factors, dtype=np.float64), (arm.n,))
    joints = tuple(
        j.replace(mass=j.mass * f, inertia=j.inertia * f)
        for j, f in zip(arm.joints, each.tolist(), strict=True)
    )
    return arm.replace(joints=joints)


def as_published(arm: Arm) -> Arm:
    """The arm as the published observer and controller knew it: gravity 9.81 m/s^2."""
    return arm.replace(gravity=arm.gravity * (GRAVITY / float(np.linalg.norm(arm.gravity))))


class Law(Protocol):
    """A controller together with the state estimate it uses."""

    def torque(self, sample: Sample, setpoint: Setpoint) -> Array:
        """The torque (n,) [N m] to ask for, from what was read now."""
        ...


class PublishedLaw:
    """PD + gravity of the setpoint for the bare arm, on the published Kalman filter's state."""

    def __init__(
        self, arm: Arm, *, kp: Sequence[float] = KP, kd: Sequence[float] = KD, limit: float = LIMIT
    ) -> None:
        known = as_published(arm)
        self._filter = PublishedKalmanFilter(known.core, PublishedKalman())
        self._controller = Controller(known, kp, kd, limit=limit, feedforward="reference_gravity")
        self._asked = np.zeros(arm.n)
        self._before: int | None = None

    def torque(self, sample: Sample, setpoint: Setpoint) -> Array:
        """See :class:`Law`. The filter is told the torque that was asked for, as published, not the one applied."""
        dt = 0.0 if self._before is None else (sample.time_ns - self._before) * 1e-9
        self._before = sample.time_ns
        q, dq = self.estimate(dt, sample.position)
        self._asked, _ = self._controller.step(setpoint, q, dq)
        return self._asked

    def estimate(self, dt: float, position: Array) -> tuple[Array, Array]:
        """The filter's state (q, dq) `dt` [s] after the one before."""
        q, dq = self._filter.step(dt, position, self._asked)
        return q, dq


class FeedbackLaw:
    """PD about the torque that the arm needs with what it is found to hold, on a pipeline's state.

    ``touches`` keeps (mass [kg], standard deviation [kg], changes, payload status) of every sample.
    """

    def __init__(
        self,
        pipeline: Pipeline,
        *,
        kp: Sequence[float] = KP,
        kd: Sequence[float] = KD,
        limit: float = LIMIT,
        feedforward: FeedforwardName = "inverse_dynamics",
    ) -> None:
        self._pipeline = pipeline
        self._controller = Controller(pipeline.arm, kp, kd, limit=limit, feedforward=feedforward)
        self.touches: list[tuple[float, float, int, int]] = []

    def torque(self, sample: Sample, setpoint: Setpoint) -> Array:
        """See :class:`Law`."""
        touch = self._pipeline.step(sample)
        held = touch.payload
        self.touches.append((held.mass, held.mass_std, int(held.changes), int(held.status)))
        torque, _ = self._controller.step(setpoint, touch.q, touch.dq, self._pipeline.load)
        return torque


@dataclass(frozen=True, slots=True)
class Motion:
    """A simulated run; arrays have one row per sample."""

    arm: Arm
    """the true one"""
    time: Array
    """(N,) [s]"""
    position: Array
    """(N, n) as read [rad]"""
    effort: Array
    """(N, n) torque applied in the period that ended at the sample, as read [N m]"""
    asked: Array
    """(N, n) torque the controller asked for in that period, before the drives rounded it [N m]"""
    q: Array
    """(N, n) truth [rad]"""
    dq: Array
    """(N, n) truth [rad/s]"""
    wanted: Array
    """(N, 2, n) setpoint [rad, rad/s]"""

    def log(self, *, asked: bool = False) -> Log:
        """What a recorder would have kept; `asked`: with the torque asked for instead of the one applied."""
        return Log(
            time_ns=np.rint(self.time * 1e9).astype(np.int64),
            position=self.position,
            effort=self.asked if asked else self.effort,
            joint_names=self.arm.joint_names,
        )

    def stopped(self, speed: float = 0.02) -> float:
        """When ||dq|| falls below `speed` [rad/s] for good [s]."""
        return settled(self.time, np.linalg.norm(self.dq, axis=1), speed)

    def weigh(self, pipeline: Pipeline, *, asked: bool = False) -> Touch:
        """What a fresh pipeline makes of the run."""
        pipeline.reset()
        return pipeline.run(self.log(asked=asked))


def simulate(
    arm: Arm,
    law: Law,
    goal: npt.ArrayLike | Callable[[float], Setpoint],
    *,
    start: npt.ArrayLike | None = None,
    load: Load | None = None,
    schedule: Schedule | None = None,
    seconds: float = SECONDS,
    seed: int = 0,
    sensor: SensorModel | None = None,
) -> Motion:
    """Move the simulated arm from rest at `start` to `goal` and hold it there.

    Args:
        arm: the true one; its drives round torques, its encoders read with 2 counts of noise.
        law: what moves it.
        goal: (n,) [rad], reached by a quintic in 3 s; or the setpoint by time [s].
        start: (n,) [rad]; None: zero, where Justina's arm hangs.
        load: held from the start.
        schedule: what happens on the way.
        seconds: how long [s].
        seed: of the noise.
        sensor: instead of the bench's own.
    """
    q0 = np.zeros(arm.n) if start is None else np.asarray(start, dtype=np.float64)
    setpoint = goal if callable(goal) else Quintic(q0, goal, MOVING).sample
    drives = sensor or SensorModel(arm, seed=seed, noise_counts=NOISE_COUNTS)
    driver = MujocoDriver(arm, payload=load, sensor=drives, schedule=schedule, q=q0)
    driver.connect()
    driver.enable()
    count = round(seconds * 1e9 / driver.period_ns) + 1
    samples = np.empty((count, 5, arm.n))
    wanted = np.empty((count, 2, arm.n))
    asked = np.zeros(arm.n)
    for k in range(count):
        sample = driver.read()
        assert sample is not None  # nothing is lost on this bench
        samples[k] = sample.position, sample.effort, asked, driver.plant.q, driver.plant.dq
        target = setpoint(k * driver.period_ns * 1e-9)
        wanted[k] = target.q, target.dq
        asked = law.torque(sample, target)
        driver.write(asked)
    times: Array = np.arange(count, dtype=np.float64) * (driver.period_ns * 1e-9)
    driver.close()
    position, effort, told, q, dq = (samples[:, i] for i in range(5))
    return Motion(arm, times, position, effort, told, q, dq, wanted)


def reference_arm(name: str = "justina_left_arm") -> Arm:
    """A reference arm by name."""
    return robots.load(name)


# --- measuring -------------------------------------------------------------------------------------------------------


def settled(time_s: Array, error: Array, bound: float) -> float:
    """From when on |error| stays at or below `bound` for good [s]; infinite if it is above at the end."""
    outside = np.flatnonzero(~(np.abs(error) <= bound))
    if not outside.size:
        return float(time_s[0])
    last = int(outside[-1])
    return float(time_s[last + 1]) if last + 1 < len(error) else math.inf


def rms(values: npt.ArrayLike) -> float:
    """Root of the mean square."""
    return math.sqrt(float(np.mean(np.square(values))))


def last(time_s: Array) -> npt.NDArray[np.bool_]:
    """Which samples lie in the last :data:`LAST` seconds."""
    return time_s > time_s[-1] - LAST


def late_percent(time_s: Array, error: Array) -> float:
    """RMS of `error` [kg] over the last seconds, in per cent of the object's mass."""
    return 100.0 * rms(error[last(time_s)]) / MASS


def trusted(payload: Payload, mass: float) -> float:
    """Share of the samples that are marked ok and more than 10 % of `mass` [kg] wrong."""
    return float(np.mean((payload.status == int(Status.ok)) & (np.abs(payload.mass - mass) > 0.1 * mass)))


def payload_filters(arm: Arm) -> dict[str, Pipeline]:
    """The filters under test by name."""
    return {MASS_ONLY: Pipeline(arm, payload=PayloadFilter()), DEFAULT: Pipeline(arm)}


# --- many runs -------------------------------------------------------------------------------------------------------


class Work:
    """Jobs spread over two processes, with word of how far they are. Results come in the order of the jobs.

    >>> with Work(progress, total=5) as work:  # doctest: +SKIP
    ...     first = work.map(measure, jobs)
    """

    def __init__(self, progress: Progress, total: int) -> None:
        self._progress, self._total = progress, total
        self._done = 0
        self._begin = time.perf_counter()
        self._workers = min(2, os.cpu_count() or 1)
        # spawn: the caller may have threads, which a fork would leave behind with their locks
        self._pool = (
            ProcessPoolExecutor(self._workers, mp_context=get_context("spawn"))
            if self._workers > 1 and total > 1
            else None
        )

    def map(
        self,
        function: Callable[[In], Out],
        jobs: Iterable[In],
        each: Callable[[int, Out], None] | None = None,
    ) -> list[Out]:
        """function(job) of every job; the function belongs to a module, jobs and results can be pickled.

        Args:
            each: told the number of a job and its result as soon as it is there, in no order.

        Raises:
            Exception: the first that a job raised; the jobs that have not begun are dropped.
            PalpateError: something killed one of the processes.
        """
        if self._pool is None:
            results = []
            for k, job in enumerate(jobs):
                results.append(function(job))
                if each is not None:
                    each(k, results[k])
                self._tick()
            return results
        try:
            futures: list[Future[Out]] = [self._pool.submit(function, job) for job in jobs]
            number = {future: k for k, future in enumerate(futures)}
            for future in as_completed(futures):
                result = future.result()
                if each is not None:
                    each(number[future], result)
                self._tick()
        except BrokenProcessPool:
            raise PalpateError(
                "a process of this study was killed from outside, perhaps for want of memory; run it again"
            ) from None
        return [future.result() for future in futures]

    def _tick(self) -> None:
        self._done += 1
        pace = (time.perf_counter() - self._begin) / self._done
        self._progress(self._done, self._total, pace * max(self._total - self._done, 0))

    def __enter__(self) -> Self:
        self._progress(0, self._total, math.inf)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)


def by_pose(results: Sequence[Any], jobs: Sequence[Any]) -> dict[str, list[Any]]:
    """Results grouped by their job's pose, in the order of :data:`POSES`."""
    return {name: [r for r, job in zip(results, jobs, strict=True) if job.pose == name] for name in POSES}
