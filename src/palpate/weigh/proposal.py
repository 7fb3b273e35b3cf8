"""A short two-way motion that shows a weight which stiction hides."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ..arm import Arm, Array
from .scenes import weight_torque

_TURNS = 5.0
"""presliding distances a joint goes each way, so that friction has turned over"""
_LEAST = 0.05
"""nor less than this [rad]"""
_SPEED = 5.0
"""times the velocity at which friction's sign is sure"""
_SLOWEST = 0.1
"""nor less than this [rad/s]"""


@dataclass(frozen=True, slots=True)
class TwoWayMotion:
    """Move one joint there and back: friction pushes with and against the weight, the mean is free of it."""

    joint: str
    start: float
    """[rad], for a prismatic joint [m]"""
    stop: float
    """[rad]"""
    speed: float
    """at least, in the middle of each way [rad/s]"""
    hidden: float
    """mass that this joint's stiction may hide at rest [kg]"""
    prismatic: bool = False

    def words(self) -> str:
        """The proposal in a sentence."""
        unit = "m" if self.prismatic else "rad"
        way = "forward" if self.stop > self.start else "backward"
        return (
            f"At rest the stiction of {self.joint} alone hides up to {self.hidden:.2g} kg: while it weighs, move "
            f"{self.joint} {way} by {abs(self.stop - self.start):.2g} {unit}, {self.start:.2f} to {self.stop:.2f}, "
            f"and back, twice, at {self.speed:.2g} {unit}/s or more."
        )

    def summary(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return asdict(self)


def stiction_std(arm: Arm, q: Array) -> float:
    """Standard deviation of a mass weighed at rest by all joints, for their stiction [kg]; infinite: none feels it."""
    weight, stiction = weight_torque(arm, q), _stiction(arm, q)
    known = float(np.sum(np.square(weight / np.maximum(stiction / math.sqrt(3.0), 1e-9))))
    return 1.0 / math.sqrt(known) if known > 1e-12 else math.inf


def two_way_motion(arm: Arm, q: Array) -> TwoWayMotion | None:
    """The joint that feels the weight best beside its stiction, and how to move it from q (n,) [rad].

    Into the side with more room between its limits; None: no joint feels a weight here, or there is no room.
    """
    weight, stiction = weight_torque(arm, q), _stiction(arm, q)
    order = np.argsort(-weight / np.maximum(stiction, 1e-9))
    for j in order.tolist():
        joint = arm.joints[j]
        way = max(_TURNS * joint.friction.presliding, _LEAST)
        up, down = joint.limits.upper - float(q[j]), float(q[j]) - joint.limits.lower
        if weight[j] < 1e-3 or max(up, down) < way:
            continue
        speed = max(_SPEED * joint.friction.sign_velocity, _SLOWEST)
        stop = float(q[j]) + (way if up >= down else -way)
        return TwoWayMotion(
            joint.name, float(q[j]), stop, speed, float(stiction[j] / weight[j]), joint.kind == "prismatic"
        )
    return None


def _stiction(arm: Arm, q: Array) -> Array:
    """(n,) torque within which friction at rest may lie [N m]."""
    load = np.abs(arm.gravity_torque(q)) if arm.has_dynamics else np.zeros(arm.n)
    friction = [j.friction for j in arm.joints]
    level = [f.coulomb if f.static is None else f.static for f in friction]
    return np.asarray(np.array(level) + np.array([f.load for f in friction]) * load)
