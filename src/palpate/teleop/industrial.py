"""The ABB IRB 2400-16 as a slave: heavy, not backdrivable, under the position control of its own drives; what touches
it is told from its phase currents alone (E. del Sol, P. Pagala, R. King, M. Ferre, 2014)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..arm import Arm, Array
from ..drivers.mujoco import MujocoDriver
from ..logs import Sample
from ..simulate.drives import GearedPlant, position_gains
from ..simulate.irb2400 import CurrentSensors, PhaseSensors, truth_drives
from .motor_force import MotorForce, identified
from .pose import pose_minus, pose_of, pose_plus
from .slaves import InScene, Seen

if TYPE_CHECKING:
    from .scenes import Scene

TRACKER = 80.0
"""bandwidth with which the robot's controller smooths the reference it is given [rad/s]"""
PLAY = 3e-4
"""so far the hand may move before the reference does, or its tremor would turn the motors back all the time [m]"""
PLAY_TURN = 5e-4
"""and turn [rad]"""
CERTAIN = 6.0
"""a force of so many standard deviations is a touch, until it is less than half as many of sliding friction [1]"""
SENSORS = 11
"""seed of the current sensors that were there when the robot was identified"""


class IndustrialSlave(InScene):
    """Follows a reference of its tool's tip by the position control of geared drives, and estimates what touches it.

    Outside sees encoder counts and phase currents. The drives' own control knows the links as their maker does and
    turns the motors stiffly; what touches the tool moves it by little::

        tau_m = B^-T ID(q_r, q_r', q_r'') + I B q_r'' + k_p e + k_d e' + k_i int e,    e = B (q_r - q)

    Where friction turns over it is known less well, and at rest it may hide a push: little is felt then, unless a
    touch was certain before. While a glitch hides a current the last force is held.

    Args:
        arm: as it is, with its tool.
        q: (6,) pose at the start [rad].
        scene: what there is to touch; None: nothing.
        seed: of the sensors' noise.

    Raises:
        MissingExtraError: mujoco is not installed.
    """

    def __init__(self, arm: Arm, q: Array, scene: Scene | None = None, *, seed: int = 0) -> None:
        drives = truth_drives(arm)
        build = None if scene is None else scene.build
        self._drives = drives
        self._inverse = np.linalg.inv(drives.B)
        self._gains = position_gains(drives, GearedPlant.seen_inertia(arm, drives, q))
        self._integral = np.zeros(arm.n)
        sensors = PhaseSensors(arm, CurrentSensors.drawn(np.random.default_rng(SENSORS)), seed=seed)
        plant = GearedPlant(arm, drives, q, contacts=build is not None, scene=build)
        self._certain = np.zeros(3, dtype=bool)
        self._estimator = MotorForce(arm, identified(arm.name), period=sensors.period_ns * 1e-9)
        driver = MujocoDriver(plant, sensor=sensors, q=q)
        super().__init__(driver, scene, model=arm)
        self._goal = self._x = self.seen.x.copy()
        self._v, self._a = np.zeros(6), np.zeros(6)

    def hold(self, mass: float) -> None:
        """From now on this mass in the hand is known [kg]: its weight and inertia are not felt."""
        self._estimator.hold(mass)

    def _take(self, sample: Sample) -> None:
        felt = self._felt = self._estimator.step(sample)
        size = np.abs(felt.force)
        # each axis for itself: that it presses ahead says nothing of what friction hides across
        self._certain = (size > CERTAIN * felt.seen_std) | (
            self._certain & (size > 0.5 * CERTAIN * felt.sliding_std)
        )

    def _see(self) -> Seen:
        felt = self._felt
        # where it is the encoders tell at once; what touches it comes later. Of moments nothing is told: they are free
        # in the estimator, and a tool that presses has none
        R, tip, J = self._pose(np.asarray(self._sample.position))
        unknown = np.full(3, np.inf)
        seen_std = np.where(self._certain, felt.sliding_std, felt.seen_std)
        return Seen(
            self._sample.time_ns,
            np.asarray(self._sample.position),
            felt.dq,
            pose_of(R, tip),
            J @ felt.dq,
            np.concatenate((felt.force if felt.good else np.zeros(3), np.zeros(3))),
            np.concatenate((felt.std if felt.good else unknown, unknown)),
            self._reason,
            felt.good and self._lost == 0,
            np.concatenate((seen_std if felt.good else unknown, unknown)),
            self._beyond,
        )

    def follow(self, x_ref: Array, v_ref: Array, push: Array | None = None) -> Array:
        """As of :class:`ArmSlave`, the reference smoothed: da/dt = w^3 (x_r - x) + 3 w^2 (v_r - v) - 3 w a.

        A hand's encoder steps would make the currents jump, and then no glitch could be told from them.
        """
        w, h = TRACKER, self._period
        away, v = pose_minus(x_ref, self._goal), v_ref.copy()
        for axes, play in ((slice(0, 3), PLAY), (slice(3, 6), PLAY_TURN)):
            far = float(np.linalg.norm(away[axes]))
            away[axes] *= max(0.0, 1.0 - play / far) if far > 0.0 else 0.0
            if far <= play:
                v[axes] = 0.0
        self._goal = pose_plus(self._goal, away)
        jerk = w**3 * pose_minus(self._goal, self._x) + 3.0 * w**2 * (v - self._v) - 3.0 * w * self._a
        self._a = self._a + h * jerk
        self._v = self._v + h * self._a
        self._x = pose_plus(self._x, h * self._v)
        return super().follow(self._x, self._v, push)

    def _torque(self, J: Array, ddq_ref: Array, pushed: Array) -> Array:
        B, plant = self._drives.B, self.plant
        kp, kd, ki = self._gains
        error = B @ (self._q_ref - plant.q)
        self._integral = self._integral + self._period * error
        rigid = self.model.inverse_dynamics(self._q_ref, self._dq_ref, ddq_ref) @ self._inverse
        motor = rigid + self._drives.inertia * (B @ ddq_ref)
        motor = motor + kp * error + kd * (B @ (self._dq_ref - plant.dq)) + ki * self._integral
        return motor @ B + pushed
