"""What touches a geared industrial arm, sample by sample, from two phase currents per motor and the encoders alone."""

from __future__ import annotations

import json
import math
from collections import deque
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from importlib import resources
from typing import Any, NamedTuple

import numpy as np

from .. import robots
from .._core import Status, WrenchEstimator, solve_wrench
from ..arm import Arm, Array
from ..errors import InputError
from ..identify import Fit
from ..logs import Sample
from ..logs.repair import BoolArray
from ..phase import PhaseCurrents

KINEMATIC, CUTOFF = 200.0, 100.0
"""low-passes of position and current before friction and acceleration are computed; of the residual [rad/s]"""
PUSH_RATE = 300.0
"""how fast an external torque may change unseen while a glitch hides a current [N m/s]"""
TURNED_BACK, TURNED_BY = 0.045, 4.5e-5
"""a motor that turns back has no sine for so long [s]; it has turned back when it is so far from where it was farthest
[rad]"""
BEFORE = 0.012
"""so long a glitch spoils currents before anything shows it [s]"""
CATCH_UP = 2.0 / KINEMATIC
"""how long the currents' low-pass needs after a glitch [s]"""
PER_WAY, PER_TIME = 158.0, 2.0
"""how much a touch may change: by 5 N over a millimetre of the tool's way, as against 5 kN/m [N/sqrt(m)]; by itself
[N/sqrt(s)]"""
MOMENT = 0.2
"""lever of a force's moment about the grasp point [m]"""
SUDDEN = 3.0
"""a residual that is off by so many of its deviations is a push that began [1]"""
READING = 0.5
"""deviation of a motor torque's reading, friction aside [N m]"""
WARM_UP = 0.1
"""so long nothing is taken for a touch: low-passes settle [s]"""
DIRECT_SHARE, CURRENT_RATE = 0.05, 20.0
"""of :class:`palpate.phase.PhaseCurrents`: 60 N m of friction turned over in 20 ms are 20 A/s"""


@dataclass(frozen=True, slots=True, eq=False)
class MotorModel:
    """What identification has found of an arm with geared drives, at the motors: rigid body, friction, gains, errors.

    Torque of the motors for a motion without contact, with w = B dq and Dahl's remembered sign z of each motor::

        tau_m = B^-T Y(q, q', q'') phi + F_c z + F_b z_b + F_v w + f_0 + I w'
        z' = |w| (sgn w - z)/x_0,    z_b' = |w| (exp(-(w/v_s)^2) sgn w - z_b)/x_0

    Attributes:
        B: (n, n) motor speeds = B dq.
        phi: (10 n,) rigid-body parameters of the links.
        coulomb, viscous, offset, bump: (n,) F_c, F_v, f_0, F_b [N m, N m s/rad, N m, N m].
        rotor: (n,) I [kg m^2].
        presliding, stribeck_velocity: (n,) x_0 [rad], v_s [rad/s].
        gain, gain_std: (n,) torque at the link side per ampere [N m/A] and its relative deviation [1].
        sliding_std, turning_std: (n,) of the motor torque's error: variance = sliding^2 + turning^2 (1 - z^2) [N m].
        gear, pole_pairs: (n,) of the motors [1].
        angle_offset: (n,) electrical angle at position 0 [rad].
        sensor_offset, sensor_gain: (n, 2) of the current sensors [A, 1].
        amplitude_std: (n,) noise of the amplitude [A].
    """

    B: Array
    phi: Array
    coulomb: Array
    viscous: Array
    offset: Array
    bump: Array
    rotor: Array
    presliding: Array
    stribeck_velocity: Array
    gain: Array
    gain_std: Array
    sliding_std: Array
    turning_std: Array
    gear: Array
    pole_pairs: Array
    angle_offset: Array
    sensor_offset: Array
    sensor_gain: Array
    amplitude_std: Array

    @classmethod
    def of(cls, found: Fit, **others: Array) -> MotorModel:
        """From a fit with transmission, remembered friction and Stribeck peak; `others` are the attributes it has not.

        Raises:
            InputError: the fit has another friction model.
        """
        terms = found.friction.terms
        if not (
            found.friction.memory
            and "stribeck" in terms
            and "load" not in terms
            and not found.friction.couplings
        ):
            raise InputError("a motor model needs a fit with memory and stribeck, without load or couplings")
        n = found.start.n
        place = {
            (p.name.rpartition(".")[0], p.name.rpartition(".")[2]): k for k, p in enumerate(found.parameters)
        }

        def term(kind: str) -> Array:
            return np.array([found.phi[place[joint, kind]] for joint in found.start.joint_names])

        return cls(
            B=np.eye(n) if found.transmission is None else found.transmission,
            phi=found.phi[: 10 * n],
            coulomb=term("coulomb"),
            viscous=term("viscous"),
            offset=term("offset"),
            bump=term("stribeck"),
            rotor=term("rotor_inertia"),
            presliding=np.array(found.shape.presliding),
            stribeck_velocity=np.array(found.shape.stribeck_velocity),
            **others,
        )

    def to_json(self) -> str:
        """As text; :meth:`from_json` reads it."""
        return json.dumps({k: np.asarray(v).tolist() for k, v in asdict(self).items()}, indent=1) + "\n"

    @classmethod
    def from_json(cls, text: str) -> MotorModel:
        """Read what :meth:`to_json` wrote.

        Raises:
            InputError: something is missing, too much, or no number.
        """
        try:
            found: Mapping[str, Any] = json.loads(text)
            return cls(**{k: np.array(v, dtype=np.float64) for k, v in found.items()})
        except (AttributeError, TypeError, ValueError) as error:
            raise InputError(f"motor model: {error}") from None

    def phases(self) -> PhaseCurrents:
        """Readings of the current sensors to signed motor currents."""
        return PhaseCurrents(
            len(self.gain),
            k_t=self.gain / self.gear,
            gear=self.gear,
            pole_pairs=self.pole_pairs.astype(int),
            angle_offset=self.angle_offset,
            offset=self.sensor_offset,
            gain=self.sensor_gain,
            amplitude_std=self.amplitude_std,
            direct_share=DIRECT_SHARE,
            current_rate=CURRENT_RATE,
        )


def identified(name: str = "abb_irb2400_16") -> MotorModel:
    """What ``scripts/identify_irb2400.py`` found of the simulated robot, by its own motion alone.

    Raises:
        InputError: nothing is known of that robot.
    """
    file = resources.files(__package__).joinpath(f"{name}.json")
    if name not in robots.names() or not file.is_file():
        raise InputError(f"no motor model of {name!r}")
    return MotorModel.from_json(file.read_text(encoding="utf-8"))


class LowPass:
    """Causal second-order Butterworth low-pass of a vector, sample by sample; settled at the first one.

    Args:
        cutoff: [rad/s].
        period: between samples [s].
    """

    def __init__(self, cutoff: float, period: float) -> None:
        k = math.tan(0.5 * cutoff * period)
        norm = 1.0 / (1.0 + math.sqrt(2.0) * k + k * k)
        self._b = k * k * norm
        self._a1, self._a2 = 2.0 * (k * k - 1.0) * norm, (1.0 - math.sqrt(2.0) * k + k * k) * norm
        self._s: tuple[Array, Array] | None = None

    def settle(self, x: Array, which: BoolArray) -> None:
        """As if the components `which` had been x for long."""
        if self._s is not None:
            rest = (1.0 - self._b) * x, (self._b - self._a2) * x
            self._s = np.where(which, rest[0], self._s[0]), np.where(which, rest[1], self._s[1])

    def __call__(self, x: Array) -> Array:
        """The next value, the shape of x."""
        if self._s is None:
            self._s = (1.0 - self._b) * x, (self._b - self._a2) * x
        first, second = self._s
        y: Array = self._b * x + first
        self._s = 2.0 * self._b * x - self._a1 * y + second, self._b * x - self._a2 * y
        return y


class MotorTouch(NamedTuple):
    """What is known after a sample; sqrt(2) (1/KINEMATIC + 1/CUTOFF) late."""

    q: Array
    """(n,) low-passed [rad]"""
    dq: Array
    """(n,) [rad/s]"""
    torque: Array
    """(n,) external torque at the joints [N m]"""
    force: Array
    """(3,) on the tool, base axes [N]"""
    std: Array
    """(3,) its standard deviation [N]"""
    seen_std: Array
    """(3,) the same without what a glitch might hide [N]"""
    sliding_std: Array
    """(3,) the same if friction slid [N]"""
    z: Array
    """(n,) remembered sign of the motors' friction [1]"""
    hidden: bool
    """a glitch hides a current: its external torque is taken to stay"""
    good: bool
    """every current is known"""


class _Split:
    """What of the motors' residual torque is a touch, and what an error of the friction model.

    A Kalman filter of two states for each motor: the touch t changes as the tool moves, for then it presses more or
    less, and slowly by itself; the error e of the friction is renewed as the motor turns, by its presliding, and knows
    its deviation. An arm that stands keeps both apart as they were, however badly its friction is known there::

        y = t + e + noise,    var dt = l^2 (c_s^2 |v| + c_t^2) dt,    e <- a e,    var de = (1 - a^2) S(z),
        a = exp(-|w| dt/x_0),   S = sliding^2 + turning^2 (1 - z^2),   l: lever of the tool at the motor [m]
    """

    def __init__(self, model: MotorModel) -> None:
        n = len(model.gain)
        self._model = model
        self.touch, self._error = np.zeros(n), np.zeros(n)
        # variance of the touch, of the error, and their covariance
        self._own = model.sliding_std**2 + model.turning_std**2
        self.variance = self._own.copy()
        self._both = np.zeros(n)

    def step(
        self, residual: Array, z: Array, turned: Array, lever: Array, way: float, h: float, seen: BoolArray
    ) -> None:
        """A period of `h` [s] later.

        Args:
            residual: (n,) [N m].
            z: (n,) remembered sign of friction [1].
            turned: (n,) way of the motors in this period [rad].
            lever: (n,) [m].
            way: of the tool in this period [m].
            seen: (n,) motors whose residual counts.
        """
        m = self._model
        a = np.exp(-np.abs(turned) / m.presliding)
        friction = m.sliding_std**2 + m.turning_std**2 * (1.0 - z**2)
        touch = self.variance + lever**2 * (PER_WAY**2 * way + PER_TIME**2 * h)
        both, own = a * self._both, a * a * self._own + (1.0 - a * a) * friction
        self._error = a * self._error
        innovation = residual - self.touch - self._error
        total = touch + 2.0 * both + own + READING**2
        # more than friction can be: something pushes
        sudden = np.where(seen & (innovation**2 > SUDDEN**2 * total), innovation**2, 0.0)
        touch, total = touch + sudden, total + sudden
        gain, other = (np.where(seen, part / total, 0.0) for part in (touch + both, both + own))
        self.touch, self._error = self.touch + gain * innovation, self._error + other * innovation
        self.variance = touch - gain * (touch + both)
        self._both = both - gain * (both + own)
        self._own = own - other * (both + own)


class MotorForce:
    """The external torque of a geared arm and the force on its tool, live; the estimator of the sensorless-force study
    with a memory: what touches an arm that stands is what touched it when it came to rest.

    Args:
        arm: kinematics and gravity.
        model: what is known of the drives.
        period: between samples [s].
        moment_std: how large a moment about the grasp point may be [N m].
        cutoffs: low-passes of the readings and of the residual [rad/s].
    """

    def __init__(
        self,
        arm: Arm,
        model: MotorModel,
        *,
        period: float = 1e-3,
        moment_std: float = 3.0,
        cutoffs: tuple[float, float] = (KINEMATIC, CUTOFF),
    ) -> None:
        self.arm, self.model = arm, model
        self._h = period
        self._inverse = np.linalg.inv(model.B)
        self._phases = model.phases()
        self._wrench = WrenchEstimator(point="grasp", moment_prior_std=moment_std)
        self._cutoffs = cutoffs
        self.hold(0.0)
        self.reset()

    def reset(self) -> None:
        """Back to the state before the first sample."""
        n = self.arm.n
        kinematic, residual = self._cutoffs
        self._phases.reset()
        self._position, self._current = LowPass(kinematic, self._h), LowPass(kinematic, self._h)
        self._smooth = LowPass(residual, self._h)
        self._q: Array | None = None
        self._dq, self._v = np.zeros(n), np.zeros(3)
        self._z, self._bump = np.zeros(n), np.zeros(n)
        self._residual = np.zeros(n)
        self._split, self._steps = _Split(self.model), 0
        self._since, self._hidden = np.full(n, math.inf), np.zeros(n)
        self._way, self._turned, self._farthest = np.zeros(n), np.full(n, math.inf), np.full(n, math.nan)
        self._past = deque([np.zeros(n)], maxlen=max(1, round(BEFORE / self._h)))

    def hold(self, mass: float) -> None:
        """From now on this mass at the grasp point is known [kg]: its weight and inertia are not felt."""
        self._mass = mass

    def step(self, sample: Sample) -> MotorTouch:
        """Take a sample whose effort is (n, 2), both phase currents of every motor [A].

        Raises:
            InputError: the effort has another shape.
        """
        m, h = self.model, self._h
        readings = np.asarray(sample.effort, dtype=np.float64)
        if readings.shape != (self.arm.n, 2):
            raise InputError(
                f"phase currents: expected effort of shape ({self.arm.n}, 2), got {readings.shape}"
            )
        position = np.asarray(sample.position, dtype=np.float64)
        found = self._phases.run(
            [sample.time_ns], readings[None, :, 0], readings[None, :, 1], position=(m.B @ position)[None]
        )
        status = found.status[0]
        good = bool(np.all((status == Status.ok) | (status == Status.held)))
        q = self._position(position)
        before = q if self._q is None else self._q
        dq = (q - before) / h
        ddq = (dq - self._dq) / h
        self._q, self._dq = q, dq
        needed = self._needed(q, dq, ddq) - self._of_load(q, dq) @ self._inverse
        residual = needed - self._current(
            np.where(np.isfinite(found.current[0]), found.current[0], 0.0) * m.gain
        )

        blind = (status != Status.ok) | self._turns_back(m.B @ position)
        self._since = np.where(blind, 0.0, self._since + h)
        after = self._since <= CATCH_UP + 0.5 * h
        begins = after & (self._hidden == 0.0)
        self._hidden = np.where(after, self._hidden + h, 0.0)
        if begins.any():
            self._smooth.settle(self._past[0], begins)
        self._residual = np.where(begins, self._past[0], np.where(after, self._residual, residual))
        external = self._smooth(self._residual)
        self._past.append(external)

        self._steps += 1
        if self._steps * h > WARM_UP:
            J = self.arm.jacobian(q, self.arm.grasp)[:3]
            lever = np.hypot(np.linalg.norm(J @ self._inverse, axis=0), MOMENT)
            way = float(np.linalg.norm(J @ dq)) * h
            self._split.step(external, self._z, m.B @ dq * h, lever, way, h, self._hidden == 0.0)
        touch = self._split.touch
        tau = touch @ m.B
        gain = (m.gain_std * touch) ** 2
        sliding, seen = m.sliding_std**2 + gain, self._split.variance + gain
        covariance = np.einsum(
            "ki,rk,kj->rij",
            m.B,
            [seen + (PUSH_RATE * self._hidden) ** 2, seen, np.minimum(sliding, seen)],
            m.B,
        )
        three = np.ones((3, 1))
        solved = solve_wrench(self.arm.core, self._wrench, three * q, three * tau, covariance)
        force, std = solved["force"][1], solved["force_std"]
        return MotorTouch(q, dq, tau, force, std[0], std[1], std[2], self._z, bool(self._hidden.any()), good)

    def _turns_back(self, position: Array) -> BoolArray:
        """(n,) motors that have turned back lately, by their positions (n,) [rad]."""
        ahead = (position - self._farthest) * self._way
        first = np.isnan(self._farthest)
        back = (self._way != 0.0) & (ahead < -TURNED_BY)
        starts = (self._way == 0.0) & (np.abs(position - self._farthest) > TURNED_BY)
        self._turned = np.where(back, 0.0, self._turned + self._h)
        self._way = np.where(
            back, -self._way, np.where(starts, np.sign(position - self._farthest), self._way)
        )
        self._farthest = np.where(first | back | starts | (ahead > 0.0), position, self._farthest)
        found: BoolArray = self._turned < TURNED_BACK
        return found

    def _needed(self, q: Array, dq: Array, ddq: Array) -> Array:
        """(n,) torque of the motors for this motion [N m]; friction remembers it."""
        m = self.model
        w = m.B @ dq
        decay = np.exp(-np.abs(w) * self._h / m.presliding)
        goal = np.sign(w) * (1.0 - decay)
        self._z = self._z * decay + goal
        self._bump = self._bump * decay + goal * np.exp(-np.square(w / m.stribeck_velocity))
        rigid = self.arm.regressor(q[None], dq[None], ddq[None])[0] @ m.phi @ self._inverse
        torque: Array = (
            rigid
            + m.coulomb * self._z
            + m.bump * self._bump
            + m.viscous * w
            + m.offset
            + m.rotor * (m.B @ ddq)
        )
        return torque

    def _of_load(self, q: Array, dq: Array) -> Array:
        """(n,) external torque of the mass that is held [N m]."""
        J = self.arm.jacobian(q, self.arm.grasp)[:3]
        v = J @ dq
        a = (v - self._v) / self._h
        self._v = v
        return self._mass * (J.T @ (self.arm.gravity - a))
