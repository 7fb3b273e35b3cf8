"""palpate's ROS 2 messages against DDS that nobody here wrote: Debian's Fast DDS (C++) and RustDDS (Rust)."""

from __future__ import annotations

import os
import shutil
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("cyclonedds", reason="ROS 2 needs the extra ros")

from palpate.errors import InputError
from palpate.logs import Sample
from palpate.ros import Context, Node, RosArguments, SampleSource
from palpate.ros.graphs import TASKS
from palpate.ros.messages import Header, InertiaStamped, JointState, Time
from palpate.studies.ros2 import build_fastdds, build_rust
from ros_here import DOMAIN, palpate_ros, until

TREE = Path(__file__).parents[2]
TOPIC = f"/p{os.getpid()}/joint_states"
NAMES = [f"A{k}" for k in range(1, 8)]
MESSAGES = 600


@pytest.fixture(autouse=True)
def _corner(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(
        "CYCLONEDDS_URI", raising=False
    )  # the peers know no tags; the topics bear the process's number


@pytest.fixture(scope="module")
def fastdds(tmp_path_factory: pytest.TempPathFactory) -> Path:
    try:
        return build_fastdds(TREE, tmp_path_factory.mktemp("fastdds"))
    except InputError as missing:
        pytest.skip(str(missing))


@pytest.fixture(scope="module")
def rust() -> Path:
    if not any(
        int(flags.read_text(), 16) & 0x1001 == 0x1001 and flags.parent.name != "lo"
        for flags in Path("/sys/class/net").glob("*/flags")
    ):
        pytest.skip("RustDDS needs an interface with multicast, and there is none")
    try:
        return build_rust(TREE, TREE / "build" / "peers" / "rust")
    except InputError as missing:
        pytest.skip(str(missing))


@contextmanager
def running(*command: str | Path) -> Iterator[subprocess.Popen[str]]:
    """A peer that is up."""
    peer = subprocess.Popen([str(c) for c in command], stdout=subprocess.PIPE, text=True)
    try:
        assert peer.stdout is not None and peer.stdout.readline() == "up\n"
        yield peer
    finally:
        peer.kill()
        peer.wait()


def state(sec: int, count: int) -> JointState:
    values = [0.1 * k + count for k in range(7)]
    return JointState(Header(Time(sec, count), "base"), NAMES, values, values, values)


def there_and_back(me: Node, out: Any, got: list[JointState]) -> None:
    """Every message comes back once, in order, with all its numbers; no matter how slowly."""
    for k in range(MESSAGES):
        out.publish(state(1, k))
        me.spin_once(0.0)
    until([me], lambda: len(got) >= MESSAGES, "the echoes")
    for _ in range(10):
        me.spin_once(0.02)
    assert got == [state(1, k) for k in range(MESSAGES)]


class TestFastDds:
    def test_there_and_back_without_loss(self, fastdds: Path) -> None:
        got: list[JointState] = []
        with (
            running(fastdds, "echo", str(DOMAIN), TOPIC) as peer,
            Context(DOMAIN, localhost=True) as there,
            Node("me", there, quiet=True) as me,
        ):
            out = me.publish(JointState, TOPIC)
            back = me.subscribe(JointState, f"{TOPIC}_echo", lambda m, w: got.append(m))
            until([me], lambda: out.readers and back.writers, "a match")
            assert peer.stdout is not None and peer.stdout.readline() == "ready\n"
            there_and_back(me, out, got)

    def test_a_best_effort_robot_with_joints_in_another_order(self, fastdds: Path) -> None:
        got: list[Sample] = []
        with (
            running(fastdds, "robot", str(DOMAIN), TOPIC),
            Context(DOMAIN, localhost=True) as there,
            Node("me", there, quiet=True) as me,
        ):
            SampleSource(me, NAMES, TOPIC, lambda s, r: got.append(s))
            until([me], lambda: len(got) >= 5, "samples")
            assert not me.troubles
        for sample in got:
            np.testing.assert_array_equal(sample.position, [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7])
            np.testing.assert_array_equal(sample.effort, np.arange(1.0, 8.0))
            assert sample.velocity is None and sample.time_ns >= 100_000_000_000

    def test_giants_are_refused_without_growth(self, fastdds: Path, tmp_path: Path) -> None:
        """A name of 1 MB, 100 000 numbers, a length that lies, over and over: good messages go on, memory stays."""
        answers: list[InertiaStamped] = []
        said = tmp_path / "said"
        with (
            running(fastdds, "giant", str(DOMAIN), TOPIC),
            Context(DOMAIN, localhost=True) as there,
            Node("me", there, quiet=True) as me,
            said.open("w") as output,
        ):
            me.subscribe(InertiaStamped, f"{TOPIC}/payload", lambda m, w: answers.append(m))
            options = [
                "--domain",
                str(DOMAIN),
                "--localhost",
                "--ros-args",
                "-p",
                "arm:=kuka_lbr_iiwa7",
                "-p",
                "assume:=true",
            ]
            remaps = ["-r", f"joint_states:={TOPIC}", "-r", f"payload:={TOPIC}/payload"]
            node = palpate_ros("run", "mass", *options, *remaps, stdout=output)
            try:
                until([me], lambda: answers, "the first answer")
                status = Path(f"/proc/{node.pid}/status")
                before = _peak(status)
                until([me], lambda: len(answers) > 60, "more answers")
                assert node.poll() is None
                assert _peak(status) - before < 20_000, "a hundred MB were thrown at it"
            finally:
                node.terminate()
                node.wait(60)
        assert "oversize" in said.read_text() and "Traceback" not in said.read_text()


def _peak(status: Path) -> int:
    """Largest resident memory so far [kB]."""
    return next(int(line.split()[1]) for line in status.read_text().splitlines() if line.startswith("VmHWM"))


@pytest.mark.slow
class TestRustDds:
    def test_there_and_back_without_loss(self, rust: Path) -> None:
        got: list[JointState] = []
        with (
            running(rust, "echo", str(DOMAIN), TOPIC),
            Context(DOMAIN, localhost=False) as there,
            Node("me", there, quiet=True) as me,
        ):
            out = me.publish(JointState, TOPIC)
            me.subscribe(JointState, f"{TOPIC}_echo", lambda m, w: got.append(m))
            while not got:  # it does not tell when it knows both ends of this one
                out.publish(state(0, 0))
                until([me], lambda: out.readers, "a match")
                me.spin_once(0.2)
            while me.spin_once(1.0):
                continue
            got.clear()
            there_and_back(me, out, got)

    def test_nodes_and_parameters(self, rust: Path) -> None:
        """It finds the node in the graph, lists its parameters, sets one and reads it back."""
        name = f"mass_{os.getpid()}"
        arguments = RosArguments.parse(["--ros-args", "-r", f"__node:={name}"])
        with Context(DOMAIN, localhost=False) as there, TASKS["mass"](there, arguments, quiet=True) as node:
            with running(rust, "params", str(DOMAIN), f"/{name}", "estimator.min_change", "0.02") as peer:
                until([node], lambda: peer.poll() is not None, "its answers")
                assert peer.stdout is not None
                names, put, value = peer.stdout.read().splitlines()
            assert "estimator.min_change" in names.split() and put.startswith("set true")
            assert value == "value 3 0.02" and node.parameters["estimator.min_change"] == 0.02
            with running(rust, "graph", str(DOMAIN)) as peer:
                assert peer.stdout is not None
                lines: list[str] = []
                hear = threading.Thread(target=lambda: lines.extend(peer.stdout or ()), daemon=True)
                hear.start()
                until([node], lambda: f"node /{name}\n" in lines, "its name in the graph")
            hear.join()


def test_what_is_missing_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert shutil.which("cargo") is None
    with pytest.raises(InputError, match="cargo"):
        build_rust(TREE, tmp_path)
    with pytest.raises(InputError, match="C\\+\\+"):
        build_fastdds(TREE, tmp_path)
    with pytest.raises(InputError, match="clone"):
        build_fastdds(tmp_path, tmp_path)
