"""An emulated UR controller in a process of its own: RTDE, dashboard and script ports; a MuJoCo arm moves behind them.

It speaks the server's side of the vendor's published protocols (RTDE 2, dashboard, script upload) and, in place of the
URScript that ur_rtde uploads, does what that script does with the registers. Ports are those of a real controller, so
every instance takes a loopback address of its own.
"""

from __future__ import annotations

import contextlib
import json
import math
import selectors
import socket
import struct
import subprocess
import sys
import time
from typing import Any

import numpy as np

from palpate.arm import Arm, Effort, Limits

RTDE_PORT, DASHBOARD_PORT, SCRIPT_PORT = 30004, 29999, 30003
JOINTS = (
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "elbow_joint",
    "wrist_1_joint",
    "wrist_2_joint",
    "wrist_3_joint",
)
HOME = np.array([0.3, -1.2, 1.4, -1.5, -1.3, 0.2])

# RTDE packages
_VERSION, _CONTROLLER, _TEXT, _DATA, _OUTPUTS, _INPUTS, _START, _PAUSE = b"VvMUOISP"
_FORMATS = {
    "DOUBLE": "d",
    "VECTOR6D": "6d",
    "UINT32": "I",
    "INT32": "i",
    "UINT64": "Q",
}
# what the control script does by number; those in _STREAMED are signalled ready at once, the others done
_STREAMED = frozenset((24, 11, 9, 10, 6, 25, 26, 27, 38, 58, 66, 67, 68, 69, 70, 71))
_FORCE, _FORCE_STOP, _SPEED, _SERVO, _SPEED_STOP, _SERVO_STOP = 6, 7, 9, 11, 15, 16
_STOP_J, _WATCHDOG, _TORQUE, _STOP_SCRIPT = 34, 35, 66, 255
# safety_status_bits, safety_mode
_SAFETY = {"normal": (1, 1), "protective": (1 << 2 | 1 << 10, 3), "emergency": (1 << 7 | 1 << 10, 7)}


def ur5e() -> Arm:
    """Sizes, masses, limits as the vendor publishes for a UR5e; all inertias and the drive gains are round numbers."""
    masses = (3.761, 8.058, 2.846, 1.37, 1.3, 0.365)
    coms = (
        (0, -0.02561, 0.00193),
        (0.2125, 0, 0.11336),
        (0.15, 0, 0.0265),
        (0, -0.0018, 0.01634),
        (0, 0.0018, 0.01634),
        (0, 0, -0.001159),
    )
    spread = (0.03, 0.15, 0.05, 0.003, 0.003, 0.001)
    arm = Arm.from_dh(
        a=(0, -0.425, -0.3922, 0, 0, 0),
        alpha=(math.pi / 2, 0, 0, math.pi / 2, -math.pi / 2, 0),
        d=(0.1625, 0, 0, 0.1333, 0.0997, 0.0996),
        inertials=[(m, c, i * np.eye(3)) for m, c, i in zip(masses, coms, spread, strict=True)],
        joint_names=JOINTS,
        name="ur5e",
        effort=Effort.current(k_t=[0.12, 0.12, 0.12, 0.09, 0.09, 0.09], gear=101),
    )
    turn = 2 * math.pi
    drives = [(150.0, 0.3)] * 3 + [(28.0, 0.06)] * 3
    return arm.replace(
        joints=tuple(
            joint.replace(limits=Limits(-turn, turn, math.pi, torque), rotor_inertia=rotor)
            for joint, (torque, rotor) in zip(arm.joints, drives, strict=True)
        )
    )


def type_of(name: str) -> str:
    """RTDE's type of a field; NOT_FOUND for what this controller does not know."""
    if name.startswith(("input_int_register_", "output_int_register_")):
        return "INT32"
    if name.startswith(("input_double_register_", "output_double_register_")):
        return "DOUBLE"
    return {
        "timestamp": "DOUBLE",
        "payload": "DOUBLE",
        "robot_mode": "INT32",
        "safety_mode": "INT32",
        "runtime_state": "UINT32",
        "robot_status_bits": "UINT32",
        "safety_status_bits": "UINT32",
        "external_force_torque": "VECTOR6D",
        **dict.fromkeys(("actual_q", "actual_qd", "actual_current", "target_moment"), "VECTOR6D"),
    }.get(name, "NOT_FOUND")


class Robot:
    """The arm, its drives and the control script's registers; time goes on by step()."""

    def __init__(self, rate: float, version: str) -> None:
        from palpate.simulate import Plant

        self.arm = ur5e()
        self.plant = Plant(self.arm, integrator="discrete", timestep=2e-3)
        self.rate, self.version = rate, version
        self.period_ns = round(1e9 / rate)
        self.plant.reset(HOME)
        self.gain = self.arm.effort.gain(6)
        self.hold, self.speed = HOME.copy(), np.zeros(6)
        self.mode = "hold"
        self.ints, self.doubles = [0] * 48, [0.0] * 48
        self.out_int = 0
        self.safety = "normal"
        self.robot_mode = 7
        self.payload = 0.0
        self.program = False
        self.starts_at: int | None = None
        self.executing = False
        self.watchdog_ns = 0
        self.fed_ns = 0
        self.commands: dict[int, int] = {}

    def upload(self) -> None:
        """A script has arrived; it starts a little later."""
        if self.safety == "normal":
            self.starts_at = self.plant.time_ns + 20_000_000

    def stop_program(self) -> None:
        """The program is at its end: the arm is braked and held where it is."""
        self.program, self.starts_at, self.watchdog_ns = False, None, 0
        self._halt()

    def _halt(self) -> None:
        self.mode, self.hold = "hold", self.plant.q

    def received(self, names: list[str], values: list[Any]) -> None:
        """An input package."""
        for name, value in zip(names, values, strict=True):
            kind, _, index = name.rpartition("_")
            (self.ints if kind == "input_int_register" else self.doubles)[int(index)] = value
        self.fed_ns = self.plant.time_ns

    def step(self) -> None:
        """One control period: script, drives, arm."""
        now = self.plant.time_ns
        if self.starts_at is not None and now >= self.starts_at:
            self.program, self.starts_at, self.executing, self.out_int = True, None, False, 1
        if self.program and self.watchdog_ns and now - self.fed_ns > self.watchdog_ns:
            self.stop_program()
        if self.program:
            self._script(self.ints[0])
        self.plant.step(self._drives(), self.period_ns)

    def _script(self, cmd: int) -> None:
        if cmd == 0:
            self.executing, self.out_int = False, 1
            if self.mode == "torque":  # direct torque holds for the one period in which it is commanded
                self._halt()
            return
        if cmd in _STREAMED:
            self._do(cmd)
            self.out_int = 1
        elif not self.executing:
            self.commands[cmd] = self.commands.get(cmd, 0) + 1
            self._do(cmd)
            self.executing, self.out_int = True, 2

    def _do(self, cmd: int) -> None:
        six = np.array(self.doubles[:6])
        if cmd == _TORQUE:
            self.mode, self.target = "torque", six
        elif cmd == _SPEED:
            if self.mode != "speed":
                self.hold, self.speed = self.plant.q, np.zeros(6)
            self.mode, self.target = "speed", six
        elif cmd == _SERVO:
            self.mode, self.target = "servo", six
        elif cmd == _FORCE:
            wrench, chosen = np.array(self.doubles[6:12]), np.array(self.ints[2:8])
            self.mode, self.target = "force", wrench * chosen
        elif cmd == _STOP_SCRIPT:
            self.stop_program()
        elif cmd == _WATCHDOG:
            self.watchdog_ns = round(1e9 / self.doubles[0])
        elif cmd in (_FORCE_STOP, _SPEED_STOP, _SERVO_STOP, _STOP_J):
            self._halt()

    def _drives(self) -> np.ndarray:
        """Link-side torque of the coming period [N m]."""
        q, dq, dt = self.plant.q, self.plant.dq, self.period_ns * 1e-9
        if self.mode == "torque":
            return self.target + self.arm.gravity_torque(q)
        if self.mode == "force":
            return self.arm.inverse_dynamics(q, dq, -20.0 * dq) + self.arm.jacobian(q).T @ self.target
        wanted = np.zeros(6)
        if self.mode == "speed":
            wanted = self.speed = self.speed + np.clip(self.target - self.speed, -2.0 * dt, 2.0 * dt)
            self.hold = self.hold + self.speed * dt
        elif self.mode == "servo":
            self.hold = self.hold + np.clip(self.target - self.hold, -1.0 * dt, 1.0 * dt)
        return self.arm.inverse_dynamics(q, dq, 2500.0 * (self.hold - q) + 100.0 * (wanted - dq))

    def field(self, name: str) -> Any:
        """Value of an RTDE output."""
        bits, mode = _SAFETY[self.safety]
        match name:
            case "timestamp":
                return self.plant.time_ns * 1e-9
            case "actual_q":
                return self.plant.q
            case "actual_qd":
                return self.plant.dq
            case "actual_current":
                return self.plant.torque / self.gain
            case "target_moment":
                return self.arm.gravity_torque(self.plant.q)
            case "payload":
                return self.payload
            case "robot_mode":
                return self.robot_mode
            case "safety_mode":
                return mode
            case "safety_status_bits":
                return bits
            case "robot_status_bits":
                return 1 | 2 * self.program
            case "runtime_state":
                return 2 if self.program else 1
            case "output_int_register_0":
                return self.out_int
        return 0


class Connection:
    """One client at the RTDE port."""

    def __init__(self, sock: socket.socket, robot: Robot) -> None:
        self.sock, self.robot = sock, robot
        self.buffer = b""
        self.outputs: list[tuple[str, str]] = []
        self.inputs: list[tuple[list[str], str]] = []
        self.every, self.left, self.running = 1, 0, False

    def send(self, kind: int, payload: bytes) -> None:
        self.sock.sendall(struct.pack(">HB", 3 + len(payload), kind) + payload)

    def feed(self, data: bytes) -> None:
        self.buffer += data
        while len(self.buffer) >= 3:
            size, kind = struct.unpack(">HB", self.buffer[:3])
            if size < 3 or len(self.buffer) < size:
                return
            payload, self.buffer = self.buffer[3:size], self.buffer[size:]
            self.answer(kind, payload)

    def answer(self, kind: int, payload: bytes) -> None:
        if kind == _VERSION:
            self.send(kind, b"\x01")
        elif kind == _CONTROLLER:
            self.send(kind, struct.pack(">4I", *map(int, self.robot.version.split("."))))
        elif kind == _OUTPUTS:
            rate, names = struct.unpack(">d", payload[:8])[0], payload[8:].decode().split(",")
            self.outputs = [(n, type_of(n)) for n in names if n]  # ur_rtde ends its list with a comma
            self.every = max(1, round(self.robot.rate / rate))
            self.send(kind, b"\x01" + ",".join(t for _, t in self.outputs).encode())
        elif kind == _INPUTS:
            names = [n for n in payload.decode().split(",") if n]
            types = [type_of(n) for n in names]
            self.inputs.append((names, ">" + "".join(_FORMATS[t] for t in types)))
            self.send(kind, bytes([len(self.inputs)]) + ",".join(types).encode())
        elif kind in (_START, _PAUSE):
            self.running = kind == _START
            self.send(kind, b"\x01")
        elif kind == _DATA:
            names, layout = self.inputs[payload[0] - 1]
            if "external_force_torque" not in names:
                self.robot.received(names, list(struct.unpack(layout, payload[1:])))

    def publish(self) -> None:
        """The data package of this period."""
        self.left -= 1
        if not self.running or self.left > 0:
            return
        self.left = self.every
        out = b"\x01"
        for name, kind in self.outputs:
            value = self.robot.field(name)
            layout = ">" + _FORMATS[kind]
            out += struct.pack(layout, *(np.broadcast_to(value, 6) if kind == "VECTOR6D" else [value]))
        self.send(_DATA, out)


class Server:
    """Sockets and the clock."""

    def __init__(self, host: str, rate: float, version: str) -> None:
        self.robot = Robot(rate, version)
        self.host, self.version = host, version
        self.select = selectors.DefaultSelector()
        self.listeners: list[socket.socket] = []
        self.clients: dict[socket.socket, Connection | str] = {}
        self.silent = False
        self.select.register(sys.stdin, selectors.EVENT_READ)
        self.listen()

    def listen(self) -> None:
        if self.listeners:
            return
        for port in (RTDE_PORT, DASHBOARD_PORT, SCRIPT_PORT):
            listener = socket.socket()
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind((self.host, port))
            listener.listen(8)
            self.listeners.append(listener)
            self.select.register(listener, selectors.EVENT_READ)

    def drop(self, sock: socket.socket) -> None:
        self.select.unregister(sock)
        del self.clients[sock]
        sock.close()

    def cut(self) -> None:
        """The cable is out: every connection ends, nobody answers."""
        for sock in list(self.clients):
            self.drop(sock)
        for listener in self.listeners:
            self.select.unregister(listener)
            listener.close()
        self.listeners = []

    def accept(self, listener: socket.socket) -> None:
        sock, _ = listener.accept()
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        port = listener.getsockname()[1]
        self.clients[sock] = Connection(sock, self.robot) if port == RTDE_PORT else str(port)
        self.select.register(sock, selectors.EVENT_READ)
        if port == DASHBOARD_PORT:
            sock.sendall(b"Connected: Universal Robots Dashboard Server\n")

    def serve(self, sock: socket.socket) -> None:
        data = sock.recv(1 << 16)
        if not data:
            self.drop(sock)
            return
        client = self.clients[sock]
        if isinstance(client, Connection):
            client.feed(data)
        elif client == str(DASHBOARD_PORT):
            for line in data.decode().splitlines():
                sock.sendall((self.dashboard(line.strip()) + "\n").encode())
        elif data.rstrip().endswith(b"end"):
            self.robot.upload()

    def dashboard(self, line: str) -> str:
        if line == "stop":
            self.robot.stop_program()
        return {
            "PolyscopeVersion": f"URSoftware {self.version} (Jan 01 2026)",
            "is in remote control": "true",
            "get serial number": "20260000001",
            "stop": "Stopped",
        }.get(line, f"could not understand: '{line}'")

    def order(self, line: str) -> Any:
        """What the test asks for, one word and maybe a number."""
        word, _, value = line.strip().partition(" ")
        robot = self.robot
        if word == "cut":
            self.cut()
        elif word == "mend":
            self.listen()
        elif word == "silent":
            self.silent = value == "on"
        elif word in _SAFETY:
            robot.safety = word
            if word != "normal":
                robot.stop_program()
        elif word == "power":
            robot.robot_mode = 7 if value == "on" else 3
        elif word == "payload":
            robot.payload = float(value)
        elif word == "hold":
            robot.plant.attach(float(value))
        elif word == "release":
            robot.plant.release()
        elif word == "home":
            robot.stop_program()
            robot.plant.reset(HOME, time_ns=robot.plant.time_ns)
            robot.hold = HOME.copy()
        else:
            assert word == "state", line
        return {
            "q": robot.plant.q.tolist(),
            "dq": robot.plant.dq.tolist(),
            "mode": robot.mode,
            "program": robot.program,
            "watchdog_ns": robot.watchdog_ns,
            "commands": robot.commands,
        }

    def run(self) -> None:
        period = self.robot.period_ns * 1e-9
        start_ns = time.monotonic_ns()
        self.robot.plant.reset(HOME, time_ns=start_ns)
        due = start_ns * 1e-9 + period  # so that a stamp less this clock is the age of a package
        while True:
            for key, _ in self.select.select(max(0.0, due - time.monotonic())):
                sock: Any = key.fileobj
                if sock is sys.stdin:
                    line = sys.stdin.readline()
                    if not line:
                        return
                    print(json.dumps(self.order(line)), flush=True)
                elif sock in self.listeners:
                    self.accept(sock)
                elif sock in self.clients:
                    try:
                        self.serve(sock)
                    except OSError:
                        self.drop(sock)
            if time.monotonic() < due:
                continue
            due += period
            self.robot.step()
            for sock, client in list(self.clients.items()):
                if isinstance(client, Connection) and not self.silent:
                    try:
                        client.publish()
                    except OSError:
                        self.drop(sock)


class UrController:
    """Starts the emulated controller and talks with it; a context manager.

    Args:
        host: loopback address it listens at.
        rate: packages per second [Hz]; 125 is a CB3.
        version: of its software.
    """

    def __init__(self, host: str, rate: float = 500.0, version: str = "5.26.0.1") -> None:
        self.host = host
        self._process = subprocess.Popen(
            [sys.executable, __file__, host, str(rate), version],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self._process.stdout is not None
        assert self._process.stdout.readline() == "ready\n"

    def tell(self, order: str) -> Any:
        """Do something, and say how things are."""
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(order + "\n")
        self._process.stdin.flush()
        return json.loads(self._process.stdout.readline())

    def close(self) -> None:
        assert self._process.stdin is not None and self._process.stdout is not None
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.close()
        self._process.wait(10)
        self._process.stdout.close()

    def __enter__(self) -> UrController:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


if __name__ == "__main__":
    server = Server(sys.argv[1], float(sys.argv[2]), sys.argv[3])
    print("ready", flush=True)
    server.run()
