"""Real arms on the command line: which drivers there are, and what they say of a run."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import InputError, suggest

if TYPE_CHECKING:
    from ..arm import Arm
    from ..drivers.servos import ServoDriver
    from ..weigh import Session

DRIVERS = ("dynamixel", "feetech", "ros")


def make_driver(name: str, arm: Arm, port: str | None, bus: Path | None, rate: float) -> ServoDriver:
    """A driver by name, closed.

    Raises:
        InputError: no such driver, no port, or a bus file that does not fit.
        MissingExtraError: its extra is not installed.
    """
    if name not in DRIVERS:
        raise InputError(f"no driver {name!r}; {suggest(name, DRIVERS, 'there are')}")
    if name == "ros":
        raise InputError("--driver ros watches an arm that others move; it cannot move one")
    if port is None:
        raise InputError(f"--driver {name} needs --port, e.g. --port /dev/ttyUSB0")
    from ..drivers.bus import Bus

    servos = None if bus is None else Bus.from_yaml(bus)
    if name == "dynamixel":
        from ..drivers.dynamixel import DynamixelDriver

        return DynamixelDriver(arm, port, bus=servos, rate=rate)
    if servos is None:
        raise InputError("--driver feetech needs --bus FILE: these servos do not say which version they are")
    from ..drivers.feetech import FeetechDriver

    return FeetechDriver(arm, port, bus=servos, rate=rate)


def bus_summary(driver: ServoDriver, session: Session) -> dict[str, Any]:
    """Rate reached [Hz] and what happened on the bus, plain values for JSON."""
    log = session.log
    rate = (len(log) - 1) / log.duration if len(log) > 1 else None
    return {"rate_hz": rate, "rate_asked_hz": 1e9 / driver.period_ns, **asdict(driver.statistics)}


def bus_words(summary: dict[str, Any]) -> str:
    """The same for people."""
    rate = summary["rate_hz"]
    words = [
        f"{'-' if rate is None else format(rate, '.1f')} of {summary['rate_asked_hz']:g} samples per second",
        f"{summary['lost']} of {summary['periods']} lost",
    ]
    words += [
        f"{summary[key]} {text}"
        for key, text in (
            ("corrupt", "damaged answers"),
            ("unanswered", "questions unanswered"),
            ("late", "periods skipped"),
        )
        if summary[key]
    ]
    return ", ".join(words)
