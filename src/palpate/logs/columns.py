"""What the columns of a table (or the arrays of an ``.npz``) mean, and in which unit they are written."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

from palpate.errors import InputError, LogError

#: One column: its name, or its index from 0.
Column = str | int
#: Several columns: a name with a placeholder (``"q{joint}"``: the arm's joints; ``"ft_{i}"``: every number in
#: the header), a list of names or indices, a ``range`` of indices, or a single column.
Columns = str | int | Sequence[str | int]

TIME_UNITS = {"s": 9, "ms": 6, "us": 3, "µs": 3, "ns": 0}  #: power of ten to [ns]
POSITION_UNITS = {
    "rad": 1.0,
    "mrad": 1e-3,
    "deg": math.pi / 180.0,
    "rev": 2.0 * math.pi,
    "m": 1.0,
    "mm": 1e-3,
}
VELOCITY_UNITS = {
    "rad/s": 1.0,
    "mrad/s": 1e-3,
    "deg/s": math.pi / 180.0,
    "rev/s": 2.0 * math.pi,
    "rpm": math.pi / 30.0,
    "m/s": 1.0,
    "mm/s": 1e-3,
}
#: factor and the unit it leads to; the driver's unit is kept, only its prefix goes
EFFORT_UNITS = {
    "N m": (1.0, "N m"),
    "Nm": (1.0, "N m"),
    "mN m": (1e-3, "N m"),
    "mNm": (1e-3, "N m"),
    "kgf cm": (0.0980665, "N m"),
    "N": (1.0, "N"),
    "A": (1.0, "A"),
    "mA": (1e-3, "A"),
    "raw": (1.0, "raw"),
}
_PLACEHOLDER = re.compile(r"\{(\w*)\}")


@dataclass(frozen=True, slots=True)
class SignalColumns:
    """Columns of one extra signal.

    Attributes:
        columns: which; a single name or index gives a signal (M,), anything else (M,k).
        unit: unit of the values after multiplication with ``scale``; only carried along.
        scale: factor applied to the numbers of the file.
    """

    columns: Columns
    unit: str = ""
    scale: float = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class ColumnMap:
    """Where a table keeps what.

    Example::

        ColumnMap(
            time="t", time_unit="ms",
            position="q{joint}", position_unit="deg",
            effort="I{joint}", effort_unit="mA",
            joints=(1, 2, 3, 4, 5, 6),
            signals={"force": SignalColumns("F_{i}", "N")},
        )

    Attributes:
        time: column of the time; None if there is none, then ``period`` is needed.
        time_unit: ``s``, ``ms``, ``us`` or ``ns``. Times in text are converted exactly, digit by digit; finer
            than 1 ns is rounded.
        period: time between rows [s] where there is no time column; row k of the file gets the time ``k *
            period``.
        position: one column per joint.
        position_unit: ``rad``, ``mrad``, ``deg``, ``rev``, ``m``, ``mm``, or a factor to [rad] or [m].
        velocity: one column per joint; None if not there.
        velocity_unit: ``rad/s``, ``mrad/s``, ``deg/s``, ``rev/s``, ``rpm``, ``m/s``, ``mm/s``, or a factor.
        effort: one column per joint; None if not there (then it is NaN).
        effort_unit: ``N m``, ``mN m``, ``kgf cm``, ``N``, ``A``, ``mA``, ``raw``, or a factor to the driver's
            unit. A current stays a current: the arm's gains make it a torque.
        model_torque: one column per joint: the controller's own torque of the bare arm; None if not there.
        model_torque_unit: as ``effort_unit``.
        signals: extra quantities by name.
        joints: what ``{joint}`` stands for, in order. None: every number (else every text) found in the
            header.
        joint_names: names of the joints in the log. None: ``joint_1`` for the number 1, else the text itself.
        delimiter: character between cells; None: found out (``,`` ``;`` tab or blanks).
        header: the first row names the columns. None: found out.

    In an ``.npz`` a name means an array; one without placeholder may be (N,n), all joints at once.
    """

    position: Columns
    time: Column | None = "time"
    time_unit: str = "s"
    period: float | None = None
    position_unit: str | float = "rad"
    velocity: Columns | None = None
    velocity_unit: str | float = "rad/s"
    effort: Columns | None = None
    effort_unit: str | float = "N m"
    model_torque: Columns | None = None
    model_torque_unit: str | float = "N m"
    signals: Mapping[str, SignalColumns | Columns] = field(default_factory=dict)
    joints: Sequence[str | int] | None = None
    joint_names: Sequence[str] | None = None
    delimiter: str | None = None
    header: bool | None = None

    def __post_init__(self) -> None:
        if self.time_unit not in TIME_UNITS:
            raise InputError(f"time_unit must be one of {', '.join(TIME_UNITS)}, got {self.time_unit!r}")
        if self.time is None and not (self.period is not None and 0.0 < self.period < 1e6):
            raise InputError(f"without a time column the period [s] must be given, got {self.period!r}")
        self.scales()
        if self.delimiter is not None and len(self.delimiter) != 1:
            raise InputError(f"delimiter must be one character, got {self.delimiter!r}")
        for name, columns in self.signals.items():
            if not isinstance(name, str) or not name:
                raise InputError(f"signals must be named, got {name!r}")
            if isinstance(columns, SignalColumns) and not math.isfinite(columns.scale):
                raise InputError(f"scale of signal {name!r} must be finite, got {columns.scale}")
        object.__setattr__(self, "signals", MappingProxyType(dict(self.signals)))

    def scales(self) -> dict[str, float]:
        """Factor to the log's unit for position, velocity, effort and model_torque.

        Raises:
            InputError: an unknown unit.
        """
        efforts = {unit: scale for unit, (scale, _) in EFFORT_UNITS.items()}
        return {
            "position": _scale("position_unit", self.position_unit, POSITION_UNITS),
            "velocity": _scale("velocity_unit", self.velocity_unit, VELOCITY_UNITS),
            "effort": _scale("effort_unit", self.effort_unit, efforts),
            "model_torque": _scale("model_torque_unit", self.model_torque_unit, efforts),
        }

    @property
    def effort_base_unit(self) -> str | None:
        """Unit of the effort in the log: ``N m``, ``A``, ...; None if ``effort_unit`` is a bare factor."""
        return EFFORT_UNITS[self.effort_unit][1] if isinstance(self.effort_unit, str) else None

    def fields(self) -> dict[str, Columns]:
        """The joint quantities that are mapped, by name."""
        mapped = {
            "position": self.position,
            "velocity": self.velocity,
            "effort": self.effort,
            "model_torque": self.model_torque,
        }
        return {name: columns for name, columns in mapped.items() if columns is not None}

    @classmethod
    def named(cls, name: str) -> ColumnMap:
        """The map of a known data set.

        Raises:
            InputError: no such map; the message lists them.
        """
        try:
            return _NAMED[name]
        except KeyError:
            raise InputError(f"no column map named {name!r}; there are {', '.join(cls.names())}") from None

    @classmethod
    def names(cls) -> tuple[str, ...]:
        """Names that ``named`` knows."""
        return tuple(_NAMED)


def _scale(what: str, unit: str | float, known: Mapping[str, float]) -> float:
    if isinstance(unit, str):
        if unit not in known:
            raise InputError(f"{what} must be one of {', '.join(known)} or a factor, got {unit!r}")
        return known[unit]
    factor = float(unit)
    if not math.isfinite(factor) or factor == 0.0:
        raise InputError(f"{what} as a factor must be finite and not 0, got {unit!r}")
    return factor


@dataclass(frozen=True, slots=True)
class Layout:
    """A ``ColumnMap`` applied to one file: an index for every column."""

    time: int | None
    fields: dict[str, list[int]]
    signals: dict[str, tuple[list[int], bool, str, float]]  #: indices, is a vector, unit, scale
    joint_names: tuple[str, ...]


def resolve(columns: ColumnMap, header: Sequence[str] | None, width: int, where: str) -> Layout:
    """Find every column of the map.

    Args:
        columns: the map.
        header: names of the columns (or arrays); None if the file has none.
        width: number of columns.
        where: names the file in messages.

    Raises:
        LogError: a column that is not there, or different numbers of columns per quantity.
    """
    table = _Header(header, width, where)
    joints = list(columns.joints) if columns.joints is not None else None
    if joints is None:
        for spec in columns.fields().values():
            if isinstance(spec, str) and "{joint}" in spec:
                joints = table.found(spec, "position")
                break
    time = None if columns.time is None else table.index(columns.time, "the time")
    fields = {name: table.indices(spec, name, joints)[0] for name, spec in columns.fields().items()}
    n = len(fields["position"])
    for name, indices in fields.items():
        if len(indices) != n:
            raise LogError(
                f"{where}: {n} columns of position but {len(indices)} of {name}; expected one per joint"
            )
    signals = {}
    for name, signal in columns.signals.items():
        if not isinstance(signal, SignalColumns):
            signal = SignalColumns(signal)
        indices, vector = table.indices(signal.columns, f"signal {name}", joints)
        signals[name] = (indices, vector, signal.unit, signal.scale)
    if columns.joint_names is not None:
        names = tuple(columns.joint_names)
    else:
        keys = joints if joints is not None and len(joints) == n else range(1, n + 1)
        names = tuple(f"joint_{k}" if str(k).isdigit() else str(k) for k in keys)
    if len(names) != n or len(set(names)) != n:
        raise LogError(f"{where}: {n} columns of position but the joint names are {', '.join(names)}")
    return Layout(time, fields, signals, names)


class _Header:
    def __init__(self, names: Sequence[str] | None, width: int, where: str) -> None:
        self.names = names
        self.width = width
        self.where = where
        self.at: dict[str, int] = {}
        for i, name in enumerate(names or ()):
            self.at.setdefault(name, i)

    def index(self, column: Column, what: str) -> int:
        if isinstance(column, str):
            if self.names is None:
                raise LogError(
                    f"{self.where}: {what} is mapped to the column named {column!r}, "
                    f"but the file has no header; use an index from 0 to {self.width - 1}"
                )
            if column in self.at:
                return self.at[column]
            near = difflib.get_close_matches(column, self.names, n=4, cutoff=0.5)
            raise LogError(
                f"{self.where}: no column {column!r} for {what}; "
                + (f"close to it: {', '.join(near)}" if near else f"there are {_some(self.names)}")
            )
        if isinstance(column, bool) or not isinstance(column, int):
            raise LogError(f"{self.where}: a column is a name or an index, got {column!r} for {what}")
        if not 0 <= column < self.width:
            raise LogError(
                f"{self.where}: no column {column} for {what}; "
                f"there are {self.width}, counted from 0 to {self.width - 1}"
            )
        return column

    def indices(self, spec: Columns, what: str, joints: Sequence[str | int] | None) -> tuple[list[int], bool]:
        """Column indices and whether they form a vector."""
        if isinstance(spec, str):
            holders = set(_PLACEHOLDER.findall(spec))
            if not holders:
                return [self.index(spec, what)], False
            if holders - {"joint", "i"} or len(holders) > 1:
                raise LogError(f"{self.where}: the placeholder in {spec!r} must be {{joint}} or {{i}}")
            holder = "{" + holders.pop() + "}"
            keys = joints if holder == "{joint}" and joints is not None else self.found(spec, what)
            return [self.index(spec.replace(holder, str(key)), what) for key in keys], True
        if isinstance(spec, int):
            return [self.index(spec, what)], False
        if not spec:
            raise LogError(f"{self.where}: no columns given for {what}")
        return [self.index(column, what) for column in spec], True

    def found(self, pattern: str, what: str) -> list[str | int]:
        """What the placeholder of ``pattern`` stands for in this header: numbers in order, else texts."""
        if self.names is None:
            raise LogError(
                f"{self.where}: {pattern!r} names columns, but the file has no header; use indices"
            )
        parts = _PLACEHOLDER.split(pattern)[::2]
        for key in ("[0-9]{1,9}", ".+"):
            regex = re.compile(_regex(parts, key))
            keys = [m["key"] for name in self.at if (m := regex.fullmatch(name))]
            if keys:
                return list(keys) if key == ".+" else sorted(keys, key=int)
        stem = max(parts, key=len)
        near = [name for name in self.names if stem and stem.lower() in name.lower()][:4]
        near = near or difflib.get_close_matches(stem + "1", self.names, n=4, cutoff=0.4)
        raise LogError(
            f"{self.where}: no column like {pattern!r} for {what}; "
            + (f"close to it: {', '.join(near)}" if near else f"there are {_some(self.names)}")
        )


def _regex(parts: Sequence[str], key: str) -> str:
    """The pattern's text with the key at the first placeholder and the same key at every further one."""
    first, second, *rest = (re.escape(p) for p in parts)
    return f"{first}(?P<key>{key}){second}" + "".join(f"(?P=key){p}" for p in rest)


def _some(names: Sequence[str], most: int = 12) -> str:
    text = ", ".join(names[:most])
    return text if len(names) <= most else f"{text}, ... ({len(names)} in all)"


def conventional(header: Sequence[str] | None, where: str) -> ColumnMap:
    """The map of a table with palpate's own column names.

    Raises:
        LogError: other names; the message says what was looked for, what is there, and which named map would
            fit.
    """
    names = set(header or ())
    time = next((t for t in ("time_ns", "time_s") if t in names), None)
    if time is None or "position_1" not in names:
        fitting = [name for name, known in _NAMED.items() if header is not None and _fits(known, header)]
        hint = (
            f"; this is a {fitting[0]} table: ColumnMap.named({fitting[0]!r}), --columns {fitting[0]}"
            if fitting
            else ""
        )
        there = _some(list(header)) if header else "no header"
        raise LogError(
            f"{where}: without a column map a table must have the columns time_ns (or time_s), "
            f"position_1, ... and effort_1, ...; there is {there}{hint}"
        )
    optional: dict[str, Any] = {
        name: f"{name}_{{joint}}" for name in ("velocity", "effort", "model_torque") if f"{name}_1" in names
    }
    unit = time.removeprefix("time_")
    return ColumnMap(time=time, time_unit=unit, position="position_{joint}", **optional)


def _fits(columns: ColumnMap, header: Sequence[str]) -> bool:
    if columns.header is False:  # indices fit any table that is wide enough
        return False
    try:
        resolve(columns, header, len(header), "")
    except LogError:
        return False
    return True


_UR_JOINTS = (
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "elbow_joint",
    "wrist_1_joint",
    "wrist_2_joint",
    "wrist_3_joint",
)

_NAMED = {
    # NEURA LARA 8 with a wrist force/torque sensor (A. Lucious, MasterThesis, BSD-3-Clause). The effort is
    # the joint torque that the controller computes from the motor current. fts_reading_3 (Fz) has the
    # opposite sign of the tool's z axis.
    "lara8": ColumnMap(
        time="Timestamp",
        time_unit="s",
        position="joint_angles_{joint}",
        velocity="joint_velocity_{joint}",
        effort="joint_torque_current_{joint}",
        effort_unit="N m",
        model_torque="target_joint_torque_{joint}",
        joints=(1, 2, 3, 4, 5, 6),
        signals={
            "fts_reading": SignalColumns("fts_reading_{i}", "N, N m"),
            "target_joint_angles": SignalColumns("target_joint_angles_{joint}", "rad"),
            "target_joint_velocity": SignalColumns("target_joint_velocity_{joint}", "rad/s"),
            "pose": SignalColumns([f"pose_{c}" for c in ("tx", "ty", "tz", "qw", "qx", "qy", "qz")], "m, 1"),
        },
    ),
    # Universal Robots UR10e, identification and validation runs (Innopolis University, dynamic_calibration): 31
    # columns, no header. model_torque is the manufacturer's rigid-body model without load and friction.
    "ur10e": ColumnMap(
        time=0,
        time_unit="s",
        position=range(1, 7),
        velocity=range(7, 13),
        effort=range(13, 19),
        effort_unit="A",
        model_torque=range(25, 31),
        model_torque_unit="N m",
        signals={"target_current": SignalColumns(range(19, 25), "A")},
        joint_names=_UR_JOINTS,
        header=False,
    ),
    # The same robot's collision runs: 25 columns, no header. The wrench is the controller's own estimate at the
    # tool, in the UR base frame (URDF base_link turned by 180 deg about z).
    "ur10e_wrench": ColumnMap(
        time=0,
        time_unit="s",
        position=range(1, 7),
        velocity=range(7, 13),
        effort=range(13, 19),
        effort_unit="A",
        signals={"wrench": SignalColumns(range(19, 25), "N, N m")},
        joint_names=_UR_JOINTS,
        header=False,
    ),
    # Kinova Gen3 (DynaMapp, CC0-1.0). The effort is the motor current; torque_sensor is what the joint torque
    # sensors read, torque_current the controller's torque from the current.
    "kinova_gen3": ColumnMap(
        time="Time",
        time_unit="ms",
        position="Position{joint}",
        velocity="Velocity{joint}",
        effort="Cur{joint}",
        effort_unit="A",
        model_torque="Torque{joint}",
        model_torque_unit="N m",
        joints=(1, 2, 3, 4, 5, 6, 7),
        signals={
            "torque_sensor": SignalColumns("TorqueSm{joint}", "N m"),
            "torque_current": SignalColumns("TorqueCur{joint}", "N m"),
            "temperature": SignalColumns("Temp{joint}", "degC"),
            "position_command": SignalColumns("PositionCmptd{joint}", "rad"),
        },
    ),
    # KUKA LWR 4+ (FloBaRoID, LGPL-3.0), .npz. The effort is what the joint torque sensors read.
    "kuka_lwr4": ColumnMap(
        time="times",
        time_unit="s",
        position="positions",
        velocity="velocities",
        effort="torques",
        effort_unit="N m",
    ),
}
