"""The two sides of a teleoperator: what the hand feels, where the slave goes. Computed by the C++ core."""

from __future__ import annotations

import dataclasses
import math
import time
from enum import IntFlag
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from .._core import LinkOptions, MasterOptions, SlaveOptions, Status, TankOptions
from .._core import MasterSide as CoreMaster
from .._core import SlaveSide as CoreSlave
from .._core import felt_force as core_felt_force
from ..arm import Array
from ..errors import InputError
from .channel import Message

CouplingName: TypeAlias = Literal["force_position", "position_position", "four_channel"]
COUPLINGS: tuple[CouplingName, ...] = ("force_position", "position_position", "four_channel")


LEVER = 0.1
"""of a pose, where one number is given for all axes [m]: it is that of the place, and the orientation has what is alike
at such a lever (torque 0.1 times the force, stiffness 0.01 times, speed 10 times)"""


class Event(IntFlag):
    """What is the matter; 0 where everything is as wanted."""

    LINK = 1
    """nothing new has come for too long: both sides hold"""
    ENGAGING = 2
    """coming back, slowly"""
    CLUTCH = 4
    """a clutch is open"""
    ENERGY = 8
    """there is not the energy for what is wanted: force or motion was made smaller"""
    FORCE = 16
    """the force is at its limit"""
    SPEED = 32
    """the reference is at its largest speed"""
    WORKSPACE = 64
    """the master points out of what the slave may reach, or turns beyond its largest angle"""
    INPUT = 128
    """a number was not finite: the last good ones hold"""


_WORDS = {
    Event.LINK: "the link is dead: held",
    Event.ENGAGING: "coming back slowly",
    Event.CLUTCH: "clutch open",
    Event.ENERGY: "less force or motion: it would make energy",
    Event.FORCE: "force at its limit",
    Event.SPEED: "slave at its largest speed",
    Event.WORKSPACE: "end of the slave's workspace",
    Event.INPUT: "a reading was not a number: held",
}


def event_words(events: int) -> str:
    """The events in words, empty where there are none."""
    return "; ".join(words for bit, words in _WORDS.items() if events & bit)


class MasterCommand(NamedTuple):
    """What the device does to the hand."""

    force: Array
    """(n,) of the device on the hand [N]"""
    felt: Array
    """(n,) of it, what the environment does [N]"""
    events: Event
    status: Status
    """ok; saturated: a limit; held: the link is dead; non_finite: bad input"""


class SlaveCommand(NamedTuple):
    """Where the slave is to go, and what is told of its touch."""

    position: Array
    """(n,) reference [m]"""
    velocity: Array
    """(n,) of the reference [m/s]"""
    force: Array
    """(n,) to be added to what follows the reference; not zero with four_channel alone [N]"""
    felt: Array
    """(n,) of the environment as told, the slave's axes and scale [N]"""
    events: Event
    status: Status


class _Side:
    """What both sides share: messages out and in."""

    _core: Any

    def __init__(self, n: int, session: int | None) -> None:
        self.n = n
        """axes"""
        self._core.begin(time.time_ns() if session is None else session)

    def receive(self, message: Message) -> bool:
        """Take a message of the other side; False: it is old or broken, and was not used."""
        values = {f.name: getattr(message, f.name) for f in dataclasses.fields(message) if f.name != "reason"}
        return bool(self._core.receive(**values))

    def message(self, reason: str = "") -> Message:
        """To be sent after each step, with what holds this side, for people."""
        return Message(**self._core.message(), reason=reason)

    @property
    def alive(self) -> bool:
        """The other side is heard."""
        return bool(self._core.alive)

    @property
    def gain(self) -> float:
        """0 apart, 1 coupled."""
        return float(self._core.gain)

    def tank(self) -> dict[str, float]:
        """The energies of this side [J]: level, taken, given, sent, received, dissipated, lowest."""
        return dict(self._core.tank())


def _full(value: npt.ArrayLike, n: int, what: str, pose: bool, power: int) -> list[float]:
    """One number per axis; `power` of the lever, by which a number for the place is one for the orientation."""
    try:
        array = np.asarray(value, dtype=np.float64)
        if array.shape == () and pose:
            array = np.array([float(array) * (LEVER**power if 3 <= i < 6 else 1.0) for i in range(n)])
        return [float(x) for x in np.broadcast_to(array, (n,))]
    except (TypeError, ValueError):
        raise InputError(f"{what}: expected one number or {n}, got {value!r:.60}") from None


class MasterSide(_Side):
    """What the hand is made to feel: F = g F_env + K (x_s - x_m) + B (v_s - v_m) + holding, within its energy
    (docs/theory.md).

    Args:
        n: axes of the device, 1 to 16.
        force_limit: largest force of the device [N], one number or one per axis; so are the others. 0: the axis is
            measured and has no motor.
        pose: axes 0 to 2 are a place, 3 to 5 an orientation: its rotation vector [rad], angular velocity [rad/s] and
            torque [N m] in base axes. One number is then of the place, see :data:`LEVER`.
        coupling: "force_position" (as published), "position_position" or "four_channel".
        stiffness: of the spring between the two [N/m]; not used by force_position.
        damping: and of the damper [N s/m].
        fill: damping while the tank is empty [N s/m].
        contact_damping: damping in contact: it makes up for the estimate's delay [N s/m].
        contact_force: felt, from which on that damping is whole [N].
        hold_stiffness: of the spring that holds the device while the link is dead [N/m].
        hold_damping: and of its damper [N s/m].
        acceleration: of the device at most [m/s^2]; larger is safer, and needs a fuller tank.
        resync_rate: how fast the force may change while the two come together again [N/s].
        fade: time constant with which the force goes when the link dies [s].
        passive: the passivity layer; False only to see what happens without.
        link: when a link counts as dead, how slowly it returns.
        tank: energies.
        session: number of this run, larger than of any earlier; None: the time [ns].

    Raises:
        InputError: an option is out of range.
    """

    def __init__(
        self,
        n: int,
        force_limit: npt.ArrayLike,
        *,
        pose: bool = False,
        coupling: CouplingName = "force_position",
        stiffness: npt.ArrayLike = 300.0,
        damping: npt.ArrayLike = 5.0,
        fill: npt.ArrayLike = 1.0,
        contact_damping: npt.ArrayLike = 0.0,
        contact_force: npt.ArrayLike = 1.0,
        hold_stiffness: npt.ArrayLike = 200.0,
        hold_damping: npt.ArrayLike = 2.0,
        acceleration: npt.ArrayLike = 50.0,
        resync_rate: npt.ArrayLike = 150.0,
        fade: float = 0.3,
        passive: bool = True,
        link: LinkOptions | None = None,
        tank: TankOptions | None = None,
        session: int | None = None,
    ) -> None:
        vectors = {
            "force_limit": (force_limit, 1),
            "stiffness": (stiffness, 2),
            "damping": (damping, 2),
            "fill": (fill, 2),
            "contact_damping": (contact_damping, 2),
            "contact_force": (contact_force, 1),
            "hold_stiffness": (hold_stiffness, 2),
            "hold_damping": (hold_damping, 2),
            "acceleration": (acceleration, -1),
            "resync_rate": (resync_rate, 1),
        }
        try:
            options = MasterOptions(
                passive=passive,
                pose=pose,
                fade=fade,
                **{k: _full(v, n, k, pose, power) for k, (v, power) in vectors.items()},
            )
            self._core = CoreMaster(n, options, coupling, link or LinkOptions(), tank or TankOptions())
        except ValueError as error:
            raise InputError(str(error)) from None
        self._zeros = np.zeros(n)
        super().__init__(n, session)

    def step(
        self, x: Array, v: Array, dt: float, time_ns: int, *, hand: Array | None = None, closed: bool = True
    ) -> MasterCommand:
        """One period.

        Args:
            x: (n,) of the device [m].
            v: (n,) [m/s].
            dt: since the step before [s].
            time_ns: own clock [ns].
            hand: (n,) force of the hand on the device [N]; None: not known. four_channel tells it to the slave.
            closed: the clutch.
        """
        force, felt, events, status = self._core.step(
            x, v, self._zeros if hand is None else hand, closed, dt, time_ns
        )
        return MasterCommand(force, felt, Event(events), status)


class SlaveSide(_Side):
    """Where the slave is to go, and what is told of its touch; motion is limited, then bounded by energy
    (docs/theory.md).

    Args:
        n: axes of the slave, 3 to 16 in task space (6 with an orientation), 1 to 16 joint to joint.
        speed: of the reference at most [m/s], one number or one per axis; so are the others.
        lower: where the reference may be [m].
        upper: [m].
        force_limit: largest force that is told or fed forward [N].
        coupling: as the master's.
        task_space: the first three axes are a place in space, turned by `rotation`; False: joint to joint.
        pose: axes 3 to 5 are an orientation, turned by it too: a rotation vector [rad] in base axes, see
            :class:`MasterSide`. `lower` and `upper` are of the place, (3,) or one number per axis.
        rotation: (3, 3) R_slave_master.
        motion_scale: motion of the slave per motion of the master [1].
        turn_scale: rotation of the slave per rotation of the master [1]. Torques are scaled by
            force_scale turn_scale/motion_scale, as a force at a lever that is scaled like the motion.
        turn_limit: largest angle of the reference from the orientation at the start [rad], at most 3.
        force_scale: force felt per force of the environment [1].
        threshold: below so many standard deviations nothing is felt [1].
        acceleration: of the reference at most [m/s^2].
        resync: "index": after a pause the hand's new place counts as the slave's, nothing moves; "approach": the
        slave goes to the master's
            place slowly (arms of one kinematics).
        resync_speed: [m/s].
        resync_acceleration: [m/s^2].
        stiffness: K + 2 D/dt of spring and damper by which the slave follows, where the port's force is theirs; 0
        where it is the
            environment's [N/m].
        wall: stiffness with which the end of the workspace is shown to the hand [N/m].
        gain: with which the reference closes on the master's place [1/s].
        velocity_time: the master's velocity counts for so long after it was told [s].
        passive: the passivity layer; False only to see what happens without.
        link: when a link counts as dead, how slowly it returns.
        tank: energies.
        session: number of this run, larger than of any earlier; None: the time [ns].

    Raises:
        InputError: an option is out of range.
    """

    def __init__(
        self,
        n: int,
        speed: npt.ArrayLike,
        *,
        lower: npt.ArrayLike,
        upper: npt.ArrayLike,
        force_limit: npt.ArrayLike,
        coupling: CouplingName = "force_position",
        task_space: bool = True,
        pose: bool = False,
        rotation: npt.ArrayLike | None = None,
        motion_scale: float = 1.0,
        turn_scale: float = 1.0,
        turn_limit: float = 1.5,
        force_scale: float = 1.0,
        threshold: float = 3.0,
        acceleration: npt.ArrayLike = 20.0,
        resync: Literal["index", "approach"] = "index",
        resync_speed: npt.ArrayLike = 0.05,
        resync_acceleration: npt.ArrayLike = 0.2,
        stiffness: npt.ArrayLike = 0.0,
        wall: npt.ArrayLike = 500.0,
        gain: float = 60.0,
        velocity_time: float = 0.02,
        passive: bool = True,
        link: LinkOptions | None = None,
        tank: TankOptions | None = None,
        session: int | None = None,
    ) -> None:
        R = np.eye(3) if rotation is None else np.asarray(rotation, dtype=np.float64)
        if R.shape != (3, 3) or not np.allclose(R @ R.T, np.eye(3), atol=1e-6) or np.linalg.det(R) < 0.0:
            raise InputError(f"rotation: expected a rotation matrix (3, 3), got {R.tolist()}")
        if pose and np.shape(lower) == np.shape(upper) == (3,) and n > 3:
            rest = np.zeros(n - 3)
            rest[3:] = math.inf
            lower, upper = np.concatenate((lower, -rest)), np.concatenate((upper, rest))
        vectors = {
            "lower": (lower, 0),
            "upper": (upper, 0),
            "speed": (speed, -1),
            "acceleration": (acceleration, -1),
            "resync_speed": (resync_speed, -1),
            "resync_acceleration": (resync_acceleration, -1),
            "stiffness": (stiffness, 2),
            "wall": (wall, 2),
            "force_limit": (force_limit, 1),
        }
        try:
            options = SlaveOptions(
                passive=passive,
                task_space=task_space,
                pose=pose,
                turn_scale=turn_scale,
                turn_limit=turn_limit,
                motion_scale=motion_scale,
                force_scale=force_scale,
                threshold=threshold,
                gain=gain,
                velocity_time=velocity_time,
                **{k: _full(v, n, k, pose, power) for k, (v, power) in vectors.items()},
            )
            self._core = CoreSlave(
                n,
                options,
                coupling,
                resync,
                np.ascontiguousarray(R).ravel(),
                link or LinkOptions(),
                tank or TankOptions(),
            )
        except ValueError as error:
            raise InputError(str(error)) from None
        self.threshold = threshold
        """of what is felt, in standard deviations [1]"""
        self.force_scale = force_scale
        """force felt per force of the environment [1]"""
        self.wall = np.array(options.wall[:n])
        """(n,) stiffness with which the end of the workspace is shown [N/m, N m/rad]"""
        self.torque_scale = force_scale * turn_scale / motion_scale
        """torque felt per torque of the environment [1]"""
        super().__init__(n, session)

    def step(
        self,
        x: Array,
        v: Array,
        force: Array,
        std: Array,
        dt: float,
        time_ns: int,
        *,
        port: Array | None = None,
        allowed: bool = True,
    ) -> SlaveCommand:
        """One period.

        Args:
            x: (n,) of the slave [m].
            v: (n,) [m/s].
            force: (n,) of the environment as estimated, weight of tool and load taken away [N].
            std: (n,) its standard deviation [N].
            dt: since the step before [s].
            time_ns: own clock [ns].
            port: (n,) what the reference works against [N]; None: `force`.
            allowed: the slave may move.
        """
        position, velocity, push, felt, events, status = self._core.step(
            x, v, force if port is None else port, force, std, allowed, dt, time_ns
        )
        return SlaveCommand(position, velocity, push, felt, Event(events), status)


def felt_force(force: npt.ArrayLike, std: npt.ArrayLike, threshold: float = 3.0) -> Array:
    """What a hand may be shown of an estimated force: nothing below `threshold` standard deviations, all of it
    from twice that on, smooth
    between.

    Args:
        force: (n,) [N].
        std: (n,) [N].
        threshold: [1], >= 0.
    """
    F = np.ascontiguousarray(np.atleast_1d(force), dtype=np.float64)
    try:
        return core_felt_force(
            F, np.ascontiguousarray(np.broadcast_to(std, F.shape), dtype=np.float64), float(threshold)
        )
    except ValueError as error:
        raise InputError(str(error)) from None
