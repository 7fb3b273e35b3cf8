"""An emulated KUKA controller: the server's side of FRI, its own encoding of the messages, a MuJoCo arm behind it.

In lockstep (default) a cycle lasts until its answer has come, so that a seed gives the same run on any computer; what
is lost on the way is drawn from the seed and not waited for. In real time a cycle lasts its period.

Numbers of fields and order of the session are typed here from the same public facts as in the driver, but apart from
it. What those facts leave open is this emulator's own choice: how quality is reckoned, when commanding begins and
ends, and that a cycle without an answer has no overlay.
"""

from __future__ import annotations

import json
import socket
import struct
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from palpate import robots
from palpate.arm import Arm
from palpate.simulate import Plant

ARM = robots.load("kuka_lbr_iiwa14")
HOME = np.array([0.2, 0.5, -0.1, -1.3, 0.2, 0.8, 0.1])
WAIT, READY, COMMANDING_WAIT, ACTIVE = 1, 2, 3, 4
POOR, FAIR, GOOD, EXCELLENT = range(4)
COMMAND_MODES = {"position": 1, "wrench": 2, "torque": 3}
CONTROL_MODES = {"position": 0, "wrench": 1, "torque": 2}


def varint(value: int) -> bytes:
    out = b""
    while value > 0x7F:
        out += bytes([value & 0x7F | 0x80])
        value >>= 7
    return out + bytes([value])


def number(tag: int, value: int) -> bytes:
    return varint(tag << 3) + varint(value)


def block(tag: int, data: bytes) -> bytes:
    return varint(tag << 3 | 2) + varint(len(data)) + data


def doubles(tag: int, values: np.ndarray, packed: bool = False) -> bytes:
    """A message whose field 1 repeats a double."""
    if packed:
        return block(tag, block(1, struct.pack(f"<{len(values)}d", *values)))
    return block(tag, b"".join(b"\x09" + struct.pack("<d", v) for v in values))


def fields(data: bytes) -> dict[int, list[int | bytes]]:
    """Numbers and contents of a message's fields."""
    found: dict[int, list[int | bytes]] = {}
    at = 0

    def take() -> int:
        nonlocal at
        value = shift = 0
        while True:
            byte = data[at]
            at += 1
            value |= (byte & 0x7F) << shift
            shift += 7
            if byte < 0x80:
                return value

    while at < len(data):
        key = take()
        kind = key & 7
        if kind == 0:
            content: int | bytes = take()
        else:
            size = {1: 8, 5: 4}.get(kind) or take()
            content = data[at : at + size]
            at += size
        found.setdefault(key >> 3, []).append(content)
    return found


@dataclass(frozen=True)
class Command:
    """What a client answered."""

    sequence: int
    reflected: int
    position: np.ndarray | None = None
    wrench: np.ndarray | None = None
    torque: np.ndarray | None = None

    @classmethod
    def parse(cls, data: bytes) -> Command:
        assert len(data) <= 1500
        message = fields(data)
        header = fields(message[1][0])
        assert struct.unpack("<I", header[1][0])[0] == 0x34001
        (sequence,), (reflected,) = header.get(2, [0]), header.get(3, [0])
        values: dict[str, np.ndarray] = {}
        if 2 in message:
            held = fields(message[2][0])
            for tag, name in ((1, "position"), (2, "wrench"), (3, "torque")):
                if tag in held:
                    values[name] = np.array([struct.unpack("<d", v)[0] for v in fields(held[tag][0])[1]])
        return cls(sequence, reflected, **values)


@dataclass
class Network:
    """What happens to datagrams on the way; probabilities per datagram."""

    loss: float = 0.0
    delay: float = 0.0
    """comes one cycle later, so after a newer one"""
    double: float = 0.0
    seed: int = 0
    rng: np.random.Generator = field(init=False)

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(self.seed)

    def fate(self) -> str:
        draw = self.rng.random()
        for name in ("loss", "delay", "double"):
            draw -= getattr(self, name)
            if draw < 0.0:
                return name
        return "fine"


class FriController(threading.Thread):
    """The controller; a context manager.

    Args:
        port: that the client listens at.
        mode: overlay of the robot program's motion.
        layout: "1.15" or "2.5".
        period: [s].
        multiplier: every which message wants an answer.
        network: what happens on the way.
        realtime: a cycle lasts its period; False: until its answer has come.
        wait: for an answer in lockstep at most [s].
        commanding: the robot program runs its overlay motion.
        arm: what moves.
    """

    def __init__(
        self,
        port: int = 30200,
        *,
        mode: str = "torque",
        layout: str = "1.15",
        period: float = 0.002,
        multiplier: int = 1,
        network: Network | None = None,
        realtime: bool = False,
        wait: float = 0.4,
        commanding: bool = True,
        packed: bool = False,
        arm: Arm = ARM,
    ) -> None:
        super().__init__(daemon=True)
        self.client = ("127.0.0.1", port)
        self.mode, self.layout, self.period = mode, layout, period
        self.multiplier, self.network = multiplier, network or Network()
        self.realtime, self.wait, self.commanding, self.packed = realtime, wait, commanding, packed
        self.arm = arm
        self.plant = Plant(arm, integrator="discrete", timestep=period)
        self.plant.reset(HOME, time_ns=1_000_000_000)
        self.control_mode = CONTROL_MODES[mode]
        self.state, self.safety, self.drive = WAIT, 0, 2
        self.sequence = 0
        self.ipo = HOME.copy()
        self.hold = HOME.copy()
        self.answered: deque[bool] = deque(maxlen=100)
        self.mirrored = 0
        self.commands: list[Command] = []
        self.stale = 0
        self.missed = 0
        self.cycles = 0
        self.fell_back = 0
        self.paused = False
        self.before_send: Callable[[bytes], bytes] = lambda data: data
        self.made_for: Callable[[int, Command], bool] = lambda time_ns, command: True
        self.foreign = 0
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self._delayed: list[bytes] = []
        self._over = threading.Event()

    def __enter__(self) -> FriController:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.finish()

    def finish(self) -> None:
        self._over.set()
        self.join(10)
        self.socket.close()

    @property
    def quality(self) -> int:
        """From how many of the last 100 messages that wanted an answer have none."""
        if len(self.answered) < 10:
            return POOR
        missing = self.answered.count(False)
        return EXCELLENT if missing <= 2 else GOOD if missing <= 10 else FAIR if missing <= 50 else POOR

    def monitoring(self) -> bytes:
        """The message of this cycle."""
        q, torque, t = self.plant.q, self.plant.torque, self.plant.time_ns
        external = torque - self.arm.gravity_torque(q)
        header = b"\x0d" + struct.pack("<I", 0x245142) + number(2, self.sequence) + number(3, 0)
        robot = number(1, 7) + number(2, self.safety) + 7 * number(5, self.drive)
        robot += number(6, 2) + number(7, self.control_mode)
        monitor = doubles(1, q, self.packed) + doubles(2, torque, self.packed)
        if self.layout == "1.15":
            monitor += doubles(3, self.hold)
        monitor += doubles(4, torque) + doubles(5, external)
        if self.layout == "2.5":  # a pose that the client does not know
            monitor += block(9, b"\x0a\x03abc" + 7 * (b"\x11" + struct.pack("<d", 0.5))) + block(
                10, number(1, 3)
            )
        monitor += block(15, number(1, t // 10**9) + number(2, t % 10**9))
        connection = number(1, self.state) + number(2, self.quality)
        connection += number(3, round(self.period * 1e3)) + number(4, self.multiplier)
        ipo = b""
        if self.state >= COMMANDING_WAIT:
            ipo = doubles(1, self.ipo, self.packed)
            ipo += number(10, COMMAND_MODES[self.mode]) + number(11, 1)
            ipo += varint(12 << 3 | 1) + struct.pack("<d", 1.0)
        return (
            block(1, header)
            + block(2, robot)
            + block(3, monitor)
            + block(4, connection)
            + block(5, ipo)
            + block(15, number(1, 0) + number(2, 0))
        )

    def run(self) -> None:
        due = time.monotonic()
        while not self._over.is_set():
            if self.paused:
                time.sleep(0.005)
                due = time.monotonic()
                continue
            due += self.period
            self._cycle(due)
            if self.realtime:
                time.sleep(max(0.0, due - time.monotonic()))

    def _cycle(self, due: float) -> None:
        if (
            not self.commands
        ):  # until a client is there nothing counts, so that a run does not depend on when it came
            self.answered.clear()
            self.missed = 0
        fate = self.network.fate() if self.commands else "fine"
        data = self.before_send(self.monitoring())
        late, self._delayed = self._delayed, []
        if fate == "delay":
            self._delayed.append(data)
        elif fate != "loss":
            for _ in range(2 if fate == "double" else 1):
                self._send(data)
        for old in late:
            self._send(old)
        wants = self.sequence % self.multiplier == self.multiplier - 1
        reached = fate in ("fine", "double")
        command = self._await(due) if wants and (reached or self.realtime) else None
        if len(self.commands) == 1:
            self._begin_again()
        if wants:
            self.answered.append(command is not None)
            self.missed += command is None
            self._session(command)
        if self.commands:
            self.plant.step(self._drives(command), round(self.period * 1e9))
        else:  # the clock runs, the arm waits: its last digits must not tell how long
            load = self.plant.load
            self.plant.reset(HOME, time_ns=self.plant.time_ns + round(self.period * 1e9))
            if load is not None:
                self.plant.attach(load)
        self.ipo = self.hold.copy()
        self.sequence = (self.sequence + 1) % 2**32
        self.cycles += 1

    def _begin_again(self) -> None:
        """The first answer has come: where the arm is now must not depend on how long that took."""
        load = self.plant.load
        self.plant.reset(HOME, time_ns=self.plant.time_ns)
        if load is not None:
            self.plant.attach(load)
        self.ipo, self.hold = HOME.copy(), HOME.copy()

    def _send(self, data: bytes) -> None:
        try:
            self.socket.sendto(data, self.client)
        except ConnectionRefusedError:
            pass

    def _await(self, due: float) -> Command | None:
        """The answer to this cycle's message, if it comes in time."""
        command = None
        end = due if self.realtime else time.monotonic() + (self.wait if self.commands else 0.05)
        while command is None and not self._over.is_set():
            self.socket.settimeout(min(max(1e-4, end - time.monotonic()), 0.05))
            try:
                data = self.socket.recv(2000)
            except (TimeoutError, ConnectionRefusedError):
                if time.monotonic() >= end:
                    return None
                continue
            if self.commands and self.network.fate() in ("loss", "delay"):  # too late is as good as never
                if not self.realtime:
                    return None
                continue
            parsed = Command.parse(data)
            if parsed.reflected != self.sequence:
                self.stale += 1
                continue
            command = parsed
            self.commands.append(parsed)
            self.foreign += not self.made_for(self.plant.time_ns, parsed)
        return command

    def _session(self, command: Command | None) -> None:
        """The next state of the session."""
        if self.safety or (self.state >= COMMANDING_WAIT and (self.quality < GOOD or not self.commanding)):
            self.fell_back += self.state == ACTIVE
            self.state, self.mirrored = (WAIT if self.quality < GOOD else READY), 0
        elif self.state == WAIT and self.quality >= GOOD:
            self.state = READY
        elif self.state == READY and self.commanding:
            self.state, self.hold = COMMANDING_WAIT, self.plant.q
        elif self.state == COMMANDING_WAIT and command is not None and command.position is not None:
            assert np.array_equal(command.position, self.ipo), "the interpolated position must be mirrored"
            self.mirrored += 1
            if self.mirrored == 5:
                self.state = ACTIVE

    def _drives(self, command: Command | None) -> np.ndarray:
        """Link-side torque of the coming period [N m]."""
        q, dq = self.plant.q, self.plant.dq
        if self.state == ACTIVE and self.mode != "position":
            self.hold = q
            tau = self.arm.gravity_torque(q)
            if command is not None and command.torque is not None:
                tau = tau + command.torque
            if command is not None and command.wrench is not None:
                T, J = self.arm.forward_kinematics(q), self.arm.jacobian(q)
                tau = tau + J[:3].T @ (T[:3, :3] @ command.wrench[:3])
            return tau
        if self.state == ACTIVE and command is not None and command.position is not None:
            self.hold = self.hold + np.clip(command.position - self.hold, -0.002, 0.002)
        return self.arm.inverse_dynamics(q, dq, 2500.0 * (self.hold - q) - 100.0 * dq)


def wave(time_ns: int) -> float:
    """Force [N] along z that a client lays over the motion in the run below; it tells for which message it is."""
    return 0.1 + 0.05 * np.sin(time_ns * 1e-9)


if __name__ == "__main__":  # in real time, for so many seconds; then say how it went
    controller = FriController(
        int(sys.argv[1]), mode="wrench", realtime=True, network=Network(float(sys.argv[3]))
    )
    controller.made_for = lambda t, c: c.wrench is None or c.wrench[2] in (0.0, wave(t))
    controller.start()
    time.sleep(float(sys.argv[2]))
    controller.finish()
    words = ("cycles", "missed", "stale", "foreign", "fell_back", "state")
    print(json.dumps({w: getattr(controller, w) for w in words} | {"time_ns": controller.plant.time_ns}))
