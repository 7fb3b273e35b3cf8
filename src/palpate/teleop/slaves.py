"""Slaves: an arm behind the driver contract that follows a reference and tells what touches it, without a force
sensor."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from .._core import HeldLoad, MomentumObserver, Status, WrenchEstimator, rotation_vector, turn_between
from ..arm import Arm, Array
from ..drivers.mujoco import MujocoDriver
from ..errors import DriverError, InputError
from ..logs import Sample
from ..pipeline import Pipeline, Touch
from ..simulate import Load, Plant, SensorModel
from .coupling import LEVER, felt_force
from .pose import pose_minus, pose_of

if TYPE_CHECKING:
    from .scenes import Scene

RATE = 1000.0
"""control steps per second [Hz]"""
BANDWIDTH = 80.0
"""of the position control [rad/s]"""
OBSERVER = 180.0
"""bandwidth of the momentum observer [rad/s]: what touches is known 6 ms later"""
_SINGULAR = 0.08
"""least singular value of the tip's Jacobian [m, 1] below which the arm slows down"""
CLOSING = 100.0
"""with which the joints' reference closes on the tip's [1/s]"""
_CATCHING_UP = (0.3, 1.5)
"""no faster than so: near a singular pose it would run to and fro [m/s, rad/s]"""
STIFFENING = 40.0
"""bandwidth with which the external torque is taken off [rad/s]: well below the observer's, which is half a period
late"""
STIFFEST = 8000.0
"""what the coupling may meet [N/m]: beyond it the arm gives way; turned, what is alike at a :data:`LEVER` [N m/rad]"""
_TOUCHING = 5.0
"""standard deviations of the force that are a touch [1]"""
_CERTAIN = 3.0
"""standard deviations of a joint's external torque from which on it is taken off [1]"""
_CHANGES, _STEERING = 60.0, 100.0
"""bandwidths above which changes tell a stiffness, and of what follows from it [rad/s]"""
_LATELY, _FORGET = 0.05, 0.5
"""time constant of the mean squares, and how long after a touch they are forgotten [s]"""
_CHANGING = 1.0
"""a force that changes by less says nothing of the stiffness [N]; a torque at a :data:`LEVER` [N m]"""
_JERKY = 20.0
"""acceleration of a joint's reference at most [rad/s^2]"""
_PARTS = (slice(0, 3), slice(3, 6))
"""axes of the place, and of the turn"""
_SETTLE = 0.4
"""at the start, over which what is felt at rest is taken for the model's error [s]"""


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """What is known of a slave after a sample, in the axes that are coupled: those of a pose, or the joints.

    Attributes:
        time_ns: of the sample.
        q, dq: (n,) [rad, rad/s].
        x, v: (6,) pose of the tool's tip, base axes [m, rad], and its velocity [m/s, rad/s].
        force, std: (6,) force and moment about the tip of the environment on the tool as estimated, base axes [N, N m].
        reason: why it holds or slows down, empty: it does not.
        usable: it may be moved.
        felt_std: (6,) deviation that decides what a hand is shown [N, N m]; None: `std`.
        beyond: (6,) from where the arm can be to its reference, while a singular pose, a joint's limit or its largest
            speed holds it back [m, rad]; None: nothing does.
    """

    time_ns: int
    q: Array
    dq: Array
    x: Array
    v: Array
    force: Array
    std: Array
    reason: str
    usable: bool
    felt_std: Array | None = None
    beyond: Array | None = None


class Stiffness:
    """How stiff what the tool touches is, and how much of its force may be taken off; or what it is turned against, and
    how much of its torque.

    Taking the touch's force off makes the arm infinitely stiff, so that it goes where it is told through whatever
    yields. Against what does not yield, it and the touch push each other to and fro with the lag of the estimate.
    What is met is told by how far the place gives when the force changes, both through the same lag (least squares
    with forgetting, the force being what is given; sliding has nothing to do with it and averages out)::

        1/K = -LP(dx . dF) / LP(dF . dF),    share = clip(K_s / K, 0, 1)

    dx, dF high-passed. Up to K_s, the stiffest, nothing changes; beyond it the arm gives way like a spring, and the
    coupling never meets more. While the force changes by less than its noise the last value holds; half a second
    after the touch it is forgotten.

    Args:
        stiffest: K_s [N/m, N m/rad].
        changing: a force that changes by less says nothing [N, N m].
    """

    def __init__(self, stiffest: float, changing: float) -> None:
        self.stiffest = stiffest
        """[N/m, N m/rad]"""
        self._changing = changing
        self._x: Array | None = None
        self._slow_x = self._slow_F = np.zeros(3)
        self._together = self._changes = 0.0
        self._free = 0.0
        self.share = 1.0
        """part of the force that may be taken off [1]"""

    def step(self, x: Array, F: Array, std: Array, h: float) -> None:
        """A period of `h` [s] later: place or turn (3,), force or torque and its standard deviation (3,)."""
        self._x = x if self._x is None else self._x - math.expm1(-OBSERVER * h) * (x - self._x)
        felt = bool(np.linalg.norm(F) > _TOUCHING * np.linalg.norm(std))
        self._free = 0.0 if felt else self._free + h
        if not felt:
            self._slow_x, self._slow_F = self._x, F
            if self._free > _FORGET:
                self._together = self._changes = 0.0
                self.share = min(1.0, self.share + h / _FORGET)
            return
        mix = -math.expm1(-_CHANGES * h)
        dx, dF = self._x - self._slow_x, F - self._slow_F
        self._slow_x = self._slow_x + mix * dx
        self._slow_F = self._slow_F + mix * dF
        lately = -math.expm1(-h / _LATELY)
        self._together += lately * (-float(dx @ dF) - self._together)
        self._changes += lately * (float(dF @ dF) - self._changes)
        if self._changes > self._changing**2:
            share = min(1.0, max(0.0, self.stiffest * self._together / self._changes))
            self.share -= math.expm1(-_STEERING * h) * (share - self.share)


class ArmSlave:
    """Follows a reference of its tool's tip, place and orientation, and estimates what touches it.

    Resolved rates with damping near singular poses give joint references; each joint follows by computed torque,
    and the estimated external
    torque is taken off (a disturbance observer), so that what touches the tool does not push it away from its
    reference::

        u = M(q) (q_r'' + w^2 (q_r - q) + 2 w (q_r' - q')) + C q' + g + tau_f - tau_ext

    The force told is that of the pipeline: weight and inertia of what is held are taken away, and so is what is
    felt at rest before the start.

    Args:
        driver: the arm; connected and enabled here.
        model: the arm as it is known; None: the driver's plant is known exactly.
        held: mass in the hand that is known [kg]; NaN: none is.
        stiffest: beyond this stiffness of what it touches the arm gives way [N/m]; infinite: it never does.

    Raises:
        InputError: `stiffest` is not positive.
    """

    def __init__(
        self,
        driver: MujocoDriver,
        *,
        model: Arm | None = None,
        held: float = 0.0,
        stiffest: float = STIFFEST,
    ) -> None:
        if not stiffest > 0.0:
            raise InputError(f"stiffest must be > 0 N/m, got {stiffest!r}")
        self.driver = driver
        self.model = driver.plant.arm if model is None else model
        arm = self.model
        self._period = driver.period_ns * 1e-9
        low = np.array([j.limits.lower for j in arm.joints])
        high = np.array([j.limits.upper for j in arm.joints])
        self._low, self._high = low + 0.02, high - 0.02
        self._fastest = np.array([j.limits.velocity for j in arm.joints])
        self._effort = np.array([j.limits.effort for j in arm.joints])
        self._tare: Array | None = None
        self._rest: list[Array] = []
        self._steps = 0
        self._lost = 0
        self.driver.connect()
        self.driver.enable()
        sample = self.driver.read()
        assert sample is not None
        self._sample = sample
        self.hold(held)
        self._take(sample)
        self._q_ref = np.array(sample.position)
        self._home = self._q_ref.copy()
        self._dq_ref = np.zeros(arm.n)
        self._taken_off = np.zeros(arm.n)
        self._stiffness = (
            Stiffness(stiffest, _CHANGING),
            Stiffness(stiffest * LEVER**2, _CHANGING * LEVER),
        )
        self._R0 = rotation_vector(self._pose(self._q_ref)[0].ravel())
        self._reason = ""
        self._beyond: Array | None = None
        self.seen = self._see()

    def hold(self, mass: float) -> None:
        """From now on this mass in the hand is known [kg]: its weight and inertia are not felt. The estimate
        starts anew."""
        self._pipeline = Pipeline(
            self.model,
            observer=MomentumObserver(bandwidth=OBSERVER),
            payload=None,
            wrench=WrenchEstimator(moment_prior_std=3.0),
            load=HeldLoad(mass=mass),
        )

    def _take(self, sample: Sample) -> None:
        """Estimate what touches."""
        self._touch = self._pipeline.step(sample)

    def _pose(self, q: Array) -> tuple[Array, Array, Array]:
        """R_base_tip, place of the tool's tip, (6, n) Jacobian there."""
        T = self.model.forward_kinematics(q)
        J = self.model.jacobian(q, self.model.grasp)
        tip = T[:3, :3] @ self.model.grasp + T[:3, 3]
        return T[:3, :3], tip, J

    @property
    def x(self) -> Array:
        """(3,) of the tool's tip [m]."""
        return self._pose(self.seen.q)[1]

    def _see(self) -> Seen:
        touch, q = self._touch, np.asarray(self._sample.position)
        dq = np.asarray(touch.dq)
        R, tip, J = self._pose(q)
        wrench = touch.wrench
        assert wrench is not None
        force = np.concatenate((wrench.force, wrench.moment))
        good = wrench.status in (Status.ok, Status.saturated, Status.singular) and bool(
            np.isfinite(force).all()
        )
        std = np.concatenate((wrench.force_std, wrench.moment_std)) if good else np.full(6, np.inf)
        force = force if good else np.zeros(6)
        if self._tare is None:
            if good:
                self._rest.append(force)
            if self._steps >= _SETTLE * RATE and self._rest:
                self._tare = np.mean(self._rest[len(self._rest) // 2 :], axis=0)
            force = np.zeros(6)
        else:
            force = force - self._tare if good else force
        usable = self._tare is not None and self._lost == 0
        return Seen(
            self._sample.time_ns,
            q,
            dq,
            pose_of(R, tip),
            J @ dq,
            force,
            std,
            self._reason,
            usable,
            beyond=self._beyond,
        )

    def read(self) -> Seen:
        """The next period's sample. A lost one holds the last; a device that is gone stops the arm, and says so.

        Never raises for a device that is gone: the state is held and ``reason`` tells.
        """
        self._steps += 1
        try:
            sample = self.driver.read()
        except DriverError as error:
            self._lost += 1
            self._reason = f"device: {error}"
            self.seen = self._see()
            return self.seen
        self._lost = 0 if sample is not None else self._lost + 1
        if sample is not None:
            self._sample = sample
            self._take(sample)
        else:
            self._reason = "device: a sample was lost"
        self.seen = self._see()
        return self.seen

    def follow(self, x_ref: Array, v_ref: Array, push: Array | None = None) -> Array:
        """Send the torque that takes the tool's tip to the pose `x_ref` (6,) [m, rad] at `v_ref` (6,) [m/s, rad/s];
        `push` (6,) [N, N m] beside it.

        Returns:
            (n,) torque sent [N m]; zeros if the drives are off.
        """
        J, ddq_ref = self._lead(x_ref, v_ref)
        pushed = np.zeros(self.model.n) if push is None else J.T @ push
        torque = self._torque(J, ddq_ref, pushed)
        if self.driver.state != "enabled":
            return np.zeros(self.model.n)
        return self.driver.write(np.clip(torque, -self._effort, self._effort))

    def _lead(self, x_ref: Array, v_ref: Array) -> tuple[Array, Array]:
        """Move the joints' reference by a period towards the tip's; (6, n) Jacobian and the reference's
        acceleration (n,) [rad/s^2]."""
        n, h = self.model.n, self._period
        R, tip, J = self._pose(self._q_ref)
        # both references are of the end of this period: what is compared is where they were at its beginning
        away = pose_minus(x_ref, pose_of(R, tip)) - h * v_ref
        closing = CLOSING * away
        for axes, fastest in zip(_PARTS, _CATCHING_UP, strict=True):
            closing[axes] *= min(1.0, fastest / max(fastest, float(np.linalg.norm(closing[axes]))))
        U, s, Vt = np.linalg.svd(J, full_matrices=True)
        singular = s[-1] < _SINGULAR
        damp = 0.02 * (1.0 - (s[-1] / _SINGULAR) ** 2) if singular else 0.0
        self._reason = "slave near a singular pose: it gives up what it cannot follow" if singular else ""
        rates = Vt[: len(s)].T @ (s / (s * s + damp) * (U.T @ (v_ref + closing)))
        if n > 6:
            spare = Vt[6:]
            rates = rates + spare.T @ (spare @ (1.0 * (self._home - self._q_ref)))
        over = float(np.max(np.abs(rates) / self._fastest))
        if over > 1.0:
            rates, self._reason = rates / over, self._reason or "a joint of the slave at its largest speed"
        wanted = self._q_ref + h * rates
        inside = np.clip(wanted, self._low, self._high)
        if np.any(inside != wanted):
            self._reason = "a joint of the slave at its limit: the master points out of its reach"
        self._beyond = away if self._reason else None
        # a reference that jerks would be taken for a touch: torque and differentiated velocity are half a period apart
        ddq_ref = np.clip(((inside - self._q_ref) / h - self._dq_ref) / h, -_JERKY, _JERKY)
        rates = self._dq_ref + h * ddq_ref
        self._q_ref, self._dq_ref = np.clip(self._q_ref + h * rates, self._low, self._high), rates
        return J, ddq_ref

    def _torque(self, J: Array, ddq_ref: Array, pushed: Array) -> Array:
        """(n,) that takes the joints along their reference, and `pushed` (n,) beside it [N m]."""
        seen, external, h = self.seen, self._touch.external, self._period
        turn = turn_between(seen.x[3:], self._R0)
        for part, x, axes in zip(self._stiffness, (seen.x[:3], turn), _PARTS, strict=True):
            part.step(x, seen.force[axes], seen.std[axes], h)
        # the reference is of the end of this period, the sample of its beginning
        behind = self._q_ref - h * self._dq_ref - seen.q
        if external.status == Status.ok:
            # what the hand's push already bears is not taken off a second time; noise would turn a light wrist about
            certain = felt_force(np.asarray(external.torque), np.asarray(external.std), _CERTAIN)
            self._taken_off = self._taken_off - math.expm1(-STIFFENING * h) * (
                certain + pushed - self._taken_off
            )
        ahead, ddq, beside = self._dq_ref, ddq_ref, pushed - self._taken_off
        share = np.repeat([part.share for part in self._stiffness], 3)
        too_stiff = np.zeros(self.model.n)
        if np.any(share < 1.0):
            # of motion and force only their share, each in its own axes of the tip
            less = np.linalg.pinv(J, rcond=1e-3) * (1.0 - share)
            ahead, ddq = ahead - less @ (J @ ahead), ddq - less @ (J @ ddq)
            beside = beside - J.T @ (less.T @ beside)
            yields: Array = np.linalg.solve(self.model.mass_matrix(seen.q), J.T).astype(np.float64)
            for part, axes in zip(self._stiffness, _PARTS, strict=True):
                if part.share < 1.0:
                    too_stiff += (1.0 - part.share) * _too_stiff(
                        J[axes], yields[:, axes], behind, part.stiffest
                    )
        a = ddq + BANDWIDTH**2 * behind + 2.0 * BANDWIDTH * (ahead - seen.dq) - too_stiff
        torque = self.model.inverse_dynamics(seen.q, seen.dq, a) + self.model.friction_torque(seen.dq)
        found: Array = torque + beside
        return found

    def touch(self) -> Touch:
        """Everything the pipeline knows after the newest sample."""
        return self._touch

    def close(self) -> None:
        """Stop the drives and let go."""
        self.driver.close()


def _too_stiff(J: Array, yields: Array, behind: Array, stiffest: float) -> Array:
    """(n,) of the joints' acceleration, what the tip's stiffness above `stiffest` has in it [rad/s^2].

    The tip's stiffness is that of the position control, its effective mass (O. Khatib, IEEE J. RA 3(1), 1987)
    times the bandwidth squared; along its own axes it is cut. J (3, n) of place or turn, yields (n, 3) M^-1 J^T.
    """
    mobility, axes = np.linalg.eigh(J @ yields)
    stiffness = BANDWIDTH**2 / np.maximum(mobility, 1e-9)
    force = axes @ (np.maximum(0.0, stiffness - stiffest) * (axes.T @ (J @ behind)))
    surplus: Array = yields @ force
    return surplus


class InScene(ArmSlave):
    """An :class:`ArmSlave` whose driver is MuJoCo's, in a scene, with the truth beside it.

    Args:
        driver: in its scene.
        scene: what there is to touch; None: nothing.
        model: as it is known; None: exactly.
        stiffest: see :class:`ArmSlave`.
    """

    def __init__(
        self,
        driver: MujocoDriver,
        scene: Scene | None,
        *,
        model: Arm | None = None,
        stiffest: float = STIFFEST,
    ) -> None:
        super().__init__(driver, model=model, stiffest=stiffest)
        self._masses = list(() if scene is None else scene.masses)
        self._contact = np.zeros(6)

    pose = True
    """what is coupled are the axes of a pose; False: the joints"""

    @property
    def axes(self) -> int:
        """What is coupled: six of a pose, or the joints."""
        return 6

    @property
    def plant(self) -> Plant:
        """The truth."""
        return self.driver.plant

    def advance(self, time: float) -> float | None:
        """Take and put down what the scene says happens by a time [s]; the mass now held [kg] if it changed."""
        changed = None
        while self._masses and self._masses[0][0] <= time:
            _, mass = self._masses.pop(0)
            if mass > 0.0:
                self.plant.attach(Load(mass))
            else:
                self.plant.release()
            changed = mass
        return changed

    def true_wrench(self) -> Array:
        """(6,) force of the scene on the arm [N] and its moment about the tool's tip [N m], base axes, from MuJoCo's
        contacts."""
        from ..simulate._model import mujoco

        plant = self.plant
        mj, model, data = mujoco(), plant.model, plant.data
        total = np.zeros(6)
        tip = self._pose(plant.q)[1] if data.ncon else total[:3]
        for k in range(data.ncon):
            contact = data.contact[k]
            mj.mj_contactForce(model, data, k, self._contact)
            axes = contact.frame.reshape(3, 3).T
            force, twist = axes @ self._contact[:3], axes @ self._contact[3:]
            # along the normal from the first geom to the second: on the second
            sign = 1.0 if _of_arm(model, contact.geom2) else -1.0
            total[:3] += sign * force
            total[3:] += sign * (np.cross(contact.pos - tip, force) + twist)
        return total

    def true_force(self) -> Array:
        """(3,) of the scene on the arm, base axes, from MuJoCo's contacts [N]."""
        return self.true_wrench()[:3]


class SimulatedSlave(InScene):
    """An :class:`ArmSlave` in MuJoCo, in a scene, with the truth beside it.

    Args:
        arm: as it is, with its tool; see :func:`palpate.teleop.scenes.slave_arm`.
        q: (n,) pose at the start [rad].
        scene: what there is to touch; None: nothing.
        model: as it is known; None: exactly.
        seed: of the sensors' noise.
        stiffest: see :class:`ArmSlave`.

    Raises:
        InputError: the pose does not fit.
        MissingExtraError: mujoco is not installed.
    """

    def __init__(
        self,
        arm: Arm,
        q: Array,
        scene: Scene | None = None,
        *,
        model: Arm | None = None,
        seed: int = 0,
        stiffest: float = STIFFEST,
    ) -> None:
        if np.shape(q) != (arm.n,):
            raise InputError(f"q: expected {arm.n} angles, got {np.shape(q)}")
        build = None if scene is None else scene.build
        plant = Plant(arm, contacts=build is not None, scene=build, timestep=2.5e-4, integrator="discrete")
        driver = MujocoDriver(plant, sensor=SensorModel(arm, rate=RATE, seed=seed), q=q)
        super().__init__(driver, scene, model=model, stiffest=stiffest)


def _of_arm(model: Any, geom: int) -> bool:
    name = model.body(model.geom_bodyid[geom]).name
    return bool(name.startswith("arm:"))


def reach(arm: Arm) -> float:
    """How far the tool's tip can be from the base, at most [m]."""
    lengths = [float(np.linalg.norm(j.T_parent_joint[:3, 3])) for j in arm.joints]
    return (
        math.fsum(lengths) + float(np.linalg.norm(arm.T_last_tip[:3, 3])) + float(np.linalg.norm(arm.grasp))
    )
