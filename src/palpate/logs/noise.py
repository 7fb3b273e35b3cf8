"""The white noise of readings, told from the motion that they show."""

from __future__ import annotations

import math

import numpy as np

from ..arm import Array

LEAST_POSITION = 1e-5
"""no encoder is better at the link [rad]"""
LEAST_VELOCITY = 1e-4
"""no velocity is [rad/s]"""
_KEPT = 0.93460
"""RMS of the smaller 98 % of a normal distribution [standard deviations]: sqrt(1 - 2 c phi(c) / 0.98), Phi(c) = 0.99"""


def beside_rounding(noise: float, step: float) -> float:
    """Standard deviation of position readings beside their rounding to steps [rad], and what no encoder is better than.

    Args:
        noise: of the readings as they are [rad].
        step: that they are rounded to [rad]; 0: they are not.
    """
    return max(math.sqrt(max(noise**2 - step**2 / 12.0, 0.0)), LEAST_POSITION)


def white_noise(values: Array, seconds: Array) -> float:
    """Standard deviation of the white part of (N,) readings, in their unit; 0 where there are too few.

    Third differences leave nothing of a smooth motion, and of white noise of deviation s the deviation sqrt(20) s;
    weighted for uneven time stamps likewise. The readings are taken when the stamps say or evenly, whichever is
    smoother.

    Args:
        values: (N,) in any unit.
        seconds: (N,) their times [s].
    """
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
    return float(np.sqrt(np.mean(np.square(kept)))) / _KEPT if kept[-1] < 1e6 else 0.0
