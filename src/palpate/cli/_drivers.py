"""Real arms on the command line: which drivers there are, and what they say of a run."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..errors import InputError, suggest

if TYPE_CHECKING:
    from ..arm import Arm
    from ..drivers import Driver
    from ..weigh import Trial

DriverName = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        help="A real arm instead of a simulated one: dynamixel, feetech, ur or fri; or ros, an arm that others "
        "move and publish.",
        show_default=False,
    ),
]
Port = Annotated[
    str | None,
    typer.Option(
        metavar="PORT",
        help="Its serial port, e.g. /dev/ttyUSB0; of fri the UDP port. [default for fri: 30200]",
        show_default=False,
    ),
]
Host = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS",
        help="Of its controller (ur, fri). [default for fri: whoever sends]",
        show_default=False,
    ),
]
Bus = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="Which servo moves which joint. [default: ids 1, 2, ... in the order of the joints]",
        show_default=False,
    ),
]
Rate = Annotated[
    float | None,
    typer.Option(
        metavar="HZ",
        help="Its control rate. [default: 250 for servos, 500 for ur and fri]",
        show_default=False,
    ),
]
Topic = Annotated[
    str | None,
    typer.Option(
        metavar="NAME", help="With --driver ros, where. [default: /joint_states]", show_default=False
    ),
]
States = Annotated[
    str | None,
    typer.Option(
        metavar="KIND",
        help="With --driver ros, what: joint_state or lbr_state (lbr_fri_ros2_stack). [default: joint_state]",
        show_default=False,
    ),
]
Stamp = Annotated[
    str | None,
    typer.Option(
        metavar="CLOCK",
        help="With --driver ros, whose time counts: header, or arrival if stamps are zero. [default: header]",
        show_default=False,
    ),
]

_OPTIONS = {
    "dynamixel": ("--port", "--bus"),
    "feetech": ("--port", "--bus"),
    "ur": ("--host",),
    "fri": ("--host", "--port"),
    "ros": ("--topic", "--states", "--stamp"),
}
"""driver: options that it takes, beside --rate"""
DRIVERS = tuple(_OPTIONS)
_RATE_HZ = {"dynamixel": 250.0, "feetech": 250.0, "ur": 500.0, "fri": 500.0}
"""unless told otherwise"""


def make_driver(
    name: str, arm: Arm, *, port: str | None, bus: Path | None, host: str | None, rate: float | None
) -> Driver:
    """A driver by name, closed, that takes torque.

    Raises:
        InputError: no such driver, an option that it needs or does not take, or a bus file that does not fit.
        DriverError: a number that the driver does not take.
        MissingExtraError: its extra is not installed.
    """
    if name not in DRIVERS:
        raise InputError(f"no driver {name!r}; {suggest(name, DRIVERS, 'there are')}")
    if name == "ros":
        raise InputError("--driver ros watches an arm that others move; it cannot move one")
    for option, value in (("--port", port), ("--bus", bus), ("--host", host)):
        if value is not None and option not in _OPTIONS[name]:
            takes = " and ".join(_OPTIONS[name])
            raise InputError(f"--driver {name} takes {takes}, not {option}")
    hertz = _RATE_HZ[name] if rate is None else rate
    if name == "ur":
        if host is None:
            raise InputError("--driver ur needs --host, e.g. --host 192.168.1.10")
        from ..drivers.ur_rtde import UrDriver

        return UrDriver(arm, host, mode="torque", frequency=hertz)
    if name == "fri":
        from ..drivers.fri import FriDriver

        if not hertz > 0.0:
            raise InputError(f"--rate must be a number > 0 Hz, got {hertz!r}")
        options: dict[str, Any] = {} if port is None else {"port": _number(port)}
        return FriDriver(arm, mode="torque", period=1.0 / hertz, controller=host, **options)
    if port is None:
        raise InputError(f"--driver {name} needs --port, e.g. --port /dev/ttyUSB0")
    from ..drivers.bus import Bus

    servos = None if bus is None else Bus.from_yaml(bus)
    if name == "dynamixel":
        from ..drivers.dynamixel import DynamixelDriver

        return DynamixelDriver(arm, port, bus=servos, rate=hertz)
    if servos is None:
        raise InputError("--driver feetech needs --bus FILE: these servos do not say which version they are")
    from ..drivers.feetech import FeetechDriver

    return FeetechDriver(arm, port, bus=servos, rate=hertz)


def make_watcher(
    arm: Arm, *, topic: str | None, states: str | None, stamp: str | None, rate: float | None
) -> Driver:
    """A driver, closed, that watches an arm which others move in a ROS 2 graph.

    Raises:
        InputError: no such kind of states or stamps.
        DriverError: the rate is out of range.
        MissingExtraError: the extra ``ros`` is not installed.
    """
    from .. import ros
    from ..ros.source import KINDS, STAMPS

    kind = next((k for k in KINDS if k == (states or KINDS[0])), None)
    clock = next((s for s in STAMPS if s == (stamp or STAMPS[0])), None)
    if kind is None or clock is None:
        raise InputError(f"--states is {' or '.join(KINDS)}, --stamp is {' or '.join(STAMPS)}")
    hertz = 250.0 if rate is None else rate
    return ros.RosDriver(arm, topic or "/joint_states", kind=kind, stamp=clock, rate=hertz, patience=10.0)


def _number(port: str) -> int:
    try:
        return int(port)
    except ValueError:
        raise InputError(f"--port of --driver fri is a UDP port such as 30200, got {port!r}") from None


def line_summary(driver: Driver, trial: Trial) -> dict[str, Any]:
    """Rate reached [Hz] and what happened on the line to the arm, plain values for JSON."""
    from ..drivers.fri import FriDriver
    from ..drivers.servos import ServoDriver
    from ..drivers.ur_rtde import UrDriver

    log = trial.log
    rate = (len(log) - 1) / log.duration if len(log) > 1 else None
    found: dict[str, Any] = {"rate_hz": rate, "rate_asked_hz": 1e9 / driver.period_ns}
    if isinstance(driver, ServoDriver):
        return {**found, **asdict(driver.statistics)}
    if isinstance(driver, FriDriver):
        found |= {"lost": driver.lost, "corrupt": driver.refused, "late": driver.late}
    elif isinstance(driver, UrDriver):
        found |= {"lost": driver.lost}
    return {**found, "periods": len(log) + found.get("lost", 0)}


def line_words(summary: dict[str, Any]) -> str:
    """The same for people."""
    rate = summary["rate_hz"]
    words = [
        f"{'-' if rate is None else format(rate, '.1f')} of {summary['rate_asked_hz']:g} samples per second",
        f"{summary['lost']} of {summary['periods']} lost",
    ]
    late = "periods skipped" if "unanswered" in summary else "commands too late"
    words += [
        f"{summary[key]} {text}"
        for key, text in (
            ("corrupt", "damaged answers" if "unanswered" in summary else "datagrams passed over"),
            ("unanswered", "questions unanswered"),
            ("late", late),
        )
        if summary.get(key)
    ]
    return ", ".join(words)
