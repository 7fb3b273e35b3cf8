"""Bus servos on a pseudo-terminal: the protocols of Dynamixel and Feetech, spoken from the servos' side.

The bytes take their time on the wire, answers are damaged and dropped, servos die, and the joints move by the MuJoCo
plant in real time. Nothing of palpate's drivers is used: units, signs and packets are written here a second time.
``python servo_bus.py '{"make": "dynamixel", ...}'`` runs a bus as a process of its own until its input is closed.
"""

from __future__ import annotations

import json
import math
import os
import pty
import select
import struct
import sys
import threading
import time
import tty
from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

TURN = 2.0 * math.pi
BROADCAST = 254


@dataclass(kw_only=True)
class Emulated:
    """One servo, as a test wants it."""

    id: int
    joint: int
    direction: int = 1
    zero: int = 2048
    gear: float = 1.0
    constant: float = 1.78
    """torque at the horn per ampere [N m/A]"""
    model: int = 1020
    current_unit: float = 2.69e-3


class World:
    """The joints: at rest where they are put, or moved by a plant in real time; held by hand until a drive is on."""

    def __init__(self, n: int, plant=None) -> None:
        self.plant = plant
        self.q, self.dq, self.torque = np.zeros(n), np.zeros(n), np.zeros(n)
        self.held = True
        self.speed = 0.0
        """of all joints, without a plant [rad/s]"""
        self.last_ns = time.monotonic_ns()

    def advance(self) -> None:
        now = time.monotonic_ns()
        if self.speed:
            self.q = self.q + 1e-9 * (now - self.last_ns) * self.speed
        if self.plant is not None and not self.held and now > self.last_ns:
            self.plant.step(self.torque, now - self.last_ns)
            self.q, self.dq = self.plant.q, self.plant.dq
        self.last_ns = now


class ServoBus:
    """Servos behind a pseudo-terminal, served by a thread.

    corrupt, drop: probabilities per answer that it is damaged on the way, or never sent.
    usb: delay of every answer [s]; baud: bytes take 10 bits each; None: no time.
    """

    header = b""
    ENABLE = 0

    def __init__(
        self,
        servos: list[Emulated],
        *,
        plant=None,
        joints: int | None = None,
        baud: float | None = None,
        usb: float = 0.0,
        corrupt: float = 0.0,
        drop: float = 0.0,
        noise_counts: int = 0,
        seed: int = 0,
    ) -> None:
        n = 1 + max(s.joint for s in servos) if joints is None else joints
        self.world = World(n, plant)
        self.servos = {s.id: s for s in servos}
        self.tables = {s.id: self.table(s) for s in servos}
        self.baud, self.usb, self.corrupt, self.drop = baud, usb, corrupt, drop
        self.noise_counts = noise_counts
        self.dead: set[int] = set()
        self.missed: float | None = None
        """when a dead servo was first asked in vain [s]"""
        self.said: dict[int, list[int]] = {s.id: [] for s in servos}
        """positions that left each servo, undamaged [counts]"""
        self.damaged = self.dropped = self.questions = 0
        self.last_packet = time.monotonic()
        self._rng = np.random.default_rng(seed)
        self._master, self._slave = pty.openpty()
        tty.setraw(self._master)
        tty.setraw(self._slave)
        self.port = os.ttyname(self._slave)
        self._stop = False
        self._thread = threading.Thread(target=self._serve, daemon=True)

    def __enter__(self) -> ServoBus:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop = True
        self._thread.join()
        self.unplug()

    def unplug(self) -> None:
        """The adapter leaves the computer."""
        self._stop = True
        if threading.current_thread() is not self._thread and self._thread.is_alive():
            self._thread.join()
        for fd in (self._master, self._slave):
            if fd >= 0:
                os.close(fd)
        self._master = self._slave = -1

    def shout(self, noise: bytes) -> None:
        """Bytes that nobody asked for."""
        os.write(self._master, noise)

    # --- line -----------------------------------------------------------------------------------------------

    def _serve(self) -> None:
        heard = b""
        while not self._stop:
            if not select.select([self._master], [], [], 0.02)[0]:
                self.world.advance()
                continue
            heard += os.read(self._master, 4096)
            began = time.monotonic()
            while True:
                packet, heard = self.take(heard)
                if packet is None:
                    break
                self.questions += 1
                wire = self._wire(len(packet))
                self.world.advance()
                answers = self.answer(packet)
                self.last_packet = time.monotonic()
                out = b""
                for answer in answers:
                    wire += self._wire(len(answer))
                    out += self._spoil(answer)
                if answers:
                    wire += self.usb
                rest = began + wire - time.monotonic()
                if rest > 0.0:
                    time.sleep(rest)
                if out:
                    os.write(self._master, out)

    def _wire(self, count: int) -> float:
        return 0.0 if self.baud is None else 10.0 * count / self.baud

    def _spoil(self, answer: bytes) -> bytes:
        if self._rng.random() >= self.corrupt:
            return answer
        self.damaged += 1
        spoilt = bytearray(answer)
        kind = self._rng.integers(4)
        at = int(self._rng.integers(len(spoilt)))
        if kind == 0:  # one bit
            spoilt[at] ^= 1 << int(self._rng.integers(8))
        elif kind == 1:  # one byte lost
            del spoilt[at]
        elif kind == 2:  # one byte too many
            spoilt.insert(at, int(self._rng.integers(256)))
        else:  # noise in a row
            row = spoilt[at : at + 4]
            spoilt[at : at + 4] = bytes(b ^ int(self._rng.integers(1, 256)) for b in row)
        return bytes(spoilt)

    def chain(self, ids: list[int], address: int, length: int) -> list[bytes]:
        """Answers one after the other; where one stays away, those behind it wait in vain."""
        found = []
        for servo in ids:
            if not self.lives(servo):
                break
            if self._rng.random() < self.drop:
                self.dropped += 1
                break
            found.append(self.status(servo, self.look(servo, address, length)))
        return found

    def lives(self, servo: int) -> bool:
        if servo in self.dead and self.missed is None:
            self.missed = time.monotonic()
        return servo in self.tables and servo not in self.dead

    def alive(self, servo: int) -> bool:
        if not self.lives(servo):
            return False
        if self._rng.random() < self.drop:
            self.dropped += 1
            return False
        return True

    # --- servos ---------------------------------------------------------------------------------------------

    def horn(self, servo: Emulated) -> tuple[int, float]:
        """Position [counts] and speed [rad/s] of a servo."""
        noise = int(self._rng.integers(-self.noise_counts, self.noise_counts, endpoint=True))
        turn = servo.direction * servo.gear
        position = servo.zero + round(turn * self.world.q[servo.joint] / TURN * 4096) + noise
        return position, turn * self.world.dq[servo.joint]

    def push(self) -> None:
        """What the joints feel follows from what the servos were told."""
        torque = np.zeros(len(self.world.torque))
        for servo in self.servos.values():
            torque[servo.joint] += servo.direction * servo.gear * self.horn_torque(servo)
        self.world.torque = torque
        self.world.held &= not any(t[self.ENABLE] for t in self.tables.values())

    @abstractmethod
    def table(self, servo: Emulated) -> bytearray: ...
    @abstractmethod
    def take(self, heard: bytes) -> tuple[bytes | None, bytes]: ...
    @abstractmethod
    def answer(self, packet: bytes) -> list[bytes]: ...
    @abstractmethod
    def status(self, servo: int, data: bytes, error: int = 0) -> bytes: ...
    @abstractmethod
    def look(self, servo: int, address: int, length: int) -> bytes: ...
    @abstractmethod
    def horn_torque(self, servo: Emulated) -> float: ...


class DynamixelBus(ServoBus):
    """Protocol 2.0, X series."""

    header = b"\xff\xff\xfd\x00"
    turns: ClassVar[dict[int, int]] = {}
    """by how many turns a servo counts otherwise while it is not in current control"""
    RDT, MODE, LIMIT, ENABLE, HARDWARE, WATCHDOG, GOAL = 9, 11, 38, 64, 70, 98, 102

    @staticmethod
    def crc(data: bytes) -> int:
        value = 0
        for byte in data:
            value ^= byte << 8
            for _ in range(8):
                value = (value << 1 ^ 0x8005 if value & 0x8000 else value << 1) & 0xFFFF
        return value

    def table(self, servo: Emulated) -> bytearray:
        t = bytearray(256)
        struct.pack_into("<H", t, 0, servo.model)
        t[6], t[7], t[self.MODE] = 46, servo.id, 3
        struct.pack_into("<H", t, self.LIMIT, 1193)
        return t

    def take(self, heard: bytes) -> tuple[bytes | None, bytes]:
        at = heard.find(self.header)
        if at < 0:
            return None, heard[-3:]
        heard = heard[at:]
        if len(heard) < 7:
            return None, heard
        size = 7 + struct.unpack_from("<H", heard, 5)[0]
        if len(heard) < size:
            return None, heard
        packet, rest = heard[:size], heard[size:]
        good = self.crc(packet[:-2]) == struct.unpack("<H", packet[-2:])[0]
        return (packet, rest) if good else self.take(rest)

    def status(self, servo: int, data: bytes, error: int = 0) -> bytes:
        if self.tables[servo][self.HARDWARE]:
            error |= 0x80
        body = bytearray(b"\x55")
        for byte in bytes([error]) + data:
            body.append(byte)
            if body[-3:] == b"\xff\xff\xfd":
                body.append(0xFD)
        packet = self.header + bytes([servo]) + struct.pack("<H", len(body) + 2) + bytes(body)
        return packet + struct.pack("<H", self.crc(packet))

    def answer(self, packet: bytes) -> list[bytes]:
        self.bite()
        servo, instruction, data = packet[4], packet[7], packet[8:-2]
        if instruction == 1:
            return [self.status(servo, bytes(self.tables[servo][0:2]) + b"\x2e")] if self.alive(servo) else []
        if instruction == 2 and self.alive(servo):
            return [self.status(servo, self.look(servo, *struct.unpack("<HH", data)))]
        if instruction == 3 and self.alive(servo):
            error = self.store(servo, struct.unpack_from("<H", data)[0], data[2:])
            return [self.status(servo, b"", error)]
        if instruction == 0x82:
            return self.chain(list(data[4:]), *struct.unpack_from("<HH", data))
        if instruction == 0x83:
            address, length = struct.unpack_from("<HH", data)
            for at in range(4, len(data), length + 1):
                if data[at] in self.tables and data[at] not in self.dead:
                    self.store(data[at], address, data[at + 1 : at + 1 + length])
        return []

    def bite(self) -> None:
        """The watchdogs of the servos, as of now."""
        silence = time.monotonic() - self.last_packet
        for t in self.tables.values():
            if 0 < t[self.WATCHDOG] < 0x80 and silence > 0.02 * t[self.WATCHDOG] and t[self.ENABLE]:
                t[self.WATCHDOG] = 0xFF
        self.push()

    def store(self, servo: int, address: int, data: bytes) -> int:
        t = self.tables[servo]
        if address < 64 and t[self.ENABLE]:
            return 7
        if address == self.GOAL:
            if t[self.WATCHDOG] == 0xFF:
                return 4
            if abs(struct.unpack("<h", data)[0]) > struct.unpack_from("<H", t, self.LIMIT)[0]:
                return 6
        if address == self.ENABLE and data[0] and t[self.HARDWARE]:
            return 1
        t[address : address + len(data)] = data
        self.push()
        return 0

    def current(self, servo: Emulated) -> int:
        """What flows [counts]."""
        t = self.tables[servo.id]
        on = t[self.ENABLE] and t[self.MODE] == 0 and t[self.WATCHDOG] != 0xFF and not t[self.HARDWARE]
        return struct.unpack_from("<h", t, self.GOAL)[0] if on and servo.id not in self.dead else 0

    def horn_torque(self, servo: Emulated) -> float:
        return servo.constant * servo.current_unit * self.current(servo)

    def look(self, servo: int, address: int, length: int) -> bytes:
        t, emulated = self.tables[servo], self.servos[servo]
        position, speed = self.horn(emulated)
        if t[self.MODE] != 0:
            position += 4096 * self.turns.get(servo, 0)
        now = (self.current(emulated), round(speed / TURN * 60.0 / 0.229), position)
        struct.pack_into("<hii", t, 126, *now)
        if address == 126:
            self.said[servo].append(position)
        return bytes(t[address : address + length])


class FeetechBus(ServoBus):
    """STS3215: numbers with a sign bit, 8-bit sum."""

    header = b"\xff\xff"
    LEVEL, PHASE, MODE, ENABLE, PWM = 8, 18, 33, 40, 44
    VOLTS = 12.0
    STALL, FREE = 30 * 9.80665e-2, 45 * TURN / 60.0
    """of the version C018 at 12 V [N m], [rad/s]"""

    def table(self, servo: Emulated) -> bytearray:
        t = bytearray(128)
        struct.pack_into("<H", t, 3, servo.model)
        t[5], t[self.LEVEL], t[self.PHASE], t[62], t[63] = servo.id, 1, 0x0C, 120, 31
        return t

    def take(self, heard: bytes) -> tuple[bytes | None, bytes]:
        at = heard.find(self.header)
        if at < 0:
            return None, heard[-1:]
        heard = heard[at:]
        if len(heard) < 4 or len(heard) < 4 + heard[3]:
            return None, heard
        packet, rest = heard[: 4 + heard[3]], heard[4 + heard[3] :]
        return (packet, rest) if ~sum(packet[2:-1]) & 0xFF == packet[-1] else self.take(rest)

    def status(self, servo: int, data: bytes, error: int = 0) -> bytes:
        body = bytes([servo, len(data) + 2, error | self.tables[servo][65]]) + data
        return self.header + body + bytes([~sum(body) & 0xFF])

    def answer(self, packet: bytes) -> list[bytes]:
        servo, instruction, data = packet[2], packet[4], packet[5:-1]
        if instruction == 1 and self.alive(servo):
            return [self.status(servo, b"")]
        if instruction == 2 and self.alive(servo):
            return [self.status(servo, self.look(servo, data[0], data[1]))]
        if instruction == 3 and self.alive(servo):
            self.store(servo, data[0], data[1:])
            return [self.status(servo, b"")] if self.tables[servo][self.LEVEL] else []
        if instruction == 0x82:
            return self.chain(list(data[2:]), data[0], data[1])
        if instruction == 0x83:
            for at in range(2, len(data), data[1] + 1):
                if data[at] in self.tables and data[at] not in self.dead:
                    self.store(data[at], data[0], data[at + 1 : at + 1 + data[1]])
        return []

    def store(self, servo: int, address: int, data: bytes) -> None:
        self.tables[servo][address : address + len(data)] = data
        self.push()

    def horn_torque(self, servo: Emulated) -> float:
        t = self.tables[servo.id]
        if not t[self.ENABLE] or t[self.MODE] != 2 or servo.id in self.dead:
            return 0.0
        word = struct.unpack_from("<H", t, self.PWM)[0]
        duty = (word & 0x3FF) * (-1 if word & 0x400 else 1)
        _, speed = self.horn(servo)
        return self.STALL * (duty / 1000.0 - speed / self.FREE)

    @staticmethod
    def word(value: int, bit: int) -> int:
        return min(abs(value), (1 << bit) - 1) | (1 << bit if value < 0 else 0)

    def look(self, servo: int, address: int, length: int) -> bytes:
        t, emulated = self.tables[servo], self.servos[servo]
        position, speed = self.horn(emulated)
        position = position if t[self.PHASE] & 0x10 else position % 4096
        unit = 1 if t[self.PHASE] & 0x04 else 50
        duty = struct.unpack_from("<H", t, self.PWM)[0] if t[self.ENABLE] else 0
        current = round(self.horn_torque(emulated) / emulated.constant / 6.5e-3)
        struct.pack_into(
            "<HHH", t, 56, self.word(position, 15), self.word(round(speed / TURN * 4096 / unit), 15), duty
        )
        struct.pack_into("<H", t, 69, self.word(current, 15))
        if address == 56:
            self.said[servo].append(position)
        return bytes(t[address : address + length])


MAKES = {"dynamixel": DynamixelBus, "feetech": FeetechBus}


def main(text: str) -> None:
    """Run a bus until the input is closed; prints the port, and at the end what happened."""
    from palpate import robots
    from palpate.simulate import Load, Plant

    options = json.loads(text)
    plant = Plant(robots.load(options["arm"]))
    plant.reset(options.get("q"))
    if options.get("mass"):
        plant.attach(Load(options["mass"]))
    servos = [Emulated(**s) for s in options["servos"]]
    bus = MAKES[options["make"]](servos, plant=plant, **options.get("bus", {}))
    bus.world.q = plant.q
    with bus:
        print(bus.port, flush=True)
        if options.get("die"):
            while bus.world.held:
                time.sleep(0.01)
            time.sleep(options["die_after"])
            bus.dead.add(options["die"])
            while bus.missed is None:
                time.sleep(1e-4)
            while bus.world.torque.any():  # of the others: a dead servo pushes nothing
                time.sleep(1e-4)
            off_s = time.monotonic() - bus.missed
        sys.stdin.read()
    said = {"questions": bus.questions, "damaged": bus.damaged, "dropped": bus.dropped}
    if options.get("die"):
        said["off_s"] = off_s
    on = [i for i, t in bus.tables.items() if t[bus.ENABLE]]
    print(json.dumps({**said, "on": on, "q": bus.world.q.tolist()}), flush=True)


if __name__ == "__main__":
    main(sys.argv[1])
