"""Teleoperation: a hand moves a master, an arm elsewhere follows, and the hand feels what the arm touches, without
a force sensor."""

from __future__ import annotations

from .._core import LinkOptions, TankOptions
from .channel import (
    ChannelError,
    Clock,
    Faults,
    FaultyLine,
    Message,
    Sealer,
    UdpChannel,
    make_key,
    read_key,
)
from .coupling import (
    COUPLINGS,
    CouplingName,
    Event,
    MasterCommand,
    MasterSide,
    SlaveCommand,
    SlaveSide,
    event_words,
    felt_force,
)
from .masters import Hand, HapticDevice, Keys

__all__ = [
    "COUPLINGS",
    "ChannelError",
    "Clock",
    "CouplingName",
    "Event",
    "Faults",
    "FaultyLine",
    "Hand",
    "HapticDevice",
    "Keys",
    "LinkOptions",
    "MasterCommand",
    "MasterSide",
    "Message",
    "Sealer",
    "SlaveCommand",
    "SlaveSide",
    "TankOptions",
    "UdpChannel",
    "event_words",
    "felt_force",
    "make_key",
    "read_key",
]
