"""Ready-made teleoperators: a haptic device, an arm in a scene, both sides with figures that suit them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from .._core import LinkOptions, TankOptions
from ..arm import Array
from .channel import Faults
from .coupling import CouplingName, MasterSide, SlaveSide
from .masters import Device, Hand, HapticDevice
from .scenes import Scene, find, slave_arm
from .session import Cut, Progress, Run, run
from .slaves import STIFFEST, SimulatedSlave

TANK = {"initial": 0.05, "desired": 0.1, "most": 0.5}
"""of both sides [J]: what a hand gives that presses 5 N over 2 cm; without an initial charge the first touch finds
nothing to pay with"""
CONTACT_DAMPING = 30.0
"""of the device in contact [N s/m]: it makes up for the estimate's 6 ms and the line's 1 ms"""
THRESHOLD = 5.0
"""of what is felt, in standard deviations [1]: at 1 kHz three are passed every third of a second"""
ACCELERATION = 10.0
"""of the slave's reference at most [m/s^2]: twice what a hand does, and what the arm's joints can follow"""
REACH = 0.3
"""of the workspace to each side of the start [m]"""


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
    device: HapticDevice
    slave: SimulatedSlave
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
    masses: tuple[float, ...] = (0.5, 1.2),
    motion_scale: float = 1.0,
    force_scale: float | None = None,
    hand: Hand | None = None,
    passive: bool = True,
    stiffest: float = STIFFEST,
    seed: int = 0,
) -> Setup:
    """A haptic device and an arm in a scene.

    Args:
        scene: wall, rigid, surface, peg, lift, or None for free motion.
        arm: the slave, see :func:`palpate.teleop.scenes.slave_arm`.
        coupling: "force_position", "position_position" or "four_channel".
        stiffness: of the wall [N/m].
        press: how far behind the wall or the surface the hand goes [m].
        masses: of the objects to lift [kg].
        motion_scale: motion of the slave per motion of the master [1].
        force_scale: force felt per force of the environment [1]; None: what suits device and arm.
        hand: who holds the device; None: the scene's script.
        passive: the passivity layer.
        stiffest: beyond this stiffness of what it touches the slave gives way [N/m]; infinite: it never does.
        seed: of the sensors' noise.

    Raises:
        InputError: a name or a number is wrong.
        MissingExtraError: mujoco or cryptography is not installed.
    """
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
    device = HapticDevice(hand or scripted(place, motion_scale))
    return Setup(
        scene=place,
        device=device,
        slave=slave,
        master=build_master(device, shared),
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
    path = None if scene is None else scene.path
    return Hand() if path is None else Hand(wish=lambda t: np.asarray(path(t)) / motion_scale)


def build_master(device: Device, shared: Shared) -> MasterSide:
    """What the hand feels that holds a device."""
    return MasterSide(3, device.force_limit, contact_damping=CONTACT_DAMPING, **shared.options())


def build_slave(
    scene: str | None,
    *,
    arm: str = "kuka_lbr_iiwa14",
    shared: Shared,
    stiffness: float = 2000.0,
    press: float = 0.02,
    masses: tuple[float, ...] = (0.5, 1.2),
    motion_scale: float = 1.0,
    force_scale: float | None = None,
    stiffest: float = STIFFEST,
    seed: int = 0,
) -> tuple[SimulatedSlave, SlaveSide, Scene | None, tuple[str, ...]]:
    """An arm in a scene, where it goes, the scene, and what is assumed of it; options of :func:`build`.

    Raises:
        InputError: a name or a number is wrong.
        MissingExtraError: mujoco is not installed.
    """
    chosen = slave_arm(arm)
    T = chosen.arm.forward_kinematics(chosen.q)
    tip: Array = T[:3, :3] @ chosen.arm.grasp + T[:3, 3]
    place = None if scene is None else find(scene, tip, stiffness=stiffness, press=press, masses=masses)
    slave = SimulatedSlave(chosen.arm, chosen.q, place, seed=seed, stiffest=stiffest)
    side = SlaveSide(
        3,
        0.5,
        lower=tip - REACH,
        upper=tip + REACH,
        force_limit=100.0,
        acceleration=ACCELERATION,
        threshold=THRESHOLD,
        motion_scale=motion_scale,
        force_scale=chosen.force_scale if force_scale is None else force_scale,
        **shared.options(),
    )
    return slave, side, place, chosen.assumed
