"""What a node needs of whatever carries messages; DDS and Zenoh each offer it.

A *seat* is a node's place in the graph: through it the node publishes, reads, serves, and waits. Names are full names
of ROS (``/joint_states``) throughout; how they look on the wire is each transport's own.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

from ..errors import InputError

LARGEST = 64
"""messages larger than this are dropped before they are put together, unless told otherwise [kB]"""
TAKEN = 200
"""messages taken from a reader at a time"""
BLOCKED = 0.1
"""how long a reliable reader that takes nothing may hold its writer up; then the message is given up [s]"""


@dataclass(frozen=True, slots=True)
class Reliability:
    """How a topic is carried."""

    reliable: bool = True
    """what is lost is sent again"""
    latched: bool = False
    """the newest are kept for readers that come later (transient local)"""
    depth: int = 10
    """how many are kept, at each end"""


SENSOR_DATA = Reliability(reliable=False, depth=5)
"""ROS 2's profile for sensors: the newest matter, what is lost is lost"""
DEFAULT = Reliability()
"""ROS 2's default profile"""
STREAM = Reliability(depth=1000)
"""for samples none of which may be missed: a reader may stall a second at 1 kHz"""
LATCHED = Reliability(latched=True, depth=1)
"""ROS 2's transient local: who comes later still gets the newest"""
REQUESTS = Reliability(depth=1000)
"""requests of a service, and its replies"""


class Endpoint(NamedTuple):
    """Someone who publishes or reads a topic."""

    topic: str
    """name in ROS, e.g. /joint_states"""
    type: str
    """name in ROS, e.g. sensor_msgs/msg/JointState"""
    node: str
    """full name of its node; empty: not told"""
    reliable: bool


class Writer(ABC):
    """Sends messages of one type on one topic."""

    @abstractmethod
    def write(self, message: Any) -> bool:
        """Send it; False: given up, since a reader took nothing for :data:`BLOCKED`."""

    @abstractmethod
    def flush(self, timeout: float) -> bool:
        """Wait until every reliable reader has what was sent, at most `timeout` [s]; whether they are known to."""

    @property
    @abstractmethod
    def readers(self) -> int:
        """How many read it now."""

    @abstractmethod
    def close(self) -> None:
        """Send no more."""


class Reader(ABC):
    """Receives messages of one type on one topic."""

    @abstractmethod
    def take(self) -> list[tuple[Any, int]]:
        """At most :data:`TAKEN` of what has come, each with a number for its writer; what is none is Malformed.

        A message's ``sample_info.source_timestamp`` is when it was written [ns].
        """

    @property
    @abstractmethod
    def writers(self) -> int:
        """How many write it now."""

    @property
    @abstractmethod
    def missed(self) -> int:
        """Messages that are known to be lost on the way, or because they came faster than they were taken."""

    @abstractmethod
    def alive(self, writer: int) -> bool:
        """Whether the writer of this number may still be there."""

    @abstractmethod
    def close(self) -> None:
        """Receive no more."""


class Server(ABC):
    """Answers requests of one service."""

    @abstractmethod
    def serve(self) -> None:
        """Answer what has come."""

    @abstractmethod
    def close(self) -> None:
        """Answer no more."""


class Seat(ABC):
    """A node's place in the graph."""

    @abstractmethod
    def writer(self, message: type[Any], name: str, how: Reliability) -> Writer:
        """A writer of a topic.

        Raises:
            InputError: this process uses it with another type.
        """

    @abstractmethod
    def reader(self, message: type[Any], name: str, how: Reliability) -> Reader:
        """A reader of a topic.

        Raises:
            InputError: this process uses it with another type.
        """

    @abstractmethod
    def server(self, name: str, request: type[Any], reply: type[Any], handle: Callable[[Any], Any]) -> Server:
        """A service: `handle` makes the reply to a request."""

    @abstractmethod
    def wait(self, timeout: float) -> None:
        """Wait at most `timeout` [s] for something to come."""

    @abstractmethod
    def leave(self) -> None:
        """The node is gone; what it wrote, read and served was closed before."""


class Transport(ABC):
    """One process's membership of a domain."""

    def __init__(self) -> None:
        self._types: dict[str, type[Any]] = {}

    def claim(self, name: str, message: type[Any]) -> None:
        """Note the type of a topic of this process.

        Raises:
            InputError: it has another.
        """
        known: Any = self._types.setdefault(name, message)
        if known is not message:
            raise InputError(f"topic {name} is {known.ros_type} in this process, not {message.ros_type}")

    @abstractmethod
    def join(self, space: str, name: str) -> Seat:
        """A seat for a node of this namespace and name."""

    @abstractmethod
    def nodes(self) -> list[str]:
        """Full names of all nodes that are known, of this process too."""

    @abstractmethod
    def publishers(self, topic: str | None = None) -> list[Endpoint]:
        """Who publishes a topic, or all topics."""

    @abstractmethod
    def subscribers(self, topic: str | None = None) -> list[Endpoint]:
        """Who reads a topic, or all topics."""

    @abstractmethod
    def alone(self) -> str:
        """Why nobody at all may be there, in words; empty: nothing is known to be missing."""

    @abstractmethod
    def close(self) -> None:
        """Leave the domain; nodes have left before."""


def full_name(space: str, node: str) -> str:
    """Of a node in a namespace."""
    return f"{space.rstrip('/')}/{node}"
