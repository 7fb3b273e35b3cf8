"""ROS 2 without a ROS installation: messages, nodes, parameters, bridges and a driver, over Cyclone DDS or Zenoh.

Raises:
    MissingExtraError: on import, where ``palpate[ros]`` is not installed.
"""

from __future__ import annotations

from ..errors import MissingExtraError

try:
    import cyclonedds.core  # noqa: F401
except ImportError:
    raise MissingExtraError("ros", "ROS 2") from None

from . import messages
from .arguments import RosArguments
from .context import Context
from .driver import RosDriver, collect
from .node import Node, Publisher, Subscription
from .parameters import Parameters
from .source import SampleSource
from .transport import DEFAULT, LATCHED, SENSOR_DATA, STREAM, Endpoint, Reliability

__all__ = [
    "DEFAULT",
    "LATCHED",
    "SENSOR_DATA",
    "STREAM",
    "Context",
    "Endpoint",
    "Node",
    "Parameters",
    "Publisher",
    "Reliability",
    "RosArguments",
    "RosDriver",
    "SampleSource",
    "Subscription",
    "collect",
    "messages",
]
