"""Orientation in the teleoperation study: how closely the tool turns as the hand does, what a valve feels like."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from .._core import turn_between
from ..arm import Array
from ..teleop.figures import SETTLED, transparency, turning
from ..teleop.masters import Hand
from ..teleop.scenes import smooth
from ..teleop.setups import build
from . import Row
from ._rows import at_most, told
from ._teleop_slaves import ABB, IIWA

JOBS, QUICK_JOBS = 4, 2
_WOBBLE = np.array([0.25, 0.2, 0.3]), np.array([2.0, 1.7, 2.4])
"""amplitudes [rad] and rates [rad/s] of the wrist about three axes; a fifth more, and the iiwa's fourth joint would
reach its largest speed on the way"""


def circle(time: float) -> Array:
    """The hand's way in free motion, at a quarter of a metre per second once it has begun."""
    t, radius = max(0.0, time - SETTLED), 0.1
    angle = 0.25 / radius * t
    return smooth(t / 1.5) * radius * np.array([math.sin(angle), math.cos(angle), 0.0])


def wrist(time: float) -> Array:
    """How the hand turns in free motion, about all axes at once."""
    t = max(0.0, time - SETTLED)
    found: Array = smooth(t / 1.5) * _WOBBLE[0] * np.sin(_WOBBLE[1] * t)
    return found


def rows(quick: bool, done: Callable[[], None]) -> list[Row]:
    """All rows; `done` after each run."""
    found = []
    for arm, name in ((IIWA, "iiwa"),) if quick else ((IIWA, "iiwa"), (ABB, "ABB")):
        run = build(None, arm=arm, hand=Hand(wish=circle, wish_turn=wrist)).run(
            seconds=4.0 if quick else 10.0
        )
        done()
        turned, moved = turning(run), transparency(run)
        found.append(
            at_most(
                f"{name}, free motion, hand moving and turning: the tool turned away from where the hand turns it, "
                "at most",
                1.0,
                1e3 * turned.tracking,
                "mrad",
                f"tool at up to {turned.spin:.2f} rad/s and {moved.speed:.2f} m/s",
            )
        )
    setup = build("turn")
    run = setup.run(seconds=5.5 if quick else None)
    done()
    valve = turning(run, torque_scale=setup.follower.torque_scale)
    found += [
        at_most(
            "iiwa, valve of 1 N m/rad turned by a key: torque felt off the true one, mean",
            5.0,
            100.0 * valve.torque_error,
            "%",
            f"at {valve.torque_held:.2f} N m; over tenths of a second while it is held",
        ),
        told(
            "iiwa, valve: estimated against true torque, mean of every sample of the touch",
            1e3 * valve.estimate_error,
            "mN m",
            "joint torques with 0.05 N m of noise; below five standard deviations nothing is felt",
        ),
    ]
    if not quick:
        run = build("turn", torque_limit=0.0).run()
        done()
        found.append(
            told(
                "iiwa, valve, a gimbal that is measured and has no motors: the tool turns by",
                float(np.abs(_angles(run.tip_turn)).max()),
                "rad",
                f"the hand by {float(np.abs(_angles(run.device_turn)).max()):.2f} rad, it feels nothing of it; "
                f"true torque up to {np.linalg.norm(run.true_torque, axis=1).max():.2f} N m",
            )
        )
    return found


def _angles(orientation: Array) -> Array:
    """(N,) angle from the first of (N, 3) rotation vectors [rad]."""
    return np.array([math.hypot(*turn_between(row, orientation[0])) for row in orientation])
