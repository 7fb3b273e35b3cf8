"""Logs from anyone's rosbag2 recordings: written here by rosbags and by mcap, read by palpate."""

from __future__ import annotations

import itertools
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from palpate.errors import LogError, MissingExtraError
from palpate.logs import Log, messages
from palpate.logs.mcap import McapReader

rosbags = pytest.importorskip("rosbags.rosbag2", reason="needs palpate[logs]")
typesys = pytest.importorskip("rosbags.typesys", reason="palpate[logs] is not installed")

STORE = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
NAMES = ("shoulder", "elbow")
JOINT_STATE = "sensor_msgs/msg/JointState"


def stamp(time_ns: int) -> object:
    types = STORE.types
    time = types["builtin_interfaces/msg/Time"](sec=time_ns // 10**9, nanosec=time_ns % 10**9)
    return types["std_msgs/msg/Header"](stamp=time, frame_id="base")


def joints(time_ns: int, names=NAMES, position=(), velocity=(), effort=()) -> object:
    arrays = [np.array(a, dtype=float) for a in (position, velocity, effort)]
    return STORE.types[JOINT_STATE](stamp(time_ns), list(names), *arrays)


def number(value: float) -> object:
    return STORE.types["std_msgs/msg/Float64"](value)


def bag(
    path: Path, records: list[tuple], plugin: str = "MCAP", compression: str | None = None, **options
) -> Path:
    """Write (topic, log time, message or bytes) with rosbags."""
    writer = rosbags.Writer(path, version=9, storage_plugin=rosbags.StoragePlugin[plugin])
    if compression:
        writer.set_compression(rosbags.CompressionMode[compression], rosbags.CompressionFormat.ZSTD)
    connections = {}
    with writer:
        for topic, time_ns, message in records:
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=STORE)
            writer.write(connections[topic], time_ns, STORE.serialize_cdr(message, kind, **options))
    return path


def states(count: int = 20, **changes) -> list[tuple]:
    records = []
    for k in range(count):
        fields = {"position": (k, -k), "velocity": (0.5, 0.25), "effort": (k / 8, np.pi)} | changes
        records.append(("/joint_states", 10**9 + k * 10**6 + 300, joints(10**9 + k * 10**6, **fields)))
    return records


# -- what is where ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("plugin", "compression"),
    [*itertools.product(("MCAP", "SQLITE3"), (None, "FILE", "MESSAGE")), ("MCAP", "STORAGE")],
)
def test_every_storage_and_compression(tmp_path, plugin, compression):
    path = bag(tmp_path / "bag", states(), plugin, compression)
    log = Log.open(path)
    assert log.joint_names == NAMES
    np.testing.assert_array_equal(log.time_ns, 10**9 + np.arange(20) * 10**6)  # the stamps, not the log times
    np.testing.assert_array_equal(log.position, [[k, -k] for k in range(20)])
    np.testing.assert_array_equal(log.effort, [[k / 8, np.pi] for k in range(20)])
    assert log.repair.clean
    if compression != "FILE":
        file = path / f"bag.{'mcap' if plugin == 'MCAP' else 'db3'}"
        assert Log.open(file) == log


def test_lz4_chunks_and_files_by_the_mcap_library(tmp_path):
    writer = pytest.importorskip(
        "mcap_ros2.writer",
        reason="palpate[test] is not installed",
    )
    from mcap.writer import CompressionType

    for compression in CompressionType:
        with (tmp_path / f"{compression.name}.mcap").open("wb") as file:
            out = writer.Writer(file, compression=compression, chunk_size=1000)
            schema = out.register_msgdef(JOINT_STATE, messages.DEFINITIONS[JOINT_STATE].text)
            for k in range(50):
                header = {"stamp": {"sec": k, "nanosec": 5}, "frame_id": ""}
                content = {"header": header, "name": ["a"], "position": [k], "velocity": [], "effort": [0.1]}
                out.write_message("/arm/joint_states", schema, content, log_time=k * 10**9, publish_time=0)
            out.finish()
        log = Log.open(tmp_path / f"{compression.name}.mcap")
        np.testing.assert_array_equal(log.time_ns, np.arange(50) * 10**9 + 5)
        assert log.velocity is None
        assert log.repair.clean


def test_big_endian_messages(tmp_path):
    records = [*states(5), ("/mass", 10**9, number(2.5)), ("/mass", 10**9 + 1, number(-0.0))]
    log = Log.open(bag(tmp_path / "little", records))
    assert Log.open(bag(tmp_path / "big", records, little_endian=False)) == log
    np.testing.assert_array_equal(log.signals["mass"].value, [2.5, 0.0])


def test_joints_are_mapped_by_name(tmp_path):
    records = states(6)
    for k in (1, 3, 4):
        swapped = joints(
            10**9 + k * 10**6,
            names=NAMES[::-1],
            position=(-k, k),
            velocity=(0.25, 0.5),
            effort=(np.pi, k / 8),
        )
        records[k] = (*records[k][:2], swapped)
    assert Log.open(bag(tmp_path / "mixed", records)) == Log.open(bag(tmp_path / "plain", states(6)))


def test_several_publishers_on_one_topic(tmp_path):
    records = []
    for k, record in enumerate(states(10)):
        records.append(record)
        gripper = joints(10**9 + k * 10**6 + 7, names=("finger",), position=(k / 100,))
        records.append(("/joint_states", record[1] + 10, gripper))
    path = bag(tmp_path / "bag", records)
    log = Log.open(path)
    assert log.joint_names == NAMES
    assert len(log) == 10
    assert log.repair.rows_read == 20
    assert log.repair.dropped == {"joint state of finger": 10}
    assert log.repair.lines["joint state of finger"] == (2, 4, 6, 8, 10)
    finger = Log.open(path, joints=["finger"])
    assert len(finger) == 10
    assert not finger.has_effort
    np.testing.assert_array_equal(Log.open(path, joints=["elbow"]).position[:, 0], -np.arange(10.0))
    with pytest.raises(
        LogError, match="no message on /joint_states has all of wrist; there are: shoulder, elbow; finger"
    ):
        Log.open(path, joints=["wrist"])


def test_two_arms_of_equal_size_must_be_told_apart(tmp_path):
    other = [("/joint_states", t, joints(t, names=("c", "d"), position=(0, 0))) for t in (1, 2)]
    path = bag(tmp_path / "bag", states(2) + other)
    with pytest.raises(LogError, match="several arms on /joint_states; say joints=, one of: "):
        Log.open(path)
    assert len(Log.open(path, joints=("d", "c"))) == 2


def test_the_topic_of_the_joint_states(tmp_path):
    left = [("/left/joint_states", t, m) for _, t, m in states(3)]
    right = [("/right/joint_states", t, m) for _, t, m in states(4)]
    assert len(Log.open(bag(tmp_path / "one", left))) == 3
    path = bag(tmp_path / "two", left + right)
    with pytest.raises(LogError, match="say topic= one of /left/joint_states, /right/joint_states"):
        Log.open(path)
    log = Log.open(path, topic="/right/joint_states")
    assert len(log) == 4
    assert log.signals["left/joint_states/position"].value.shape == (3, 2)
    with pytest.raises(LogError, match="no joint states on /arm among 7 messages; topics: /left"):
        Log.open(path, topic="/arm")
    with pytest.raises(
        LogError, match=r"no joint states .sensor_msgs/msg/JointState. among 1 messages; topics: /mass"
    ):
        Log.open(bag(tmp_path / "none", [("/mass", 5, number(1.0))]))
    with pytest.raises(LogError, match="columns are for tables"):
        Log.open(path, columns=SimpleNamespace())  # type: ignore[arg-type]


@pytest.mark.parametrize("missing", ["velocity", "effort"])
def test_missing_arrays(tmp_path, missing):
    log = Log.open(bag(tmp_path / "all", states(**{missing: ()})))
    assert len(log) == 20
    assert (log.velocity is None) == (missing == "velocity")
    assert log.has_effort == (missing == "velocity")
    # a publisher without it beside one with it: its rows are invalid, or the quantity is given up
    some = states(20)
    some[3:6] = states(20, **{missing: ()})[3:6]
    log = Log.open(bag(tmp_path / "most", some))
    assert log.repair.dropped == {"NaN or infinite value": 3}
    assert len(Log.open(tmp_path / "most", keep_invalid=True)) == 20
    some[3:15] = states(20, **{missing: ()})[3:15]
    log = Log.open(bag(tmp_path / "few", some))
    assert len(log) == 20
    assert log.repair.notes == (f"{missing} is in 8 of 20 joint states only: left out",)


def test_order_and_time(tmp_path):
    times = [5, 3, 3, 9]
    records = [("/joint_states", 100 - t, joints(t * 10**9, position=(t, k))) for k, t in enumerate(times)]
    log = Log.open(bag(tmp_path / "bag", records, "SQLITE3"))
    np.testing.assert_array_equal(log.time_ns, np.array(times) * 10**9)
    np.testing.assert_array_equal(log.position[:, 1], range(4))  # as written, though log times say otherwise
    assert (log.repair.clock.backwards, log.repair.clock.repeated) == (1, 1)
    # without a stamp, the log time
    records = [("/joint_states", 7 * 10**9 + k, joints(0, position=(0, k))) for k in range(3)]
    np.testing.assert_array_equal(Log.open(bag(tmp_path / "bare", records)).time_ns, 7 * 10**9 + np.arange(3))


def test_other_messages_become_signals(tmp_path):
    types = STORE.types
    vector = types["geometry_msgs/msg/Vector3"]
    wrench = types["geometry_msgs/msg/Wrench"](vector(1.0, 2.0, 3.0), vector(4.0, 5.0, 6.0))
    stamped = types["geometry_msgs/msg/WrenchStamped"](stamp(2 * 10**9), wrench)
    layout = types["std_msgs/msg/MultiArrayLayout"]([types["std_msgs/msg/MultiArrayDimension"]("x", 2, 2)], 0)
    records = [
        *states(3),
        ("/ft", 10**9, stamped),
        ("/raw", 10**9 + 1, wrench),
        ("/count", 10**9 + 2, types["std_msgs/msg/Int16"](-7)),
        (
            "/few",
            10**9 + 3,
            types["std_msgs/msg/Float32MultiArray"](layout, np.array([0.5, 1.5], dtype=np.float32)),
        ),
        ("/many", 10**9 + 4, types["std_msgs/msg/Float64MultiArray"](layout, np.array([0.5, np.nan]))),
        ("/name", 10**9 + 5, types["std_msgs/msg/String"]("hello")),
        ("/setpoint", 10**9 + 6, joints(10**9, names=NAMES[::-1], position=(1.0, 2.0))),
        ("/gripper", 10**9 + 7, joints(10**9, names=("finger",), effort=(3.0,))),
    ]
    log = Log.open(bag(tmp_path / "bag", records))
    np.testing.assert_array_equal(log.signals["ft"].value, [[1, 2, 3, 4, 5, 6]])
    assert log.signals["ft"].unit == "N, N m"
    assert log.signals["ft"].time_ns[0] == 2 * 10**9  # its stamp
    assert log.signals["raw"].time_ns[0] == 10**9 + 1
    np.testing.assert_array_equal(log.signals["count"].value, [-7.0])
    np.testing.assert_array_equal(log.signals["few"].value, [[0.5, 1.5]])
    assert log.repair.dropped == {"signal many: NaN, infinite or beyond 1e9": 1}
    np.testing.assert_array_equal(log.signals["setpoint_position"].value, [[2.0, 1.0]])
    np.testing.assert_array_equal(log.signals["gripper/effort"].value, [[3.0]])
    assert "not read: 1 messages of std_msgs/msg/String on /name" in log.repair.notes


def test_a_simulators_clock_recorded_by_wall_clock(tmp_path):
    wall = 1_700_000_000 * 10**9
    records = [
        ("/joint_states", wall + k * 10**6 + k, joints(k * 10**6, position=(k, k))) for k in range(1, 6)
    ]
    records += [("/mass", wall + 3 * 10**6, number(1.0))]
    log = Log.open(bag(tmp_path / "bag", records))
    assert abs(int(log.signals["mass"].time_ns[0]) - 3 * 10**6) < 10
    assert any("ahead of the stamps" in note for note in log.repair.notes)


def test_a_model_torque_of_another_rate_stays_a_signal(tmp_path):
    records = []
    for k, record in enumerate(states(20)):
        records.append(record)
        if k % 4 == 0:
            records.append(("/model_torque", record[1], joints(10**9 + k * 10**6, effort=(k, k))))
    log = Log.open(bag(tmp_path / "slow", records))
    assert log.model_torque is None
    assert log.signals["model_torque/effort"].value.shape == (5, 2)
    records = [
        r
        for k, r in enumerate(records)
        if r[0] == "/joint_states"
        for r in (r, ("/model_torque", r[1], r[2]))
    ]
    del records[9]
    log = Log.open(bag(tmp_path / "same", records), keep_invalid=True)
    assert np.isnan(log.model_torque[4]).all()
    np.testing.assert_array_equal(log.model_torque[5:], log.effort[5:])
    assert "1 joint states without a model torque" in log.repair.notes


def test_split_recordings_are_read_in_order(tmp_path):
    whole = Log.open(bag(tmp_path / "whole", states(24)))
    (tmp_path / "split").mkdir()
    for part in range(12):
        bag(tmp_path / f"p{part}", states(24)[2 * part : 2 * part + 2])
        (tmp_path / f"p{part}" / f"p{part}.mcap").rename(tmp_path / "split" / f"run_{part}.mcap")
    assert Log.open(tmp_path / "split") == whole
    (tmp_path / "split" / "run_12.db3").write_bytes(b"")
    with pytest.raises(LogError, match="both .mcap and .db3"):
        Log.open(tmp_path / "split")


# -- damage -----------------------------------------------------------------------------------------------------------


def sizable(tmp_path: Path) -> bytes:
    """A recording of 6000 states in several chunks."""
    k = np.arange(6000.0)
    q = np.stack((k, -k), axis=1)
    log = Log(time_ns=np.arange(6000) * 10**6, position=q, velocity=q, effort=q, joint_names=NAMES)
    log.save(tmp_path / "chunks.mcap")
    return (tmp_path / "chunks.mcap").read_bytes()


def test_a_cut_file_is_read_up_to_the_cut(tmp_path):
    data = sizable(tmp_path)
    path = tmp_path / "cut.mcap"
    lengths = []
    for share in (0.3, 0.6, 0.9):
        path.write_bytes(data[: int(len(data) * share)])
        log = Log.open(path)
        np.testing.assert_array_equal(log.position[:, 0], np.arange(len(log)))
        assert len(log) == pytest.approx(6000 * share, abs=250)
        notes = " ".join(log.repair.notes)
        assert "the recording was interrupted or the file cut" in notes
        assert "messages could be read" in notes
        lengths.append(len(log))
    assert lengths == sorted(lengths)
    for end in (8, 20, 60):
        path.write_bytes(data[:end])
        with pytest.raises(LogError, match="no joint states .* among 0 messages; .*interrupted"):
            Log.open(path)
    path.write_bytes(data[:5])
    with pytest.raises(LogError, match="not an MCAP file"):
        Log.open(path)


def test_a_damaged_chunk_is_left_out_and_counted(tmp_path):
    data = bytearray(sizable(tmp_path))
    data[len(data) // 2] ^= 4
    path = tmp_path / "flipped.mcap"
    path.write_bytes(data)
    log = Log.open(path)
    assert 3000 < len(log) < 6000
    assert log.position[-1, 0] == 5999  # what follows the damage is there
    notes = " ".join(log.repair.notes)
    assert "checksum is wrong" in notes
    assert "of 6001 messages could be read" in notes


def test_a_damaged_length_does_not_lose_the_chunks_behind_it(tmp_path):
    data = bytearray(sizable(tmp_path))
    reader = McapReader(tmp_path / "chunks.mcap")
    assert sum(1 for _ in reader.messages()) == 6001
    second = reader._chunk_starts[1]
    data[second + 6] ^= 0x40  # a chunk of 2**46 bytes
    path = tmp_path / "length.mcap"
    path.write_bytes(data)
    log = Log.open(path)
    assert log.position[0, 0] == 0
    assert log.position[-1, 0] == 5999
    assert 3000 < len(log) < 6000


def test_a_cut_compressed_chunk_gives_its_whole_messages(tmp_path):
    path = bag(tmp_path / "bag", states(2000), compression="STORAGE") / "bag.mcap"
    data = path.read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: 2 * data.index(b"zstd") + 20_000])
    log = Log.open(tmp_path / "cut.mcap")
    np.testing.assert_array_equal(log.position[:, 0], np.arange(len(log)))
    assert 100 < len(log) < 2000


def test_unreadable_messages_are_counted(tmp_path):
    good = STORE.serialize_cdr(states(1)[0][2], JOINT_STATE)
    broken = [
        good[:20],  # cut
        b"\x00\x07" + bytes(good[2:]),  # another encoding
        bytes(good[:8]) + b"\xff\xff\xff\xff" + bytes(good[12:]),  # 4e9 nanoseconds
        b"",
    ]
    with rosbags.Writer(tmp_path / "bag", version=9, storage_plugin=rosbags.StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/joint_states", JOINT_STATE, typestore=STORE)
        for k, data in enumerate([good, *broken, good]):
            writer.write(connection, k, bytes(data))
    log = Log.open(tmp_path / "bag")
    assert len(log) == 2
    assert log.repair.dropped == {"unreadable message on /joint_states": 4}
    assert log.repair.lines["unreadable message on /joint_states"] == (2, 3, 4, 5)


def test_wrong_databases(tmp_path):
    path = tmp_path / "a.db3"
    path.write_bytes(b"SQLite format 3\0" + bytes(84))
    with pytest.raises(LogError, match="not a readable rosbag2 database|no rosbag2 database"):
        Log.open(path)
    path.write_bytes(b"text")
    with pytest.raises(LogError, match="not a readable rosbag2 database"):
        Log.open(path)


def test_compression_without_its_extra(tmp_path, monkeypatch):
    path = bag(tmp_path / "bag", states(3), compression="STORAGE")
    plain = bag(tmp_path / "plain", states(3))
    for name in (
        "backports",
        "backports.zstd",
        "compression",
        "compression.zstd",
        "rosbags",
        "lz4",
        "lz4.frame",
    ):
        monkeypatch.setitem(sys.modules, name, None)
    assert len(Log.open(plain)) == 3
    with pytest.raises(MissingExtraError, match=r'compressed with zstd, needs `pip install "palpate.logs."`'):
        Log.open(path)


# -- bytes ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", messages.DEFINITIONS)
def test_definitions_are_those_of_ros(kind):
    for store in (typesys.Stores.ROS2_HUMBLE, typesys.Stores.ROS2_JAZZY, typesys.Stores.LATEST):
        types = typesys.get_typestore(store)
        assert messages.DEFINITIONS[kind].text == types.generate_msgdef(kind, ros_version=2)[0]
        assert messages.DEFINITIONS[kind].hash == types.hash_rihs01(kind)


@pytest.mark.parametrize(
    "names", [["a"], ["abcd", "e"], [f"joint_{k}" for k in range(7)], ["Ellbogen-Gelenk-Ü"]]
)
@pytest.mark.parametrize("frame", ["", "base", "base_link"])
def test_joint_states_are_encoded_like_ros(names, frame):
    rng = np.random.default_rng(0)
    encoder = messages.JointStateEncoder(names, frame)
    decoder = messages.JointStateDecoder()
    for mask in range(8):
        arrays = [rng.standard_normal(len(names)) if mask >> k & 1 else np.empty(0) for k in range(3)]
        header = stamp(1_700_000_000_123_456_789)
        header.frame_id = frame
        expected = STORE.types[JOINT_STATE](header, names, *arrays)
        raw = encoder.encode(1_700_000_000_123_456_789, *(a.tobytes() for a in arrays))
        assert raw == bytes(STORE.serialize_cdr(expected, JOINT_STATE, little_endian=True))
        for data in (raw, bytes(STORE.serialize_cdr(expected, JOINT_STATE, little_endian=False))):
            state = decoder.decode(data)
            assert state == (1_700_000_000_123_456_789, tuple(names), *(a.tobytes() for a in arrays))


def test_diagnostics_texts_and_arrays_are_encoded_like_ros():
    rows = [("payload", 0, "ok", 0), ("touch", 2, "non_finite", 4), ("ü", 1, "", 7)]
    raw = messages.encode_diagnostics(5_000_000_007, rows, "palpate")
    message = STORE.deserialize_cdr(raw, messages.DIAGNOSTICS)
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (5, 7)
    assert [(s.name, s.level, s.message, int(s.values[0].value)) for s in message.status] == rows
    assert bytes(STORE.serialize_cdr(message, messages.DIAGNOSTICS)) == raw
    assert messages.decode_diagnostics(raw)[1] == [(a, b, c, {"code": str(d)}) for a, b, c, d in rows]
    for count in (0, 1, 5):
        values = np.arange(count, dtype=float)
        raw = messages.encode_array(values.tobytes(), "N m")
        message = STORE.deserialize_cdr(raw, messages.FLOAT64_ARRAY)
        np.testing.assert_array_equal(message.data, values)
        assert message.layout.dim[0].label == "N m"
        assert bytes(STORE.serialize_cdr(message, messages.FLOAT64_ARRAY)) == raw
        assert messages.decode_array(raw, "d") == values.tobytes()
    raw = messages.encode_text("grüß Gott")
    assert STORE.deserialize_cdr(raw, messages.STRING).data == messages.decode_text(raw) == "grüß Gott"


@pytest.mark.parametrize("kind", messages.NUMBERS)
def test_plain_numbers_are_decoded_like_ros(kind):
    layout = messages.NUMBERS[kind]
    header = (
        bytes.fromhex("00010000" + "05000000" + "07000000" + "04000000") + b"tip\0"
        if layout.stamped
        else b"\0\1\0\0"
    )
    body = np.arange(1, layout.length + 1).astype(np.dtype(layout.code) if layout.code != "?" else bool)
    padding = b"" if not layout.stamped else bytes(-(len(header) - 4) % body.itemsize)
    raw = header + padding + body.tobytes()
    message = STORE.deserialize_cdr(raw, kind)
    assert bytes(STORE.serialize_cdr(message, kind)) == raw
    time_ns, values = messages.decode_numbers(raw, layout)
    assert time_ns == (5_000_000_007 if layout.stamped else None)
    np.testing.assert_array_equal(np.frombuffer(values), body.astype(float))
