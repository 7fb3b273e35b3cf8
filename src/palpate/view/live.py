"""A live arm on a page: its loop runs at the driver's rate in a thread of its own, the page only looks."""

from __future__ import annotations

import json
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import numpy.typing as npt

from .._core import (
    Conditioner,
    ContactDetector,
    DisturbanceKalman,
    ExtendedKalman,
    HeldLoad,
    Load,
    Status,
    WrenchEstimator,
)
from ..arm import Arm, Array
from ..control import Setpoint
from ..drivers.driver import Driver, Pace
from ..errors import DriverError, InputError, LogError, PalpateError
from ..logs import Recorder, Sample
from ..pipeline import Contact, Payload, Pipeline, Touch
from ..weigh import (
    Moment,
    Route,
    RouteControl,
    Scene,
    Task,
    brick,
    check_mass,
    describe_arm,
    find_pose,
    record_moment,
    truth_of,
)
from .history import History
from .scene import Badge, Channels, Reading, ShownArm
from .source import Source

if TYPE_CHECKING:
    from ..drivers.mujoco import MujocoDriver

T = TypeVar("T")

BRAKING_S = 0.4
"""an arm under way comes to rest on its path within this time [s]"""
_LOAD_S = 0.05
"""time constant of the acceleration of what is held [s]"""
_LATE_S = 0.25
"""a simulation that is later than this gives up catching up [s]"""
_WAITING = 100_000
"""samples that wait for the page at the most; the oldest go first"""
_PATIENCE_S = 10.0
"""how long a person's wish may wait for the loop [s]"""


def view_pipeline(arm: Arm) -> Pipeline:
    """What weighs by default, with the push at the hand beyond the load."""
    return Pipeline(
        arm,
        observer=DisturbanceKalman(**_observer_options(arm)),
        wrench=WrenchEstimator(),
        conditioner=_conditioner(),
        # the held object's acceleration out of noisy encoders would shake the arrow
        load=HeldLoad(acceleration_time=0.2),
    )


def contact_pipeline(arm: Arm, load: HeldLoad) -> Pipeline:
    """What looks for contacts beside a known load."""
    return Pipeline(arm, payload=None, contact=ContactDetector(), load=load, conditioner=_conditioner())


def _conditioner() -> Conditioner:
    """Velocities smoothed over 10 ms: differences of encoder counts at 1 kHz are mostly noise."""
    return Conditioner(time_constant=0.01)


class Touched:
    """Contacts beside what is held: a load counts as held once it has been known for a while.

    To a detector a grasped object is a contact that does not end, and to a payload filter a push is a load. What the
    filter has called good for `ADOPTED_S` is the load from then on; what pushes for a shorter time is a contact.
    """

    ADOPTED_S = 1.5
    """[s]"""

    def __init__(self, arm: Arm, *, mass: float = 0.0) -> None:
        self._arm, self._mass, self._std = arm, mass, 0.0
        self._pipeline = contact_pipeline(arm, HeldLoad(mass=mass, acceleration_time=_LOAD_S))
        self._other_since: float | None = None

    def step(self, time_s: float, sample: Sample, payload: Payload) -> Contact:
        """The contact after a sample, and what the weighing says of it."""
        if not self._differs(payload):
            self._other_since = None
        elif self._other_since is None:
            self._other_since = time_s
        elif time_s - self._other_since > self.ADOPTED_S:
            self._adopt(payload)
            self._other_since = None
        contact = self._pipeline.step(sample).contact
        assert contact is not None
        return contact

    def _differs(self, payload: Payload) -> bool:
        if payload.status != Status.ok:
            return False
        error = abs(payload.mass - self._mass)
        return bool(error > max(4.0 * math.hypot(payload.mass_std, self._std), 0.02 * abs(self._mass)))

    def _adopt(self, payload: Payload) -> None:
        self._mass, self._std = max(float(payload.mass), 0.0), float(payload.mass_std)
        com = np.asarray(payload.first_moment) / self._mass if self._mass > 0.0 else np.zeros(3)
        load = HeldLoad(
            mass=self._mass, mass_std=self._std, com=tuple(com.tolist()), acceleration_time=_LOAD_S
        )
        self._pipeline = contact_pipeline(self._arm, load)


def _observer_options(arm: Arm) -> dict[str, float]:
    """In 1 s external torque changes by a tenth of what the drives can."""
    effort = float(np.median([j.limits.effort for j in arm.joints]))
    return {"disturbance_rate": 0.1 * effort} if math.isfinite(effort) else {}


class Motion:
    """Goes from pose to pose, and slows down along its path when told to.

    Args:
        scene: the arm and its gains.
        rate: steps per second [Hz].
        at: (n,) where it stands [rad].
    """

    def __init__(self, scene: Scene, rate: float, at: Array) -> None:
        self._scene, self._rate = scene, rate
        self._lead(at, at)

    def _lead(self, start: Array, goal: Array) -> None:
        task = Task(scene=self._scene, start=start, poses=(goal,), loads=None, rate=self._rate)
        self._route = Route(task)
        self._control = RouteControl(task, self._route)
        self._time, self._speed, self._braking = 0.0, 1.0, False
        self._next: Array | None = None

    @property
    def resting(self) -> bool:
        """The setpoint does not move."""
        return self._speed == 0.0 or self._time >= self._route.end

    @property
    def control(self) -> RouteControl:
        """The controllers of this stretch."""
        return self._control

    @property
    def time(self) -> float:
        """How far along the path [s]."""
        return self._time

    def go(self, goal: Array) -> None:
        """Go there (n,) [rad], once at rest."""
        self.halt()
        self._next = goal

    def halt(self) -> None:
        """Come to rest on the path."""
        self._braking = not self.resting
        self._next = None

    def step(self, dt: float) -> Setpoint:
        """The setpoint after `dt` seconds more."""
        if self.resting and self._next is not None:
            self._lead(self._route.sample(self._time).q, self._next)
        before = self._speed
        if self._braking:
            self._speed = max(0.0, before - dt / BRAKING_S)
        self._time += 0.5 * (before + self._speed) * dt
        q, dq, ddq = self._route.sample(self._time)
        slowing = (self._speed - before) / dt if dt > 0.0 else 0.0
        return Setpoint(q, dq * self._speed, ddq * self._speed**2 + dq * slowing)


class LiveArm(Source):
    """An arm behind a driver, with its pipeline, its motion and its recorder.

    :meth:`start` runs :meth:`tick` in a thread at the driver's rate; without it, whoever calls :meth:`tick` is the
    clock. What a person wants is done between two periods, in the loop's thread.

    Args:
        driver: closed; its joints and effort are those of the scene's arm.
        scene: the arm, its poses and gains.
        out: folder for recordings.

    Raises:
        InputError: driver and arm do not fit.
    """

    def __init__(self, driver: Driver, scene: Scene, *, out: Path = Path()) -> None:
        arm = scene.arm
        if driver.joint_names != arm.joint_names or driver.effort != arm.effort:
            raise InputError(f"the driver's joints or its effort are not those of arm {arm.name!r}")
        self._driver, self._scene, self._out = driver, scene, out
        self._arms = (ShownArm(arm.name, arm, scene.poses, scene.mass),)
        self._gain = arm.effort.gain(arm.n)
        self._period = 1e-9 * driver.period_ns
        self._pipeline = view_pipeline(arm)
        # a state of its own, that knows of pushes and does not depend on the method that weighs
        self._state = Pipeline(arm, observer=ExtendedKalman(**_observer_options(arm)), payload=None)
        self._load = Load()
        self._touched = Touched(arm)
        self._motion: Motion | None = None
        self._goal: Array | None = None
        self._recorder: Recorder | None = None
        self._channels = Channels(arm.n)
        self._history = History(self._channels.count)
        self._waiting: deque[tuple[float, Array]] = deque(maxlen=_WAITING)
        self._wishes: deque[Callable[[], None]] = deque()
        self._messages: deque[str] = deque(maxlen=100)
        self._newest: Reading | None = None
        self._first_ns: int | None = None
        self._last_ns: int | None = None
        self._thread: threading.Thread | None = None
        self._quit = threading.Event()
        self._fault = ""
        self._achieved = 0.0
        self._pace = Pace(None)

    # --- the loop ------------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Connect, and begin the loop.

        Raises:
            DriverError: the arm does not answer.
        """
        if self._thread is not None and self._thread.is_alive():
            return
        self.connect()
        self._quit.clear()
        self._thread = threading.Thread(target=self._run, name="palpate view: arm", daemon=True)
        self._thread.start()

    def connect(self) -> None:
        """Reach the arm, for whoever calls :meth:`tick` without a thread.

        Raises:
            DriverError: it does not answer.
        """
        if self._driver.state == "closed":
            self._driver.connect()
        self._fault, self._first_ns, self._last_ns, self._motion = "", None, None, None
        self._pipeline.reset()
        self._state.reset()
        self._load, self._touched = Load(), Touched(self._scene.arm)

    def stop(self) -> None:
        """End the loop: the drives off, the recording closed."""
        self._quit.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        self._close()

    def _close(self) -> None:
        self._close_recording()
        self._driver.close()

    def _run(self) -> None:
        counted = time.monotonic()
        ticks, begun = 0, None
        try:
            while not self._quit.is_set():
                self.tick()
                ticks += 1
                if self._last_ns is None:
                    continue
                if begun is None:
                    begun = self._last_ns
                    self._pace.start(begun)
                self._wait(self._last_ns)
                past = time.monotonic() - counted
                if past >= 1.0:
                    self._achieved = 1e-9 * (self._last_ns - begun) / past
                    counted, begun = time.monotonic(), self._last_ns
        except PalpateError as error:
            self._fault = str(error)
            self._messages.append(f"The arm was lost and its drives were stopped: {error}")
        finally:
            self._close()

    def _wait(self, time_ns: int) -> None:
        """A real arm's driver waits by itself."""

    def tick(self) -> Reading | None:
        """One period: read, estimate, command, record. None: no sample came.

        Raises:
            DriverError: the arm is lost.
        """
        while self._wishes:
            self._wishes.popleft()()
        sample = self._driver.read()
        if sample is None:
            return None
        touch = self._pipeline.step(sample)
        state = self._state.step(sample)
        if touch.payload.status == Status.ok:
            self._load = self._pipeline.load  # the last good one, so that an arm that is pushed does not sag
        if self._first_ns is None:
            self._first_ns = sample.time_ns
        since = self._period if self._last_ns is None else (sample.time_ns - self._last_ns) * 1e-9
        self._last_ns = sample.time_ns
        contact = self._touched.step(1e-9 * sample.time_ns, sample, touch.payload)
        shown = replace(touch, q=state.q, dq=state.dq, contact=contact)
        goal, sent, held_back = self._command(sample, touch, state, since)
        truth = self._truth()
        reading = Reading(
            time=(sample.time_ns - self._first_ns) * 1e-9,
            sample=sample,
            touch=shown,
            torque=np.asarray(sample.effort) * self._gain,
            goal=None if goal is None else goal.q,
            held_back=held_back,
            powered=self._powered(goal),
            true_mass=math.nan if truth is None else truth[2],
        )
        if self._recorder is not None:
            where = goal or Setpoint(touch.q, np.zeros(len(touch.q)), np.zeros(len(touch.q)))
            moment = Moment(reading.time, sample, touch, where, Status.saturated if held_back else Status.ok)
            self._write(moment, sent, truth)
        self._waiting.append((reading.time, self._channels.row(reading)))
        self._newest = reading
        return reading

    def _command(
        self, sample: Sample, touch: Touch, state: Touch, dt: float
    ) -> tuple[Setpoint | None, Array, bool]:
        """Setpoint (None: the drives are off), what was sent (n,) [N m], and whether a limit holds the arm back."""
        if self._driver.state != "enabled":
            self._motion = self._goal = None
            return None, np.zeros(len(touch.q)), False
        if self._motion is None:
            self._motion = Motion(self._scene, 1.0 / self._period, np.array(sample.position))
        if self._goal is not None:
            self._motion.go(self._goal)
            self._goal = None
        # behind a gap the setpoint goes on where it was: it must not leap
        setpoint = self._motion.step(min(max(dt, 0.0), 5.0 * self._period))
        control = self._motion.control
        torque, status = control.step(self._motion.time, setpoint, state, self._load, dt)
        return setpoint, self._driver.write(torque), status != Status.ok

    def _truth(self) -> tuple[Array, Array, float] | None:
        return None

    def _powered(self, goal: Setpoint | None) -> bool:
        """Whether drives hold the arm, so that their torque tells what it holds."""
        return goal is not None

    def _do(self, wish: Callable[[], T]) -> T:
        """Let the loop do it between two periods, and wait; without a loop, at once."""
        if self._thread is None or not self._thread.is_alive():
            return wish()
        done: Future[T] = Future()

        def act() -> None:
            try:
                done.set_result(wish())
            except PalpateError as error:
                done.set_exception(error)

        self._wishes.append(act)
        try:
            return done.result(_PATIENCE_S)
        except TimeoutError:
            raise DriverError("the arm's loop does not answer") from None

    # --- what the page sees --------------------------------------------------------------------------------------

    @property
    def arms(self) -> tuple[ShownArm, ...]:
        """The one arm."""
        return self._arms

    def reading(self, arm: int) -> Reading | None:
        """The newest state."""
        return self._newest

    def curves(self, arm: int, span: float) -> tuple[Array, Array]:
        """Of every sample since the start."""
        count = len(self._waiting)
        if count:
            rows = [self._waiting.popleft() for _ in range(count)]
            self._history.add([t for t, _ in rows], np.array([row for _, row in rows]))
        return self._history.curves(span)

    @property
    def state(self) -> Badge:
        """Whether the loop runs."""
        if self._fault:
            return Badge("arm lost", "red", self._fault)
        if self._newest is None:
            return Badge("waiting for the first sample", "grey")
        return Badge(f"live, {1.0 / self._period:.0f} Hz", "green", self._driver_words())

    def _driver_words(self) -> str:
        return ""

    def messages(self) -> list[str]:
        """What happened since the last call."""
        found = []
        while self._messages:
            found.append(self._messages.popleft())
        return found

    # --- what a person wants -------------------------------------------------------------------------------------

    @property
    def recording(self) -> Path | None:
        """See :class:`Records`."""
        recorder = self._recorder
        return None if recorder is None else recorder.path

    def record(self) -> Path:
        """See :class:`Records`.

        Raises:
            LogError: it cannot be written.
        """

        def begin() -> Path:
            if self._recorder is not None:
                return self._recorder.path
            arm = self._scene.arm
            stem = f"{arm.name}_{datetime.now():%Y%m%d_%H%M%S}"
            path = self._out / f"{stem}.mcap"
            for count in range(2, 100):
                if not path.exists():
                    break
                path = self._out / f"{stem}_{count}.mcap"
            plan = {"arm": arm.name, "rate_hz": 1.0 / self._period, "assumed": list(self._scene.assumed)}
            session = {**describe_arm(arm, self._pipeline), "task": json.dumps(plan)}
            self._recorder = Recorder(path, arm.joint_names, session=session, frame_id=arm.base)
            self._pipeline.reset()
            return path

        return self._do(begin)

    def end_recording(self) -> Path | None:
        """See :class:`Records`."""
        return self._do(self._close_recording)

    def _close_recording(self) -> Path | None:
        recorder, self._recorder = self._recorder, None
        if recorder is None:
            return None
        try:
            recorder.close()
        except LogError as error:
            self._messages.append(f"The recording could not be finished: {error}")
        return recorder.path

    def _write(self, moment: Moment, sent: Array, truth: tuple[Array, Array, float] | None) -> None:
        assert self._recorder is not None
        try:
            record_moment(self._recorder, moment, sent, self._gain, truth)
        except LogError as error:  # the arm goes on: a full disk is no reason to drop what it holds
            self._messages.append(f"The recording was ended: {error}")
            self._close_recording()

    def options(self, arm: int) -> dict[str, Any]:
        """See :class:`Tunes`."""
        return self._pipeline.options()

    def tune(self, arm: int, options: Mapping[str, Any]) -> None:
        """See :class:`Tunes`.

        Raises:
            InputError: an option is out of range, or a recording is being written.
        """
        pipeline = Pipeline.from_options(self._scene.arm, options)

        def swap() -> None:
            if self._recorder is not None:
                raise InputError("end the recording first: it replays with the parameters it began with")
            self._pipeline = pipeline

        self._do(swap)


class WatchedArm(LiveArm):
    """An arm that others move, such as one that publishes its joints' states in a ROS 2 graph: it is only read."""

    def _powered(self, goal: Setpoint | None) -> bool:
        return True


class MovedArm(LiveArm):
    """A live arm that goes where it is told."""

    def go(self, arm: int, pose: str) -> None:
        """See :class:`Moves`.

        Raises:
            InputError: no such pose.
            DriverError: the drives are off.
        """
        _, goal = find_pose(self._scene, pose)

        def wish() -> None:
            if self._driver.state != "enabled":
                raise DriverError("the drives are off: switch them on first")
            self._goal = goal

        self._do(wish)

    def halt(self, arm: int) -> None:
        """See :class:`Moves`."""

        def wish() -> None:
            self._goal = None
            if self._motion is not None:
                self._motion.halt()

        self._do(wish)


class SimulatedArm(MovedArm):
    """A simulated arm in real time, with a hand to put things into and links to push.

    Args:
        driver: as :func:`palpate.weigh.simulated_driver` makes it, without a pace of its own.
        scene: the arm, its poses and gains.
        out: folder for recordings.
        speed: simulated seconds per second; None: as fast as it goes.
        mass: in its hand from the start [kg].

    Raises:
        InputError: the mass is absurd.
    """

    def __init__(
        self,
        driver: MujocoDriver,
        scene: Scene,
        *,
        out: Path = Path(),
        speed: float | None = 1.0,
        mass: float = 0.0,
    ) -> None:
        super().__init__(driver, scene, out=out)
        self._plant = driver.plant
        self._speed = speed
        self._pace = Pace(speed)
        self._held = check_mass(mass)
        self._first_goal: Array | None = None

    def connect(self) -> None:
        """Reach the arm, its drives on and its object in the hand."""
        super().connect()
        self._driver.enable()
        self.hold(0, self._held)
        self._goal = self._first_goal

    def send(self, pose: str) -> None:
        """Go to this pose first, from the start on.

        Raises:
            InputError: no such pose.
        """
        _, self._first_goal = find_pose(self._scene, pose)

    def _wait(self, time_ns: int) -> None:
        if self._pace.late(time_ns) > _LATE_S:
            self._pace.start(time_ns)
            time.sleep(0.0)  # the page has its turn
        self._pace.wait(time_ns)

    def _truth(self) -> tuple[Array, Array, float]:
        return truth_of(self._plant)

    @property
    def state(self) -> Badge:
        """Whether the simulation keeps up."""
        state = super().state
        if state.tone != "green" or self._speed is None or not 0.0 < self._achieved < 0.95 * self._speed:
            return Badge(state.text.replace("live", "simulated"), state.tone, state.detail)
        share = self._achieved / self._speed
        return Badge(
            f"simulated, {share:.0%} of real time", "orange", "this machine is too busy; the numbers hold"
        )

    def hold(self, arm: int, mass: float) -> None:
        """See :class:`Holds`.

        Raises:
            InputError: negative or absurd.
        """
        load = brick(check_mass(mass))

        def change() -> None:
            self._held = mass
            if load is None:
                self._plant.release()
            else:
                self._plant.attach(load)

        self._do(change)

    def held(self, arm: int) -> float:
        """See :class:`Holds`."""
        return self._held

    def push(self, arm: int, link: str, force: npt.ArrayLike) -> None:
        """See :class:`Pushable`.

        Raises:
            InputError: no such link.
        """
        F = np.asarray(force, dtype=np.float64)

        def change() -> None:
            self._plant.stop_pushing()
            if np.any(F):
                self._plant.push(link, F)

        self._do(change)


class RealArm(MovedArm):
    """A real arm; its drives are off until somebody switches them on."""

    @property
    def powered(self) -> bool:
        """See :class:`Powers`."""
        return self._driver.state == "enabled"

    def power(self, on: bool) -> None:
        """See :class:`Powers`. On, an arm that was lost is looked for again.

        Raises:
            DriverError: it does not answer.
        """
        if on and self._fault:
            self.stop()
            self.start()

        def switch() -> None:
            if not on:
                self._driver.disable()
            elif self._driver.state != "enabled":
                self._check_pose()
                self._driver.enable()
                self._pipeline.reset()
                self._touched = Touched(self._scene.arm)

        self._do(switch)

    def _check_pose(self) -> None:
        """Refuse to hold an arm that is outside its limits.

        Raises:
            InputError: it is; most likely a zero or a direction is wrong.
        """
        if self._newest is None:
            return
        for joint, angle in zip(self._scene.arm.joints, self._newest.sample.position, strict=True):
            if not joint.limits.lower <= angle <= joint.limits.upper:
                raise InputError(
                    f"{joint.name} reads {angle:.4g} rad, outside its limits {joint.limits.lower:.4g} to "
                    f"{joint.limits.upper:.4g} rad: move the arm inside, or correct its zero or direction"
                )

    def _driver_words(self) -> str:
        return "drives on" if self.powered else "drives off: hold the arm before you switch them on"
