"""The contract between palpate and an arm: seven verbs, one state machine, the same errors for every driver.

One control period is ``sample = driver.read(); sent = driver.write(torque)``. A driver is *closed* until
:meth:`connect`, *connected* (readable, drives off) until :meth:`enable`, *enabled* (takes torque) until
:meth:`disable` or :meth:`stop`. A driver implements the underscored verbs; order, arguments and finiteness
are checked here, once.
"""

from __future__ import annotations

import logging
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from types import TracebackType
from typing import Literal, Self, TypeAlias

import numpy as np
import numpy.typing as npt

from ..arm import Array, Effort
from ..errors import DriverError
from ..logs import Sample

State: TypeAlias = Literal["closed", "connected", "enabled"]

_logger = logging.getLogger(__name__)


class Driver(ABC):
    """An arm that is read and commanded once per period.

    A :class:`palpate.logs.Sample` is what was read, as it came: maybe noisy, late or absurd; judging it is the
    pipeline's job. Its effort is what was really applied, link side, during the period that **ended** at that
    sample: the very torque that moved the arm from the sample before to this one, after the drives' clamping and
    quantisation, in the unit that :attr:`effort` declares.

    Args:
        joint_names: of the moving joints, base to tip.
        period_ns: control period [ns], > 0.
        effort: what the effort number of a sample is.

    Raises:
        DriverError: no joints, or a period that is not positive.
    """

    effort_of_period = False
    """Whether a sample's effort is the mean since the sample before even where the loop was late; else it is only so
    while the loop keeps its period."""

    def __init__(self, joint_names: tuple[str, ...], period_ns: int, effort: Effort) -> None:
        if not joint_names:
            raise DriverError("a driver needs at least one joint")
        if period_ns <= 0:
            raise DriverError(f"period_ns must be > 0, got {period_ns!r}")
        self._joint_names = tuple(joint_names)
        self._period_ns = int(period_ns)
        self._effort = effort
        self._state: State = "closed"
        self._stopped_by = ""

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the moving joints, base to tip."""
        return self._joint_names

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self._joint_names)

    @property
    def period_ns(self) -> int:
        """Control period [ns]."""
        return self._period_ns

    @property
    def effort(self) -> Effort:
        """What the effort number of a sample is; ``effort.gain(n)`` makes it link-side torque [N m]."""
        return self._effort

    @property
    def state(self) -> State:
        """One of closed, connected, enabled."""
        return self._state

    @property
    def finished(self) -> bool:
        """True when no sample will come any more: the end of a recording. A live arm is never finished."""
        return False

    def connect(self) -> None:
        """Reach the arm; reading works from here. The drives stay off.

        Raises:
            DriverError: already connected, or the arm does not answer.
        """
        if self._state != "closed":
            raise DriverError(f"connect(): the driver is already {self._state}; close() it first")
        self._stopped_by = ""
        self._connect()
        self._state = "connected"

    def read(self) -> Sample | None:
        """Wait for the next period and return its sample; None if none arrived in this period.

        Raises:
            DriverError: not connected, or the arm does not answer any more, or the recording has ended.
        """
        if self._state == "closed":
            raise DriverError("read() needs connect() first: the driver is closed")
        try:
            return self._read()
        except Exception:
            # whoever closes the loop sees nothing any more: the arm must not go on with the last torque
            self.stop()
            raise

    def write(self, torque: npt.ArrayLike) -> Array:
        """Send link-side motor torque, gravity included, for the period that begins now.

        A command that is refused or cannot be sent stops the drives: the arm is left at the safe torque and must be
        enabled again. So does a read that fails.

        Args:
            torque: (n,) [N m].

        Returns:
            (n,) [N m]: what was really sent, clamped and quantised; a new array.

        Raises:
            DriverError: not enabled; the shape is wrong; a number is NaN or infinite.
        """
        return self._checked("write()", "torque", "N m", torque, self._joint_names, self._write)

    def _checked(
        self,
        verb: str,
        what: str,
        unit: str,
        values: npt.ArrayLike,
        names: tuple[str, ...],
        send: Callable[[Array], Array],
    ) -> Array:
        """Check a command of one number per name, send it, return what was sent; on failure stop the drives.

        Drivers that take more than torque check their other commands by it too.
        """
        if self._state != "enabled":
            reason = f"; the drives were stopped: {self._stopped_by}" if self._stopped_by else ""
            raise DriverError(f"{verb} needs enable() first: the driver is {self._state}{reason}")
        complaint = ""
        try:
            command = np.array(values, dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            complaint = f"{what} must be {len(names)} numbers [{unit}], got {values!r:.80}"
        else:
            if command.shape != (len(names),):
                complaint = f"{what} must have shape ({len(names)},), got {command.shape}"
            elif not np.isfinite(command).all():
                bad = int(np.flatnonzero(~np.isfinite(command))[0])
                complaint = f"{what} of {names[bad]!r} is {command[bad]!s}"
        if complaint:
            self._stop_because(complaint)
            raise DriverError(f"{verb}: {complaint}; the drives were stopped")
        try:
            return send(command)
        except Exception as error:
            self._stop_because(f"a command could not be sent ({error})")
            raise

    def _stop_because(self, reason: str) -> None:
        """Stop the drives; the next command's error says why."""
        self.stop()
        self._stopped_by = reason

    def enable(self) -> None:
        """Switch the drives on, at the safe torque. Enabled already: nothing happens.

        Raises:
            DriverError: not connected, or the drives refuse.
        """
        if self._state == "closed":
            raise DriverError("enable() needs connect() first: the driver is closed")
        if self._state == "connected":
            try:
                self._enable()
            except Exception:
                self.stop()
                raise
            self._stopped_by = ""
            self._state = "enabled"

    def disable(self) -> None:
        """Bring the arm to the safe torque and switch the drives off; reading goes on.

        Off already: nothing happens.

        Raises:
            DriverError: not connected, or the drives do not answer.
        """
        if self._state == "closed":
            raise DriverError("disable() needs connect() first: the driver is closed")
        if self._state == "enabled":
            self._state = "connected"
            self._disable()

    def stop(self) -> None:
        """Bring the arm to the safe torque and switch the drives off: now, in any state, as often as you like.

        Never raises: what goes wrong is logged with its traceback to the logger ``palpate.drivers.driver``.
        """
        if self._state == "closed":
            return
        self._state = "connected"
        try:
            self._stop()
        except Exception:
            _logger.exception("stop(): the drives may still be on")

    def close(self) -> None:
        """Stop and let go of the arm; :meth:`connect` starts again. Closed already: nothing happens.

        Raises:
            DriverError: the connection cannot be shut down.
        """
        if self._state == "closed":
            return
        self.stop()
        self._state = "closed"
        self._close()

    def __enter__(self) -> Self:
        if self._state == "closed":
            self.connect()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @abstractmethod
    def _connect(self) -> None:
        """Reach the arm. On failure leave nothing open and raise DriverError."""

    @abstractmethod
    def _read(self) -> Sample | None:
        """Wait for the period's sample; its arrays are new ones."""

    @abstractmethod
    def _write(self, torque: Array) -> Array:
        """Send `torque` (n,), finite, the driver's to keep; return what was really sent as a new array."""

    @abstractmethod
    def _enable(self) -> None:
        """Switch the drives on at the safe torque."""

    @abstractmethod
    def _disable(self) -> None:
        """Command the safe torque, then switch the drives off."""

    def _stop(self) -> None:
        """As fast as it goes: command the safe torque, switch the drives off. Default: :meth:`_disable`."""
        self._disable()

    @abstractmethod
    def _close(self) -> None:
        """Let go of the connection."""


class Pace:
    """Holds a simulated or replayed clock back to the wall's.

    Args:
        speed: simulated seconds per wall second, > 0; None: no waiting.

    Raises:
        DriverError: speed is not positive and finite.
    """

    def __init__(self, speed: float | None) -> None:
        if speed is not None and not (math.isfinite(speed) and speed > 0.0):
            raise DriverError(f"pace must be > 0 or None, got {speed!r}")
        self._speed = speed
        self.start(0)

    def start(self, time_ns: int) -> None:
        """The clock shows `time_ns` [ns] now."""
        self._wall, self._time_ns = time.monotonic(), time_ns

    def late(self, time_ns: int) -> float:
        """How long ago the wall's clock passed `time_ns` [ns], [s]; negative: it has not come there yet."""
        if self._speed is None:
            return 0.0
        return time.monotonic() - self._wall - (time_ns - self._time_ns) * 1e-9 / self._speed

    def wait(self, time_ns: int) -> None:
        """Return when the wall's clock has come to `time_ns` [ns]; at once if it is late."""
        rest = -self.late(time_ns)
        if rest > 0.0:
            time.sleep(rest)
