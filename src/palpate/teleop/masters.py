"""Masters give a place and take a force: what all have in common, and a simulated haptic device in a simulated hand."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from .._core import turn_between, turned
from ..arm import Array
from ..errors import InputError

_SUBSTEPS = 5


def _nowhere(time: float) -> Array:
    return np.zeros(3)


@dataclass(frozen=True, slots=True)
class Hand:
    """An arm of a person, as it is felt at the hand: m x'' = K (x_i - x) - B x' + tremor + F.

    Source: the second-order impedance of N. Hogan, IEEE TAC 29(8), 1984; figures of a relaxed to firm grip are 200
    to 800 N/m and damping
    ratios of 0.2 to 0.6. Tremor: 8 to 12 Hz.

    Raises:
        InputError: a number is out of range.
    """

    wish: Callable[[float], Array] = _nowhere
    """where the hand wants to be at a time [s], (3,) [m]"""
    mass: float = 0.5
    """[kg]"""
    stiffness: float = 400.0
    """[N/m]"""
    damping: float = 14.0
    """[N s/m]"""
    tremor: float = 0.05
    """amplitude, each axis [N]"""
    tremor_rate: float = 9.0
    """[Hz]"""
    wish_turn: Callable[[float], Array] = _nowhere
    """how it wants to be turned at a time [s], (3,) rotation vector [rad]"""
    inertia: float = 2e-3
    """[kg m^2], the same about all axes"""
    turn_stiffness: float = 3.0
    """of the wrist [N m/rad]"""
    turn_damping: float = 0.08
    """[N m s/rad]"""
    turn_tremor: float = 5e-4
    """amplitude, each axis [N m]"""

    def __post_init__(self) -> None:
        if not min(self.mass, self.inertia) > 0.0 or (
            min(
                self.stiffness,
                self.damping,
                self.tremor,
                self.turn_stiffness,
                self.turn_damping,
                self.turn_tremor,
            )
            < 0.0
        ):
            raise InputError(
                f"a hand needs mass > 0, inertia > 0 and stiffness, damping, tremor >= 0, got {self!r}"
            )

    def force(self, time: float, x: Array, v: Array) -> Array:
        """(n,) of the hand on the device, without its own mass [N]; three axes, or the joints of a leader arm."""
        shake = self.tremor * np.sin(2.0 * math.pi * self.tremor_rate * time + 2.0 * np.arange(len(x)))
        pull: Array = self.stiffness * (self.wish(time) - x) - self.damping * v + shake
        return pull

    def torque(self, time: float, turn: Array, spin: Array) -> Array:
        """(3,) of the hand on a device that is turned so (3,) [rad] and turns so (3,) [rad/s], without its own inertia
        [N m]."""
        shake = self.turn_tremor * np.sin(2.0 * math.pi * self.tremor_rate * time + 2.0 * np.arange(3))
        away = turn_between(np.asarray(self.wish_turn(time), dtype=np.float64), turn)
        pull: Array = self.turn_stiffness * away - self.turn_damping * spin + shake
        return pull


class Device(Protocol):
    """What a hand holds: three axes of space, a pose of six, or the joints of a leader arm [rad, N m].

    A pose has its orientation as a rotation vector [rad]. A device of three axes keeps its orientation. One with a
    `torque_limit` [N m] shows torques; the common one has none, its gimbal is measured and has no motors.
    """

    @property
    def force_limit(self) -> float | Array:
        """Largest force on the hand, one number or one per axis [N]."""

    def read(self) -> tuple[Array, Array]:
        """(3,) place [m], (3,) velocity [m/s]; or (6,), the orientation's rotation vector [rad] and the angular
        velocity [rad/s] behind them.

        Raises:
            DriverError: it is gone.
        """

    def step(self, force: Array, dt: float) -> None:
        """Hold a force (3,) [N] of the device on the hand for a period [s]; or (6,), the torque [N m] behind it."""


@dataclass(slots=True)
class HapticDevice:
    """A simulated desktop device held by a :class:`Hand`: three force axes, and a stylus whose gimbal is measured.

    Mass, largest force and resolution are those a maker publishes for the PHANTOM Premium 1.5: 75 g apparent mass,
    8.5 N, 0.03 mm. With a `torque_limit` the gimbal has motors as well.
    """

    hand: Hand
    mass: float = 0.075
    """apparent [kg]"""
    force_limit: float = 8.5
    """[N]"""
    resolution: float = 3e-5
    """[m]"""
    friction: float = 0.04
    """viscous [N s/m]: 0.04 N of backdrive friction at 1 m/s"""
    x: Array = field(default_factory=lambda: np.zeros(3))
    """(3,) [m]"""
    v: Array = field(default_factory=lambda: np.zeros(3))
    """(3,) [m/s]"""
    time: float = 0.0
    """[s]"""
    inertia: float = 5e-5
    """of the stylus [kg m^2]"""
    torque_limit: float = 0.0
    """[N m]; 0: the gimbal has no motors"""
    turn_resolution: float = 1e-4
    """of the gimbal [rad]"""
    turn: Array = field(default_factory=lambda: np.zeros(3))
    """(3,) orientation as a rotation vector [rad]"""
    spin: Array = field(default_factory=lambda: np.zeros(3))
    """(3,) angular velocity [rad/s]"""

    def __post_init__(self) -> None:
        if not (self.force_limit > 0.0 and self.torque_limit >= 0.0):
            raise InputError(
                f"a device needs force_limit > 0 and torque_limit >= 0, got {self.force_limit!r}, {self.torque_limit!r}"
            )

    def step(self, force: Array, dt: float) -> None:
        """Hold a force (3,) [N] of the device on the hand for a period [s], or (6,), the torque [N m] behind it."""
        F = np.clip(force[:3], -self.force_limit, self.force_limit)
        torque = np.clip(force[3:6], -self.torque_limit, self.torque_limit) if len(force) > 3 else np.zeros(3)
        hand = self.hand
        h, mass, inertia = dt / _SUBSTEPS, self.mass + hand.mass, self.inertia + hand.inertia
        for _ in range(_SUBSTEPS):
            self.v = self.v + (h / mass) * (
                F + hand.force(self.time, self.x, self.v) - self.friction * self.v
            )
            self.x = self.x + h * self.v
            self.spin = self.spin + (h / inertia) * (torque + hand.torque(self.time, self.turn, self.spin))
            self.turn = turned(self.turn, h * self.spin)
            self.time += h

    def read(self) -> tuple[Array, Array]:
        """(6,) place [m] and orientation [rad] as the encoders give them, (6,) velocity [m/s, rad/s]."""
        return (
            np.concatenate(
                (
                    np.round(self.x / self.resolution) * self.resolution,
                    np.round(self.turn / self.turn_resolution) * self.turn_resolution,
                )
            ),
            np.concatenate((self.v, self.spin)),
        )
