"""Recording: bit for bit, readable by others, on disk when the process dies."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from palpate.errors import InputError, LogError, MissingExtraError
from palpate.logs import Event, Log, Recorder, Signal, topics
from palpate.logs.recorder import STATUS_LEVELS

KINDS = ("run.mcap", "run.db3", "run", "run.npz")
NAMES = ("a", "b", "c")


def ramp(k: int, scale: float = 1.0) -> np.ndarray:
    return np.array([k, -k, k * np.pi]) * scale


def record(path: Path, count: int = 50, **options) -> None:
    with Recorder(path, NAMES, session={"card": "name: x"}, **options) as recorder:
        for k in range(count):
            t = 10**9 + k * 10**6
            recorder.sample(t, ramp(k), ramp(k, 0.5), ramp(k, 0.25), ramp(k, 0.125))
            recorder.command(t, ramp(k, 2.0))
            recorder.setpoint(t, ramp(k, 3.0), ramp(k, 4.0))
            recorder.external_torque(t, ramp(k, 5.0), ramp(k, 6.0))
            recorder.payload(t, 0.25 * k, 0.01)
            recorder.status(t, payload="warming" if k < 10 else "ok", touch=0)
            recorder.signal("truth/force z", t, -2.5 * k, "N")
            recorder.signal("pose", t, ramp(k), "m")
            if k == 20:
                recorder.event(t, "grasp", "closed: 3 mm")
                recorder.session({"seed": "7"})


# -- what is recorded is what is read ---------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["run.mcap", "run.db3", "run"])
@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_everything_comes_back(tmp_path, kind, storage):
    record(tmp_path / kind, storage=storage)
    log = Log.open(tmp_path / kind)
    assert log.repair.clean
    assert log.joint_names == NAMES
    expected = np.array([ramp(k) for k in range(50)])
    np.testing.assert_array_equal(log.time_ns, 10**9 + np.arange(50) * 10**6)
    for factor, array in (
        (1.0, log.position),
        (0.5, log.velocity),
        (0.25, log.effort),
        (0.125, log.model_torque),
        (2.0, log.signals["command"].value),
        (3.0, log.signals["setpoint_position"].value),
        (4.0, log.signals["setpoint_velocity"].value),
        (5.0, log.signals["external_torque"].value),
        (6.0, log.signals["external_torque_std"].value),
        (1.0, log.signals["pose"].value),
    ):
        np.testing.assert_array_equal(array, np.array([ramp(k, factor) for k in range(50)]))
        assert array.shape == expected.shape
    np.testing.assert_array_equal(log.signals["payload_mass"].value, 0.25 * np.arange(50))
    assert log.signals["payload_mass_std"].unit == "kg"
    np.testing.assert_array_equal(log.signals["truth/force z"].value, -2.5 * np.arange(50))
    assert log.signals["truth/force z"].unit == "N"
    # a status is written when one changes
    np.testing.assert_array_equal(log.signals["status/payload"].value, [1, 0])
    np.testing.assert_array_equal(log.signals["status/payload"].time_ns, 10**9 + np.array([0, 10]) * 10**6)
    assert log.events == (Event(1_020_000_000, "grasp", "closed: 3 mm"),)
    assert dict(log.meta) == {"card": "name: x", "seed": "7"}
    log.save(tmp_path / "again.mcap")
    assert Log.open(tmp_path / "again.mcap") == log


def test_status_is_repeated_every_second_and_takes_names_numbers_and_enums(tmp_path):
    class Status(int):
        pass

    with Recorder(tmp_path / "run.mcap", NAMES) as recorder:
        for k in range(35):
            t = k * 10**8
            recorder.sample(t, ramp(k), None, ramp(k))
            recorder.status(t, a=Status(3), b="ok")
        with pytest.raises(InputError, match="one of ok, warming, held, .* got 'fine'"):
            recorder.status(t, a="fine")
        with pytest.raises(InputError, match="from 0 to 7, got 8"):
            recorder.status(t, a=8)
        with pytest.raises(InputError, match="its name or its number, got None"):
            recorder.status(t, a=None)
    log = Log.open(tmp_path / "run.mcap")
    np.testing.assert_array_equal(log.signals["status/a"].time_ns, np.arange(4) * 10**9)
    np.testing.assert_array_equal(log.signals["status/a"].value, [3] * 4)


def test_status_names_are_the_cores():
    header = Path(__file__).parents[2] / "core" / "include" / "palpate" / "status.hpp"
    text = header.read_text()
    for code, name in enumerate(STATUS_LEVELS):
        assert f"  {name} = {code}," in text
    assert f"= {len(STATUS_LEVELS)}," not in text


def test_the_first_sample_is_on_disk_at_once(tmp_path):
    for name in ("run.mcap", "run.db3"):
        recorder = Recorder(tmp_path / name, NAMES, flush_s=3000.0)
        recorder.sample(5, ramp(1), None, ramp(2))
        recorder.sample(6, ramp(1), None, ramp(2))
        assert len(Log.open(tmp_path / name)) == 1
        recorder.flush()
        assert len(Log.open(tmp_path / name)) == 2
        recorder.close()
        recorder.close()
        with pytest.raises(LogError, match="the recording is closed"):
            recorder.sample(7, ramp(1), None, ramp(2))
        with pytest.raises(LogError, match="the recording is closed"):
            recorder.event(7, "late")


def test_a_recording_ends_well_when_the_program_does_not(tmp_path):
    with pytest.raises(ZeroDivisionError), Recorder(tmp_path / "run", NAMES) as recorder:
        recorder.sample(5, ramp(1), None, ramp(2))
        raise ZeroDivisionError
    assert Log.open(tmp_path / "run").repair.clean


def test_an_empty_recording_says_so(tmp_path):
    Recorder(tmp_path / "run.mcap", NAMES).close()
    with pytest.raises(LogError, match="no joint states"):
        Log.open(tmp_path / "run.mcap")


# -- refusals ---------------------------------------------------------------------------------------------------------


def test_wrong_arguments(tmp_path):
    for names in ("", (), ("a", "a"), ("a", "")):
        with pytest.raises(InputError):
            Recorder(tmp_path / "x.mcap", names)
    with pytest.raises(InputError, match="flush_s"):
        Recorder(tmp_path / "x.mcap", NAMES, flush_s=-1)
    with pytest.raises(InputError, match="mcap or sqlite3"):
        Recorder(tmp_path / "x", NAMES, storage="bag")  # type: ignore[arg-type]
    with pytest.raises(LogError, match="cannot save a log as '.csv'; palpate writes .mcap"):
        Recorder(tmp_path / "x.csv", NAMES)
    with pytest.raises(LogError, match="cannot be written"):
        Recorder(tmp_path / "no" / "x.mcap", NAMES)
    assert not list(tmp_path.iterdir())
    with Recorder(tmp_path / "run.mcap", NAMES) as recorder:
        with pytest.raises(InputError, match=r"position must be .n,. = .3,. .* got .2,."):
            recorder.sample(1, [1, 2], None, [1, 2, 3])
        with pytest.raises(InputError, match="effort must be 3 numbers"):
            recorder.sample(1, [1, 2, 3], None, ["x"] * 3)
        for bad in (-1, 2**31 * 10**9):
            with pytest.raises(InputError, match="time_ns must lie in 0 .. 2..31 s"):
                recorder.sample(bad, [1, 2, 3], None, [1, 2, 3])
        with pytest.raises(InputError, match="integer number of nanoseconds, got 0.5"):
            recorder.command(0.5, [1, 2, 3])  # type: ignore[arg-type]
        with pytest.raises(InputError, match="a position or a velocity"):
            recorder.setpoint(1)
        with pytest.raises(InputError, match="mass must be one number"):
            recorder.payload(1, [1.0])  # type: ignore[arg-type]
        with pytest.raises(InputError, match="text to text"):
            recorder.session({"a": 1})  # type: ignore[dict-item]
        recorder.signal("f", 1, [1.0, 2.0], "N")
        with pytest.raises(InputError, match="'f' has 2 numbers in 'N' so far, got one number in 'N'"):
            recorder.signal("f", 1, 1.0, "N")
        with pytest.raises(InputError, match="a number or .k,."):
            recorder.signal("g", 1, [[1.0]])


def test_nothing_is_overwritten_unasked(tmp_path):
    log = Log(time_ns=[1], position=[[1.0]], effort=[[2.0]], joint_names=("a",))
    for kind in KINDS:
        path = tmp_path / kind
        log.save(path)
        with pytest.raises(LogError, match="exists; pass overwrite=True"):
            log.save(path)
        log.save(path, overwrite=True)
        assert Log.open(path) == log
    (tmp_path / "run" / "thesis.tex").write_text("all of it")
    with pytest.raises(LogError, match="it holds 'thesis.tex', which is no part of a bag"):
        log.save(tmp_path / "run", overwrite=True)
    assert (tmp_path / "run" / "thesis.tex").exists()
    with pytest.raises(LogError, match="cannot save a log as '.csv'"):
        log.save(tmp_path / "log.csv")
    early = Log(time_ns=[-1], position=[[1.0]], effort=[[2.0]], joint_names=("a",))
    with pytest.raises(
        LogError, match="holds times from 0 to 2..31 s, this log has -1 .. -1 ns; save it as .npz"
    ):
        early.save(tmp_path / "early.mcap")
    assert not (tmp_path / "early.mcap").exists()
    early.save(tmp_path / "early.npz")
    assert Log.open(tmp_path / "early.npz") == early


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_is_reported(tmp_path):
    (tmp_path / "run.mcap").symlink_to("/dev/full")
    with pytest.raises(LogError, match="cannot be written: No space left on device"):
        record(tmp_path / "run.mcap", overwrite=True)


def test_repairs_are_remembered_by_the_saved_file(tmp_path):
    (tmp_path / "log.csv").write_text("time_ns,position_1,effort_1\n1,1,1\n2,x,1\n3,nan,1\n4,1,1\n")
    log = Log.open(tmp_path / "log.csv")
    log.save(tmp_path / "once.mcap")
    once = Log.open(tmp_path / "once.mcap")
    once.save(tmp_path / "twice.db3")
    twice = Log.open(tmp_path / "twice.db3")
    for log in (once, twice):
        assert sorted(log.repair.notes) == [
            "dropped 1 before it was saved: NaN or infinite value",
            "dropped 1 before it was saved: cell that is not a number",
        ]


# -- bit for bit ------------------------------------------------------------------------------------------------------

SPECIAL = [0.0, -0.0, np.nan, np.inf, -np.inf, 5e-324, -2.2e-308, 1e300, 1.7976931348623157e308, 0.1]
BITS = st.one_of(
    st.sampled_from(SPECIAL).map(lambda x: int(np.float64(x).view(np.uint64))), st.integers(0, 2**64 - 1)
)
TIMES = st.integers(0, 2**31 * 10**9 - 1)
TEXT = st.text(max_size=8)
NAME = st.text(st.characters(blacklist_characters="\0", blacklist_categories=("Cs",)), min_size=1, max_size=6)


def doubles(draw, *shape: int) -> np.ndarray:
    count = int(np.prod(shape))
    return (
        np.array(draw(st.lists(BITS, min_size=count, max_size=count)), dtype=np.uint64)
        .view(float)
        .reshape(shape)
    )


def times(draw, count: int) -> np.ndarray:
    return np.array(draw(st.lists(TIMES, min_size=count, max_size=count)), dtype=np.int64)


@st.composite
def logs(draw) -> Log:
    names = tuple(draw(st.lists(NAME, min_size=1, max_size=3, unique=True)))
    rows, n = draw(st.integers(1, 5)), len(names)
    signals = {}
    known = [*topics.JOINT_SIGNALS, *topics.NUMBER_SIGNALS]
    for name in draw(st.lists(st.one_of(TEXT, st.sampled_from(known)), max_size=3, unique=True)):
        count = draw(st.integers(0, 4))
        shape = draw(st.sampled_from([(count,), (count, 0), (count, 1), (count, n), (count, 6)]))
        signals[name] = Signal(times(draw, count), doubles(draw, *shape), draw(TEXT))
    return Log(
        time_ns=times(draw, rows),
        position=doubles(draw, rows, n),
        velocity=doubles(draw, rows, n) if draw(st.booleans()) else None,
        effort=doubles(draw, rows, n),
        model_torque=doubles(draw, rows, n) if draw(st.booleans()) else None,
        joint_names=names,
        signals=signals,
        events=tuple(Event(*e) for e in draw(st.lists(st.tuples(TIMES, TEXT, TEXT), max_size=3))),
        meta=draw(st.dictionaries(TEXT, TEXT, max_size=2)),
    )


@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=150, deadline=None)
@given(log=logs())
def test_saved_and_opened_is_the_same_bit_for_bit(kind, log):
    with tempfile.TemporaryDirectory() as folder:
        log.save(Path(folder, kind))
        found = Log.open(Path(folder, kind), keep_invalid=True)
    in_order = sorted(log.events, key=lambda event: event.time_ns)
    assert found.joint_names == log.joint_names
    for name in ("time_ns", "position", "velocity", "effort", "model_torque"):
        a, b = getattr(found, name), getattr(log, name)
        assert (a is None) == (b is None), name
        assert a is None or (a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()), name
    assert dict(found.signals) == dict(log.signals)
    assert sorted(found.events, key=lambda event: event.time_ns) == in_order
    assert dict(found.meta) == dict(log.meta)
    assert found == log


# -- read by others ---------------------------------------------------------------------------------------------------


def test_mcap_library_reads_every_message(tmp_path):
    reader = pytest.importorskip(
        "mcap.reader",
        reason="palpate[test] is not installed",
    )
    decoder = pytest.importorskip(
        "mcap_ros2.decoder",
        reason="palpate[test] is not installed",
    )
    record(tmp_path / "run.mcap", flush_s=0.0)
    with (tmp_path / "run.mcap").open("rb") as file:
        bag = reader.make_reader(file, validate_crcs=True, decoder_factories=[decoder.DecoderFactory()])
        assert bag.get_header().profile == "ros2"
        summary = bag.get_summary()
        found = [
            (c.topic, m.log_time, m.publish_time, s.name, ros) for s, c, m, ros in bag.iter_decoded_messages()
        ]
    assert summary.statistics.message_count == len(found)
    assert summary.statistics.message_start_time == 10**9
    assert summary.statistics.message_end_time == 10**9 + 49 * 10**6
    states = [(t, p, ros) for topic, t, p, _, ros in found if topic == "/joint_states"]
    assert len(states) == 50
    for k, (log_time, publish_time, ros) in enumerate(states):
        stamp = ros.header.stamp.sec * 10**9 + ros.header.stamp.nanosec
        assert log_time == publish_time == stamp == 10**9 + k * 10**6
        assert tuple(ros.name) == NAMES
        assert np.array(ros.position).tobytes() == ramp(k).tobytes()
        assert np.array(ros.velocity).tobytes() == ramp(k, 0.5).tobytes()
    kinds = {topic: kind for topic, _, _, kind, _ in found}
    assert set(kinds.values()) == {
        "sensor_msgs/msg/JointState",
        "std_msgs/msg/Float64",
        "std_msgs/msg/Float64MultiArray",
        "std_msgs/msg/String",
        "diagnostic_msgs/msg/DiagnosticArray",
    }
    status = [ros for topic, *_, ros in found if topic == topics.STATUS]
    assert [(s.name, s.level, s.message) for s in status[0].status] == [
        ("payload", 1, "warming"),
        ("touch", 0, "ok"),
    ]
    # the indices lead to the same messages as the walk
    with (tmp_path / "run.mcap").open("rb") as file:
        bag = reader.SeekingReader(file, validate_crcs=True)
        some = list(bag.iter_messages(topics=["/joint_commands"], reverse=True))
    assert [m.log_time for _, _, m in some] == [10**9 + k * 10**6 for k in range(49, -1, -1)]


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_rosbags_reads_every_message(tmp_path, storage):
    highlevel = pytest.importorskip("rosbags.highlevel", reason="needs palpate[logs]")
    record(tmp_path / "run", storage=storage)
    assert (tmp_path / "run" / "metadata.yaml").is_file()
    with highlevel.AnyReader([tmp_path / "run"]) as bag:
        assert bag.message_count == sum(1 for _ in bag.messages())
        assert (bag.start_time, bag.end_time) == (10**9, 10**9 + 49 * 10**6 + 1)
        wanted = [c for c in bag.connections if c.topic == "/joint_states"]
        assert wanted[0].msgcount == 50
        found = [(t, bag.deserialize(raw, c.msgtype)) for c, t, raw in bag.messages(connections=wanted)]
        for connection, _, raw in bag.messages():
            bag.deserialize(raw, connection.msgtype)
    for k, (log_time, ros) in enumerate(found):
        assert log_time == ros.header.stamp.sec * 10**9 + ros.header.stamp.nanosec == 10**9 + k * 10**6
        assert ros.effort.tobytes() == ramp(k, 0.25).tobytes()


# -- any message ------------------------------------------------------------------------------------------------------


def test_any_message_can_be_recorded(tmp_path):
    pytest.importorskip("rosbags.typesys", reason="needs palpate[logs]")
    with Recorder(tmp_path / "run.mcap", NAMES) as recorder:
        recorder.sample(10**9, ramp(1), None, ramp(1))
        recorder.add(
            "/wrist/wrench", "geometry_msgs/msg/WrenchStamped", 10**9, {"wrench": {"force": {"z": -9.81}}}
        )
        recorder.add("wrist/imu", "sensor_msgs/Imu", 10**9, {"orientation_covariance": range(9)})
        recorder.add(
            "/plan", "trajectory_msgs/msg/JointTrajectory", 10**9, {"points": [{"positions": [1, 2]}, {}]}
        )
        recorder.add(
            "/image",
            "sensor_msgs/msg/Image",
            10**9,
            {"data": b"\1\2", "encoding": "mono8", "is_bigendian": True},
        )
        for topic, kind, fields, message in (
            (
                "/a",
                "geometry_msgs/msg/Wrenches",
                {},
                "no message type .*; close to it: geometry_msgs/msg/Wrench",
            ),
            ("/a", "std_msgs/msg/Float64", {"value": 1}, "Float64 has no field 'value'; it has data"),
            ("/a", "std_msgs/msg/Float64", {"data": "x"}, "Float64.data: could not convert"),
            ("/a", "std_msgs/msg/Int8", {"data": 300}, "Int8"),
            ("/a", "sensor_msgs/msg/Imu", {"orientation_covariance": [1, 2]}, "expected 9 values, got 2"),
            ("/a", "std_msgs/msg/Header", {"stamp": 5}, "stamp must be a mapping of its fields, got int"),
            (
                "/wrist/imu",
                "std_msgs/msg/Float64",
                {},
                "topic /wrist/imu carries sensor_msgs/msg/Imu, not std_msgs",
            ),
            ("/1a", "std_msgs/msg/Float64", {}, "a topic is made of letters"),
        ):
            with pytest.raises(InputError, match=message):
                recorder.add(topic, kind, 1, fields)
    log = Log.open(tmp_path / "run.mcap")
    wrench = log.signals["wrist/wrench"]
    np.testing.assert_array_equal(wrench.value, [[0, 0, -9.81, 0, 0, 0]])
    assert wrench.time_ns[0] == 10**9  # the stamp was filled in
    highlevel = pytest.importorskip("rosbags.highlevel", reason="palpate[logs] is not installed")
    with highlevel.AnyReader([tmp_path / "run.mcap"]) as bag:
        found = {c.topic: bag.deserialize(raw, c.msgtype) for c, _, raw in bag.messages()}
    np.testing.assert_array_equal(found["/wrist/imu"].orientation_covariance, np.arange(9))
    assert len(found["/plan"].points) == 2
    assert found["/image"].encoding == "mono8"


def test_any_message_needs_its_extra(tmp_path, monkeypatch):
    for name in ("rosbags", "rosbags.interfaces", "rosbags.serde", "rosbags.typesys"):
        monkeypatch.setitem(sys.modules, name, None)
    with Recorder(tmp_path / "run.mcap", NAMES) as recorder:
        recorder.sample(1, ramp(1), None, ramp(1))
        with pytest.raises(MissingExtraError, match=r"palpate\[logs\]"):
            recorder.add("/a", "std_msgs/msg/Float64", 1, {})
    assert len(Log.open(tmp_path / "run.mcap")) == 1


# -- death -----------------------------------------------------------------------------------------------------------


CHILD = """
import sys
import numpy as np
from palpate.logs import Recorder

recorder = Recorder(sys.argv[1], ("a", "b"), storage=sys.argv[2], flush_s=0.05)
k = 0
while True:
    recorder.sample(k * 10**6, [k, -k], None, [k * 0.1, np.nan])
    recorder.payload(k * 10**6, k / 3)
    k += 1
    if k % 1000 == 0:
        recorder.flush()
        print(k, flush=True)
"""


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
@pytest.mark.parametrize("after", [1, 7, 20])
def test_a_killed_recorder_leaves_a_readable_file(tmp_path, storage, after):
    path = tmp_path / "run"
    child = subprocess.Popen(
        [sys.executable, "-c", CHILD, str(path), storage], stdout=subprocess.PIPE, text=True, env=os.environ
    )
    try:
        promised = [int(child.stdout.readline()) for _ in range(after)][-1]
        time.sleep(0.011 * after)
    finally:
        child.send_signal(signal.SIGKILL)
        child.wait()
        child.stdout.close()
    assert not (path / "metadata.yaml").exists()
    log = Log.open(path, keep_invalid=True)
    count = len(log)
    assert count >= promised
    np.testing.assert_array_equal(log.time_ns, np.arange(count) * 10**6)
    np.testing.assert_array_equal(log.position[:, 1], -np.arange(float(count)))
    np.testing.assert_array_equal(log.effort[:, 0], np.arange(count) * 0.1)
    assert np.isnan(log.effort[:, 1]).all()
    assert len(log.signals["payload_mass"]) >= promised
    # saved again, it is whole
    log.save(tmp_path / "whole.mcap")
    again = Log.open(tmp_path / "whole.mcap", keep_invalid=True)
    assert again == log
    assert not any("interrupted" in note for note in again.repair.notes)


def test_a_hot_journal_is_played_back_on_a_copy(tmp_path):
    record(tmp_path / "run.db3")
    whole = Log.open(tmp_path / "run.db3")
    program = (
        "import sqlite3, sys, os; d = sqlite3.connect(sys.argv[1], isolation_level=None); "
        "d.execute('PRAGMA cache_size = 1'); d.execute('BEGIN'); "
        "d.executemany('INSERT INTO messages VALUES (NULL, 1, 5, ?)', [(b'x' * 4000,)] * 500); os._exit(9)"
    )
    subprocess.run([sys.executable, "-c", program, str(tmp_path / "run.db3")], check=False)
    journal = tmp_path / "run.db3-journal"
    assert journal.stat().st_size > 0
    before = (tmp_path / "run.db3").read_bytes()
    log = Log.open(tmp_path / "run.db3")
    assert log == whole
    assert any("interrupted" in note for note in log.repair.notes)
    assert (tmp_path / "run.db3").read_bytes() == before
    shutil.rmtree(tmp_path)
