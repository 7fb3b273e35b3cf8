"""Recording to rosbag2: every message a standard one, on disk while the robot still moves."""

from __future__ import annotations

import heapq
import json
import operator
import re
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt

from palpate.errors import InputError, LogError
from palpate.logs import topics
from palpate.logs.log import WRITABLE, check_names
from palpate.logs.messages import (
    DEFINITIONS,
    DIAGNOSTICS,
    FLOAT64,
    FLOAT64_ARRAY,
    JOINT_STATE,
    STAMP_LIMIT_NS,
    STRING,
    Definition,
    JointStateEncoder,
    encode_array,
    encode_diagnostics,
    encode_number,
    encode_text,
)

if TYPE_CHECKING:
    from os import PathLike

    from palpate.logs.db3 import Db3Writer
    from palpate.logs.log import Log
    from palpate.logs.mcap import McapWriter

#: names of ``palpate::Status`` by value, and the level of each in a DiagnosticStatus: 0 ok, 1 warning, 2 error
STATUS_LEVELS = {
    "ok": 0,
    "warming": 1,
    "held": 1,
    "gap": 1,
    "non_finite": 2,
    "saturated": 1,
    "singular": 1,
    "time_error": 2,
}
_STATUS_NAMES = tuple(STATUS_LEVELS)
_STATUS_REPEAT_NS = 1_000_000_000
_TOPIC = re.compile(r"/[A-Za-z_][A-Za-z0-9_]*(?:/[A-Za-z_][A-Za-z0-9_]*)*")


class Recorder:
    """Writes a recording, message by message, from the first sample on.

    ============================ ======================= ========================================
    topic                        type                    content
    ============================ ======================= ========================================
    ``/joint_states``            sensor_msgs/JointState  position, velocity, effort as received
    ``/model_torque``            sensor_msgs/JointState  effort: the controller's own model [N m]
    ``/joint_commands``          sensor_msgs/JointState  effort as sent
    ``/setpoint``                sensor_msgs/JointState  position, velocity
    ``/palpate/external_torque`` sensor_msgs/JointState  effort [N m]; ``..._std`` beside it
    ``/palpate/payload_mass``    std_msgs/Float64        [kg]; ``..._std`` beside it
    ``/palpate/status``          diagnostic_msgs/        status of every estimate, when one changes
                                 DiagnosticArray         and every second
    ``/palpate/events``          std_msgs/String         JSON: kind, text
    ``/palpate/session``         std_msgs/String         JSON: joint names, meta (card, options, ...)
    ``/palpate/signal/<name>``   Float64(MultiArray)     any other signal
    ============================ ======================= ========================================

    ``header.stamp`` and log time are the time of the measurement; doubles and times are kept bit for bit. A
    velocity that is not measured is an empty array. What was written more than ``flush_s`` ago survives the death
    of the process; a recording that was not closed is read by ``Log.open``, and by ``ros2 bag`` after ``ros2 bag
    reindex``. One thread at a time.

    Args:
        path: ``.mcap`` or ``.db3`` for one file; no suffix for a rosbag2 folder with ``metadata.yaml``.
        joint_names: names of the joints, in the order of the arrays.
        session: text by key, becomes ``Log.meta``: the arm's card, pipeline options, versions, seeds.
        storage: what a folder holds, ``"mcap"`` or ``"sqlite3"``.
        frame_id: ``header.frame_id`` of the joint states, e.g. the arm's base frame.
        flush_s: longest time a message waits in memory while others arrive [s].
        overwrite: replace what is there.

    Raises:
        LogError: the path exists, has another suffix or cannot be written; also later, if the disk is full.
        InputError: arguments of the wrong type or shape.
    """

    def __init__(
        self,
        path: str | PathLike[str],
        joint_names: Sequence[str],
        *,
        session: Mapping[str, str] | None = None,
        storage: Literal["mcap", "sqlite3"] = "mcap",
        frame_id: str = "",
        flush_s: float = 0.5,
        overwrite: bool = False,
    ) -> None:
        self.path = Path(path)
        self.joint_names = check_names(joint_names)
        if not 0.0 <= flush_s < 3600.0:
            raise InputError(f"flush_s must be seconds between 0 and 3600, got {flush_s}")
        self._n = len(self.joint_names)
        self._shape = (self._n,)
        self._flush_s = flush_s
        self._encoder = JointStateEncoder(self.joint_names, frame_id)
        # told with the next message, whose time it takes: a viewer's time line starts with the data
        self._untold: dict[str, Any] = {"meta": _texts(session or {})}
        self._out = _create(self.path, storage, overwrite)
        self._channels: dict[str, tuple[int, str]] = {}
        self._signals: dict[str, dict[str, Any]] = {}
        self._states: dict[str, int] = {}
        self._states_ns = -_STATUS_REPEAT_NS
        self._types: Any = None
        self._last_ns = 0
        self._next_flush = 0.0
        self._open = True
        self._joint_states = self._channel(topics.JOINT_STATES, JOINT_STATE)

    # -- what can be recorded ---------------------------------------------------------------------------

    def sample(
        self,
        time_ns: int,
        position: npt.ArrayLike,
        velocity: npt.ArrayLike | None,
        effort: npt.ArrayLike,
        model_torque: npt.ArrayLike | None = None,
    ) -> None:
        """Record what the driver read; also ``recorder.sample(*sample)`` with a ``Sample``.

        Args:
            time_ns: time of the measurement [ns], from 0 to before the year 2038.
            position: (n,) [rad] or [m].
            velocity: (n,); None if not measured.
            effort: (n,) as received, in the driver's unit.
            model_torque: (n,) [N m]; None if there is none.
        """
        time_ns = self._time(time_ns)
        q, e = self._vector(position, "position"), self._vector(effort, "effort")
        v = b"" if velocity is None else self._vector(velocity, "velocity")
        m = b"" if model_torque is None else self._vector(model_torque, "model_torque")
        self._put(self._joint_states, time_ns, self._encoder.encode(time_ns, q, v, e))
        if m:
            channel = self._channel(topics.MODEL_TORQUE, JOINT_STATE)
            self._put(channel, time_ns, self._encoder.encode(time_ns, b"", b"", m))

    def command(self, time_ns: int, effort: npt.ArrayLike) -> None:
        """Record the effort (n,) that was sent to the drives, in the driver's unit."""
        self._efforts(topics.COMMANDS, self._time(time_ns), effort, "effort")

    def setpoint(
        self, time_ns: int, position: npt.ArrayLike | None = None, velocity: npt.ArrayLike | None = None
    ) -> None:
        """Record where the joints should be, (n,) [rad] or [m], and how fast, (n,) [rad/s] or [m/s]."""
        time_ns = self._time(time_ns)
        if position is None and velocity is None:
            raise InputError("a setpoint needs a position or a velocity")
        p = b"" if position is None else self._vector(position, "position")
        v = b"" if velocity is None else self._vector(velocity, "velocity")
        channel = self._channel(topics.SETPOINT, JOINT_STATE)
        self._put(channel, time_ns, self._encoder.encode(time_ns, p, v, b""))

    def external_torque(self, time_ns: int, torque: npt.ArrayLike, std: npt.ArrayLike | None = None) -> None:
        """Record the external torque (n,) [N m], positive when the environment pushes, and its std (n,) [N m]."""
        time_ns = self._time(time_ns)
        self._efforts(topics.EXTERNAL_TORQUE, time_ns, torque, "torque")
        if std is not None:
            self._efforts(topics.EXTERNAL_TORQUE_STD, time_ns, std, "std")

    def payload(self, time_ns: int, mass: float, std: float | None = None) -> None:
        """Record the estimated payload [kg] and its standard deviation [kg]."""
        time_ns = self._time(time_ns)
        self._number(topics.PAYLOAD_MASS, time_ns, mass, "mass")
        if std is not None:
            self._number(topics.PAYLOAD_MASS_STD, time_ns, std, "std")

    def status(self, time_ns: int, **states: Any) -> None:
        """Record the status of estimates, e.g. ``status(t, external_torque=touch.external.status)``.

        Written when one differs from the last call and at least once per second of recorded time.

        Args:
            time_ns: [ns].
            states: ``palpate.Status``, its name or its number, by the name of the estimate.
        """
        time_ns = self._time(time_ns)
        codes = {name: _status_code(state) for name, state in states.items()}
        merged = self._states | codes
        if merged == self._states and 0 <= time_ns - self._states_ns < _STATUS_REPEAT_NS:
            return
        self._states, self._states_ns = merged, time_ns
        rows = [(name, STATUS_LEVELS[_STATUS_NAMES[c]], _STATUS_NAMES[c], c) for name, c in merged.items()]
        self._put(
            self._channel(topics.STATUS, DIAGNOSTICS), time_ns, encode_diagnostics(time_ns, rows, "palpate")
        )

    def event(self, time_ns: int, kind: str, text: str = "") -> None:
        """Record that something happened: one word for machines, one line for people."""
        body = json.dumps({"kind": str(kind), "text": str(text)})
        self._put(self._channel(topics.EVENTS, STRING), self._time(time_ns), encode_text(body))

    def session(self, texts: Mapping[str, str]) -> None:
        """Add to the text that describes the session; becomes ``Log.meta``."""
        self._announce("meta", _texts(texts))

    def signal(self, name: str, time_ns: int, value: npt.ArrayLike, unit: str = "") -> None:
        """Record a further quantity, a number or a vector (k,) with the same k always; see ``Log.signals``."""
        array = np.asarray(value, dtype="<f8")
        if array.ndim > 1:
            raise InputError(f"value of signal {name!r} must be a number or (k,), got {array.shape}")
        self._signal(name, self._time(time_ns), array.tobytes(), len(array) if array.ndim else None, unit)

    def add(self, topic: str, type: str, time_ns: int, fields: Mapping[str, Any]) -> None:
        """Record any ROS 2 message.

        Args:
            topic: e.g. ``"/wrist/wrench"``.
            type: e.g. ``"geometry_msgs/msg/WrenchStamped"``.
            time_ns: [ns]; also becomes ``header.stamp`` unless ``fields`` says otherwise.
            fields: content, nested as the message is; what is left out is zero or empty.

        Raises:
            InputError: no such type or field, or a value that does not fit.
            MissingExtraError: ``palpate[logs]`` is not installed.
        """
        time_ns = self._time(time_ns)
        if self._types is None:
            from palpate.logs.rosmessages import MessageTypes

            self._types = MessageTypes()
        topic = "/" + topic.removeprefix("/")
        if not _TOPIC.fullmatch(topic):
            raise InputError(f"a topic is made of letters, digits and _ between slashes, got {topic!r}")
        package, _, name = str(type).replace("/msg/", "/").rpartition("/")
        type_name = f"{package}/msg/{name}"
        message = self._types.encode(type_name, time_ns, fields)
        channel = self._channel(topic, type_name, self._types.definition(type_name))
        self._put(channel, time_ns, message)

    # -- life -------------------------------------------------------------------------------------------

    def flush(self) -> None:
        """Hand everything to the operating system now."""
        self._guard(self._out.flush)
        self._next_flush = time.monotonic() + self._flush_s

    def close(self) -> None:
        """Finish the file. Again is harmless."""
        if not self._open:
            return
        if self._untold:
            self._tell()
        self._open = False
        self._guard(self._out.close)
        if self._out.path.parent == self.path:
            self._guard(lambda: (self.path / "metadata.yaml").write_text(_metadata(self._out), "utf-8"))

    def __enter__(self) -> Recorder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # -- inside -----------------------------------------------------------------------------------------

    def _guard(self, action: Callable[[], Any]) -> None:
        try:
            action()
        except OSError as error:
            raise self._failed(error) from error

    def _failed(self, error: OSError) -> LogError:
        self._open = False
        self._out.abandon()
        return LogError(f"{self.path}: cannot be written: {error.strerror or error}")

    def _put(self, channel: int, time_ns: int, data: bytes) -> None:
        if not self._open:
            raise LogError(f"{self.path}: the recording is closed")
        self._last_ns = time_ns
        if self._untold:
            self._tell()
        self._write(channel, time_ns, data)
        if time.monotonic() >= self._next_flush:
            self.flush()

    def _write(self, channel: int, time_ns: int, data: bytes) -> None:
        try:
            self._out.write(channel, time_ns, data)
        except OSError as error:
            raise self._failed(error) from error

    def _channel(self, topic: str, type_name: str, definition: Definition | None = None) -> int:
        known = self._channels.get(topic)
        if known is not None:
            if known[1] != type_name:
                raise InputError(f"topic {topic} carries {known[1]}, not {type_name}")
            return known[0]
        if not self._open:
            raise LogError(f"{self.path}: the recording is closed")
        number = self._out.add_channel(topic, type_name, definition or DEFINITIONS[type_name])
        self._channels[topic] = number, type_name
        return number

    def _announce(self, what: str, more: dict[str, Any]) -> None:
        """Tell the readers, with the next message; they merge all session messages."""
        self._untold.setdefault(what, {}).update(more)

    def _tell(self) -> None:
        head = {"palpate_log": topics.FORMAT, "joint_names": self.joint_names}
        body, self._untold = json.dumps(head | self._untold), {}
        self._write(self._channel(topics.SESSION, STRING), self._last_ns, encode_text(body))

    def _time(self, time_ns: int) -> int:
        try:
            value = operator.index(time_ns)
        except TypeError:
            raise InputError(f"time_ns must be an integer number of nanoseconds, got {time_ns!r}") from None
        if not 0 <= value < STAMP_LIMIT_NS:
            raise InputError(
                f"time_ns must lie in 0 .. 2**31 s, the range of a ROS time stamp, got {value}; "
                "an .npz holds any time"
            )
        return value

    def _vector(self, value: npt.ArrayLike, what: str) -> bytes:
        try:
            array = np.asarray(value, dtype="<f8")
        except (TypeError, ValueError) as error:
            raise InputError(f"{what} must be {self._n} numbers: {error}") from None
        if array.shape != self._shape:
            raise InputError(
                f"{what} must be (n,) = ({self._n},) for the joints recorded here, got {array.shape}"
            )
        return array.tobytes()

    def _efforts(self, topic: str, time_ns: int, value: npt.ArrayLike, what: str) -> None:
        message = self._encoder.encode(time_ns, b"", b"", self._vector(value, what))
        self._put(self._channel(topic, JOINT_STATE), time_ns, message)

    def _number(self, topic: str, time_ns: int, value: float, what: str) -> None:
        array = np.asarray(value, dtype="<f8")
        if array.ndim:
            raise InputError(f"{what} must be one number, got {array.shape}")
        self._put(self._channel(topic, FLOAT64), time_ns, encode_number(array.tobytes()))

    def _signal(self, name: str, time_ns: int, raw: bytes, columns: int | None, unit: str) -> None:
        entry = self._signals.get(name) or self._register(name, columns, unit)
        if entry["columns"] != columns or entry["unit"] != unit:
            raise InputError(
                f"signal {name!r} has {_shape(entry['columns'])} in {entry['unit']!r} so far, "
                f"got {_shape(columns)} in {unit!r}"
            )
        topic: str = entry["topic"]
        if name in topics.JOINT_SIGNALS and topic == topics.JOINT_SIGNALS[name][0]:
            fields = [raw if field == topics.JOINT_SIGNALS[name][1] else b"" for field in _FIELDS]
            self._put(self._channel(topic, JOINT_STATE), time_ns, self._encoder.encode(time_ns, *fields))
        elif columns is None:
            self._put(self._channel(topic, FLOAT64), time_ns, encode_number(raw))
        else:
            self._put(self._channel(topic, FLOAT64_ARRAY), time_ns, encode_array(raw, unit))

    def _register(self, name: str, columns: int | None, unit: str) -> dict[str, Any]:
        """Choose the topic of a signal and tell the readers."""
        if name in topics.JOINT_SIGNALS and columns == self._n:
            topic = topics.JOINT_SIGNALS[name][0]
        elif name in topics.NUMBER_SIGNALS and columns is None:
            topic = topics.NUMBER_SIGNALS[name][0]
        else:
            stem = topic = topics.SIGNALS + (re.sub(r"[^A-Za-z0-9_]", "_", name) or "_")
            taken = {entry["topic"] for entry in self._signals.values()}
            number = 1
            while topic in taken:
                number += 1
                topic = f"{stem}_{number}"
        entry = self._signals[name] = {"topic": topic, "columns": columns, "unit": unit}
        self._announce("signals", {name: entry})
        return entry


_FIELDS = ("position", "velocity", "effort")


def write_log(log: Log, target: Path, *, overwrite: bool = False) -> None:
    """Write a whole log as a recording. See ``Log.save``.

    Raises:
        LogError: see ``Log.save``.
    """
    times = [log.time_ns, *(signal.time_ns for signal in log.signals.values())]
    bounds = [int(t) for array in times if len(array) for t in (array.min(), array.max())]
    bounds += [event.time_ns for event in log.events]
    if bounds and not (min(bounds) >= 0 and max(bounds) < STAMP_LIMIT_NS):
        raise LogError(
            f"{target}: a bag holds times from 0 to 2**31 s, this log has {min(bounds)} .. {max(bounds)} ns; "
            "save it as .npz, or shift its times"
        )
    recorder = Recorder(target, log.joint_names, session=log.meta, flush_s=3599.0, overwrite=overwrite)
    with recorder:
        recorder._announce("repaired", _history(log))
        for name, signal in log.signals.items():
            recorder._register(name, signal.value.shape[1] if signal.value.ndim == 2 else None, signal.unit)
        streams = [_samples(recorder, log), *(_values(recorder, log, name) for name in log.signals)]
        streams.append((event.time_ns, partial(recorder.event, *event)) for event in log.events)
        # in order of time across the streams, and within each stream in the order it has
        for _, write in heapq.merge(*streams, key=lambda item: item[0]):
            write()


def _samples(recorder: Recorder, log: Log) -> Iterator[tuple[int, Callable[[], None]]]:
    size = 8 * log.n
    blocks = [
        b"" if array is None else np.asarray(array, dtype="<f8").tobytes()
        for array in (log.position, log.velocity, log.effort, log.model_torque)
    ]

    def write(time_ns: int, at: int) -> None:
        position, velocity, effort, model = (block[at : at + size] for block in blocks)
        encode = recorder._encoder.encode
        recorder._put(recorder._joint_states, time_ns, encode(time_ns, position, velocity, effort))
        if model:
            channel = recorder._channel(topics.MODEL_TORQUE, JOINT_STATE)
            recorder._put(channel, time_ns, encode(time_ns, b"", b"", model))

    for row, time_ns in enumerate(log.time_ns.tolist()):
        yield time_ns, partial(write, time_ns, row * size)


def _values(recorder: Recorder, log: Log, name: str) -> Iterator[tuple[int, Callable[[], None]]]:
    signal = log.signals[name]
    columns = signal.value.shape[1] if signal.value.ndim == 2 else None
    size = 8 * (1 if columns is None else columns)
    block = np.asarray(signal.value, dtype="<f8").tobytes()
    for row, time_ns in enumerate(signal.time_ns.tolist()):
        raw = block[row * size : (row + 1) * size]
        yield time_ns, partial(recorder._signal, name, time_ns, raw, columns, signal.unit)


def _history(log: Log) -> dict[str, int]:
    """What had been dropped before this log is saved, so that the saved file still tells."""
    earlier = (re.fullmatch(topics.BEFORE, note) for note in log.repair.notes)
    found = {match["reason"]: int(match["count"]) for match in earlier if match}
    for reason, count in log.repair.dropped.items():
        found[reason] = found.get(reason, 0) + count
    return found


def _create(path: Path, storage: str, overwrite: bool) -> McapWriter | Db3Writer:
    from palpate.logs.db3 import Db3Writer
    from palpate.logs.mcap import McapWriter

    kinds = {"mcap": ".mcap", "sqlite3": ".db3"}
    if storage not in kinds:
        raise InputError(f"storage must be mcap or sqlite3, got {storage!r}")
    if path.suffix not in ("", *kinds.values()) or not path.name:
        raise LogError(f"{path}: cannot save a log as {path.suffix!r}; palpate writes {WRITABLE}")
    try:
        file = path
        if not path.suffix:
            if path.exists():
                _clear(path, overwrite)
            path.mkdir(parents=True)
            file = path / f"{path.name}{kinds[storage]}"
        if file.suffix == ".db3":
            return Db3Writer(file, overwrite=overwrite)
        return McapWriter(file, f"palpate {_version()}", overwrite=overwrite)
    except FileExistsError:
        raise LogError(f"{path} exists; pass overwrite=True to replace it") from None
    except OSError as error:
        raise LogError(f"{path}: cannot be written: {error.strerror or error}") from error


def _clear(folder: Path, overwrite: bool) -> None:
    """Remove an old bag, and nothing that is not one."""
    if not overwrite:
        raise FileExistsError
    strange = [
        entry.name
        for entry in (folder.iterdir() if folder.is_dir() else [folder])
        if entry.name != "metadata.yaml"
        and entry.suffix not in (".mcap", ".db3", ".db3-journal", ".db3-wal", ".db3-shm")
    ]
    if strange:
        raise LogError(f"{folder}: not replaced, because it holds {strange[0]!r}, which is no part of a bag")
    shutil.rmtree(folder)


def _version() -> str:
    from importlib.metadata import (
        PackageNotFoundError,
        version,
    )  # takes as long to load as all of this package

    try:
        return version("palpate")
    except PackageNotFoundError:
        return "unknown"


def _metadata(out: McapWriter | Db3Writer) -> str:
    """``metadata.yaml`` of a rosbag2 folder, in version 8: the newest that Humble reads as well."""
    first, last = out.span or (0, 0)
    count = sum(out.counts)
    lines = [
        "rosbag2_bagfile_information:",
        "  version: 8",
        f"  storage_identifier: {out.storage}",
        "  duration:",
        f"    nanoseconds: {last - first}",
        "  starting_time:",
        f"    nanoseconds_since_epoch: {first}",
        f"  message_count: {count}",
        "  topics_with_message_count:",
    ]
    for (topic, type_name, definition), messages in zip(out.topics, out.counts, strict=True):
        lines += [
            "    - topic_metadata:",
            f"        name: {topic}",
            f"        type: {type_name}",
            "        serialization_format: cdr",
            '        offered_qos_profiles: ""',
            f"        type_description_hash: {definition.hash}",
            f"      message_count: {messages}",
        ]
    name = json.dumps(out.path.name)
    lines += [
        '  compression_format: ""',
        '  compression_mode: ""',
        "  relative_file_paths:",
        f"    - {name}",
        "  files:",
        f"    - path: {name}",
        "      starting_time:",
        f"        nanoseconds_since_epoch: {first}",
        "      duration:",
        f"        nanoseconds: {last - first}",
        f"      message_count: {count}",
        "  custom_data: ~",
        "  ros_distro: palpate",
        "",
    ]
    return "\n".join(lines)


def _status_code(state: Any) -> int:
    if isinstance(state, str):
        if state not in STATUS_LEVELS:
            raise InputError(f"a status is one of {', '.join(STATUS_LEVELS)}, got {state!r}")
        return _STATUS_NAMES.index(state)
    try:
        code = int(state)
    except (TypeError, ValueError):
        raise InputError(f"a status is a Status, its name or its number, got {state!r}") from None
    if not 0 <= code < len(_STATUS_NAMES):
        raise InputError(f"a status is a number from 0 to {len(_STATUS_NAMES) - 1}, got {code}")
    return code


def _texts(texts: Mapping[str, str]) -> dict[str, str]:
    for key, text in texts.items():
        if not isinstance(key, str) or not isinstance(text, str):
            raise InputError(f"the session maps text to text, got {key!r}: {type(text).__name__}")
    return dict(texts)


def _shape(columns: int | None) -> str:
    return "one number" if columns is None else f"{columns} numbers"
