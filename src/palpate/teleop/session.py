"""A teleoperator in one process, period by period: hand, device, both sides, the packets between them, the slave,
what really happened."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from .._core import turn_between, turned
from ..arm import Array
from ..errors import InputError
from .channel import Faults, FaultyLine, Sealer
from .coupling import Event, MasterSide, SlaveSide
from .ends import PERIOD, MasterEnd, SlaveEnd
from .masters import Device
from .slaves import InScene

Progress: TypeAlias = Callable[[float, float], None]
"""told the simulated time and the whole time [s], now and then"""


@dataclass(frozen=True, slots=True)
class Wish:
    """What somebody who watches wants of the next period."""

    faults: Faults
    """of the network, each way"""
    cut: bool = False
    """the link is dead"""
    closed: bool = True
    """the clutch"""


Tap: TypeAlias = "Callable[[int, Run], Wish]"
"""told the period and the run as far as it is"""


@dataclass(frozen=True, slots=True)
class Cut:
    """The link dies for a while."""

    at: float
    """[s]"""
    seconds: float
    """[s]"""


@dataclass(slots=True, eq=False)
class Run:
    """What happened, one row per period; (N, 3) in base axes of the slave, but the device's own columns.

    Joint to joint they are (N, n), with [rad] and [N m] in place of [m] and [N], and the columns of orientation (N, 0).

    Attributes:
        time: (N,) [s].
        device, device_velocity: of the haptic device, its axes and scale [m, m/s].
        wanted: where the device points, the slave's axes and scale [m].
        tip, tip_velocity: of the slave's tool [m, m/s].
        reference: of the slave [m].
        force: of the device on the hand, device axes [N].
        felt: of it, what the environment does [N].
        estimated, std: force of the environment by the pipeline [N].
        true: the same from MuJoCo [N].
        device_turn: orientation of the device, a rotation vector as all orientations here [rad].
        wanted_turn: where the device turns the tool to, the slave's axes [rad].
        tip_turn, tip_spin: of the slave's tool [rad, rad/s].
        reference_turn: of the slave [rad].
        torque: of the device on the hand, device axes [N m].
        felt_torque: of it, what the environment does [N m].
        estimated_torque, torque_std: moment of the environment about the tool's tip by the pipeline [N m].
        true_torque: the same from MuJoCo [N m].
        master_events, slave_events: (N,) Event bits.
        levels: (N, 2) of the tanks, master and slave [J].
        q: (N, n) of the slave's joints [rad].
        effort: (N, n) as the driver gave it.
        reasons: (time [s], text): what held or slowed down, when it began.
        holding: the newest of them still does.
        offset, round_trip: of the slave's clock against the master's [s]; 0 for one clock.
        bandwidth: (2,) from master to slave and back [bit/s].
        refused: packets not taken, by reason.
        tanks: energies of both sides at the end [J].
        held: (time [s], true [kg], weighed [kg], std [kg]) of objects lifted.
    """

    time: Array
    device: Array
    device_velocity: Array
    wanted: Array
    tip: Array
    tip_velocity: Array
    reference: Array
    force: Array
    felt: Array
    estimated: Array
    std: Array
    true: Array
    device_turn: Array
    wanted_turn: Array
    tip_turn: Array
    tip_spin: Array
    reference_turn: Array
    torque: Array
    felt_torque: Array
    estimated_torque: Array
    torque_std: Array
    true_torque: Array
    master_events: npt.NDArray[np.int64]
    slave_events: npt.NDArray[np.int64]
    levels: Array
    q: Array
    effort: Array
    reasons: list[tuple[float, str]] = field(default_factory=list)
    holding: bool = False
    offset: float = math.nan
    round_trip: float = math.nan
    bandwidth: tuple[float, float] = (0.0, 0.0)
    refused: dict[str, int] = field(default_factory=dict)
    tanks: dict[str, dict[str, float]] = field(default_factory=dict)
    held: list[tuple[float, float, float, float]] = field(default_factory=list)

    @classmethod
    def empty(cls, count: int, n: int, *, pose: bool) -> Run:
        """Room for `count` periods of a slave with `n` joints, whose pose is coupled, or else its joints."""

        def each() -> Array:
            return np.zeros((count, 3 if pose else n))

        def turn() -> Array:
            return np.zeros((count, 3 if pose else 0))

        return cls(
            time=np.arange(count, dtype=np.float64) * PERIOD,
            device=each(),
            device_velocity=each(),
            wanted=each(),
            tip=each(),
            tip_velocity=each(),
            reference=each(),
            force=each(),
            felt=each(),
            estimated=each(),
            std=each(),
            true=each(),
            device_turn=turn(),
            wanted_turn=turn(),
            tip_turn=turn(),
            tip_spin=turn(),
            reference_turn=turn(),
            torque=turn(),
            felt_torque=turn(),
            estimated_torque=turn(),
            torque_std=turn(),
            true_torque=turn(),
            master_events=np.zeros(count, dtype=np.int64),
            slave_events=np.zeros(count, dtype=np.int64),
            levels=np.zeros((count, 2)),
            q=np.zeros((count, n)),
            effort=np.zeros((count, n)),
        )


def _weighs(since: float, force: Array, std: Array) -> bool:
    """An object lifted `since` [s] can be weighed: settled, and known to a twentieth; or it is high time.

    Where friction hides the weight at rest, that is once the arm moves.
    """
    return since >= 0.5 and (since >= 2.5 or bool(np.all(std <= 0.05 * abs(float(force.mean())))))


def run(
    device: Device,
    slave: InScene,
    master_side: MasterSide,
    slave_side: SlaveSide,
    seconds: float,
    *,
    motion_scale: float = 1.0,
    turn_scale: float = 1.0,
    faults: Faults | None = None,
    cuts: tuple[Cut, ...] = (),
    closed: Callable[[float], bool] = lambda time: True,
    weigh: bool = False,
    progress: Progress | None = None,
    stop: Callable[[], bool] = lambda: False,
    tap: Tap | None = None,
    seed: int = 0,
) -> Run:
    """Run both sides in lock-step over a line with faults; every message goes through the encrypted packets of the
    channel.

    Args:
        device: held by its hand.
        slave: in its scene.
        master_side: what the hand feels.
        slave_side: where the slave goes.
        seconds: how long.
        motion_scale, turn_scale: those of the slave's side, for the columns `wanted` and `wanted_turn`.
        faults: of the network, each way; None: none.
        cuts: when the link is dead.
        closed: the clutch at a time [s].
        weigh: weigh what is lifted.
        progress: told how far it is.
        stop: asked now and then; True ends the run there.
        tap: called at the end of every period; what it wants is done in the next one.
        seed: of the faults and the packets' salts.

    Raises:
        InputError: a length that is not positive.
    """
    if not 0.0 < seconds <= 3600.0:
        raise InputError(f"seconds must be above 0 to 3600, got {seconds!r}")
    count = round(seconds / PERIOD)
    out = Run.empty(count, slave.model.n, pose=slave.pose)
    rng = np.random.default_rng(seed)
    key = rng.bytes(32)
    boxes = {
        "master": Sealer(key, "master", 1, slave.axes, salt=rng.bytes(8)),
        "slave": Sealer(key, "slave", 1, slave.axes, salt=rng.bytes(8)),
    }
    there, back = (FaultyLine(seed=seed + k) for k in range(2))
    sent = [0, 0]
    places = slice(0, 3 if slave.pose else slave.axes)
    start = slave.seen.x.copy()
    master, follower = MasterEnd(device, master_side), SlaveEnd(slave, slave_side)
    reason, heard, wish = "", False, Wish(faults or Faults())
    picked: float | None = None
    picked_at = 0.0
    for k in range(count):
        time, now = k * PERIOD, k * 1_000_000
        there.cut = back.cut = wish.cut or any(c.at <= time < c.at + c.seconds for c in cuts)
        there.faults = back.faults = wish.faults
        for packet in back.receive(now):
            if (answer := boxes["master"].open(packet, now)) is not None:
                master_side.receive(answer)
        master.closed = closed(time) and wish.closed
        command = master.step(now)
        packet = boxes["master"].seal(master_side.message(), now)
        sent[0] += len(packet) + 28
        there.send(packet, now)

        if (mass := slave.advance(time)) is not None:
            picked, picked_at = mass, time
        for packet in there.receive(now):
            if (told := boxes["slave"].open(packet, now)) is not None:
                slave_side.receive(told)
        reference = follower.step(now)
        seen = follower.seen
        packet = boxes["slave"].seal(slave_side.message(), now)
        sent[1] += len(packet) + 28
        back.send(packet, now)
        lately, sure = out.estimated[k - 200 : k, 2], out.std[k - 200 : k, 2]
        if weigh and picked and _weighs(time - picked_at, lately, sure):
            # what is felt is the weight; from then on it is known, and the hand is spared it
            rise = out.tip_velocity[k - 200 : k, 2]
            pull = 9.81 + float(rise[-1] - rise[0]) / (len(rise) * PERIOD)
            found, std = float(-lately.mean() / pull), float(out.std[k - 1, 2] / pull)
            out.held.append((time, picked, found, std))
            slave.hold(max(0.0, found))
            picked = None
        elif weigh and picked == 0.0:
            slave.hold(0.0)
            picked = None

        out.device[k], out.device_velocity[k] = master.x[places], master.v[places]
        out.force[k], out.felt[k] = command.force[places], command.felt[places]
        out.tip[k], out.tip_velocity[k] = seen.x[places], seen.v[places]
        out.reference[k] = reference.position[places]
        out.estimated[k], out.std[k] = seen.force[places], seen.std[places]
        if slave.pose:
            out.device_turn[k], out.reference_turn[k] = master.x[3:], reference.position[3:]
            out.tip_turn[k], out.tip_spin[k] = seen.x[3:], seen.v[3:]
            out.torque[k], out.felt_torque[k] = command.force[3:], command.felt[3:]
            out.estimated_torque[k], out.torque_std[k] = seen.force[3:], seen.std[3:]
            before = out.wanted_turn[k - 1] if k else start[3:]
            moved = turn_between(master.x[3:], out.device_turn[max(0, k - 1)])
            out.wanted_turn[k] = turned(before, turn_scale * moved)
            truth = slave.true_wrench()
            out.true[k], out.true_torque[k] = truth[:3], truth[3:]
        else:
            out.true[k] = slave.true_force()
        out.master_events[k], out.slave_events[k] = command.events, reference.events
        out.q[k], out.effort[k] = seen.q, slave.driver.plant.torque
        out.levels[k] = master_side.tank()["level"], slave_side.tank()["level"]
        now_reason = master.reason or follower.reason
        silent = bool((command.events | reference.events) & Event.LINK)
        heard = heard or not silent
        now_reason = "the link is dead: both hold" if heard and silent else now_reason
        if now_reason != reason:
            reason = now_reason
            out.holding = bool(reason)
            if reason:
                out.reasons.append((time, reason))
        if tap is not None:
            wish = tap(k, out)
        if k % 200 == 199:
            if progress is not None:
                progress(time + PERIOD, seconds)
            if stop():
                count = k + 1
                break
    for name in out.__dataclass_fields__:
        value = getattr(out, name)
        if isinstance(value, np.ndarray):
            setattr(out, name, value[:count])
    out.wanted = start[places] + motion_scale * (out.device - out.device[0])
    out.offset, out.round_trip = boxes["master"].clock.offset, boxes["master"].clock.round_trip
    span = max(PERIOD, count * PERIOD)
    out.bandwidth = (8.0 * sent[0] / span, 8.0 * sent[1] / span)
    refused = boxes["master"].refused + boxes["slave"].refused
    out.refused = {kind: n for kind, n in refused.items() if kind != "greeting"}
    out.tanks = {"master": master_side.tank(), "slave": slave_side.tank()}
    return out
