"""How noisy a log's readings are, where the arm's description does not say."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from ..arm import Arm, Array, Sensing
from ..logs import Log

_LEAST_POSITION = 1e-5
"""no encoder is better at the link [rad]"""
_LEAST_TORQUE = 0.005
"""no torque is better than this part of its range"""


def describe_noise(arm: Arm, log: Log) -> tuple[Arm, str]:
    """The arm with the noise of a log in every joint whose sensing is not described; a torque that is, is kept.

    Resolution is the step that positions lie on; the rest is what third differences hold beside a smooth motion:
    of white noise of deviation s they have the deviation sqrt(20) s, weighted for uneven time stamps likewise.

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
        noise = _noise(position, seconds)
        position_std = max(math.sqrt(max(noise**2 - step**2 / 12.0, 0.0)), _LEAST_POSITION)
        good = torque[np.isfinite(torque) & (np.abs(torque) < 1e9)]
        size = float(np.percentile(np.abs(good), 95.0)) if good.size else 0.0
        torque_std = max(_noise(torque, seconds), _LEAST_TORQUE * size, 1e-6)
        velocity = None if log.velocity is None else max(_noise(log.velocity[:, i], seconds), 1e-4)
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


def _noise(values: Array, seconds: Array) -> float:
    """Standard deviation of the white part of (N,), sampled when the stamps say or evenly, whichever is smoother."""
    if len(values) < 4:
        return 0.0
    four = np.lib.stride_tricks.sliding_window_view(seconds, 4)
    distances = four[:, :, None] - four[:, None, :] + np.eye(4)
    with np.errstate(divide="ignore", invalid="ignore"):
        stamped = 1.0 / distances.prod(
            axis=2
        )  # of a divided difference: a parabola leaves nothing at any times
        stamped /= np.sqrt(np.square(stamped).sum(axis=1, keepdims=True))
    even = np.broadcast_to(np.array([-1.0, 3.0, -3.0, 1.0]) / math.sqrt(20.0), stamped.shape)
    around = np.lib.stride_tricks.sliding_window_view(values, 4)
    return min(_spread((weights * around).sum(axis=1)) for weights in (stamped, even))


def _spread(third: Array) -> float:
    """RMS of (N,) third differences."""
    third = third[np.isfinite(third)]
    if third.size < 10:
        return 0.0
    # without the largest: jumps and absurd numbers are no noise
    kept = np.sort(np.abs(third))[: max(int(0.98 * third.size), 10)]
    return float(np.sqrt(np.mean(np.square(kept)))) if kept[-1] < 1e6 else 0.0


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
