"""External force of an industrial robot from two phase currents per motor (del Sol et al., the sensorless-force paper).

(a) The paper's rig: a motor lifts weights on a pulley. (b) Its robot, an ABB IRB 2400-16, on its way A -> B -> A while
something pushes: the paper's method beside palpate's, which is identified from the same arm's own excitation.
"""

from __future__ import annotations

import math
import time as clock
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from .. import robots
from .._core import Status, WrenchEstimator, solve_wrench
from ..arm import Arm, Array, Effort
from ..identify import (
    Fit,
    FrictionModel,
    TorqueConstants,
    calibrate_phases,
    fit,
    fit_torque_constants,
)
from ..logs import Log
from ..phase import PhaseCurrents
from ..pipeline import Pipeline
from . import Progress, Row, _figures
from ._geared_arm import RATE, Drives, Motion, simulate
from ._rows import at_most, near, told

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# --- the paper's experiment -------------------------------------------------------------------------------------------

POSES_DEG = ((-94.2, 10.6, 22.7, 19.9, 12.4, 81.4), (-93.5, 25.5, 26.8, 25.6, 8.4, 75.9))
"""A and B of its Table 2, controller angles [deg]"""
PAYLOAD = 20.0
"""[kg]"""
PUBLISHED = 24.2
"""its mean error, 2.47 kg or 12.35 % of the payload [N]"""
BAR = 2.4
"""a tenth of it [N]"""
FRICTION_ERROR = 0.3
"""of the friction the paper subtracts, relative: what makes its error (it names friction at low speed, but no figure) [1]"""
POSITION_RATE = 50
"""readings of the position per second in the paper's set-up, whose controller limits them; assumed [Hz]"""

B = np.eye(6)
B[2, 1] = 1.0
"""speeds of the motors = B dq: the parallelogram turns motor 3 with joints 2 and 3"""

# --- what no source states: typical of such robots, the same for both methods -----------------------------------------

K_T = np.array([1.2, 1.2, 1.1, 0.8, 0.8, 0.8])
"""torque constants per ampere of peak current [N m/A]"""
GEAR = np.array([125.0, 125.0, 110.0, 60.0, 60.0, 50.0])
POLE_PAIRS = 4
ROTORS = np.array([10.0, 10.0, 10.0, 2.5, 2.5, 1.5])
"""inertia of the rotors at the link side [kg m^2]"""
PRESLIDING = 5e-4
"""[rad]; lies between the distances that identification tries"""
RIPPLE = 0.02
"""of the friction with the motor's position, which no model here knows, part of Coulomb friction [1]"""
ENCODER = 1.5e-5
"""one count at the link [rad]"""
NOMINAL = np.array([3.0, 5.0, 3.0, 3.0, 3.0, 3.0])
"""of the current sensors TH3A and TH5A [A]"""
OFFSET, GAIN_MISMATCH, NOISE = 0.02, 0.02, 0.005
"""offset, gain error and noise of a sensor: largest, largest, standard deviation; part of nominal, of reading, of nominal [1]"""
GLITCH = 0.04
"""how long the change of the phase order leaves no sine when a motor turns back [s]"""
SHEET_STD = 0.05
"""of a torque constant taken from a data sheet, where static poses show nothing (joint 1 bears no weight) [1]"""
LINK_ERROR = 0.1
"""the links that both methods start from are wrong by so much (mass, relative) and by 5 mm (centre of mass) [1]"""

KINEMATIC, CUTOFF = 200.0, 100.0
"""low-passes of ours: of position and current before friction and acceleration are computed; of the residual [rad/s]"""
PUSH_RATE = 300.0
"""how fast an external torque may change unseen while a glitch hides a current [N m/s]"""


def truth_arm() -> Arm:
    """The robot as it is: Table 1 of the paper, decoded, and published friction."""
    return robots.load("abb_irb2400_16")


def truth_drives(arm: Arm) -> Drives:
    """Its motors with the published friction of Obal and Gierlak, which was measured at the motors."""
    friction = [joint.friction for joint in arm.joints]
    return Drives(
        B=B,
        inertia=ROTORS,
        coulomb=np.array([f.coulomb for f in friction]),
        static=np.array([f.static for f in friction]),
        viscous=np.array([f.viscous for f in friction]),
        stribeck_velocity=np.array([f.stribeck_velocity for f in friction]),
        presliding=np.full(6, PRESLIDING),
        ripple=np.full(6, RIPPLE),
        ripple_period=2.0 * math.pi / GEAR,
    )


def prior_arm(arm: Arm, seed: int) -> Arm:
    """The robot as its CAD model has it: every mass and centre of mass somewhat wrong."""
    rng = np.random.default_rng(seed)
    joints = []
    for joint in arm.joints:
        scale = 1.0 + LINK_ERROR * rng.uniform(-1.0, 1.0)
        shift = 0.005 * rng.uniform(-1.0, 1.0, 3)
        joints.append(joint.replace(mass=scale * joint.mass, com=joint.com + shift, inertia=scale * joint.inertia))
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

    time_ns: Array
    position: Array
    phase_a: Array
    phase_b: Array


class Sensors:
    """Two current sensors per motor and the encoders: offset, gain, noise and what a reversal does to the wave."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self._rng = rng
        self.offset = OFFSET * NOMINAL[:, None] * rng.uniform(-1.0, 1.0, (6, 2))
        self.gain = 1.0 + GAIN_MISMATCH * rng.uniform(-1.0, 1.0, (6, 2))
        self.angle = rng.uniform(-math.pi, math.pi, 6)

    def read(self, motion: Motion) -> Readings:
        """Measure."""
        i_q = motion.torque / (K_T * GEAR)
        theta = POLE_PAIRS * GEAR * (motion.q @ B.T) + self.angle
        a = -i_q * np.sin(theta)
        b = 0.5 * (math.sqrt(3.0) * i_q * np.cos(theta) - a)
        w = glitches(motion.dq @ B.T)
        a, b = a + w * (b - a), b + w * (a - b)
        noise = NOISE * NOMINAL * self._rng.standard_normal((2, *a.shape))
        return Readings(
            time_ns=np.round(motion.time * 1e9).astype(np.int64),
            position=np.round(motion.q / ENCODER) * ENCODER,
            phase_a=a * self.gain[:, 0] + self.offset[:, 0] + noise[0],
            phase_b=b * self.gain[:, 1] + self.offset[:, 1] + noise[1],
        )


def glitches(speed: Array) -> Array:
    """(N, n) how far the two phases have passed into one another, 0 to 1: a half sine after every reversal."""
    length = round(GLITCH * RATE)
    pulse = np.sin(np.pi * (np.arange(length) + 0.5) / length)
    found = np.zeros_like(speed)
    for j, column in enumerate(speed.T):
        way = 0.0
        for k in np.flatnonzero(np.abs(column) > 1e-3):
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
    return A + ((1.0 - from_B + way))[:, None] * (other - A)


def excitation(seed: int, seconds: float, speed: float) -> Callable[[Array], Array]:
    """Fourier motion around the middle between A and B, all joints at once, `speed` times 1, 1, 1, 1.5, 1.5, 2 rad/s at most."""
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
    size = np.minimum(span / np.abs(shape).max(axis=0), fastest / np.abs(np.gradient(shape, t, axis=0)).max(axis=0))

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


def static_poses(count: int) -> tuple[Callable[[Array], Array], list[tuple[float, float]], float]:
    """Poses held after an approach from below, then from above: motion, (time, side) of each hold, length [s]."""
    rng = np.random.default_rng(5)
    targets = poses().mean(axis=0) + np.array([0.5, 0.35, 0.3, 1.2, 0.8, 1.2]) * rng.uniform(-1.0, 1.0, (count, 6))
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
        for (t0, q0), (t1, q1) in zip(knots[:-1], knots[1:], strict=True):
            part = (time >= t0) & (time < t1)
            found[part] = q0 + smooth((time[part] - t0) / (t1 - t0))[:, None] * (q1 - q0)
        return found

    return reference, holds, now


def pushes(seed: int, seconds: float) -> Array:
    """(N, 6) what a tool meets: pushes up to 150 N along the vertical, some sideways, some moment; about 1 s each."""
    rng = np.random.default_rng(seed)
    count = round(seconds * RATE)
    time = np.arange(count + 1) / RATE
    found = np.zeros((count + 1, 6))
    most = np.array([40.0, 40.0, 150.0, 6.0, 6.0, 6.0])
    start = BEGIN + 0.3
    while start < seconds - 1.5:
        length = rng.uniform(1.2, 2.4)
        rise = smooth((time - start) / 0.5) - smooth((time - start - length + 0.5) / 0.5)
        found += rise[:, None] * most * rng.uniform(-1.0, 1.0, 6)
        start += length * rng.uniform(0.6, 1.2)
    return found


# --- ours -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class Identified:
    """What the robot's own motion told, and how sure it is.

    Attributes:
        arm: links as CAD has them, gains as found.
        phases: readings to motor current and torque.
        constants: from the static poses.
        gain_std: (n,) relative deviation of the gains, data sheet where the poses show nothing [1].
        fit: dynamics and friction.
        sliding_std, turning_std: (n,) of the motor torque's error while friction slides, and what is added where its sign
            turns over: var = sliding^2 + turning^2 (1 - z^2), from a log the fit has not seen [N m].
    """

    arm: Arm
    phases: PhaseCurrents
    constants: TorqueConstants
    gain_std: Array
    fit: Fit
    sliding_std: Array
    turning_std: Array


def motor_currents(phases: PhaseCurrents, readings: Readings, *, live: bool = True) -> Array:
    """(N, n) signed motor currents [A]; glitches hold the last good one, or, if not live, are bridged by a straight line."""
    phases.reset()
    found = phases.run(readings.time_ns, readings.phase_a, readings.phase_b, position=readings.position @ B.T)
    if live:
        return found.current
    good = found.status == Status.ok
    rows = np.arange(len(good))
    return np.column_stack(
        [np.interp(rows, rows[g], i[g]) for g, i in zip(good.T, found.current.T, strict=True)]
    )


def as_log(readings: Readings, current: Array, names: Sequence[str]) -> Log:
    """A log with the motors' currents as its effort."""
    return Log(
        time_ns=readings.time_ns,
        position=readings.position,
        effort=current,
        joint_names=tuple(names),
        meta={"effort_unit": "A"},
    )


def calibrated(readings: Readings, gain: Array) -> PhaseCurrents:
    """Sensors and electrical angle from one motion of all joints."""
    motor = readings.position @ B.T
    found = [
        calibrate_phases(motor[:, j], readings.phase_a[:, j], readings.phase_b[:, j], POLE_PAIRS * GEAR[j]) for j in range(6)
    ]
    return PhaseCurrents(
        6,
        k_t=gain / GEAR,
        gear=GEAR,
        pole_pairs=POLE_PAIRS,
        angle_offset=[c.angle_offset for c in found],
        offset=[c.offset for c in found],
        gain=[c.gain for c in found],
        amplitude_std=[1.5 * c.noise for c in found],
        direct_share=0.05,
    )


def torque_constants(phases: PhaseCurrents, arm: Arm, runs: Sequence[Readings], holds: Sequence[tuple[float, float]]) -> TorqueConstants:
    """Gains from the same static poses without and with a known load: what the load adds."""
    free, loaded = (motor_currents(phases, r) for r in runs)
    rows = [(slice(round((end - 0.3) * RATE), round(end * RATE)), side) for end, side in holds]
    extra = with_load(arm, STATIC_LOAD, STATIC_PLACE)
    pose = np.array([runs[1].position[part].mean(axis=0) for part, _ in rows])
    torque = (extra.gravity_torque(pose) - arm.gravity_torque(pose)) @ np.linalg.inv(B)
    current = np.array([loaded[part].mean(axis=0) - free[part].mean(axis=0) for part, _ in rows])
    return fit_torque_constants(torque, current, np.array([np.full(6, side) for _, side in rows]))


def low_pass(values: Array, cutoff: float) -> Array:
    """Causal second-order Butterworth low-pass, settled at the first row."""
    from scipy import signal

    sos = signal.butter(2, cutoff / (math.pi * RATE), output="sos")
    start = signal.sosfilt_zi(sos)[:, :, None] * values[0]
    found: Array = signal.sosfilt(sos, values, axis=0, zi=start)[0]
    return found


LAG = math.sqrt(2.0) * (1.0 / KINEMATIC + 1.0 / CUTOFF)
"""how late both low-passes are at low frequencies [s]"""


def motor_residual(found: Fit, gain: Array, phases: PhaseCurrents, readings: Readings) -> tuple[Array, Array, Array]:
    """(N, n) external torque at the motors [N m], LAG late; the remembered sign of friction; how long a glitch lasts [s].

    While a glitch hides a motor's current, its external torque is taken to stay: friction and gravity go on by the model.
    """
    phases.reset()
    measured = phases.run(readings.time_ns, readings.phase_a, readings.phase_b, position=readings.position @ B.T)
    q = low_pass(readings.position, KINEMATIC)
    dq = np.gradient(q, 1.0 / RATE, axis=0)
    ddq = np.gradient(dq, 1.0 / RATE, axis=0)
    torque, z = found.torque(q, dq, ddq, 1.0 / RATE)
    residual = torque - low_pass(measured.current * gain, KINEMATIC)
    blind = measured.status != Status.ok
    # what the filter of the currents still remembers of it
    memory = round(2.0 * RATE / KINEMATIC)
    for shift in range(1, memory + 1):
        blind[shift:] |= measured.status[:-shift] != Status.ok
    hidden = np.zeros_like(residual)
    for k in range(1, len(residual)):
        at = blind[k]
        hidden[k] = np.where(at, hidden[k - 1] + 1.0 / RATE, 0.0)
        residual[k] = np.where(at, residual[k - 1], residual[k])
    return low_pass(residual, CUTOFF), z, hidden


def error_model(residual: Array, z: Array) -> tuple[Array, Array]:
    """Standard deviations (n,), (n,) of var = sliding^2 + turning^2 (1 - z^2), by the residuals of a free motion."""
    sliding, turning = np.zeros(residual.shape[1]), np.zeros(residual.shape[1])
    for j, (r, s) in enumerate(zip(residual.T, z.T, strict=True)):
        share = 1.0 - np.square(s)
        quiet = share < 0.1
        sliding[j] = np.sqrt(np.mean(np.square(r[quiet])))
        turned = ~quiet
        excess = np.maximum(0.0, np.sum((np.square(r) - sliding[j] ** 2)[turned] * share[turned]))
        turning[j] = np.sqrt(excess / max(float(np.sum(np.square(share[turned]))), 1e-300))
    return sliding, turning


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """Wrench on the tip, base axes.

    Attributes:
        wrench: (N, 6) [N, N m].
        std: (N, 6).
    """

    wrench: Array
    std: Array


def ours(robot: Identified, readings: Readings, moment: float = 100.0) -> Estimate:
    """Palpate's estimate of the wrench, LAG late; `moment` is how large a moment may be [N m] (the default of the estimator)."""
    residual, z, hidden = motor_residual(robot.fit, robot.arm.effort.gain(6), robot.phases, readings)
    variance = robot.sliding_std**2 + robot.turning_std**2 * (1.0 - z**2)
    variance += (robot.gain_std * residual) ** 2 + (PUSH_RATE * hidden) ** 2
    covariance = np.einsum("ki,nk,kj->nij", B, variance, B)
    solved = solve_wrench(
        robot.arm.core,
        WrenchEstimator(point="tip", moment_prior_std=moment),
        low_pass(readings.position, KINEMATIC), residual @ B, covariance
    )
    return Estimate(
        np.hstack([solved["force"], solved["moment"]]), np.hstack([solved["force_std"], solved["moment_std"]])
    )


def published(arm: Arm, drives: Drives, readings: Readings, sign: Array, friction_error: float) -> Array:
    """The paper's wrench (N, 6): F = J^-T (M ddq + C dq + g + tau_f - tau), friction F_c sgn + F_v dq off by a part.

    In its favour: the links are known exactly, the torque constants too, and the sign of the current is right. As in the paper: the
    sensors' amplitude formula without a look at the wave, and a position that is read now and then.

    Args:
        sign: (N, n) of the motor currents.
        friction_error: relative.
    """
    hold = RATE // POSITION_RATE
    rows = np.arange(len(readings.position)) // hold * hold
    q = low_pass(readings.position[rows], 30.0)
    dq = np.gradient(q, 1.0 / RATE, axis=0)
    ddq = np.gradient(dq, 1.0 / RATE, axis=0)
    w = dq @ B.T
    friction = (1.0 - friction_error) * (drives.coulomb * np.sign(np.round(w, 4)) + drives.viscous * w)
    phases = PhaseCurrents(6, k_t=K_T, gear=GEAR)
    amplitude = phases.run(readings.time_ns, readings.phase_a, readings.phase_b, controller_current=sign).torque
    rigid = arm.inverse_dynamics(q, dq, ddq) + (ddq @ B.T * drives.inertia) @ B
    external = rigid + (friction - low_pass(amplitude, 30.0)) @ B
    J = arm.jacobian(q, np.zeros(3))
    found: Array = np.linalg.solve(J.transpose(0, 2, 1), external[:, :, None])[:, :, 0]
    return found
