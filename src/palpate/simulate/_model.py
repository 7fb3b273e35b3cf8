"""From an Arm to a MuJoCo model: bodies, joints, friction, pictures. No state lives here."""

from __future__ import annotations

import ctypes.util
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
import numpy.typing as npt

from ..arm import Arm, Array, smallest_turn
from ..errors import ArmError, MissingExtraError, PalpateError

# Dry friction is a constraint in MuJoCo. Its impedance is put at the largest value and its time constant at
# the smallest the step allows (two steps), because a joint at rest under load creeps at (1-d)/d of what would
# move it: with the defaults a light wrist crawls at 0.2 rad/s.
_STICK_SOLREF = (1e-9, 1.0)
_STICK_SOLIMP = (0.9999, 0.9999, 1e-3, 0.5, 2.0)
_END_STOP_SOLREF = (0.004, 1.0)

PAYLOAD_COLOUR = (0.93, 0.49, 0.19, 1.0)
HIDDEN_COLOUR = (0.93, 0.49, 0.19, 0.0)

OFFSCREEN = (2560, 1600)
"""Largest picture [pixel]: width, height."""


def mujoco() -> ModuleType:
    """The mujoco module. Without a display and without MUJOCO_GL it is told to draw through EGL, if there is one.

    Raises:
        MissingExtraError: mujoco-core is not installed.
        PalpateError: MUJOCO_GL asks for a library that is not there.
    """
    if "mujoco" not in sys.modules and sys.platform.startswith("linux"):
        if not any(os.environ.get(v) for v in ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY")):
            # MuJoCo reads this while it is imported, and fails then if the library is missing
            os.environ["MUJOCO_GL"] = "egl" if ctypes.util.find_library("EGL") else "off"
    try:
        import mujoco as module
    except ModuleNotFoundError as error:
        if error.name != "mujoco":
            raise
        raise MissingExtraError("sim", "simulating an arm") from None
    except (AttributeError, ImportError, OSError, RuntimeError) as error:
        raise PalpateError(
            f"MuJoCo cannot be imported with MUJOCO_GL={os.environ.get('MUJOCO_GL', '')!r}: {error}; "
            "MUJOCO_GL=off simulates without pictures, egl needs libegl1, osmesa needs libosmesa6"
        ) from error
    return module


@dataclass(frozen=True, slots=True)
class Built:
    """A compiled model and where things are in it."""

    model: Any
    """mujoco.MjModel; joint i of the arm is qpos[i], qvel[i]"""
    links: tuple[int, ...]
    """body of the base (index 0) and of every link (index i+1)"""
    hands: tuple[int, ...]
    """massless body of every link at which a wrench acts; index i is link i"""
    payload: int
    """body of the held object; its frame is the arm's tip frame"""
    payload_geom: int
    R_world_base: Array
    """(3, 3): the world's z axis is straight up, whatever the arm's mount"""
    extent: float
    """how far the arm reaches [m]"""


def quaternion(R: Array) -> Array:
    """Unit quaternion (w, x, y, z) of a rotation matrix (3, 3)."""
    q = np.empty(4)
    mujoco().mju_mat2Quat(q, np.ascontiguousarray(R).ravel())
    return q


def upright(gravity: Array) -> Array:
    """R_world_base (3, 3): the smallest turn that makes `gravity` (3,) point along -z; 1 without gravity."""
    size = float(np.linalg.norm(gravity))
    if size == 0.0:
        return np.eye(3)
    return smallest_turn(-gravity / size).T


def write_inertial(model: Any, body: int, mass: float, com: Array, inertia: Array) -> None:
    """Give a body its mass [kg], centre of mass (3,) [m] and inertia (3, 3) about it [kg m^2], body axes.

    Written into the compiled model, because the compiler refuses published tensors that break the triangle
    inequality a little. mj_setConst must follow.
    """
    moments, axes = np.linalg.eigh(inertia)
    if np.linalg.det(axes) < 0.0:
        axes[:, 0] *= -1.0
    model.body_mass[body] = mass
    model.body_ipos[body] = com
    model.body_iquat[body] = quaternion(axes)
    model.body_inertia[body] = moments


def build(arm: Arm, *, limits: bool, contacts: bool, scene: Callable[[Any], None] | None) -> Built:
    """Compile the model of an arm.

    Args:
        arm: the arm; its base stands in the world's origin, turned so that gravity points down.
        limits: end stops at the joints' limits.
        contacts: the arm's shapes and the held object collide with the scene (never with each other).
        scene: called with the MjSpec after the arm is in it, to add tables, boards, lights, cameras.

    Raises:
        ArmError: the arm has no dynamics.
        MissingExtraError: mujoco is not installed.
    """
    mj = mujoco()
    if not arm.has_dynamics:
        raise ArmError(f"arm {arm.name!r} has no masses: it has kinematics only and cannot be simulated")
    spec = mj.MjSpec()
    spec.modelname = arm.name
    spec.compiler.degree = False
    spec.compiler.fusestatic = False
    disable = mj.mjtDisableBit.mjDSBL_ISLAND | mj.mjtDisableBit.mjDSBL_AUTORESET
    if not contacts:
        disable |= mj.mjtDisableBit.mjDSBL_CONTACT
    spec.option.disableflags = int(disable)
    spec.option.tolerance = 1e-12
    spec.option.jacobian = mj.mjtJacobian.mjJAC_DENSE
    spec.option.gravity = (0.0, 0.0, -float(np.linalg.norm(arm.gravity)))

    R_world_base = upright(arm.gravity)
    parts = add_arm(spec, arm, "arm:", quaternion(R_world_base), limits=limits, contacts=contacts)
    extent = _draw(mj, spec, arm, R_world_base)
    if scene is not None:
        scene(spec)
    model = spec.compile()

    built = Built(
        model=model,
        links=tuple(b.id for b in parts.links),
        hands=tuple(b.id for b in parts.hands),
        payload=parts.payload.id,
        payload_geom=parts.held.id,
        R_world_base=R_world_base,
        extent=extent,
    )
    write_arm(model, arm, parts)
    return built


@dataclass(frozen=True, slots=True)
class Parts:
    """An arm in a MjSpec."""

    links: tuple[Any, ...]
    """bodies of the base and of every link"""
    hands: tuple[Any, ...]
    """massless bodies at which wrenches act, one for every link"""
    payload: Any
    """body of what is held; its frame is the arm's tip frame"""
    held: Any
    """its geom"""


def add_arm(
    spec: Any,
    arm: Arm,
    prefix: str,
    quat: Array,
    *,
    pos: tuple[float, float, float] = (0.0, 0.0, 0.0),
    limits: bool,
    contacts: bool,
) -> Parts:
    """Put an arm into a MjSpec; once it is compiled, :func:`write_arm` gives the bodies their masses.

    Args:
        spec: the MjSpec.
        arm: the arm.
        prefix: of the names of bodies and joints.
        quat: of the base, (w, x, y, z) in the world.
        pos: of the base [m].
        limits: end stops at the joints' limits.
        contacts: the arm's shapes and the held object collide with the scene.
    """
    mj = mujoco()
    base = spec.worldbody.add_body(name=f"{prefix}base", pos=pos, quat=quat)
    links, hands, body = [base], [], base
    # off the origin and off the axes, so that the compiler takes no shortcut; the real ones are written below
    stand_in = {
        "mass": 1.0,
        "ipos": (0.1, 0.2, 0.3),
        "iquat": (0.5, 0.5, 0.5, 0.5),
        "inertia": (1.0, 1.1, 1.2),
        "explicitinertial": True,
        "simple": 0,
    }
    for joint in arm.joints:
        T = joint.T_parent_joint
        body = body.add_body(
            name=f"{prefix}{joint.link}", pos=T[:3, 3], quat=quaternion(T[:3, :3]), **stand_in
        )
        hinge = body.add_joint(name=f"{prefix}{joint.name}", axis=joint.axis, armature=joint.rotor_inertia)
        hinge.type = mj.mjtJoint.mjJNT_HINGE if joint.kind == "revolute" else mj.mjtJoint.mjJNT_SLIDE
        hinge.damping[0] = joint.friction.viscous
        hinge.frictionloss = joint.friction.coulomb
        hinge.solref_friction, hinge.solimp_friction = _STICK_SOLREF, _STICK_SOLIMP
        stops = (joint.limits.lower, joint.limits.upper)
        if limits and np.any(np.isfinite(stops)):
            hinge.limited = mj.mjtLimited.mjLIMITED_TRUE
            hinge.range = np.clip(stops, -1e6, 1e6)
            hinge.solref_limit = _END_STOP_SOLREF
        links.append(body)
    for joint, link in zip(arm.joints, links[1:], strict=True):
        hands.append(link.add_body(name=f"{prefix}{joint.link}:push"))
    tip = arm.T_last_tip
    payload = links[-1].add_body(
        name=f"{prefix}payload", pos=tip[:3, 3], quat=quaternion(tip[:3, :3]), **stand_in
    )
    # against the scene's geoms (1 and 1 by default), not against one another
    collide = {"contype": int(contacts), "conaffinity": 0}
    held = payload.add_geom(
        name=f"{prefix}payload", type=mj.mjtGeom.mjGEOM_BOX, size=(0.01,) * 3, rgba=HIDDEN_COLOUR, **collide
    )
    _draw_arm(mj, arm, links, collide)
    return Parts(tuple(links), tuple(hands), payload, held)


def write_arm(model: Any, arm: Arm, parts: Parts) -> None:
    """Give the bodies of an arm their masses and let it hold nothing. mj_setConst must follow."""
    for joint, link in zip(arm.joints, parts.links[1:], strict=True):
        write_inertial(model, link.id, joint.mass, joint.com, joint.inertia)
    write_inertial(model, parts.payload.id, 0.0, np.zeros(3), np.zeros((3, 3)))


def _draw_arm(mj: ModuleType, arm: Arm, links: list[Any], collide: dict[str, int]) -> None:
    """Add a geom for every shape of :meth:`palpate.Arm.solid_shapes`."""
    kinds = {
        "box": mj.mjtGeom.mjGEOM_BOX,
        "cylinder": mj.mjtGeom.mjGEOM_CYLINDER,
        "sphere": mj.mjtGeom.mjGEOM_SPHERE,
        "capsule": mj.mjtGeom.mjGEOM_CAPSULE,
    }
    for shape in arm.solid_shapes():
        halves = np.zeros(3)
        halves[: len(shape.size)] = shape.size
        halves[0 if shape.kind == "box" else 1 :] *= 0.5
        links[shape.link + 1].add_geom(
            type=kinds[shape.kind],
            size=halves,
            pos=shape.T[:3, 3],
            quat=quaternion(shape.T[:3, :3]),
            rgba=shape.rgba,
            **collide,
        )


def _draw(mj: ModuleType, spec: Any, arm: Arm, R_world_base: Array) -> float:
    """Add sky, floor and lights; return the arm's reach [m]."""
    reach = arm.reach
    # the floor goes below everything the straight arm touches; an arm that hangs gets room to swing
    T = np.eye(4)
    T[:3, :3] = R_world_base
    heights = [0.0]
    for joint in arm.joints:
        T = T @ joint.T_parent_joint
        heights.append(float(T[2, 3]))
    heights.append(float((T @ arm.T_last_tip @ np.append(arm.grasp, 1.0))[2]))
    floor = 0.0 if min(heights) > -1e-6 else -1.15 * reach

    spec.add_texture(
        name="arm:sky",
        type=mj.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mj.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=(0.93, 0.95, 0.98),
        rgb2=(0.62, 0.72, 0.84),
        width=256,
        height=256 * 6,
    )
    spec.add_texture(
        name="arm:tiles",
        type=mj.mjtTexture.mjTEXTURE_2D,
        builtin=mj.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=(0.83, 0.85, 0.87),
        rgb2=(0.79, 0.81, 0.84),
        width=512,
        height=512,
    )
    tiles = spec.add_material(
        name="arm:tiles", texrepeat=(4.0 / reach,) * 2, texuniform=True, reflectance=0.03
    )
    textures = list(tiles.textures)
    textures[mj.mjtTextureRole.mjTEXROLE_RGB] = "arm:tiles"
    tiles.textures = textures
    spec.worldbody.add_geom(
        name="arm:floor",
        type=mj.mjtGeom.mjGEOM_PLANE,
        size=(0.0, 0.0, 0.1),
        pos=(0.0, 0.0, floor),
        material="arm:tiles",
        contype=0,
        conaffinity=0,
    )
    up = max(*heights, floor + reach)
    for where, strength, shadow in (((1.2, -1.6, 2.2), 0.55, True), ((-1.8, 1.2, 1.6), 0.20, False)):
        spec.worldbody.add_light(
            type=mj.mjtLightType.mjLIGHT_DIRECTIONAL,
            pos=(where[0] * reach, where[1] * reach, up + where[2] * reach),
            dir=tuple(-w for w in where),
            castshadow=shadow,
            diffuse=(strength,) * 3,
            specular=(0.15,) * 3,
            ambient=(0.0,) * 3,
        )
    spec.visual.headlight.ambient = (0.38,) * 3
    spec.visual.headlight.diffuse = (0.22,) * 3
    spec.visual.headlight.specular = (0.05,) * 3
    # the floor has no end: it fades into the sky
    spec.visual.rgba.haze = (0.80, 0.86, 0.92, 1.0)
    spec.visual.map.haze = 0.35
    spec.visual.quality.shadowsize = 4096
    spec.visual.global_.offwidth, spec.visual.global_.offheight = OFFSCREEN
    spec.stat.extent = 2.0 * reach
    spec.stat.center = (0.0, 0.0, 0.5 * (floor + up))
    return reach


def box_halves(mass: float, size: npt.ArrayLike | None) -> Array:
    """Half lengths (3,) [m] at which a held object is drawn: its own, or those of a cube of 2000 kg/m^3."""
    if size is not None:
        return 0.5 * np.asarray(size, dtype=np.float64)
    return np.full(3, 0.5 * (mass / 2000.0) ** (1.0 / 3.0))
