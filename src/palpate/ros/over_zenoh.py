"""The ROS graph over Zenoh, as rmw_zenoh_cpp lays it out.

A topic is the key ``domain/name/type/hash``, its messages are CDR, and beside each stand its writer, its time and its
number; a service is a queryable of such a key; nodes and what they read, write and serve are liveliness tokens below
``@ros2_lv/domain``; what is latched is kept by the advanced publisher. Source: the design document of ros2/rmw_zenoh.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import os
import re
import struct
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any, Literal, NamedTuple, TypeAlias

from ..errors import InputError, MissingExtraError
from .messages import Malformed
from .names import plain_type
from .transport import (
    BLOCKED,
    REQUESTS,
    TAKEN,
    Endpoint,
    Reader,
    Reliability,
    Seat,
    Server,
    Transport,
    Writer,
    full_name,
)

try:
    import zenoh
    from zenoh import ext
    from zenoh.handlers import Callback
except ImportError:
    raise MissingExtraError("ros-zenoh", "ROS 2 over Zenoh") from None

Kind: TypeAlias = Literal["NN", "MP", "MS", "SS"]

_GRAPH = "@ros2_lv"
_WHERE = re.compile(r" at \S+\.rs:\d+\.?")  # of Zenoh's own source
_ROUTER = "tcp/localhost:7447"
_HEARTBEAT = 0.5
"""of a latched writer, so that a reader knows whether it has the newest [s]"""
_TOKENS = 20_000
"""of the graph, at most: a ROS node has some 15"""
_HEARD = 16
"""writers of one topic that are told apart"""
_CALLER = 16
"""bytes of the caller's identity, which stands in front of a request's fields only over DDS"""
_HEAD = 4
"""bytes that say how CDR is laid out"""


# --- settings ----------------------------------------------------------------------------------------------------


def _settings(largest: int) -> dict[str, Any]:
    """As rmw_zenoh_cpp's session by default: this machine alone, and a router known by its port.

    Beyond that, peers without a router find each other, by multicast that does not leave the machine either.
    """
    congestion = "transport/link/tx/queue/congestion_control/drop"
    return {
        "mode": "peer",
        "connect/endpoints": [_ROUTER],
        "listen/endpoints": ["tcp/localhost:0"],
        "scouting/multicast/enabled": True,
        "scouting/multicast/interface": "lo" if sys.platform == "linux" else "127.0.0.1",
        "scouting/delay": 200,
        "timestamping/enabled": True,  # latched topics need it
        "transport/shared_memory/enabled": False,
        "transport/link/rx/max_message_size": largest * 1024,
        f"{congestion}/wait_before_drop": round(1e6 * BLOCKED),
        f"{congestion}/max_wait_before_drop_fragments": round(1e6 * BLOCKED),
    }


def _configuration(largest: int) -> zenoh.Config:
    """Palpate's own, or that of ``ZENOH_SESSION_CONFIG_URI``, with ``ZENOH_CONFIG_OVERRIDE`` (key=value;key=value).

    Raises:
        InputError: one of the two is wrong; the message says which key.
    """
    path = os.environ.get("ZENOH_SESSION_CONFIG_URI", "")
    if path:
        try:
            made = zenoh.Config.from_file(path)
        except zenoh.ZError as error:
            raise InputError(f"ZENOH_SESSION_CONFIG_URI: {path}: {_one_line(error)}") from None
    else:
        made = zenoh.Config()
        for key, value in _settings(largest).items():
            made.insert_json5(key, json.dumps(value))
    for pair in os.environ.get("ZENOH_CONFIG_OVERRIDE", "").split(";"):
        if not pair.strip():
            continue
        key, equals, text = (part.strip() for part in pair.partition("="))
        try:
            if not equals:
                raise InputError(f"ZENOH_CONFIG_OVERRIDE: expected key=value;key=value, got {pair[:80]!r}")
            made.insert_json5(key, text)
        except zenoh.ZError as error:
            raise InputError(f"ZENOH_CONFIG_OVERRIDE: {key}: {_one_line(error)}") from None
    return made


def _one_line(error: Exception) -> str:
    text = " ".join(str(error).split())
    return _WHERE.sub("", text)[:200]


# --- names -------------------------------------------------------------------------------------------------------


def _dds_type(message: Any) -> str:
    """``sensor_msgs::msg::dds_::JointState_``."""
    name: str = message.__idl_typename__
    return name.replace(".", "::")


def _mangled(name: str) -> str:
    return name.replace("/", "%")


class _Token(NamedTuple):
    """What a liveliness token tells."""

    kind: str
    node: str
    topic: str = ""
    type: str = ""
    hash: str = ""
    reliable: bool = True

    @classmethod
    def parse(cls, key: str) -> _Token | None:
        """None: it tells nothing of ROS."""
        parts = key.split("/")
        if len(parts) < 9:
            return None
        kind, space, name = parts[5], *(part.replace("%", "/") for part in parts[7:9])
        node = full_name(space, name)
        if kind == "NN":
            return cls(kind, node)
        if len(parts) < 13:
            return None
        reliable = not parts[12].startswith("2:")
        return cls(kind, node, parts[9].replace("%", "/"), parts[10], parts[11], reliable)


class _Place(NamedTuple):
    """A topic or service on the wire."""

    name: str
    type: str
    hash: str

    @classmethod
    def of(cls, name: str, message: Any) -> _Place:
        """Of a topic."""
        if not message.type_hash:
            raise InputError(
                f"{name}: {message.ros_type} is a part of messages, not one to be sent by itself"
            )
        return cls(name, _dds_type(message), message.type_hash)

    def key(self, domain: int) -> str:
        return f"{domain}/{self.name.strip('/')}/{self.type}/{self.hash}"

    def token(self, how: Reliability) -> str:
        """The end of its token. An empty field is ROS's default."""
        qos = f"{'' if how.reliable else 2}:{1 if how.latched else ''}:,{how.depth}:,:,:,,"
        return f"{_mangled(self.name)}/{self.type}/{self.hash}/{qos}"


# --- what comes with a message -------------------------------------------------------------------------------------


class _Origin(NamedTuple):
    """Who wrote a message, when, and its number."""

    sequence: int
    source_timestamp: int
    """[ns]"""
    gid: bytes

    @classmethod
    def parse(cls, attachment: Any) -> _Origin | None:
        """None: that is no attachment of ROS. Two numbers of 64 bits, the length of the identity, the identity."""
        raw = bytes(attachment) if attachment is not None else b""
        if len(raw) != 33 or raw[16] != 16 or not any(raw[17:]):
            return None
        sequence, written = struct.unpack_from("<qq", raw)
        return cls(sequence, written, raw[17:])

    def pack(self) -> bytes:
        return struct.pack("<qqB", self.sequence, self.source_timestamp, 16) + self.gid

    @property
    def number(self) -> int:
        """Of the writer."""
        return int.from_bytes(self.gid, "little")


def _cdr(message: Any) -> bytes:
    raw: bytes = message.serialize(use_version_2=False)
    return raw


# --- a node's ends -------------------------------------------------------------------------------------------------


class _Writer(Writer):
    def __init__(self, seat: _Seat, message: Any, name: str, how: Reliability) -> None:
        self._seat = seat
        self._place = _Place.of(name, message)
        transport = seat.transport
        options: dict[str, Any] = {
            "congestion_control": zenoh.CongestionControl.DROP,  # after having waited, see _settings
            "reliability": zenoh.Reliability.RELIABLE if how.reliable else zenoh.Reliability.BEST_EFFORT,
        }
        key = self._place.key(transport.domain)
        self._publisher: Any
        if how.latched:
            missing = ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=_HEARTBEAT)
            self._publisher = ext.declare_advanced_publisher(
                transport.session,
                key,
                cache=ext.CacheConfig(how.depth),
                sample_miss_detection=missing if how.reliable else None,
                publisher_detection=True,
                **options,
            )
        else:
            self._publisher = transport.session.declare_publisher(key, **options)
        self._token, self._gid = seat.token("MP", self._place.token(how))
        self._sequence = itertools.count(1)

    def write(self, message: Any) -> bool:
        origin = _Origin(next(self._sequence), time.time_ns(), self._gid)
        self._publisher.put(_cdr(message), attachment=origin.pack())
        return True

    def flush(self, timeout: float) -> bool:
        return False  # nobody acknowledges; but closing the session sends what waits

    @property
    def readers(self) -> int:
        return self._seat.transport.count("MS", self._place)

    def close(self) -> None:
        self._token.undeclare()
        self._publisher.undeclare()


class _Reader(Reader):
    def __init__(self, seat: _Seat, message: Any, name: str, how: Reliability) -> None:
        self.place = _Place.of(name, message)
        self._seat, self._message = seat, message
        self._waiting: deque[tuple[bytes, _Origin] | Malformed] = deque(maxlen=how.depth)
        self._heard: dict[int, int] = {}  # number of a writer and of its newest message
        self._missed = 0
        transport = seat.transport
        key, hear = self.place.key(transport.domain), Callback(self._hear, indirect=False)
        self._subscriber: Any
        if how.latched:
            self._subscriber = ext.declare_advanced_subscriber(
                transport.session,
                key,
                hear,
                history=ext.HistoryConfig(detect_late_publishers=True, max_samples=how.depth),
                recovery=ext.RecoveryConfig(periodic_queries=None, heartbeat=True) if how.reliable else None,
                subscriber_detection=True,
            )
        else:
            self._subscriber = transport.session.declare_subscriber(key, hear)
        self._token, _ = seat.token("MS", self.place.token(how))
        transport.readers.append(self)

    def _hear(self, sample: zenoh.Sample) -> None:
        """In a thread of Zenoh's."""
        if sample.kind != zenoh.SampleKind.PUT:
            return
        self._missed += len(self._waiting) == self._waiting.maxlen
        self._waiting.append(self._checked(sample))
        self._seat.wake()

    def _checked(self, sample: zenoh.Sample) -> tuple[bytes, _Origin] | Malformed:
        if wrong := self._seat.transport.oversize(sample.payload):
            return Malformed(wrong)
        origin = _Origin.parse(sample.attachment)
        if origin is None:
            return Malformed("what rmw_zenoh_cpp puts beside a message is missing")
        newest = self._heard.pop(origin.number, origin.sequence)
        self._missed += max(origin.sequence - newest - 1, 0)
        self._heard[origin.number] = max(newest, origin.sequence)
        if len(self._heard) > _HEARD:
            self._heard.pop(next(iter(self._heard)))
        return sample.payload.to_bytes(), origin

    def take(self) -> list[tuple[Any, int]]:
        taken: list[tuple[Any, int]] = []
        while self._waiting and len(taken) < TAKEN:
            came = self._waiting.popleft()
            if isinstance(came, Malformed):
                taken.append((came, 0))
                continue
            raw, origin = came
            message = self._message.deserialize(raw)
            if not isinstance(message, Malformed):
                message.sample_info = origin
            taken.append((message, origin.number))
        if self._waiting:
            self._seat.wake()
        return taken

    @property
    def writers(self) -> int:
        return self._seat.transport.count("MP", self.place)

    @property
    def missed(self) -> int:
        return self._missed

    def alive(self, writer: int) -> bool:
        # Which token is whose is each implementation's own affair. But as many writers can be alive as there are
        # tokens: those that were heard last, and since one was gone at all.
        last = list(self._heard)[-self.writers :] if self.writers else []
        return writer in last

    def forget(self) -> None:
        """A writer is gone, it is not known which."""
        self._heard.clear()

    def close(self) -> None:
        self._seat.transport.readers.remove(self)
        self._token.undeclare()
        self._subscriber.undeclare()


class _Server(Server):
    def __init__(
        self, seat: _Seat, name: str, request: Any, reply: Any, handle: Callable[[Any], Any]
    ) -> None:
        kind = _dds_type(request).removesuffix("Request_")
        place = _Place(name, kind, request.service_hash)
        self._seat, self._request, self._handle = seat, request, handle
        self._waiting: deque[zenoh.Query] = deque(maxlen=REQUESTS.depth)
        self._key = place.key(seat.transport.domain)
        self._queryable: Any = seat.transport.session.declare_queryable(
            self._key, Callback(self._hear, indirect=False), complete=True
        )
        self._token, _ = seat.token("SS", place.token(Reliability()))

    def _hear(self, query: zenoh.Query) -> None:
        """In a thread of Zenoh's."""
        if self._seat.transport.oversize(query.payload):
            query.drop()
            return
        self._waiting.append(query)
        self._seat.wake()

    def serve(self) -> None:
        while self._waiting:
            with self._waiting.popleft() as query:
                self._answer(query)

    def _answer(self, query: zenoh.Query) -> None:
        origin = _Origin.parse(query.attachment)
        raw = b"" if query.payload is None else query.payload.to_bytes()
        # 16 bytes more or less move no field against CDR's boundaries of 8
        request = self._request.deserialize(raw[:_HEAD] + bytes(_CALLER) + raw[_HEAD:])
        if origin is None or isinstance(request, Malformed):
            reason = request.reason if isinstance(request, Malformed) else "nothing says who asks"
            query.reply_err(f"no request of {self._request.ros_type}: {reason}")
            return
        reply = _cdr(self._handle(request))
        answered = _Origin(origin.sequence, time.time_ns(), origin.gid)
        query.reply(self._key, reply[:_HEAD] + reply[_HEAD + _CALLER :], attachment=answered.pack())

    def close(self) -> None:
        self._token.undeclare()
        self._queryable.undeclare()
        while self._waiting:
            self._waiting.popleft().drop()


class _Seat(Seat):
    def __init__(self, transport: _Transport, space: str, name: str) -> None:
        self.transport = transport
        self._id = next(transport.ids)
        self._names = f"%/{_mangled(space)}/{name}"  # no enclave
        self._come = threading.Event()
        self._token = transport.declare_token(f"{self._id}/{self._id}/NN/{self._names}")

    def token(self, kind: Kind, end: str) -> tuple[zenoh.LivelinessToken, bytes]:
        """Tell of an end of this node; its token, and the end's identity of 16 bytes."""
        key = f"{self._id}/{next(self.transport.ids)}/{kind}/{self._names}/{end}"
        unique = f"{self.transport.session.zid()}/{key}".encode()
        return self.transport.declare_token(key), hashlib.blake2b(unique, digest_size=16).digest()

    def writer(self, message: type[Any], name: str, how: Reliability) -> Writer:
        self.transport.claim(name, message)
        return _Writer(self, message, name, how)

    def reader(self, message: type[Any], name: str, how: Reliability) -> Reader:
        self.transport.claim(name, message)
        return _Reader(self, message, name, how)

    def server(self, name: str, request: type[Any], reply: type[Any], handle: Callable[[Any], Any]) -> Server:
        return _Server(self, name, request, reply, handle)

    def wake(self) -> None:
        """Something has come."""
        self._come.set()

    def wait(self, timeout: float) -> None:
        self._come.wait(timeout)
        self._come.clear()

    def leave(self) -> None:
        self._token.undeclare()


class _Transport(Transport):
    def __init__(self, domain: int, largest: int) -> None:
        super().__init__()
        self.domain = domain
        self._largest = largest * 1024
        try:
            self.session = zenoh.open(_configuration(largest))
        except zenoh.ZError as error:
            raise InputError(
                f"Zenoh does not start: {_one_line(error)}; see ZENOH_CONFIG_OVERRIDE and ZENOH_SESSION_CONFIG_URI"
            ) from None
        self.ids = itertools.count()
        self.readers: list[_Reader] = []
        self._tokens: dict[str, _Token] = {}
        self._graph = self.session.liveliness().declare_subscriber(
            f"{_GRAPH}/{domain}/**", Callback(self._learn, indirect=False), history=True
        )

    def _learn(self, sample: zenoh.Sample) -> None:
        """In a thread of Zenoh's."""
        key = str(sample.key_expr)
        if sample.kind == zenoh.SampleKind.PUT:
            token = _Token.parse(key)
            if token is not None and len(self._tokens) < _TOKENS:
                self._tokens[key] = token
            return
        gone = self._tokens.pop(key, None)
        if gone is not None and gone.kind == "MP":
            for reader in list(self.readers):
                if reader.place.name == gone.topic:
                    reader.forget()

    def declare_token(self, end: str) -> zenoh.LivelinessToken:
        """A token of this session."""
        return self.session.liveliness().declare_token(f"{_GRAPH}/{self.domain}/{self.session.zid()}/{end}")

    def oversize(self, payload: zenoh.ZBytes | None) -> str:
        """What is wrong with its size; empty: nothing."""
        size = 0 if payload is None else len(payload)
        return f"{size} bytes, where at most {self._largest} are read" if size > self._largest else ""

    def join(self, space: str, name: str) -> Seat:
        return _Seat(self, space, name)

    def _known(self, kind: Kind) -> list[_Token]:
        return [token for token in list(self._tokens.values()) if token.kind == kind]

    def count(self, kind: Kind, place: _Place) -> int:
        """How many ends of this kind a topic has."""
        return sum(_Place(t.topic, t.type, t.hash) == place for t in self._known(kind))

    def nodes(self) -> list[str]:
        return sorted(token.node for token in self._known("NN"))

    def publishers(self, topic: str | None = None) -> list[Endpoint]:
        return self._endpoints("MP", topic)

    def subscribers(self, topic: str | None = None) -> list[Endpoint]:
        return self._endpoints("MS", topic)

    def _endpoints(self, kind: Kind, topic: str | None) -> list[Endpoint]:
        return [
            Endpoint(t.topic, plain_type(t.type), t.node, t.reliable)
            for t in self._known(kind)
            if topic in (None, t.topic)
        ]

    def alone(self) -> str:
        if self.session.info.routers_zid() or self.session.info.peers_zid():
            return ""
        return f"; no Zenoh router at {_ROUTER} (ros2 run rmw_zenoh_cpp rmw_zenohd), nor any peer"

    def close(self) -> None:
        self._graph.undeclare()
        self.session.close()


def member(domain: int, largest: int) -> Transport:
    """A session of Zenoh, and what the graph of a domain tells.

    Args:
        domain: its number.
        largest: messages larger than this are dropped before they are put together [kB].

    Raises:
        InputError: the session does not open, or its settings in the environment are wrong.
    """
    return _Transport(domain, largest)
