"""MCAP files: written so that a killed process leaves a readable file, read as far as they are readable.

Format: https://mcap.dev/spec (version 0). A file is a magic, a row of records (opcode, 64-bit length,
content) and the magic again. Messages lie in chunks, each with a checksum and an index; a summary at the end
repeats channels and chunk positions. Chunks are written whole, so whatever a killed recorder has handed to
the operating system can be read from the front, without the summary.

Own code rather than a library's because libraries read a file without summary not at all, sort messages by
log time (which hides a clock that runs backwards), and write no checksums.
"""

from __future__ import annotations

import struct
import sys
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from palpate.errors import LogError, MissingExtraError
from palpate.logs.messages import Definition

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(1, 9)
STATISTICS, METADATA, METADATA_INDEX, SUMMARY_OFFSET, DATA_END = range(0x0B, 0x10)
CHUNK_LIMIT = 256 << 20  # [bytes] uncompressed; writers use 1 to 4 MiB
RECORD_LIMIT = 1 << 30  # [bytes]; a longer one is a damaged length
_PROBLEMS_KEPT = 8

_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_MESSAGE_RECORD = struct.Struct("<BQHIQQ")
_CHUNK = struct.Struct("<QQQI")
_INDEX_ENTRY = np.dtype([("time", "<u8"), ("offset", "<u8")])


class Channel(NamedTuple):
    """One topic of a bag."""

    topic: str
    type: str
    encoding: str  #: of the messages, ``cdr`` for ROS 2


class Message(NamedTuple):
    """One message of a bag, not decoded."""

    channel: Channel
    log_time: int  #: [ns]
    data: bytes


# -- reading -------------------------------------------------------------------------------------------


class _Fields:
    """The content of a record, field by field."""

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.at = 0

    def take(self, layout: str) -> tuple[int, ...]:
        values = struct.unpack_from(layout, self.data, self.at)
        self.at += struct.calcsize(layout)
        return values

    def raw(self, layout: str = "<I") -> bytes:
        (length,) = self.take(layout)
        if length > len(self.data) - self.at:
            raise ValueError(f"a field of {length} bytes in {len(self.data) - self.at}")
        self.at += length
        return self.data[self.at - length : self.at]

    def text(self) -> str:
        return self.raw().decode()


#: what a damaged record makes the parser raise
_DAMAGE = (struct.error, ValueError)


class McapReader:
    """Messages of an MCAP file in file order, with a record of what could not be read.

    Attributes:
        problems: sentences about damage found so far; empty for a sound file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.problems: list[str] = []
        self.size = path.stat().st_size
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, Channel] = {}
        self._chunk_starts: list[int] = []
        self._expected: int | None = None
        self._read = 0

    def messages(self) -> Iterator[Message]:
        """Iterate over the messages.

        Raises:
            LogError: not an MCAP file.
            MissingExtraError: a chunk is compressed and ``palpate[logs]`` is not installed.
        """
        with self.path.open("rb") as file:
            if file.read(len(MAGIC)) != MAGIC:
                raise LogError(f"{self.path}: not an MCAP file (or its first bytes are damaged)")
            try:
                self._summary(file)
            except _DAMAGE:
                # the summary only repeats; what it would have said is found on the way
                self._chunk_starts, self._expected = [], None
            yield from self._walk(file)
        if self._expected is not None and self._read != self._expected:
            self.problems.append(f"{self._read} of {self._expected} messages could be read")
        elif self._expected is None and self.problems:
            self.problems.append(f"{self._read} messages could be read")

    def _summary(self, file: BinaryIO) -> None:
        """Learn channels and chunk positions from the end of the file, if it has one."""
        tail = 9 + 20 + len(MAGIC)
        file.seek(max(self.size - tail, len(MAGIC)))
        footer = file.read()
        if len(footer) != tail or footer[-8:] != MAGIC or _RECORD.unpack_from(footer) != (FOOTER, 20):
            self._problem("the file has no end: the recording was interrupted or the file cut")
            return
        start, _, checksum = struct.unpack_from("<QQI", footer, 9)
        if not len(MAGIC) <= start <= self.size - tail or self.size - start > RECORD_LIMIT:
            return
        file.seek(start)
        summary = file.read(self.size - tail - start)
        if checksum and zlib.crc32(summary + footer[:25]) != checksum:
            self._problem("the summary at the end of the file is damaged")
            return
        at = 0
        while at + 9 <= len(summary):
            opcode, length = _RECORD.unpack_from(summary, at)
            fields = _Fields(summary[at + 9 : at + 9 + length])
            at += 9 + length
            if opcode in (SCHEMA, CHANNEL):
                self._learn(opcode, fields)
            elif opcode == CHUNK_INDEX:
                self._chunk_starts.append(fields.take("<QQQ")[2])
            elif opcode == STATISTICS:
                self._expected = fields.take("<Q")[0]
        self._chunk_starts.sort()

    def _walk(self, file: BinaryIO) -> Iterator[Message]:
        position: int | None = len(MAGIC)
        while position is not None:
            file.seek(position)
            head = file.read(9)
            if len(head) < 9:
                if head:
                    self._problem(f"the file ends in the middle of a record, at byte {position}")
                return
            opcode, length = _RECORD.unpack(head)
            there = min(length, self.size - position - 9)
            following: int | None = position + 9 + length
            try:
                if opcode in (DATA_END, FOOTER) and not self._next_chunk(position):
                    return
                if opcode in (0, DATA_END, FOOTER) or length > RECORD_LIMIT:
                    there, following = 0, None
                    raise ValueError(f"a record with opcode {opcode} and {length} bytes")
                if opcode == CHUNK:
                    yield from self._chunk(file.read(there), position, cut=there < length)
                if there < length:
                    following = None
                    if opcode != CHUNK:
                        raise ValueError(f"a record of {length} bytes, {there} of them there")
                elif opcode == MESSAGE:
                    if message := self._message(file.read(length), 0, length):
                        yield message
                elif opcode in (SCHEMA, CHANNEL):
                    self._learn(opcode, _Fields(file.read(length)))
            except _DAMAGE as error:
                self._problem(f"damaged at byte {position} of {self.size}: {error}")
                following = self._next_chunk(position) if self._chunk_starts else following
            position = following

    def _next_chunk(self, position: int) -> int | None:
        return next((start for start in self._chunk_starts if start > position), None)

    def _problem(self, text: str) -> None:
        if len(self.problems) < _PROBLEMS_KEPT:
            self.problems.append(text)

    def _chunk(self, body: bytes, position: int, *, cut: bool) -> Iterator[Message]:
        """Messages of a chunk; of one that is cut, those that are whole."""
        fields = _Fields(body)
        _, _, size, checksum = fields.take("<QQQI")
        compression = fields.text()
        (stored,) = fields.take("<Q")
        data = body[fields.at : fields.at + stored]
        if len(data) < stored and not cut:
            raise ValueError(f"a chunk of {stored} bytes, {len(data)} of them there")
        if size > CHUNK_LIMIT:
            raise ValueError(f"a chunk of {size} bytes; expected at most {CHUNK_LIMIT}")
        if compression:
            data = decompress(data, compression, size, str(self.path))
        if cut:
            self._problem(f"the chunk at byte {position} is cut short")
        elif len(data) != size or (checksum and zlib.crc32(data) != checksum):
            raise ValueError("a chunk whose checksum is wrong; it is left out")
        at = 0
        while at + 9 <= len(data):
            opcode, length = _RECORD.unpack_from(data, at)
            at += 9
            if at + length > len(data):
                if cut:
                    return
                raise ValueError(f"a record of {length} bytes in a chunk with {len(data) - at} left")
            if opcode == MESSAGE:
                if message := self._message(data, at, length):
                    yield message
            elif opcode in (SCHEMA, CHANNEL):
                self._learn(opcode, _Fields(data[at : at + length]))
            at += length

    def _message(self, data: bytes, at: int, length: int) -> Message | None:
        if length < _MESSAGE.size:
            raise ValueError(f"a message record of {length} bytes")
        channel_id, _, log_time, _ = _MESSAGE.unpack_from(data, at)
        channel = self._channels.get(channel_id)
        if channel is None:
            raise ValueError(f"a message of the unknown channel {channel_id}")
        self._read += 1
        return Message(channel, log_time, data[at + _MESSAGE.size : at + length])

    def _learn(self, opcode: int, fields: _Fields) -> None:
        if opcode == SCHEMA:
            (number,) = fields.take("<H")
            self._schemas[number] = fields.text()
        else:
            number, schema = fields.take("<HH")
            topic, encoding = fields.text(), fields.text()
            self._channels[number] = Channel(topic, self._schemas.get(schema, ""), encoding)


def decompress(data: bytes, compression: str, limit: int, where: str) -> bytes:
    """Undo ``lz4`` or ``zstd`` compression; of cut data, as much as there is, never more than ``limit``
    bytes.

    Raises:
        ValueError: damaged data or another compression.
        MissingExtraError: ``palpate[logs]`` is not installed.
    """
    if compression not in ("lz4", "zstd"):
        raise ValueError(f"compression {compression!r}; expected lz4, zstd or none")
    errors: tuple[type[Exception], ...] = (EOFError, MemoryError)
    try:
        if compression == "lz4":
            from lz4.frame import LZ4FrameDecompressor

            decompressor, errors = LZ4FrameDecompressor(), (*errors, RuntimeError)
        else:
            zstd = zstd_module()
            decompressor, errors = zstd.ZstdDecompressor(), (*errors, zstd.ZstdError)
    except ImportError:
        raise MissingExtraError("logs", f"reading {where}, which is compressed with {compression},") from None
    try:
        found: bytes = decompressor.decompress(data, limit)
    except errors as error:
        raise ValueError(f"damaged {compression} data ({error})") from None
    return found


def zstd_module() -> Any:
    """Python's zstd module: its own from 3.14 on, before that the backport that rosbags brings."""
    if sys.version_info >= (3, 14):
        from compression import zstd
    else:
        from backports import zstd
    return zstd


# -- writing -------------------------------------------------------------------------------------------


class McapWriter:
    """Writes an MCAP file chunk by chunk.

    Args:
        path: file to create.
        library: name of the writing program, stored in the file.
        overwrite: replace an existing file.
        chunk_bytes: size at which a chunk is written out by itself; one damaged bit costs the whole chunk.
    """

    storage = "mcap"

    def __init__(
        self, path: Path, library: str, *, overwrite: bool = False, chunk_bytes: int = 256 << 10
    ) -> None:
        self.path = path
        self.topics: list[tuple[str, str, Definition]] = []
        self.counts: list[int] = []
        self.span: tuple[int, int] | None = None  #: earliest and latest log time [ns]
        self._chunk_bytes = chunk_bytes
        self._schemas: dict[str, bytes] = {}
        self._channels: list[bytes] = []
        self._parts: list[bytes] = []
        self._size = 0
        self._index: list[list[int]] = []
        self._chunk_indices: list[bytes] = []
        self._file = path.open("wb" if overwrite else "xb", buffering=0)
        self._at = 0
        self._write(MAGIC + _record(HEADER, _string("ros2") + _string(library)))

    def add_channel(self, topic: str, type_name: str, definition: Definition) -> int:
        """Announce a topic; returns its number for ``write``."""
        if type_name not in self._schemas:
            body = struct.pack("<H", len(self._schemas) + 1) + _string(type_name) + _string("ros2msg")
            self._schemas[type_name] = _record(SCHEMA, body + _string(definition.text))
            self._append(self._schemas[type_name])
        number = len(self.topics)  # in the file, channels count from 1
        schema = list(self._schemas).index(type_name) + 1
        extra = _map({"offered_qos_profiles": "", "topic_type_hash": definition.hash})
        body = struct.pack("<HH", number + 1, schema) + _string(topic) + _string("cdr") + extra
        self._channels.append(_record(CHANNEL, body))
        self._append(self._channels[-1])
        self.topics.append((topic, type_name, definition))
        self.counts.append(0)
        self._index.append([])
        return number

    def write(self, channel: int, time_ns: int, data: bytes) -> None:
        """Append a message; it reaches the operating system with the next ``flush``."""
        head = _MESSAGE_RECORD.pack(
            MESSAGE,
            _MESSAGE.size + len(data),
            channel + 1,
            self.counts[channel] & 0xFFFFFFFF,
            time_ns,
            time_ns,
        )
        self.counts[channel] += 1
        self._index[channel] += (time_ns, self._size)
        self._parts += (head, data)
        self._size += len(head) + len(data)
        if self._size > self._chunk_bytes:
            self.flush()

    def flush(self) -> None:
        """Write what is pending as one chunk. From then on a killed process does not lose it."""
        if not self._parts:
            return
        records = b"".join(self._parts)
        entries = {number: _by_time(flat) for number, flat in enumerate(self._index) if flat}
        first = min((int(e["time"][0]) for e in entries.values()), default=0)
        last = max((int(e["time"][-1]) for e in entries.values()), default=0)
        if entries:
            self.span = (
                (first, last) if self.span is None else (min(first, self.span[0]), max(last, self.span[1]))
            )
        head = _CHUNK.pack(first, last, len(records), zlib.crc32(records)) + _string("")
        chunk = _record(CHUNK, head + struct.pack("<Q", len(records)) + records)
        start = self._at
        offsets = b""
        indices = b""
        for number, entry in entries.items():
            offsets += struct.pack("<HQ", number + 1, start + len(chunk) + len(indices))
            body = struct.pack("<HI", number + 1, entry.nbytes) + entry.tobytes()
            indices += _record(MESSAGE_INDEX, body)
        self._chunk_indices.append(
            _record(
                CHUNK_INDEX,
                struct.pack("<QQQQI", first, last, start, len(chunk), len(offsets))
                + offsets
                + struct.pack("<Q", len(indices))
                + _string("")
                + struct.pack("<QQ", len(records), len(records)),
            )
        )
        self._parts, self._size = [], 0
        self._index = [[] for _ in self._index]
        self._write(chunk + indices)

    def close(self) -> None:
        """Write the rest and the summary."""
        self.flush()
        self._write(_record(DATA_END, bytes(4)))
        start = self._at
        groups = (
            (SCHEMA, list(self._schemas.values())),
            (CHANNEL, self._channels),
            (CHUNK_INDEX, self._chunk_indices),
            (STATISTICS, [_record(STATISTICS, self._statistics())]),
        )
        summary, offsets = b"", b""
        for opcode, records in groups:
            if records:
                group = b"".join(records)
                offsets += _record(
                    SUMMARY_OFFSET, struct.pack("<BQQ", opcode, start + len(summary), len(group))
                )
                summary += group
        footer = _RECORD.pack(FOOTER, 20) + struct.pack("<QQ", start, start + len(summary))
        checksum = zlib.crc32(summary + offsets + footer)
        self._write(summary + offsets + footer + struct.pack("<I", checksum) + MAGIC)
        self._file.close()

    def abandon(self) -> None:
        """Close the file without another byte."""
        self._file.close()

    def _statistics(self) -> bytes:
        counts = b"".join(struct.pack("<HQ", number, count) for number, count in enumerate(self.counts, 1))
        return (
            struct.pack(
                "<QHIIII",
                sum(self.counts),
                len(self._schemas),
                len(self.topics),
                0,
                0,
                len(self._chunk_indices),
            )
            + struct.pack("<QQI", *(self.span or (0, 0)), len(counts))
            + counts
        )

    def _append(self, record: bytes) -> None:
        self._parts.append(record)
        self._size += len(record)

    def _write(self, data: bytes) -> None:
        view = memoryview(data)
        while view:
            view = view[self._file.write(view) :]
        self._at += len(data)


def _by_time(flat: list[int]) -> Any:
    """Index entries of one channel; readers search them by time."""
    entries = np.array(flat, dtype="<u8").view(_INDEX_ENTRY)
    return entries[np.argsort(entries["time"], kind="stable")]


def _record(opcode: int, body: bytes) -> bytes:
    return _RECORD.pack(opcode, len(body)) + body


def _string(text: str) -> bytes:
    raw = text.encode()
    return struct.pack("<I", len(raw)) + raw


def _map(texts: Mapping[str, str]) -> bytes:
    body = b"".join(_string(key) + _string(value) for key, value in texts.items())
    return struct.pack("<I", len(body)) + body
