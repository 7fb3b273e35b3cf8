"""Teleoperation: a hand moves a master, an arm elsewhere follows, and the hand feels what the arm touches, without a force sensor."""

from __future__ import annotations

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

__all__ = [
    "ChannelError",
    "Clock",
    "Faults",
    "FaultyLine",
    "Message",
    "Sealer",
    "UdpChannel",
    "make_key",
    "read_key",
]
