"""Hobby servos that report the current of their supply, not of their motor (XL330).

The bridge passes the power on: V i_bus = R i^2 + k_t w i, with the bus voltage V, the motor current i and the
joint speed w. In the motor's torque tau = k_t i, at the joint side, this is

    V i_bus = a tau^2 + w tau,   a = R / k_t^2,

so R and k_t matter together only. With s the sign of the register, the direction of the drive,

    tau = s (-s w + sqrt(w^2 + 4 a V |i_bus|)) / (2 a).

a and the friction come from logs with a known load.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from palpate.arm import Arm, Array
from palpate.errors import InputError, LogError, MissingExtraError
from palpate.identify._threads import one_thread
from palpate.identify.data import LEAST_CUTOFF, RegressionData, Segment, prepare
from palpate.identify.friction import remembered_sign
from palpate.identify.regress import slowest
from palpate.logs import Log

PRESLIDING = 3e-3
"""x_0 of small gear trains [rad]"""
MOVING = 0.9
"""share of motion (1 less how much of it is rest) that one row of a log must have for the log to show motion"""
START = (30.0, 2e-3, 0.05, 5e-3)
"""where the search starts: W/(N m)^2, kg m^2, N m, N m s/rad; small geared servos are within a decade"""


@dataclass(frozen=True, slots=True)
class BusDrive:
    """What :func:`fit_bus_drive` found of one servo, at the joint side.

    Attributes:
        heat: a = R/k_t^2, the power that one N m at standstill takes [W/(N m)^2].
        rotor_inertia: [kg m^2].
        coulomb: [N m].
        viscous: [N m s/rad].
        rms: of the torque left unexplained in the logs of the fit [N m].
    """

    heat: float
    rotor_inertia: float
    coulomb: float
    viscous: float
    rms: float

    def motor_torque(self, bus: Array, voltage: Array, speed: Array) -> Array:
        """Motor torque at the joint [N m] from supply current [A], its voltage [V] and joint speed [rad/s]."""
        sign = np.sign(bus)
        root = np.sqrt(np.square(speed) + 4.0 * self.heat * np.abs(bus) * np.asarray(voltage))
        found: Array = sign * (root - np.asarray(speed) * sign) / (2.0 * self.heat)
        return found

    def load_torque(self, log: Log, *, voltage: str = "voltage") -> tuple[Array, RegressionData]:
        """Torque the drive gives to what hangs on it: motor torque minus rotor inertia and friction, (M,) [N m].

        Returns:
            the torque, and the data with the kinematics of its rows; rows at rest are in doubt by the Coulomb
            friction.

        Raises:
            InputError, LogError: as in :func:`fit_bus_drive`.
        """
        data, volts = _prepare(log, voltage)
        parts = _columns(self, data, volts)
        return parts @ np.array([1.0, -self.rotor_inertia, -self.viscous, -self.coulomb]), data

    def weigh(self, arm: Arm, log: Log, *, voltage: str = "voltage") -> float:
        """Mass [kg] that hangs on the servo in a log, by least squares over the rows in motion.

        Args:
            arm: one joint; its link is the load, of any mass: only where the mass sits counts.
            log: as in :func:`fit_bus_drive`.
            voltage: name of the signal with the supply voltage.

        Raises:
            InputError, LogError: as in :func:`fit_bus_drive`; the log shows no motion.
        """
        _check(arm)
        torque, data = self.load_torque(log, voltage=voltage)
        expected = data.reduce(lambda s: arm.inverse_dynamics(s.q, s.dq, s.ddq))[:, 0]
        moving = 1.0 - _rest(data)
        weighted = moving * expected
        if moving.max() < MOVING or not np.any(weighted):
            raise LogError("the servo does not move: at rest its friction is anywhere within +-F_c")
        return float(arm.joints[0].mass * (weighted @ torque) / (weighted @ expected))


@one_thread
def fit_bus_drive(arm: Arm, logs: Log | Sequence[Log], *, voltage: str = "voltage") -> BusDrive:
    """Find a = R/k_t^2, rotor inertia and friction of a servo from motion with a known load.

    Args:
        arm: one joint; its link is the known load, everything that moves.
        logs: effort: supply current with the sign of the drive's direction [A]; position [rad].
        voltage: name of the signal with the supply voltage (M,) [V].

    Raises:
        InputError: the arm has not one joint with a mass, or a log lacks the voltage.
        LogError: nothing usable.
        MissingExtraError: without the extra ``identify``.
    """
    try:
        from scipy.optimize import least_squares
    except ImportError:
        raise MissingExtraError("identify", "identification") from None
    _check(arm)
    every = (logs,) if isinstance(logs, Log) else tuple(logs)
    if not every:
        raise InputError("a servo is fitted from at least one log with its known load")
    prepared = [_prepare(log, voltage) for log in every]
    torques = [data.reduce(lambda s: arm.inverse_dynamics(s.q, s.dq, s.ddq))[:, 0] for data, _ in prepared]

    def drive(x: Array, rms: float = 0.0) -> BusDrive:
        heat, rotor_inertia, coulomb, viscous = (float(v) for v in np.exp(x))
        return BusDrive(heat, rotor_inertia, coulomb, viscous, rms)

    def residual(x: Array) -> Array:
        found = drive(x)
        parts = []
        for (data, volts), torque in zip(prepared, torques, strict=True):
            terms = _columns(found, data, volts)
            given = terms @ np.array([1.0, -found.rotor_inertia, -found.viscous, -found.coulomb])
            parts.append((given - torque) * np.sqrt(1.0 - _rest(data)))
        return np.concatenate(parts)

    best = least_squares(residual, np.log(START), loss="soft_l1", f_scale=0.02)
    return drive(best.x, float(np.sqrt(np.mean(np.square(residual(best.x))))))


def _check(arm: Arm) -> None:
    if arm.n != 1 or not arm.has_dynamics:
        raise InputError(f"a servo is fitted with an arm of one joint that has a mass, got {arm!r}")


def _prepare(log: Log, voltage: str) -> tuple[RegressionData, Array]:
    """Kinematics and supply current of the log's driven part, and the voltage per inner row."""
    if log.n != 1:
        raise InputError(f"a servo's log has one joint, this has {log.n}")
    if voltage not in log.signals or log.signals[voltage].value.ndim != 1:
        raise InputError(f"the log needs the supply voltage as signal {voltage!r} (M,)")
    part = log
    if "enabled" in log.signals:
        on = np.interp(log.time_ns, log.signals["enabled"].time_ns, log.signals["enabled"].value) > 0.5
        if not on.any():
            raise LogError("the drive is off throughout the log")
        # the longest stretch under power: what swings freely tells nothing of the current
        edges = np.flatnonzero(np.diff(np.r_[False, on, False].astype(int)))
        longest = int(np.argmax(edges[1::2] - edges[::2]))
        part = log[int(edges[2 * longest]) : int(edges[2 * longest + 1])]
    data = prepare(part, cutoff=LEAST_CUTOFF, velocity=False)
    start = part.time_ns[0]
    times = (log.signals[voltage].time_ns - start) * 1e-9
    volts = np.concatenate([np.interp(s.time, times, log.signals[voltage].value) for s in data.segments])
    return data, volts


def _rest(data: RegressionData) -> Array:
    slow = slowest(data)
    rest: Array = data.reduce(lambda s: 1.0 - np.square(np.tanh(s.dq / slow)))[:, 0].clip(0.0, 1.0)
    return rest


def _columns(drive: BusDrive, data: RegressionData, volts: Array) -> Array:
    """Motor torque, acceleration, speed and remembered sign (M, 4)."""
    begin = np.cumsum([0, *(len(s.time) for s in data.segments)])
    place = {id(s): slice(a, b) for s, a, b in zip(data.segments, begin[:-1], begin[1:], strict=True)}

    def part(s: Segment) -> Array:
        torque = drive.motor_torque(s.effort[:, 0], volts[place[id(s)]], s.dq[:, 0])
        z = remembered_sign(s.dq, 1.0 / s.rate, np.array([PRESLIDING]))[0, :, 0]
        return np.column_stack([torque, s.ddq[:, 0], s.dq[:, 0], z])

    return data.reduce(part)
