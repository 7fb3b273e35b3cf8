"""Logs from and to NumPy's ``.npz``: needs nothing else, no pickles, sizes checked before memory is taken."""

from __future__ import annotations

import json
import math
import os
import struct
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt
from numpy.lib import format as npy

from palpate.errors import LogError
from palpate.logs.columns import TIME_UNITS, ColumnMap, Layout, SignalColumns, resolve
from palpate.logs.log import Event, Log, Signal
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
from palpate.logs.table import EXPANSION_FACTOR, effort_meta, joint_arrays, scaled

FORMAT = 1
_INFO = "palpate_log"
_EXPANSION_FREE = 256 << 20  # [bytes]; arrays of zeros shrink to nothing and are no attack
#: what damaged archives and headers make zipfile and NumPy raise
_DAMAGE = (
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
    EOFError,
    ValueError,
    SyntaxError,
    TypeError,
    KeyError,
    IndexError,
    NotImplementedError,
    RuntimeError,
    OverflowError,
    MemoryError,
    RecursionError,
)


class _Archive:
    """The arrays of an ``.npz``, read one by one on request."""

    def __init__(self, path: Path, file: IO[bytes]) -> None:
        self.path = path
        self.left = _EXPANSION_FREE + EXPANSION_FACTOR * path.stat().st_size
        try:
            self.zip = zipfile.ZipFile(file)
            self.names = [name.removesuffix(".npy") for name in self.zip.namelist() if name.endswith(".npy")]
        except _DAMAGE as error:
            raise LogError(f"{path}: not a readable .npz file: {error}") from None

    def read(self, name: str) -> npt.NDArray[Any]:
        try:
            info = self.zip.getinfo(f"{name}.npy")
            self.left -= info.file_size
            if self.left < 0:
                raise LogError(
                    f"{self.path}: {name!r} expands to {info.file_size >> 20} MiB, too much for its file"
                )
            with self.zip.open(info) as member:
                version = npy.read_magic(member)
                if version not in ((1, 0), (2, 0)):
                    raise ValueError(f"version {version} of the .npy format")
                header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
                shape, fortran, dtype = header(member)
                if dtype.kind not in "fiubU":
                    raise LogError(
                        f"{self.path}: {name!r} holds {dtype} (a pickle or text); expected numbers"
                    )
                raw = member.read()
                if min(shape, default=0) < 0 or len(raw) != math.prod(shape) * dtype.itemsize:
                    raise ValueError(f"{len(raw)} bytes for {shape} of {dtype}")
        except _DAMAGE as error:
            raise LogError(f"{self.path}: array {name!r} is damaged: {error}") from None
        return np.frombuffer(raw, dtype=dtype).reshape(shape, order="F" if fortran else "C")

    def floats(self, name: str) -> FloatArray:
        array = self.read(name)
        if array.dtype.kind == "U":
            raise LogError(f"{self.path}: {name!r} holds text; expected numbers")
        with np.errstate(invalid="ignore", over="ignore"):  # a signalling NaN of 32 bit, a number of 128 bit
            return array.astype(np.float64)


def read_npz(path: Path, columns: ColumnMap | None, *, keep_invalid: bool) -> Log:
    """Read an ``.npz``. See ``Log.open``.

    Raises:
        LogError: see ``Log.open``.
    """
    if path.stat().st_size == 0:
        raise LogError(f"{path}: the file is empty")
    with path.open("rb") as file:
        archive = _Archive(path, file)
        if columns is not None:
            return _mapped(archive, columns, keep_invalid)
        if _INFO in archive.names:
            return _own(archive, keep_invalid)
        raise LogError(
            f"{path}: not written by palpate; pass columns=ColumnMap(...). It holds the arrays "
            f"{', '.join(archive.names[:20]) or '(none)'}"
        )


def write_npz(log: Log, path: Path, *, overwrite: bool) -> None:
    """Write a log as ``.npz``; the file appears complete or not at all.

    Raises:
        LogError: path exists.
    """
    if path.exists() and not overwrite:
        raise LogError(f"{path} exists; pass overwrite=True to replace it")
    info = {
        "format": FORMAT,
        "joint_names": log.joint_names,
        "signals": [[name, signal.unit] for name, signal in log.signals.items()],
        "events": log.events,
        "meta": dict(log.meta),
    }
    arrays: dict[str, Any] = {
        _INFO: np.array(json.dumps(info)),
        "time_ns": log.time_ns,
        "position": log.position,
        "effort": log.effort,
    }
    for name in ("velocity", "model_torque"):
        if (value := getattr(log, name)) is not None:
            arrays[name] = value
    for i, signal in enumerate(log.signals.values()):
        arrays[f"signal{i}_time_ns"] = signal.time_ns
        arrays[f"signal{i}"] = signal.value
    half = path.with_name(path.name + ".part")
    try:
        with half.open("wb") as file:
            np.savez(file, allow_pickle=False, **arrays)
        os.replace(half, path)
    finally:
        half.unlink(missing_ok=True)


def _own(archive: _Archive, keep_invalid: bool) -> Log:
    try:
        info = json.loads(str(archive.read(_INFO)[()]))
        if info["format"] > FORMAT:
            raise LogError(f"{archive.path}: written by a newer palpate (format {info['format']})")
        names = tuple(map(str, info["joint_names"]))
        units = [(str(name), str(unit)) for name, unit in info["signals"]]
        events = tuple(Event(int(t), str(kind), str(text)) for t, kind, text in info["events"])
        meta = {str(key): str(text) for key, text in info["meta"].items()}
        if any(abs(event.time_ns) >= TIME_LIMIT_NS for event in events):
            raise ValueError("the time of an event")
    except _DAMAGE as error:
        raise LogError(f"{archive.path}: array {_INFO!r} is damaged: {error}") from None
    fields: dict[str, FloatArray] = {
        name: archive.floats(name)
        for name in ("position", "velocity", "effort", "model_torque")
        if name in archive.names or name in ("position", "effort")
    }
    time_ns = archive.read("time_ns")
    raw = [
        (name, archive.read(f"signal{i}_time_ns"), archive.floats(f"signal{i}"), unit)
        for i, (name, unit) in enumerate(units)
    ]
    return _log(archive.path, time_ns, 0, fields, raw, names, meta, events, keep_invalid)


def _mapped(archive: _Archive, columns: ColumnMap, keep_invalid: bool) -> Log:
    path = archive.path
    specs = [*columns.fields().values(), *columns.signals.values()]
    flat = [spec.columns if isinstance(spec, SignalColumns) else spec for spec in specs]
    if any(
        not isinstance(c, str) for spec in flat for c in ([spec] if isinstance(spec, str | int) else spec)
    ):
        raise LogError(
            f"{path}: the arrays of an .npz have names, not indices; there are {', '.join(archive.names)}"
        )
    if not archive.names:
        raise LogError(f"{path}: holds no arrays")

    # the names are resolved like those of columns; then an array may be worth several columns
    def stack(indices: list[int], what: str) -> FloatArray:
        parts = [archive.floats(archive.names[i]) for i in indices]
        if any(part.ndim not in (1, 2) or len(part) != len(parts[0]) for part in parts):
            raise LogError(
                f"{path}: {what} must be (N,) or (N,n), got {', '.join(str(p.shape) for p in parts)}"
            )
        return parts[0] if len(parts) == 1 else np.column_stack(parts)

    names = columns.joint_names
    loose = ColumnMap(
        **{
            name: getattr(columns, name)
            for name in ("time", "time_unit", "period", "joints", "signals", "position")
        }
    )
    layout: Layout = resolve(loose, archive.names, len(archive.names), str(path))
    fields: dict[str, FloatArray] = {}
    for name, spec in columns.fields().items():
        part = ColumnMap(position=spec, time=None, period=1.0, joints=columns.joints)
        indices = resolve(part, archive.names, len(archive.names), str(path)).fields["position"]
        value = stack(indices, name)
        fields[name] = scaled(value if value.ndim == 2 else value[:, None], columns.scales()[name])
    n = fields["position"].shape[1]
    if names is None:
        names = (
            layout.joint_names if len(layout.joint_names) == n else [f"joint_{k}" for k in range(1, n + 1)]
        )
    time: npt.NDArray[Any]
    if layout.time is None:
        time, exponent = np.arange(len(fields["position"])) * (columns.period or 0.0), 9
    else:
        time, exponent = archive.read(archive.names[layout.time]), TIME_UNITS[columns.time_unit]
    raw = []
    for name, (indices, _, unit, scale) in layout.signals.items():
        raw.append((name, time, scaled(stack(indices, f"signal {name}"), scale), unit))
    meta = effort_meta(columns, fields)
    return _log(path, time, exponent, fields, raw, tuple(names), meta, (), keep_invalid)


def _log(
    path: Path,
    time: npt.NDArray[Any],
    exponent: int,
    fields: dict[str, FloatArray],
    raw_signals: list[tuple[str, npt.NDArray[Any], FloatArray, str]],
    names: tuple[str, ...],
    meta: Mapping[str, str],
    events: tuple[Event, ...],
    keep_invalid: bool,
) -> Log:
    """Check shapes, screen values and put the log together."""
    tally = Tally()
    shape = (time.size, len(names))
    if time.ndim != 1 or any(value.shape != shape for value in fields.values()):
        shapes = ", ".join(f"{name} {value.shape}" for name, value in fields.items())
        raise LogError(
            f"{path}: time {time.shape} and {shapes} do not fit {len(names)} joints; expected (N,) and (N,n)"
        )
    time_ns, valid = _ns(time, exponent, path)
    places = np.arange(len(time_ns), dtype=np.int64)
    tally.add(BAD_TIME, places[~valid].tolist())
    time_ns, places = time_ns[valid], places[valid]
    fields = {name: value[valid] for name, value in fields.items()}
    keep = screen(fields, places, tally, keep_invalid=keep_invalid)
    require_rows(str(path), len(valid), int(np.count_nonzero(keep)), tally)
    signals = {}
    for name, signal_time, value, unit in raw_signals:
        if signal_time.ndim != 1 or value.ndim not in (1, 2) or len(value) != len(signal_time):
            raise LogError(f"{path}: signal {name!r} has {value.shape} values for {signal_time.shape} times")
        signal_ns, good = _ns(signal_time, exponent, path)
        if not keep_invalid:
            good &= screen_signal(name, value, np.arange(len(value), dtype=np.int64), tally)
        signals[name] = Signal(signal_ns[good], value[good], unit)
    time_ns = time_ns[keep]
    return Log(
        time_ns=time_ns,
        joint_names=names,
        signals=signals,
        events=events,
        meta=meta,
        repair=tally.report(len(valid), time_ns),
        **joint_arrays({name: value[keep] for name, value in fields.items()}),
    )


def _ns(time: npt.NDArray[Any], exponent: int, path: Path) -> tuple[IntArray, BoolArray]:
    """Times as integer nanoseconds, and which of them are any good. Integers are exact, floats rounded."""
    if time.dtype.kind in "iu":
        factor = 10**exponent
        limit = TIME_LIMIT_NS // factor
        good = (time < limit) & (time > -limit) if time.dtype.kind == "i" else time < limit
        return np.where(good, time, 0).astype(np.int64) * factor, good
    if time.dtype.kind != "f":
        raise LogError(f"{path}: the time holds {time.dtype}; expected numbers")
    with np.errstate(over="ignore", invalid="ignore"):
        ns = np.rint(time.astype(np.float64) * 10.0**exponent)
        good = np.abs(ns) < TIME_LIMIT_NS
    return np.where(good, ns, 0.0).astype(np.int64), good
