"""The external force of the IRB 2400: identified from its own motion and estimated, and by the paper's method."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from .._core import Status, WrenchEstimator, solve_wrench
from ..arm import Arm, Array, Effort
from ..identify import (
    Fit,
    FrictionModel,
    PhaseCalibration,
    TorqueConstants,
    calibrate_phases,
    fit,
    fit_torque_constants,
)
from ..logs import Log
from ..logs.repair import BoolArray
from ..phase import PhaseCurrents
from ..simulate.drives import Drives
from ..simulate.irb2400 import ENCODER, GEAR, K_T, POLE_PAIRS, B, truth_arm, truth_drives
from ._geared_arm import RATE, Motion, Run, simulate
from ._irb2400 import (
    BEGIN,
    CURRENT_RATE,
    CUTOFF,
    FIT_CUTOFF,
    FRICTION_ERROR,
    KINEMATIC,
    PAPER_CUTOFF,
    POSITION_RATE,
    PUSH_RATE,
    SECONDS,
    SHEET_STD,
    STATIC_LOAD,
    STATIC_PLACE,
    TOOL_MOMENT,
    Readings,
    Sensors,
    excitation,
    prior_arm,
    pushes,
    static_poses,
    stop_and_go,
    there_and_back,
    with_load,
)

# --- ours -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class Identified:
    """What the robot's own motion told, and how sure it is.

    Attributes:
        arm: links as CAD has them, gains as found.
        calibration: of every motor's sensors.
        phases: readings to motor current and torque.
        constants: from the static poses.
        gain_std: (n,) relative deviation of the gains, data sheet where the poses show nothing [1].
        fit: dynamics and friction.
        sliding_std, turning_std: (n,) of the motor torque's error while friction slides, and what is added
            where its sign
            turns over: var = sliding^2 + turning^2 (1 - z^2), from a log the fit has not seen [N m].
    """

    arm: Arm
    calibration: tuple[PhaseCalibration, ...]
    phases: PhaseCurrents
    constants: TorqueConstants
    gain_std: Array
    fit: Fit
    sliding_std: Array
    turning_std: Array


def motor_currents(phases: PhaseCurrents, readings: Readings) -> tuple[Array, BoolArray]:
    """(N, n) signed motor currents [A], and where they are not believed: a glitch repeats the last good one."""
    phases.reset()
    found = phases.run(readings.time_ns, readings.phase_a, readings.phase_b, position=readings.position @ B.T)
    return found.current, found.status != Status.ok


def bridged(current: Array, blind: BoolArray) -> Array:
    """The currents of a log, glitches bridged by a straight line."""
    rows = np.arange(len(current))
    return np.column_stack(
        [np.interp(rows, rows[~b], i[~b]) for b, i in zip(blind.T, current.T, strict=True)]
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


def calibrated(readings: Readings) -> list[PhaseCalibration]:
    """Sensors and electrical angles from one motion of all joints."""
    motor = readings.position @ B.T
    return [
        calibrate_phases(motor[:, j], readings.phase_a[:, j], readings.phase_b[:, j], POLE_PAIRS * GEAR[j])
        for j in range(6)
    ]


def phase_currents(found: Sequence[PhaseCalibration], gain: Array) -> PhaseCurrents:
    """Readings to motor currents."""
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
        current_rate=CURRENT_RATE,
    )


def torque_constants(
    phases: PhaseCurrents, arm: Arm, runs: Sequence[Readings], holds: Sequence[tuple[float, float]]
) -> TorqueConstants:
    """Gains from the same static poses without and with a known load: what the load adds."""
    free, loaded = (motor_currents(phases, r)[0] for r in runs)
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


def motor_residual(
    found: Fit, gain: Array, position: Array, current: Array, blind: BoolArray
) -> tuple[Array, Array, Array]:
    """(N, n) external torque at the motors [N m], LAG late; the remembered sign of friction; how long a glitch
    lasts [s].

    While a glitch hides a motor's current, its external torque is taken to stay: friction and gravity go on by
    the model.
    """
    q = low_pass(position, KINEMATIC)
    dq = np.gradient(q, 1.0 / RATE, axis=0)
    ddq = np.gradient(dq, 1.0 / RATE, axis=0)
    torque, z = found.torque(q, dq, ddq, 1.0 / RATE)
    residual = torque - low_pass(current * gain, KINEMATIC)
    # the filter of the currents needs a moment to catch up
    after = blind.copy()
    for shift in range(1, round(2.0 * RATE / KINEMATIC) + 1):
        after[shift:] |= blind[:-shift]
    hidden = np.zeros_like(residual)
    for k in range(1, len(residual)):
        if after[k].any():
            hidden[k] = np.where(after[k], hidden[k - 1] + 1.0 / RATE, 0.0)
            residual[k] = np.where(after[k], residual[k - 1], residual[k])
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
        z: (N, 6) remembered sign of the motors' friction [1].
    """

    wrench: Array
    std: Array
    z: Array


def ours(
    robot: Identified, position: Array, current: Array, blind: BoolArray, moment: float = TOOL_MOMENT
) -> Estimate:
    """Palpate's estimate of the wrench, LAG late; `moment` is how large a moment may be [N m]."""
    residual, z, hidden = motor_residual(robot.fit, robot.arm.effort.gain(6), position, current, blind)
    variance = robot.sliding_std**2 + robot.turning_std**2 * (1.0 - z**2)
    variance += (robot.gain_std * residual) ** 2 + (PUSH_RATE * hidden) ** 2
    covariance = np.einsum("ki,nk,kj->nij", B, variance, B)
    solved = solve_wrench(
        robot.arm.core,
        WrenchEstimator(point="tip", moment_prior_std=moment),
        low_pass(position, KINEMATIC),
        residual @ B,
        covariance,
    )
    return Estimate(
        np.hstack([solved["force"], solved["moment"]]),
        np.hstack([solved["force_std"], solved["moment_std"]]),
        z,
    )


def published(arm: Arm, drives: Drives, readings: Readings, sign: Array, friction_error: float) -> Array:
    """The paper's wrench (N, 6): F = J^-T (M ddq + C dq + g + tau_f - tau), friction F_c sgn + F_v dq off by a part.

    In its favour: the links are known exactly, the torque constants too, and the sign of the current is right.
    As in the paper: the sensors' amplitude formula without a look at the wave, and a position that is read now
        and then.

    Args:
        sign: (N, n) of the motor currents.
        friction_error: relative.
    """

    def slow(values: Array) -> Array:
        """Twice, so that accelerations of a position in steps are no spikes."""
        return low_pass(low_pass(values, PAPER_CUTOFF), PAPER_CUTOFF)

    hold = RATE // POSITION_RATE
    rows = np.arange(len(readings.position)) // hold * hold
    q = slow(readings.position[rows])
    dq = np.gradient(q, 1.0 / RATE, axis=0)
    ddq = np.gradient(dq, 1.0 / RATE, axis=0)
    w = dq @ B.T
    # at rest the sign of the last motion, which is kinder than none
    moving = np.abs(w) > 1e-3
    newest = np.maximum.accumulate(np.where(moving, np.arange(len(w))[:, None], 0), axis=0)
    sign_of_motion = np.sign(np.take_along_axis(w, newest, axis=0))
    friction = (1.0 - friction_error) * (drives.coulomb * sign_of_motion + drives.viscous * w)
    phases = PhaseCurrents(6, k_t=K_T, gear=GEAR)
    amplitude = phases.run(
        readings.time_ns, readings.phase_a, readings.phase_b, controller_current=sign
    ).torque
    rigid = arm.inverse_dynamics(q, dq, ddq) + (ddq @ B.T * drives.inertia) @ B
    external = rigid + (friction - slow(amplitude)) @ B
    J = arm.jacobian(q, np.zeros(3))
    found: Array = np.linalg.solve(J.transpose(0, 2, 1), external[:, :, None])[:, :, 0]
    return found


def friction_alone(arm: Arm, drives: Drives, motion: Motion) -> Array:
    """(N, 6) error of the paper's wrench if all is known but FRICTION_ERROR of Coulomb and viscous friction."""
    w = motion.dq @ B.T
    error = FRICTION_ERROR * (drives.coulomb * np.sign(w) + drives.viscous * w)
    J = arm.jacobian(motion.q, np.zeros(3))
    return np.asarray(
        np.linalg.solve(J.transpose(0, 2, 1), (error @ B)[:, :, None])[:, :, 0], dtype=np.float64
    )


# --- the experiment ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Plan:
    """How much is done."""

    excitation: float
    """length of the Fourier motion [s]"""
    moves: int
    """of the stop-and-go motion to fit"""
    check: int
    """of the one to hold out"""
    poses: int
    """static poses, each from both sides"""
    records: int
    """A -> B -> A with different pushes"""
    changes: tuple[float, ...]
    """friction that has changed since identification, relative"""


FULL = Plan(80.0, 20, 12, 8, 6, (0.05, 0.1, 0.3))
QUICK = Plan(12.0, 3, 2, 4, 1, (0.1,))

FRICTION = FrictionModel(
    stribeck=True,
    memory=True,
    stiction=0.3,
    presliding=tuple(1e-4 * 1.2**k for k in range(17)),
    velocities=tuple(0.01 * 1.2**k for k in range(17)),
)
"""what a slow, stiffly controlled arm calls for: friction down to rest"""


@dataclass(frozen=True, slots=True, eq=False)
class Experiment:
    """The robot, what was identified, and its records.

    Attributes:
        arm, drives, sensors: the truth.
        robot: what palpate knows.
        records: A -> B -> A with pushes.
        free: the same without.
        changed: (part, record) with friction that has changed.
    """

    arm: Arm
    drives: Drives
    sensors: Sensors
    robot: Identified
    records: list[Motion]
    free: Motion
    changed: list[tuple[float, Motion]]


def experiment(plan: Plan, progress: Callable[[float], None], fresh: int = 0) -> Experiment:
    """Simulate everything, then identify the robot from its own motion.

    Args:
        fresh: 0 for the experiment by which settings were chosen; each other number is one with another prior, other
            sensors, motions and pushes.
    """
    arm, seed = truth_arm(), 1000 * fresh
    drives, prior, sensors = truth_drives(arm), prior_arm(arm, seed + 7), Sensors(seed + 11)
    held = with_load(arm, STATIC_LOAD, STATIC_PLACE)
    static, holds, static_seconds = static_poses(seed + 5, plan.poses)
    to_fit, fit_seconds = stop_and_go(seed + 2, plan.moves)
    to_check, check_seconds = stop_and_go(seed + 3, plan.check)
    own = [
        Run(arm, drives, excitation(seed + 1, plan.excitation, 0.15), plan.excitation),
        Run(arm, drives, to_fit, fit_seconds),
        Run(arm, drives, to_check, check_seconds),
        Run(arm, drives, static, static_seconds),
        Run(held, drives, static, static_seconds),
    ]
    records = [Run(arm, drives, there_and_back, SECONDS, pushes(seed + 20 + k)) for k in range(plan.records)]
    others = [Run(arm, drives, there_and_back, SECONDS)]
    for part in plan.changes:
        worn = replace(
            drives,
            coulomb=(1.0 + part) * drives.coulomb,
            static=(1.0 + part) * drives.static,
            viscous=(1.0 + part) * drives.viscous,
        )
        others.append(Run(arm, worn, there_and_back, SECONDS, pushes(seed + 20)))
    motions = simulate([*own, *records, *others], progress)
    robot = identify(prior, [sensors.read(m) for m in motions[: len(own)]], holds)
    after = motions[len(own) + len(records) :]
    return Experiment(
        arm,
        drives,
        sensors,
        robot,
        motions[len(own) : len(own) + len(records)],
        after[0],
        list(zip(plan.changes, after[1:], strict=True)),
    )


def identify(prior: Arm, runs: Sequence[Readings], holds: Sequence[tuple[float, float]]) -> Identified:
    """All from the robot's own motion: Fourier, stop and go, the same to hold out, static poses without and
    with the load."""
    calibration = calibrated(runs[0])
    phases = phase_currents(calibration, K_T * GEAR)
    constants = torque_constants(phases, prior, runs[3:5], holds)
    # where no pose tells, the data sheet: off by as much as its tolerance
    gain = np.where(constants.seen, constants.gain, (1.0 + 0.6 * SHEET_STD) * K_T * GEAR)
    gain_std = np.where(constants.seen, constants.std / gain, SHEET_STD)
    arm = prior.replace(effort=Effort.current(gain.tolist()))
    currents = [motor_currents(phases, r) for r in runs[:3]]
    logs = [as_log(r, bridged(*i), arm.joint_names) for r, i in zip(runs[:3], currents, strict=True)]
    found = fit(arm, logs[:2], friction=FRICTION, cutoff=FIT_CUTOFF, transmission=B, validate_on=logs[2])
    residual, z, _ = motor_residual(found, arm.effort.gain(6), runs[2].position, *currents[2])
    settled = slice(3 * RATE, None)
    sliding, turning = error_model(residual[settled], z[settled])
    return Identified(arm, tuple(calibration), phases, constants, gain_std, found, sliding, turning)


def late(wrench: Array) -> Array:
    """The true wrench LAG earlier."""
    shift = round(LAG * RATE)
    return np.vstack([np.repeat(wrench[:1], shift, axis=0), wrench[:-shift]])


@dataclass(frozen=True, slots=True, eq=False)
class Score:
    """Errors of records, all rows together from the time the robot is at A.

    Attributes:
        error: (M, 6) [N, N m].
        std: (M, 6).
        turning: (M,) friction of motor 2 or 3 is turning over.
    """

    error: Array
    std: Array
    turning: BoolArray

    @property
    def mean(self) -> Array:
        """(6,) mean |error|."""
        return np.abs(self.error).mean(axis=0)

    @property
    def coverage(self) -> Array:
        """(6,) part of the rows within 1.96 standard deviations."""
        return (np.abs(self.error) <= 1.96 * self.std).mean(axis=0)


def score(parts: Sequence[tuple[Estimate, Array]]) -> Score:
    """Estimates against true wrenches."""
    rows = slice(round(BEGIN * RATE), None)
    return Score(
        np.vstack([(e.wrench - truth)[rows] for e, truth in parts]),
        np.vstack([e.std[rows] for e, _ in parts]),
        np.concatenate([(e.z[rows, 1:3] ** 2 < 0.9).any(axis=1) for e, _ in parts]),
    )


def estimate(x: Experiment, motion: Motion, moment: float = TOOL_MOMENT) -> Estimate:
    """Measure and estimate."""
    readings = x.sensors.read(motion)
    return ours(x.robot, readings.position, *motor_currents(x.robot.phases, readings), moment)


def with_exact_currents(x: Experiment, motion: Motion) -> Estimate:
    """As if the currents were known without sensors: what the model's error leaves."""
    current = motion.torque / (K_T * GEAR)
    position = np.round(motion.q / ENCODER) * ENCODER
    return ours(x.robot, position, current, np.zeros(current.shape, dtype=bool))


def with_exact_model(x: Experiment, motion: Motion) -> Estimate:
    """As if the robot were its identified model: what sensors, glitches and filters leave."""
    acceleration = np.gradient(motion.dq, 1.0 / RATE, axis=0)
    needed = x.robot.fit.torque(motion.q, motion.dq, acceleration, 1.0 / RATE)[0]
    J = x.arm.jacobian(motion.q, np.zeros(3))
    external = np.einsum("nij,ni->nj", J, motion.wrench) @ np.linalg.inv(B)
    torque = (needed - external) * (K_T * GEAR) / x.robot.arm.effort.gain(6)
    return estimate(x, replace(motion, torque=torque))
