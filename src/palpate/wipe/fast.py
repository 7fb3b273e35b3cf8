"""The fast activities: robot, estimation and control. No locks: each value has one writer and one reader."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from .._core import MomentumObserver, Status, WrenchEstimator
from ..arm import Arm, Array, Effort, Sensing
from ..control import CartesianTarget, CartesianVelocity, SafetyLimiter, Setpoint
from ..logs import Sample
from ..pipeline import Pipeline
from ..velocity import JointVelocity
from .activity import Activity, Slot
from .motion import BRAKING, Path, joint_torque
from .reach import tool_poses
from .scene import BoardScene
from .strokes import Leg, Motion

POSITION_STD = 2e-6
"""of a joint position that a robot tells [rad]"""
TORQUE_STD = 0.02
"""of a joint torque sensor [N m]"""
STALE = 3
"""cycles of control without a command after which the robot holds by itself"""
STIFF = (2500.0, 100.0)
"""of an arm that holds or moves, per inertia [1/s^2], [1/s]"""


def sensed(arm: Arm) -> Arm:
    """The arm as the estimators are to take it: with joint torque sensors and their noise."""
    sensing = Sensing(position_std=POSITION_STD, velocity_std=5e-4, torque_std=TORQUE_STD)
    return arm.replace(effort=Effort.torque(), joints=tuple(j.replace(sensing=sensing) for j in arm.joints))


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """What the robots tell, one arm after the other."""

    time_ns: int
    q: tuple[Array, Array]
    tau: tuple[Array, Array]
    """NaN: the channel is lost"""


@dataclass(frozen=True, slots=True, eq=False)
class Felt:
    """What is made of the readings."""

    time_ns: int
    q: tuple[Array, Array]
    dq: tuple[Array, Array]
    wrench: Array
    """(6,) of the board on the tool, base axes [N, N m]; NaN where it is not to be believed"""
    std: Array
    """(6,)"""
    believed: bool


@dataclass(frozen=True, slots=True, eq=False)
class Torques:
    """What control wants of both arms."""

    time_ns: int
    tau: tuple[Array, Array]


class Robot(Activity):
    """Reads both arms and sends them torques, every cycle, whatever the others do.

    What is sent passes the :class:`palpate.SafetyLimiter`. Without a fresh command each arm floats and brakes.
    """

    def __init__(
        self, scene: BoardScene, period_ns: int, command: Slot[Torques], patience_ns: int, seed: int
    ) -> None:
        super().__init__("robot", period_ns)
        self.scene = scene
        self.readings: deque[Reading] = deque(maxlen=64)
        """for estimation; append and popleft are one step each"""
        self.command = command
        self.patience_ns = patience_ns
        self.grip: Slot[bool] = Slot()
        """the gripper is to close or to open"""
        self.sent: tuple[Array, Array] = tuple(np.zeros(a.n) for a in scene.arms)  # type: ignore[assignment]
        self.orphaned = False
        """there is no fresh command"""
        self._limiters = tuple(SafetyLimiter(a, damping=_braking(a, period_ns * 1e-9)) for a in scene.arms)
        self._rng = np.random.default_rng(seed)
        self.reading: Reading | None = None
        self._before: Reading | None = None

    def configure(self) -> None:
        """The first reading, and torques that hold both arms."""
        (q0, _), (q1, _) = self.scene.state
        self.sent = self.scene.arms[0].gravity_torque(q0), self.scene.arms[1].gravity_torque(q1)
        for limiter, tau in zip(self._limiters, self.sent, strict=True):
            limiter.reset(tau)
        self.reading = None
        self.read()

    def step(self, time_ns: int) -> None:
        """Send."""
        wanted = self.command.newest
        self.orphaned = wanted is None or time_ns - wanted.time_ns > self.patience_ns
        tau = []
        reading, before = self.reading, self._before
        assert reading is not None and before is not None
        for k, arm in enumerate(self.scene.arms):
            q = reading.q[k]
            dq = (q - before.q[k]) / (self.period_ns * 1e-9)
            if wanted is None or self.orphaned:
                ask = arm.gravity_torque(q) - arm.mass_matrix(q) @ (10.0 * dq)
            else:
                ask = wanted.tau[k]
            tau.append(self._limiters[k].step(ask, q, dq, self.period_ns * 1e-9)[0])
        self.sent = tau[0], tau[1]
        grip = self.grip.take()
        if grip is True:
            self.scene.close_grip()
        elif grip is False:
            self.scene.open_grip()

    @property
    def held(self) -> bool:
        """The gripper's fingers feel something between them."""
        return self.scene.held

    def read(self) -> None:
        """Read, after the world went on for a period."""
        rng, (a, b) = self._rng, self.scene.state
        n = len(a[0])
        noise = rng.standard_normal((2, 2, n))
        tau = [s + TORQUE_STD * e for s, e in zip(self.sent, noise[1], strict=True)]
        if self.scene.torque_lost:
            tau[0] = np.full(n, math.nan)
        self._before = self.reading
        self.reading = Reading(
            self.scene.time_ns,
            (a[0] + POSITION_STD * noise[0, 0], b[0] + POSITION_STD * noise[0, 1]),
            (tau[0], tau[1]),
        )
        self._before = self._before or self.reading
        self.readings.append(self.reading)


def _braking(arm: Arm, h: float) -> Array:
    """(n,) damping of the limiter [N m s/rad] that does not rattle at steps of `h` [s], however light the joint."""
    limits = [j.limits for j in arm.joints]
    usual = np.array([x.effort / x.velocity for x in limits])
    poses = np.random.default_rng(0).uniform(-2.0, 2.0, (100, arm.n))
    inertia = np.diagonal(arm.mass_matrix(poses), axis1=1, axis2=2).min(0)
    return np.minimum(usual, 0.7 * inertia / h)


class Estimation(Activity):
    """Joint velocities of both arms, and the wrench on the eraser from the joint torques."""

    def __init__(self, arms: tuple[Arm, Arm], period_ns: int, readings: Robot) -> None:
        super().__init__("estimation", period_ns)
        self._robot = readings
        self.felt: Slot[Felt] = Slot()
        # both clocks are the same here: nothing to recover
        self._velocity = tuple(JointVelocity(a.n, clock="reader") for a in arms)
        self._pipeline = Pipeline(
            sensed(arms[0]),
            observer=MomentumObserver(bandwidth=60.0),
            payload=None,
            wrench=WrenchEstimator(),
        )

    def configure(self) -> None:
        """Forget everything, and take the first reading."""
        self._pipeline.reset()
        for v in self._velocity:
            v.reset()
        self.step(0)

    def step(self, time_ns: int) -> None:
        """Take all readings since the last cycle."""
        readings = self._robot.readings
        while readings:
            r = readings.popleft()
            dq = tuple(v.step(r.time_ns, q)[0] for v, q in zip(self._velocity, r.q, strict=True))
            if not np.isfinite(r.tau[0]).all():
                nan = np.full(6, math.nan)
                self._pipeline.reset()  # what it knew is too old when the channel comes back
                self.felt.put(Felt(r.time_ns, r.q, (dq[0], dq[1]), nan, nan, False))
                continue
            touch = self._pipeline.step(Sample(r.time_ns, r.q[0], dq[0], r.tau[0]))
            w = touch.wrench
            assert w is not None
            good = w.status in (Status.ok, Status.singular)
            wrench = np.concatenate((w.force, w.moment)) if good else np.full(6, math.nan)
            std = np.concatenate((w.force_std, w.moment_std)) if good else np.full(6, math.nan)
            self.felt.put(Felt(r.time_ns, r.q, (dq[0], dq[1]), wrench, std, good))


# --- control ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class Effect:
    """What a law wants now, and how far it is."""

    tau: Array
    done: bool = False
    fault: str = ""
    """it cannot go on"""
    commanded: Array | None = None
    """(6,) force and moment at the tool [N, N m]"""
    wanted_force: float = 0.0
    phase: str = ""
    stroke: int = -1
    yielding: bool = False


class Law(Protocol):
    """Moves one arm. `rate` is how fast its time runs: 1, or less down to 0 while it is brought to rest."""

    def step(self, felt: Felt, h: float, rate: float) -> Effect:
        """One cycle of `h` [s]."""


class Hold:
    """Stays where it is found."""

    def __init__(self, arm: Arm, which: int) -> None:
        self._arm, self._which = arm, which
        self._at: Array | None = None

    def step(self, felt: Felt, h: float, rate: float) -> Effect:
        """One cycle."""
        q, dq = felt.q[self._which], felt.dq[self._which]
        if self._at is None:
            self._at = q + dq / STIFF[1]  # where a brake of that damping ends
        still = Setpoint(self._at, np.zeros_like(q), np.zeros_like(q))
        return Effect(_joint(self._arm, still, q, dq), done=True)


class Follow:
    """Goes along a path of the joints."""

    def __init__(self, arm: Arm, which: int, path: Path) -> None:
        self._arm, self._which, self._path = arm, which, path
        self._t = 0.0

    def step(self, felt: Felt, h: float, rate: float) -> Effect:
        """One cycle."""
        self._t += rate * h
        q, dq = felt.q[self._which], felt.dq[self._which]
        wanted = self._path.sample(self._t, rate)
        done = self._t >= self._path.duration + 0.2
        return Effect(_joint(self._arm, wanted, q, dq), done=done)


def _joint(arm: Arm, wanted: Setpoint, q: Array, dq: Array) -> Array:
    return joint_torque(arm, wanted, q, dq, stiffness=STIFF[0], damping=STIFF[1])


@dataclass(frozen=True, slots=True, eq=False)
class Work:
    """Legs to be gone through over a board, and where the board is."""

    legs: tuple[Leg, ...]
    strokes: tuple[int, ...]
    """number of the stroke of each leg"""
    T_base_board: Array
    angle: float
    """of the tool's x axis in the board's plane [rad]"""
    size: tuple[float, float]
    motion: Motion


class Wipe:
    """Goes along legs over a board, pressing with bounded force where it touches."""

    TOUCH = 4.0
    """longest time until something is felt [s]"""
    LOST = 0.4
    """longest time without contact while sliding [s]"""
    AWAY = 0.12
    """pushed further away, it comes back by its joints [m]"""
    DEEP = 0.02
    """so far below the board's surface no eraser gets [m]"""

    def __init__(self, arm: Arm, controller: CartesianVelocity, work: Work, force: float) -> None:
        self._arm, self._controller, self._work, self._force = arm, controller, work, force
        self._legs = deque(zip(work.legs, work.strokes, strict=True))
        self._t = self._waited = self._free = 0.0
        self._disturbed = False
        self._R = work.T_base_board[:3, :3]
        self._to_board = np.linalg.inv(work.T_base_board)
        self._axes = self._R @ np.diag([1.0, -1.0, -1.0])
        self._orientation = tool_poses(np.zeros((1, 3)), work.T_base_board, work.angle)[0, :3, :3]
        self._total = sum(leg.duration for leg in work.legs)
        self.at = np.full(3, math.nan)
        """of the eraser over the board, z the height [m]"""

    @property
    def remaining(self) -> float:
        """[s] by the legs."""
        return max(0.0, sum(leg.duration for leg, _ in self._legs) - self._t)

    @property
    def total(self) -> float:
        """[s] of all legs."""
        return self._total

    def step(self, felt: Felt, h: float, rate: float) -> Effect:
        """One cycle."""
        q, dq = felt.q[0], felt.dq[0]
        T = self._arm.forward_kinematics(q)
        at = self._to_board[:3, :3] @ (T[:3, :3] @ self._arm.grasp + T[:3, 3]) + self._to_board[:3, 3]
        at[2] = -at[2]
        self.at = at
        if not self._legs:
            hold = Leg("lift", at, at, 1.0, 1.0)
            return self._drive(hold, -1, felt, q, dq, done=True)
        leg, stroke = self._legs[0]
        effect = self._drive(leg, stroke, felt, q, dq)
        if effect.fault:
            return effect
        if effect.yielding:
            self._disturbed = True
            return effect
        if self._disturbed:
            self._disturbed = False
            away = float(np.linalg.norm(at - leg.at(self._t)[0]))
            if away > self.AWAY:
                return replace(effect, fault=f"the arm was pushed away by {1e2 * away:.0f} cm")
            self._rejoin(at)
            return effect
        normal = float(felt.wrench[:3] @ self._axes[:, 2])
        fault = self._progress(leg, at, normal, h, rate)
        return replace(effect, done=not self._legs, fault=fault)

    def _drive(self, leg: Leg, stroke: int, felt: Felt, q: Array, dq: Array, *, done: bool = False) -> Effect:
        x, v = leg.at(self._t)
        press = leg.phase in ("touch", "slide")
        point = self._work.T_base_board[:3, 3] + self._R @ (x * [1.0, 1.0, -1.0])
        target = CartesianTarget(
            point,
            self._orientation,
            0.1,
            self._R @ (self._rate * v * [1.0, 1.0, -1.0]),
            self._axes,
            self._force if press else 0.0,
        )
        c = self._controller.step(target, q, dq, force=felt.wrench[:3] if felt.believed else None)
        return Effect(
            c.torque,
            done,
            ""
            if felt.believed or not press
            else "the torque channel is lost: nothing tells how hard it presses",
            np.concatenate((c.force, c.moment)),
            self._force if press else 0.0,
            "" if done else leg.phase,
            stroke,
            c.yielding,
        )

    _rate = 1.0

    def _progress(self, leg: Leg, at: Array, normal: float, h: float, rate: float) -> str:
        """Time goes on along the leg; a sentence if it cannot."""
        self._rate = rate
        felt = normal > 0.4 * self._force
        if leg.phase == "touch":
            self._t = min(self._t + rate * h, leg.duration)
            settled = self._t >= leg.duration and abs(normal - self._force) < 0.2 * self._force
            self._waited = self._waited + h if self._t >= leg.duration else 0.0
            if not settled:
                deep = at[2] < -self.DEEP and not felt
                if deep or self._waited > self.TOUCH:
                    return "no contact where the board should be"
                return ""
            self._free = 0.0
        elif leg.phase == "slide":
            self._free = 0.0 if felt else self._free + h
            if self._free > self.LOST or (at[2] < -self.DEEP and not felt):
                return "the contact is lost"
            if not felt:
                return ""  # time waits for the contact
        self._t += rate * h
        if self._t >= leg.duration:
            self._legs.popleft()
            self._t = self._waited = 0.0
        return ""

    def resume(self) -> None:
        """Go on after the arm was held by another law."""
        self._controller.reset()
        self._disturbed = True

    def _rejoin(self, at: Array) -> None:
        """After a push: from where the tool is now to where the stroke was left, and on."""
        leg, stroke = self._legs.popleft()
        goal, _ = leg.at(self._t)
        m = self._work.motion
        rest = Leg(leg.phase, goal, leg.end, leg.speed, leg.acceleration)
        legs: list[Leg]
        if leg.phase in ("approach", "lift"):
            legs = [Leg(leg.phase, at, leg.end, leg.speed, leg.acceleration)]
        else:
            W, H = self._work.size
            astray = at[2] > 0.006 or not (0.0 < at[0] < W and 0.0 < at[1] < H)
            flat, air = np.array([goal[0], goal[1], 0.0]), np.array([goal[0], goal[1], max(m.lift, at[2])])
            if astray or leg.phase == "touch":
                over = np.array([at[0], at[1], air[2]])
                legs = [
                    Leg("lift", at, over, m.approach, m.acceleration),
                    Leg("approach", over, air, m.travel, m.acceleration),
                    Leg("touch", air, flat, m.approach, m.acceleration),
                ]
            else:
                legs = [Leg("slide", np.array([at[0], at[1], 0.0]), flat, m.speed, m.acceleration)]
            if leg.phase == "slide":
                legs.append(rest)
        self._t = self._waited = self._free = 0.0
        self._legs.extendleft((x, stroke) for x in reversed(legs))


@dataclass(frozen=True, slots=True, eq=False)
class Report:
    """What control did in its last cycle."""

    time_ns: int
    effects: tuple[Effect, Effect]
    laws: tuple[Law, Law]


class Control(Activity):
    """Runs one law for each arm; holds both at once when a law cannot go on."""

    def __init__(
        self,
        arms: tuple[Arm, Arm],
        period_ns: int,
        felt: Slot[Felt],
        command: Slot[Torques],
        fault: Callable[[str], None],
    ) -> None:
        super().__init__("control", period_ns)
        self._arms, self._felt, self._command, self._fault = arms, felt, command, fault
        self.orders: tuple[Slot[Law], Slot[Law]] = (Slot(), Slot())
        """a law for each arm"""
        self.laws: list[Law] = [Hold(a, k) for k, a in enumerate(arms)]
        self.report: Slot[Report] = Slot()
        self._rate = 0.0

    def step(self, time_ns: int) -> None:
        """One step of both laws."""
        felt = self._felt.newest
        if felt is None:
            return
        h = self.period_ns * 1e-9
        for k, order in enumerate(self.orders):
            law = order.take()
            if law is not None:
                self.laws[k] = law
        # time is slowed down and sped up, so that nobody jerks
        change = h / BRAKING
        self._rate = (
            min(1.0, self._rate + change) if self.state == "running" else max(0.0, self._rate - change)
        )
        effects = [law.step(felt, h, self._rate) for law in self.laws]
        for k, effect in enumerate(effects):
            if effect.fault:
                self.laws[k] = Hold(self._arms[k], k)
                held = self.laws[k].step(felt, h, self._rate)
                effects[k] = Effect(held.tau, fault=effect.fault)
                self._fault(effect.fault)
        self._command.put(Torques(time_ns, (effects[0].tau, effects[1].tau)))
        self.report.put(Report(time_ns, (effects[0], effects[1]), (self.laws[0], self.laws[1])))
