"""A KUKA LBR behind the driver contract, by its Fast Robot Interface (FRI).

An independent client, written from public facts about the messages (numbers of fields, order of the session); no code
of the vendor's. **Those facts were never checked against a KUKA controller**: none was at hand. Messages and
deadlines are handled in C++ (``palpate/session/fri_link.hpp``).
"""

from __future__ import annotations

import math
import socket
import time
from collections.abc import Mapping
from typing import Literal, TypeAlias, get_args

import numpy as np
import numpy.typing as npt

from .._core import FriLink, FriMonitoring
from ..arm import Arm, Array, Effort
from ..errors import DriverError
from ..logs import Sample
from .driver import Driver

Mode: TypeAlias = Literal["torque", "position", "wrench"]
"""What is laid over the robot program's motion: joint torque, joint position, or a wrench at the tool."""

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

    A message for which no command has come by the `deadline` is answered in the same way by a thread in C++, and while
    nothing is commanded at once: the session does not depend on Python being in time. A command that comes later is
    not sent; :attr:`late` counts, and the command's return value says what acts.

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
        deadline: part of the period after which a message is answered without a command [1]; infinity: never, each
            waits for the program.

    Raises:
        DriverError: an argument is not one of the choices.
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
        deadline: float = 0.6,
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
        if not deadline > 0.0:
            raise DriverError(f"deadline must be a number > 0, part of the period, got {deadline!r}")
        if mode == "torque" and not arm.has_dynamics:
            raise DriverError(f"mode 'torque' needs the masses of arm {arm.name!r}, to subtract its gravity")
        super().__init__(arm.joint_names, round(1e9 * period), Effort.torque())
        self._arm, self._mode = arm, mode
        self._port, self._address, self._controller = port, address, controller
        self._sign, self._patience = float(torque_sign), float(patience)
        self._limit = np.array([j.limits.effort for j in arm.joints])
        self._link = FriLink(
            self.n, self._period_ns, round(deadline * self._period_ns) if math.isfinite(deadline) else 0
        )
        self._forget()

    def _forget(self) -> None:
        """Nothing has been received yet."""
        self._monitoring: FriMonitoring | None = None  # the newest message
        self._arrived = 0.0
        self._sent: Array | None = None

    @property
    def lost(self) -> int:
        """Monitoring messages since connect() that never came, or were overtaken by a newer one."""
        return self._link.counts()[0]

    @property
    def refused(self) -> int:
        """Datagrams since connect() that were passed over: old, doubled, damaged, or of another sender."""
        return self._link.counts()[1]

    @property
    def late(self) -> int:
        """Messages since connect() that no command answered in time."""
        return self._link.counts()[2]

    @property
    def session(self) -> str:
        """State of the session, quality of the connection and safety, e.g. "MONITORING_READY, GOOD, NORMAL".

        Raises:
            DriverError: nothing was received yet.
        """
        if self._monitoring is None:
            raise DriverError("session needs connect() first: nothing was received yet")
        return _session(self._monitoring)

    @property
    def external(self) -> Array:
        """(n,) the controller's own estimate of the external torque in the newest message, KUKA's sign [N m].

        Raises:
            DriverError: nothing was received yet, or the message does not hold it.
        """
        if self._monitoring is None:
            raise DriverError("external needs connect() first: nothing was received yet")
        values: Array = self._monitoring.external
        if len(values) != self.n:
            raise DriverError(f"the controller sends {len(values)} external torques, not {self.n}")
        return values

    def position(self, q: npt.ArrayLike) -> Array:
        """Command joint positions `q` (n,) [rad] for this period: near the interpolated ones, the robot checks.

        Returns:
            (n,) what was sent [rad].

        Raises:
            DriverError: as in :meth:`write`; the mode is not "position".
        """

        def send(q: Array) -> Array:
            self._need("position")
            return self._transmit(q, q, None, None)

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
            return self._transmit(wrench, None, None, wrench)

        return self._checked("wrench()", "wrench", "N, N m", wrench, _WRENCH, send)

    def _connect(self) -> None:
        self._forget()
        where = f"{self._address}:{self._port}"
        try:
            controller = socket.gethostbyname(self._controller) if self._controller is not None else ""
            self._link.open(socket.gethostbyname(self._address), self._port, controller)
        except OSError as error:
            raise DriverError(
                f"connect(): cannot listen at {where} for {self._controller or 'any controller'}: {error}"
            ) from None
        message = self._receive(self._patience)
        if message is None:
            refused = self.refused
            others = f" ({refused} datagrams of another kind)" if refused else ""
            self._close()
            raise DriverError(
                f"connect(): no monitoring message came to {where} within {self._patience:g} s{others}; does the "
                "robot program run with FRI open, and is this the address and port it sends to?"
            )
        if message.send_period * 1_000_000 != self._period_ns:
            self._close()
            raise DriverError(
                f"connect(): the controller sends every {message.send_period} ms, the driver was made for "
                f"{self._period_ns * 1e-6:g} ms: give period={message.send_period * 1e-3:g}"
            )
        self._answer()

    def _receive(self, timeout: float) -> FriMonitoring | None:
        """The newest message that was not seen yet; waits for one, at most `timeout` [s]."""
        found = self._link.receive(round(timeout * 1e9))
        if found is None:
            return None
        self._monitoring, arrived_ns = found
        self._arrived, self._sent = 1e-9 * arrived_ns, None
        return self._monitoring

    @property
    def _newest(self) -> FriMonitoring:
        assert self._monitoring is not None  # connected
        return self._monitoring

    def _read(self) -> Sample | None:
        self._answer()  # the message before, if nobody did
        message = self._receive(2e-9 * self._period_ns)
        if message is None:
            silence = time.monotonic() - self._arrived
            if silence > self._patience:
                raise DriverError(f"no monitoring message for {silence:.2f} s: the session is over")
            return None
        sample = Sample(message.time_ns, message.position, None, self._sign * message.torque)
        if self._state == "enabled":
            complaint = self._hindrance()
            if not complaint and message.session_state != _COMMANDING_ACTIVE:
                complaint = f"the session fell back: {self.session}"
            if complaint:
                self._stop_because(complaint)
        else:
            self._answer()
        return sample

    def _hindrance(self) -> str:
        """Why the robot cannot move; empty if it can."""
        message = self._newest
        if message.safety_state != 0:
            return f"the controller reports: {self.session}"
        if message.session_state < _COMMANDING_WAIT:
            return ""  # the robot program may switch the drives on later
        drives = [_name(_DRIVES, drive) for drive in message.drive_state[: self.n]]
        idle = [i for i, drive in enumerate(drives) if drive != "ACTIVE"]
        if idle:
            return f"the drive of {self._joint_names[idle[0]]!r} is {drives[idle[0]]}"
        return ""

    def _enable(self) -> None:
        if self._mode is None:
            raise DriverError(
                "enable(): this driver monitors the arm only; "
                f"to command it, give it a mode: {', '.join(map(repr, get_args(Mode)))}"
            )
        self._link.expect(True)
        deadline = time.monotonic() + _ENABLE_S
        while True:
            message = self._newest
            hindrance = self._hindrance()
            if hindrance:
                raise DriverError(f"enable(): {hindrance}")
            if message.receive_multiplier > 1:
                raise DriverError(
                    "enable(): commanding needs an answer to every message, "
                    f"the robot program has set the receive multiplier to {message.receive_multiplier}"
                )
            if message.session_state >= _COMMANDING_WAIT:
                self._check_modes(message)
            if message.session_state == _COMMANDING_ACTIVE and self._link.due():
                return  # that message is answered by the first command
            self._answer()
            if time.monotonic() > deadline:
                raise DriverError(
                    f"enable(): the robot program did not come to command within {_ENABLE_S:g} s ({self.session}); "
                    "does it run a motion with an FRI overlay?"
                )
            if self._receive(self._patience) is None:
                raise DriverError(f"enable(): no monitoring message for {self._patience:g} s")

    def _check_modes(self, message: FriMonitoring) -> None:
        """The robot program's overlay must be the one that is commanded."""
        assert self._mode is not None  # enable() checked it
        command, control = _NEEDS[self._mode]
        found = _name(_COMMAND_MODES, message.command_mode)
        if found != command:
            raise DriverError(f"enable(): the robot program expects {found}, this driver commands {command}")
        mode = _name(_CONTROL_MODES, message.control_mode)
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
        added = self._sign * (sent - self._arm.gravity_torque(self._newest.position))
        return self._transmit(sent, None, added, None)

    def _transmit(
        self, sent: Array, position: Array | None, torque: Array | None, wrench: Array | None
    ) -> Array:
        """Answer the newest message with a command, if it is not answered yet; return what was sent for it."""
        if self._answer(position, torque, wrench):
            self._sent = sent.copy()
        return self._safe() if self._sent is None else self._sent.copy()

    def _safe(self) -> Array:
        """What acts when a message was answered without a command, as the mode's command would say it."""
        if self._mode == "wrench":
            return np.zeros(6)
        if self._mode == "position":
            return np.array(self._newest.interpolated)
        return self._arm.gravity_torque(self._newest.position)

    def _answer(
        self, position: Array | None = None, torque: Array | None = None, wrench: Array | None = None
    ) -> bool:
        """Answer the newest message, without arguments with what changes nothing; False: it was answered before."""
        try:
            return self._link.answer(position, torque, wrench)
        except OSError as error:
            raise DriverError(f"no answer can be sent to {self._link.peer()}: {error}") from None

    def _disable(self) -> None:
        try:
            self._answer()
        finally:
            self._link.expect(False)

    def _close(self) -> None:
        self._link.close()


def _session(message: FriMonitoring) -> str:
    return ", ".join(
        (
            _name(_STATES, message.session_state),
            _name(_QUALITIES, message.quality),
            _name(_SAFETY, message.safety_state),
        )
    )


def _name(names: tuple[str, ...], value: int) -> str:
    return names[value] if 0 <= value < len(names) else f"unknown ({value})"
