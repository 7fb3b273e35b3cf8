"""How noisy a log's readings are, where the arm's description does not say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..arm import Arm, Array, Sensing
from ..logs import Log
from ..logs.noise import LEAST_VELOCITY, beside_rounding, white_noise

_LEAST_TORQUE = 0.005
"""no torque is better than this part of its range"""


def describe_noise(arm: Arm, log: Log) -> tuple[Arm, str]:
    """The arm with the noise of a log in every joint whose sensing is not described; a torque that is, is kept.

    Resolution is the step that positions lie on; the rest is the white part of the readings, see
    :func:`palpate.logs.noise.white_noise`.

    Returns:
        the arm, and what was done; "" if everything was described.
    """
    unknown = [
        i
        for i, j in enumerate(arm.joints)
        if j.sensing.position_std == 0.0
        and (j.sensing == Sensing() or (j.sensing.velocity_std is None and log.velocity is not None))
    ]
    if not unknown or len(log) < 100:
        return arm, ""
    gain = arm.effort.gain(arm.n)
    joints, seconds = list(arm.joints), log.seconds
    for i in unknown:
        position, torque = log.position[:, i], log.effort[:, i] * gain[i]
        step = _step(position)
        noise = white_noise(position, seconds)
        position_std = beside_rounding(noise, step)
        good = torque[np.isfinite(torque) & (np.abs(torque) < 1e9)]
        size = float(np.percentile(np.abs(good), 95.0)) if good.size else 0.0
        torque_std = max(white_noise(torque, seconds), _LEAST_TORQUE * size, 1e-6)
        velocity = (
            None if log.velocity is None else max(white_noise(log.velocity[:, i], seconds), LEAST_VELOCITY)
        )
        told = joints[i].sensing
        if told.torque_std or told.torque_resolution:
            found = replace(told, position_resolution=step, position_std=position_std, velocity_std=velocity)
        else:
            found = Sensing(step, position_std, velocity, 0.0, torque_std)
        joints[i] = joints[i].replace(sensing=found)
    names = ", ".join(arm.joint_names[i] for i in unknown) if len(unknown) < arm.n else "the arm"
    return arm.replace(joints=tuple(joints)), (
        f"The description of {names} does not say how noisy its readings are: taken from the log itself "
        f"(position ± {max(joints[i].sensing.position_std for i in unknown):.1g} rad, "
        f"torque ± {max(joints[i].sensing.torque_std for i in unknown):.1g} N m)."
    )


def _step(values: Array) -> float:
    """The step whose multiples the values of (N,) are; 0 if there is none."""
    good = values[np.isfinite(values) & (np.abs(values) < 1e3)]
    distances = np.abs(np.diff(np.unique(good)))
    distances = distances[distances > 1e-9]
    if distances.size < 3:
        return 0.0
    step = float(distances.min())
    off = np.abs(good / step - np.round(good / step))
    return step if step < 0.1 and float(np.mean(off < 0.05)) > 0.95 else 0.0
