"""What there is to touch: a spring wall of known stiffness, a surface, a hole for a peg, objects to lift."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np

from .. import robots
from ..arm import Arm, Array, Sensing, Shape
from ..errors import InputError, suggest
from ..simulate._model import mujoco, quaternion

SceneName: TypeAlias = Literal["wall", "rigid", "surface", "peg", "lift", "turn"]

SlaveKind: TypeAlias = Literal["torque", "phase_currents", "servos"]

PROBE = 0.015
"""radius of the tool's tip [m]"""
TOOL = 0.12
"""from the flange to the centre of the tip [m]"""
PEG_GAP = 0.0015
"""between peg and hole, on each side [m]"""
KEY_GAP = 0.0003
"""between key and slot, on each side [m]"""
_PANEL_MASS = 0.3
_FIXTURE = 3000.0
"""of the springs on which surface and block stand [N/m]"""
_VALVE = 1.0
"""of the torsional spring of the valve [N m/rad]"""
DOWN = np.diag([1.0, -1.0, -1.0])
"""axes of a tool that points down"""


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Something to touch, seen from the tool's tip at the start.

    Attributes:
        name: which one.
        text: what it is and what to do, for people.
        build: adds it to a MjSpec; None: nothing.
        joints: MuJoCo joints that it adds.
        stiffness: of the wall [N/m]; None: there is none.
        path: where the hand goes, times [s] to (3,) [m] from its start, in the slave's axes and scale.
        seconds: how long that takes.
        masses: objects taken and put down, (time [s], mass [kg]).
        turn: how the hand turns, times [s] to (3,) rotation vector [rad] from its start, in the slave's axes.
    """

    name: SceneName
    text: str
    build: Callable[[Any], None] | None
    joints: int
    stiffness: float | None
    path: Callable[[float], Array]
    seconds: float
    masses: tuple[tuple[float, float], ...] = ()
    turn: Callable[[float], Array] = lambda time: np.zeros(3)


def smooth(x: float) -> float:
    """Quintic from 0 to 1."""
    x = min(1.0, max(0.0, x))
    return x**3 * (10.0 - 15.0 * x + 6.0 * x * x)


def through(points: list[tuple[float, tuple[float, float, float]]]) -> Callable[[float], Array]:
    """From rest to rest through points (time [s], place [m])."""
    times = [t for t, _ in points]
    places = np.array([p for _, p in points])

    def path(time: float) -> Array:
        k = int(np.searchsorted(times, time, side="right")) - 1
        if k < 0:
            return places[0].copy()
        if k + 1 >= len(times):
            return places[-1].copy()
        part = smooth((time - times[k]) / (times[k + 1] - times[k]))
        found: Array = places[k] + part * (places[k + 1] - places[k])
        return found

    return path


def find(
    name: str,
    tip: Array,
    *,
    stiffness: float = 2000.0,
    press: float = 0.02,
    masses: tuple[float, ...] = (0.5, 1.2),
    axes: Array = DOWN,
) -> Scene:
    """The scene of that name, placed for a tool whose tip is at `tip` (3,) [m] in the slave's base frame.

    Args:
        name: wall, rigid, surface, peg, lift or turn.
        tip: (3,) [m].
        stiffness: of the wall [N/m].
        press: how far the hand goes beyond the touch [m].
        masses: of the objects to lift [kg].
        axes: (3, 3) of the tool in the slave's base frame, z along it.

    Raises:
        InputError: no such scene, or a number is out of range.
    """
    makers: dict[str, Callable[[], Scene]] = {
        "wall": lambda: _wall(tip, stiffness, press),
        "rigid": lambda: _wall(tip, None, press),
        "surface": lambda: _surface(tip, press),
        "peg": lambda: _peg(tip),
        "lift": lambda: _lift(masses),
        "turn": lambda: _turn(tip, axes),
    }
    if name not in makers:
        raise InputError(f"no scene {name!r}; {suggest(str(name), makers, 'there are')}")
    if not (10.0 <= stiffness <= 1e6 and 0.0 < press <= 0.2):
        raise InputError(
            f"stiffness must be 10 to 1e6 N/m and press above 0 to 0.2 m, got {stiffness!r} and {press!r}"
        )
    return makers[name]()


_UPRIGHT = (1.0, 0.0, 0.0, 0.0)


def _sprung(
    spec: Any,
    name: str,
    pos: tuple[float, float, float] | Array,
    quat: tuple[float, float, float, float],
    axes: tuple[tuple[float, float, float], ...],
    stiffness: float,
) -> Any:
    """A weightless-looking body on springs of one stiffness [N/m] along its own axes."""
    mj = mujoco()
    body = spec.worldbody.add_body(name=name, pos=pos, quat=quat, gravcomp=1.0)
    for k, axis in enumerate(axes):
        slide = body.add_joint(name=f"{name}:{k}", axis=axis)
        slide.type = mj.mjtJoint.mjJNT_SLIDE
        slide.stiffness[0] = stiffness
        slide.damping[0] = 2.0 * 0.3 * (stiffness * _PANEL_MASS) ** 0.5
    return body


def _box(
    body: Any,
    size: tuple[float, float, float],
    pos: tuple[float, float, float],
    rgba: tuple[float, float, float, float],
    share: float = 1.0,
) -> None:
    """A box of half lengths `size` [m], with this share of the body's mass."""
    body.add_geom(
        type=mujoco().mjtGeom.mjGEOM_BOX,
        size=size,
        pos=pos,
        mass=share * _PANEL_MASS,
        rgba=rgba,
        friction=(0.3, 0.005, 0.0001),
        solref=(0.002, 1.0),
    )


def _wall(tip: Array, stiffness: float | None, press: float) -> Scene:
    """On a spring [N/m], or as rigid as MuJoCo's contacts are."""
    gap = 0.05
    axes = () if stiffness is None else ((1.0, 0.0, 0.0),)

    def build(spec: Any) -> None:
        place = (tip[0] + gap + PROBE + 0.01, tip[1], tip[2])
        panel = _sprung(spec, "panel", place, _UPRIGHT, axes, stiffness or 0.0)
        _box(panel, (0.01, 0.1, 0.05), (0.0, 0.0, 0.0), (0.55, 0.68, 0.5, 1.0))

    deep = gap + press
    path = through(
        [(2.0, (0.0, 0.0, 0.0)), (3.5, (deep, 0.0, 0.0)), (6.5, (deep, 0.0, 0.0)), (8.5, (0.0, 0.0, 0.0))]
    )
    if stiffness is None:
        text = f"press a rigid wall as if it gave way by {1e3 * press:g} mm, and come back"
        return Scene("rigid", text, build, 0, None, path, 9.5)
    text = f"press a wall on a spring of {stiffness:g} N/m, {1e3 * press:g} mm deep, and come back"
    return Scene("wall", text, build, 1, stiffness, path, 9.5)


def _surface(tip: Array, press: float) -> Scene:
    gap = 0.03
    slope = 0.15  # [rad]

    def build(spec: Any) -> None:
        quat = (float(np.cos(0.5 * slope)), 0.0, float(np.sin(0.5 * slope)), 0.0)
        normal = np.array([np.sin(slope), 0.0, np.cos(slope)])
        touch = np.asarray(tip) - np.array([0.0, 0.0, gap + PROBE])
        plate = _sprung(spec, "surface", touch - 0.01 * normal, quat, ((0.0, 0.0, 1.0),), _FIXTURE)
        _box(plate, (0.25, 0.25, 0.01), (0.0, 0.0, 0.0), (0.62, 0.56, 0.46, 1.0))

    down = -gap - press
    fall = -np.tan(slope)
    path = through(
        [
            (2.0, (0.0, 0.0, 0.0)),
            (4.0, (0.0, 0.0, down)),
            (7.0, (0.1, 0.0, down + 0.1 * fall)),
            (9.0, (0.1, 0.1, down + 0.1 * fall)),
            (11.0, (0.0, 0.1, down)),
            (12.5, (0.0, 0.1, 0.0)),
        ]
    )
    return Scene(
        "surface",
        f"trace a surface that falls by {np.degrees(slope):.0f} degrees, pressing lightly",
        build,
        1,
        None,
        path,
        13.5,
    )


def _peg(tip: Array) -> Scene:
    gap, depth, off = 0.03, 0.03, 0.008

    def build(spec: Any) -> None:
        hole, width = PROBE + PEG_GAP, 0.04
        axes = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
        top = tip[2] - PROBE - gap
        block = _sprung(spec, "block", (tip[0], tip[1], top - depth), _UPRIGHT, axes, _FIXTURE)
        for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            away = hole + width
            size = (width, 2.0 * width + hole, depth) if dx else (hole, width, depth)
            _box(block, size, (dx * away, dy * away, 0.0), (0.5, 0.52, 0.58, 1.0), 0.25)

    # the hand misses the hole at first and slides into it
    path = through(
        [
            (2.0, (0.0, 0.0, 0.0)),
            (4.0, (off, 0.0, -gap + 0.003)),
            (5.0, (off, 0.0, -gap - 0.004)),
            (7.0, (-0.001, 0.0, -gap - 0.006)),
            (9.0, (0.0, 0.0, -gap - 0.03)),
            (11.0, (0.0, 0.0, -gap - 0.03)),
            (13.0, (0.0, 0.0, 0.0)),
        ]
    )
    return Scene(
        "peg",
        f"put a peg into a hole {1e3 * PEG_GAP:g} mm wider on each side, missing it at first",
        build,
        3,
        None,
        path,
        14.0,
    )


def _turn(tip: Array, axes: Array) -> Scene:
    """A key at the tool's tip in the slot of a valve that a torsional spring turns back."""
    blade, wall = (0.02, 0.003, 0.015), (0.026, 0.01, 0.003)  # a low slot: it guides the turn, not the tilt

    def build(spec: Any) -> None:
        mj = mujoco()
        spec.body("arm:payload").add_geom(
            type=mj.mjtGeom.mjGEOM_BOX,
            size=blade,
            pos=(0.0, 0.0, TOOL + PROBE + blade[2]),
            mass=0.0,
            contype=1,
            conaffinity=0,
            rgba=(0.75, 0.6, 0.3, 1.0),
        )
        place = np.asarray(tip) + axes[:, 2] * (PROBE + blade[2])
        valve = spec.worldbody.add_body(name="valve", pos=place, quat=quaternion(axes), gravcomp=1.0)
        hinge = valve.add_joint(name="valve:turn", axis=(0.0, 0.0, 1.0))
        hinge.type = mj.mjtJoint.mjJNT_HINGE
        hinge.stiffness[0], hinge.damping[0], hinge.armature = _VALVE, 0.01, 2e-3
        for side in (1.0, -1.0):
            off = side * (blade[1] + KEY_GAP + wall[1])
            _box(valve, wall, (0.0, off, 0.0), (0.5, 0.52, 0.58, 1.0), 0.5)

    angle = 0.4
    way = through([(2.0, (0.0,) * 3), (4.0, (angle, 0.0, 0.0)), (6.0, (angle, 0.0, 0.0)), (8.0, (0.0,) * 3)])
    text = f"turn a valve on a spring of {_VALVE:g} N m/rad by {angle:g} rad with a key, and come back"
    return Scene(
        "turn",
        text,
        build,
        1,
        None,
        lambda time: np.zeros(3),
        9.0,
        turn=lambda time: float(way(time)[0]) * np.asarray(axes)[:, 2],
    )


def _lift(masses: tuple[float, ...]) -> Scene:
    if not masses or any(not 0.0 < m <= 20.0 for m in masses):
        raise InputError(f"masses to lift must be above 0 to 20 kg, got {masses!r}")
    events: list[tuple[float, float]] = []
    points: list[tuple[float, tuple[float, float, float]]] = [(2.0, (0.0, 0.0, 0.0))]
    time = 2.0
    for mass in masses:
        events += [(time + 1.0, mass), (time + 7.0, 0.0)]
        points += [
            (time + 1.5, (0.0, 0.0, 0.0)),
            (time + 3.0, (0.0, 0.0, 0.1)),
            (time + 5.0, (0.0, 0.1, 0.1)),
            (time + 6.5, (0.0, 0.0, 0.0)),
        ]
        time += 8.0
    return Scene(
        "lift",
        f"lift {len(masses)} objects whose masses nobody knows, and weigh them",
        None,
        0,
        None,
        through(points),
        time + 1.0,
        tuple(events),
    )


# --- arms with a tool -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class SlaveArm:
    """An arm with a tool in its hand, and how it stands.

    Attributes:
        arm: with the tool as a shape, its grasp point at the centre of the tool's tip.
        q: (n,) pose at the start [rad].
        force_scale: force felt per force of the environment, so that the device's range fits the arm's [1].
        speed: of its reference at most [m/s].
        threshold: of what is felt, in standard deviations [1]: at 1 kHz three are passed every third of a second.
        gain: with which the reference closes on the master's place [1/s].
        motion_scale: motion of the arm per motion of the hand [1].
        force_limit: largest force that is told [N].
        masses: of objects that suit it [kg].
        kind: "torque": follows by torque, its joint torques are measured; "phase_currents": follows by the position
            control of its drives, measures its phase currents; "servos": hobby servos, led joint by joint by its twin.
        assumed: what no source states and was taken, one sentence each.
    """

    arm: Arm
    q: Array
    force_scale: float
    assumed: tuple[str, ...]
    speed: float = 0.5
    threshold: float = 5.0
    gain: float = 60.0
    motion_scale: float = 1.0
    force_limit: float = 100.0
    masses: tuple[float, ...] = (0.5, 1.2)
    kind: SlaveKind = "torque"


_POSES = {
    "kuka_lbr_iiwa14": (0.0, 0.5, 0.0, -1.5, 0.0, 1.1, 0.0),
    "kuka_lbr_iiwa7": (0.0, 0.5, 0.0, -1.5, 0.0, 1.1, 0.0),
    "abb_irb2400_16": (0.0, 0.3, 0.1, 0.0, 0.9, 0.0),
    "so101": (0.0, -0.2, 0.2, 0.9, 0.0),
}
SLAVES = tuple(_POSES)
"""arms that can be slaves in the scenes here"""


def slave_arm(name: str) -> SlaveArm:
    """A reference arm that can be a slave here, with a tool.

    Raises:
        InputError: no such slave.
    """
    if name not in _POSES:
        raise InputError(f"no slave {name!r}; {suggest(str(name), _POSES, 'there are')}")
    bare = robots.load(name)
    T = bare.T_last_tip
    centre = np.eye(4)
    centre[:3, :3] = T[:3, :3]
    centre[:3, 3] = T[:3, :3] @ np.array([0.0, 0.0, 0.5 * TOOL]) + T[:3, 3]
    tool = Shape(kind="capsule", size=(PROBE, TOOL), T=centre, link=bare.n - 1, rgba=(0.3, 0.3, 0.34, 1.0))
    shapes, grasp = (*bare.shapes, tool), np.array([0.0, 0.0, TOOL])
    if name == "so101":
        return SlaveArm(
            bare.replace(shapes=shapes, grasp=grasp),
            np.array(_POSES[name]),
            1.0,
            (
                "load friction of the SO-101's gears as measured on the 7.4 V servo; its current is good to a step of "
                "6.5 mA",
            ),
            gain=60.0,
            threshold=5.0,
            masses=(0.1, 0.2),
            kind="servos",
        )
    if name == "abb_irb2400_16":
        return SlaveArm(
            bare.replace(shapes=shapes, grasp=grasp),
            np.array(_POSES[name]),
            0.05,
            (
                "torque constants, gears, rotors, presliding, ripple and the errors of the current sensors of the ABB: "
                "no source states them; they are those of the sensorless-force study",
            ),
            speed=0.8,
            threshold=3.0,
            gain=20.0,
            motion_scale=2.0,
            force_limit=200.0,
            masses=(6.0, 14.0),
            kind="phase_currents",
        )
    sensing = Sensing(position_resolution=1e-6, position_std=0.0, velocity_std=1e-4, torque_std=0.05)
    joints = tuple(j.replace(sensing=sensing) for j in bare.joints)
    arm = bare.replace(joints=joints, shapes=shapes, grasp=grasp)
    return SlaveArm(
        arm,
        np.array(_POSES[name]),
        1.0,
        (
            "encoders of 1 microradian, velocities with 0.1 mrad/s and torques with 0.05 N m of noise at 1 kHz: "
            "no source states them",
        ),
    )
