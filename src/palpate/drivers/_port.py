"""The serial port under a servo maker's SDK: waits instead of spinning, and says plainly why it does not open."""

from __future__ import annotations

import errno
import logging
import select
import time
from pathlib import Path
from typing import Any

from ..errors import DriverError

GRACE_MS = 10.0
"""how long an answer may take beyond its time on the wire [ms]: the servo's own delay, USB, this computer"""
GAP_MS = 1.7
"""the same from one answer to the next [ms]"""
_WRITE_S = 0.2
_AT_ONCE = 4096
"""most bytes taken from the line at once"""
_logger = logging.getLogger(__name__)


def open_port(handler: type, path: str, baud: int) -> Any:
    """A PortHandler of an SDK on an open port.

    Args:
        handler: the SDK's PortHandler.
        path: of the port.
        baud: [bit/s].

    Raises:
        DriverError: there is no such port, it may not be used, or this speed is not possible.
    """
    import serial

    class Port(handler):  # type: ignore[misc]
        """What the SDK's own does by polling at full load, by the wall's clock and without emptying the line."""

        unread = 0
        """bytes that came too late and were thrown away"""

        held = b""
        """bytes that came with those asked for: the answers of many servos arrive together"""

        def readPort(self, length: int) -> bytes:
            if not self.held:
                rest = (self.packet_timeout - self.getTimeSinceStart()) * 1e-3
                if rest > 0.0:
                    select.select([self.ser.fileno()], [], [], rest)
                self.held = self.ser.read(_AT_ONCE)
            data, self.held = self.held[:length], self.held[length:]
            return data

        def setPacketTimeout(self, packet_length: int) -> None:
            self.packet_start_time = self.getCurrentTime()
            self.packet_timeout = self.tx_time_per_byte * packet_length + self.grace_ms

        def expect(self, length: int) -> None:
            """Answers have begun to come: the rest, of so many bytes, follows at once."""
            self.packet_start_time = self.getCurrentTime()
            self.packet_timeout = self.tx_time_per_byte * length + self.gap_ms

        def getCurrentTime(self) -> float:
            return time.monotonic() * 1e3

        def clearPort(self) -> None:
            # a late answer to an earlier question must not be taken for the answer to this one
            self.unread += len(self.held) + self.ser.in_waiting
            self.held = b""
            self.ser.reset_input_buffer()

    latency = _usb_latency_ms(path)
    if latency > 1.0:
        _logger.warning(
            "%s collects answers for %g ms: 250 Hz cannot be reached; "
            "echo 1 | sudo tee /sys/class/tty/%s/device/latency_timer",
            path,
            latency,
            Path(path).resolve().name,
        )
    port = Port(path)
    port.grace_ms = GRACE_MS + 2.0 * latency
    port.gap_ms = GAP_MS + 2.0 * latency
    try:
        if not port.setBaudRate(baud):
            raise DriverError(f"{path}: {baud} bit/s is not a speed of these servos")
        port.ser.exclusive = True
        port.ser.write_timeout = _WRITE_S
    except (OSError, ValueError) as error:  # serial.SerialException is an OSError
        if port.ser is not None:
            port.ser.close()
        raise DriverError(_why(path, baud, error)) from None
    except serial.serialutil.PortNotOpenError:
        raise DriverError(f"{path} cannot be opened") from None
    return port


def _usb_latency_ms(path: str) -> float:
    """How long the USB adapter collects bytes before it passes them on [ms]; 0 where it does not say."""
    file = Path("/sys/class/tty") / Path(path).resolve().name / "device" / "latency_timer"
    try:
        return float(file.read_text())
    except (OSError, ValueError):
        return 0.0


def _why(path: str, baud: int, error: Exception) -> str:
    code = getattr(error, "errno", None)
    if code == errno.ENOENT:
        from serial.tools import list_ports

        found = sorted(p.device for p in list_ports.comports())
        return f"no port {path}; there are {', '.join(found[:10]) or 'none: is the adapter plugged in?'}"
    if code in (errno.EACCES, errno.EPERM):
        return (
            f"no permission for {path}: add your user to the group that owns it "
            "(sudo usermod -aG dialout $USER), then log in again"
        )
    if code in (errno.EBUSY, errno.EAGAIN) or "exclusively lock" in str(error):
        return f"{path} is in use by another program"
    if code == errno.ENOTTY or "Could not configure" in str(error) or "Inappropriate ioctl" in str(error):
        return f"{path} is not a serial port, or not one that can do {baud} bit/s"
    return f"{path} cannot be opened: {' '.join(str(error).split())}"
