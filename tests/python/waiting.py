"""Waiting for what another thread or process does; long, because the machine may be busy."""

from __future__ import annotations

import time
from collections.abc import Callable

from palpate.drivers import Driver, Sample

LONG_S = 30.0


def until(what: Callable[[], bool]) -> None:
    """Wait until `what` is true."""
    deadline = time.monotonic() + LONG_S
    while not what():
        assert time.monotonic() < deadline, "it did not happen"
        time.sleep(0.001)


def following(driver: Driver) -> Sample:
    """The next sample that comes."""
    deadline = time.monotonic() + LONG_S
    while (sample := driver.read()) is None:
        assert time.monotonic() < deadline, "no sample"
    return sample
