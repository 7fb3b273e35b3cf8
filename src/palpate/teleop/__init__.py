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
from .input_devices import InputSource
from .masters import Hand, HapticDevice
from .rate_control import RateMaster, TerminalKeys

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
    "InputSource",
    "LinkOptions",
    "MasterCommand",
    "MasterSide",
    "Message",
    "RateMaster",
    "Sealer",
    "SlaveCommand",
    "SlaveSide",
    "TankOptions",
    "TerminalKeys",
    "UdpChannel",
    "event_words",
    "felt_force",
    "make_key",
    "read_key",
]
