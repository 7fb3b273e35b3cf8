"""The log of a robot arm: what the driver read, sample by sample, and what else was recorded beside it."""

from __future__ import annotations

import operator
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from os import PathLike
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple, overload

import numpy as np

from palpate.errors import InputError, LogError
from palpate.logs.repair import TIME_LIMIT_NS, Clock, FloatArray, IntArray, RepairReport

if TYPE_CHECKING:
    from palpate.logs.columns import ColumnMap

_TABLE_SUFFIXES = (".csv", ".tsv", ".txt")
READABLE = ".mcap, .db3, a rosbag2 folder, .csv, .tsv, .txt (each also .gz), .npz"
WRITABLE = ".mcap, .db3, .npz, or no suffix for a rosbag2 folder"


class Sample(NamedTuple):
    """One reading of the driver.

    Attributes:
        time_ns: time of the measurement on the driver's clock [ns].
        position: (n,) [rad] or [m].
        velocity: (n,) [rad/s] or [m/s]; None if the driver does not measure it.
        effort: (n,) in the driver's unit ([N m] or [A]); NaN where none was read.
        model_torque: (n,) torque of the controller's own model of the bare arm [N m]; None if there is none.
    """

    time_ns: int
    position: FloatArray
    velocity: FloatArray | None
    effort: FloatArray
    model_torque: FloatArray | None = None


class Event(NamedTuple):
    """Something that happened at one moment: a grasp, an operator's mark, a stop.

    Attributes:
        time_ns: when [ns].
        kind: one word for machines, e.g. ``"grasp"``.
        text: one line for people.
    """

    time_ns: int
    kind: str
    text: str = ""


def _same(a: FloatArray | IntArray | None, b: FloatArray | IntArray | None) -> bool:
    """Bit for bit, so that NaN equals itself and -0.0 differs from 0.0."""
    if a is None or b is None:
        return a is b
    return a.shape == b.shape and bool(np.array_equal(a.view(np.int64), b.view(np.int64)))


def _times(value: Any, what: str) -> IntArray:
    array = np.asarray(value)
    if array.ndim != 1 or (array.dtype.kind not in "iu" and array.size):
        raise InputError(
            f"{what} must be (N,) integer nanoseconds, got shape {array.shape} of {array.dtype}; "
            "convert seconds with numpy.rint(t * 1e9).astype(numpy.int64)"
        )
    if array.size and (int(array.max()) >= TIME_LIMIT_NS or int(array.min()) <= -TIME_LIMIT_NS):
        raise InputError(f"{what} must lie within +-2**62 ns, got {int(array.min())} .. {int(array.max())}")
    found: IntArray = _frozen(array, np.int64)
    return found


def _floats(value: Any, what: str) -> FloatArray:
    try:
        array = np.asarray(value)
        if array.dtype.kind not in "fiub":
            array = array.astype(np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{what} must be numbers, got {type(value).__name__}: {error}") from None
    found: FloatArray = _frozen(array, np.float64)
    return found


def _frozen(array: Any, dtype: Any) -> Any:
    """A read-only array of ``dtype``; arrays that are read-only already are shared, others copied."""
    if array.dtype == dtype and not array.flags.writeable:
        return array
    array = np.array(array, dtype=dtype, order="C")
    array.setflags(write=False)
    return array


@dataclass(frozen=True, slots=True, eq=False)
class Signal:
    """A recorded quantity with a clock of its own: a force sensor, a setpoint, the truth of a simulation.

    Attributes:
        time_ns: (M,) [ns].
        value: (M,) or (M,k), in ``unit``.
        unit: as it was declared; ``""`` if nobody said.
    """

    time_ns: IntArray
    value: FloatArray
    unit: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "time_ns", _times(self.time_ns, "time_ns of a signal"))
        object.__setattr__(self, "value", _floats(self.value, "value of a signal"))
        if self.value.ndim not in (1, 2) or len(self.value) != len(self.time_ns):
            raise InputError(
                f"value of a signal must be (M,) or (M,k) with M = {len(self.time_ns)} times, "
                f"got {self.value.shape}"
            )

    def __len__(self) -> int:
        return len(self.time_ns)

    def __eq__(self, other: object) -> bool:
        """Equal bit for bit."""
        if not isinstance(other, Signal):
            return NotImplemented
        return (
            self.unit == other.unit and _same(self.time_ns, other.time_ns) and _same(self.value, other.value)
        )

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        shape = " x ".join(map(str, self.value.shape))
        return f"Signal({shape}" + (f" [{self.unit}])" if self.unit else ")")


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Log:
    """What a driver read over time, in the order it was read. Immutable; its arrays are read-only.

    Time stamps are the driver's and are kept as they came: repeated or backward times are counted in
    ``repair.clock`` and never sorted away.

    Attributes:
        time_ns: (N,) int64 time of each measurement [ns].
        position: (N,n) [rad] or [m].
        effort: (N,n) in the driver's unit, declared by ``Arm.effort``; NaN in every row if none was recorded.
        joint_names: n names, in the order of the columns.
        velocity: (N,n) [rad/s] or [m/s]; None if not measured.
        model_torque: (N,n) [N m] torque of the controller's own model of the bare arm; None if not recorded.
        signals: other quantities by name, each with its own times.
        events: what happened, in the order it was recorded.
        meta: text by key: the arm's card, options, versions, ``"effort_unit"``, ...
        repair: what the reader found wrong with the file; a part of a log keeps the report of the whole.

    Raises:
        InputError: arrays that do not fit each other.
    """

    time_ns: IntArray
    position: FloatArray
    effort: FloatArray
    joint_names: tuple[str, ...]
    velocity: FloatArray | None = None
    model_torque: FloatArray | None = None
    signals: Mapping[str, Signal] = field(default_factory=dict)
    events: tuple[Event, ...] = ()
    meta: Mapping[str, str] = field(default_factory=dict)
    repair: RepairReport = None  # type: ignore[assignment]  # None is replaced by a clean report

    def __post_init__(self) -> None:
        names = check_names(self.joint_names)
        set_ = object.__setattr__
        set_(self, "joint_names", names)
        set_(self, "time_ns", _times(self.time_ns, "time_ns"))
        shape = (len(self.time_ns), len(names))
        for what in ("position", "effort", "velocity", "model_torque"):
            value = getattr(self, what)
            if value is None and what in ("velocity", "model_torque"):
                continue
            array = _floats(value, what)
            if array.shape != shape:
                raise InputError(
                    f"{what} must be (N,n) = {shape} for {shape[0]} times and {shape[1]} joints, "
                    f"got {array.shape}"
                )
            set_(self, what, array)
        for name, signal in self.signals.items():
            if not isinstance(name, str) or not isinstance(signal, Signal):
                raise InputError(f"signals must map names to Signal, got {name!r}: {type(signal).__name__}")
        for key, text in self.meta.items():
            if not isinstance(key, str) or not isinstance(text, str):
                raise InputError(f"meta must map text to text, got {key!r}: {type(text).__name__}")
        set_(self, "signals", MappingProxyType(dict(self.signals)))
        set_(self, "events", tuple(_event(*e) for e in self.events))
        set_(self, "meta", MappingProxyType(dict(self.meta)))
        if self.repair is None:
            set_(self, "repair", RepairReport(len(self.time_ns), clock=Clock.of(self.time_ns)))

    def __reduce__(self) -> tuple[Any, ...]:
        # a mappingproxy cannot be pickled; logs travel to worker processes
        state = {f.name: getattr(self, f.name) for f in fields(self)}
        return (_rebuild, (state | {"signals": dict(self.signals), "meta": dict(self.meta)},))

    # -- files ------------------------------------------------------------------------------------------

    @classmethod
    def open(
        cls,
        path: str | PathLike[str],
        columns: ColumnMap | None = None,
        *,
        joints: Sequence[str] | None = None,
        topic: str | None = None,
        keep_invalid: bool = False,
    ) -> Log:
        """Read a log from a file of any supported kind.

        Bags (``.mcap``, ``.db3``, rosbag2 folder): joint states come from ``sensor_msgs/msg/JointState``
        messages, in file order, mapped by joint name; the time is ``header.stamp`` (the log time if that is
        zero). Other messages with plain numbers become signals. A bag cut short or damaged is read as far as
        it goes; ``repair`` says how far.

        Tables (``.csv``, ``.tsv``, ``.txt``, also ``.gz``) and ``.npz``: ``columns`` says what is where.
        Times in text are converted exactly; float seconds of an ``.npz`` are rounded to the nearest
        nanosecond.

        Args:
            path: file or rosbag2 folder.
            columns: where a table or ``.npz`` keeps what. Not needed for files that palpate wrote, nor for
                tables with palpate's own column names (``time_ns`` or ``time_s``, ``position_1``,
                ``velocity_1``, ``effort_1``, ...).
            joints: joints to read, in this order. Default: all of them. In a bag, messages that lack one of
                them (a gripper's, say) are left out and counted; without ``joints`` the largest set of names
                is taken.
            topic: topic of the joint states in a bag. Default: ``/joint_states`` or the only one of its type.
            keep_invalid: keep rows with NaN, infinite or absurd values, in place. Needed to replay a
                recording bit for bit; estimates then see them as the live ones did. Default: drop and count
                them. Rows without a readable time or with a wrong number of columns are dropped in any case.

        Raises:
            LogError: no such file, unknown kind, nothing readable in it, a column or topic that is not there.
            MissingExtraError: the bag is compressed and ``palpate[logs]`` is not installed.
        """
        source = Path(path)
        if not source.exists():
            raise LogError(f"{source}: no such file or folder")
        if not (source.is_file() or source.is_dir()):
            raise LogError(f"{source}: neither a file nor a folder")
        suffixes = [s.lower() for s in source.suffixes]
        kind = suffixes[-1] if suffixes else ""
        if kind == ".gz" and len(suffixes) > 1:
            kind = suffixes[-2]
        try:
            if source.is_dir() or kind in (".mcap", ".db3", ".zstd"):
                from palpate.logs.bag import read_bag

                if columns is not None:
                    raise LogError(
                        f"{source}: columns are for tables; in a bag joints are found by name: use joints="
                    )
                return read_bag(source, joints=joints, topic=topic, keep_invalid=keep_invalid)
            if topic is not None:
                raise LogError(f"{source}: topic is for bags; in a table columns= says what is where")
            if kind == ".npz":
                from palpate.logs.npz import read_npz

                log = read_npz(source, columns, keep_invalid=keep_invalid)
            elif kind in _TABLE_SUFFIXES:
                from palpate.logs.table import read_table

                log = read_table(source, columns, keep_invalid=keep_invalid)
            else:
                raise LogError(f"{source}: unknown kind of log {source.suffix!r}; palpate reads {READABLE}")
        except OSError as error:
            raise LogError(f"{source}: cannot be read: {error.strerror or error}") from error
        return log if joints is None else log.select(joints)

    def save(self, path: str | PathLike[str], *, overwrite: bool = False) -> None:
        """Write the log, bit for bit.

        Args:
            path: ``.mcap`` or ``.db3`` for one file, no suffix for a rosbag2 folder, ``.npz``.
            overwrite: replace what is there.

        Raises:
            LogError: path exists or has another suffix; a bag cannot hold a time before 0 or from the year
                2038 on.
        """
        target = Path(path)
        try:
            if target.suffix == ".npz":
                from palpate.logs.npz import write_npz

                write_npz(self, target, overwrite=overwrite)
            else:
                from palpate.logs.recorder import write_log

                write_log(self, target, overwrite=overwrite)
        except OSError as error:
            raise LogError(f"{target}: cannot be written: {error.strerror or error}") from error

    # -- the parts --------------------------------------------------------------------------------------

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.joint_names)

    @property
    def has_effort(self) -> bool:
        """True if an effort was recorded: some value is not NaN."""
        return not bool(np.isnan(self.effort).all())

    @property
    def seconds(self) -> FloatArray:
        """(N,) time since the first sample [s]."""
        seconds: FloatArray = (self.time_ns - self.time_ns[:1]) * np.float64(1e-9)
        return seconds

    @property
    def duration(self) -> float:
        """Time from the earliest to the latest sample [s]; 0 with fewer than two samples."""
        return float(np.ptp(self.time_ns)) * 1e-9 if len(self) else 0.0

    @property
    def rate(self) -> float:
        """Samples per second by the median spacing [Hz]; 0 if there is none."""
        median = Clock.of(self.time_ns).median_ns
        return 1e9 / median if median > 0 else 0.0

    def __len__(self) -> int:
        return len(self.time_ns)

    def __iter__(self) -> Iterator[Sample]:
        """The driver's samples in order, each with read-only (n,) views."""
        rows = len(self)
        velocity = [None] * rows if self.velocity is None else self.velocity
        model = [None] * rows if self.model_torque is None else self.model_torque
        for sample in zip(self.time_ns.tolist(), self.position, velocity, self.effort, model, strict=True):
            yield Sample(*sample)

    @overload
    def __getitem__(self, key: int) -> Sample: ...
    @overload
    def __getitem__(self, key: slice) -> Log: ...
    def __getitem__(self, key: int | slice) -> Sample | Log:
        """One sample by number, or a part by rows.

        A part takes along the signals and events from its first row's time up to the time of the first row
        behind it; a part that begins (ends) with the log also takes what lies before (behind). No array is
        copied.
        """
        if not isinstance(key, slice):
            try:
                i = operator.index(key)
            except TypeError:
                raise InputError(
                    f"a log is indexed by a number or a slice of rows, got {type(key).__name__}; "
                    "for times use log.between(start, stop)"
                ) from None
            if not -len(self) <= i < len(self):
                raise IndexError(f"sample {i} of a log with {len(self)} samples")
            return Sample(
                int(self.time_ns[i]),
                self.position[i],
                None if self.velocity is None else self.velocity[i],
                self.effort[i],
                None if self.model_torque is None else self.model_torque[i],
            )
        start, stop, step = key.indices(len(self))
        if step <= 0:
            raise InputError(f"a log cannot run backwards: step {step}, expected 1 or more")
        stop = max(start, stop)
        first = int(self.time_ns[start]) if 0 < start < len(self) else (None if start == 0 else TIME_LIMIT_NS)
        last = int(self.time_ns[stop]) if stop < len(self) else None
        return self._part(slice(start, stop, step), first, last)

    def between(self, start: float = 0.0, stop: float = float("inf")) -> Log:
        """The part with ``start <= t < stop``, t being the time since the first sample [s].

        Signals and events are cut alike.

        Raises:
            InputError: NaN.
        """
        if len(self) == 0:
            return self
        if np.isnan(start) or np.isnan(stop):
            raise InputError(f"start and stop must be seconds, got {start} and {stop}")
        span = TIME_LIMIT_NS * 1e-9
        zero = int(self.time_ns[0])
        first = zero + round(max(start, -span) * 1e9) if start < span else TIME_LIMIT_NS
        last = zero + round(max(stop, -span) * 1e9) if stop < span else TIME_LIMIT_NS
        rows = np.flatnonzero((self.time_ns >= first) & (self.time_ns < last))
        if len(rows) and rows[-1] - rows[0] + 1 == len(rows):
            return self._part(slice(int(rows[0]), int(rows[-1]) + 1), first, last)
        return self._part(rows, first, last)

    def _part(self, rows: slice | IntArray, first: int | None, last: int | None) -> Log:
        def inside(time_ns: IntArray) -> Any:
            mask = np.ones(len(time_ns), dtype=bool)
            if first is not None:
                mask &= time_ns >= first
            if last is not None:
                mask &= time_ns < last
            return mask

        def cut(array: FloatArray | None) -> Any:
            return None if array is None else array[rows]

        signals = {}
        for name, signal in self.signals.items():
            mask = inside(signal.time_ns)
            signals[name] = (
                signal if mask.all() else Signal(signal.time_ns[mask], signal.value[mask], signal.unit)
            )
        event_times = np.array([e.time_ns for e in self.events], dtype=np.int64)
        return replace(
            self,
            time_ns=self.time_ns[rows],
            position=cut(self.position),
            effort=cut(self.effort),
            velocity=cut(self.velocity),
            model_torque=cut(self.model_torque),
            signals=signals,
            events=tuple(e for e, keep in zip(self.events, inside(event_times), strict=True) if keep),
        )

    def select(self, joints: Sequence[str]) -> Log:
        """The same log with these joints only, in this order. Signals stay as they are.

        Raises:
            LogError: a joint that the log does not have.
        """
        names = (joints,) if isinstance(joints, str) else tuple(joints)
        if missing := [name for name in names if name not in self.joint_names]:
            raise LogError(f"the log has no joint {missing[0]!r}; it has {', '.join(self.joint_names)}")
        index = [self.joint_names.index(name) for name in names]

        def pick(array: FloatArray | None) -> Any:
            return None if array is None else array[:, index]

        return replace(
            self,
            joint_names=names,
            position=pick(self.position),
            effort=pick(self.effort),
            velocity=pick(self.velocity),
            model_torque=pick(self.model_torque),
        )

    # -- looks ------------------------------------------------------------------------------------------

    def __eq__(self, other: object) -> bool:
        """Equal bit for bit in all but the repair report."""
        if not isinstance(other, Log):
            return NotImplemented
        return (
            self.joint_names == other.joint_names
            and all(_same(getattr(self, a), getattr(other, a)) for a in _ARRAYS)
            and dict(self.signals) == dict(other.signals)
            and self.events == other.events
            and dict(self.meta) == dict(other.meta)
        )

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        there, missing = self._inventory()
        text = f"Log({len(self)} samples, {self.duration:g} s, {self.rate:.4g} Hz, {self.n} joints, "
        text += ", ".join(there)
        if missing:
            text += f", no {', no '.join(missing)}"
        if self.signals:
            text += f", {len(self.signals)} signals"
        if self.repair.dropped:
            text += f", {sum(self.repair.dropped.values())} dropped"
        return text + ")"

    def summary(self) -> str:
        """Lines for people: duration, rate, joints, what is there, what is missing, what was repaired."""
        there, missing = self._inventory()
        lines = [
            f"{len(self)} samples in {self.duration:g} s, {self.rate:.4g} Hz",
            f"{self.n} joints: {', '.join(self.joint_names)}",
            f"has: {', '.join(there)}",
        ]
        if missing:
            lines.append(f"missing: {', '.join(missing)}")
        lines.extend(f"signal {name}: {signal!r}" for name, signal in self.signals.items())
        if self.events:
            lines.append(f"{len(self.events)} events: {', '.join(sorted({e.kind for e in self.events}))}")
        lines.append(str(self.repair))
        return "\n".join(lines)

    def _inventory(self) -> tuple[list[str], list[str]]:
        unit = self.meta.get("effort_unit")
        state = {
            "position": True,
            "velocity": self.velocity is not None,
            f"effort [{unit}]" if unit and self.has_effort else "effort": self.has_effort,
            "model torque": self.model_torque is not None,
        }
        return [k for k, v in state.items() if v], [k for k, v in state.items() if not v]


_ARRAYS = ("time_ns", "position", "velocity", "effort", "model_torque")


def _event(time_ns: int, kind: str, text: str = "") -> Event:
    time_ns = operator.index(time_ns)
    if not -TIME_LIMIT_NS < time_ns < TIME_LIMIT_NS:
        raise InputError(f"time_ns of an event must lie within +-2**62 ns, got {time_ns}")
    return Event(time_ns, str(kind), str(text))


def check_names(joint_names: Sequence[str]) -> tuple[str, ...]:
    """The names as a tuple.

    Raises:
        InputError: none, one twice, or one that no file could hold.
    """
    names = (joint_names,) if isinstance(joint_names, str) else tuple(joint_names)
    for name in names:
        if not isinstance(name, str) or not name or "\0" in name or not _is_utf8(name):
            raise InputError(f"joint_names must be non-empty text, got {name!r}")
    if not names or len(set(names)) != len(names):
        raise InputError(f"joint_names must name at least one joint, each once, got {names}")
    return names


def _is_utf8(text: str) -> bool:
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def _rebuild(state: dict[str, Any]) -> Log:
    return Log(**state)
