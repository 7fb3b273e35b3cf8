"""The laws of ROS 2 without ROS once more, over Zenoh; and the bytes that rmw_zenoh_cpp's design asks for."""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Any

import pytest

pytest.importorskip("cyclonedds", reason="ROS 2 needs the extra ros")
pytest.importorskip("zenoh", reason="ROS 2 over Zenoh needs the extra ros-zenoh")

import test_ros

PORT = 20_000 + os.getpid() % 20_000


def corner(patch: pytest.MonkeyPatch) -> None:
    """A corner of the graph for this test process: multicast of its own, and no router."""
    patch.setenv("RMW_IMPLEMENTATION", "rmw_zenoh_cpp")
    patch.setenv(
        "ZENOH_CONFIG_OVERRIDE", f'scouting/multicast/address="224.0.0.224:{PORT}";connect/endpoints=[]'
    )
    patch.setenv("ROS_DOMAIN_ID", str(test_ros.DOMAIN))


@pytest.fixture(autouse=True)
def _corner(monkeypatch: pytest.MonkeyPatch) -> None:
    corner(monkeypatch)


@pytest.fixture(scope="class")
def robot() -> Iterator[Any]:
    with pytest.MonkeyPatch.context() as patch:
        corner(patch)
        made = test_ros._Robot()
        yield made
        made.stop()


class TestSource(test_ros.TestSource):
    pass


class TestGraph(test_ros.TestGraph):
    test_domains = None  # of DDS alone


@pytest.mark.usefixtures("robot")
class TestDriver(test_ros.TestDriver):
    pass


class TestDriverAlone(test_ros.TestDriverAlone):
    pass


class TestTasks(test_ros.TestTasks):
    pass


class TestBoard(test_ros.TestBoard):
    pass


class TestProcesses(test_ros.TestProcesses):
    pass


class TestCommands(test_ros.TestCommands):
    pass
