"""Which arm, which pose: arms by name or file, named poses, and how an arm is driven in simulation."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np

from .. import robots
from ..arm import Arm, Array, Effort, Sensing
from ..errors import ArmError, InputError, suggest

# RobotJustina/RCF-MathWorks-2020-14 @ c49314f: poses of simple_gui, goal and gains of justina_full_system.slx and
# katana_full_system.slx
_JUSTINA_POSES = {
    "StandBy": (-1.0, 0.0, 0.0, 1.5, 0.0, 0.9, 0.0),
    "StandBy2": (-0.5, 0.0, 0.0, 1.2, 0.0, 0.6, 0.0),
    "Take": (0.3, 0.0, 0.0, 0.5, 0.0, 0.7, 0.0),
    "Take2": (0.6, 0.0, 0.0, 0.4, 0.0, 0.6, 0.0),
    "Take3": (0.0, -0.5, 0.5, 1.0, 0.0, 1.0, -0.3),
    "Take4": (0.4, -0.1, 1.0, 0.8, 0.0, 0.7, -0.4),
    "Zero": (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    "goal": (0.5, -0.1, 1.0, 1.1, 0.0, 0.7, -0.4),
}
_KATANA_POSES = {"goal": (0.0, 0.5, -0.5, 0.0, 0.0)}
_JUSTINA_KP = (5.0, 2.5, 2.5, 2.5, 2.5, 2.5, 2.5)
_JUSTINA_KD = (3.5, 1.0, 1.0, 1.5, 1.0, 1.0, 1.0)

_BANDWIDTH = 10.0
"""of the controller of an arm without published gains [rad/s]"""
_ROTOR = 500.0
"""assumed of a drive: its torque limit over its reflected rotor inertia [1/s^2]"""
_ENCODER = 2.0 * math.pi / 65536.0
"""resolution assumed of an encoder that nobody described: 16 bit [rad]"""
NOISE_COUNTS = 2
"""simulated encoders err by up to so many counts, as on the published bench"""


@dataclass(frozen=True, slots=True)
class Scene:
    """An arm as it is used in simulation: with all it needs to move, hold something and be read."""

    arm: Arm
    poses: Mapping[str, Array]
    """(n,) [rad] by name"""
    pose: str
    """the pose in which it weighs, unless told otherwise"""
    start: str
    """the pose from which it comes"""
    mass: float
    """what it lifts, unless told otherwise [kg]"""
    gains: tuple[Array, Array] | None
    """published kp [N m/rad] and kd [N m s/rad] of the controller, (n,) each; None: :func:`gains_at`"""
    assumed: tuple[str, ...] = ()
    """what the arm's description leaves open and what was taken instead, one sentence each"""


@dataclass(frozen=True, slots=True)
class _Reference:
    poses: Mapping[str, tuple[float, ...]]
    pose: str | None
    mass: float
    kp: tuple[float, ...] | None = None
    kd: tuple[float, ...] | None = None


_REFERENCES = {
    "justina_left_arm": _Reference(_JUSTINA_POSES, "Take3", 0.25, _JUSTINA_KP, _JUSTINA_KD),
    # a tenth of the damping: with the inertias of the boxes the published gains shake at 250 Hz
    "justina_left_arm_box": _Reference(
        _JUSTINA_POSES, "Take3", 0.25, _JUSTINA_KP, tuple(0.1 * k for k in _JUSTINA_KD)
    ),
    "katana_300_6m180": _Reference(_KATANA_POSES, "goal", 0.1),
    "katana_450_6m90a": _Reference(_KATANA_POSES, "goal", 0.1),
    "kuka_lbr_iiwa7": _Reference({}, None, 2.0),
    "kuka_lbr_iiwa14": _Reference({}, None, 2.0),
    "abb_irb2400_16": _Reference({}, None, 20.0),
}
_UNKNOWN = _Reference({}, None, 0.25)


def load_arm(
    source: str, *, base: str | None = None, tip: str | None = None, repair_inertia: bool = False
) -> Arm:
    """An arm by the name of a reference arm, or out of a card (.yaml, .yml) or a URDF (.urdf, .xacro, .xml).

    Args:
        source: name or path.
        base: base link in a URDF; None: as :meth:`palpate.Arm.from_urdf`.
        tip: tip link in a URDF; None: as :meth:`palpate.Arm.from_urdf`.
        repair_inertia: as :meth:`palpate.Arm.from_urdf`.

    Raises:
        ArmError: no such arm, or the file describes none.
        MissingExtraError: reading a card needs the extra ``card``, a xacro file ``xacro``.
    """
    if source in robots.names():
        if base or tip:
            raise ArmError(f"{source}: base and tip are for URDF files; a reference arm has its own")
        return robots.load(source)
    path = Path(source)
    kind = path.suffix.lower()
    if kind not in (".yaml", ".yml", ".urdf", ".xacro", ".xml"):
        if path.exists():
            raise ArmError(
                f"{source}: an arm is a card (.yaml) or a URDF (.urdf, .xacro), not {kind or 'this'}"
            )
        raise ArmError(
            f"no arm {source!r}: neither a file nor a reference arm; "
            f"{suggest(source, robots.names(), 'reference arms')}"
        )
    if kind in (".yaml", ".yml"):
        if base or tip:
            raise ArmError(f"{source}: base and tip are for URDF files; a card has its own")
        return Arm.from_card(path)
    if not path.exists():
        raise ArmError(f"{source}: no such file")
    return Arm.from_urdf(path, base=base, tip=tip, repair_inertia=repair_inertia)


def parse_effort(text: str) -> Effort:
    """What a driver's effort is, from ``torque`` or ``current:`` and the N m per A of the joints, one or all.

    Raises:
        InputError: neither.
        ArmError: a gain is zero.
    """
    if text == "torque":
        return Effort.torque()
    kind, _, gains = text.partition(":")
    try:
        numbers = tuple(float(g) for g in gains.split(","))
    except ValueError:
        numbers = ()
    if kind != "current" or not numbers:
        raise InputError(
            "--effort: expected torque, or current: and the N m per A of the joints (current:0.9,1.2,...), "
            f"got {text!r}"
        )
    return Effort.current(numbers)


def scene(arm: Arm, *, mass: float | None = None) -> Scene:
    """How to use an arm in simulation. What its description leaves open is assumed, and said.

    Args:
        arm: the arm.
        mass: the heaviest thing it will hold [kg]; None: the scene's own.

    Raises:
        ArmError: it has no masses.
    """
    if not arm.has_dynamics:
        raise ArmError(f"arm {arm.name!r} has no masses (kinematics only): it cannot be simulated")
    reference = _REFERENCES.get(arm.name, _UNKNOWN)
    poses = {k: _vector(v) for k, v in reference.poses.items() if len(v) == arm.n}
    if len(poses) < len(reference.poses):  # another arm of the same name
        reference, poses = _UNKNOWN, {}
    heaviest = max(reference.mass, mass or 0.0)
    arm, assumed = _complete(arm, heaviest, published=reference.kp is not None)
    zero = next((name for name in poses if name.lower() == "zero"), "zero")
    if zero not in poses:
        poses[zero] = _vector(np.clip(np.zeros(arm.n), *_limits(arm)))
    start, pose = zero, reference.pose
    if pose is None:
        pose, start = "raised", "ready"
        poses[pose] = telling_pose(arm, heaviest)
        # many arms stand upright at zero: there a load has no lever, and falls whichever way
        poses[start] = _vector(0.5 * (poses[zero] + poses[pose]))
    gains: tuple[Array, Array] | None = None
    if reference.kp is not None and reference.kd is not None:
        gains = (_vector(reference.kp), _vector(reference.kd))
    return Scene(arm, MappingProxyType(poses), pose, start, reference.mass, gains, assumed)


def gains_at(arm: Arm, q: Array, period: float) -> tuple[Array, Array]:
    """Gains of a controller for an arm without published ones, about a pose.

    kp = w^2 I, kd = 2 w I with I_j = 1 / (M^-1)_jj, the inertia of a joint while the others are free: the least there
    is, so that the loop is stable however the joints couple. Dry friction needs more: kp reaches it within 0.05 rad,
    as far as viscous friction damps that in one period.

    Args:
        arm: the arm.
        q: (n,) [rad].
        period: of the control loop [s].

    Returns:
        kp [N m/rad] and kd [N m s/rad], (n,) each.
    """
    inertia = 1.0 / np.diag(np.linalg.inv(arm.mass_matrix(q)))
    coulomb = np.array([j.friction.coulomb for j in arm.joints])
    viscous = np.array([j.friction.viscous for j in arm.joints])
    kp = np.maximum(_BANDWIDTH**2 * inertia, np.minimum(coulomb / 0.05, 0.1 * viscous / period))
    return kp, 2.0 * _BANDWIDTH * inertia


def find_pose(scene: Scene, text: str) -> tuple[str, Array]:
    """A pose by its name, in any case, or from n angles separated by commas [rad].

    Returns:
        its name (the angles, if it has none) and the angles (n,) [rad].

    Raises:
        InputError: no such pose, a wrong number of angles, or an angle beyond the joint's limits.
    """
    arm = scene.arm
    names = {name.lower(): name for name in scene.poses}
    name = names.get(text.strip().lower())
    if name is not None:
        q = scene.poses[name]
    else:
        try:
            q = _vector([float(part) for part in text.split(",")])
        except ValueError:
            raise InputError(
                f"no pose {text!r} of {arm.name}; {suggest(text, scene.poses, 'there are')} "
                f"Or give {arm.n} angles in rad, separated by commas."
            ) from None
        if q.shape != (arm.n,):
            raise InputError(f"pose {text!r}: {arm.name} has {arm.n} joints, got {len(q)} angles")
        if not np.isfinite(q).all():
            raise InputError(f"pose {text!r}: every angle must be a finite number [rad]")
        name = text.strip()
    lower, upper = _limits(arm)
    for joint, angle, low, high in zip(arm.joints, q, lower, upper, strict=True):
        if not low <= angle <= high:
            raise InputError(
                f"pose {text!r}: {joint.name} = {angle:g} rad is outside its limits {low:.4g} to {high:.4g} rad"
            )
    return name, q


def weight_torque(arm: Arm, q: Array) -> Array:
    """(n,) torque of the joints that one kilogram at the grasp point of an arm at q (n,) [rad] takes [N m/kg]."""
    J = arm.core.jacobian(np.ascontiguousarray(q[None]), arm.grasp)[0, :3]
    return np.abs(arm.gravity @ J)


def telling_pose(arm: Arm, mass: float) -> Array:
    """A pose that shows the weight of an object well and in which the arm can hold it, (n,) [rad].

    The best of 512 pseudo-random poses near zero by the sum over joints of (torque per kilogram / least torque that
    can be told)^2, angles rounded to 0.1 rad. The same arm gives the same pose.
    """
    lower, upper = _limits(arm)
    # not at the limits, where the safety limiter brakes
    low, high = np.maximum(lower + 0.2, -1.2), np.minimum(upper - 0.2, 1.2)
    low, high = np.minimum(low, upper), np.maximum(high, lower)
    draws = np.random.default_rng(0).random((512, arm.n))
    q = np.clip(np.round(low + draws * (high - low), 1), lower, upper)
    if not arm.has_dynamics:
        weight = np.abs(np.einsum("k,nkj->nj", arm.gravity, arm.core.jacobian(q, arm.grasp)[:, :3]))
        return _vector(q[np.argmax(weight.max(axis=1))])
    g = arm.gravity_torque(q)
    signed = np.einsum("k,nkj->nj", -arm.gravity, arm.core.jacobian(q, arm.grasp)[:, :3])
    effort = np.array([j.limits.effort for j in arm.joints])
    share = np.max(np.abs(g + mass * signed) / effort, axis=1)
    blur = 0.01 * np.max(np.abs(g), axis=0) + np.array(
        [j.friction.coulomb + j.sensing.torque_resolution + 1e-3 for j in arm.joints]
    )
    score = np.sum(np.square(signed / blur), axis=1)
    able = share <= 0.7
    best = np.argmax(np.where(able, score, -1.0)) if able.any() else np.argmin(share)
    return _vector(q[best])


def _limits(arm: Arm) -> tuple[Array, Array]:
    lower, upper = np.array([(j.limits.lower, j.limits.upper) for j in arm.joints]).T
    return lower, upper


def _vector(values: object) -> Array:
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array


def _complete(arm: Arm, mass: float, *, published: bool) -> tuple[Arm, tuple[str, ...]]:
    """The arm with a declared effort, torque limits, rotors and encoders, and what was assumed for that.

    A published bench stays as it was published.
    """
    assumed = []
    if arm.effort.kind == "undeclared":
        arm = arm.replace(effort=Effort.torque())
        assumed.append("The arm's description does not say what its effort is: link-side torque assumed.")
    if any(math.isinf(j.limits.effort) for j in arm.joints):
        lower, upper = (np.clip(x, -math.pi, math.pi) for x in _limits(arm))
        draws = np.random.default_rng(1).random((256, arm.n))
        q = lower + draws * (upper - lower)
        J = arm.core.jacobian(q, arm.grasp)[:, :3]
        static = np.abs(arm.gravity_torque(q)) + 2.0 * mass * np.abs(np.einsum("k,nkj->nj", arm.gravity, J))
        inertia = np.diagonal(arm.mass_matrix(q), axis1=1, axis2=2) + mass * np.sum(J * J, axis=1)
        most = np.max(1.5 * static + 10.0 * inertia, axis=0) + [j.friction.coulomb for j in arm.joints]
        most = np.maximum(most, 0.05 * np.max(most))
        joints = []
        for joint, torque in zip(arm.joints, most, strict=True):
            effort = joint.limits.effort if math.isfinite(joint.limits.effort) else float(f"{torque:.2g}")
            limits = joint.limits
            joints.append(
                joint.replace(limits=type(limits)(limits.lower, limits.upper, limits.velocity, effort))
            )
        arm = arm.replace(joints=tuple(joints))
        assumed.append(
            "Torque limits that the arm's description does not state were taken from its weight and inertia."
        )
    if not published and not any(j.rotor_inertia for j in arm.joints):
        joints = [j.replace(rotor_inertia=j.limits.effort / _ROTOR) for j in arm.joints]
        arm = arm.replace(joints=tuple(joints))
        assumed.append(
            "Rotor inertias that the arm's description does not state were taken from the torque limits: "
            f"{1e3 / _ROTOR:g} g m^2 per N m."
        )
    if any(j.sensing == Sensing() for j in arm.joints):
        joints = []
        for joint in arm.joints:
            sensing = joint.sensing
            if sensing == Sensing():
                noise = math.sqrt(NOISE_COUNTS * (NOISE_COUNTS + 1) / 3.0)
                step = float(f"{joint.limits.effort / 1024.0:.3g}")
                sensing = Sensing(_ENCODER, noise * _ENCODER, None, step)
            joints.append(joint.replace(sensing=sensing))
        arm = arm.replace(joints=tuple(joints))
        assumed.append(
            f"Encoders that the arm's description does not state: 16 bit per turn, ± {NOISE_COUNTS} counts; "
            "torque in 1024 steps of its limit."
        )
    return arm, tuple(assumed)
