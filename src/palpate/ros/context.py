"""One process's place in the ROS graph: its domain, what it tells of its nodes, and what it knows of others."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

from cyclonedds.builtin import (
    BuiltinDataReader,
    BuiltinTopicDcpsParticipant,
    BuiltinTopicDcpsPublication,
    BuiltinTopicDcpsSubscription,
)
from cyclonedds.core import DDSException, InstanceState, Policy, Qos, ReadCondition, SampleState, ViewState
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from ..errors import InputError
from .messages import Gid, NodeEntitiesInfo, ParticipantEntitiesInfo
from .names import plain_type

LARGEST = 64
"""messages larger than this are dropped before they are put together, unless told otherwise [kB]"""


@dataclass(frozen=True, slots=True)
class Reliability:
    """How a topic is carried."""

    reliable: bool = True
    """what is lost is sent again"""
    latched: bool = False
    """the newest are kept for readers that come later (transient local)"""
    depth: int = 10
    """how many are kept, at each end"""

    def qos(self, type_hash: str = "") -> Qos:
        """As DDS has it; the hash of the type goes with it."""
        policies = [
            Policy.Reliability.Reliable(duration(milliseconds=100))
            if self.reliable
            else Policy.Reliability.BestEffort,
            Policy.Durability.TransientLocal if self.latched else Policy.Durability.Volatile,
            Policy.History.KeepLast(self.depth),
            Policy.DataRepresentation(use_cdrv0_representation=True),
        ]
        if type_hash:
            policies.append(Policy.Userdata(f"typehash={type_hash};".encode()))
        return Qos(*policies)


SENSOR_DATA = Reliability(reliable=False, depth=5)
"""ROS 2's profile for sensors: the newest matter, what is lost is lost"""
DEFAULT = Reliability()
"""ROS 2's default profile"""
STREAM = Reliability(depth=1000)
"""for samples none of which may be missed: a reader may stall a second at 1 kHz"""
LATCHED = Reliability(latched=True, depth=1)
"""ROS 2's transient local: who comes later still gets the newest"""
_GRAPH = Reliability(latched=True, depth=1)
_OTHERS = Reliability(latched=True, depth=100)


class Endpoint(NamedTuple):
    """Someone who publishes or reads a topic."""

    topic: str
    """name in ROS, e.g. /joint_states"""
    type: str
    """name in ROS, e.g. sensor_msgs/msg/JointState"""
    node: str
    """full name of its node; empty: not told"""
    reliable: bool
    gid: bytes


def default_domain() -> int:
    """``ROS_DOMAIN_ID``, or 0.

    Raises:
        InputError: it is no number.
    """
    text = os.environ.get("ROS_DOMAIN_ID", "") or "0"
    try:
        return check_domain(int(text))
    except ValueError:
        raise InputError(f"ROS_DOMAIN_ID: expected a number from 0 to 232, got {text!r}") from None


def check_domain(domain: int) -> int:
    """The domain, if there is one of this number.

    Raises:
        InputError: beyond what the ports of DDS allow.
    """
    if not 0 <= domain <= 232:
        raise InputError(f"domain {domain}: expected a number from 0 to 232")
    return domain


def _local() -> bool:
    """Whether the environment asks to stay on this machine, as ROS 2 does."""
    return (
        os.environ.get("ROS_LOCALHOST_ONLY", "") == "1"
        or os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "").upper() == "LOCALHOST"
    )


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


class Context:
    """A participant of a ROS 2 domain; the nodes of this process belong to it.

    Args:
        domain: its number; None: ``ROS_DOMAIN_ID``, or 0.
        localhost: stay on this machine; None: as ``ROS_LOCALHOST_ONLY`` or ``ROS_AUTOMATIC_DISCOVERY_RANGE`` say.
        largest: messages larger than this are dropped before they are put together [kB].

    Raises:
        InputError: no such domain, or this process has it open with another `localhost` or `largest`.
    """

    def __init__(
        self, domain: int | None = None, *, localhost: bool | None = None, largest: int = LARGEST
    ) -> None:
        self.domain = default_domain() if domain is None else check_domain(domain)
        self.localhost = _local() if localhost is None else localhost
        text = _configuration(self.localhost, largest)
        shared = _domains.get(self.domain)
        if shared is None:
            try:
                shared = _Shared(text, Domain(self.domain, text), [])
            except DDSException as error:
                raise InputError(
                    f"domain {self.domain}: Cyclone DDS does not start: {' '.join(str(error).split())}; "
                    "see CYCLONEDDS_URI and the network's interfaces"
                ) from None
            _domains[self.domain] = shared
        elif shared.configuration != text:
            raise InputError(f"domain {self.domain} is open in this process with other options")
        shared.users.append(self)
        self.participant = DomainParticipant(
            self.domain, qos=Qos(Policy.Userdata(b"enclave=/;"), Policy.EntityName("palpate"))
        )
        topic = Topic(self.participant, "ros_discovery_info", ParticipantEntitiesInfo)
        hash_ = ParticipantEntitiesInfo.type_hash  # type: ignore[attr-defined]
        self._writer = DataWriter(self.participant, topic, qos=_GRAPH.qos(hash_))
        self._reader = DataReader(self.participant, topic, qos=_OTHERS.qos(hash_))
        self._topics: dict[str, Topic[Any]] = {}
        self._nodes: list[Callable[[], NodeEntitiesInfo]] = []
        self._others: dict[bytes, ParticipantEntitiesInfo] = {}
        self._closed = False

    def topic(self, message: type[Any], name: str) -> Topic[Any]:
        """The DDS topic of a name such as ``rt/joint_states``.

        Raises:
            InputError: this process uses it with another type.
        """
        found = self._topics.get(name)
        if found is None:
            found = self._topics[name] = Topic(self.participant, name, message)
        elif found.data_type is not message:
            known = found.data_type.ros_type
            raise InputError(f"topic {name[2:]} is {known} in this process, not {message.ros_type}")
        return found

    def writer(
        self, message: type[Any], name: str, how: Reliability, *, hashed: bool = True
    ) -> DataWriter[Any]:
        """A writer of a DDS topic."""
        qos = how.qos(message.type_hash if hashed else "")
        return DataWriter(self.participant, self.topic(message, name), qos=qos)

    def reader(
        self, message: type[Any], name: str, how: Reliability, *, hashed: bool = True
    ) -> DataReader[Any]:
        """A reader of a DDS topic."""
        qos = how.qos(message.type_hash if hashed else "")
        return DataReader(self.participant, self.topic(message, name), qos=qos)

    def add_node(self, describe: Callable[[], NodeEntitiesInfo]) -> None:
        """Tell of a node from now on."""
        self._nodes.append(describe)

    def remove_node(self, describe: Callable[[], NodeEntitiesInfo]) -> None:
        """Tell of it no more."""
        self._nodes.remove(describe)
        self.announce()

    def announce(self) -> None:
        """Tell the graph which nodes are here and what they read and write."""
        info = ParticipantEntitiesInfo(gid_of(self.participant), [describe() for describe in self._nodes])
        self._writer.write(info)

    def _learn(self) -> None:
        for info in self._reader.take(200):
            if isinstance(info, ParticipantEntitiesInfo):
                self._others[bytes(info.gid.data)] = info

    def nodes(self) -> list[str]:
        """Full names of all nodes that are known in this domain, of this process too."""
        self._learn()
        reader = BuiltinDataReader(self.participant, BuiltinTopicDcpsParticipant)
        alive = {p.key.bytes for p in reader.read(1000) if _alive(p)}
        self._others = {gid: info for gid, info in self._others.items() if gid in alive}
        return sorted(
            _full_name(node) for info in self._others.values() for node in info.node_entities_info_seq
        )

    def _node_of(self, gid: bytes) -> str:
        for info in self._others.values():
            for node in info.node_entities_info_seq:
                for known in (*node.writer_gid_seq, *node.reader_gid_seq):
                    if bytes(known.data) == gid:
                        return _full_name(node)
        return ""

    def publishers(self, dds_topic: str | None = None) -> list[Endpoint]:
        """Who publishes a DDS topic such as ``rt/joint_states``, or all topics of ROS."""
        return self._endpoints(BuiltinTopicDcpsPublication, dds_topic)

    def subscribers(self, dds_topic: str | None = None) -> list[Endpoint]:
        """Who reads a DDS topic such as ``rt/joint_states``, or all topics of ROS."""
        return self._endpoints(BuiltinTopicDcpsSubscription, dds_topic)

    def _endpoints(self, which: Any, dds_topic: str | None) -> list[Endpoint]:
        self._learn()
        found = []
        for e in BuiltinDataReader(self.participant, which).read(10_000):
            wanted = e.topic_name == dds_topic if dds_topic else e.topic_name.startswith("rt/")
            if wanted and _alive(e):
                reliability = e.qos[Policy.Reliability]
                found.append(
                    Endpoint(
                        e.topic_name[2:],
                        plain_type(e.type_name),
                        self._node_of(e.key.bytes),
                        isinstance(reliability, Policy.Reliability.Reliable),
                        e.key.bytes,
                    )
                )
        return found

    def close(self) -> None:
        """Leave the domain; nodes are closed before. Closed already: nothing happens."""
        if self._closed:
            return
        self._closed = True
        self._topics.clear()
        self._nodes.clear()
        del self._writer, self._reader, self.participant
        shared = _domains[self.domain]
        shared.users.remove(self)
        if not shared.users:
            del _domains[self.domain]

    def __enter__(self) -> Context:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def gid_of(entity: Any) -> Gid:
    """An entity's identity as the graph has it."""
    return Gid(entity.guid.bytes)


def new_data(reader: DataReader[Any]) -> ReadCondition:
    """True while a reader holds something that was not taken."""
    return ReadCondition(reader, SampleState.Any | ViewState.Any | InstanceState.Any)


def gids(entities: Iterable[Any]) -> list[Gid]:
    """Their identities."""
    return [gid_of(entity) for entity in entities]


def _alive(sample: Any) -> bool:
    return bool(sample.sample_info.instance_state == InstanceState.Alive)


def _full_name(node: NodeEntitiesInfo) -> str:
    return f"{node.node_namespace.rstrip('/')}/{node.node_name}"
