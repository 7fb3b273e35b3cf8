"""Which servo moves which joint: the bus file, and what follows from it in the units of the arm."""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..arm import Arm, Array, Effort
from ..errors import InputError, suggest

COUNTS_PER_TURN = 4096
"""of the position of every servo here"""
RAD_PER_COUNT = 2.0 * math.pi / COUNTS_PER_TURN
MIDDLE = COUNTS_PER_TURN // 2
MAX_ID = 252
BAUD = 1_000_000
"""unless told otherwise [bit/s]"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Servo:
    """One servo on the bus."""

    id: int
    """0 to 252"""
    joint: str
    """name of the arm's joint that it moves; two servos may share one, the first is the one whose position counts"""
    model: str | None = None
    """as its maker calls it, e.g. XM430-W350; None: what the servo says"""
    direction: int = 1
    """+1, or -1 where the servo turns against the joint"""
    zero: int = MIDDLE
    """its position at joint position 0 [counts of 1/4096 turn]"""
    gear: float = 1.0
    """turns of the servo's horn per turn of the joint, > 0"""
    torque_constant: float | None = None
    """torque at the horn per ampere that the servo reports [N m/A]; None: from the arm's card"""
    current_limit: float | None = None
    """largest current to be commanded [A]; None: what the servo and the joint's torque limit allow"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Bus:
    """The servos of an arm."""

    servos: tuple[Servo, ...]
    baud: int = BAUD
    """[bit/s]"""

    @classmethod
    def of(cls, arm: Arm, *, baud: int = BAUD) -> Bus:
        """Servos 1 to n for the joints in their order, in the joints' direction, in the middle at joint position 0."""
        return cls(servos=tuple(Servo(id=i + 1, joint=j) for i, j in enumerate(arm.joint_names)), baud=baud)

    @classmethod
    def from_yaml(cls, path: str | os.PathLike[str]) -> Bus:
        """A bus file; docs/hardware.md shows one.

        Raises:
            InputError: it cannot be read, or a field is wrong; the message names the place.
            MissingExtraError: the extra ``card`` is not installed.
        """
        from ._busfile import read

        return read(path)


class JointMap:
    """Registers of the servos to and from joints: positions, torques, and the driver's effort number.

    With s the direction, r the gear and k the torque constant of servo i, and (position, current) what it reports:
    joint position = s (position - zero) / r of the joint's first servo; joint torque = sum of s r k current over the
    joint's servos; effort = joint torque / (k r of the first servo), or / the card's gain where the card declares a
    current.

    Args:
        arm: the arm.
        bus: its servos.
        hint: how to give a servo's torque constant, for a message.

    Raises:
        InputError: bus and arm do not fit.
    """

    def __init__(self, arm: Arm, bus: Bus, hint: Callable[[Servo], str]) -> None:
        names = arm.joint_names
        if not bus.servos:
            raise InputError("bus: no servos")
        twice = [i for i, count in Counter(s.id for s in bus.servos).items() if count > 1]
        if twice:
            raise InputError(f"bus: id {twice[0]} is given twice; every servo on a bus has its own")
        for servo in bus.servos:
            where = f"bus: servo {servo.id}"
            if not 0 <= servo.id <= MAX_ID:
                raise InputError(f"{where}: an id is 0 to {MAX_ID}")
            if servo.joint not in names:
                raise InputError(
                    f"{where}: arm {arm.name!r} has no joint {servo.joint!r}; {suggest(servo.joint, names, 'joints')}"
                )
            if servo.direction not in (-1, 1):
                raise InputError(f"{where}: direction must be 1 or -1, got {servo.direction!r}")
            for what in ("gear", "torque_constant", "current_limit"):
                value = getattr(servo, what)
                if value is not None and not (math.isfinite(value) and value > 0.0):
                    raise InputError(f"{where}: {what} must be a number > 0, got {value!r}")
        missing = [name for name in names if name not in {s.joint for s in bus.servos}]
        if missing:
            raise InputError(f"bus: no servo for joint {', '.join(missing)} of arm {arm.name!r}")
        prismatic = [j.name for j in arm.joints if j.kind != "revolute"]
        if prismatic:
            raise InputError(f"bus: joint {prismatic[0]} of arm {arm.name!r} is not revolute; a servo turns")

        self.servos = bus.servos
        self.joint = np.array([names.index(s.joint) for s in bus.servos])
        """(S,) joint of each servo"""
        self.lead = np.array([int(np.flatnonzero(self.joint == j)[0]) for j in range(arm.n)])
        """(n,) the first servo of each joint"""
        self._count = np.bincount(self.joint, minlength=arm.n)
        self._turn = np.array([s.direction / s.gear for s in bus.servos])
        self._zero = np.array([s.zero for s in bus.servos])
        gain, constants = self._gains(arm, hint)
        self.effort = Effort.current(tuple(gain))
        """what the driver's effort number is [A]"""
        self._gain = gain
        self._constants = constants
        self._torque_per_ampere = constants * np.array([s.direction * s.gear for s in bus.servos])

    def _gains(self, arm: Arm, hint: Callable[[Servo], str]) -> tuple[Array, Array]:
        """N m per effort number of each joint (n,), and torque constants at the horns (S,) [N m/A]."""
        servos = self.servos
        gear = np.array([s.gear for s in servos])
        if arm.effort.kind == "current":
            gain = arm.effort.gain(arm.n)
            constants = np.abs(gain[self.joint]) / gear
            for servo, constant in zip(servos, constants, strict=True):
                given = servo.torque_constant
                if given is not None and not math.isclose(given, constant, rel_tol=1e-6):
                    raise InputError(
                        f"bus: servo {servo.id}: torque constant {given:g} N m/A, but the card of {arm.name!r} says "
                        f"{constant:g} N m/A at its horn; leave one of them out"
                    )
            return gain, constants
        unknown = [s for s in servos if s.torque_constant is None]
        if unknown:
            raise InputError(
                f"bus: servo {unknown[0].id} (joint {unknown[0].joint}) has no torque constant: without the N m per A "
                f"its current says nothing; give the card an effort of kind current, or the bus file {hint(unknown[0])}"
            )
        constants = np.array([s.torque_constant for s in servos], dtype=np.float64)
        return constants[self.lead] * gear[self.lead], constants

    def position(self, counts: Array) -> Array:
        """(n,) [rad] from (S,) positions [counts]."""
        angles: Array = (counts - self._zero) * self._turn * RAD_PER_COUNT
        return angles[self.lead]

    def velocity(self, speed: Array) -> Array:
        """(n,) [rad/s] from (S,) speeds of the horns [rad/s]."""
        found: Array = (speed * self._turn)[self.lead]
        return found

    def torque(self, current: Array) -> Array:
        """(n,) [N m] from (S,) currents [A]."""
        found: Array = np.zeros(len(self.lead))
        np.add.at(found, self.joint, self._torque_per_ampere * current)
        return found

    def effort_of(self, current: Array) -> Array:
        """(n,) the driver's effort number [A] from (S,) currents [A]."""
        return self.torque(current) / self._gain

    def currents(self, torque: Array) -> Array:
        """(S,) currents [A] that give the joints (n,) torques [N m], shared evenly by the servos of a joint."""
        found: Array = (torque / self._count)[self.joint] / self._torque_per_ampere
        return found

    def horn_torque(self, current: Array) -> Array:
        """(S,) torque at the horns [N m] from (S,) currents [A]."""
        return self._constants * current

    def horn_current(self, torque: Array) -> Array:
        """(S,) currents [A] from (S,) torques at the horns [N m]."""
        return torque / self._constants

    def steps(self, current: Array) -> tuple[Array, Array]:
        """(n,) steps of position [rad] and of torque [N m] of the joints from (S,) steps of current [A]."""
        return RAD_PER_COUNT * np.abs(self._turn[self.lead]), np.abs(self._torque_per_ampere * current)[
            self.lead
        ]

    def current_limits(self, arm: Arm) -> Array:
        """(S,) largest currents [A] by the bus file and the torque limits of the joints; may be infinite."""
        torque = np.array([j.limits.effort for j in arm.joints])
        most: Array = np.abs(self.currents(torque))
        own = np.array([math.inf if s.current_limit is None else s.current_limit for s in self.servos])
        return np.minimum(most, own)
