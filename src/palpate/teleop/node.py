"""One end of a teleoperator as a process of its own, the other one somewhere on the network; and both their recordings
as one."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np

from .._core import __version__
from ..errors import InputError
from ..logs import Event as LogEvent
from ..logs import Log, Recorder, Signal
from .channel import UdpChannel
from .coupling import Event, MasterCommand, SlaveCommand, event_words
from .ends import PERIOD, MasterEnd, SlaveEnd

_AXES = ("x", "y", "z", "turn x", "turn y", "turn z")
_TURNING = {"m": "rad", "m/s": "rad/s", "N": "N m"}
"""units of the axes of an orientation"""
_BEHIND = 0.05
"""a loop that is later than this gives its backlog up [s]"""


@dataclass(frozen=True, slots=True)
class LinkState:
    """What one end knows of the link, for people. NaN: not known yet."""

    alive: bool
    gain: float
    """0 apart, 1 coupled"""
    reason: str
    """what holds it or slows it down; empty: nothing does"""
    offset: float
    """the other side's clock less ours [s]"""
    round_trip: float
    """of the newest packet [s]"""
    loss: float
    """part of the other side's packets that did not come [1]"""
    bandwidth: tuple[float, float]
    """sent and received [bit/s]"""
    refused: Mapping[str, int]
    """packets not taken, by reason"""

    def __str__(self) -> str:
        """One line."""
        known = "" if math.isnan(self.offset) else f"clock {1e3 * self.offset:+.2f} ms, "
        known += "" if math.isnan(self.round_trip) else f"round trip {1e3 * self.round_trip:.1f} ms, "
        known += "" if math.isnan(self.loss) else f"lost {100.0 * self.loss:.1f} %, "
        rate = f"out {self.bandwidth[0] / 1e6:.2f}, in {self.bandwidth[1] / 1e6:.2f} Mbit/s"
        refused = "".join(f", {count} {kind}" for kind, count in self.refused.items())
        state = self.reason or ("coupled" if self.gain == 1.0 else "coming together")
        return f"{state}; {known}{rate}{', refused:' + refused[1:] if refused else ''}"


class Node:
    """One end, its channel and its recording; :meth:`step` it every millisecond, or :meth:`run` it.

    Args:
        end: device or arm.
        channel: to the other side.
        record: where to record this side, on this side's clock; replaces what is there. None: nowhere.
        tell: told what holds it, whenever that changes.

    Raises:
        LogError: the recording cannot be written.
    """

    def __init__(
        self,
        end: MasterEnd | SlaveEnd,
        channel: UdpChannel,
        *,
        record: str | PathLike[str] | None = None,
        tell: Callable[[str], None] = lambda text: None,
    ) -> None:
        self.end, self.channel, self._tell = end, channel, tell
        self.reason = ""
        """what holds it or slows it down; empty: nothing does"""
        self._theirs = ""
        self._recorder: Recorder | None = None
        if record is not None:
            names = _AXES if isinstance(end, MasterEnd) else end.slave.model.joint_names
            session = {"what": f"teleoperation: {channel.sealer.role}", "palpate": __version__}
            self._recorder = Recorder(record, names, session=session, overwrite=True)

    def step(self) -> None:
        """One period."""
        end = self.end
        for message in self.channel.receive():
            if end.side.receive(message):
                self._theirs = message.reason
        now = time.time_ns()
        command = end.step(now)
        self.channel.send(end.side.message(end.reason))
        reason = self._why(command.events)
        if reason != self.reason:
            self.reason = reason
            self._tell(reason)
            if self._recorder is not None:
                self._recorder.event(now, "held" if reason else "free", reason)
        if self._recorder is not None:
            self._write(self._recorder, now, command)

    def _why(self, events: Event) -> str:
        """What holds it, the gravest thing first."""
        sealer, role = self.channel.sealer, self.channel.sealer.role
        if events & Event.LINK:
            return f"the link is dead: held ({sealer.reason or 'nothing is heard'})"
        if self.end.reason:
            return self.end.reason
        if self._theirs:
            return f"{'slave' if role == 'master' else 'master'}: {self._theirs}"
        return event_words(events & (Event.CLUTCH | Event.INPUT | Event.WORKSPACE))

    def _write(self, out: Recorder, now: int, command: MasterCommand | SlaveCommand) -> None:
        end = self.end
        if isinstance(end, MasterEnd):
            out.sample(now, end.x, end.v, command.force)
            name = "master"
        elif isinstance(command, SlaveCommand):
            name, seen = "slave", end.seen
            out.sample(now, seen.q, None, end.slave.driver.plant.torque)
            truth = end.slave.true_wrench()
            for what, torque, value, unit in (
                ("slave_tip", "slave_turn", seen.x, "m"),
                ("slave_reference", "slave_reference_turn", command.position, "m"),
                ("slave_force", "slave_torque", seen.force, "N"),
                ("slave_force_std", "slave_torque_std", seen.std, "N"),
                ("true_force", "true_torque", truth, "N"),
            ):
                out.signal(what, now, value[:3], unit)
                out.signal(torque, now, value[3:], _TURNING[unit])
        out.signal(f"{name}_felt", now, command.felt[:3], "N")
        out.signal(f"{name}_felt_torque", now, command.felt[3:], "N m")
        out.signal(f"{name}_events", now, float(command.events))
        out.signal(f"{name}_tank", now, end.side.tank()["level"], "J")
        clock = self.channel.sealer.clock
        if not math.isnan(clock.offset):
            out.signal("clock_offset", now, clock.offset, "s")
            out.signal("round_trip", now, clock.last_round_trip, "s")

    def state(self) -> LinkState:
        """What is known of the link."""
        sealer = self.channel.sealer
        return LinkState(
            alive=self.end.side.alive,
            gain=self.end.side.gain,
            reason=self.reason,
            offset=sealer.clock.offset,
            round_trip=sealer.clock.last_round_trip,
            loss=sealer.lost(),
            bandwidth=self.channel.bandwidth(),
            refused=sealer.refusals(),
        )

    def run(
        self,
        stop: Callable[[], bool],
        *,
        seconds: float = math.inf,
        show: Callable[[LinkState], None] = lambda state: None,
        every: float = 1.0,
    ) -> None:
        """A step per millisecond until `stop` or the end; where the computer is too slow, time passes slowly.

        Args:
            stop: asked every period.
            seconds: at most, in periods of this side.
            show: told the state.
            every: so often [s].
        """
        begin = next_at = time.monotonic()
        shown, count = begin, 0
        while not stop() and count * PERIOD < seconds:
            self.step()
            count += 1
            next_at += PERIOD
            now = time.monotonic()
            if now - shown >= every:
                shown = now
                show(self.state())
            if next_at > now:
                time.sleep(next_at - now)
            elif now - next_at > _BEHIND:
                next_at = now

    def close(self) -> None:
        """End the recording and let go of channel and arm."""
        if self._recorder is not None:
            self._recorder.close()
        self.channel.close()
        if isinstance(self.end, SlaveEnd):
            self.end.slave.close()


def join(master: Log, slave: Log) -> Log:
    """Both sides' recordings as one, on the master's clock.

    The slave's clock is taken off by what the master knew of it in the end, which is good to half the quickest round
    trip. Joints are the slave's; what belongs to the master has a name that says so.

    Raises:
        InputError: the recordings are not of the two sides, or they never met.
    """
    for log, side in ((master, "master"), (slave, "slave")):
        if log.meta.get("what") != f"teleoperation: {side}":
            raise InputError(
                f"not a recording of a {side}: its first message says {log.meta.get('what', 'nothing')!r}"
            )
    known = master.signals.get("clock_offset")
    if known is None or not len(known):
        raise InputError("the master's recording knows no clock offset: the two sides never met")
    offset = float(known.value[-1])
    shift = round(offset * 1e9)
    signals: dict[str, Signal] = {}
    for name, signal in slave.signals.items():
        own = name if name.startswith(("slave_", "true_")) else f"slave_{name}"
        signals[own] = Signal(signal.time_ns - shift, signal.value, signal.unit)
    for name, signal in master.signals.items():
        signals[name if name.startswith("master_") else f"master_{name}"] = signal
    assert master.velocity is not None
    for name, turn, value, unit in (
        ("master_position", "master_turn", master.position, "m"),
        ("master_velocity", "master_spin", master.velocity, "m/s"),
        ("master_force", "master_torque", master.effort, "N"),
    ):
        signals[name] = Signal(master.time_ns, value[:, :3], unit)
        signals[turn] = Signal(master.time_ns, value[:, 3:], _TURNING[unit])
    events = [LogEvent(e.time_ns, e.kind, f"master: {e.text}") for e in master.events]
    events += [LogEvent(e.time_ns - shift, e.kind, f"slave: {e.text}") for e in slave.events]
    meta = {**slave.meta, "what": "teleoperation", "clock_offset_s": f"{offset:.9g}"}
    return Log(
        time_ns=slave.time_ns - shift,
        position=slave.position,
        effort=slave.effort,
        joint_names=slave.joint_names,
        velocity=slave.velocity,
        model_torque=slave.model_torque,
        signals=signals,
        events=tuple(sorted(events, key=lambda e: e.time_ns)),
        meta=meta,
    )


def join_files(master: str | PathLike[str], slave: str | PathLike[str], out: str | PathLike[str]) -> Path:
    """See :func:`join`; an existing file is replaced.

    Raises:
        InputError: see there.
        LogError: a file cannot be read or written.
    """
    target = Path(out)
    both = join(Log.open(master), Log.open(slave))
    if not np.all(np.diff(both.time_ns) >= 0):
        raise InputError("the slave's clock was set back while it recorded: its times cannot be put in order")
    both.save(target, overwrite=True)
    return target
