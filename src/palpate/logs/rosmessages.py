"""Any ROS 2 message from plain Python values, with rosbags' knowledge of the standard types."""

from __future__ import annotations

import difflib
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np

from palpate.errors import InputError, MissingExtraError
from palpate.logs.messages import Definition

_HEADER = "std_msgs/msg/Header"
_DTYPES = {"byte": "uint8", "octet": "uint8", "char": "uint8"}


class MessageTypes:
    """The standard message types of ROS 2.

    Raises:
        MissingExtraError: ``palpate[logs]`` is not installed.
    """

    def __init__(self) -> None:
        try:
            from rosbags.interfaces import Nodetype
            from rosbags.serde import SerdeError
            from rosbags.typesys import Stores, get_typestore
            from rosbags.typesys.base import normalize_fieldname
        except ImportError:
            raise MissingExtraError("logs", "recording a message of any type") from None
        self._store = get_typestore(Stores.LATEST)
        self._kind = Nodetype
        self._normalize = normalize_fieldname
        self._errors = (SerdeError, struct.error, TypeError, ValueError, OverflowError, AttributeError)

    def definition(self, type_name: str) -> Definition:
        """Text and hash of a type that ``encode`` accepted."""
        text, _ = self._store.generate_msgdef(type_name, ros_version=2)
        return Definition(text, self._store.hash_rihs01(type_name))

    def encode(self, type_name: str, time_ns: int, fields: Mapping[str, Any]) -> bytes:
        """Bytes of a message; ``header.stamp`` is ``time_ns`` [ns] unless given.

        Raises:
            InputError: no such type or field, or a value that does not fit.
        """
        message = self._message(type_name, fields, type_name, time_ns)
        try:
            return bytes(self._store.serialize_cdr(message, type_name, little_endian=True))
        except self._errors as error:
            raise InputError(f"{type_name}: {error}") from None

    def _message(self, type_name: str, values: Mapping[str, Any], where: str, time_ns: int) -> Any:
        if type_name not in self._store.fielddefs:
            near = difflib.get_close_matches(type_name, self._store.fielddefs, n=3)
            raise InputError(
                f"no message type {type_name!r}" + (f"; close to it: {', '.join(near)}" if near else "")
            )
        if not isinstance(values, Mapping):
            raise InputError(f"{where} must be a mapping of its fields, got {type(values).__name__}")
        known = dict(self._store.fielddefs[type_name][1])
        if unknown := [str(name) for name in values if name not in known]:
            raise InputError(f"{where} has no field {unknown[0]!r}; it has {', '.join(known)}")
        if type_name == _HEADER and "stamp" not in values:
            sec, nanosec = divmod(time_ns, 1_000_000_000)
            values = {**values, "stamp": {"sec": sec, "nanosec": nanosec}}
        content = {
            self._normalize(name): self._value(desc, values.get(name), f"{where}.{name}", time_ns)
            for name, desc in known.items()
        }
        return self._store.types[type_name](**content)

    def _value(self, desc: Any, value: Any, where: str, time_ns: int) -> Any:
        """One field; None stands for zero or empty."""
        node, detail = desc
        try:
            if node == self._kind.BASE:
                name = detail[0]
                if name in ("string", "wstring"):
                    return str(value or "")
                if name == "bool":
                    return bool(value)
                return float(value or 0.0) if name.startswith("float") else int(value or 0)
            if node == self._kind.NAME:
                return self._message(detail, {} if value is None else value, where, time_ns)
            (inner, content), length = detail
            fixed = length if node == self._kind.ARRAY else None
            if inner == self._kind.BASE and content[0] not in ("string", "wstring"):
                if isinstance(value, bytes | bytearray | memoryview):
                    value = np.frombuffer(value, dtype=np.uint8)
                array = np.asarray(() if value is None else value, dtype=_DTYPES.get(content[0], content[0]))
                array = np.zeros(fixed, array.dtype) if fixed and value is None else array.reshape(-1)
                items: Any = array
            else:
                rows = list(value or ()) or [None] * (fixed or 0)
                items = [
                    self._value((inner, content), row, f"{where}[{i}]", time_ns) for i, row in enumerate(rows)
                ]
            if fixed is not None and len(items) != fixed:
                raise ValueError(f"expected {fixed} values, got {len(items)}")
        except (TypeError, ValueError, OverflowError) as error:
            raise InputError(f"{where}: {error}") from None
        return items
