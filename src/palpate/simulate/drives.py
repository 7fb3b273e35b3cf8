"""Geared drives: friction that sticks, slides and remembers, rotors that turn with several joints, and a plant of both.

M q'' + C q' + g + B^T (I_m B q'' + f) = B^T tau_m + J^T F,        motor speeds w = B q'
dz/dt = w - |w| z / x(w),   x = x_0 g(w)/F_c,   g = F_c + (F_s - F_c) exp(-(w/v_s)^2)
f = (F_c/x_0) z + s_1 dz/dt + F_v w

C. Canudas de Wit, H. Olsson, K. Astrom, P. Lischinsky, IEEE TAC 40(3), 1995.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from ..arm import Arm, Array, Friction
from .plant import Plant

BANDWIDTH = 60.0
"""of the drives' position control [rad/s]"""


@dataclass(frozen=True, slots=True, eq=False)
class Drives:
    """The motors of an arm, all seen at the link side.

    Attributes:
        B: (n, n) motor speeds = B dq.
        inertia: (n,) of the rotors [kg m^2].
        coulomb, static, viscous, stribeck_velocity: (n,) F_c, F_s [N m], F_v [N m s/rad], v_s [rad/s].
        presliding: (n,) x_0 [rad].
        ripple: (n,) part of the Coulomb friction that varies with the motor's position [1].
        ripple_period: (n,) of that variation [rad].
    """

    B: Array
    inertia: Array
    coulomb: Array
    static: Array
    viscous: Array
    stribeck_velocity: Array
    presliding: Array
    ripple: Array
    ripple_period: Array

    @classmethod
    def stacked(cls, drives: Sequence[Drives]) -> Drives:
        """Of several arms at once, every array with a leading axis."""
        return cls(**{f.name: np.array([getattr(d, f.name) for d in drives]) for f in fields(cls)})


class LuGre:
    """Friction of motors, step by step, at rest and unloaded at first.

    Args:
        drives: the motors; several arms' at once (:meth:`Drives.stacked`) have a leading axis.
        inertia: (..., n) that each motor sees [kg m^2]: the micro-damping is 0.2 sqrt(stiffness inertia).
    """

    def __init__(self, drives: Drives, inertia: Array) -> None:
        self._drives = drives
        self._wave = 2.0 * np.pi / drives.ripple_period
        self._stiffness = drives.coulomb / drives.presliding
        self._micro = 0.2 * np.sqrt(self._stiffness * inertia)
        self._z = np.zeros_like(inertia)

    def uneven(self, position: Array) -> Array:
        """(..., n) factor of the ripple where the motors are (..., n) [rad]."""
        found: Array = 1.0 + self._drives.ripple * np.sin(self._wave * position)
        return found

    def step(self, w: Array, uneven: Array | float, dt: float) -> Array:
        """(..., n) friction torque [N m] after `dt` [s] at speeds w (..., n) [rad/s]; exact in z for a constant w."""
        d = self._drives
        g = d.coulomb + (d.static - d.coulomb) * np.exp(-np.square(w / d.stribeck_velocity))
        reach = d.presliding * g / d.coulomb
        end = np.sign(w) * reach
        moved = end + (self._z - end) * np.exp(-np.abs(w) * dt / reach)
        stuck = self._stiffness * moved + self._micro * (moved - self._z) / dt
        friction: Array = uneven * stuck + d.viscous * w
        self._z = moved
        return friction


def position_gains(drives: Drives, seen: Array) -> tuple[Array, Array, Array]:
    """(..., n) gains of position, speed and integral for motors that see these inertias (..., n) [kg m^2].

    The speed loop outdoes the falling branch of the Stribeck curve, or the joint would creep by jerks.
    """
    kp = seen * BANDWIDTH**2
    kd = 2.0 * seen * BANDWIDTH + 1.5 * (drives.static - drives.coulomb) / drives.stribeck_velocity
    return kp, kd, kp * BANDWIDTH / 4.0


class GearedPlant(Plant):
    """An arm in MuJoCo whose joints are moved by geared drives; its own friction and rotor inertias are not used.

    The torque given to :meth:`step` is B^T tau_m, that of the motors as the joints see it. Rotors are MuJoCo's
    tendons of constant coefficients with armature, one for each row of B.

    Args:
        arm: links and gravity.
        drives: the motors.
        q: (n,) pose at which the micro-damping of the friction is set [rad].
        contacts, scene, timestep: as of :class:`Plant`.

    Raises:
        MissingExtraError: mujoco is not installed.
    """

    def __init__(
        self,
        arm: Arm,
        drives: Drives,
        q: Array,
        *,
        contacts: bool = False,
        scene: Callable[[Any], None] | None = None,
        timestep: float = 2.5e-4,
    ) -> None:
        bare = arm.replace(
            joints=tuple(j.replace(friction=Friction(), rotor_inertia=0.0) for j in arm.joints)
        )

        def with_rotors(spec: Any) -> None:
            for k, (row, inertia) in enumerate(zip(drives.B, drives.inertia, strict=True)):
                tendon = spec.add_tendon(name=f"rotor:{k}", armature=inertia)
                for joint, turns in zip(arm.joints, row, strict=True):
                    if turns:
                        tendon.wrap_joint(f"arm:{joint.name}", turns)
            if scene is not None:
                scene(spec)

        self.drives = drives
        self._friction_of_motors = LuGre(drives, self.seen_inertia(bare, drives, q))
        self._motor_friction = np.zeros(arm.n)
        super().__init__(bare, contacts=contacts, scene=with_rotors, timestep=timestep, integrator="discrete")

    @staticmethod
    def seen_inertia(arm: Arm, drives: Drives, q: Array) -> Array:
        """(n,) inertia that each motor sees at a pose (n,) [kg m^2]."""
        inverse = np.linalg.inv(drives.B)
        rotors = drives.B.T @ np.diag(drives.inertia) @ drives.B
        seen: Array = np.diag(inverse.T @ (arm.mass_matrix(q) + rotors) @ inverse)
        return seen

    def _advance(self, tau: Array, count: int, h: float) -> None:
        if h != self._h:
            self._options.timestep = self._h = h
        B, friction = self.drives.B, self._friction_of_motors
        uneven = friction.uneven(B @ self._q)
        for _ in range(count):
            self._motor_friction = friction.step(B @ self._dq, uneven, h)
            np.subtract(tau, self._motor_friction @ B, out=self._applied)
            self._mj.mj_step(self._model, self._data)

    def _friction(self, data: Any) -> Array:
        return self._motor_friction @ self.drives.B

    def motor_torque(self) -> Array:
        """(n,) of the motors at the link side in the last step [N m]."""
        found: Array = np.linalg.solve(self.drives.B.T, self.torque).astype(np.float64)
        return found
