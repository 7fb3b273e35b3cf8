"""The closed loop: an arm, simulated or real, moves an object through poses, is weighed by, and is recorded."""

from __future__ import annotations

import gc
import itertools
import json
import math
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from .._core import Load as _CoreLoad
from .._core import PayloadFilter, Status, __version__
from ..arm import Arm, Array, Sensing
from ..control import Controller, Quintic, SafetyLimiter, Setpoint
from ..errors import InputError, LogError, PalpateError
from ..logs import Log, Recorder, Sample, Signal
from ..pipeline import ExternalTorque, Payload, Pipeline, Touch
from ..session import card_text
from .scenes import NOISE_COUNTS, Scene, gains_at

if TYPE_CHECKING:
    from ..drivers import Driver
    from ..drivers.mujoco import MujocoDriver
    from ..simulate import Load, Plant

PROGRESS_S = 0.1
"""time between two calls of progress [s], simulated"""
_PATIENCE_S = 1.0
"""how long a real arm goes on at the end where samples have just been lost [s]"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """What an arm is asked to do.

    Raises:
        InputError: a number is out of range.
    """

    scene: Scene
    start: Array
    """(n,) [rad], at rest"""
    poses: tuple[Array, ...]
    """(n,) each [rad], visited in turn; the last one is held"""
    loads: tuple[tuple[float, float], ...] | None = ()
    """(time [s], mass [kg]): what is in the hand from then on; 0 kg: nothing. None: a real arm, nobody knows"""
    duration: float = 10.0
    """[s]"""
    move: float = 3.0
    """time of each motion [s]; longer where a joint would exceed half of its largest speed"""
    hold: float = 2.0
    """time at each pose but the last [s]"""
    rate: float = 250.0
    """[Hz]"""
    noise: bool = True
    """False: ideal encoders and drives"""
    jitter: float = 0.0
    """of the time stamps [s]"""
    loss: float = 0.0
    """probability that a sample is lost [1]"""
    seed: int = 0
    speed: float | None = None
    """simulated seconds per second; None: as fast as it goes"""

    def __post_init__(self) -> None:
        n = self.scene.arm.n
        for what, q in (("start", self.start), *(("pose", q) for q in self.poses)):
            if np.shape(q) != (n,) or not np.isfinite(q).all():
                raise InputError(f"{what}: expected {n} finite angles [rad], got {q!r:.80}")
        if not self.poses:
            raise InputError("a task needs at least one pose")
        _within("duration", self.duration, 0.0, 3600.0, "s")
        _within("move", self.move, 0.0, 600.0, "s")
        if self.hold != 0.0:
            _within("hold", self.hold, 0.0, 600.0, "s")
        if self.speed is not None:
            _within("speed", self.speed, 0.0, 1e6, "simulated seconds per second")
        if isinstance(self.seed, bool) or not isinstance(self.seed, int) or self.seed < 0:
            raise InputError(f"seed must be a whole number >= 0, got {self.seed!r}")
        loads = self.loads or ()
        for time, mass in loads:
            if not (math.isfinite(time) and time >= 0.0):
                raise InputError(f"time of a load must be a number >= 0 s, got {time!r}")
            check_mass(mass)
        times = [time for time, _ in loads]
        if times != sorted(set(times)):
            raise InputError(f"times of the loads must ascend, got {', '.join(f'{t:g}' for t in times)} s")

    @property
    def simulated(self) -> bool:
        """Whether the arm is; of a real one nobody knows what it holds."""
        return self.loads is not None

    def mass_at(self, time: float) -> float:
        """What is in a simulated hand at a time [s], [kg]."""
        held = [mass for t, mass in self.loads or () if t <= time]
        return held[-1] if held else 0.0


def check_mass(mass: float) -> float:
    """The mass [kg], if a simulated arm can be given it.

    Raises:
        InputError: negative, not finite, or beyond 1000 kg.
    """
    if not 0.0 <= mass <= 1000.0:
        raise InputError(f"mass must be a number from 0 to 1000 kg, got {mass!r}")
    return mass


def _within(what: str, value: float, above: float, most: float, unit: str) -> None:
    if not above < value <= most:
        raise InputError(f"{what} must be above {above:g} and at most {most:g} {unit}, got {value!r}")


class Moment(NamedTuple):
    """How far a trial is."""

    time: float
    """[s]"""
    sample: Sample
    touch: Touch
    """of this sample"""
    setpoint: Setpoint
    control: Status
    """ok, or saturated: a torque limit holds the arm back"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """What a trial left: N samples of n joints."""

    task: Task
    pipeline: Mapping[str, Any]
    """options of the pipeline, see :meth:`palpate.Pipeline.options`"""
    log: Log
    """every sample as read, of a simulated arm with the truth among its signals"""
    touch: Touch
    """one row per sample, as it was known then"""
    desired_q: Array
    """(N, n) [rad]"""
    desired_dq: Array
    """(N, n) [rad/s]"""
    command: Array
    """(N, n) torque that was really sent [N m]"""
    control: npt.NDArray[np.uint8]
    """(N,) Status of the command: ok or saturated"""
    effort_of_period: bool = False
    """see :attr:`palpate.drivers.Driver.effort_of_period`"""
    interrupted: bool = False
    """stopped before its end"""
    picture: npt.NDArray[np.uint8] | None = None
    """(height, width, 3) of the end; None: not asked for, or this machine cannot draw"""
    picture_error: str = ""
    """why there is no picture"""


def brick(mass: float) -> Load | None:
    """The object of the published bench: 0.07 x 0.07 m, 10000 kg/m^3; a cube where that would be taller; 0: none."""
    from ..simulate import Load

    if mass == 0.0:
        return None
    height = mass / (1e4 * 0.07**2)
    size = (0.07, 0.07, height) if height <= 0.07 else (float(np.cbrt(mass / 1e4)),) * 3
    return Load.box(mass, (size[0], size[1], size[2]))


def simulated_driver(task: Task) -> MujocoDriver:
    """The simulated arm of a task, with its noise, and what it will hold when; closed.

    Raises:
        MissingExtraError: mujoco is not installed.
    """
    from ..drivers.mujoco import MujocoDriver
    from ..simulate import Attach, Release, Schedule, SensorModel

    arm = task.scene.arm
    if not task.noise:
        arm = arm.replace(joints=tuple(j.replace(sensing=Sensing()) for j in arm.joints))
    counted = task.noise and all(j.sensing.position_resolution > 0.0 for j in arm.joints)
    sensor = SensorModel(
        arm,
        rate=task.rate,
        noise_counts=NOISE_COUNTS if counted else None,
        jitter=task.jitter,
        loss=task.loss,
        seed=task.seed,
    )
    events = []
    for time, mass in task.loads or ():
        load = brick(mass)
        events.append(Release(time) if load is None else Attach(time, load))
    return MujocoDriver(arm, sensor=sensor, schedule=Schedule(events), q=task.start, pace=task.speed)


@contextmanager
def uncollected() -> Iterator[None]:
    """Python's cyclic garbage collector looks through all that a trial has gathered, which after a minute takes longer
    than a servo's watchdog waits: it rests while a real arm moves. What is not in cycles is freed all the same."""
    running = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if running:
            gc.enable()


class Route:
    """Setpoints of a task: quintic after quintic, with a rest at each pose."""

    def __init__(self, task: Task) -> None:
        speed = np.array([j.limits.velocity for j in task.scene.arm.joints])
        self._legs: list[tuple[float, Quintic]] = []
        begin, at = 0.0, task.start
        for pose in task.poses:
            # a quintic's peak speed is 1.875 times its mean
            least = float(np.max(1.875 * np.abs(pose - at) / (0.5 * speed)))
            leg = Quintic(at, pose, max(task.move, least))
            self._legs.append((begin, leg))
            begin, at = begin + leg.duration + task.hold, pose

    def sample(self, time: float) -> Setpoint:
        """The setpoint at a time [s]."""
        begin, leg = next((x for x in reversed(self._legs) if x[0] <= time), self._legs[0])
        return leg.sample(time - begin)

    @property
    def end(self) -> float:
        """When the last pose should be reached [s]."""
        begin, leg = self._legs[-1]
        return begin + leg.duration


class RouteControl:
    """Controllers along the route, each with the gains of its stretch, and the safety limiter behind them."""

    def __init__(self, task: Task, route: Route) -> None:
        self._task, self._route = task, route
        self._limiter = SafetyLimiter(task.scene.arm)
        self._stretch = 0.1
        fixed = task.scene.gains is not None
        self._last = 0 if fixed else int(route.end / self._stretch) + 1
        self._controllers: dict[int, Controller] = {}

    def _controller(self, stretch: int) -> Controller:
        """Made when the arm gets there: no period of a live arm has to wait for all of them."""
        known = self._controllers.get(stretch)
        if known is None:
            scene = self._task.scene
            pose = self._route.sample(stretch * self._stretch).q
            kp, kd = scene.gains or gains_at(scene.arm, pose, 1.0 / self._task.rate)
            limits = [j.limits.effort for j in scene.arm.joints]
            known = self._controllers[stretch] = Controller(scene.arm, kp, kd, limit=limits)
        return known

    def step(
        self, time: float, setpoint: Setpoint, state: Touch, load: _CoreLoad, dt: float
    ) -> tuple[Array, Status]:
        """Torque to be sent [N m], and its status."""
        controller = self._controller(min(int(time / self._stretch), self._last))
        torque, status = controller.step(setpoint, state.q, state.dq, load)
        torque, limited = self._limiter.step(torque, state.q, state.dq, dt)
        return torque, limited if status == Status.ok else status


def arrival(task: Task) -> float:
    """When the last pose should be reached [s]."""
    return Route(task).end


def describe(task: Task, pipeline: Pipeline, *, effort_of_period: bool = False) -> dict[str, str]:
    """What a recording must say to be replayed and judged: card, pipeline, task, seed, version."""
    arm = task.scene.arm
    plan: dict[str, Any] = {
        "arm": arm.name,
        "start_rad": task.start.tolist(),
        "poses_rad": [q.tolist() for q in task.poses],
        "loads_s_kg": None if task.loads is None else [list(load) for load in task.loads],
        "duration_s": task.duration,
        "move_s": task.move,
        "hold_s": task.hold,
        "rate_hz": task.rate,
        "effort_of_period": effort_of_period,
        "noise": task.noise,
        "jitter_s": task.jitter,
        "loss": task.loss,
        "gains": None if task.scene.gains is None else [k.tolist() for k in task.scene.gains],
        "assumed": list(task.scene.assumed),
    }
    return {**describe_arm(arm, pipeline), "task": json.dumps(plan), "seed": str(task.seed)}


def describe_arm(arm: Arm, pipeline: Pipeline) -> dict[str, str]:
    """What any recording must say for its samples to be understood and replayed: card, pipeline, version."""
    return {
        "palpate_version": __version__,
        "arm_card": card_text(arm),
        "pipeline": json.dumps(pipeline.options()),
        "effort_unit": "A" if arm.effort.kind == "current" else "N m",
    }


#: outputs that a recording keeps as signals of their own, beside those that the recorder has topics for: unit
OUTPUTS = {
    "estimated_position": "rad",
    "estimated_velocity": "rad/s",
    "first_moment": "kg m",
    "changes": "1",
    "change_time": "ns",
    "touch_status": "Status of sample, external torque, payload",
}


def record_moment(
    recorder: Recorder, moment: Moment, sent: Array, gain: Array, truth: tuple[Array, Array, float] | None
) -> None:
    """Write a moment with all its outputs, as :func:`replay` reads them.

    Args:
        recorder: of the arm's joints.
        moment: what was read, found and wanted.
        sent: (n,) torque that was really sent [N m].
        gain: (n,) torque per unit of the driver's effort.
        truth: of a simulated arm, see :func:`truth_of`; None: nobody knows.
    """
    time_ns, touch = moment.sample.time_ns, moment.touch
    recorder.sample(*moment.sample)
    external, payload = touch.external, touch.payload
    recorder.external_torque(time_ns, external.torque, external.std)
    recorder.payload(time_ns, payload.mass, payload.mass_std)
    recorder.status(time_ns, sample=touch.status, external_torque=external.status, payload=payload.status)
    values: tuple[npt.ArrayLike, ...] = (
        touch.q,
        touch.dq,
        payload.first_moment,
        float(payload.changes),
        float(payload.change_time_ns),
        [float(int(s)) for s in (touch.status, external.status, payload.status)],
    )
    for (name, unit), value in zip(OUTPUTS.items(), values, strict=True):
        recorder.signal(name, time_ns, value, unit)
    recorder.setpoint(time_ns, moment.setpoint.q, moment.setpoint.dq)
    recorder.command(time_ns, sent / gain)
    if truth is not None:
        q, dq, mass = truth
        recorder.signal("true_position", time_ns, q, "rad")
        recorder.signal("true_velocity", time_ns, dq, "rad/s")
        recorder.signal("true_mass", time_ns, mass, "kg")


def run(
    task: Task,
    pipeline: Pipeline,
    *,
    driver: Driver | None = None,
    record: Path | None = None,
    progress: Callable[[Moment], None] | None = None,
    stop: Callable[[], bool] | None = None,
    picture: bool = False,
    frames: Callable[[npt.NDArray[np.uint8]], None] | None = None,
    frame_rate: float = 25.0,
) -> Trial:
    """Let an arm do a task; each of its samples goes through the pipeline.

    The controller is fed the state and the load of the pipeline's payload filter, or of one of its own where the
    pipeline weighs by another method: then the motion does not depend on the method.

    Args:
        task: what to do.
        pipeline: weighs; of the scene's arm, fresh.
        driver: of a real arm, where the task's loads are None; it is closed at the end, the drives off.
        record: file (.mcap) or folder to record every input and output to; it is replaced.
        progress: called every PROGRESS_S of the arm's time.
        stop: asked before every period; True stops the arm and ends the trial, the record included.
        picture: draw the arm as it stands at the end.
        frames: called with a picture (720, 960, 3), `frame_rate` times per simulated second.
        frame_rate: [Hz].

    Raises:
        LogError: the record cannot be written.
        InputError: the simulation diverged, or the pipeline or the driver is of another arm.
        DriverError: the arm is lost; its drives have been stopped, and what was recorded until then is kept.
        MissingExtraError: mujoco is not installed.
    """
    arm = task.scene.arm
    if pipeline.arm is not arm:
        raise InputError("the pipeline must be made for the task's arm: task.scene.arm")
    if (driver is None) != task.simulated:
        raise InputError(
            "a task with loads is for a simulated arm; a driver needs a task whose loads are None"
        )
    filtered = isinstance(pipeline.payload, PayloadFilter)
    control = pipeline if filtered else Pipeline(arm)
    route = Route(task)
    controller = RouteControl(task, route)
    gain = arm.effort.gain(arm.n)
    plant: Plant | None = None
    periods: Iterable[int] = itertools.count()
    if driver is None:
        driver = simulated = simulated_driver(task)
        plant = simulated.plant
        periods = range(round(task.duration * task.rate) + 1)
    elif driver.joint_names != arm.joint_names or driver.effort != arm.effort:
        raise InputError(f"the driver's joints or its effort are not those of arm {arm.name!r}")
    rows = _Rows(arm.n)
    interrupted = False
    next_progress = next_frame = 0.0
    error = ""
    drawn: npt.NDArray[np.uint8] | None = None
    recorder = None
    if record is not None:
        recorder = Recorder(
            record,
            arm.joint_names,
            session=describe(task, pipeline, effort_of_period=driver.effort_of_period),
            frame_id=arm.base,
            overwrite=True,
        )
    try:
        with nullcontext() if task.simulated else uncollected(), driver:
            driver.enable()
            last_ns: int | None = None
            first_ns: int | None = None
            for _ in periods:
                if stop is not None and stop():
                    interrupted = True
                    driver.stop()
                    break
                sample = driver.read()
                if sample is None:
                    continue
                touch = pipeline.step(sample)
                state = touch if control is pipeline else control.step(sample)
                if first_ns is None:
                    first_ns = 0 if task.simulated else sample.time_ns
                time = (sample.time_ns - first_ns) * 1e-9
                setpoint = route.sample(time)
                dt = 1.0 / task.rate if last_ns is None else (sample.time_ns - last_ns) * 1e-9
                torque, status = controller.step(time, setpoint, state, control.load, dt)
                sent = driver.write(torque)
                last_ns = sample.time_ns
                moment = Moment(time, sample, touch, setpoint, status)
                truth = None if plant is None else truth_of(plant)
                rows.add(moment, sent, truth)
                if recorder is not None:
                    record_moment(recorder, moment, sent, gain, truth)
                if progress is not None and time >= next_progress:
                    next_progress += PROGRESS_S
                    progress(moment)
                if frames is not None and plant is not None and time >= next_frame:
                    next_frame += 1.0 / frame_rate
                    frames(plant.render())
                if not task.simulated and _over(task, time, touch):
                    break
            if recorder is not None and interrupted and last_ns is not None:
                recorder.event(last_ns, "stop", "stopped before its end, by request")
            if picture and plant is not None:
                from ..simulate import Camera

                try:
                    drawn = plant.render(camera=Camera(azimuth=None, elevation=-20.0))
                except PalpateError as e:
                    error = str(e)  # a weighing without a picture is one all the same; the caller tells why
    finally:
        if recorder is not None:
            recorder.close()
    return replace(
        rows.result(task, pipeline, interrupted, drawn, error), effort_of_period=driver.effort_of_period
    )


def _over(task: Task, time: float, touch: Touch) -> bool:
    """Whether a real arm may stop: not just behind samples that were lost, if it can be helped."""
    late = time - task.duration
    return late >= 0.0 and (Status(touch.payload.status) != Status.gap or late >= _PATIENCE_S)


def truth_of(plant: Plant) -> tuple[Array, Array, float]:
    """A simulated arm's positions [rad], velocities [rad/s] and mass held [kg]."""
    return plant.q, plant.dq, 0.0 if plant.load is None else plant.load.mass


class _Rows:
    """Collects a trial row by row."""

    def __init__(self, n: int) -> None:
        self._n = n
        self._moments: list[Moment] = []
        self._sent: list[Array] = []
        self._truth: list[tuple[Array, Array, float]] = []

    def add(self, moment: Moment, sent: Array, truth: tuple[Array, Array, float] | None) -> None:
        self._moments.append(moment)
        self._sent.append(sent)
        if truth is not None:
            self._truth.append(truth)

    def result(
        self,
        task: Task,
        pipeline: Pipeline,
        interrupted: bool,
        picture: npt.NDArray[np.uint8] | None,
        error: str,
    ) -> Trial:
        n, moments = self._n, self._moments
        touches = [m.touch for m in moments]

        def matrix(rows: list[Array], width: int = n) -> Array:
            return np.array(rows, dtype=np.float64).reshape(len(rows), width)

        def codes(states: list[Any]) -> npt.NDArray[np.uint8]:
            return np.array([int(s) for s in states], dtype=np.uint8)

        time_ns = np.array([m.sample.time_ns for m in moments], dtype=np.int64)
        velocities = [m.sample.velocity for m in moments]
        measured = [v for v in velocities if v is not None]
        signals = {}
        if task.simulated:
            mass = np.array([m for _, _, m in self._truth], dtype=np.float64)
            signals["true_position"] = Signal(time_ns, matrix([q for q, _, _ in self._truth]), "rad")
            signals["true_mass"] = Signal(time_ns, mass, "kg")
        log = Log(
            time_ns=time_ns,
            position=matrix([m.sample.position for m in moments]),
            velocity=matrix(measured) if measured else None,
            effort=matrix([m.sample.effort for m in moments]),
            joint_names=task.scene.arm.joint_names,
            signals=signals,
        )
        touch = Touch(
            time_ns,
            matrix([t.q for t in touches]),
            matrix([t.dq for t in touches]),
            codes([t.status for t in touches]),
            ExternalTorque(
                matrix([t.external.torque for t in touches]),
                matrix([t.external.std for t in touches]),
                codes([t.external.status for t in touches]),
            ),
            Payload(
                np.array([t.payload.mass for t in touches], dtype=np.float64),
                np.array([t.payload.mass_std for t in touches], dtype=np.float64),
                matrix([t.payload.first_moment for t in touches], 3),
                np.array([t.payload.changes for t in touches], dtype=np.uint32),
                np.array([t.payload.change_time_ns for t in touches], dtype=np.int64),
                codes([t.payload.status for t in touches]),
            ),
        )
        return Trial(
            task=task,
            pipeline=pipeline.options(),
            log=log,
            touch=touch,
            desired_q=matrix([m.setpoint.q for m in moments]),
            desired_dq=matrix([m.setpoint.dq for m in moments]),
            command=matrix(self._sent),
            control=codes([m.control for m in moments]),
            interrupted=interrupted,
            picture=picture,
            picture_error=error,
        )


def arm_of(log: Log) -> Arm:
    """The arm that a recording of palpate was made with.

    Raises:
        LogError: the log does not carry a card.
    """
    text = log.meta.get("arm_card")
    if text is None:
        raise LogError("the log carries no arm card; name the arm")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "arm.yaml"
        path.write_text(text, encoding="utf-8")
        return Arm.from_card(path)
