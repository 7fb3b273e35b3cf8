"""A KUKA LBR behind the driver contract, by its Fast Robot Interface (FRI). Needs ``palpate[fri]``.

An independent client, written from public facts about the messages (numbers of fields, order of the session); no code
of the vendor's. **Those facts were never checked against a KUKA controller**: none was at hand.
"""

from __future__ import annotations

import math
import socket
import time
from collections.abc import Mapping
from typing import Any, Literal, TypeAlias, get_args

import numpy as np
import numpy.typing as npt

from ..arm import Arm, Array, Effort
from ..errors import DriverError, MissingExtraError
from ..logs import Sample
from .driver import Driver

Mode: TypeAlias = Literal["torque", "position", "wrench"]
"""What is laid over the robot program's motion: joint torque, joint position, or a wrench at the tool."""

_MONITORING_ID, _COMMAND_ID = 0x245142, 0x34001
_MAX_BYTES = 1500
_PORTS = range(30200, 30210)

_STATES = ("IDLE", "MONITORING_WAIT", "MONITORING_READY", "COMMANDING_WAIT", "COMMANDING_ACTIVE")
_COMMANDING_WAIT, _COMMANDING_ACTIVE = 3, 4
_QUALITIES = ("POOR", "FAIR", "GOOD", "EXCELLENT")
_COMMAND_MODES = ("NONE", "POSITION", "WRENCH", "TORQUE")
_CONTROL_MODES = ("POSITION", "CARTESIAN_IMPEDANCE", "JOINT_IMPEDANCE", "NONE")
_SAFETY = ("NORMAL", "STOP_0", "STOP_1", "STOP_2")
_DRIVES = ("OFF", "TRANSITIONING", "ACTIVE")
# mode: (client command mode, control mode it needs; None: any)
_NEEDS: Mapping[str, tuple[str, str | None]] = {
    "position": ("POSITION", None),
    "wrench": ("WRENCH", "CARTESIAN_IMPEDANCE"),
    "torque": ("TORQUE", "JOINT_IMPEDANCE"),
}
_WRENCH = ("Fx", "Fy", "Fz", "tauA", "tauB", "tauC")
_ENABLE_S = 10.0

# message: {field: (number, type)}; a star is for repeated, a capital letter for a message. Only what is used: these
# numbers are the same in FRI 1.15 and 2.5, and what else a message holds is passed over
_FIELDS: Mapping[str, Mapping[str, tuple[int, str]]] = {
    "Header": {"message_id": (1, "fixed32"), "sequence": (2, "uint32"), "reflected": (3, "uint32")},
    "Joints": {"value": (1, "double*")},
    "Vector": {"element": (1, "double*")},
    "Time": {"sec": (1, "uint32"), "nanosec": (2, "uint32")},
    "RobotInfo": {
        "joints": (1, "int32"),
        "safety_state": (2, "int32"),
        "drive_state": (5, "int32*"),
        "control_mode": (7, "int32"),
    },
    "MonitorData": {
        "measured_position": (1, "Joints"),
        "measured_torque": (2, "Joints"),
        "external_torque": (5, "Joints"),
        "timestamp": (15, "Time"),
    },
    "ConnectionInfo": {
        "session_state": (1, "int32"),
        "quality": (2, "int32"),
        "send_period": (3, "uint32"),
        "receive_multiplier": (4, "uint32"),
    },
    "IpoData": {"joint_position": (1, "Joints"), "command_mode": (10, "int32")},
    "Monitoring": {
        "header": (1, "Header"),
        "robot": (2, "RobotInfo"),
        "monitor": (3, "MonitorData"),
        "connection": (4, "ConnectionInfo"),
        "ipo": (5, "IpoData"),
    },
    "CommandData": {
        "joint_position": (1, "Joints"),
        "wrench": (2, "Vector"),
        "joint_torque": (3, "Joints"),
    },
    "Command": {"header": (1, "Header"), "data": (2, "CommandData")},
}


class FriDriver(Driver):
    """Reads a KUKA LBR (iiwa, Med) over FRI and, if asked to, lays torque, position or wrench over its motion.

    The controller opens the session: its robot program sends a monitoring message every `period` to this computer,
    and each is answered with its sequence counter reflected. A sample holds measured position and torque; velocity is
    not measured. Time is the controller's. Messages that come twice or after a newer one are passed over, as are
    those of other senders or other make; :attr:`lost`, :attr:`refused` and :attr:`late` count.

    **What write() means.** Without a `mode` the driver monitors: enable() is refused. With ``mode="torque"`` the
    robot program must run a joint impedance motion with FRI's torque overlay; the controller adds gravity by itself,
    so gravity of `arm`, as the controller knows it with its tool, is subtracted before sending. write() returns what
    acts if the impedance is soft (stiffness zero): a stiff one adds its spring. In mode "position" (any control mode)
    :meth:`position` commands, in mode "wrench" (Cartesian impedance) :meth:`wrench`; write() is refused.

    enable() waits until the robot program commands (COMMANDING_ACTIVE), mirroring the interpolated position meanwhile.
    Every message is answered once: by the first command after the read() that returned it, or else, by the next
    read(), with the interpolated position and no torque or wrench, the safe torque here. **A command is never sent
    for a later message than the one it was made for.** When the session falls back or safety stops the arm, the
    sample is still returned, control ends, and the next command's error says why. read() returns None if no message
    came within two periods and raises DriverError after `patience` seconds.

    Answers leave from Python. It is not real time: on an idle computer an answer takes a fraction of a 2 ms period,
    and nothing guarantees that the next one will; the controller then lowers the quality of the connection and ends
    commanding by its own rules.

    Args:
        arm: as many joints as the robot; joint order and signs are KUKA's.
        mode: what is commanded; None: nothing.
        period: time between monitoring messages, as set in the robot program [s], 1 to 100 ms.
        port: UDP port that the controller sends to, 30200 to 30209.
        address: of this computer's interface; all of them by default.
        controller: address of the controller; None: the first that sends a monitoring message.
        torque_sign: +1 if a positive measured torque pushes the joint in its positive direction, -1 if not. Hold
            something up and look before relying on it: the convention was not checked on a robot.
        patience: longest silence [s].

    Raises:
        DriverError: an argument is not one of the choices.
        MissingExtraError: protobuf is not installed.
    """

    def __init__(
        self,
        arm: Arm,
        *,
        mode: Mode | None = None,
        period: float = 0.002,
        port: int = 30200,
        address: str = "0.0.0.0",
        controller: str | None = None,
        torque_sign: int = 1,
        patience: float = 1.0,
    ) -> None:
        if mode is not None and mode not in get_args(Mode):
            raise DriverError(f"mode must be None, {', '.join(map(repr, get_args(Mode)))}, got {mode!r}")
        if not 0.001 <= period <= 0.1:
            raise DriverError(f"period must be between 0.001 and 0.1 s, got {period!r}")
        if port not in _PORTS:
            raise DriverError(f"port must be {_PORTS[0]} to {_PORTS[-1]}, got {port!r}")
        if torque_sign not in (1, -1):
            raise DriverError(f"torque_sign must be 1 or -1, got {torque_sign!r}")
        if not 2.0 * period <= patience <= 60.0:
            raise DriverError(f"patience must be two periods to 60 s, got {patience!r}")
        if mode == "torque" and not arm.has_dynamics:
            raise DriverError(f"mode 'torque' needs the masses of arm {arm.name!r}, to subtract its gravity")
        super().__init__(arm.joint_names, round(1e9 * period), Effort.torque())
        self._arm, self._mode = arm, mode
        self._port, self._address, self._controller = port, address, controller
        self._sign, self._patience = float(torque_sign), float(patience)
        self._limit = np.array([j.limits.effort for j in arm.joints])
        self._messages, self._undecodable = _messages()
        self._socket: socket.socket | None = None
        self._forget()

    def _forget(self) -> None:
        """Nothing has been received yet."""
        self._peer: tuple[str, int] | None = None
        self._expected: str | None = None  # IP address
        self._monitoring: Any = None  # the newest message
        self._stamp_ns = -1
        self._arrived = 0.0
        self._due = False  # the newest message is to be answered and was not yet
        self._unanswered = 0
        self._sequence = 0
        self._sent: Array | None = None
        self._lost = self._refused = self._late = 0

    @property
    def lost(self) -> int:
        """Monitoring messages since connect() that never came, or were overtaken by a newer one."""
        return self._lost

    @property
    def refused(self) -> int:
        """Datagrams since connect() that were passed over: old, doubled, damaged, or of another sender."""
        return self._refused

    @property
    def late(self) -> int:
        """Answers since connect() that left more than a period after their message had come."""
        return self._late

    @property
    def session(self) -> str:
        """State of the session, quality of the connection and safety, e.g. "MONITORING_READY, GOOD, NORMAL".

        Raises:
            DriverError: nothing was received yet.
        """
        if self._monitoring is None:
            raise DriverError("session needs connect() first: nothing was received yet")
        connection = self._monitoring.connection
        return ", ".join(
            (
                _name(_STATES, connection.session_state),
                _name(_QUALITIES, connection.quality),
                _name(_SAFETY, self._monitoring.robot.safety_state),
            )
        )

    @property
    def external(self) -> Array:
        """(n,) the controller's own estimate of the external torque in the newest message, KUKA's sign [N m].

        Raises:
            DriverError: nothing was received yet, or the message does not hold it.
        """
        if self._monitoring is None:
            raise DriverError("external needs connect() first: nothing was received yet")
        values = self._monitoring.monitor.external_torque.value
        if len(values) != self.n:
            raise DriverError(f"the controller sends {len(values)} external torques, not {self.n}")
        return np.array(values)

    def position(self, q: npt.ArrayLike) -> Array:
        """Command joint positions `q` (n,) [rad] for this period: near the interpolated ones, the robot checks.

        Returns:
            (n,) what was sent [rad].

        Raises:
            DriverError: as in :meth:`write`; the mode is not "position".
        """

        def send(q: Array) -> Array:
            self._need("position")
            return self._transmit(q, position=q)

        return self._checked("position()", "position", "rad", q, self._joint_names, send)

    def wrench(self, wrench: npt.ArrayLike) -> Array:
        """Lay a wrench over the motion for this period.

        Args:
            wrench: (6,) [Fx Fy Fz tauA tauB tauC] in the axes of the current motion centre [N, N m]; tauA turns
                about z, tauB about y, tauC about x, as in KUKA's frames.

        Returns:
            (6,) what was sent.

        Raises:
            DriverError: as in :meth:`write`; the mode is not "wrench".
        """

        def send(wrench: Array) -> Array:
            self._need("wrench")
            return self._transmit(wrench, wrench=wrench)

        return self._checked("wrench()", "wrench", "N, N m", wrench, _WRENCH, send)

    def _connect(self) -> None:
        self._forget()
        where = f"{self._address}:{self._port}"
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind((self._address, self._port))
            if self._controller is not None:
                self._expected = socket.gethostbyname(self._controller)
        except OSError as error:
            self._close()
            raise DriverError(
                f"connect(): cannot listen at {where} for {self._controller or 'any controller'}: {error}"
            ) from None
        begin = time.monotonic()
        while not self._receive(begin + self._patience):
            if time.monotonic() - begin >= self._patience:
                others = f" ({self._refused} datagrams of another kind)" if self._refused else ""
                self._close()
                raise DriverError(
                    f"connect(): no monitoring message came to {where} within {self._patience:g} s{others}; does the "
                    "robot program run with FRI open, and is this the address and port it sends to?"
                )
        period_ms = self._monitoring.connection.send_period
        if period_ms * 1_000_000 != self._period_ns:
            self._close()
            raise DriverError(
                f"connect(): the controller sends every {period_ms} ms, the driver was made for "
                f"{self._period_ns * 1e-6:g} ms: give period={period_ms * 1e-3:g}"
            )
        self._answer()

    def _receive(self, deadline: float) -> bool:
        """Wait until `deadline` for a new monitoring message, and take the newest there is."""
        assert self._socket is not None  # connected
        found = False
        while True:
            rest = 0.0 if found else deadline - time.monotonic()
            self._socket.settimeout(max(rest, 0.0))
            try:
                data, sender = self._socket.recvfrom(_MAX_BYTES + 1)
            except (BlockingIOError, TimeoutError):
                return found
            except ConnectionRefusedError:
                # an answer met a closed port: the controller's side is gone for now, the silence will tell
                continue
            if self._take(data, sender):
                self._lost += found  # nobody will see the one before
                found = True
            if time.monotonic() > deadline:  # whoever floods the port does not hold up the loop
                return found

    def _take(self, data: bytes, sender: tuple[str, int]) -> bool:
        """Whether a datagram is a newer monitoring message; then it becomes the newest."""
        expected = self._peer[0] if self._peer else self._expected
        message = self._parse(data) if expected in (None, sender[0]) else None
        if message is None:
            self._refused += 1
            return False
        stamp = message.monitor.timestamp
        stamp_ns = stamp.sec * 1_000_000_000 + stamp.nanosec
        # by time, not by sequence, which starts again with a new session
        if stamp_ns <= self._stamp_ns:
            self._refused += 1
            return False
        if self._monitoring is not None:
            gap = (message.header.sequence - self._monitoring.header.sequence) % 2**32
            self._lost += gap - 1 if 0 < gap < 1000 else 0
        self._monitoring, self._stamp_ns, self._peer = message, stamp_ns, sender
        self._arrived = time.monotonic()
        self._unanswered += 1
        self._due = self._unanswered >= max(1, message.connection.receive_multiplier)
        return True

    def _parse(self, data: bytes) -> Any:
        """The monitoring message in a datagram; None if it is none, or not of this arm."""
        if len(data) > _MAX_BYTES:
            return None
        message = self._messages["Monitoring"]()
        try:
            message.ParseFromString(data)
        except self._undecodable:
            return None
        if message.header.message_id != _MONITORING_ID or message.connection.session_state not in range(1, 5):
            return None
        values = (message.monitor.measured_position.value, message.monitor.measured_torque.value)
        if any(len(v) != self.n or not all(map(math.isfinite, v)) for v in values):
            return None
        if message.connection.session_state >= _COMMANDING_WAIT:
            ipo = message.ipo.joint_position.value
            if len(ipo) != self.n or not all(map(math.isfinite, ipo)):
                return None
        return message

    def _read(self) -> Sample | None:
        if self._due:
            self._answer()
        if not self._receive(time.monotonic() + 2e-9 * self._period_ns):
            silence = time.monotonic() - self._arrived
            if silence > self._patience:
                raise DriverError(f"no monitoring message for {silence:.2f} s: the session is over")
            return None
        monitor = self._monitoring.monitor
        sample = Sample(
            self._stamp_ns,
            np.array(monitor.measured_position.value),
            None,
            self._sign * np.array(monitor.measured_torque.value),
        )
        if self._state == "enabled":
            complaint = self._hindrance()
            if not complaint and self._monitoring.connection.session_state != _COMMANDING_ACTIVE:
                complaint = f"the session fell back: {self.session}"
            if complaint:
                self._stop_because(complaint)
        elif self._due:
            self._answer()
        return sample

    def _hindrance(self) -> str:
        """Why the robot cannot move; empty if it can."""
        robot = self._monitoring.robot
        if robot.safety_state != 0:
            return f"the controller reports: {self.session}"
        if self._monitoring.connection.session_state < _COMMANDING_WAIT:
            return ""  # the robot program may switch the drives on later
        idle = [i for i, drive in enumerate(robot.drive_state) if _name(_DRIVES, drive) != "ACTIVE"]
        if idle:
            return (
                f"the drive of {self._joint_names[idle[0]]!r} is {_name(_DRIVES, robot.drive_state[idle[0]])}"
            )
        return ""

    def _enable(self) -> None:
        if self._mode is None:
            raise DriverError(
                "enable(): this driver monitors the arm only; "
                f"to command it, give it a mode: {', '.join(map(repr, get_args(Mode)))}"
            )
        deadline = time.monotonic() + _ENABLE_S
        while True:
            message = self._monitoring
            hindrance = self._hindrance()
            if hindrance:
                raise DriverError(f"enable(): {hindrance}")
            if message.connection.receive_multiplier > 1:
                raise DriverError(
                    "enable(): commanding needs an answer to every message, "
                    f"the robot program has set the receive multiplier to {message.connection.receive_multiplier}"
                )
            if message.connection.session_state >= _COMMANDING_WAIT:
                self._check_modes()
            if message.connection.session_state == _COMMANDING_ACTIVE and self._due:
                return  # that message is answered by the first command
            if self._due:
                self._answer()
            if time.monotonic() > deadline:
                raise DriverError(
                    f"enable(): the robot program did not come to command within {_ENABLE_S:g} s ({self.session}); "
                    "does it run a motion with an FRI overlay?"
                )
            if not self._receive(time.monotonic() + self._patience):
                raise DriverError(f"enable(): no monitoring message for {self._patience:g} s")

    def _check_modes(self) -> None:
        """The robot program's overlay must be the one that is commanded."""
        assert self._mode is not None  # enable() checked it
        command, control = _NEEDS[self._mode]
        found = _name(_COMMAND_MODES, self._monitoring.ipo.command_mode)
        if found != command:
            raise DriverError(f"enable(): the robot program expects {found}, this driver commands {command}")
        mode = _name(_CONTROL_MODES, self._monitoring.robot.control_mode)
        if control is not None and mode != control:
            raise DriverError(f"enable(): {command} needs the control mode {control}, the robot is in {mode}")

    def _need(self, mode: Mode) -> None:
        if self._mode != mode:
            raise DriverError(f"{mode}(): this driver was made with mode={self._mode!r}")

    def _write(self, torque: Array) -> Array:
        if self._mode != "torque":
            raise DriverError(
                f"write(): an LBR in mode {self._mode!r} takes no torque; call {self._mode}(), "
                "or give the driver mode='torque'"
            )
        sent = np.clip(torque, -self._limit, self._limit)
        q = np.array(self._monitoring.monitor.measured_position.value)
        return self._transmit(sent, torque=self._sign * (sent - self._arm.gravity_torque(q)))

    def _transmit(self, sent: Array, **command: Array) -> Array:
        """Answer the newest message with a command, if it is not answered yet; return what was sent for it."""
        if self._due:
            self._answer(**command)
            self._sent = sent.copy()
        return self._safe() if self._sent is None else self._sent.copy()

    def _safe(self) -> Array:
        """What acts when a message was answered without a command, as the mode's command would say it."""
        if self._mode == "wrench":
            return np.zeros(6)
        if self._mode == "position":
            return np.array(self._monitoring.ipo.joint_position.value)
        return self._arm.gravity_torque(np.array(self._monitoring.monitor.measured_position.value))

    def _answer(
        self, position: Array | None = None, torque: Array | None = None, wrench: Array | None = None
    ) -> None:
        """Answer the newest message; without arguments with what changes nothing."""
        assert self._socket is not None and self._peer is not None  # something was received
        message = self._monitoring
        answer = self._messages["Command"]()
        answer.header.message_id = _COMMAND_ID
        answer.header.sequence = self._sequence
        answer.header.reflected = message.header.sequence
        self._sent = None
        if message.connection.session_state >= _COMMANDING_WAIT:
            mirrored = message.ipo.joint_position.value if position is None else position.tolist()
            answer.data.joint_position.value.extend(mirrored)
            wanted = _name(_COMMAND_MODES, message.ipo.command_mode)
            if wanted == "TORQUE":
                answer.data.joint_torque.value.extend([0.0] * self.n if torque is None else torque.tolist())
            elif wanted == "WRENCH":
                answer.data.wrench.element.extend([0.0] * 6 if wrench is None else wrench.tolist())
        self._sequence = (self._sequence + 1) % 2**32
        self._due, self._unanswered = False, 0
        self._late += time.monotonic() - self._arrived > 1e-9 * self._period_ns
        try:
            self._socket.sendto(answer.SerializeToString(), self._peer)
        except OSError as error:
            raise DriverError(f"no answer can be sent to {self._peer[0]}: {error}") from None

    def _disable(self) -> None:
        if self._due:
            self._answer()

    def _close(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None


def _name(names: tuple[str, ...], value: int) -> str:
    return names[value] if 0 <= value < len(names) else f"unknown ({value})"


def _messages() -> tuple[Mapping[str, Any], type[Exception]]:
    """Message classes made from the table above, and the error of bytes that are none.

    Raises:
        MissingExtraError: protobuf is not installed.
    """
    try:
        from google.protobuf import descriptor_pb2, descriptor_pool, message, message_factory
    except ImportError:
        raise MissingExtraError("fri", "a KUKA arm") from None
    kinds = descriptor_pb2.FieldDescriptorProto
    file = descriptor_pb2.FileDescriptorProto(
        name="palpate_fri.proto", package="palpate_fri", syntax="proto2"
    )
    for name, fields in _FIELDS.items():
        described = file.message_type.add(name=name)
        for field, (number, kind) in fields.items():
            added = described.field.add(name=field, number=number)
            # repeated numbers are sent one by one, proto2's default; read they are either way
            added.label = kinds.LABEL_REPEATED if kind.endswith("*") else kinds.LABEL_OPTIONAL
            if kind in _FIELDS:
                added.type, added.type_name = kinds.TYPE_MESSAGE, f".palpate_fri.{kind}"
            else:
                added.type = getattr(kinds, f"TYPE_{kind.rstrip('*').upper()}")
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    classes = {
        name: message_factory.GetMessageClass(pool.FindMessageTypeByName(f"palpate_fri.{name}"))
        for name in _FIELDS
    }
    return classes, message.DecodeError
