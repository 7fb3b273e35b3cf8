"""The standard ROS 2 messages that a log is made of, as bytes.

Everything palpate records has one of the standard types below, so that ``ros2 bag``, PlotJuggler and Foxglove
show it without palpate. Bytes follow the OMG CDR encoding version 1 (DDS-XTypes 1.3, section 7.4.3): a 4-byte
header whose second byte is 1 for little endian, then the fields, each aligned to its own size counted from
behind the header. Definitions and hashes (REP-2016) are the same from Humble to Kilted.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

JOINT_STATE = "sensor_msgs/msg/JointState"
FLOAT64 = "std_msgs/msg/Float64"
FLOAT64_ARRAY = "std_msgs/msg/Float64MultiArray"
FLOAT32_ARRAY = "std_msgs/msg/Float32MultiArray"
STRING = "std_msgs/msg/String"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"

_SECOND = 1_000_000_000  # [ns]
#: ``header.stamp`` counts seconds in an int32 and the log time of a bag is unsigned: recordings lie in 0 ..
#: this [ns].
STAMP_LIMIT_NS = 2**31 * _SECOND

_LITTLE = b"\x00\x01\x00\x00"
_U32 = struct.Struct("<I")
_STAMP = struct.Struct("<iI")


class CdrError(ValueError):
    """The bytes are not the message they should be."""


class Definition(NamedTuple):
    """Text and REP-2016 hash of a message type, as bags store them."""

    text: str
    hash: str


_RULE = "=" * 80 + "\n"
_HEADER_TEXT = (
    _RULE
    + "MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
    + _RULE
    + "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
)
DEFINITIONS = {
    JOINT_STATE: Definition(
        "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n"
        + _HEADER_TEXT,
        "RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e",
    ),
    FLOAT64: Definition(
        "float64 data\n", "RIHS01_705ba9c3d1a09df43737eb67095534de36fd426c0587779bda2bc51fe790182a"
    ),
    FLOAT64_ARRAY: Definition(
        "std_msgs/MultiArrayLayout layout\nfloat64[] data\n"
        + _RULE
        + "MSG: std_msgs/MultiArrayLayout\nstd_msgs/MultiArrayDimension[] dim\nuint32 data_offset\n"
        + _RULE
        + "MSG: std_msgs/MultiArrayDimension\nstring label\nuint32 size\nuint32 stride\n",
        "RIHS01_1025ddc6b9552d191f89ef1a8d2f60f3d373e28b283d8891ddcc974e8c55397f",
    ),
    STRING: Definition(
        "string data\n", "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
    ),
    DIAGNOSTICS: Definition(
        "std_msgs/Header header\ndiagnostic_msgs/DiagnosticStatus[] status\n"
        + _HEADER_TEXT
        + _RULE
        + "MSG: diagnostic_msgs/DiagnosticStatus\n"
        "byte OK=0\nbyte WARN=1\nbyte ERROR=2\nbyte STALE=3\nbyte level\n"
        "string name\nstring message\nstring hardware_id\ndiagnostic_msgs/KeyValue[] values\n"
        + _RULE
        + "MSG: diagnostic_msgs/KeyValue\nstring key\nstring value\n",
        "RIHS01_5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e",
    ),
}


class Numbers(NamedTuple):
    """A message that is nothing but numbers of one kind, perhaps behind a ``std_msgs/Header``."""

    stamped: bool
    length: int
    code: str  #: of the ``struct`` module
    unit: str


def _plain_numbers() -> dict[str, Numbers]:
    kinds = {
        "Float64": "d",
        "Float32": "f",
        "Int64": "q",
        "Int32": "i",
        "Int16": "h",
        "Int8": "b",
        "UInt64": "Q",
        "UInt32": "I",
        "UInt16": "H",
        "UInt8": "B",
        "Bool": "B",
    }
    found = {f"std_msgs/msg/{name}": Numbers(False, 1, code, "") for name, code in kinds.items()}
    for name, count, unit in (
        ("Wrench", 6, "N, N m"),
        ("Twist", 6, "m/s, rad/s"),
        ("Accel", 6, "m/s^2, rad/s^2"),
        ("Pose", 7, "m, 1"),
        ("Point", 3, "m"),
        ("Vector3", 3, ""),
        ("Quaternion", 4, "1"),
    ):
        found[f"geometry_msgs/msg/{name}"] = Numbers(False, count, "d", unit)
        found[f"geometry_msgs/msg/{name}Stamped"] = Numbers(True, count, "d", unit)
    return found


#: Types that become signals, by name. Components in the order of the definition: a wrench is fx fy fz tx ty
#: tz, a pose px py pz qx qy qz qw.
NUMBERS = _plain_numbers()


class JointState(NamedTuple):
    """A decoded ``sensor_msgs/msg/JointState``; arrays are little-endian doubles, empty or one per name."""

    time_ns: int
    names: tuple[str, ...]
    position: bytes
    velocity: bytes
    effort: bytes


class _Cursor:
    """Reads fields one after the other and refuses to read past the end."""

    def __init__(self, data: bytes) -> None:
        if len(data) < 4 or data[0] != 0 or data[1] > 1:
            raise CdrError(f"unknown CDR encoding {data[:2].hex() or '(empty)'}; expected 0000 or 0001")
        self.data = data
        self.endian = "<" if data[1] else ">"
        self.at = 4

    def align(self, size: int) -> None:
        self.at += -(self.at - 4) % size

    def raw(self, count: int) -> bytes:
        end = self.at + count
        if end > len(self.data):
            raise CdrError(f"message of {len(self.data)} bytes ends in a field of {count} bytes")
        found = self.data[self.at : end]
        self.at = end
        return found

    def unpack(self, code: str, size: int) -> int:
        self.align(size)
        value: int = struct.unpack(self.endian + code, self.raw(size))[0]
        return value

    def u32(self) -> int:
        return self.unpack("I", 4)

    def stamp(self) -> int:
        sec, nanosec = self.unpack("i", 4), self.u32()
        if nanosec >= _SECOND:
            raise CdrError(f"a time stamp has {nanosec} ns; expected less than 1e9")
        return sec * _SECOND + nanosec

    def text(self) -> str:
        raw = self.raw(self.u32())
        try:
            return raw.removesuffix(b"\0").decode()
        except UnicodeDecodeError as error:
            raise CdrError(f"text is not UTF-8: {error}") from None

    def numbers(self, count: int, code: str) -> bytes:
        """``count`` numbers as little-endian doubles."""
        size = struct.calcsize(code)
        if count == 0:
            return b""
        self.align(size)
        raw = self.raw(count * size)
        if code == "d" and self.endian == "<":
            return raw
        with np.errstate(invalid="ignore"):  # a signalling NaN of 32 bit
            return np.frombuffer(raw, dtype=self.endian + code).astype("<f8").tobytes()


def decode_text(data: bytes) -> str:
    """``std_msgs/msg/String``.

    Raises:
        CdrError: other bytes.
    """
    return _Cursor(data).text()


def decode_numbers(data: bytes, layout: Numbers) -> tuple[int | None, bytes]:
    """One of ``NUMBERS``: its stamp [ns] (None without a header) and its values as little-endian doubles.

    Raises:
        CdrError: other bytes.
    """
    cursor = _Cursor(data)
    time_ns = None
    if layout.stamped:
        time_ns = cursor.stamp()
        cursor.text()
    return time_ns, cursor.numbers(layout.length, layout.code)


def decode_array(data: bytes, code: str) -> bytes:
    """``std_msgs/msg/Float64MultiArray`` (code d) or ``Float32MultiArray`` (code f): its values, the layout
    left aside.

    Raises:
        CdrError: other bytes.
    """
    cursor = _Cursor(data)
    for _ in range(cursor.u32()):
        cursor.text()
        cursor.u32()
        cursor.u32()
    cursor.u32()
    return cursor.numbers(cursor.u32(), code)


def decode_diagnostics(data: bytes) -> tuple[int, list[tuple[str, int, str, dict[str, str]]]]:
    """``diagnostic_msgs/msg/DiagnosticArray``: its stamp [ns] and (name, level, message, values) of every
    status.

    Raises:
        CdrError: other bytes.
    """
    cursor = _Cursor(data)
    time_ns = cursor.stamp()
    cursor.text()
    found = []
    for _ in range(cursor.u32()):
        level, name, message = cursor.unpack("B", 1), cursor.text(), cursor.text()
        cursor.text()
        found.append((name, level, message, {cursor.text(): cursor.text() for _ in range(cursor.u32())}))
    return time_ns, found


class JointStateDecoder:
    """Decodes ``sensor_msgs/msg/JointState``; names are parsed once, a publisher repeats them."""

    def __init__(self) -> None:
        self._block = b"?"
        self._names: tuple[str, ...] = ()

    def decode(self, data: bytes) -> JointState:
        """Decode one message.

        Raises:
            CdrError: other bytes, or arrays that are neither empty nor as long as the names.
        """
        cursor = _Cursor(data)
        time_ns = cursor.stamp()
        if cursor.endian == "<" and data.startswith(self._block, cursor.at):
            cursor.at += len(self._block)
            names = self._names
        else:
            start = cursor.at
            cursor.text()
            names = tuple(cursor.text() for _ in range(cursor.u32()))
            if cursor.endian == "<":
                self._block, self._names = data[start : cursor.at], names
        arrays = []
        for what in ("positions", "velocities", "efforts"):
            count = cursor.u32()
            if count and count != len(names):
                raise CdrError(f"{count} {what} for {len(names)} joint names")
            arrays.append(cursor.numbers(count, "d"))
        return JointState(time_ns, names, *arrays)


def encode_text(text: str) -> bytes:
    """``std_msgs/msg/String``."""
    return _LITTLE + _text(text)


def encode_number(value: bytes) -> bytes:
    """``std_msgs/msg/Float64`` of one little-endian double."""
    return _LITTLE + value


def encode_array(values: bytes, unit: str) -> bytes:
    """``std_msgs/msg/Float64MultiArray`` of little-endian doubles; the label of its dimension is the unit."""
    count = len(values) // 8
    body = bytearray(_U32.pack(1) + _text(unit))
    _pad(body, 4)
    body += struct.pack("<IIII", count, count, 0, count)
    if count:
        _pad(body, 8)
        body += values
    return _LITTLE + bytes(body)


def encode_diagnostics(time_ns: int, states: Sequence[tuple[str, int, str, int]], source: str) -> bytes:
    """``diagnostic_msgs/msg/DiagnosticArray`` from (name, level, message, code) of every status.

    The code goes into the values too, as ``code``: PlotJuggler draws numeric values over time.
    """
    body = bytearray(_STAMP.pack(*divmod(time_ns, _SECOND)) + _text(""))
    _pad(body, 4)
    body += _U32.pack(len(states))
    for name, level, message, code in states:
        body.append(level)
        for text in (name, message, source):
            _pad(body, 4)
            body += _text(text)
        _pad(body, 4)
        body += _U32.pack(1)
        for text in ("code", str(code)):
            _pad(body, 4)
            body += _text(text)
    return _LITTLE + bytes(body)


class JointStateEncoder:
    """Encodes ``sensor_msgs/msg/JointState`` for fixed names; all but stamp and numbers is laid out once."""

    def __init__(self, names: Sequence[str], frame_id: str = "") -> None:
        block = bytearray(8) + _text(frame_id)  # 8 bytes stand for the stamp
        _pad(block, 4)
        block += _U32.pack(len(names))
        for name in names:
            _pad(block, 4)
            block += _text(name)
        _pad(block, 4)
        n = len(names)
        self._block = bytes(block[8:])
        # an array of n doubles starts with its length and is aligned to 8; an empty one is its length alone
        self._full = {phase: _U32.pack(n) + bytes(-(phase + 4) % 8) for phase in (0, 4)}
        self._phase = len(block) % 8

    def encode(self, time_ns: int, position: bytes, velocity: bytes, effort: bytes) -> bytes:
        """Encode one message; each array is n little-endian doubles or empty."""
        parts = [_LITTLE, _STAMP.pack(*divmod(time_ns, _SECOND)), self._block]
        phase = self._phase
        for values in (position, velocity, effort):
            if values:
                parts += (self._full[phase], values)
                phase = 0
            else:
                parts.append(b"\0\0\0\0")
                phase = (phase + 4) % 8
        return b"".join(parts)


def _text(text: str) -> bytes:
    raw = text.encode("utf-8", "backslashreplace") + b"\0"
    return _U32.pack(len(raw)) + raw


def _pad(body: bytearray, size: int) -> None:
    body += bytes(-len(body) % size)
