"""The real-time session: a C++ thread reads, estimates, controls, limits, writes and records; Python looks on and asks.

>>> arm = robots.load("justina_left_arm")
>>> controller = Controller(arm, kp=5.0, kd=1.0)
>>> with Session(arm, SimulatedArm(arm), controller=controller, record="run.mcap") as session:  # doctest: +SKIP
...     session.enable()
...     session.move_to([0.0, -0.5, 0.5, 1.0, 0.0, 1.0, -0.3], duration=3.0)
...     session.run(4.0)
...     print(session.state.touch.payload.mass)
"""

from __future__ import annotations

import atexit
import json
import logging
import math
import os
import tempfile
import threading
import time
import weakref
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self, TypeAlias

import numpy as np
import numpy.typing as npt

from ._core import Session as CoreSession
from ._core import SimulatedArm as CoreSimulatedArm
from ._core import Status, __version__
from .arm import Arm, Array
from .control import Controller, SafetyLimiter, Setpoint
from .drivers.driver import Driver
from .errors import DriverError, InputError, MissingExtraError, PalpateError
from .logs import Recorder, Sample
from .pipeline import Pipeline, Touch

Mode: TypeAlias = Literal["watching", "enabled", "stopped", "fault"]

_logger = logging.getLogger(__name__)
_DRAIN_S = 0.02
"""between two looks for records"""
_BATCH = 1024
_open: weakref.WeakSet[Session] = weakref.WeakSet()


@dataclass(frozen=True, slots=True)
class Realtime:
    """What is asked of the operating system for the loop's thread; what it refuses is said, and the session goes on."""

    priority: int = 80
    """of SCHED_FIFO, 1 to 99; 0: not asked for"""
    lock_memory: bool = True
    """keep the process's memory of that moment from being paged out"""
    processor: int | None = None
    """run on this one alone; None: on any"""


@dataclass(frozen=True, slots=True)
class Granted:
    """What the operating system granted."""

    fifo: bool
    locked: bool
    pinned: bool
    complaint: str
    """what was refused, why, and what would allow it; empty: nothing"""


@dataclass(frozen=True, slots=True)
class Durations:
    """How often something took how long [ns]. Quantiles are at most 1/32 too large, never too small."""

    count: int
    p50_ns: int
    p99_ns: int
    p999_ns: int
    worst_ns: int
    bins: list[list[int]]
    """upper edge [ns] and count of every bin that holds something"""


@dataclass(frozen=True, slots=True)
class SessionStatistics:
    """Counted since the session began."""

    ticks: int
    samples: int
    missing: int
    """ticks without a sample"""
    refused: int
    """samples that were not used: NaN, absurd numbers, a time that does not rise"""
    lost_own: int
    """ticks that never began because of the session's own computing"""
    lost_driver: int
    """... because of the driver"""
    lost_system: int
    """... because the thread was not woken in time, or its processor was taken away"""
    records_dropped: int
    """records that were not taken in time"""
    allocations: int
    """heap allocations of the session's own work; 0 also where they are not counted"""
    own: Durations
    """time of a tick in the session's own work"""
    own_processor: Durations
    """processor time for that and for the driver's write(): without the time in which the processor was taken away"""
    driver: Durations
    """time in the driver's read() and write(), its waiting included"""
    late: Durations
    """how late ticks began"""


@dataclass(frozen=True, slots=True)
class SessionState:
    """The newest tick that brought a sample."""

    tick: int
    """its number; those that were lost count too"""
    mode: Mode
    sample: Sample
    touch: Touch
    setpoint: Setpoint | None
    """None: no command was sent"""
    sent: Array | None
    """(n,) torque that went out [N m]"""
    control: Status
    """ok; saturated: a limit holds the arm back; held: no command"""
    net_mass: float
    """mass since the tare [kg]"""
    net_mass_std: float
    """[kg]; that of the tare included as if the two were independent"""
    tares: int
    """how many tares are done"""


class SimulatedArm:
    """An arm simulated in C++ by palpate's own dynamics, for a :class:`Session`: 1 kHz and more.

    Args:
        arm: the arm; it needs masses.
        rate: samples per second [Hz].
        q: (n,) where it starts, at rest [rad]; None: zero.
        substeps: of the integration per sample.
        noise: the arm's encoder steps and noise; False: ideal ones.
        seed: of the noise.

    Raises:
        InputError: a number is out of range, or the arm has no masses.
    """

    def __init__(
        self,
        arm: Arm,
        *,
        rate: float = 1000.0,
        q: npt.ArrayLike | None = None,
        substeps: int = 4,
        noise: bool = True,
        seed: int = 0,
    ) -> None:
        if not (math.isfinite(rate) and rate > 0.0):
            raise InputError(f"rate must be a number > 0 Hz, got {rate!r}")
        self.arm = arm
        start = np.zeros(arm.n) if q is None else np.ascontiguousarray(q, dtype=np.float64)
        try:
            self.core = CoreSimulatedArm(arm.core, 1.0 / rate, substeps, noise, seed, start)
        except (ValueError, TypeError) as e:
            raise InputError(str(e).splitlines()[0]) from None

    def hold(self, mass: float) -> None:
        """Put a point mass [kg] into the hand; 0: nothing. From the next sample on.

        Raises:
            InputError: no number >= 0.
        """
        if not 0.0 <= mass < math.inf:
            raise InputError(f"mass must be a number >= 0 kg, got {mass!r}")
        self.core.hold(self.arm.core.load(float(mass), np.array(self.arm.grasp, dtype=np.float64)))

    def push(self, force: npt.ArrayLike) -> None:
        """Push the hand with a force (3,) [N], base axes, from the next sample on; zero: leave it alone.

        Raises:
            InputError: not three finite numbers.
        """
        f = np.ascontiguousarray(force, dtype=np.float64)
        if f.shape != (3,) or not np.isfinite(f).all():
            raise InputError(f"force must be 3 finite numbers [N], got {force!r:.60}")
        self.core.push(f)

    @property
    def truth(self) -> tuple[Array, Array]:
        """True positions (n,) [rad] and velocities (n,) [rad/s] at the newest sample."""
        q, dq = self.core.truth()
        return q, dq


class Session:
    """A loop with a thread of its own around a driver; a context manager that leaves the arm stopped.

    The thread reads, steps the pipeline and, while enabled, controller and safety limiter, writes and records; none of
    it waits for Python unless the driver is written in Python. Whatever ends it, the driver's safe command comes
    first: :meth:`stop`, leaving the block, a failing driver, no usable sample for `patience` seconds, the interpreter
    silent for `lease` seconds, the end of the program. Only a killed process (SIGKILL) stops nothing: then the arm's
    own watchdog has to.

    Args:
        arm: the arm; its effort is what the driver reports.
        driver: :class:`SimulatedArm`, or any :class:`palpate.drivers.Driver`, which is connected and closed with the
            session unless it was connected before.
        pipeline: what is estimated, as it was built (its own state is not touched); None: the default pipeline.
        controller: what moves the arm; None: the session only watches.
        limiter: None: the arm's limits.
        record: file (.mcap, .db3) or folder for everything, or a Recorder that the session closes; None: nothing.
        fault_log: where the last seconds go if the session ends by a fault and nothing was recorded; None: a new file
            in the folder for temporary files, which the error names.
        keep: these last seconds [s].
        realtime: what is asked of the operating system.
        patience: longest time without a usable sample while enabled [s].
        lease: longest time without a sign of life of the interpreter while enabled [s]; 0: it is not watched.
        grace: how long stop() waits for a stuck driver before it calls the driver's stop() itself [s].
        buffer: how many seconds of records wait for the recorder at most [s]; what does not fit is counted.
        simulated_time: no thread and no waiting: ticks happen in :meth:`run`, and a run is the same every time.
        allocation_counter: address of a C function ``size_t f(void)`` that counts the calling thread's allocations.

    Raises:
        InputError: parts that do not fit together; a number out of range.
        ArmError: the arm's effort is not declared.
    """

    def __init__(
        self,
        arm: Arm,
        driver: SimulatedArm | Driver,
        *,
        pipeline: Pipeline | None = None,
        controller: Controller | None = None,
        limiter: SafetyLimiter | None = None,
        record: str | os.PathLike[str] | Recorder | None = None,
        fault_log: str | os.PathLike[str] | None = None,
        keep: float = 4.0,
        realtime: Realtime | None = None,
        patience: float = 0.1,
        lease: float = 1.0,
        grace: float = 2.0,
        buffer: float = 8.0,
        simulated_time: bool = False,
        allocation_counter: int = 0,
    ) -> None:
        self.arm, self.driver = arm, driver
        self.pipeline = Pipeline(arm) if pipeline is None else pipeline
        if arm.effort.kind == "phase_currents":
            raise InputError("a session takes one effort per joint; phase currents are not supported")
        if self.pipeline.arm.joint_names != arm.joint_names:
            raise InputError(f"the pipeline is of another arm than {arm.name!r}")
        if controller is None and limiter is not None:
            raise InputError("a limiter without a controller has nothing to limit")
        if isinstance(driver, SimulatedArm):
            if driver.arm.joint_names != arm.joint_names:
                raise InputError(f"the driver's joints are not those of arm {arm.name!r}")
            self._period_ns = driver.core.period_ns
        else:
            if driver.joint_names != arm.joint_names or driver.effort != arm.effort:
                raise InputError(f"the driver's joints or its effort are not those of arm {arm.name!r}")
            self._period_ns = driver.period_ns
        rate = 1e9 / self._period_ns
        for what, value in (("keep", keep), ("buffer", buffer)):
            if not 0.0 < value <= 3600.0:
                raise InputError(f"{what} must be above 0 and at most 3600 s, got {value!r}")
        if limiter is None and controller is not None:
            limiter = SafetyLimiter(arm)
        realtime = realtime or Realtime()
        self._simulated_time = simulated_time
        self._controller = controller
        self._records = max(16, math.ceil(buffer * rate))
        try:
            self._core = CoreSession(
                self.pipeline.arm.core,
                driver.core if isinstance(driver, SimulatedArm) else driver,
                self.pipeline.core,
                None if controller is None else controller.core,
                None if limiter is None else limiter.core,
                self._period_ns,
                simulated_time,
                patience,
                0.0 if simulated_time else lease,
                self._records,
                max(1, math.ceil(keep * rate)),
                realtime.priority,
                realtime.lock_memory,
                -1 if realtime.processor is None else realtime.processor,
                grace,
                allocation_counter,
            )
        except (ValueError, TypeError) as e:
            raise InputError(str(e).splitlines()[0]) from None
        self._keep, self._fault_log = keep, fault_log
        self._record = record
        self._writer: _Writer | None = None
        self._recorder_error: PalpateError | None = None
        self._connected_here = False
        self._drain: threading.Thread | None = None
        self._over = threading.Event()
        self._began = self._closed = self._ended = False
        self._granted: Granted | None = None
        self._dump: Path | None = None
        self._dump_complaint = ""

    # --- life ---------------------------------------------------------------------------------------------------

    def start(self) -> Self:
        """Connect the driver and begin to read; the drives stay off. Once.

        Raises:
            DriverError: the arm cannot be reached, or the session was started before.
            LogError: the recording cannot be made.
        """
        if self._began or self._closed:
            raise DriverError("a session is started once; make a new one")
        if not isinstance(self.driver, SimulatedArm) and self.driver.state == "closed":
            self.driver.connect()
            self._connected_here = True
        try:
            if self._record is not None:
                self._writer = _Writer(self._recorder(self._record), self.arm, self.pipeline)
            self._began = True
            if self._simulated_time:
                return self
            fifo, locked, pinned, complaint = self._core.start()
        except BaseException:
            self.close()
            raise
        self._granted = Granted(fifo, locked, pinned, complaint)
        if complaint:
            _logger.warning("not real time: %s", complaint)
        _open.add(self)
        self._drain = threading.Thread(target=_drain, args=(weakref.ref(self), self._over), daemon=True)
        self._drain.start()
        return self

    def stop(self) -> None:
        """The driver's safe command, now, and the end of the session's ticks. Again is harmless; never fails."""
        self._core.stop()

    def close(self) -> None:
        """Stop, take what is still to be recorded, close recording and driver. Again is harmless.

        Raises:
            LogError: the recording could not be written.
            DriverError: the driver cannot be closed.
        """
        if self._closed:
            return
        self._closed = True
        self.stop()
        _open.discard(self)
        self._over.set()
        if self._drain is not None:
            self._drain.join()
        try:
            if self._began:
                self._take()
                self._end_recording()
        finally:
            if self._connected_here and isinstance(self.driver, Driver):
                self.driver.close()
        if self._recorder_error is not None and self.mode != "fault":
            raise self._recorder_error

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
        if error is None:
            self._check()

    # --- asking -------------------------------------------------------------------------------------------------

    def enable(self, timeout: float = 30.0) -> None:
        """Switch the drives on; the arm holds where it is.

        Raises:
            DriverError: the drives refuse, no sample comes, the session is over.
            InputError: the session has no controller.
        """
        if self._controller is None:
            raise InputError("this session only watches: give it a controller")
        self._switch(True, timeout)

    def disable(self, timeout: float = 30.0) -> None:
        """Switch the drives off; reading goes on.

        Raises:
            DriverError: the session is over.
        """
        self._switch(False, timeout)

    def move_to(self, q: npt.ArrayLike, duration: float | None = None, *, speed: float = 0.5) -> float:
        """Go to joint positions `q` (n,) [rad] and stay there; a motion under way is taken over smoothly.

        Args:
            q: the goal.
            duration: of the motion [s]; None: from rest no joint would exceed `speed`.
            speed: [rad/s].

        Returns:
            the duration [s].

        Raises:
            InputError: not n finite numbers within the arm's limits, or no duration > 0.
            DriverError: the drives are off, or the session is over.
        """
        self._check()
        goal = np.ascontiguousarray(q, dtype=np.float64)
        if goal.shape != (self.arm.n,) or not np.isfinite(goal).all():
            raise InputError(f"move_to(): expected {self.arm.n} finite angles [rad], got {q!r:.80}")
        for joint, angle in zip(self.arm.joints, goal, strict=True):
            if not joint.limits.lower <= angle <= joint.limits.upper:
                raise InputError(
                    f"move_to(): {joint.name} {angle:.4g} rad is outside its limits "
                    f"{joint.limits.lower:.4g} to {joint.limits.upper:.4g} rad"
                )
        if self.mode != "enabled":
            raise DriverError(f"move_to() needs enable() first: the session is {self.mode}")
        if duration is None:
            if not (math.isfinite(speed) and speed > 0.0):
                raise InputError(f"move_to(): speed must be a number > 0 rad/s, got {speed!r}")
            state = self.state
            # a quintic's peak speed is 1.875 times its mean
            here = goal if state is None else state.touch.q
            duration = max(0.1, 1.875 * float(np.max(np.abs(goal - here))) / speed)
        if not 0.0 < duration < 1e6:
            raise InputError(f"move_to(): duration must be a number > 0 s, got {duration!r}")
        self._core.move_to(goal, float(duration))
        return float(duration)

    def set_gains(self, kp: npt.ArrayLike, kd: npt.ArrayLike) -> None:
        """Other gains from the next tick on: `kp` [N m/rad], `kd` [N m s/rad], one number or (n,).

        Raises:
            InputError: not finite numbers >= 0.
            DriverError: the session is over.
        """
        self._check()
        both = []
        for what, value in (("kp", kp), ("kd", kd)):
            array = np.asarray(value, dtype=np.float64)
            if array.shape not in ((), (self.arm.n,)) or not (np.isfinite(array) & (array >= 0.0)).all():
                raise InputError(f"{what}: expected a number >= 0 or {self.arm.n} of them, got {value!r:.60}")
            both.append(np.ascontiguousarray(np.broadcast_to(array, (self.arm.n,))))
        self._core.set_gains(*both)

    def tare(self) -> int:
        """Call zero what is weighed at the next tick at which the mass is ``ok``.

        Returns:
            the number of this tare: it is done when ``state.tares`` has come to it.

        Raises:
            DriverError: the session is over.
        """
        self._check()
        return self._core.tare()

    def run(self, seconds: float) -> None:
        """Let the session go on for so long [s]: in simulated time its ticks happen here, else this waits.

        Raises:
            DriverError: it ended by a fault meanwhile.
            InputError: not a number >= 0.
        """
        if not 0.0 <= seconds < math.inf:
            raise InputError(f"run(): expected a number >= 0 s, got {seconds!r}")
        if self._simulated_time:
            ticks = round(seconds * 1e9 / self._period_ns)
            while ticks > 0 and self.mode in ("watching", "enabled"):
                ticks -= self._tick(min(ticks, self._records // 2)) or ticks
        else:
            end = time.monotonic() + seconds
            while not self._core.left and (rest := end - time.monotonic()) > 0.0:
                time.sleep(min(rest, 0.02))
        self._check()

    # --- looking ------------------------------------------------------------------------------------------------

    @property
    def mode(self) -> Mode:
        """What the session does now."""
        mode: Mode = self._core.mode
        return mode

    @property
    def fault(self) -> str:
        """Why it ended; empty unless the mode is fault."""
        return self._core.fault

    @property
    def fault_log(self) -> Path | None:
        """Where the last seconds before a fault are; None: no fault, not written yet, or everything was recorded."""
        return self._dump

    @property
    def realtime(self) -> Granted | None:
        """What the operating system granted; None before the start and in simulated time."""
        return self._granted

    @property
    def state(self) -> SessionState | None:
        """The newest sample and what is known after it; None before the first. Does not touch the loop."""
        found = self._core.state()
        if found is None:
            return None
        core_touch, rows = found
        touch = self.pipeline.touch_of(core_touch)
        commanded = bool(rows["commanded"][0])
        tare, tare_std = float(rows["tare"][0]), float(rows["tare_std"][0])
        return SessionState(
            tick=int(rows["tick"][0]),
            mode=_MODES[rows["mode"][0]],
            sample=_sample(rows, 0),
            touch=touch,
            setpoint=Setpoint(rows["setpoint_q"][0], rows["setpoint_dq"][0], rows["setpoint_ddq"][0])
            if commanded
            else None,
            sent=rows["sent"][0] if commanded else None,
            control=Status(int(rows["control"][0])),
            net_mass=touch.payload.mass - tare,
            net_mass_std=math.hypot(touch.payload.mass_std, tare_std),
            tares=int(rows["tares"][0]),
        )

    @property
    def statistics(self) -> SessionStatistics:
        """Counted so far."""
        raw = self._core.statistics()
        for name in ("own", "own_processor", "driver", "late"):
            raw[name] = Durations(**raw[name])
        return SessionStatistics(**raw)

    # --- inside -------------------------------------------------------------------------------------------------

    def _check(self) -> None:
        if self.mode == "fault":
            if self._drain is not None:
                self._drain.join()  # it ends with the loop, once everything is written
            else:
                self._take()
                self._end_recording()
            where = "" if self._dump is None else f"; the last seconds are in {self._dump}"
            raise DriverError(f"the session ended: {self.fault}{where}{self._dump_complaint}")
        if self.mode == "stopped" and not self._closed:
            raise DriverError("the session has been stopped; make a new one")

    def _tick(self, most: int) -> int:
        """Ticks in simulated time; how many happened."""
        done = self._core.tick(most)
        self._take()
        return done

    def _switch(self, on: bool, timeout: float) -> None:
        self._check()
        if not self._began:
            raise DriverError("enable() needs start() first")
        if (self.mode == "enabled") == on:
            return
        before = self._core.switched
        self._core.enable(on)
        what = "the drives were not switched " + ("on" if on else "off")
        self._until(lambda: self._core.switched != before, timeout, what)

    def _until(self, condition: Callable[[], bool], timeout: float, complaint: str) -> None:
        """Tick or wait until the loop has done something; `timeout` [s]."""
        end = time.monotonic() + timeout
        left = max(2, round(timeout * 1e9 / self._period_ns))
        while not condition():
            self._check()
            if self._simulated_time:
                left -= self._tick(1)
            else:
                time.sleep(1e-3)
            if left <= 0 or (not self._simulated_time and time.monotonic() > end):
                self.stop()
                raise DriverError(
                    f"{complaint} within {timeout:g} s: no usable sample? The session was stopped"
                )

    def _recorder(self, record: str | os.PathLike[str] | Recorder) -> Recorder:
        if isinstance(record, Recorder):
            return record
        return Recorder(
            record, self.arm.joint_names, session=self._describe(), frame_id=self.arm.base, overwrite=True
        )

    def _describe(self) -> dict[str, str]:
        """What a recording must say to be replayed."""
        texts = {
            "palpate_version": __version__,
            "pipeline": json.dumps(self.pipeline.options()),
            "effort_unit": "A" if self.arm.effort.kind == "current" else "N m",
        }
        try:
            texts["arm_card"] = card_text(self.arm)
        except MissingExtraError as e:
            texts["arm"] = f"{self.arm.name}; no card, because {e}"
        return texts

    def _take(self) -> None:
        """Move what waits in the ring into the recording."""
        while True:
            rows = self._core.take(_BATCH)
            if not len(rows["time_ns"]):
                return
            if self._writer is None or self._recorder_error is not None:
                continue
            try:
                self._writer.write(rows)
            except PalpateError as e:
                # the arm goes on; whoever closes the session is told
                self._recorder_error = e
                _logger.error("recording stopped: %s", e)

    def _end_recording(self) -> None:
        """Close the recording; after a fault say why, and leave the last seconds somewhere. Again is harmless."""
        if self._ended:
            return
        self._ended = True
        try:
            if self._writer is not None and self._recorder_error is None:
                if self.mode == "fault":
                    self._writer.event("fault", self.fault)
                self._writer.close()
        except PalpateError as e:
            self._recorder_error = e
        if self.mode == "fault" and (self._writer is None or self._recorder_error is not None):
            try:
                self._dump_black_box()
            except PalpateError as e:  # the fault itself is what must be told
                self._dump_complaint = f"; the last seconds could not be kept: {e}"

    def _dump_black_box(self) -> None:
        rows = self._core.black_box()
        if not len(rows["time_ns"]):
            return
        if self._fault_log is None:
            handle, name = tempfile.mkstemp(prefix="palpate-fault-", suffix=".mcap")
            os.close(handle)
        else:
            name = os.fspath(self._fault_log)
        writer = _Writer(self._recorder(name), self.arm, self.pipeline)
        writer.write(rows)
        writer.event("fault", self.fault)
        writer.close()
        self._dump = Path(name)
        _logger.error("the session ended: %s; the last seconds are in %s", self.fault, name)


_MODES: tuple[Mode, ...] = ("watching", "enabled", "stopped", "fault")


def _drain(session: weakref.ref[Session], over: threading.Event) -> None:
    """Show life, and record what the loop leaves; holds the session only while at it."""
    while not over.wait(_DRAIN_S):
        alive = session()
        if alive is None:
            return
        alive._core.renew()
        left = alive._core.left  # before the look: what comes after it was seen
        alive._take()
        if left:
            alive._end_recording()
            return
        del alive


def _close_all() -> None:
    """The interpreter ends: arms first."""
    for session in list(_open):
        try:
            session.close()
        except PalpateError as e:
            _logger.error("%s", e)


atexit.register(_close_all)


def card_text(arm: Arm) -> str:
    """The arm's card as text.

    Raises:
        MissingExtraError: the extra ``card`` is not installed.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "arm.yaml"
        arm.save(path)
        return path.read_text(encoding="utf-8")


def _sample(rows: Mapping[str, Any], i: int) -> Sample:
    return Sample(
        int(rows["time_ns"][i]),
        rows["position"][i],
        rows["velocity"][i] if rows["has_velocity"][i] else None,
        rows["effort"][i],
        rows["model_torque"][i] if rows["has_model_torque"][i] else None,
    )


class _Writer:
    """Records of a session into a recording."""

    def __init__(self, recorder: Recorder, arm: Arm, pipeline: Pipeline) -> None:
        self._recorder = recorder
        self._gain = arm.effort.gain(arm.n)
        self._wrench, self._contact = pipeline.wrench is not None, pipeline.contact is not None
        self._last_ns = 0

    def write(self, rows: Mapping[str, Any]) -> None:
        """Everything in a batch of records.

        Raises:
            LogError: it cannot be written.
        """
        recorder, touch = self._recorder, rows["touch"]
        effort_sent = rows["sent"] / self._gain
        for i, time_ns in enumerate(rows["time_ns"].tolist()):
            sample = _sample(rows, i)
            recorder.sample(*sample)
            recorder.external_torque(time_ns, touch["torque"][i], touch["torque_std"][i])
            recorder.payload(time_ns, touch["mass"][i], touch["mass_std"][i])
            states = {
                "sample": int(touch["status"][i]),
                "external_torque": int(touch["external_status"][i]),
                "payload": int(touch["payload_status"][i]),
                "control": int(rows["control"][i]),
            }
            if self._wrench:
                wrench = touch["wrench"]
                states["wrench"] = int(wrench["status"][i])
                recorder.signal("wrench_force", time_ns, wrench["force"][i], "N")
                recorder.signal("wrench_moment", time_ns, wrench["moment"][i], "N m")
            if self._contact:
                contact = touch["contact"]
                states["contact"] = int(contact["status"][i])
                recorder.signal("contact_link", time_ns, float(contact["link"][i]), "1")
            recorder.status(time_ns, **states)
            if rows["commanded"][i]:
                recorder.setpoint(time_ns, rows["setpoint_q"][i], rows["setpoint_dq"][i])
                recorder.command(time_ns, effort_sent[i])
            self._last_ns = time_ns

    def event(self, kind: str, text: str) -> None:
        """Something happened at the newest sample."""
        self._recorder.event(self._last_ns, kind, text)

    def close(self) -> None:
        """Finish the recording."""
        self._recorder.close()


__all__ = [
    "Durations",
    "Granted",
    "Mode",
    "Realtime",
    "Session",
    "SessionState",
    "SessionStatistics",
    "SimulatedArm",
    "card_text",
]
