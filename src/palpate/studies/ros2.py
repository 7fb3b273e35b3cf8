"""ROS 2 beside software that nobody here wrote: every message there and back; the published graph as processes.

Builds and runs the peers of ``benchmarks/ros2`` in the source tree: Fast DDS (C++), ros2-client on RustDDS (Rust) and,
over Zenoh, hiroz (Rust).
"""

from __future__ import annotations

import math
import os
import shutil
import signal
import subprocess
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..errors import InputError, PalpateError
from ..ros import Context, Node, Reliability
from ..ros.context import Rmw
from ..ros.graphs import GRAPHS, TASKS
from ..ros.launch import Launch, graph
from ..ros.messages import Header, InertiaStamped, JointState, JointTrajectory, Time
from ..weigh import Task, load_arm, make_pipeline, scene
from ..weigh import run as run_trial
from . import Progress, Row
from ._rows import at_most, told
from .speed import source_tree

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SECONDS = 60.0
"""of each stream [s]"""
RATES = (250.0, 1000.0)
"""[Hz]"""
WEIGHING = 10.0
"""of the graph's weighing [s], simulated"""
WITHIN = 0.01
"""of the mass, relative"""
_DEEP = Reliability(depth=10_000)
"""so that a busy machine may stop either side for seconds"""
_PATIENCE = 60.0
"""for a match, an answer, a mass [s]"""
_SCOUTING = {
    "ZENOH_CONFIG_OVERRIDE": 'scouting/multicast/enabled=true;scouting/multicast/interface="lo";connect/endpoints=[]'
}
"""for a peer over Zenoh: find each other on this machine without a router, as palpate does"""
_JOINTS = tuple(f"joint_{k}" for k in range(1, 8))


# --- peers -------------------------------------------------------------------------------------------------------


def _sources(tree: Path) -> Path:
    folder = tree / "benchmarks" / "ros2"
    if not (folder / "fastdds_peer.cpp").is_file():
        raise InputError(f"{tree} holds no benchmarks/ros2: run it inside a clone")
    return folder


def _compiled(command: list[str], what: str, environment: Mapping[str, str] | None = None) -> None:
    done = subprocess.run(
        command,
        capture_output=True,
        text=True,
        env=None if environment is None else {**os.environ, **environment},
        check=False,
    )
    if done.returncode:
        raise PalpateError(f"{what} does not build: {done.stderr.strip()[-1500:]}")


def build_fastdds(tree: Path, folder: Path) -> Path:
    """Build the Fast DDS peer into a folder; its program.

    Raises:
        InputError: this is no clone, or compiler or library are missing.
        PalpateError: it does not build.
    """
    source = _sources(tree) / "fastdds_peer.cpp"
    compiler = shutil.which("c++") or shutil.which("g++")
    if compiler is None:
        raise InputError("the Fast DDS peer needs a C++ compiler: apt install g++")
    if not Path("/usr/include/fastrtps/fastrtps_dll.h").is_file():
        raise InputError("the Fast DDS peer needs Fast DDS 2: apt install libfastrtps-dev")
    folder.mkdir(parents=True, exist_ok=True)
    program = folder / "fastdds_peer"
    libraries = ["-lfastrtps", "-lfastcdr", "-pthread"]
    _compiled(
        [compiler, "-std=c++20", "-O1", str(source), "-o", str(program), *libraries], "the Fast DDS peer"
    )
    return program


def build_rust(tree: Path, folder: Path) -> Path:
    """Build the ros2-client peer into a folder; its program. The first time takes minutes, and a network.

    Raises:
        InputError: this is no clone, or cargo is missing.
        PalpateError: it does not build.
    """
    return _built_by_cargo(tree, folder, "rust_peer", "the ros2-client peer")


def build_zenoh(tree: Path, folder: Path) -> Path:
    """Build the hiroz peer into a folder; its program. The first time takes minutes, and a network.

    Raises:
        InputError: this is no clone, or cargo is missing.
        PalpateError: it does not build.
    """
    return _built_by_cargo(tree, folder, "zenoh_peer", "the hiroz peer")


def _built_by_cargo(tree: Path, folder: Path, name: str, what: str) -> Path:
    manifest = _sources(tree) / name / "Cargo.toml"
    cargo = shutil.which("cargo")
    if cargo is None:
        raise InputError(f"{what} needs Rust's cargo 1.85 or later: https://rustup.rs")
    command = [cargo, "build", "--release", "--quiet", "--manifest-path", str(manifest)]
    _compiled(command, what, {"CARGO_TARGET_DIR": str(folder)})
    return folder / "release" / name


@contextmanager
def _running(program: Path, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    peer = subprocess.Popen(
        [str(program), *arguments], stdout=subprocess.PIPE, text=True, env={**os.environ, **_SCOUTING}
    )
    try:
        assert peer.stdout is not None
        if peer.stdout.readline() != "up\n":
            raise PalpateError(f"{program.name} does not start")
        yield peer
    finally:
        peer.kill()
        peer.wait()


# --- there and back ----------------------------------------------------------------------------------------------


class Stream(NamedTuple):
    """What came of a stream of messages that were sent back."""

    sent: int
    lost: int
    """never came back"""
    disordered: int
    """came back behind a later one, or twice"""
    round_trip: tuple[float, float]
    """median and 99 % quantile [ms]"""
    write: float
    """median time of publish() [us]"""
    late: int
    """sent more than a period late: what this machine did meanwhile"""


class Peer(NamedTuple):
    """Software that sends messages back."""

    name: str
    build: Callable[[Path, Path], Path]
    rmw: Rmw = "dds"
    localhost: bool = True


PEERS = (
    Peer("Fast DDS (C++)", build_fastdds),
    Peer("ros2-client on RustDDS (Rust)", build_rust, localhost=False),
    Peer("hiroz over Zenoh (Rust)", build_zenoh, "zenoh"),
)


def stream(
    program: Path, domain: int, rate: float, seconds: float, *, rmw: Rmw = "dds", localhost: bool = True
) -> Stream:
    """Send JointStates of seven joints to a peer's echo at `rate` [Hz].

    Raises:
        PalpateError: the peer does not answer.
    """
    topic = f"/palpate_{os.getpid()}/joint_states"
    count = round(rate * seconds)
    begun, back = np.zeros(count), np.full(count, np.nan)
    writing = np.zeros(count)
    disordered = 0
    newest = -1
    warm = 0

    def take(message: JointState, writer: int) -> None:
        nonlocal disordered, newest, warm
        k = message.header.stamp.nanosec
        if message.header.stamp.sec == 0:
            warm += 1
        elif math.isnan(back[k]):
            back[k] = time.perf_counter()
            disordered += k < newest
            newest = max(newest, k)
        else:
            disordered += 1

    values = [0.1 * k for k in range(len(_JOINTS))]
    with (
        _running(program, "echo", str(domain), topic) as peer,
        Context(domain, localhost=localhost, rmw=rmw) as there,
        Node("palpate_bench", there, quiet=True) as node,
    ):
        out = node.publish(JointState, topic, _DEEP)
        node.subscribe(JointState, f"{topic}_echo", take, _DEEP)
        end = time.monotonic() + _PATIENCE
        while not warm:  # until both ends know both ends
            if time.monotonic() > end:
                raise PalpateError(f"{program.name} does not answer within {_PATIENCE:g} s")
            if out.readers:
                out.publish(JointState(Header(Time(0, 0)), _JOINTS, values, values, values))
            node.spin_once(0.2)
        while node.spin_once(0.5):
            continue
        late = 0
        origin = time.perf_counter()
        for k in range(count):
            message = JointState(Header(Time(1, k), "base"), _JOINTS, values, values, values)
            begun[k] = time.perf_counter()
            out.publish(message)
            writing[k] = time.perf_counter() - begun[k]
            late += begun[k] - origin > (k + 1) / rate
            while (rest := origin + (k + 1) / rate - time.perf_counter()) > 0.0:
                node.spin_once(rest)
        node.spin_until(lambda: not np.isnan(back).any(), 5.0)
        if peer.poll() is not None:
            raise PalpateError(f"{program.name} ended by itself, with code {peer.returncode}")
    trip = 1e3 * (back - begun)[np.isfinite(back)]
    quantiles = np.quantile(trip, [0.5, 0.99]) if len(trip) else np.full(2, np.nan)
    return Stream(
        count,
        int(np.isnan(back).sum()),
        disordered,
        (float(quantiles[0]), float(quantiles[1])),
        float(1e6 * np.median(writing)),
        late,
    )


def stream_rows(name: str, found: Stream, rate: float, seconds: float) -> list[Row]:
    """What is required of a stream, and what it took."""
    what = f"{name}, {rate:g} Hz, {seconds:g} s there and back"
    note = f"{found.sent} messages of 7 joints, reliable; {found.late} were sent more than a period late"
    p50, p99 = found.round_trip
    return [
        at_most(f"{what}: messages lost", 0, found.lost, "1", note),
        at_most(f"{what}: out of order or twice", 0, found.disordered, "1"),
        told(f"{what}: round trip, median and 99 %", f"{p50:.2f}, {p99:.2f}", "ms"),
        told(f"{what}: publish(), median", f"{found.write:.0f}", "us"),
    ]


# --- the graph ---------------------------------------------------------------------------------------------------


def weigh_by_graph(domain: int, seconds: float, seed: int) -> tuple[float, float]:
    """Mass [kg] that the launched graph tells last, and that of a trial in this process."""
    arm = scene(load_arm("justina_left_arm"))
    masses: list[float] = []
    readers = 1 + sum(TASKS[node].reads_samples for node in GRAPHS["mass-estimation"])
    with (
        Context(domain, localhost=True, rmw="dds") as there,
        Node("palpate_bench", there, quiet=True) as node,
    ):
        node.subscribe(JointState, "joint_states", lambda m, w: None)
        node.subscribe(InertiaStamped, "payload", lambda m, w: masses.append(m.inertia.m))
        simulation = {"pace": 0.0, "duration": seconds, "seed": seed, "wait_for": readers}
        arguments = ["--ros-args"]
        for name, value in simulation.items():
            arguments += ["-p", f"arm_simulation:{name}:={value}"]
        launched = Launch(graph("mass-estimation"), arguments, _where(domain))
        launched.start()
        guard = threading.Thread(target=launched.watch)
        guard.start()
        while guard.is_alive():
            node.spin_once(0.05)
        guard.join()
    task = Task(
        scene=arm,
        start=arm.poses[arm.start],
        poses=(arm.poses[arm.pose],),
        loads=((0.0, arm.mass),),
        duration=seconds,
        seed=seed,
    )
    trial = run_trial(task, make_pipeline(arm.arm, None, None)[0])
    return masses[-1] if masses else math.nan, float(trial.touch.payload.mass[-1])


_ANSWERS = {
    "arm_simulation": "joint_states",
    "trajectory": "setpoint",
    "control": "joint_commands",
    "sliding_mode_observer": "external_torque",
    "extended_kalman_filter": "estimated_state",
}
"""what each node but the last publishes for every sample"""


def kill_each(domain: int) -> dict[str, float]:
    """Kill each node of a running graph in turn; seconds until it has answered a hundred samples and the mass is known
    again within 5 %, inf: never."""
    found: dict[str, float] = {}
    recent: list[float] = []
    answers: Counter[str] = Counter()
    truth = scene(load_arm("justina_left_arm")).mass
    stop = threading.Event()
    launched = Launch(
        graph("mass-estimation"),
        ["--ros-args", "-p", "arm_simulation:pace:=0.0"],
        _where(domain),
        restart=True,
    )

    def known() -> bool:
        return len(recent) >= 100 and all(abs(m - truth) <= 0.05 * truth for m in recent[-100:])

    with (
        Context(domain, localhost=True, rmw="dds") as there,
        Node("palpate_bench", there, quiet=True) as node,
    ):
        node.subscribe(InertiaStamped, "payload", lambda m, w: recent.append(m.inertia.m))
        for name, topic in _ANSWERS.items():
            message = JointTrajectory if name == "trajectory" else JointState
            node.subscribe(message, topic, partial(_count, answers, name))
        launched.start()
        guard = threading.Thread(target=launched.watch, args=(stop.is_set,))
        guard.start()
        try:
            ready = node.spin_until(known, _PATIENCE)
            for name in launched.nodes:
                before = launched.pids.get(name)
                if not ready or before is None:
                    found[name] = math.inf
                    continue
                begin = time.monotonic()
                os.kill(before, signal.SIGKILL)
                node.spin_until(_replaced(launched, name, before), _PATIENCE)
                recent.clear()
                answers.clear()
                ready = node.spin_until(partial(_answered, answers, name, known), _PATIENCE)
                found[name] = time.monotonic() - begin if ready else math.inf
        finally:
            stop.set()
            guard.join()
    return found


def _count(answers: Counter[str], name: str, message: object, writer: int) -> None:
    answers[name] += 1


def _answered(answers: Counter[str], name: str, known: Callable[[], bool]) -> bool:
    return known() and (name not in _ANSWERS or answers[name] >= 100)


def _replaced(launched: Launch, name: str, before: int) -> Callable[[], bool]:
    return lambda: launched.pids.get(name, before) != before


def _where(domain: int) -> list[str]:
    return ["--domain", str(domain), "--localhost", "--rmw", "dds", "--quiet"]


# --- both --------------------------------------------------------------------------------------------------------


def run(progress: Progress, quick: bool) -> tuple[list[Row], Mapping[str, Figure], list[str]]:
    """Measure; `quick` with streams of a few seconds."""
    seconds = 5.0 if quick else SECONDS
    domain = 1 + os.getpid() % 100
    rows: list[Row] = []
    tree = source_tree()
    steps = len(PEERS) * len(RATES) + 2
    done = 0
    progress(done, steps, math.inf)
    for name, build, rmw, localhost in PEERS:
        try:
            program = build(tree, tree / "build" / "peers" / build.__name__.removeprefix("build_"))
        except PalpateError as error:
            rows.append(
                Row(f"{name}: messages lost", "<= 0", "not measured", None, False, "1", str(error)[:300])
            )
            done += len(RATES)
            continue
        for rate in RATES:
            found = stream(program, domain, rate, seconds, rmw=rmw, localhost=localhost)
            rows += stream_rows(name, found, rate, seconds)
            done += 1
            progress(done, steps, math.inf)
    told_mass, alone = weigh_by_graph(domain, 6.0 if quick else WEIGHING, seed=1)
    rows.append(
        at_most(
            "six processes: the mass differs from that of one process by",
            WITHIN,
            abs(told_mass / alone - 1.0),
            "1",
            f"{told_mass:.5g} kg and {alone:.5g} kg of 0.25 kg",
        )
    )
    progress(done + 1, steps, math.inf)
    back = kill_each(domain)
    missing = [name for name, after in back.items() if not math.isfinite(after)]
    times = ", ".join(f"{name} {after:.1f}" for name, after in back.items())
    rows.append(
        at_most(
            "nodes killed and started anew that do not rejoin",
            0,
            len(missing),
            "1",
            f"seconds until the mass is known again: {times}",
        )
    )
    progress(steps, steps, 0.0)
    notes = [
        "Each JointState goes to the peer and back by reliable topics of depth 10000, so what is not lost there and "
        "back was lost neither way. The sender is Python; times include what else the machine did.",
        "The graph is launched by palpate ros launch mass-estimation in step with its simulated arm. A killed node is "
        "ended by SIGKILL and started anew by the launcher.",
    ]
    return rows, {}, notes
