"""The ROS graph over Cyclone DDS, as rmw_cyclonedds_cpp lays it out."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any, NamedTuple

from cyclonedds.builtin import (
    BuiltinDataReader,
    BuiltinTopicDcpsParticipant,
    BuiltinTopicDcpsPublication,
    BuiltinTopicDcpsSubscription,
)
from cyclonedds.core import (
    DDSException,
    InstanceState,
    Policy,
    Qos,
    ReadCondition,
    SampleState,
    ViewState,
    WaitSet,
)
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from ..errors import InputError
from .messages import Gid, Malformed, NodeEntitiesInfo, ParticipantEntitiesInfo
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

_GRAPH = Reliability(latched=True, depth=1)
_OTHERS = Reliability(latched=True, depth=100)
_ANY = SampleState.Any | ViewState.Any | InstanceState.Any


def _qos(how: Reliability, type_hash: str = "") -> Qos:
    """As DDS has it; the hash of the type goes with it."""
    policies = [
        Policy.Reliability.Reliable(duration(seconds=BLOCKED))
        if how.reliable
        else Policy.Reliability.BestEffort,
        Policy.Durability.TransientLocal if how.latched else Policy.Durability.Volatile,
        Policy.History.KeepLast(how.depth),
        Policy.DataRepresentation(use_cdrv0_representation=True),
    ]
    if type_hash:
        policies.append(Policy.Userdata(f"typehash={type_hash};".encode()))
    return Qos(*policies)


def _configuration(localhost: bool, largest: int) -> str:
    """For Cyclone DDS; ``CYCLONEDDS_URI`` comes behind and wins."""
    own = f"<Internal><MaxSampleSize>{largest} kB</MaxSampleSize></Internal>"
    if localhost:
        own += (
            '<General><Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces>'
            "<AllowMulticast>false</AllowMulticast></General>"
            "<Discovery><ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>99"
            '</MaxAutoParticipantIndex><Peers><Peer address="127.0.0.1"/></Peers></Discovery>'
        )
    text = f'<CycloneDDS><Domain Id="any">{own}</Domain></CycloneDDS>'
    user = os.environ.get("CYCLONEDDS_URI", "")
    return f"{text},{user}" if user else text


class _Shared(NamedTuple):
    configuration: str
    domain: Domain
    users: list[object]


_domains: dict[int, _Shared] = {}
"""a process can configure a domain but once"""


class _Writer(Writer):
    def __init__(self, writer: DataWriter[Any], closed: Callable[[_Writer], None]) -> None:
        self._writer: Any = writer
        self._closed = closed

    @property
    def gid(self) -> Gid:
        return _gid(self._writer)

    def write(self, message: Any) -> bool:
        try:
            self._writer.write(message)
        except DDSException as error:
            if error.code != DDSException.DDS_RETCODE_TIMEOUT:
                raise
            return False
        return True

    def flush(self, timeout: float) -> bool:
        return bool(self._writer.wait_for_acks(duration(seconds=timeout)))

    @property
    def readers(self) -> int:
        return len(self._writer.get_matched_subscriptions())

    def close(self) -> None:
        # readers are told at once, whoever still holds this
        self._closed(self)
        self._writer = None


class _Reader(Reader):
    def __init__(
        self, reader: DataReader[Any], message: type[Any], waitset: WaitSet, closed: Callable[[_Reader], None]
    ) -> None:
        self._reader: Any = reader
        self._message, self._waitset, self._closed = message, waitset, closed
        self._condition: Any = ReadCondition(reader, _ANY)
        waitset.attach(self._condition)

    @property
    def gid(self) -> Gid:
        return _gid(self._reader)

    def take(self) -> list[tuple[Any, int]]:
        return [
            (found, _number(found.sample_info.publication_handle) if isinstance(found, self._message) else 0)
            for found in self._reader.take(TAKEN)
            if isinstance(found, self._message | Malformed)
        ]

    @property
    def writers(self) -> int:
        return len(self._reader.get_matched_publications())

    @property
    def missed(self) -> int:
        return 0  # DDS numbers its messages for itself

    def alive(self, writer: int) -> bool:
        return any(_number(handle) == writer for handle in self._reader.get_matched_publications())

    def close(self) -> None:
        self._closed(self)
        self._waitset.detach(self._condition)
        self._condition = self._reader = None


class _Server(Server):
    """The caller's identity stands in front of the fields, of the request and of its reply."""

    def __init__(self, requests: _Reader, replies: _Writer, handle: Callable[[Any], Any]) -> None:
        self._requests, self._replies, self._handle = requests, replies, handle

    def serve(self) -> None:
        for request, _ in self._requests.take():
            if not isinstance(request, Malformed):
                reply = self._handle(request)
                reply.guid, reply.sequence = request.guid, request.sequence
                self._replies.write(reply)

    def close(self) -> None:
        self._requests.close()
        self._replies.close()


class _Seat(Seat):
    def __init__(self, transport: _Transport, space: str, name: str) -> None:
        self._transport = transport
        self._space, self._name = space, name
        self._waitset = WaitSet(transport.participant)
        self._writers: list[_Writer] = []
        self._readers: list[_Reader] = []

    def writer(self, message: type[Any], name: str, how: Reliability) -> Writer:
        self._transport.claim(name, message)
        return self._write(message, f"rt{name}", _qos(how, message.type_hash))

    def _write(self, message: type[Any], dds_topic: str, qos: Qos) -> _Writer:
        topic = self._transport.topic(message, dds_topic)
        made = _Writer(DataWriter(self._transport.participant, topic, qos=qos), self._writers.remove)
        self._writers.append(made)
        self._transport.announce()
        return made

    def reader(self, message: type[Any], name: str, how: Reliability) -> Reader:
        self._transport.claim(name, message)
        return self._read(message, f"rt{name}", _qos(how, message.type_hash))

    def _read(self, message: type[Any], dds_topic: str, qos: Qos) -> _Reader:
        topic = self._transport.topic(message, dds_topic)
        reader = DataReader(self._transport.participant, topic, qos=qos)
        made = _Reader(reader, message, self._waitset, self._readers.remove)
        self._readers.append(made)
        self._transport.announce()
        return made

    def server(self, name: str, request: type[Any], reply: type[Any], handle: Callable[[Any], Any]) -> Server:
        requests = self._read(request, f"rq{name}Request", _qos(REQUESTS))
        return _Server(requests, self._write(reply, f"rr{name}Reply", _qos(REQUESTS)), handle)

    def wait(self, timeout: float) -> None:
        self._waitset.wait(duration(seconds=timeout))

    def leave(self) -> None:
        self._transport.seats.remove(self)
        self._transport.announce()

    def describe(self) -> NodeEntitiesInfo:
        return NodeEntitiesInfo(
            self._space, self._name, [r.gid for r in self._readers], [w.gid for w in self._writers]
        )


class _Transport(Transport):
    def __init__(self, domain: int, localhost: bool, largest: int) -> None:
        super().__init__()
        self._domain = domain
        text = _configuration(localhost, largest)
        shared = _domains.get(domain)
        if shared is None:
            try:
                shared = _Shared(text, Domain(domain, text), [])
            except DDSException as error:
                raise InputError(
                    f"domain {domain}: Cyclone DDS does not start: {' '.join(str(error).split())}; "
                    "see CYCLONEDDS_URI and the network's interfaces"
                ) from None
            _domains[domain] = shared
        elif shared.configuration != text:
            raise InputError(f"domain {domain} is open in this process with other options")
        shared.users.append(self)
        self.participant = DomainParticipant(
            domain, qos=Qos(Policy.Userdata(b"enclave=/;"), Policy.EntityName("palpate"))
        )
        topic = Topic(self.participant, "ros_discovery_info", ParticipantEntitiesInfo)
        hash_ = ParticipantEntitiesInfo.type_hash  # type: ignore[attr-defined]
        self._writer = DataWriter(self.participant, topic, qos=_qos(_GRAPH, hash_))
        self._reader = DataReader(self.participant, topic, qos=_qos(_OTHERS, hash_))
        self._topics: dict[str, Topic[Any]] = {}
        self.seats: list[_Seat] = []
        self._others: dict[bytes, ParticipantEntitiesInfo] = {}

    def topic(self, message: type[Any], name: str) -> Topic[Any]:
        """The DDS topic of a name such as ``rt/joint_states``."""
        if name not in self._topics:
            self._topics[name] = Topic(self.participant, name, message)
        return self._topics[name]

    def join(self, space: str, name: str) -> Seat:
        seat = _Seat(self, space, name)
        self.seats.append(seat)
        self.announce()
        return seat

    def announce(self) -> None:
        """Tell the graph which nodes are here and what they read and write."""
        self._writer.write(
            ParticipantEntitiesInfo(_gid(self.participant), [s.describe() for s in self.seats])
        )

    def _learn(self) -> None:
        for info in self._reader.take(TAKEN):
            if isinstance(info, ParticipantEntitiesInfo):
                self._others[bytes(info.gid.data)] = info

    def nodes(self) -> list[str]:
        self._learn()
        reader = BuiltinDataReader(self.participant, BuiltinTopicDcpsParticipant)
        alive = {p.key.bytes for p in reader.read(1000) if _alive(p)}
        self._others = {gid: info for gid, info in self._others.items() if gid in alive}
        return sorted(
            full_name(node.node_namespace, node.node_name)
            for info in self._others.values()
            for node in info.node_entities_info_seq
        )

    def _node_of(self, gid: bytes) -> str:
        for info in self._others.values():
            for node in info.node_entities_info_seq:
                for known in (*node.writer_gid_seq, *node.reader_gid_seq):
                    if bytes(known.data) == gid:
                        return full_name(node.node_namespace, node.node_name)
        return ""

    def publishers(self, topic: str | None = None) -> list[Endpoint]:
        return self._endpoints(BuiltinTopicDcpsPublication, topic)

    def subscribers(self, topic: str | None = None) -> list[Endpoint]:
        return self._endpoints(BuiltinTopicDcpsSubscription, topic)

    def _endpoints(self, which: Any, topic: str | None) -> list[Endpoint]:
        self._learn()
        found = []
        for e in BuiltinDataReader(self.participant, which).read(10_000):
            wanted = e.topic_name == f"rt{topic}" if topic else e.topic_name.startswith("rt/")
            if wanted and _alive(e):
                reliable = isinstance(e.qos[Policy.Reliability], Policy.Reliability.Reliable)
                node = self._node_of(e.key.bytes)
                found.append(Endpoint(e.topic_name[2:], plain_type(e.type_name), node, reliable))
        return found

    def alone(self) -> str:
        return ""

    def close(self) -> None:
        self._topics.clear()
        del self._writer, self._reader, self.participant
        shared = _domains[self._domain]
        shared.users.remove(self)
        if not shared.users:
            del _domains[self._domain]


def _gid(entity: Any) -> Gid:
    """An entity's identity as the graph has it."""
    return Gid(entity.guid.bytes)


def _number(handle: int) -> int:
    return handle & 0xFFFF_FFFF_FFFF_FFFF


def _alive(sample: Any) -> bool:
    return bool(sample.sample_info.instance_state == InstanceState.Alive)


def member(domain: int, localhost: bool, largest: int) -> Transport:
    """A participant of a domain.

    Args:
        domain: its number.
        localhost: stay on this machine.
        largest: messages larger than this are dropped before they are put together [kB].

    Raises:
        InputError: this process has the domain open with another `localhost` or `largest`, or DDS does not start.
    """
    return _Transport(domain, localhost, largest)
