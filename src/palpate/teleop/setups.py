"""Ready-made teleoperators: a haptic device, an arm in a scene, both sides with figures that suit them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from .._core import LinkOptions, TankOptions
from ..arm import Array
from ..errors import InputError
from .channel import Faults
from .coupling import CouplingName, MasterSide, SlaveSide
from .industrial import IndustrialSlave
from .masters import Device, Hand, HapticDevice
from .scenes import Scene, SlaveArm, find, slave_arm
from .servo_arms import ServoSlave, SimulatedLeader, joint_path
from .session import Cut, Progress, Run, run
from .slaves import STIFFEST, InScene, SimulatedSlave

TANK = {"initial": 0.05, "desired": 0.1, "most": 0.5}
"""of both sides [J]: what a hand gives that presses 5 N over 2 cm; without an initial charge the first touch finds
nothing to pay with"""
CONTACT_DAMPING = 30.0
"""of the device in contact [N s/m]: it makes up for the estimate's 6 ms and the line's 1 ms"""
ACCELERATION = 10.0
"""of the slave's reference at most [m/s^2]: twice what a hand does, and what the arm's joints can follow"""
JOINT_HAND: dict[str, Any] = {"mass": 0.03, "stiffness": 25.0, "damping": 1.2, "tremor": 0.01}
"""a :class:`Hand` of 0.5 kg, 400 N/m at a lever of a quarter metre [kg m^2, N m/rad, N m s/rad, N m]"""
_TURN_ASSUMED = (
    "a wrist of 2 g m^2, 3 N m/rad and 0.08 N m s/rad, a gimbal with encoders of 0.1 mrad: no source "
    "states them"
)
REACH = 0.3
"""of the workspace to each side of the start [m]"""
TORQUE_LIMIT = 0.5
"""of a device whose gimbal has motors, as the scene "turn" needs one [N m]"""
TURN_REACH = 1.2
"""largest angle from the orientation at the start [rad]"""
TURN_SPEED, TURN_ACCELERATION = 2.0, 15.0
"""of the reference's orientation at most [rad/s, rad/s^2]"""
TURN_CONTACT_DAMPING = 0.04
"""as CONTACT_DAMPING, for a torsional spring of some 5 N m/rad [N m s/rad]"""


@dataclass(frozen=True, slots=True)
class Setup:
    """A teleoperator to be run.

    Attributes:
        scene: what there is to touch; None: nothing.
        device: in its hand.
        slave: in its scene.
        master: what the hand feels.
        follower: where the slave goes.
        motion_scale: of the slave per motion of the master [1].
        seconds: how long the scene takes.
        assumed: what no source states, one sentence each.
    """

    scene: Scene | None
    device: Device
    slave: InScene
    master: MasterSide
    follower: SlaveSide
    motion_scale: float
    seconds: float
    assumed: tuple[str, ...]

    def run(
        self,
        *,
        seconds: float | None = None,
        faults: Faults | None = None,
        cuts: tuple[Cut, ...] = (),
        progress: Progress | None = None,
        seed: int = 0,
        **options: object,
    ) -> Run:
        """Run it; see :func:`palpate.teleop.session.run`."""
        weigh = self.scene is not None and self.scene.name == "lift"
        return run(
            self.device,
            self.slave,
            self.master,
            self.follower,
            self.seconds if seconds is None else seconds,
            motion_scale=self.motion_scale,
            faults=faults,
            cuts=cuts,
            weigh=weigh,
            progress=progress,
            seed=seed,
            **options,  # type: ignore[arg-type]
        )


def build(
    scene: str | None = "wall",
    *,
    arm: str = "kuka_lbr_iiwa14",
    coupling: CouplingName = "force_position",
    stiffness: float = 2000.0,
    press: float = 0.02,
    masses: tuple[float, ...] | None = None,
    motion_scale: float | None = None,
    force_scale: float | None = None,
    torque_limit: float | None = None,
    hand: Hand | None = None,
    device: Device | None = None,
    passive: bool = True,
    stiffest: float = STIFFEST,
    seed: int = 0,
) -> Setup:
    """A haptic device and an arm in a scene.

    Args:
        scene: wall, rigid, surface, peg, lift, turn, or None for free motion.
        arm: the slave, see :func:`palpate.teleop.scenes.slave_arm`.
        coupling: "force_position", "position_position" or "four_channel".
        stiffness: of the wall [N/m].
        press: how far behind the wall or the surface the hand goes [m].
        masses: of the objects to lift [kg]; None: what suits the arm.
        motion_scale: motion of the slave per motion of the master [1]; None: what suits device and arm.
        force_scale: force felt per force of the environment [1]; None: what suits device and arm.
        torque_limit: largest torque of the device [N m]; 0: its gimbal is measured and has no motors, None: it has them
            in the scene "turn" alone.
        hand: who holds the simulated device; None: the scene's script.
        device: what a person moves, in place of the simulated one.
        passive: the passivity layer.
        stiffest: beyond this stiffness of what it touches the slave gives way [N/m]; infinite: it never does.
        seed: of the sensors' noise.

    Raises:
        InputError: a name or a number is wrong.
        MissingExtraError: mujoco or cryptography is not installed.
    """
    chosen = slave_arm(arm)
    motion_scale = chosen.motion_scale if motion_scale is None else motion_scale
    if scene == "turn" and chosen.kind == "servos":
        raise InputError(
            f"turn: {arm} is led joint by joint by its twin, nothing turns a key in its place; take another arm"
        )
    shared = Shared(coupling, passive)
    slave, follower, place, assumed = build_slave(
        scene,
        arm=arm,
        shared=shared,
        stiffness=stiffness,
        press=press,
        masses=masses,
        motion_scale=motion_scale,
        force_scale=force_scale,
        stiffest=stiffest,
        seed=seed,
    )
    assumed = assumed if chosen.kind == "servos" or device is not None else (*assumed, _TURN_ASSUMED)
    if device is not None:
        if chosen.kind == "servos":
            raise InputError(f"{arm} is led joint by joint by its twin; such a device moves another arm")
        master = build_master(device, shared)
    elif chosen.kind == "servos":
        device = SimulatedLeader(chosen.arm, chosen.q, hand or scripted_joints(place, chosen), seed=seed + 1)
        motion_scale = 1.0
        master = _leading(chosen.arm.n, device, shared)
    else:
        if torque_limit is None:
            torque_limit = TORQUE_LIMIT if scene == "turn" else 0.0
        device = HapticDevice(hand or scripted(place, motion_scale), torque_limit=torque_limit)
        master = build_master(device, shared)
    return Setup(
        scene=place,
        device=device,
        slave=slave,
        master=master,
        follower=follower,
        motion_scale=motion_scale,
        seconds=10.0 if place is None else place.seconds,
        assumed=assumed,
    )


@dataclass(frozen=True, slots=True)
class Shared:
    """What both sides must have alike."""

    coupling: CouplingName = "force_position"
    passive: bool = True
    session: int | None = 1
    """of both sides' runs; None: the time"""

    def options(self) -> dict[str, Any]:
        """For :class:`MasterSide` and :class:`SlaveSide`."""
        return {
            "coupling": self.coupling,
            "passive": self.passive,
            "session": self.session,
            "tank": TankOptions(**TANK),
            "link": LinkOptions(),
        }


def scripted(scene: Scene | None, motion_scale: float = 1.0) -> Hand:
    """A hand that does what the scene asks for."""
    if scene is None:
        return Hand()
    path, turn = scene.path, scene.turn
    return Hand(wish=lambda t: np.asarray(path(t)) / motion_scale, wish_turn=turn)


def scripted_joints(scene: Scene | None, chosen: SlaveArm) -> Hand:
    """The same at the joints of a leader arm."""
    arm, q = chosen.arm, chosen.q
    wish = (lambda time: q) if scene is None else joint_path(arm, q, scene.path, scene.seconds)
    return Hand(wish=wish, **JOINT_HAND)


def build_master(device: Device, shared: Shared) -> MasterSide:
    """What the hand feels that holds a device; torques if it has motors for them (`torque_limit` [N m])."""
    force, torque = (
        np.broadcast_to(np.asarray(limit, dtype=np.float64), (3,))
        for limit in (device.force_limit, getattr(device, "torque_limit", 0.0))
    )
    return MasterSide(
        6,
        np.concatenate((force, torque)),
        pose=True,
        contact_damping=[CONTACT_DAMPING] * 3 + [TURN_CONTACT_DAMPING] * 3,
        **shared.options(),
    )


def build_slave(
    scene: str | None,
    *,
    arm: str = "kuka_lbr_iiwa14",
    shared: Shared,
    stiffness: float = 2000.0,
    press: float = 0.02,
    masses: tuple[float, ...] | None = None,
    motion_scale: float | None = None,
    force_scale: float | None = None,
    stiffest: float = STIFFEST,
    seed: int = 0,
) -> tuple[InScene, SlaveSide, Scene | None, tuple[str, ...]]:
    """An arm in a scene, where it goes, the scene, and what is assumed of it; options of :func:`build`.

    Raises:
        InputError: a name or a number is wrong.
        MissingExtraError: mujoco is not installed.
    """
    chosen = slave_arm(arm)
    T = chosen.arm.forward_kinematics(chosen.q)
    tip: Array = T[:3, :3] @ chosen.arm.grasp + T[:3, 3]
    lifted = chosen.masses if masses is None else masses
    place = (
        None
        if scene is None
        else find(scene, tip, stiffness=stiffness, press=press, masses=lifted, axes=T[:3, :3])
    )
    if chosen.kind == "servos":
        return ServoSlave(chosen.arm, chosen.q, place, seed=seed), _led(chosen, shared), place, chosen.assumed
    slave = (
        IndustrialSlave(chosen.arm, chosen.q, place, seed=seed)
        if chosen.kind == "phase_currents"
        else SimulatedSlave(chosen.arm, chosen.q, place, seed=seed, stiffest=stiffest)
    )
    side = SlaveSide(
        6,
        [chosen.speed] * 3 + [TURN_SPEED] * 3,
        pose=True,
        lower=tip - REACH,
        upper=tip + REACH,
        turn_limit=TURN_REACH,
        force_limit=chosen.force_limit,
        acceleration=[ACCELERATION] * 3 + [TURN_ACCELERATION] * 3,
        threshold=chosen.threshold,
        gain=chosen.gain,
        motion_scale=chosen.motion_scale if motion_scale is None else motion_scale,
        force_scale=chosen.force_scale if force_scale is None else force_scale,
        **shared.options(),
    )
    return slave, side, place, chosen.assumed


def _leading(n: int, device: Device, shared: Shared) -> MasterSide:
    """What a hand feels that leads a twin: [rad, N m] in place of [m, N]."""
    return MasterSide(
        n,
        device.force_limit,
        stiffness=6.0,
        damping=0.1,
        fill=0.02,
        contact_damping=0.3,
        hold_stiffness=5.0,
        hold_damping=0.1,
        acceleration=2000.0,  # encoders tell a whole count, 1.5 mrad, within a period: its work comes in one lump
        resync_rate=10.0,
        **shared.options(),
    )


def _led(chosen: SlaveArm, shared: Shared) -> SlaveSide:
    """Where the twin goes."""
    limits = [j.limits for j in chosen.arm.joints]
    return SlaveSide(
        chosen.arm.n,
        [limit.velocity for limit in limits],
        lower=[limit.lower for limit in limits],
        upper=[limit.upper for limit in limits],
        force_limit=[limit.effort for limit in limits],
        acceleration=60.0,
        threshold=chosen.threshold,
        task_space=False,
        gain=chosen.gain,
        resync="approach",
        resync_speed=0.2,
        resync_acceleration=1.0,
        wall=5.0,
        **shared.options(),
    )
