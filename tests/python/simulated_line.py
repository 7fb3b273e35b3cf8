"""A serial line in simulated time: the real SDK at one end, emulated servos at the other, no thread, no real clock.

Every byte takes its time on the wire, the adapter its delay, each look of the program at the line or the clock a little
computing. A run is the same on any computer, however busy, and says what the protocol itself needs.
"""

from __future__ import annotations

from collections.abc import Callable

import pytest

import palpate.drivers._port
import palpate.drivers.dynamixel
import palpate.drivers.feetech
import palpate.drivers.servos
import servo_bus
from servo_bus import ServoBus

LOOK_NS = 10_000
"""of computing per look at the line or the clock [ns]"""


class SimulatedLine:
    """In the place of time, select and the serial port of the drivers, and of the emulator's clock."""

    def __init__(self, emulator: ServoBus, monkeypatch: pytest.MonkeyPatch) -> None:
        self.emulator = emulator
        self.now_ns = emulator.world.last_ns = 0
        self._heard = b""
        self._free_ns = 0
        self._coming: list[tuple[int, bytes]] = []
        """when bytes arrive [ns], in order"""
        self.delivery_ns = 0
        """how long the adapter keeps what is written [ns]"""
        self.sent: list[tuple[int, bytes]] = []
        """when each packet was whole on the wire [ns], and the packet"""
        for module in (
            palpate.drivers._port,
            palpate.drivers.servos,
            palpate.drivers.dynamixel,
            palpate.drivers.feetech,
        ):
            monkeypatch.setattr(module, "time", self)
        monkeypatch.setattr(palpate.drivers._port, "select", self)
        monkeypatch.setattr(servo_bus, "time", self)
        opened = palpate.drivers.servos.open_port

        def open_port(handler: type, path: str, baud: int) -> object:
            port = opened(handler, path, baud)
            port.ser.close()
            port.ser = self
            return port

        monkeypatch.setattr(palpate.drivers.servos, "open_port", open_port)

    # --- time and select ------------------------------------------------------------------------------------

    def monotonic_ns(self) -> int:
        self.now_ns += LOOK_NS
        return self.now_ns

    def monotonic(self) -> float:
        return 1e-9 * self.monotonic_ns()

    def sleep(self, seconds: float) -> None:
        self.now_ns += max(0, round(1e9 * seconds))

    def select(self, _read: list, _write: list, _error: list, timeout: float) -> None:
        end = self.now_ns + round(1e9 * timeout)
        if self._coming:
            end = min(end, self._coming[0][0])
        self.now_ns = max(self.now_ns + LOOK_NS, end)

    # --- the serial port ------------------------------------------------------------------------------------

    def fileno(self) -> int:
        return 0

    def close(self) -> None:
        pass

    @property
    def in_waiting(self) -> int:
        return sum(len(data) for at, data in self._coming if at <= self.now_ns)

    def reset_input_buffer(self) -> None:
        self._coming = [(at, data) for at, data in self._coming if at > self.now_ns]

    def read(self, length: int) -> bytes:
        self.now_ns += LOOK_NS
        out = b""
        while self._coming and self._coming[0][0] <= self.now_ns and len(out) < length:
            at, data = self._coming.pop(0)
            wanted = length - len(out)
            out += data[:wanted]
            if data[wanted:]:
                self._coming.insert(0, (at, data[wanted:]))
        return out

    def write(self, data: bytes) -> int:
        emulator = self.emulator
        self._heard += bytes(data)
        while True:
            packet, self._heard = emulator.take(self._heard)
            if packet is None:
                return len(data)
            emulator.questions += 1
            at = max(self.now_ns + self.delivery_ns, self._free_ns) + self._wire_ns(packet)
            self.sent.append((at, packet))
            self._at(at, emulator.world.advance)
            answers = emulator.answer(packet)
            emulator.last_packet = 1e-9 * at
            for answer in answers:
                at += self._wire_ns(answer)
            self._free_ns = at
            if answers:
                at += round(1e9 * emulator.usb)
                self._coming.append((at, b"".join(emulator._spoil(a) for a in answers)))

    def _at(self, when_ns: int, what: Callable[[], None]) -> None:
        """Do it as if the clock stood there."""
        now, self.now_ns = self.now_ns, when_ns
        what()
        self.now_ns = now

    def _wire_ns(self, packet: bytes) -> int:
        return round(1e9 * self.emulator._wire(len(packet)))
