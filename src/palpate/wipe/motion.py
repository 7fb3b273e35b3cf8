"""Moving an arm from pose to pose: quintics through poses that keep clear of the table, the board and the other arm."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from ..arm import Arm, Array
from ..control import Quintic, Setpoint

SPEED = 1.0
"""of the fastest joint [rad/s]"""
CLEAR = 0.02
"""[m]"""
STEP = 0.08
"""largest turn of a joint between two looks [rad]"""
BRAKING = 0.25
"""in which a motion is brought to rest [s]"""


@dataclass(slots=True)
class Path:
    """Joint motion from rest to rest through poses, at rest in each; time can be slowed down and stopped."""

    poses: tuple[Array, ...]
    speed: float = SPEED
    pieces: tuple[Quintic, ...] = field(init=False)

    def __post_init__(self) -> None:
        self.pieces = tuple(Quintic(a, b, speed=self.speed) for a, b in itertools.pairwise(self.poses))

    @property
    def duration(self) -> float:
        """[s]"""
        return sum(p.duration for p in self.pieces)

    def sample(self, t: float, rate: float = 1.0) -> Setpoint:
        """The setpoint at `t` [s], if time runs `rate` times as fast as the clock."""
        for piece in self.pieces:
            if t < piece.duration:
                s = piece.sample(t)
                return Setpoint(s.q, rate * s.dq, rate * rate * s.ddq)
            t -= piece.duration
        still = np.zeros_like(self.poses[-1])
        return Setpoint(self.poses[-1], still, still)


def find(
    start: Array,
    goal: Array,
    via: Sequence[Array],
    clearance: Callable[[Array], float],
    *,
    clear: float = CLEAR,
) -> Path | None:
    """The shortest clear way from pose to pose: straight, or through one or two of `via`; None: there is none.

    Args:
        start: (n,) [rad].
        goal: (n,) [rad].
        via: poses to go through if need be.
        clearance: distance to the nearest thing in a pose [m]; near start and goal it may be as small as there.
        clear: to be kept everywhere else [m].
    """
    known: dict[tuple[int, int], float] = {}
    poses = [start, goal, *via]
    ends = [min(clear, clearance(q) - 2e-3) for q in poses[:2]]

    def free(a: int, b: int) -> bool:
        key = (min(a, b), max(a, b))
        if key not in known:
            known[key] = _least(poses[key[0]], poses[key[1]], clearance, key, ends, clear)
        return known[key] >= 0.0

    others = range(2, len(poses))
    ways = [(0, 1), *((0, k, 1) for k in others), *((0, j, k, 1) for j in others for k in others if j != k)]
    ways.sort(key=lambda w: sum(_far(poses[a], poses[b]) for a, b in itertools.pairwise(w)))
    for way in ways:
        if all(free(a, b) for a, b in itertools.pairwise(way)):
            return Path(tuple(poses[k] for k in way))
    return None


def _far(a: Array, b: Array) -> float:
    return float(np.abs(b - a).max()) + 0.3  # a stop costs time


def _least(
    a: Array,
    b: Array,
    clearance: Callable[[Array], float],
    key: tuple[int, int],
    ends: Sequence[float],
    clear: float,
) -> float:
    """Least clearance beyond what is asked for between two poses; near start and goal (0 and 1) less is asked."""
    count = max(2, math.ceil(float(np.abs(b - a).max()) / STEP) + 1)
    least = math.inf
    for s in np.linspace(0.0, 1.0, count):
        asked = clear
        for place, which in ((0.0, key[0]), (1.0, key[1])):
            if which < 2:
                asked = min(asked, ends[which] + clear * 4.0 * abs(s - place))
        least = min(least, clearance(a + s * (b - a)) - asked)
        if least < 0.0:
            break
    return least


def joint_torque(
    arm: Arm, wanted: Setpoint, q: Array, dq: Array, *, stiffness: float, damping: float
) -> Array:
    """Computed torque (n,) [N m] that follows a setpoint: stiffness [1/s^2], damping [1/s].

    By the arm's own inertia, so that every joint answers alike.
    """
    return arm.inverse_dynamics(q, dq, wanted.ddq + stiffness * (wanted.q - q) + damping * (wanted.dq - dq))
