"""Columns of the friction model (MATH.md section 6), with a sign that remembers the way it came.

A joint at rest keeps the friction it stopped with: the sign of a velocity that is zero says nothing, and a
controller's creep of 1e-4 rad/s decides between -F_c and +F_c. The sign used here is Dahl's state

    dz/dt = (dq / x_0) (1 - z sgn dq),  |z| <= 1,

which depends on the distance travelled since a reversal, not on time: it holds at rest and turns over within a
few x_0 [rad]. For x_0 -> 0 it is sgn of the last motion.
P. Dahl, A solid friction model, Aerospace Corporation TOR-0158(3107-18)-1, 1968.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from palpate.arm import Array
from palpate.errors import InputError
from palpate.identify.data import Segment

PRESLIDING = (1e-4, 3e-4, 1e-3, 3e-3, 1e-2)
"""presliding distances tried [rad]"""
STRIBECK = (0.03, 0.06, 0.12, 0.2, 0.3)
"""Stribeck velocities tried, as parts of the joint's fastest speed in the logs: wider ones pass for viscous"""


@dataclass(frozen=True, slots=True)
class Coupling:
    """A drive that turns with the sum of several joints (TX40 axes 5 and 6), seen at the link side.

    Its rotor inertia, viscous and Coulomb friction act on each of the joints with the sum of their velocities.
    """

    joints: tuple[int, ...]
    """indices of the joints, from 0"""

    def __post_init__(self) -> None:
        object.__setattr__(self, "joints", tuple(int(j) for j in self.joints))
        if len(self.joints) < 2 or len(set(self.joints)) < len(self.joints) or min(self.joints) < 0:
            raise InputError(f"a coupling joins two or more different joints, got {self.joints}")


@dataclass(frozen=True, slots=True)
class FrictionModel:
    """Which friction is fitted. Coulomb, viscous friction and offset always are.

    Attributes:
        stribeck: adds (F_s - F_c) exp(-(dq/v_s)^2), v_s searched; F_s < F_c (less friction at low speed, the
            concave curve of many harmonic drives) is allowed.
        load: adds load |tau_load| to F_c.
        springs: joints, by index, that get k q, k >= 0: a harness or hose that turns with the joint pulls it back.
            An arm card has no springs: what it says is then k q off.
        rotor_inertia: fits I_a ddq.
        presliding: distances x_0 tried [rad]; one value fixes it.
        velocities: Stribeck velocities v_s tried, as parts of the joint's fastest speed [1].
        couplings: drives that turn with several joints.
        memory: the Stribeck term, too, follows the speed only over the distance x_0, as in the LuGre model,
            instead of at once.
        stiction: how unknown friction at rest is, part of its range +-F_c [1]. 1: all of it, rows at rest say
            next to nothing. Near 0: a joint keeps the friction it stopped with, so rows at rest show how
            friction rises there; for joints that a stiff controller holds without creep. Held-out residuals
            tell which is right.
    """

    stribeck: bool = False
    load: bool = False
    springs: tuple[int, ...] = ()
    rotor_inertia: bool = True
    presliding: tuple[float, ...] = PRESLIDING
    velocities: tuple[float, ...] = STRIBECK
    couplings: tuple[Coupling, ...] = ()
    memory: bool = False
    stiction: float = 1.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.stiction <= 1.0:
            raise InputError(f"friction stiction must be between 0 and 1, got {self.stiction!r}")
        for name in ("presliding", "velocities"):
            values = tuple(float(v) for v in getattr(self, name))
            if not values or not all(np.isfinite(v) and v > 0.0 for v in values):
                raise InputError(f"friction {name} must be positive numbers, got {values}")
            object.__setattr__(self, name, values)
        object.__setattr__(self, "couplings", tuple(self.couplings))
        object.__setattr__(self, "springs", tuple(sorted({int(j) for j in self.springs})))
        if self.springs and self.springs[0] < 0:
            raise InputError(f"springs must be indices of joints, from 0, got {self.springs}")

    @classmethod
    def named(cls, name: str, couplings: Sequence[Coupling] = ()) -> FrictionModel:
        """``"coulomb"``, ``"stribeck"``, ``"load"`` or ``"stribeck+load"``.

        Raises:
            InputError: another name.
        """
        parts = set(name.split("+")) - {"coulomb"}
        if not parts <= {"stribeck", "load"}:
            raise InputError(f"friction must be coulomb, stribeck, load or stribeck+load, got {name!r}")
        return cls(stribeck="stribeck" in parts, load="load" in parts, couplings=tuple(couplings))

    @property
    def terms(self) -> tuple[str, ...]:
        """Names of one joint's friction parameters, in the order of the columns."""
        return (
            "coulomb",
            "viscous",
            "offset",
            *(("stribeck",) if self.stribeck else ()),
            *(("load",) if self.load else ()),
        )


@dataclass(frozen=True, slots=True)
class FrictionShape:
    """The friction parameters that do not enter linearly, one per joint."""

    presliding: tuple[float, ...]
    """x_0 [rad]"""
    stribeck_velocity: tuple[float, ...]
    """v_s [rad/s]"""


def remembered_sign(dq: Array, period: float, distance: Array, level: Array | None = None) -> Array:
    """Dahl's state z for each distance; with a level, the state that follows level sgn dq over it.

    Args:
        dq: (N, n) [rad/s].
        period: time between rows [s].
        distance: (K,) x_0 [rad], or (K, n).
        level: (N, n) >= 0; None: 1.

    Returns:
        (K, N, n) in [-1, 1] (times the level); starts as the sign of the first motion.
    """
    travel = np.abs(dq) * period
    sign = np.sign(dq)
    reach = np.asarray(distance, dtype=np.float64)
    reach = np.broadcast_to(reach[:, None] if reach.ndim == 1 else reach, (len(reach), dq.shape[1]))
    decay = np.exp(-travel[None] / reach[:, None, :])
    z = np.empty_like(decay)
    # what happened before the log is unknown; the first motion is the best guess
    first = np.argmax(sign != 0.0, axis=0)
    state = np.broadcast_to(sign[first, np.arange(dq.shape[1])], reach.shape).copy()
    goal = sign if level is None else sign * level
    towards = goal[:, None, :] * (1.0 - decay.transpose(1, 0, 2))
    steps = np.ascontiguousarray(decay.transpose(1, 0, 2))
    for k in range(len(dq)):
        state = state * steps[k] + towards[k]
        z[:, k] = state
    return z


def columns(
    model: FrictionModel,
    segment: Segment,
    shape: FrictionShape,
    load_torque: Array | None,
    sign: Array | None = None,
) -> Array:
    """Friction columns of every joint on the inner grid, (N, n, terms): torque per unit of each parameter.

    Args:
        model: which terms.
        segment: kinematics.
        shape: x_0 and v_s per joint.
        load_torque: (N, n) torque the gears transmit [N m]; needed with ``model.load``.
        sign: (N, n) the remembered sign at the shape's distances, where it is known already.
    """
    z = sign
    if z is None:
        z = remembered_sign(segment.dq, 1.0 / segment.rate, np.array([shape.presliding]))[0]
    parts = [z, segment.dq, np.ones_like(z)]
    if model.stribeck:
        bump = np.exp(-np.square(segment.dq / np.array(shape.stribeck_velocity)))
        if model.memory:
            reach = np.array([shape.presliding])
            parts.append(remembered_sign(segment.dq, 1.0 / segment.rate, reach, bump)[0])
        else:
            parts.append(z * bump)
    if model.load:
        if load_torque is None:
            raise InputError("load-dependent friction needs the load torque")
        parts.append(z * np.abs(load_torque))
    return np.stack(parts, axis=2)


def coupling_columns(coupling: Coupling, segment: Segment, distance: float) -> Array:
    """Rotor inertia, viscous and Coulomb columns (N, 3) of a coupling, for each of its joints alike."""
    joints = list(coupling.joints)
    dq, ddq = segment.dq[:, joints].sum(axis=1), segment.ddq[:, joints].sum(axis=1)
    z = remembered_sign(dq[:, None], 1.0 / segment.rate, np.array([distance]))[0]
    return np.column_stack([ddq, dq, z])
