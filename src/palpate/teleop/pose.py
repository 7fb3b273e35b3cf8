"""Poses as six numbers: a place [m] and the rotation vector of an orientation [rad], both in base axes.

What is added to an orientation, and what lies between two, is a rotation vector in base axes too (docs/theory.md).
"""

from __future__ import annotations

import numpy as np

from .._core import rotation_vector, turn_between, turned
from ..arm import Array


def pose_of(R: Array, place: Array) -> Array:
    """(6,) of a rotation matrix (3, 3) and a place (3,) [m]."""
    return np.concatenate((place, rotation_vector(np.ascontiguousarray(R).ravel())))


def pose_plus(x: Array, d: Array) -> Array:
    """(6,) a pose (6,) moved and turned by d (6,)."""
    return np.concatenate((x[:3] + d[:3], turned(x[3:6], d[3:6])))


def pose_minus(to: Array, start: Array) -> Array:
    """(6,) what moves and turns the pose `start` (6,) to `to` (6,)."""
    return np.concatenate((to[:3] - start[:3], turn_between(to[3:6], start[3:6])))
