"""Logs from rosbag2 recordings: MCAP or SQLite, a file or a folder, palpate's own or anyone's."""

from __future__ import annotations

import json
import re
import tempfile
from array import array
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from palpate.errors import LogError, MissingExtraError
from palpate.logs import topics
from palpate.logs.db3 import Db3Reader
from palpate.logs.log import Event, Log, Signal
from palpate.logs.mcap import Channel, McapReader, Message, decompress, zstd_module
from palpate.logs.messages import (
    DIAGNOSTICS,
    FLOAT32_ARRAY,
    FLOAT64_ARRAY,
    JOINT_STATE,
    NUMBERS,
    STRING,
    CdrError,
    JointStateDecoder,
    decode_array,
    decode_diagnostics,
    decode_numbers,
    decode_text,
)
from palpate.logs.repair import (
    BAD_TIME,
    TIME_LIMIT_NS,
    BoolArray,
    FloatArray,
    IntArray,
    Tally,
    require_rows,
    screen,
    screen_signal,
)
from palpate.logs.table import EXPANSION_FACTOR, EXPANSION_FREE, joint_arrays

_ZSTD = b"\x28\xb5\x2f\xfd"
_MESSAGE_LIMIT = 64 << 20  # [bytes] decompressed; a point cloud of a million points has 32 MB
_OTHER_CLOCK_NS = 1_000_000_000
_FIELDS = ("position", "velocity", "effort")


def read_bag(path: Path, *, joints: Sequence[str] | None, topic: str | None, keep_invalid: bool) -> Log:
    """Read a recording. See ``Log.open``.

    Raises:
        LogError: see ``Log.open``.
        MissingExtraError: see ``Log.open``.
    """
    bag = _Bag(path)
    for message in _messages(path, bag.tally):
        bag.add(message)
    return bag.log(joints, topic, keep_invalid)


def _messages(path: Path, tally: Tally) -> Iterator[Message]:
    """All messages in file order, of all files of a folder."""
    for file in _files(path):
        reader: McapReader | Db3Reader
        with tempfile.TemporaryDirectory() as folder:
            source = file
            if file.suffix.lower() == ".zstd":
                source = Path(folder, file.stem)
                _unpack(file, source)
            reader = Db3Reader(source) if source.suffix.lower() == ".db3" else McapReader(source)
            yield from reader.messages()
        for problem in reader.problems:
            tally.note(f"{file.name}: {problem}")


def _files(path: Path) -> list[Path]:
    if not path.is_dir():
        return [path]
    kinds = (".mcap", ".db3", ".mcap.zstd", ".db3.zstd")
    found = [file for file in path.iterdir() if file.name.lower().endswith(kinds) and file.is_file()]
    if not found:
        raise LogError(f"{path}: a folder without .mcap or .db3 file; expected a rosbag2 recording")
    if len({file.name.lower().removesuffix(".zstd").rpartition(".")[2] for file in found}) > 1:
        raise LogError(f"{path}: holds both .mcap and .db3 files; open one of them")
    # name_2 comes before name_10
    return sorted(
        found, key=lambda file: [int(p) if p.isdigit() else p for p in re.split(r"([0-9]{1,9})", file.name)]
    )


def _unpack(file: Path, target: Path) -> None:
    try:
        zstd = zstd_module()
    except ImportError:
        raise MissingExtraError("logs", f"reading {file}, which is compressed with zstd,") from None
    limit = EXPANSION_FREE + EXPANSION_FACTOR * file.stat().st_size
    total = 0
    try:
        with zstd.open(file, "rb") as packed, target.open("wb") as out:
            while block := packed.read(1 << 20):
                total += len(block)
                if total > limit:
                    raise LogError(
                        f"{file}: expands to more than {limit >> 20} MiB, too much for a log of its size"
                    )
                out.write(block)
    except (zstd.ZstdError, EOFError) as error:
        if total == 0:
            raise LogError(f"{file}: not a readable zstd file: {error}") from None


class _Numbers:
    """Rows of doubles of different lengths, appended one by one; packed, since a recording has millions."""

    def __init__(self) -> None:
        self._data = bytearray()
        self._counts = array("I")

    def add(self, block: bytes) -> None:
        self._data += block
        self._counts.append(len(block) // 8)

    @property
    def counts(self) -> IntArray:
        """(M,) length of every row."""
        return np.array(self._counts, dtype=np.int64)

    def take(self, rows: IntArray, columns: IntArray) -> FloatArray:
        """(R,k) these columns of these rows, which all must have them."""
        starts = np.cumsum(self.counts) - self.counts
        found: FloatArray = np.frombuffer(self._data, dtype="<f8")[starts[rows][:, None] + columns]
        return found


class _Stream:
    """Times and places of messages, in file order."""

    def __init__(self) -> None:
        self._times = array("q")
        self._places = array("q")

    def __len__(self) -> int:
        return len(self._times)

    @property
    def times(self) -> IntArray:
        """(M,) [ns]."""
        return np.array(self._times, dtype=np.int64)

    @property
    def places(self) -> IntArray:
        """(M,) number of the message in the bag."""
        return np.array(self._places, dtype=np.int64)


class _JointTopic(_Stream):
    """The joint states of one topic."""

    def __init__(self) -> None:
        super().__init__()
        self.delays = array("q")  # log time behind stamp [ns]
        self.fields = (_Numbers(), _Numbers(), _Numbers())
        self._decoder = JointStateDecoder()
        self._ids: dict[tuple[str, ...], int] = {}
        self._id = array("I")

    def add(self, message: Message, place: int) -> None:
        state = self._decoder.decode(message.data)
        time_ns = state.time_ns or message.log_time
        self._times.append(time_ns)
        self._places.append(place)
        self.delays.append(message.log_time - time_ns)
        self._id.append(self._ids.setdefault(state.names, len(self._ids)))
        for numbers, block in zip(self.fields, state[2:], strict=True):
            numbers.add(block)

    @property
    def names(self) -> list[tuple[str, ...]]:
        """The different rows of joint names, in order of appearance."""
        return list(self._ids)

    def of(self, names: tuple[str, ...]) -> IntArray:
        """Which messages have exactly these names."""
        return np.flatnonzero(np.array(self._id) == self._ids[names])

    def having(self, joints: tuple[str, ...]) -> IntArray:
        """Which messages have all of these joints."""
        fits = np.array([set(joints) <= set(names) for names in self._ids], dtype=bool)
        return np.flatnonzero(fits[np.array(self._id)])

    def values(self, field: int, rows: IntArray, joints: tuple[str, ...]) -> tuple[FloatArray, BoolArray]:
        """Values (R,n) of the rows, NaN where a message has none, and the mask (R,) of those that have."""
        numbers = self.fields[field]
        there: BoolArray = numbers.counts[rows] > 0
        found = np.full((len(rows), len(joints)), np.nan)
        ids = np.array(self._id)[rows]
        for names, number in self._ids.items():
            members = np.flatnonzero(there & (ids == number))
            if len(members):
                columns = np.array([names.index(joint) for joint in joints], dtype=np.int64)
                found[members] = numbers.take(rows[members], columns)
        return found, there


class _Values(_Stream):
    """The values of one signal."""

    def __init__(self, unit: str, *, stamped: bool, scalar: bool) -> None:
        super().__init__()
        self.unit = unit
        self.stamped = stamped
        self.scalar = scalar
        self.numbers = _Numbers()

    def add(self, time_ns: int, place: int, block: bytes) -> None:
        self._times.append(time_ns)
        self._places.append(place)
        self.numbers.add(block)


class _Bag:
    """Sorts messages by what they are, then makes a log of them."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.tally = Tally()
        self.count = 0
        self.joint_topics: dict[str, _JointTopic] = {}
        self.values: dict[str, _Values] = {}
        self.events: list[Event] = []
        self.session: dict[str, Any] = {"meta": {}, "signals": {}}
        self.unread: Counter[tuple[str, str]] = Counter()

    def add(self, message: Message) -> None:
        """Take in one message."""
        self.count += 1
        channel = message.channel
        if not -TIME_LIMIT_NS < message.log_time < TIME_LIMIT_NS:
            self.tally.add(BAD_TIME, [self.count])
            return
        try:
            if channel.encoding != "cdr" or not self._dispatch(channel, self._plain(message)):
                self.unread[channel.topic, channel.type] += 1
        except CdrError as error:
            self.tally.add(f"unreadable message on {channel.topic}", [self.count])
            if sum(self.tally.counts.values()) == 1:
                self.tally.note(f"message {self.count} on {channel.topic}: {error}")

    def _plain(self, message: Message) -> Message:
        if not message.data.startswith(_ZSTD):
            return message
        try:  # rosbag2's compression mode "message"
            return message._replace(data=decompress(message.data, "zstd", _MESSAGE_LIMIT, str(self.path)))
        except ValueError as error:
            raise CdrError(str(error)) from None

    def _dispatch(self, channel: Channel, message: Message) -> bool:
        """True if the message was of use."""
        topic, kind, data = channel.topic, channel.type, message.data
        if kind == JOINT_STATE:
            self.joint_topics.setdefault(topic, _JointTopic()).add(message, self.count)
        elif kind in NUMBERS:
            layout = NUMBERS[kind]
            stamp, block = decode_numbers(data, layout)
            values = self._values(topic, layout.unit, stamped=layout.stamped, scalar=layout.length == 1)
            values.add(stamp or message.log_time, self.count, block)
        elif kind in (FLOAT64_ARRAY, FLOAT32_ARRAY):
            values = self._values(topic, "", stamped=False, scalar=False)
            values.add(
                message.log_time, self.count, decode_array(data, "d" if kind == FLOAT64_ARRAY else "f")
            )
        elif kind == STRING and topic == topics.EVENTS:
            self.events.append(_event(message.log_time, decode_text(data)))
        elif kind == STRING and topic == topics.SESSION:
            self._merge(decode_text(data))
        elif kind == DIAGNOSTICS and topic == topics.STATUS:
            self._status(message)
        else:
            return False
        return True

    def _values(self, key: str, unit: str, *, stamped: bool, scalar: bool) -> _Values:
        if key not in self.values:
            self.values[key] = _Values(unit, stamped=stamped, scalar=scalar)
        return self.values[key]

    def _status(self, message: Message) -> None:
        time_ns, states = decode_diagnostics(message.data)
        for name, _, _, values in states:
            try:
                code = np.float64(values.get("code", ""))
            except ValueError:
                raise CdrError(f"status {name!r} without a code") from None
            signal = self._values(f"status/{name}", "", stamped=True, scalar=True)
            signal.add(time_ns, self.count, code.astype("<f8").tobytes())

    def _merge(self, text: str) -> None:
        """One of the session messages; together they describe the recording."""
        try:
            found = json.loads(text)
            if found.get("palpate_log", 0) > topics.FORMAT:
                self.tally.note("written by a newer palpate; some of it may not be understood")
            self.session["meta"].update({str(k): str(v) for k, v in found.get("meta", {}).items()})
            for name, entry in found.get("signals", {}).items():
                columns = entry["columns"]
                if columns is not None and not 0 <= int(columns) < 1 << 20:
                    raise ValueError(f"{columns} columns")
                self.session["signals"][str(name)] = {
                    "topic": str(entry["topic"]),
                    "unit": str(entry["unit"]),
                    "columns": None if columns is None else int(columns),
                }
            for reason, count in found.get("repaired", {}).items():
                self.tally.note(f"dropped {int(count)} before it was saved: {reason}")
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
            raise CdrError(f"damaged session text: {error}") from None

    # -- making the log ---------------------------------------------------------------------------------

    def log(self, joints: Sequence[str] | None, topic: str | None, keep_invalid: bool) -> Log:
        main = self._main(topic)
        states = self.joint_topics.pop(main)
        names = self._joints(states, main, joints)
        rows = states.having(names)
        read = len(states)
        self._others(states, names)
        time_ns, places = states.times[rows], states.places[rows]
        fields: dict[str, FloatArray] = {}
        for k, field in enumerate(_FIELDS):
            value, there = states.values(k, rows, names)
            if field == "position" or 2 * np.count_nonzero(there) > len(rows):
                fields[field] = value
            elif there.any():
                self.tally.note(
                    f"{field} is in {np.count_nonzero(there)} of {len(rows)} joint states only: left out"
                )
        fields |= self._model_torque(time_ns, places, names)
        keep = screen(fields, places, self.tally, keep_invalid=keep_invalid)
        require_rows(str(self.path), read, int(np.count_nonzero(keep)), self.tally)
        shift = self._clock_shift(states)
        signals = self._signals(names, shift, keep_invalid)
        for (name, kind), count in self.unread.items():
            self.tally.note(f"not read: {count} messages of {kind or 'unknown type'} on {name}")
        time_ns = time_ns[keep]
        return Log(
            time_ns=time_ns,
            joint_names=names,
            signals=signals,
            events=tuple(self.events),
            meta=self.session["meta"],
            repair=self.tally.report(read, time_ns),
            **joint_arrays({name: value[keep] for name, value in fields.items()}),
        )

    def _main(self, topic: str | None) -> str:
        """The topic with the joint states of the arm."""
        there = [name for name, states in self.joint_topics.items() if len(states)]
        if topic is not None:
            if topic in there:
                return topic
        elif topics.JOINT_STATES in there:
            return topics.JOINT_STATES
        else:
            own = {topics.MODEL_TORQUE, *(t for t, _, _ in topics.JOINT_SIGNALS.values())}
            candidates = [name for name in there if name not in own]
            named = [name for name in candidates if name.endswith(topics.JOINT_STATES)]
            for choice in (candidates, named):
                if len(choice) == 1:
                    return choice[0]
            if candidates:
                choices = ", ".join(candidates)
                raise LogError(f"{self.path}: several topics with joint states; say topic= one of {choices}")
        what = (
            "no joint states (sensor_msgs/msg/JointState)" if topic is None else f"no joint states on {topic}"
        )
        others = sorted({*there, *self.values, *(name for name, _ in self.unread)})
        reasons = [f"{count} x {reason}" for reason, count in self.tally.counts.items()]
        details = "; ".join([f"topics: {', '.join(others[:20]) or 'none'}", *reasons, *self.tally.notes])
        raise LogError(f"{self.path}: {what} among {self.count} messages; {details}")

    def _joints(self, states: _JointTopic, topic: str, joints: Sequence[str] | None) -> tuple[str, ...]:
        if joints is not None:
            wanted = (joints,) if isinstance(joints, str) else tuple(joints)
            if not any(set(wanted) <= set(names) for names in states.names):
                known = "; ".join(", ".join(names) for names in states.names[:4])
                raise LogError(
                    f"{self.path}: no message on {topic} has all of {', '.join(wanted)}; there are: {known}"
                )
            return wanted
        largest = max(len(set(names)) for names in states.names)
        best = [names for names in states.names if len(set(names)) == largest]
        if len({frozenset(names) for names in best}) > 1:
            choices = "; ".join(", ".join(names) for names in best[:4])
            raise LogError(f"{self.path}: several arms on {topic}; say joints=, one of: {choices}")
        chosen = best[0]
        if not chosen or len(set(chosen)) < len(chosen) or not all(chosen) or "\0" in "".join(chosen):
            raise LogError(
                f"{self.path}: joint states on {topic} with the names {chosen}; expected one per joint"
            )
        return chosen

    def _others(self, states: _JointTopic, names: tuple[str, ...]) -> None:
        """Count the joint states that belong to other joints."""
        for others in states.names:
            if not set(names) <= set(others):
                text = ", ".join(others) or "nothing"
                places = states.places[states.of(others)].tolist()
                self.tally.add(f"joint state of {text if len(text) < 80 else text[:77] + '...'}", places)

    def _model_torque(
        self, time_ns: IntArray, places: IntArray, names: tuple[str, ...]
    ) -> dict[str, FloatArray]:
        """The model torques of the rows: each was recorded behind its joint state, with the same stamp."""
        model = self.joint_topics.get(topics.MODEL_TORQUE)
        if model is None or not len(time_ns):
            return {}
        wanted = model.having(names)
        value, there = model.values(2, wanted, names)
        wanted, value = wanted[there], value[there]
        row = np.searchsorted(places, model.places[wanted]) - 1
        fits = (row >= 0) & (time_ns[row] == model.times[wanted])
        if 2 * len(np.unique(row[fits])) <= len(time_ns):
            return {}  # of another rate or clock: stays a signal
        del self.joint_topics[topics.MODEL_TORQUE]
        torque = np.full((len(time_ns), len(names)), np.nan)
        torque[row[fits]] = value[fits]
        if missing := len(time_ns) - len(np.unique(row[fits])):
            self.tally.note(f"{missing} joint states without a model torque")
        return {"model_torque": torque}

    def _clock_shift(self, states: _JointTopic) -> int:
        """What to subtract from log times to get times of the joint states' stamps [ns].

        Zero unless the two clocks differ, as for a simulator's clock recorded by wall clock.
        """
        delay = int(np.median(np.array(states.delays)))
        if not _OTHER_CLOCK_NS <= abs(delay) < TIME_LIMIT_NS // 2:
            return 0
        self.tally.note(
            f"log times are {delay / 1e9:g} s ahead of the stamps of the joint states; "
            "messages without a stamp are shifted by that"
        )
        return delay

    def _signals(self, names: tuple[str, ...], shift: int, keep_invalid: bool) -> dict[str, Signal]:
        declared = {entry["topic"]: (name, entry) for name, entry in self.session["signals"].items()}
        known = {topic: (name, unit) for name, (topic, unit) in topics.NUMBER_SIGNALS.items()}
        signals: dict[str, Signal] = {}

        def add(name: str, times: IntArray, value: FloatArray, places: IntArray, unit: str) -> None:
            if name in self.session["signals"]:
                unit = self.session["signals"][name]["unit"]
            good = np.abs(times) < TIME_LIMIT_NS
            self.tally.add(BAD_TIME, places[~good].tolist())
            if not keep_invalid:
                good &= screen_signal(name, value, places, self.tally)
            signals[name] = Signal(times[good], value[good], unit)

        for topic, states in self.joint_topics.items():
            for name, unit, rows, value in self._joint_signals(topic, states, names):
                add(name, states.times[rows], value, states.places[rows], unit)
        for key, values in self.values.items():
            name, unit = known.get(key, (key.removeprefix("/"), values.unit))
            counts = values.numbers.counts
            columns = None if values.scalar else int(np.bincount(counts).argmax())
            if key in declared:
                name, columns = declared[key][0], declared[key][1]["columns"]
            fits = counts == (1 if columns is None else columns)
            self.tally.add(f"signal {name}: wrong number of values", values.places[~fits].tolist())
            rows = np.flatnonzero(fits)
            value = values.numbers.take(rows, np.arange(1 if columns is None else columns))
            times = values.times[rows] - (0 if values.stamped else shift)
            name = key if name in signals else name
            add(name, times, value[:, 0] if columns is None else value, values.places[rows], unit)
        for name, entry in self.session["signals"].items():
            if name not in signals:
                columns = entry["columns"]
                empty = np.empty((0,) if columns is None else (0, columns))
                signals[name] = Signal(np.empty(0, dtype=np.int64), empty, entry["unit"])
        return signals

    def _joint_signals(
        self, topic: str, states: _JointTopic, names: tuple[str, ...]
    ) -> Iterator[tuple[str, str, IntArray, FloatArray]]:
        """Name, unit, messages (R,) and values (R,k) of every field of a further JointState topic."""
        if not len(states):
            return
        rows = states.having(names)
        if not len(rows):
            names = max(states.names, key=lambda names: len(states.of(names)))
            if not names or len(set(names)) < len(names):
                self.unread[topic, JOINT_STATE] += len(states)
                return
            rows = states.having(names)
        if others := len(states) - len(rows):
            self.tally.note(f"not read: {others} messages of other joints on {topic}")
        own = {(t, field): (name, unit) for name, (t, field, unit) in topics.JOINT_SIGNALS.items()}
        for k, field in enumerate(_FIELDS):
            value, there = states.values(k, rows, names)
            if there.any():
                name, unit = own.get((topic, field), (f"{topic.removeprefix('/')}/{field}", ""))
                yield name, unit, rows[there], value[there]


def _event(time_ns: int, text: str) -> Event:
    try:
        found = json.loads(text)
        return Event(time_ns, str(found["kind"]), str(found["text"]))
    except (ValueError, TypeError, KeyError, RecursionError):
        return Event(time_ns, "text", text)
