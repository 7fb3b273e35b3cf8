"""The ABB IRB 2400-16 of the sensorless-force study: the robot as it is, its sensors and its motions."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from ..arm import Arm, Array, Effort
from ..simulate.irb2400 import ENCODER, TURNING, B, CurrentSensors, glitch_pulse
from ._geared_arm import RATE, Motion

# --- the paper's experiment -------------------------------------------------------------------------------------------

POSES_DEG = ((-94.2, 10.6, 22.7, 19.9, 12.4, 81.4), (-93.5, 25.5, 26.8, 25.6, 8.4, 75.9))
"""A and B of its Table 2, controller angles [deg]"""
FRICTION_ERROR = 0.3
"""of the friction the paper subtracts, relative: what makes its error (it names friction at low speed, but no
figure) [1]"""
POSITION_RATE = 50
"""readings of the position per second in the paper's set-up, whose controller limits them; assumed [Hz]"""

PAPER_CUTOFF = 30.0
"""of the low-passes that take the steps out of it; assumed [rad/s]"""

CURRENT_RATE = 20.0
"""no motor here changes its current faster: 60 N m of friction turned over in 20 ms [A/s]"""
SHEET_STD = 0.05
"""of a torque constant taken from a data sheet, where static poses show nothing (joint 1 bears no weight) [1]"""
LINK_ERROR = 0.1
"""the links that both methods start from are wrong by so much (mass, relative) and by 5 mm (centre of mass) [1]"""

MOST = np.array([40.0, 40.0, 150.0, 6.0, 6.0, 6.0])
"""of the pushes, base axes [N, N m]"""
TOOL_MOMENT = 5.0
"""what palpate is told of the moments about the tool's tip: within +-10 N m, two standard deviations [N m]"""
FIT_CUTOFF = 6.0
"""of the regression [Hz]: motions of half a hertz, friction that turns over within a tenth of a second"""
KINEMATIC, CUTOFF = 200.0, 100.0
"""low-passes of ours: of position and current before friction and acceleration are computed; of the residual
[rad/s]"""
PUSH_RATE = 300.0
"""how fast an external torque may change unseen while a glitch hides a current [N m/s]"""


def prior_arm(arm: Arm, seed: int) -> Arm:
    """The robot as its CAD model has it: every mass and centre of mass somewhat wrong."""
    rng = np.random.default_rng(seed)
    joints = []
    for joint in arm.joints:
        scale = 1.0 + LINK_ERROR * rng.uniform(-1.0, 1.0)
        shift = 0.005 * rng.uniform(-1.0, 1.0, 3)
        joints.append(
            joint.replace(mass=scale * joint.mass, com=joint.com + shift, inertia=scale * joint.inertia)
        )
    return arm.replace(joints=tuple(joints), effort=Effort.torque())


def with_load(arm: Arm, mass: float, place: Array) -> Arm:
    """The arm with a point mass [kg] at `place` (3,) in its tip frame [m]."""
    last = arm.joints[-1]
    at = arm.T_last_tip[:3, :3] @ place + arm.T_last_tip[:3, 3]
    total = last.mass + mass
    com = (last.mass * last.com + mass * at) / total
    inertia = last.inertia.copy()
    for m, r in ((last.mass, last.com - com), (mass, at - com)):
        inertia += m * (r @ r * np.eye(3) - np.outer(r, r))
    return arm.replace(joints=(*arm.joints[:-1], last.replace(mass=total, com=com, inertia=inertia)))


# --- sensors ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class Readings:
    """What is measured of a motion.

    Attributes:
        time_ns: (N,) [ns].
        position: (N, n) of the joints [rad].
        phase_a, phase_b: (N, n) [A].
    """

    time_ns: npt.NDArray[np.int64]
    position: Array
    phase_a: Array
    phase_b: Array


class Sensors:
    """Two current sensors per motor and the encoders: offset, gain, noise and what a reversal does to the wave."""

    def __init__(self, seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        self.sensors = CurrentSensors.drawn(self._rng)

    def read(self, motion: Motion) -> Readings:
        """Measure."""
        speed = motion.dq @ B.T
        a, b = self.sensors.measured(motion.torque, motion.q @ B.T, glitches(speed), self._rng)
        return Readings(
            time_ns=np.round(motion.time * 1e9).astype(np.int64),
            position=np.round(motion.q / ENCODER) * ENCODER,
            phase_a=a,
            phase_b=b,
        )


def glitches(speed: Array) -> Array:
    """(N, n) how far the two phases have passed into one another, 0 to 1: a half sine after every reversal."""
    pulse = glitch_pulse(RATE)
    found = np.zeros_like(speed)
    for j, column in enumerate(speed.T):
        way = 0.0
        for k in np.flatnonzero(np.abs(column) > TURNING):
            sign = math.copysign(1.0, column[k])
            if way * sign < 0.0:
                part = pulse[: len(column) - k]
                found[k : k + len(part), j] = part
            way = sign
    return found


# --- motions ----------------------------------------------------------------------------------------------------------


def smooth(x: Array) -> Array:
    """Quintic from 0 to 1."""
    x = np.clip(x, 0.0, 1.0)
    return x**3 * (10.0 - 15.0 * x + 6.0 * x * x)


def poses() -> Array:
    """A and B as joint angles (2, 6) [rad]."""
    return np.radians(POSES_DEG) @ np.linalg.inv(B).T


BEGIN, SECONDS = 4.0, 16.0
"""the record proper begins when the robot has come to A; its end [s]"""


def there_and_back(time: Array) -> Array:
    """To A from elsewhere, then A -> B -> A in 12 s."""
    A, other = poses()
    from_B = smooth(time / 3.0)
    way = smooth((time - BEGIN - 0.5) / 5.0) - smooth((time - BEGIN - 6.5) / 5.0)
    return A + (1.0 - from_B + way)[:, None] * (other - A)


def excitation(seed: int, seconds: float, speed: float) -> Callable[[Array], Array]:
    """Fourier motion around the middle between A and B, all joints at once, `speed` times 1, 1, 1, 1.5, 1.5, 2
    rad/s at most."""
    rng = np.random.default_rng(seed)
    middle = poses().mean(axis=0)
    span = np.array([1.0, 0.6, 0.5, 1.5, 1.2, 1.5])
    fastest = speed * np.array([1.0, 1.0, 1.0, 1.5, 1.5, 2.0])
    order = np.arange(1, 6)
    base = 2.0 * math.pi * 3.0 / seconds
    amplitude, phase = rng.uniform(0.3, 1.0, (6, 5)) / order, rng.uniform(0.0, 2.0 * math.pi, (6, 5))
    t = np.linspace(0.0, seconds, 2000)
    stretch = 1.0 + 0.37 * np.arange(6) / 6.0

    def raw(time: Array) -> Array:
        angle = base * np.multiply.outer(time, np.multiply.outer(stretch, order)) + phase
        return np.einsum("tjk,jk->tj", np.sin(angle), amplitude)

    shape = raw(t)
    size = np.minimum(
        span / np.abs(shape).max(axis=0), fastest / np.abs(np.gradient(shape, t, axis=0)).max(axis=0)
    )

    def reference(time: Array) -> Array:
        ends = smooth(time / 2.0) * smooth((seconds - time) / 2.0)
        return middle + ends[:, None] * size * raw(time)

    return reference


def stop_and_go(seed: int, count: int) -> tuple[Callable[[Array], Array], float]:
    """`count` motions from rest to rest, 4 s each and 1 s of rest, all joints at once; and how long it takes [s].

    Who is to work at low speed and from rest needs friction there: Fourier motions are hardly ever slow.
    """
    rng = np.random.default_rng(seed)
    reach = np.array([0.1, 0.3, 0.2, 0.3, 0.3, 0.3])
    goals = poses().mean(axis=0) + reach * rng.uniform(-1.0, 1.0, (count + 1, 6))

    def reference(time: Array) -> Array:
        found = np.tile(goals[0], (len(time), 1))
        for k in range(count):
            found += smooth((time - 5.0 * k) / 4.0)[:, None] * (goals[k + 1] - goals[k])
        return found

    return reference, 5.0 * count


STATIC_LOAD, STATIC_PLACE = 20.0, np.array([0.15, 0.05, 0.1])
"""mass [kg] and place in the tip frame [m] of the known load that tells the torque constants"""
STEP = 0.03
"""how far to either side a static pose is approached from [rad]"""


def static_poses(seed: int, count: int) -> tuple[Callable[[Array], Array], list[tuple[float, float]], float]:
    """Poses held after an approach from below, then from above: motion, (time, side) of each hold, length [s]."""
    rng = np.random.default_rng(seed)
    targets = poses().mean(axis=0) + np.array([0.5, 0.35, 0.3, 1.2, 0.8, 1.2]) * rng.uniform(
        -1.0, 1.0, (count, 6)
    )
    knots, holds, now = [(0.0, targets[0] - STEP)], [], 0.0
    for target in targets:
        for side in (1.0, -1.0):
            now += 2.0 if side > 0.0 else 0.7
            knots.append((now, target - side * STEP))
            now += 0.6
            knots.append((now, target))
            now += 0.4
            knots.append((now, target))
            holds.append((now, side))

    def reference(time: Array) -> Array:
        found = np.empty((len(time), 6))
        found[:] = knots[-1][1]
        for (t0, q0), (t1, q1) in pairwise(knots):
            part = (time >= t0) & (time < t1)
            found[part] = q0 + smooth((time[part] - t0) / (t1 - t0))[:, None] * (q1 - q0)
        return found

    return reference, holds, now


def pushes(seed: int) -> Callable[[Array], Array]:
    """What a tool meets: pushes up to 150 N along the vertical, some sideways, some moment; each lasts 1 to 2 s."""
    rng = np.random.default_rng(seed)
    starts, lengths, sizes = [], [], []
    start = BEGIN + 0.3
    while start < SECONDS - 1.5:
        starts.append(start)
        lengths.append(rng.uniform(1.2, 2.4))
        sizes.append(MOST * rng.uniform(-1.0, 1.0, 6))
        start += lengths[-1] * rng.uniform(0.6, 1.2)

    def wrench(time: Array) -> Array:
        found = np.zeros((len(time), 6))
        for begin, length, size in zip(starts, lengths, sizes, strict=True):
            rise = smooth((time - begin) / 0.5) - smooth((time - begin - length + 0.5) / 0.5)
            found += rise[:, None] * size
        return found

    return wrench
