"""A Universal Robots arm behind the driver contract, by the ur_rtde client. Needs ``palpate[ur]``.

Facts about the controller (ports, packages, fields, safety bits, CB3 at 125 Hz and later series at 500 Hz) are those of
the vendor's RTDE guide; what ur_rtde's control program does was measured with ur_rtde 1.6.5.
"""

from __future__ import annotations

import contextlib
import json
import select
import socket
import struct
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, Literal, TypeAlias, get_args

import numpy as np
import numpy.typing as npt

from ..arm import Arm, Array
from ..errors import DriverError, MissingExtraError
from ..logs import Sample
from .driver import Driver

Mode: TypeAlias = Literal["torque", "speed", "servo", "force"]
"""What is commanded: direct torque, joint speeds, joint positions, or a force at the tool."""

_PORT = 30004
_FIELDS = (
    "timestamp",
    "actual_q",
    "actual_qd",
    "actual_current",
    "target_moment",
    "robot_mode",
    "robot_status_bits",
    "safety_status_bits",
)
_TORQUE_SINCE = (5, 26)
_CB3 = 3
_RUNNING = 7  # robot_mode: brakes released
_PROGRAM = 1 << 1  # robot_status_bits
# safety_status_bits, the graver first
_SAFETY = (
    (9, "fault"),
    (8, "violation"),
    (7, "emergency stop"),
    (6, "emergency stop"),
    (5, "emergency stop"),
    (4, "safeguard stop"),
    (2, "protective stop"),
    (3, "recovery"),
    (10, "stopped for safety"),
    (1, "reduced"),
)
_MOVABLE = ("normal", "reduced")
_WRENCH = ("Fx", "Fy", "Fz", "Tx", "Ty", "Tz")
_SILENCE_S = 1.0  # without a package for so long the connection is lost
_CONNECT_S = 2.0
_START_S = 5.0
_DECELERATION = 4.0  # of the leading joint when the drives are stopped [rad/s^2]
_LOOKAHEAD_S = 0.1
_SERVO_GAIN = 300.0


class UrDriver(Driver):
    """Reads a UR at its own rate and, if asked to, moves it.

    A sample holds measured positions, velocities and motor currents, and as model torque the controller's own
    ``target_moment``, unless a payload is set there: that torque is then not the bare arm's and is left out. Time is
    the controller's, since it was switched on. Effort is motor current: ``Effort.current(k_t, gear)`` in the arm.

    **What write() means.** A UR is position controlled and in general takes no torque. Without a `mode` the driver
    watches: enable() is refused. With ``mode="torque"`` (PolyScope 5.26 and later) write() takes link-side torque as
    every driver does; the controller adds gravity by itself, so gravity of `arm` is subtracted before sending: the
    arm must be the one the controller knows, payload included. In the other modes write() is refused, and
    :meth:`speed`, :meth:`servo` or :meth:`force` command. The controller's own limits hold in every mode.

    enable() starts ur_rtde's control program on the robot (remote control must be on), under a watchdog: without a
    command for `watchdog` seconds the controller ends the program and holds the arm. disable() and stop() brake the
    arm, end the program and leave the arm held in position by its controller: the safe torque here is what holds it.
    A protective or emergency stop ends control in the next read(), which still returns the sample; the next command's
    error names it. Where packages stay away, read() returns None, and raises DriverError after `watchdog` seconds if
    enabled, after 1 s otherwise; close() and connect() then reach the controller anew.

    Args:
        arm: of six joints; its effort is of kind current, or undeclared if the arm is only watched.
        host: name or address of the controller.
        mode: what is commanded; None: nothing.
        frequency: packages per second [Hz]; a CB3 sends 125 at most, later series 500.
        watchdog: longest time without a command while enabled [s].

    Raises:
        DriverError: the arm has not six joints or its effort is not a current; mode, frequency or watchdog is not one
            of the choices.
    """

    def __init__(
        self,
        arm: Arm,
        host: str,
        *,
        mode: Mode | None = None,
        frequency: float = 500.0,
        watchdog: float = 0.1,
    ) -> None:
        if arm.n != 6:
            raise DriverError(f"a UR has 6 joints, arm {arm.name!r} has {arm.n}")
        if arm.effort.kind not in ("current", "undeclared"):
            raise DriverError(
                f"a UR reports motor current: declare Effort.current(k_t, gear), not {arm.effort.kind}"
            )
        if mode is not None and mode not in get_args(Mode):
            raise DriverError(f"mode must be None, {', '.join(map(repr, get_args(Mode)))}, got {mode!r}")
        if not 1.0 <= frequency <= 500.0:
            raise DriverError(f"frequency must be between 1 and 500 Hz, got {frequency!r}")
        if not 2.0 / frequency <= watchdog <= 1.0:
            raise DriverError(f"watchdog must be two periods to 1 s, got {watchdog!r}")
        if mode == "torque" and not arm.has_dynamics:
            raise DriverError(f"mode 'torque' needs the masses of arm {arm.name!r}, to subtract its gravity")
        super().__init__(arm.joint_names, round(1e9 / frequency), arm.effort)
        self._arm, self._host, self._mode = arm, host, mode
        self._frequency, self._watchdog = float(frequency), float(watchdog)
        self._limit = np.array([j.limits.effort for j in arm.joints])
        self._version = (0, 0)
        self._has_payload = False
        self._receive: Any = None
        self._control: _Control | None = None
        self._stamp = 0.0
        self._arrived = 0.0
        self._q: Array = np.zeros(6)
        self._lost = 0

    @property
    def version(self) -> tuple[int, int]:
        """Major and minor version of the controller's software; (0, 0) before connect()."""
        return self._version

    @property
    def lost(self) -> int:
        """Packages that were not read since connect(): never arrived, or overtaken by a newer one."""
        return self._lost

    @property
    def safety(self) -> str:
        """What the controller says of its safety: normal, reduced, protective stop, emergency stop, ...

        Raises:
            DriverError: not connected.
        """
        if self._receive is None:
            raise DriverError("safety needs connect() first: the driver is closed")
        bits = self._receive.getSafetyStatusBits()
        return next((name for bit, name in _SAFETY if bits >> bit & 1), "normal")

    def speed(self, dq: npt.ArrayLike, acceleration: float = 1.0) -> Array:
        """Move on at joint speeds `dq` (6,) [rad/s], reached by `acceleration` [rad/s^2] of the leading joint.

        Returns:
            (6,) what was sent [rad/s].

        Raises:
            DriverError: as in :meth:`write`; the mode is not "speed".
        """

        def send(dq: Array) -> Array:
            self._transmit("speed", "speedJ", dq.tolist(), float(acceleration), 0.0)
            return dq

        return self._checked("speed()", "speed", "rad/s", dq, self._joint_names, send)

    def servo(self, q: npt.ArrayLike) -> Array:
        """Follow joint positions `q` (6,) [rad], one after the other: near where the arm is, once per period.

        Returns:
            (6,) what was sent [rad].

        Raises:
            DriverError: as in :meth:`write`; the mode is not "servo".
        """

        def send(q: Array) -> Array:
            period = 1.0 / self._frequency
            self._transmit("servo", "servoJ", q.tolist(), 0.0, 0.0, period, _LOOKAHEAD_S, _SERVO_GAIN)
            return q

        return self._checked("servo()", "position", "rad", q, self._joint_names, send)

    def force(
        self,
        wrench: npt.ArrayLike,
        *,
        axes: tuple[bool, bool, bool, bool, bool, bool] = (True, True, True, False, False, False),
        frame: npt.ArrayLike = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        limits: npt.ArrayLike = (0.1, 0.1, 0.1, 0.2, 0.2, 0.2),
    ) -> Array:
        """Push the environment with a wrench along the chosen axes; the arm holds its place along the others.

        Args:
            wrench: (6,) force [N] and torque [N m] by which the tool acts on the environment, in `frame`.
            axes: which of the six yield, so that their force is reached.
            frame: (6,) position [m] and rotation vector [rad] of the frame in the base.
            limits: (6,) largest speed along yielding axes [m/s, rad/s]; largest deviation along the others [m, rad].

        Returns:
            (6,) what was sent.

        Raises:
            DriverError: as in :meth:`write`; the mode is not "force"; frame or limits are not 6 finite numbers.
        """

        def send(wrench: Array) -> Array:
            rest = [np.asarray(v, dtype=np.float64) for v in (frame, limits)]
            if len(axes) != 6 or any(v.shape != (6,) or not np.isfinite(v).all() for v in rest):
                raise DriverError("force(): axes, frame and limits must be 6 finite numbers each")
            chosen, kind = [int(bool(a)) for a in axes], 2
            self._transmit(
                "force", "forceMode", rest[0].tolist(), chosen, wrench.tolist(), kind, rest[1].tolist()
            )
            return wrench

        return self._checked("force()", "wrench", "N, N m", wrench, _WRENCH, send)

    def _connect(self) -> None:
        try:
            import rtde_control  # noqa: F401  # what enable() will need is missed here already
            import rtde_receive
        except ImportError:
            raise MissingExtraError("ur", "a UR arm") from None
        self._version, types = _probe(self._host, self._frequency)
        if self._version[0] <= _CB3 and self._frequency > 125.0:
            raise DriverError(
                f"connect(): the controller at {self._host} is a CB3, which sends 125 packages per second: "
                "give frequency=125"
            )
        unknown = [name for name in _FIELDS if types[name] == "NOT_FOUND"]
        if unknown:
            raise DriverError(f"connect(): the controller at {self._host} does not know {', '.join(unknown)}")
        self._has_payload = types["payload"] != "NOT_FOUND"
        fields = [*_FIELDS, "payload"] if self._has_payload else list(_FIELDS)
        try:
            self._receive = rtde_receive.RTDEReceiveInterface(self._host, self._frequency, fields)
        except RuntimeError as error:
            raise DriverError(f"connect(): {self._host}: {error}") from None
        self._stamp = -1.0
        try:
            self._await_package("connect()")
        except DriverError:
            self._close()
            raise
        self._lost = 0

    def _await_package(self, verb: str) -> None:
        """Read and pass over the next package, so that commands start from what is true now."""
        deadline = time.monotonic() + _CONNECT_S
        while self._fresh() is None:
            if time.monotonic() > deadline:
                raise DriverError(f"{verb}: the controller at {self._host} sends nothing")
            time.sleep(1e-3)

    def _fresh(self) -> Sample | None:
        """The newest package, if it was not read yet; its numbers are all of one instant."""
        receive = self._receive
        stamp = receive.getTimestamp()
        if stamp == self._stamp or stamp == 0.0:
            return None
        while True:
            q, dq = receive.getActualQ(), receive.getActualQd()
            current, moment = receive.getActualCurrent(), receive.getTargetMoment()
            payload = receive.getPayload() if self._has_payload else 1.0
            after = receive.getTimestamp()
            if after == stamp:
                break
            stamp = after
        if stamp < self._stamp:
            raise DriverError(f"the controller at {self._host} was restarted; close() and connect() again")
        self._lost += max(0, round((stamp - self._stamp) * self._frequency) - 1)
        self._stamp, self._arrived = stamp, time.monotonic()
        self._q = np.array(q)
        model = np.array(moment) if payload == 0.0 else None
        return Sample(round(stamp * 1e9), self._q.copy(), np.array(dq), np.array(current), model)

    def _read(self) -> Sample | None:
        period = 1.0 / self._frequency
        begin = time.monotonic()
        while (sample := self._fresh()) is None:
            now = time.monotonic()
            patience = self._watchdog if self._state == "enabled" else _SILENCE_S
            if now - self._arrived > patience:
                raise DriverError(
                    f"no package from the controller at {self._host} for {now - self._arrived:.2f} s; "
                    "close() and connect() again"
                )
            if now - begin > 2.0 * period:
                return None
            time.sleep(0.1 * period)
        if self._state == "enabled":
            complaint = self._hindrance()
            if not complaint and not self._receive.getRobotStatus() & _PROGRAM:
                complaint = "the control program on the robot has ended: its watchdog, the pendant or a fault"
            if complaint:
                self._stop_because(complaint)
        return sample

    def _hindrance(self) -> str:
        """Why the robot cannot move; empty if it can."""
        if self.safety not in _MOVABLE:
            return f"the controller reports: {self.safety}"
        if self._receive.getRobotMode() != _RUNNING:
            return f"the robot is not running (robot mode {self._receive.getRobotMode()})"
        return ""

    def _enable(self) -> None:
        if self._mode is None:
            raise DriverError(
                "enable(): this driver watches the arm only; "
                f"to command it, give it a mode: {', '.join(map(repr, get_args(Mode)))}"
            )
        if self._mode == "torque" and self._version < _TORQUE_SINCE:
            raise DriverError(
                "enable(): direct torque needs PolyScope 5.26, "
                f"the controller at {self._host} has {self._version[0]}.{self._version[1]}"
            )
        hindrance = self._hindrance()
        if hindrance:
            raise DriverError(f"enable(): {hindrance}; clear that on the pendant first")
        if self._control is None or self._control.ended:
            self._control = _Control(self._host, self._frequency)
        else:
            self._control.call("reuploadScript")
        deadline = time.monotonic() + _START_S
        while not (self._receive.getRobotStatus() & _PROGRAM and self._control.call("isProgramRunning")):
            if time.monotonic() > deadline:
                raise DriverError(f"enable(): the control program did not start within {_START_S:g} s")
            time.sleep(1e-3)
        guarded = self._control.call("setWatchdog", 1.0 / self._watchdog)
        if not guarded:
            raise DriverError("enable(): the controller did not accept the watchdog")
        if self._mode == "torque":
            self._control.call("directTorque", [0.0] * 6, [0.0] * 6, [0.0] * 6)
        self._await_package("enable()")

    def _write(self, torque: Array) -> Array:
        if self._mode != "torque":
            raise DriverError(
                f"write(): a UR in mode {self._mode!r} takes no torque; call {self._mode}(), "
                "or give the driver mode='torque'"
            )
        sent = np.clip(torque, -self._limit, self._limit)
        added = sent - self._arm.gravity_torque(self._q)
        # no friction compensation: what is sent is what acts
        self._transmit("torque", "directTorque", added.tolist(), [0.0] * 6, [0.0] * 6)
        return sent

    def _transmit(self, mode: Mode, verb: str, *arguments: Any) -> None:
        """Hand a command to ur_rtde; never over a connection that was silent, which it would mend and send stale."""
        if mode != self._mode:
            raise DriverError(f"{mode}(): this driver was made with mode={self._mode!r}")
        age = time.monotonic() - self._arrived
        if age > self._watchdog:
            raise DriverError(f"the last sample is {age:.2f} s old; read() comes before every command")
        assert self._control is not None  # enabled
        if not self._control.call(verb, *arguments, patience=self._watchdog):
            raise DriverError(f"{self._host} refused {verb}: {self._hindrance() or 'its program has ended'}")

    def _disable(self) -> None:
        control = self._control
        if control is None or control.ended:
            return  # without commands the controller's watchdog stops the arm
        silent = self._receive.getTimestamp() == self._stamp
        if silent and time.monotonic() - self._arrived > self._watchdog:
            control.end()  # nobody hears a command: the watchdog again
            return
        if not self._receive.getRobotStatus() & _PROGRAM:
            return
        if self._mode == "speed":
            control.call("speedStop", _DECELERATION)
        elif self._mode == "servo":
            control.call("servoStop", _DECELERATION)
        elif self._mode == "force":
            control.call("forceModeStop")
        else:
            control.call("stopJ", _DECELERATION)
        control.call("stopScript")

    def _close(self) -> None:
        control, receive = self._control, self._receive
        self._control = self._receive = None
        if control is not None:
            control.end()
        if receive is not None:
            receive.disconnect()


class _Control:
    """ur_rtde's control client in a process that can be killed; see ``_ur_control.py``.

    Raises:
        DriverError: the controller does not let itself be controlled.
    """

    def __init__(self, host: str, frequency: float) -> None:
        self._host = host
        self._process = subprocess.Popen(
            [sys.executable, str(Path(__file__).with_name("_ur_control.py")), host, str(frequency)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )
        try:
            self.call("connect", patience=2.0 * _START_S)
        except DriverError:
            self.end()
            raise

    @property
    def ended(self) -> bool:
        """True when no call is possible any more."""
        return self._process.poll() is not None

    def call(self, verb: str, *arguments: Any, patience: float = _CONNECT_S) -> Any:
        """What the client's `verb` returns; without an answer within `patience` seconds the client is ended."""
        stdin, stdout = self._process.stdin, self._process.stdout
        assert stdin is not None and stdout is not None  # pipes were asked for
        line = b""
        if not self.ended:
            with contextlib.suppress(BrokenPipeError):  # it ended just now: there is no line
                stdin.write(json.dumps([verb, arguments]).encode() + b"\n")
                stdin.flush()
                ready, _, _ = select.select([stdout], [], [], patience)
                line = stdout.readline() if ready else b""
        if not line:
            self.end()
            raise DriverError(f"{verb}: no answer by way of ur_rtde from {self._host} within {patience:g} s")
        answer, *complaint = json.loads(line)
        if complaint:
            raise DriverError(f"{verb}: {self._host}: {' '.join(complaint[0].split())}")
        return answer

    def end(self) -> None:
        """End the client now; its connections are closed by that."""
        self._process.kill()
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            assert pipe is not None
            with contextlib.suppress(BrokenPipeError):  # a command that was under way
                pipe.close()


def _probe(host: str, frequency: float) -> tuple[tuple[int, int], dict[str, str]]:
    """Version of the controller and types of the fields, by a short visit: ur_rtde crashes on what is no controller."""
    names = (*_FIELDS, "payload")
    what = f"connect(): {host}:{_PORT}"
    try:
        with socket.create_connection((host, _PORT), timeout=_CONNECT_S) as sock:
            accepted = _ask(sock, b"V", struct.pack(">H", 2))
            version = _ask(sock, b"v", b"")
            types = _ask(sock, b"O", struct.pack(">d", frequency) + ",".join(names).encode())
    except OSError as error:
        raise DriverError(
            f"{what}: no UR controller answers ({error}); is the robot on, the address right, the service RTDE enabled?"
        ) from None
    kinds = types[1:].decode("ascii", "replace").split(",")
    if accepted != b"\x01" or len(version) != 16 or len(kinds) != len(names):
        raise DriverError(f"{what}: something else than a UR controller answers")
    major, minor, _, _ = struct.unpack(">4I", version)
    return (major, minor), dict(zip(names, kinds, strict=True))


def _ask(sock: socket.socket, kind: bytes, payload: bytes) -> bytes:
    """One RTDE request and the answer to it; other packages, such as text messages, are passed over."""
    sock.sendall(struct.pack(">H", 3 + len(payload)) + kind + payload)
    for _ in range(100):
        size, answered = struct.unpack(">Hc", _exactly(sock, 3))
        answer = _exactly(sock, max(0, size - 3))
        if answered == kind:
            return answer
    raise ConnectionError("no RTDE answer among 100 packages")


def _exactly(sock: socket.socket, count: int) -> bytes:
    data = b""
    while len(data) < count:
        part = sock.recv(count - len(data))
        if not part:
            raise ConnectionError("the connection was closed")
        data += part
    return data
