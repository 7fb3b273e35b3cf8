"""Two processes that teleoperate, and what each says when something is wrong; nothing here depends on speed."""

from __future__ import annotations

import json
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco")
pytest.importorskip("cryptography")

from palpate.cli import main
from palpate.errors import DriverError, InputError
from palpate.logs import Log
from palpate.teleop import Hand, HapticDevice, UdpChannel, make_key
from palpate.teleop.ends import MasterEnd, SlaveEnd
from palpate.teleop.node import Node, join
from palpate.teleop.scenes import smooth
from palpate.teleop.setups import Shared, build_master, build_slave

KEY = bytes(range(32))
LONG_S = 240.0


class Side:
    """A process of `palpate teleop` and what it has said."""

    def __init__(self, *arguments: str) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-u", "-m", "palpate.cli", "teleop", *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env=os.environ | {"PYTHONUNBUFFERED": "1"},
        )
        self.lines: list[str] = []
        self._new: queue.Queue[str] = queue.Queue()
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self._new.put(line.strip())

    def until(self, *starts: str) -> str:
        """The next line that begins like one of these."""
        deadline = time.monotonic() + LONG_S
        while True:
            try:
                line = self._new.get(timeout=max(0.01, deadline - time.monotonic()))
            except queue.Empty:
                pytest.fail(f"none of {starts} came, but {self.lines}")
            self.lines.append(line)
            if line.startswith(starts):
                return line

    def stop(self) -> int:
        self.process.send_signal(signal.SIGINT)
        try:
            return self.process.wait(LONG_S)
        finally:
            self.process.kill()


@pytest.mark.timeout(1200)
def test_two_processes_are_coupled_record_and_are_joined(tmp_path: Path) -> None:
    pytest.importorskip("rosbags")
    key = str(make_key(tmp_path / "key"))
    master_log, slave_log = tmp_path / "master.mcap", tmp_path / "slave.mcap"
    slave = Side("slave", "free", "--key", key, "--bind", "127.0.0.1:0", "--record", str(slave_log))
    master = None
    try:
        place = slave.until("slave at ").split()[2]
        master = Side(
            "master",
            "--connect",
            place,
            "--key",
            key,
            "--script",
            "free",
            "--record",
            str(master_log),
            "--loss",
            "0.1",
        )
        assert "lost" in master.until("coupled") and "clock" in slave.until("coupled")
        assert master.stop() == 0
        slave.until("! the link is dead: held")
        assert slave.stop() == 0
    finally:
        for side in (slave, master):
            if side is not None:
                side.process.kill()
    assert (
        main(["teleop", "join", str(master_log), str(slave_log), "--out", str(tmp_path / "both.mcap")]) == 0
    )
    log = Log.open(tmp_path / "both.mcap")
    assert log.n == 7
    assert {"master_position", "master_felt", "slave_tip", "slave_reference", "master_clock_offset"} <= set(
        log.signals
    )
    assert abs(float(log.meta["clock_offset_s"])) < 1.0  # one machine
    assert any("the link is dead" in event.text for event in log.events if event.text.startswith("slave"))
    assert main(["teleop", "join", str(slave_log), str(master_log), "--out", str(tmp_path / "x.mcap")]) == 2


@pytest.mark.timeout(1200)
def test_a_wrong_key_is_said_in_the_terminal(tmp_path: Path) -> None:
    keys = [str(make_key(tmp_path / name)) for name in ("one", "other")]
    slave = Side("slave", "free", "--key", keys[0], "--bind", "127.0.0.1:0")
    master = None
    try:
        place = slave.until("slave at ").split()[2]
        master = Side("master", "--connect", place, "--key", keys[1])
        assert "need the same key file" in slave.until("! the link is dead: held (another key")
    finally:
        for side in (slave, master):
            if side is not None:
                side.process.kill()


class Cabled(HapticDevice):
    """A device whose cable may come out."""

    out = False

    def read(self) -> tuple[np.ndarray, np.ndarray]:
        if self.out:
            raise DriverError("the cable is out")
        return super().read()


class Pair:
    """Both nodes in this process, step by step."""

    def __init__(
        self, device: HapticDevice | None = None, *, ahead_ns: int = 0, record: Path | None = None
    ) -> None:
        shared = Shared(session=None)
        follower, side, _, _ = build_slave(None, shared=shared)
        there = UdpChannel(KEY, "slave", 6, clock=lambda: time.time_ns() + ahead_ns)
        held = HapticDevice(Hand()) if device is None else device
        here = UdpChannel(KEY, "master", 6, peer=there.address)
        names = (None, None) if record is None else (record / "master.mcap", record / "slave.mcap")
        self.said: list[str] = []
        self.master = Node(
            MasterEnd(held, build_master(held, shared)), here, record=names[0], tell=self.said.append
        )
        self.slave = Node(SlaveEnd(follower, side), there, record=names[1])

    def steps(self, count: int) -> None:
        for _ in range(count):
            self.master.step()
            self.slave.step()

    def close(self) -> None:
        self.master.close()
        self.slave.close()


def test_what_holds_one_side_is_said_on_both_and_recorded(tmp_path: Path) -> None:
    pytest.importorskip("rosbags")
    device = Cabled(Hand())
    pair = Pair(device, record=tmp_path)
    pair.steps(1700)
    assert pair.master.state().gain == 1.0 and pair.master.reason == "" and pair.slave.reason == ""
    device.out = True
    pair.steps(20)
    assert (
        "the cable is out" in pair.master.reason and "master: device: the cable is out" in pair.slave.reason
    )
    reference = pair.slave.end.side.message().position.copy()
    pair.steps(50)
    assert np.allclose(pair.slave.end.side.message().position, reference, atol=1e-4)
    assert pair.master.state().loss == 0.0 and "the cable is out" in str(pair.master.state())
    pair.close()
    both = join(Log.open(tmp_path / "master.mcap"), Log.open(tmp_path / "slave.mcap"))
    assert any(event.text == "slave: master: device: the cable is out" for event in both.events)
    with pytest.raises(InputError, match="not a recording of a master"):
        join(Log.open(tmp_path / "slave.mcap"), Log.open(tmp_path / "slave.mcap"))


def test_a_master_that_points_out_of_reach_is_told_by_the_slave() -> None:
    pair = Pair(HapticDevice(Hand(wish=lambda t: np.array([0.0, 0.0, 0.4 * smooth((t - 1.5) / 2.0)]))))
    pair.steps(4200)
    assert "slave: end of the slave's workspace" in pair.said
    pair.close()


def test_clocks_minutes_apart_hold_both_with_the_reason() -> None:
    pair = Pair(ahead_ns=300 * 10**9)
    pair.steps(400)
    for node in (pair.master, pair.slave):
        assert "the clocks differ by" in node.reason and node.state().refused["clocks"] > 0
        assert not node.state().alive
    assert any("the clocks differ" in text for text in pair.said)
    pair.close()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["slave", "lift"], "run lift"),
        (["slave", "--bind", "here"], "--bind"),
        (["master", "--connect", "x:99999"], "--connect"),
        (["master", "--master", "glove"], "--master"),
        (["master", "--key", "none"], "cannot be read"),
        (["master", "--script", "wal"], "did you mean 'wall'"),
        (["slave", "nowhere"], "scenes are wall, rigid"),
        (["slav"], "did you mean 'slave'"),
        (["run", "wall", "--mass", "2"], "--mass is for the scene lift"),
        (["run", "free", "--arm", "so101", "--motion-scale", "2"], "one to one"),
        (["slave", "--force-scale", "-1"], "--force-scale: expected a number above 0"),
        (["run", "turn", "--torque", "-1"], "--torque: expected 0 N m or more"),
    ],
)
def test_wrong_words_are_one_line(
    arguments: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    make_key("teleop.key")
    assert main(["teleop", *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1


def test_a_key_is_made(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["teleop", "key", str(tmp_path / "k"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"key": str(tmp_path / "k")}
    assert main(["teleop", "key", str(tmp_path / "k")]) == 2
