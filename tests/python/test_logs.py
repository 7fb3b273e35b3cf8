"""The log itself: what it accepts, how it is cut, when two are equal."""

from __future__ import annotations

import copy
import pickle
import subprocess
import sys

import numpy as np
import pytest

from palpate.errors import InputError, LogError
from palpate.logs import Clock, Event, Log, RepairReport, Sample, Signal


def make(rows: int = 10, n: int = 3, **changes: object) -> Log:
    time_ns = 1_000_000_000 + 1_000_000 * np.arange(rows)
    values = np.arange(rows * n, dtype=float).reshape(rows, n)
    arrays = {
        "time_ns": time_ns,
        "position": values,
        "velocity": values + 0.25,
        "effort": values + 0.5,
        "model_torque": values + 0.75,
        "joint_names": tuple(f"joint_{i + 1}" for i in range(n)),
        "signals": {
            "force": Signal(1_000_000_000 + 500_000 * np.arange(2 * rows), np.arange(2.0 * rows), "N"),
            "wrench": Signal(time_ns, np.ones((rows, 6)), "N, N m"),
        },
        "events": (
            Event(999_999_999, "start"),
            Event(1_004_000_000, "grasp", "closed"),
            Event(2_000_000_000, "end"),
        ),
        "meta": {"effort_unit": "A"},
    }
    return Log(**(arrays | changes))


def test_a_log_is_immutable():
    position = np.zeros((10, 3))
    log = make(position=position)
    position[0, 0] = 1.0
    assert log.position[0, 0] == 0.0
    for array in (
        log.time_ns,
        log.position,
        log.velocity,
        log.effort,
        log.model_torque,
        log.signals["force"].value,
    ):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1
    with pytest.raises(AttributeError):
        log.position = position
    with pytest.raises(TypeError):
        log.meta["a"] = "b"
    with pytest.raises(TypeError):
        log.signals["a"] = log.signals["force"]


def test_iteration_and_index_give_the_drivers_samples():
    log = make()
    samples = list(log)
    assert len(samples) == len(log) == 10
    for k, sample in enumerate(samples):
        assert isinstance(sample, Sample)
        assert sample.time_ns == log.time_ns[k]
        assert isinstance(sample.time_ns, int)
        for name in ("position", "velocity", "effort", "model_torque"):
            np.testing.assert_array_equal(getattr(sample, name), getattr(log, name)[k])
            np.testing.assert_array_equal(getattr(log[k], name), getattr(log, name)[k])
    assert log[-1].time_ns == samples[-1].time_ns
    bare = make(velocity=None, model_torque=None)
    assert bare[0].velocity is None
    assert next(iter(bare)).model_torque is None
    with pytest.raises(IndexError, match="sample 10 of a log with 10"):
        log[10]
    with pytest.raises(InputError, match=r"between\(start, stop\)"):
        log["a"]  # type: ignore[call-overload]


def test_parts_by_rows_are_views_and_add_up():
    log = make()
    head, tail = log[:4], log[4:]
    assert len(head) == 4
    assert np.shares_memory(head.position, log.position)
    for name in ("time_ns", "position", "velocity", "effort", "model_torque"):
        np.testing.assert_array_equal(
            np.concatenate((getattr(head, name), getattr(tail, name))), getattr(log, name)
        )
    # every value of a signal and every event lies in exactly one part, whatever its own rate
    assert [len(part.signals["force"]) for part in (head, tail)] == [8, 12]
    assert [event.kind for event in head.events] == ["start"]
    assert [event.kind for event in tail.events] == ["grasp", "end"]
    assert log[:] == log
    assert len(log[::3]) == 4
    assert len(log[7:3]) == 0
    assert len(log[20:]) == 0
    assert len(log[20:].signals["force"]) == 0
    assert head.repair is log.repair
    with pytest.raises(InputError, match="backwards"):
        log[::-1]


def test_parts_by_time():
    log = make()
    part = log.between(0.002, 0.005)
    np.testing.assert_array_equal(part.time_ns, log.time_ns[2:5])
    assert len(part.signals["force"]) == 6
    assert [event.kind for event in part.events] == ["grasp"]
    assert len(log.between(0.005)) == 5
    assert len(log.between(-1e300, 1e300)) == len(log.between(float("-inf"))) == 10
    assert len(log.between(5.0)) == 0
    with pytest.raises(InputError, match="seconds"):
        log.between(float("nan"))
    # a clock that runs backwards: rows are chosen by time and stay in their order
    shuffled = make(rows=4, time_ns=np.array([5, 1, 9, 3]), signals={}, events=())
    np.testing.assert_array_equal(shuffled.between(-4e-9, 1e-9).time_ns, [5, 1, 3])


def test_joints_by_name():
    log = make()
    picked = log.select(("joint_3", "joint_1"))
    assert picked.joint_names == ("joint_3", "joint_1")
    np.testing.assert_array_equal(picked.effort, log.effort[:, [2, 0]])
    with pytest.raises(LogError, match="no joint 'elbow'; it has joint_1, joint_2, joint_3"):
        log.select(("elbow",))


def test_equality_is_bit_for_bit():
    log = make()
    assert log == make()
    assert log != make(meta={})
    assert log != make(velocity=None)
    assert log != "a log"
    zero = np.zeros((10, 3))
    assert make(position=zero) != make(position=-zero)
    holes = np.full((10, 3), np.nan)
    assert make(effort=holes) == make(effort=holes.copy())
    assert make(effort=holes) != make(effort=np.full((10, 3), -np.nan))
    assert Signal(np.array([1]), np.array([np.nan]), "N") == Signal(np.array([1]), np.array([np.nan]), "N")
    assert Signal(np.array([1]), np.array([1.0])) != Signal(np.array([1]), np.array([[1.0]]))
    with pytest.raises(TypeError, match="unhashable"):
        hash(log)


def test_copies_and_pickles():
    log = make()
    for copied in (copy.deepcopy(log), pickle.loads(pickle.dumps(log))):
        assert copied == log
        assert copied.repair == log.repair
        assert not copied.position.flags.writeable


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"time_ns": np.arange(10) * 0.1},
            "time_ns must be .N,. integer nanoseconds, got shape .10,. of float64",
        ),
        ({"time_ns": np.full(10, 2**62)}, "within"),
        (
            {"position": np.zeros((10, 2))},
            r"position must be .N,n. = \(10, 3\) for 10 times and 3 joints, got",
        ),
        ({"velocity": np.zeros(10)}, "velocity must be"),
        ({"effort": None}, "effort must be"),
        ({"effort": [["a"] * 3] * 10}, "effort must be numbers"),
        ({"joint_names": ("a", "a", "b")}, "each once"),
        ({"joint_names": ("a", "", "b")}, "non-empty"),
        ({"joint_names": ("a", "b\0", "c")}, "non-empty"),
        ({"joint_names": ("a", "b\ud800", "c")}, "non-empty"),
        ({"joint_names": ()}, "at least one"),
        ({"signals": {"force": np.zeros(3)}}, "signals must map names to Signal"),
        ({"meta": {"a": 1}}, "meta must map text to text"),
        ({"events": ((2**62, "late"),)}, "time_ns of an event"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(changes, message):
    with pytest.raises(InputError, match=message):
        make(**changes)


def test_signals_that_do_not_fit_are_refused():
    with pytest.raises(InputError, match="M = 2 times, got"):
        Signal(np.array([1, 2]), np.zeros(3))
    with pytest.raises(InputError, match="M = 1 times, got"):
        Signal(np.array([1]), np.zeros((1, 1, 1)))


def test_what_is_there_and_what_is_missing():
    log = make()
    assert log.n == 3
    assert log.duration == pytest.approx(0.009)
    assert log.rate == pytest.approx(1000.0)
    np.testing.assert_allclose(log.seconds, np.arange(10) * 1e-3)
    assert log.has_effort
    assert repr(log) == (
        "Log(10 samples, 0.009 s, 1000 Hz, 3 joints, position, velocity, effort [A], model torque, 2 signals)"
    )
    assert "joint_1, joint_2, joint_3" in log.summary()
    assert "signal wrench: Signal(10 x 6 [N, N m])" in log.summary()
    assert "3 events: end, grasp, start" in log.summary()
    bare = make(velocity=None, model_torque=None, effort=np.full((10, 3), np.nan))
    assert not bare.has_effort
    assert "no velocity, no effort, no model torque" in repr(bare)
    assert "missing: velocity, effort, model torque" in bare.summary()
    empty = log[:0]
    assert len(empty) == empty.duration == empty.rate == 0
    assert len(empty.seconds) == 0
    assert len(empty.between(0.0)) == 0
    assert "0 samples" in repr(empty)


def test_the_clock_is_judged_and_not_mended():
    time_ns = np.array([0, 10, 20, 20, 15, 25, 35, 135, 145]) * 1_000_000
    log = make(rows=9, time_ns=time_ns)
    np.testing.assert_array_equal(log.time_ns, time_ns)
    clock = log.repair.clock
    assert clock == Clock(
        median_ns=10_000_000, min_ns=-5_000_000, max_ns=100_000_000, gaps=1, repeated=1, backwards=1
    )
    assert str(clock) == "spacing 10 ms (min -5, max 100), 1 gaps, 1 repeated times, 1 steps backwards"
    assert not log.repair.clean
    assert make().repair.clean
    assert Clock.of(np.array([5])) == Clock()


def test_a_report_reads_well():
    report = RepairReport(12, {"bad": 2}, {"bad": (3, 7)}, notes=("the file was cut",))
    assert str(report).splitlines()[:2] == ["12 rows read", "dropped 2: bad (first at 3, 7)"]
    assert str(report).endswith("the file was cut")


def test_paths_that_cannot_be_opened(tmp_path):
    with pytest.raises(LogError, match="no such file"):
        Log.open(tmp_path / "nothing.csv")
    with pytest.raises(LogError, match="without .mcap or .db3"):
        Log.open(tmp_path)
    strange = tmp_path / "log.bag"
    strange.write_bytes(b"#ROSBAG V2.0")
    with pytest.raises(LogError, match=r"unknown kind of log '.bag'; palpate reads .mcap"):
        Log.open(strange)
    for name in ("a.csv", "a.npz", "a.mcap", "a.db3", "a.csv.gz"):
        (tmp_path / name).touch()
        with pytest.raises(LogError, match=rf"a.{name[2:]}: "):
            Log.open(tmp_path / name)
    if sys.platform == "linux":
        with pytest.raises(LogError, match="neither a file nor a folder"):
            Log.open("/dev/null")


def test_logs_need_numpy_alone():
    program = (
        "import sys, palpate.logs; "
        "print(sorted({'rosbags', 'lz4', 'backports', 'zstandard', 'yaml', 'scipy'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
