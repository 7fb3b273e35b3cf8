"""A real arm before it weighs: what its driver adds to its card, and where it stands."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..arm import Arm, Array, Sensing
from ..drivers import Driver
from ..drivers.servos import ServoDriver
from ..errors import DriverError, InputError

_PERIODS = 50
"""how many periods may pass until a sample arrives"""


def driven_arm(arm: Arm, driver: Driver) -> Arm:
    """The arm with the effort that its driver reports, and its servos' steps where the card names finer ones or none.

    Only a servo bus tells its steps; of other arms the card's are taken.

    Raises:
        InputError: what the servos report is not their torque.
    """
    if not isinstance(driver, ServoDriver):
        return arm.replace(effort=driver.effort)
    if driver.doubts:
        raise InputError(f"this arm cannot be weighed with live: {driver.doubts[0]}")
    position, torque = driver.resolution
    joints = []
    for joint, count, step in zip(arm.joints, position, torque, strict=True):
        known = joint.sensing
        sensing = replace(
            known,
            position_resolution=max(known.position_resolution, float(count)),
            position_std=float(count) if known == Sensing() else known.position_std,
            torque_resolution=max(known.torque_resolution, float(step)),
        )
        joints.append(joint.replace(sensing=sensing))
    return arm.replace(joints=tuple(joints), effort=driver.effort)


def present_pose(arm: Arm, driver: Driver) -> Array:
    """(n,) where a connected arm stands now [rad].

    Raises:
        DriverError: no sample arrives.
        InputError: a joint is beyond its limits: on a servo bus most likely its zero or direction is wrong.
    """
    for _ in range(_PERIODS):
        sample = driver.read()
        if sample is not None:
            break
    else:
        happened = f": {driver.statistics}" if isinstance(driver, ServoDriver) else ""
        raise DriverError(f"no sample in {_PERIODS} periods{happened}")
    q: Array = np.array(sample.position)
    for joint, angle in zip(arm.joints, q, strict=True):
        if not joint.limits.lower <= angle <= joint.limits.upper:
            raise InputError(
                f"{joint.name} reads {angle:.4g} rad, outside its limits {joint.limits.lower:.4g} to "
                f"{joint.limits.upper:.4g} rad: move the arm inside, or correct "
                + (
                    "its zero or direction in the bus file"
                    if isinstance(driver, ServoDriver)
                    else "the arm's card"
                )
            )
    return q
