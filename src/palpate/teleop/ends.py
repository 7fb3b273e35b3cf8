"""The two ends of a teleoperator, one period at a time: a device in a hand, an arm that touches. Both the simulation
in one process and the two processes on a network run these."""

from __future__ import annotations

import math

import numpy as np

from ..arm import Array
from ..errors import DriverError
from .coupling import Event, MasterCommand, MasterSide, SlaveCommand, SlaveSide, felt_force
from .masters import Device
from .slaves import InScene, Seen

PERIOD = 1e-3
"""[s]"""
HAND = 40.0
"""bandwidth with which the hand's force is told by that of the device [rad/s]: a light device moves as the two are not
equal, and a hand's own will is slower"""


class MasterEnd:
    """A device and what the hand that holds it feels. A device of fewer axes than its side keeps the others at zero:
    one that knows no orientation leaves that of the slave.

    Args:
        device: held by its hand.
        side: what the hand feels.
        closed: the clutch at the start.
    """

    def __init__(self, device: Device, side: MasterSide, *, closed: bool = True) -> None:
        self.device, self.side, self.closed = device, side, closed
        self.x, self.v = np.zeros(side.n), np.zeros(side.n)
        self.reason = ""
        """what holds it; empty: nothing does"""
        self._hand = np.zeros(side.n)
        self._axes = side.n

    def step(self, now_ns: int) -> MasterCommand:
        """One period; a device that is gone opens the clutch, and says so."""
        axes, n = self._axes, self.side.n
        try:
            x, v = self.device.read()
            axes = self._axes = min(len(x), n)
            self.x, self.v = np.zeros(n), np.zeros(n)
            self.x[:axes], self.v[:axes] = x[:axes], v[:axes]
            gone = ""
        except DriverError as error:
            self.v, gone = np.zeros(self.side.n), f"device: {error}"
        closed = self.closed and not gone
        command = self.side.step(self.x, self.v, PERIOD, now_ns, hand=self._hand, closed=closed)
        self._hand = self._hand - math.expm1(-HAND * PERIOD) * (-command.force - self._hand)
        if not gone:
            self.device.step(command.force[:axes], PERIOD)
        self.reason = gone or (
            "a reading of the device is not a number" if command.events & Event.INPUT else ""
        )
        return command


class SlaveEnd:
    """An arm that follows and tells what it touches.

    Args:
        slave: in its scene.
        side: where it goes.
    """

    def __init__(self, slave: InScene, side: SlaveSide) -> None:
        self.slave, self.side = slave, side
        self.seen: Seen = slave.seen
        self.reason = ""
        """what holds it or slows it down; empty: nothing does"""

    def step(self, now_ns: int) -> SlaveCommand:
        """One period."""
        seen = self.seen = self.slave.read()
        # noise is no work: the reference pays for what is felt
        std = seen.std if seen.felt_std is None else seen.felt_std
        port: Array = felt_force(seen.force, std, self.side.threshold)
        force = seen.force
        if seen.beyond is not None:
            # the end of what the arm can follow is felt like the end of the workspace
            force, std = port - self.side.wall * seen.beyond, np.zeros(len(port))
        command = self.side.step(seen.x, seen.v, force, std, PERIOD, now_ns, port=port, allowed=seen.usable)
        self.slave.follow(command.position, command.velocity, command.force)
        out = "end of the slave's workspace" if command.events & Event.WORKSPACE else ""
        self.reason = seen.reason or out
        return command
