"""One process's place in the ROS graph: its domain, what carries its messages, and what it knows of others."""

from __future__ import annotations

import os
from typing import Literal, TypeAlias

from ..errors import InputError, suggest
from .transport import LARGEST, Endpoint, Transport

Rmw: TypeAlias = Literal["dds", "zenoh"]

RMWS: tuple[Rmw, ...] = ("dds", "zenoh")
"""what may carry messages, by the name that ``--rmw`` takes"""


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


def default_rmw() -> Rmw:
    """What ``RMW_IMPLEMENTATION`` asks for: Zenoh for rmw_zenoh_cpp, else DDS, whose vendors understand each other."""
    return "zenoh" if os.environ.get("RMW_IMPLEMENTATION", "") == "rmw_zenoh_cpp" else "dds"


def check_rmw(rmw: str) -> Rmw:
    """The rmw, if there is one of this name.

    Raises:
        InputError: there is none.
    """
    for known in RMWS:
        if rmw == known:
            return known
    raise InputError(f"no rmw {rmw!r}; {suggest(rmw, RMWS, 'there are')}")


def _local() -> bool:
    """Whether the environment asks to stay on this machine, as ROS 2 does."""
    return (
        os.environ.get("ROS_LOCALHOST_ONLY", "") == "1"
        or os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "").upper() == "LOCALHOST"
    )


class Context:
    """A member of a ROS 2 domain; the nodes of this process belong to it.

    Args:
        domain: its number; None: ``ROS_DOMAIN_ID``, or 0.
        localhost: stay on this machine; None: as ``ROS_LOCALHOST_ONLY`` or ``ROS_AUTOMATIC_DISCOVERY_RANGE`` say. Over
            Zenoh a process always does, as rmw_zenoh_cpp's: the router leads beyond.
        largest: messages larger than this are dropped before they are put together [kB].
        rmw: what carries messages, "dds" or "zenoh"; None: as ``RMW_IMPLEMENTATION`` says.

    Raises:
        InputError: no such domain or rmw, this process has the domain open with another `localhost` or `largest`, or
            the settings of DDS or Zenoh in the environment are wrong.
        MissingExtraError: Zenoh is asked for and not installed.
    """

    def __init__(
        self,
        domain: int | None = None,
        *,
        localhost: bool | None = None,
        largest: int = LARGEST,
        rmw: Rmw | None = None,
    ) -> None:
        self.domain = default_domain() if domain is None else check_domain(domain)
        self.rmw: Rmw = default_rmw() if rmw is None else check_rmw(rmw)
        self.transport: Transport
        if self.rmw == "zenoh":
            from . import over_zenoh

            self.transport = over_zenoh.member(self.domain, largest)
        else:
            from . import over_dds

            self.transport = over_dds.member(
                self.domain, _local() if localhost is None else localhost, largest
            )
        self._closed = False

    def nodes(self) -> list[str]:
        """Full names of all nodes that are known in this domain, of this process too."""
        return self.transport.nodes()

    def publishers(self, topic: str | None = None) -> list[Endpoint]:
        """Who publishes a topic such as ``/joint_states``, or all topics."""
        return self.transport.publishers(topic)

    def subscribers(self, topic: str | None = None) -> list[Endpoint]:
        """Who reads a topic such as ``/joint_states``, or all topics."""
        return self.transport.subscribers(topic)

    def close(self) -> None:
        """Leave the domain; nodes are closed before. Closed already: nothing happens."""
        if not self._closed:
            self._closed = True
            self.transport.close()

    def __enter__(self) -> Context:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
