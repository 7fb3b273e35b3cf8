"""A leader arm and its twin, of hobby servos: joint to joint, as SO-101 and GELLO are used; the leader can push back.

The leader is any driver of servos that takes torque: the simulated one, or a real arm on a Feetech or Dynamixel bus.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ..arm import Arm, Array, Sensing
from ..drivers.driver import Driver
from ..drivers.mujoco import MujocoDriver
from ..errors import InputError
from ..logs import Sample
from ..simulate import Plant, SensorModel
from .masters import Hand
from .servo_force import CountedMotion, ServoForce
from .slaves import RATE, InScene, Seen

if TYPE_CHECKING:
    from .scenes import Scene

COUNT = 2.0 * math.pi / 4096.0
"""of the encoders, 12 bit a turn [rad]"""
TORQUE_CONSTANT = 2.94 / 2.7
"""at the horn, stall torque over stall current of the STS3215-C018 [N m/A]"""
CURRENT_STEP = 6.5e-3
"""of the current that it reports [A]"""
LOAD_FRICTION = 0.2116
"""part of the load its gears lose (Rhoban/bam, feetech_sts3215_7_4V, m3) [1]"""
BANDWIDTH = 50.0
"""of the follower's position control [rad/s]: encoders of 12 bit allow no more"""
STIFFENING = 2.0
"""bandwidth with which the external torque is taken off [rad/s]"""
FORWARD = 30.0
"""low-pass of the reference's acceleration [rad/s]"""
BUS_RATE = 250.0
"""readings and commands per second, what a bus of six servos at 1 Mbit/s allows [Hz]"""
OBSERVER = 60.0
"""bandwidth of the corrections by the encoders, both arms' [rad/s]: with steps of 12 bit more is noise"""
DITHER, DITHER_PERIOD = 2.5, 8
"""amplitude of the torque that shakes a follower in contact, part of what its friction can be, and its period in
commands [1]: well above one, so that friction turns over within each period; 31 Hz, where a joint hardly moves"""
NOISE, BEHIND = 0.02, 0.08
"""deviation of the external torque where nothing touches [N m], and what is added of all joints' torque of a touch [1]:
it changes faster than the observer"""
CERTAIN, GONE = 64.0, 16.0
"""a touch is certain where the sum of the joints' (torque/std)^2 is above the one, until it is below the other [1]"""
TURNING = 0.05
"""speed of the reference from which on friction is made up for whole [rad/s]"""


def with_servos(arm: Arm) -> Arm:
    """The arm with what its servos measure: 12 bit of position, no velocity, current in steps."""
    sensing = Sensing(
        position_resolution=COUNT,
        position_std=0.0,
        torque_std=CURRENT_STEP * TORQUE_CONSTANT / math.sqrt(12.0),
    )
    return arm.replace(joints=tuple(j.replace(sensing=sensing) for j in arm.joints))


def with_load_friction(arm: Arm) -> Arm:
    """The arm as it is: its gears lose a part of what they carry."""
    return arm.replace(
        joints=tuple(j.replace(friction=replace(j.friction, load=LOAD_FRICTION)) for j in arm.joints)
    )


class LeaderArm:
    """A leader arm behind the driver contract, as a master of n axes [rad, N m].

    Its motors bear its weight, so that a hand moves it freely, and add what is to be felt. Friction of the leader's own
    gears is felt too: it is not compensated, because a compensation that is too large would move by itself.

    Args:
        driver: of the arm; connected and enabled here.
        arm: its model.
        force_limit: (n,) torque that is added at most, or one number [N m].
        count: of its encoders [rad].
    """

    def __init__(
        self, driver: Driver, arm: Arm, *, force_limit: float | Array = 2.0, count: float = COUNT
    ) -> None:
        self.driver, self.arm = driver, arm
        self.force_limit: Array = np.broadcast_to(np.asarray(force_limit, dtype=np.float64), (arm.n,))
        self._period = driver.period_ns * 1e-9
        self._motion = CountedMotion(arm.n, count, OBSERVER, self._period)
        driver.connect()
        driver.enable()
        self._due = 0.0
        self._take(driver.read())

    def _take(self, sample: Sample | None) -> None:
        if sample is None:
            return
        q = np.asarray(sample.position)
        moves = self._motion(q)
        self._dq = moves if sample.velocity is None else np.asarray(sample.velocity)
        self._q = q.copy()

    def read(self) -> tuple[Array, Array]:
        """(n,) joint positions [rad], (n,) velocities [rad/s]."""
        return self._q, self._dq

    def step(self, force: Array, dt: float) -> None:
        """Push back with a torque (n,) [N m] for `dt` [s]; the bus is slower than the coupling, so it is told now and
        then, and the next sample is waited for.

        Raises:
            DriverError: the arm does not answer.
        """
        self._due += dt
        if self._due < self._period - 1e-9:
            return
        self._due = 0.0
        felt = np.clip(force, -self.force_limit, self.force_limit)
        self.driver.write(self.arm.gravity_torque(self._q) + felt)
        self._take(self.driver.read())

    def close(self) -> None:
        """Stop the drives and let go."""
        self.driver.close()


class HeldPlant(Plant):
    """A simulated arm in a hand, whose impedance acts on its joints: [rad, N m] in place of [m, N].

    Args:
        arm: as it is.
        hand: who holds it.
    """

    def __init__(self, arm: Arm, hand: Hand) -> None:
        self.hand = hand
        """who holds it"""
        super().__init__(arm, timestep=5e-4, integrator="discrete")

    def _advance(self, tau: Array, count: int, h: float) -> None:
        mine = tau + self.hand.force(self.time_ns * 1e-9, self._q, self._dq)
        np.subtract(mine, self._offset, out=self._applied)
        super()._advance(tau, count, h)


class SimulatedLeader(LeaderArm):
    """A leader in MuJoCo, in a hand.

    Args:
        arm: the leader.
        q: (n,) pose at the start [rad].
        hand: its wish in joint angles [rad], its impedance at the joints [N m/rad, N m s/rad].
        seed: of the sensors' noise.
    """

    def __init__(self, arm: Arm, q: Array, hand: Hand, *, seed: int = 0) -> None:
        known = with_servos(arm)
        rotors = tuple(j.replace(rotor_inertia=j.rotor_inertia + hand.mass) for j in known.joints)
        self.plant = HeldPlant(known.replace(joints=rotors), hand)
        sensor = SensorModel(known, rate=BUS_RATE, seed=seed)
        super().__init__(MujocoDriver(self.plant, sensor=sensor, q=q), known)

    @property
    def hand(self) -> Hand:
        """Who holds it."""
        return self.plant.hand

    @hand.setter
    def hand(self, hand: Hand) -> None:
        self.plant.hand = hand


class ServoSlave(InScene):
    """The follower: joint references in, external torque of the joints out, from positions and currents of its servos.

    Computed torque with feed-forward friction; the external torque is that of :class:`ServoForce`. While a touch is
    certain the motors shake the joints, each against the next, by less than a step of their encoders, or stiction
    would hide what presses::

        std^2 = s_0^2 + s_1^2 |tau_ext|^2 + (p F)^2/3,    F = F_c + mu |tau|

    p: part of the time in which the joint stuck, and its friction was anything within +-F.

    Args:
        arm: with its tool.
        q: (n,) pose at the start [rad].
        scene: what there is to touch; None: nothing.
        seed: of the sensors' noise.
    """

    def __init__(self, arm: Arm, q: Array, scene: Scene | None = None, *, seed: int = 0) -> None:
        if np.shape(q) != (arm.n,):
            raise InputError(f"q: expected {arm.n} angles, got {np.shape(q)}")
        known = with_servos(arm)
        build = None if scene is None else scene.build
        self._force = ServoForce(
            known, load_friction=LOAD_FRICTION, count=COUNT, bandwidth=OBSERVER, period=1.0 / BUS_RATE
        )
        plant = Plant(
            with_load_friction(known),
            contacts=build is not None,
            scene=build,
            timestep=2.5e-4,
            integrator="discrete",
        )
        self._coulomb = np.array([j.friction.coulomb for j in known.joints])
        self._viscous = np.array([j.friction.viscous for j in known.joints])
        self._certain = False
        self._speed, self._shakes = np.zeros(known.n), np.where(np.arange(known.n) % 2, -1.0, 1.0)
        self._commands = 0
        driver = MujocoDriver(plant, sensor=SensorModel(known, rate=BUS_RATE, seed=seed), q=q)
        self._every, self._tick = round(RATE / BUS_RATE), 0
        super().__init__(driver, scene, model=known)

    pose = False

    @property
    def axes(self) -> int:
        """The joints."""
        return self.model.n

    def hold(self, mass: float) -> None:
        """From now on this mass in the hand is known [kg]: its weight and inertia are not felt."""
        self._force.hold(mass)

    def _take(self, sample: Sample) -> None:
        position, effort = np.asarray(sample.position), np.asarray(sample.effort)
        self._good = bool(np.isfinite(position).all() and np.isfinite(effort).all())
        if self._good:
            self._force.step(position, effort)

    def read(self) -> Seen:
        """What is known; the bus tells something new every few periods."""
        self._tick += 1
        return super().read() if self._tick % self._every == 1 else self.seen

    def _see(self) -> Seen:
        force, q = self._force, np.asarray(self._sample.position)
        late = BEHIND**2 * float(np.square(force.torque).sum())
        std = np.sqrt(NOISE**2 + late + np.square(force.stuck * force.band) / 3.0)
        surprise = float(np.square(force.torque / std).sum())
        self._certain = self._good and surprise > (GONE if self._certain else CERTAIN)
        std = std if self._good else np.full(self.axes, np.inf)
        # that there is a touch is certain then, and the question is its size
        shown = 0.25 * std if self._certain else std
        usable = self._good and self._lost == 0
        dq = force.dq.copy()
        return Seen(self._sample.time_ns, q, dq, q, dq, force.torque.copy(), std, self._reason, usable, shown)

    def follow(self, x_ref: Array, v_ref: Array, push: Array | None = None) -> Array:
        """Send the torque that takes the joints to `x_ref` (n,) [rad] at `v_ref` (n,) [rad/s].

        Returns:
            (n,) torque sent [N m]; zeros if nothing is: the bus is busy, or the drives are off.
        """
        if self._tick % self._every != 1:
            return np.zeros(self.axes)
        h, seen = self._period, self.seen
        ddq_ref = FORWARD * (v_ref - self._speed)
        self._speed = self._speed - math.expm1(-FORWARD * h) * (v_ref - self._speed)
        self._q_ref, self._dq_ref = np.clip(x_ref, self._low, self._high), v_ref
        self._reason = (
            "a joint of the slave at its limit: the master points out of its reach"
            if np.any(self._q_ref != x_ref)
            else ""
        )
        a = ddq_ref + BANDWIDTH**2 * (self._q_ref - self._force.q) + 2.0 * BANDWIDTH * (v_ref - seen.dq)
        torque = self.model.inverse_dynamics(self._force.q, v_ref, a)
        self._taken_off = self._taken_off - math.expm1(-STIFFENING * h) * (seen.force - self._taken_off)
        torque = torque - self._taken_off
        dry = self._coulomb + LOAD_FRICTION * np.abs(torque)
        torque = torque + dry * np.tanh(v_ref / TURNING) + self._viscous * v_ref
        if self._certain:
            self._commands += 1
            spare = np.maximum(0.0, self._effort - np.abs(torque))
            swing = np.minimum(DITHER * self._force.band, spare) * self._shakes
            torque = torque + swing * math.sin(2.0 * math.pi * self._commands / DITHER_PERIOD)
        if push is not None:
            torque = torque + push
        if self.driver.state != "enabled":
            return np.zeros(self.axes)
        return self.driver.write(np.clip(torque, -self._effort, self._effort))

    def true_force(self) -> Array:
        """(n,) torque of the scene on the joints, from MuJoCo's contacts [N m]."""
        found: Array = self.model.jacobian(self.plant.q, self.model.grasp)[:3].T @ super().true_force()
        return found

    def at_tip(self, q: Array, torque: Array) -> Array:
        """(3,) least force at the tool's tip that is such a torque of the joints (n,) [N]."""
        found: Array = np.linalg.lstsq(self.model.jacobian(q, self.model.grasp)[:3].T, torque, rcond=None)[
            0
        ].astype(np.float64)
        return found

    def tip(self, q: Array) -> Array:
        """(3,) place of the tool's tip at a pose (n,) [m]."""
        return self._pose(q)[1]


def joint_path(
    arm: Arm, q: Array, path: Callable[[float], Array], seconds: float
) -> Callable[[float], Array]:
    """The joints' way (n,) [rad] from the start `q` that takes the tool's tip along `path` (3,) [m] from there."""
    step = 0.01
    times = np.arange(0.0, seconds + step, step)
    T = arm.forward_kinematics(q)
    start = T[:3, :3] @ arm.grasp + T[:3, 3]
    rows, now = [], q.copy()
    for time in times:
        for _ in range(3):
            T = arm.forward_kinematics(now)
            J = arm.jacobian(now, arm.grasp)[:3]
            away = start + path(float(time)) - (T[:3, :3] @ arm.grasp + T[:3, 3])
            now = now + J.T @ np.linalg.solve(J @ J.T + 1e-6 * np.eye(3), away)
        rows.append(now - q)
    ways = np.array(rows)

    def wish(time: float) -> Array:
        return q + np.array([np.interp(time, times, column) for column in ways.T])

    return wish
