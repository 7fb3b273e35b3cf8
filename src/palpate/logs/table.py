"""Logs from text tables (CSV and its relatives, plain or gzip-compressed)."""

from __future__ import annotations

import csv
import re
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from decimal import ROUND_HALF_EVEN, Decimal, DecimalException
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from palpate.errors import LogError
from palpate.logs.columns import TIME_UNITS, ColumnMap, Layout, conventional, resolve
from palpate.logs.log import Log, Signal
from palpate.logs.repair import (
    BAD_TIME,
    CUT_LINE,
    TIME_LIMIT_NS,
    WRONG_COLUMNS,
    BoolArray,
    FloatArray,
    IntArray,
    Tally,
    require_rows,
    screen,
    screen_signal,
)

BLOCK_BYTES = 1 << 20
_GZIP_BYTES = 64 << 10
LINE_LIMIT = 1 << 20  # [bytes]: 30 joints with 20 quantities each need 12 kB
#: A compressed file may grow to this much plus EXPANSION_FACTOR times its size; beyond, it is an attack, not
#: a log.
EXPANSION_FREE = 32 << 20
EXPANSION_FACTOR = 200
_BISECT_STOP = 16
_PLAIN_DECIMAL = re.compile(r"([+-]?)([0-9]{1,18})(?:\.([0-9]*))?")
_FLOAT = re.compile(r"[+-]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
_NOT_FINITE = re.compile(r"[+-]?(?:nan|inf|infinity)", re.ASCII | re.IGNORECASE)
_NOT_TEXT = {
    b"\x89MCAP": "an MCAP file; name it .mcap",
    b"SQLite format 3": "a rosbag2 database; name it .db3",
    b"PK\x03\x04": "a ZIP or NPZ file",
    b"\x89PNG": "a picture",
    b"\xff\xfe": "UTF-16 text; save it as UTF-8",
    b"\xfe\xff": "UTF-16 text; save it as UTF-8",
}


def read_table(path: Path, columns: ColumnMap | None, *, keep_invalid: bool) -> Log:
    """Read a table. See ``Log.open``.

    Raises:
        LogError: see ``Log.open``.
    """
    tally = Tally()
    with path.open("rb") as raw:
        magic = raw.read(16)
        raw.seek(0)
        if not magic:
            raise LogError(f"{path}: the file is empty")
        zipped = magic.startswith(b"\x1f\x8b")
        if zipped:
            blocks = _gunzip(raw, tally)
            limit = EXPANSION_FREE + EXPANSION_FACTOR * path.stat().st_size
        else:
            blocks, limit = iter(partial(raw.read, BLOCK_BYTES), b""), None
        for start, what in _NOT_TEXT.items():
            if magic.startswith(start):
                raise LogError(f"{path}: expected a text table, but this is {what}")
        return _Table(path, columns, tally, keep_invalid).read(_lines(blocks, path, limit, tally))


def exact_ns(text: str, exponent: int) -> int | None:
    """Convert a decimal number to integer nanoseconds, exactly.

    Args:
        text: the number, e.g. ``"1700000000.123456789"``.
        exponent: power of ten of its unit in [ns], 9 for seconds. Digits finer than 1 ns are rounded half to
            even.

    Returns:
        [ns]; None if the text is no number or lies beyond +-2**62 ns.
    """
    text = text.strip()
    match = _PLAIN_DECIMAL.fullmatch(text)
    if match:
        sign, whole, fraction = match.groups()
        fraction = fraction or ""
        if len(fraction) <= exponent:
            ns = int(whole + fraction.ljust(exponent, "0"))
            return (-ns if sign == "-" else ns) if ns < TIME_LIMIT_NS else None
    elif not _FLOAT.fullmatch(text):
        return None
    try:
        number = Decimal(text)
        if number.is_zero():
            return 0
        if not -40 < number.adjusted() < 20:  # before scaling: 1e999999999 would fill the memory
            return 0 if number.adjusted() < 0 else None
        ns = int(number.scaleb(exponent).to_integral_value(ROUND_HALF_EVEN))
    except DecimalException:
        return None
    return ns if abs(ns) < TIME_LIMIT_NS else None


def number(text: str) -> float | None:
    """A cell as a number: NaN if it is empty, None if it is no number at all."""
    text = text.strip()
    if _FLOAT.fullmatch(text) or _NOT_FINITE.fullmatch(text):
        return float(text)
    return None if text else float("nan")


def _gunzip(raw: BinaryIO, tally: Tally) -> Iterator[bytes]:
    """Everything that can be decompressed; damage is noted and ends it."""
    unpack = zlib.decompressobj(wbits=31)
    total = 0
    data = raw.read(_GZIP_BYTES)
    while data:
        before = unpack.copy()
        try:
            found = unpack.decompress(data, BLOCK_BYTES)
            data = unpack.unconsumed_tail
        except zlib.error as error:
            # what came out before the damaged byte is lost with the call: go there byte by byte
            found, data = _up_to_damage(before, data), b""
            tally.cut = True
            tally.note(f"the compressed file is damaged behind {total + len(found)} bytes of text ({error})")
            yield found
            return
        total += len(found)
        if found:
            yield found
        if unpack.eof:
            data = unpack.unused_data.lstrip(b"\0") or raw.read(_GZIP_BYTES).lstrip(b"\0")
            if data:
                unpack = zlib.decompressobj(wbits=31)
        elif not data:
            data = raw.read(_GZIP_BYTES)
    if not unpack.eof:
        tally.cut = True
        tally.note(f"the compressed file is cut short behind {total} bytes of text")


def _up_to_damage(unpack: Any, data: bytes) -> bytes:
    found = bytearray()
    try:
        for k in range(len(data)):
            found += unpack.decompress(data[k : k + 1])
    except zlib.error:
        pass
    return bytes(found)


def _lines(
    blocks: Iterator[bytes], path: Path, limit: int | None, tally: Tally
) -> Iterator[tuple[int, list[str]]]:
    """Lines in blocks of about 1 MiB, with the number of the first one."""
    carry = b""
    line_number = 1
    total = 0
    ended = False
    while not ended:
        data = next(blocks, b"")
        total += len(data)
        if limit is not None and total > limit:
            raise LogError(f"{path}: expands to more than {limit >> 20} MiB, too much for a log of its size")
        ended = not data
        text = carry + data
        # the last line is complete only once its end was seen; a lone "\r" may be half of "\r\n"
        end = len(text) if ended else max(text.rfind(b"\n"), text.rfind(b"\r", 0, len(text) - 1)) + 1
        carry = text[end:]
        lines = text[:end].splitlines()
        if len(carry) > LINE_LIMIT:
            raise LogError(
                f"{path}: line {line_number + len(lines)} is longer than 1 MiB; expected a text table"
            )
        if lines and ended and text[-1:] not in (b"\n", b"\r"):
            last = line_number + len(lines) - 1
            if tally.cut:
                tally.add(CUT_LINE, [last])
                lines.pop()
            else:
                tally.note(f"the last line ({last}) has no line end; it may be cut short")
        if lines:
            yield line_number, [line.decode("utf-8", errors="replace") for line in lines]
            line_number += len(lines)


class _Table:
    """One pass over the lines; the arrays grow block by block."""

    def __init__(self, path: Path, columns: ColumnMap | None, tally: Tally, keep_invalid: bool) -> None:
        self.path = path
        self.columns = columns
        self.tally = tally
        self.keep_invalid = keep_invalid
        self.layout: Layout | None = None
        self.delimiter = ","
        self.width = 0
        self.rows = 0
        self.used: list[int] = []
        self.times: list[IntArray] = []
        self.values: list[FloatArray] = []
        self.garbage: list[BoolArray] = []
        self.places: list[IntArray] = []

    def read(self, blocks: Iterator[tuple[int, list[str]]]) -> Log:
        for first, lines in blocks:
            numbers = np.arange(first, first + len(lines), dtype=np.int64)
            keep = [k for k, line in enumerate(lines) if line.strip()]
            if self.layout is None:
                if not keep:
                    continue
                keep = keep[self._begin([lines[k] for k in keep]) :]
            keep = [k for k in keep if not lines[k].startswith("#")]
            self._add([lines[k] for k in keep], numbers[keep])
        if self.rows == 0 or self.layout is None:
            raise LogError("; ".join([f"{self.path}: no rows of numbers", *self.tally.notes]))
        return self._log(self.layout)

    def _begin(self, lines: list[str]) -> int:
        """Find out delimiter, header and layout from the first lines; return how many of them are no data."""
        columns = self.columns
        lines[0] = lines[0].removeprefix("\ufeff")
        skip = next((k for k, line in enumerate(lines) if not line.startswith("#")), None)
        if skip is None:
            raise LogError(f"{self.path}: only comments, no rows of numbers")
        if columns is not None and columns.delimiter is not None:
            self.delimiter = columns.delimiter
        else:
            counts = {d: lines[skip].count(d) for d in (",", ";", "\t")}
            best = max(counts, key=lambda d: counts[d])
            self.delimiter = best if counts[best] else " "
        first = self._cells(lines[skip])
        title = self._cells(lines[skip - 1].lstrip("# \t")) if skip else []  # a comment may be the header
        declared = columns.header if columns is not None else None
        # a damaged row has a bad cell or two, a header consists of names
        words = sum(number(cell) is None for cell in first)
        header = None
        if declared or (declared is None and 2 * words > len(first)):
            header, skip = first, skip + 1
        elif declared is None and len(title) == len(first):
            header = title
        sample = [cells for line in lines[skip : skip + 200] if (cells := self._cells(line))]
        self.width = Counter(map(len, sample)).most_common(1)[0][0] if sample else len(first)
        if header is not None and self.width != len(header):
            ends = {cells[-1].strip() for cells in sample if len(cells) == self.width}
            # a delimiter behind the last value does no harm
            if self.width != len(header) + 1 or ends != {""}:
                raise LogError(
                    f"{self.path}: the header names {len(header)} columns, but the rows have {self.width} "
                    f"(separated by {self.delimiter!r})"
                )
        if header is not None:
            header = [cell.strip() for cell in header]
        if columns is None:
            columns = self.columns = conventional(header, str(self.path))
        layout = self.layout = resolve(columns, header, self.width, str(self.path))
        groups = [*layout.fields.values(), *(indices for indices, *_ in layout.signals.values())]
        self.used = [i for group in groups for i in group]
        return skip

    def _cells(self, line: str) -> list[str]:
        if self.delimiter == " ":
            return line.split()
        if '"' in line:
            try:
                return next(csv.reader([line], delimiter=self.delimiter), [])
            except csv.Error:
                return []
        return line.split(self.delimiter)

    def _add(self, lines: list[str], places: IntArray) -> None:
        """Parse a block of rows; ``places`` are their line numbers."""
        index = np.arange(self.rows, self.rows + len(lines), dtype=np.int64)
        self.rows += len(lines)
        slow = self.delimiter == " " or any('"' in line for line in lines)
        rows = [self._cells(line) for line in lines] if slow else []
        counts = map(len, rows) if slow else (line.count(self.delimiter) + 1 for line in lines)
        fits = np.fromiter((count == self.width for count in counts), dtype=bool, count=len(lines))
        if not fits.all():
            self.tally.add(WRONG_COLUMNS, places[~fits].tolist())
            keep = np.flatnonzero(fits).tolist()
            lines, rows = [lines[k] for k in keep], [rows[k] for k in keep] if slow else []
            places, index = places[fits], index[fits]
        if not lines:
            return
        times = self._times(lines, rows, index)
        values, garbage = self._parse_cells(rows) if slow else self._parse(lines)
        good = np.array([t is not None for t in times], dtype=bool)
        self.tally.add(BAD_TIME, places[~good].tolist())
        self.times.append(np.array([t for t in times if t is not None], dtype=np.int64))
        self.values.append(values[good])
        self.garbage.append(garbage[good])
        self.places.append(places[good])

    def _times(self, lines: list[str], rows: list[list[str]], index: IntArray) -> Sequence[int | None]:
        assert self.layout is not None
        assert self.columns is not None
        column = self.layout.time
        if column is None:
            period_ns = (self.columns.period or 0.0) * 1e9
            return [t if (t := round(k * period_ns)) < TIME_LIMIT_NS else None for k in index.tolist()]
        exponent = TIME_UNITS[self.columns.time_unit]
        if rows:
            return [exact_ns(row[column], exponent) for row in rows]
        delimiter = self.delimiter
        return [exact_ns(line.split(delimiter, column + 1)[column], exponent) for line in lines]

    def _parse(self, lines: list[str]) -> tuple[FloatArray, BoolArray]:
        """Values (R,c) of the used columns; cells that are no number are NaN and marked."""
        try:
            values = np.loadtxt(lines, delimiter=self.delimiter, usecols=self.used, comments=None, ndmin=2)
        except ValueError:
            if len(lines) > _BISECT_STOP:
                middle = len(lines) // 2
                a, b = self._parse(lines[:middle]), self._parse(lines[middle:])
                return np.concatenate((a[0], b[0])), np.concatenate((a[1], b[1]))
            return self._parse_cells([self._cells(line) for line in lines])
        return values, np.zeros(values.shape, dtype=bool)

    def _parse_cells(self, rows: list[list[str]]) -> tuple[FloatArray, BoolArray]:
        shape = (len(rows), len(self.used))
        cells = [number(row[i]) for row in rows for i in self.used]
        garbage = np.array([cell is None for cell in cells], dtype=bool).reshape(shape)
        values = np.array([np.nan if cell is None else cell for cell in cells], dtype=np.float64).reshape(
            shape
        )
        return values, garbage

    def _log(self, layout: Layout) -> Log:
        assert self.columns is not None
        time_ns = np.concatenate(self.times) if self.times else np.empty(0, dtype=np.int64)
        require_rows(str(self.path), self.rows, len(time_ns), self.tally)
        values, garbage = np.concatenate(self.values), np.concatenate(self.garbage)
        places = np.concatenate(self.places)
        scales = self.columns.scales()
        fields: dict[str, FloatArray] = {}
        column = 0
        for name, indices in layout.fields.items():
            fields[name] = scaled(values[:, column : column + len(indices)], scales[name])
            column += len(indices)
        keep = screen(
            fields,
            places,
            self.tally,
            keep_invalid=self.keep_invalid,
            garbage=garbage[:, :column].any(axis=1),
        )
        require_rows(str(self.path), self.rows, int(keep.sum()), self.tally)
        time_ns, places = time_ns[keep], places[keep]
        signals = {}
        for name, (indices, vector, unit, scale) in layout.signals.items():
            value = scaled(values[keep, column : column + len(indices)], scale)
            column += len(indices)
            value = value if vector else value[:, 0]
            if self.keep_invalid:
                signals[name] = Signal(time_ns, value, unit)
            else:
                good = screen_signal(name, value, places, self.tally)
                signals[name] = Signal(time_ns[good], value[good], unit)
        return Log(
            time_ns=time_ns,
            joint_names=layout.joint_names,
            signals=signals,
            meta=effort_meta(self.columns, fields),
            repair=self.tally.report(self.rows, time_ns),
            **joint_arrays({name: value[keep] for name, value in fields.items()}),
        )


def scaled(values: FloatArray, scale: float) -> FloatArray:
    """``values * scale``, untouched for a scale of 1."""
    if scale == 1.0:
        return values
    with np.errstate(over="ignore"):  # an absurd value may become infinite; it is caught as either
        return values * scale


def effort_meta(columns: ColumnMap, fields: Mapping[str, FloatArray]) -> dict[str, str]:
    """The ``meta`` entry that says which unit the effort has."""
    unit = columns.effort_base_unit
    return {"effort_unit": unit} if unit is not None and "effort" in fields else {}


def joint_arrays(fields: dict[str, FloatArray]) -> dict[str, Any]:
    """The quantities of a ``Log``; an effort that was not recorded is NaN."""
    return {"effort": np.full(fields["position"].shape, np.nan)} | fields
