"""Hands by which the teleoperation study judges: each draws its grip, its way and the wall it presses."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..arm import Array
from ..teleop.figures import SETTLED
from ..teleop.masters import Hand, HapticDevice
from ..teleop.scenes import SlaveArm, smooth, through
from ..teleop.servo_arms import joint_path
from ..teleop.setups import JOINT_HAND

JUDGED = (101, 102, 103)
"""seeds of hands, places, walls and sensors that judge; nothing was chosen by them"""
SPEED = 0.25
"""of the hand in free motion [m/s]"""
GAP = 0.05
"""from the tool to the wall at the start [m]"""
STIFFNESS_SPREAD = 0.15
"""the walls' stiffness is off the nominal one by up to so much [1]"""
SHOWN = 0.8
"""part of the device's largest force that a hand presses with at most [1]"""
HELD = 2.5
"""so long the hand presses [s]"""


@dataclass(frozen=True, slots=True)
class Draw:
    """One hand and what it does.

    Attributes:
        seed: of everything, sensors included.
        hand: on a device of three axes, or at the joints of a leader arm.
        stiffness: of the wall [N/m].
        seconds: how long it takes.
    """

    seed: int
    hand: Hand
    stiffness: float
    seconds: float


def _grip(rng: np.random.Generator, chosen: SlaveArm) -> dict[str, Any]:
    """How a hand holds the device: options of :class:`Hand`."""
    usual = {"mass": 0.5, "stiffness": 400.0, "damping": 14.0, "tremor": 0.05}
    of = JOINT_HAND if chosen.kind == "servos" else usual
    drawn = rng.uniform(0.75, 1.25, 4)
    grip = {name: float(part) * of[name] for name, part in zip(usual, drawn, strict=True)}
    return {**grip, "tremor_rate": float(rng.uniform(8.0, 12.0))}


def _held(grip: dict[str, Any], chosen: SlaveArm, path: Callable[[float], Array], seconds: float) -> Hand:
    """A hand that goes along a path of the slave's tool, from its start (3,) [m]."""
    if chosen.kind == "servos":
        return Hand(wish=joint_path(chosen.arm, chosen.q, path, seconds), **grip)
    return Hand(wish=lambda t: path(t) / chosen.motion_scale, **grip)


def free(chosen: SlaveArm, seed: int, radius: float, seconds: float) -> Draw:
    """Along a circle of any plane, the hand at SPEED once it has begun.

    Args:
        chosen: the slave.
        seed: of the draw.
        radius: of the hand's way [m]; shrunk by up to a fifth.
        seconds: how long.
    """
    rng = np.random.default_rng(seed)
    # two axes at right angles, of any direction
    axes = np.linalg.qr(rng.standard_normal((3, 2)))[0].T
    radius *= float(rng.uniform(0.8, 1.0))
    scale = chosen.motion_scale

    def path(time: float) -> Array:
        t = max(0.0, time - SETTLED)
        angle = SPEED / radius * t
        place: Array = (smooth(t / 1.5) * radius * scale) * (
            math.sin(angle) * axes[0] + math.cos(angle) * axes[1]
        )
        return place

    return Draw(seed, _held(_grip(rng, chosen), chosen, path, seconds), math.nan, seconds)


def pressing(chosen: SlaveArm, seed: int, stiffness: float, press: float) -> Draw:
    """To any place of the wall, into it, some seconds there, and back; no harder than the device can show.

    Args:
        chosen: the slave.
        seed: of the draw.
        stiffness: of the wall, nominal [N/m].
        press: how far behind its surface the hand goes, nominal [m].
    """
    rng = np.random.default_rng(seed)
    side, up = float(rng.uniform(-0.05, 0.05)), float(rng.uniform(-0.025, 0.025))
    deep = GAP + press * float(rng.uniform(0.8, 1.1))
    K = stiffness * float(rng.uniform(1.0 - STIFFNESS_SPREAD, 1.0 + STIFFNESS_SPREAD))
    there = SETTLED + float(rng.uniform(0.8, 1.2))
    into = there + float(rng.uniform(1.0, 1.6))
    back = into + HELD + float(rng.uniform(1.5, 2.0))
    grip = _grip(rng, chosen)
    if (
        chosen.kind != "servos"
    ):  # a hand that is stronger than the device goes on into the wall, whatever it feels
        deep = min(
            deep, GAP + SHOWN * HapticDevice(Hand()).force_limit / grip["stiffness"] * chosen.motion_scale
        )
    path = through(
        [
            (SETTLED, (0.0, 0.0, 0.0)),
            (there, (0.3 * GAP, side, up)),
            (into, (deep, side, up)),
            (into + HELD, (deep, side, up)),
            (back, (0.0, side, up)),
        ]
    )
    return Draw(seed, _held(grip, chosen, path, back + 0.5), K, back + 0.5)
