"""URDF in and out (used by :mod:`palpate.arm`; call ``Arm.from_urdf`` and ``Arm.to_urdf``).

URDF has no place for gravity, sensing or the meaning of a driver's numbers. They travel in one extra element
of the file, ``<palpate>``, which other readers skip::

    <palpate version="1" base="base_link" tip="tool0" gravity="0 0 -9.81" grasp="0 0 0.1">
      <effort kind="current" k_t="0.05 0.05" gear="100 -100"/>
      <joint name="shoulder" rotor_inertia="0.4">
        <friction offset="0.1" static="3" stribeck_velocity="0.01" load="0" sign_velocity="0.01"
                  presliding="0.001"/>
        <sensing position_resolution="0.0015" position_std="0.002" torque_resolution="0.01" torque_std="0"/>
      </joint>
      <provenance key="source">data sheet, 2024</provenance>
    </palpate>
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.parsers import expat
from xml.sax.saxutils import escape, quoteattr

import numpy as np

from .arm import HUGE, Arm, Array, Effort, Friction, Joint, Limits, Sensing, Shape, inertia_complaint
from .errors import ArmError, MissingExtraError, suggest

_MAX_BYTES = 16 * 2**20
_MAX_DEPTH = 64
_UNLIMITED = 1e308
"""What is written where URDF demands a limit and there is none; anything from 1e300 on is read as none."""
_MOVING = ("revolute", "continuous", "prismatic")
_KINDS = (*_MOVING, "fixed", "floating", "planar")


# --- XML with line numbers ----------------------------------------------------------------------------------


@dataclass(slots=True)
class _Element:
    tag: str
    attributes: dict[str, str]
    where: str
    """file:line"""
    children: list[_Element] = field(default_factory=list)
    text: list[str] = field(default_factory=list)

    def all(self, tag: str) -> list[_Element]:
        return [c for c in self.children if c.tag == tag]

    def one(self, tag: str) -> _Element | None:
        found = self.all(tag)
        if len(found) > 1:
            raise ArmError(f"{found[1].where}: <{self.tag}> has more than one <{tag}>")
        return found[0] if found else None

    def need(self, tag: str) -> _Element:
        found = self.one(tag)
        if found is None:
            raise ArmError(f"{self.where}: <{self.tag}> {self.attributes.get('name', '')!r} needs a <{tag}>")
        return found

    def get(self, name: str) -> str:
        if name not in self.attributes:
            raise ArmError(f"{self.where}: <{self.tag}> needs the attribute {name!r}")
        return self.attributes[name]

    def named(self, name: str = "name") -> str:
        value = self.get(name).strip()
        if not value:
            raise ArmError(f"{self.where}: <{self.tag}> has an empty {name!r}")
        return value

    def numbers(
        self, name: str, count: int | None, default: tuple[float, ...] | None = None
    ) -> tuple[float, ...]:
        """The attribute's finite numbers; any count from 1 on if count is None."""
        if default is not None and name not in self.attributes:
            return default
        text = self.get(name)
        values = []
        for word in text.split():
            try:
                values.append(float(word) if "_" not in word else math.nan)
            except ValueError:
                values.append(math.nan)
        if not all(map(math.isfinite, values)) or (len(values) != count if count is not None else not values):
            raise ArmError(
                f"{self.where}: {name!r} of <{self.tag}> must be {count or 'some'} finite number(s), "
                f"got {text!r:.60}"
            )
        return tuple(values)

    def number(self, name: str, default: float | None = None) -> float:
        return self.numbers(name, 1, None if default is None else (default,))[0]

    def is_xacro(self) -> bool:
        """True if a macro is left anywhere inside."""
        stack = [self]
        while stack:
            element = stack.pop()
            if element.tag.startswith("xacro:"):
                return True
            stack += element.children
        return False

    def only(self, attributes: Iterable[str], children: Iterable[str] = ()) -> None:
        """Refuse what palpate's own element does not know, so that no misspelt setting is ignored."""
        for kind, known, used in (
            ("attribute", list(attributes), list(self.attributes)),
            ("element", list(children), [c.tag for c in self.children]),
        ):
            for name in used:
                if name not in known:
                    raise ArmError(
                        f"{self.where}: <{self.tag}> has no {kind} {name!r}; {suggest(name, known, 'known')}"
                    )


def _parse_xml(data: bytes, name: str) -> _Element:
    """Root element of an XML document without a DTD (no entities, so no bombs and no foreign files)."""
    if len(data) > _MAX_BYTES:
        raise ArmError(f"{name}: larger than {_MAX_BYTES // 2**20} MiB, which no arm's description is")
    parser = expat.ParserCreate()
    parser.buffer_text = True
    root: list[_Element] = []
    stack: list[_Element] = []

    def start(tag: str, attributes: dict[str, str]) -> None:
        where = f"{name}:{parser.CurrentLineNumber}"
        if len(stack) >= _MAX_DEPTH:
            raise ArmError(f"{where}: elements are nested deeper than {_MAX_DEPTH}")
        element = _Element(tag, attributes, where)
        (stack[-1].children if stack else root).append(element)
        stack.append(element)

    def end(_tag: str) -> None:
        stack.pop()

    def characters(text: str) -> None:
        stack[-1].text.append(text)

    def doctype(*_: object) -> None:
        raise ArmError(f"{name}:{parser.CurrentLineNumber}: a DOCTYPE (entities) is not allowed")

    parser.StartElementHandler = start
    parser.EndElementHandler = end
    parser.CharacterDataHandler = characters
    parser.StartDoctypeDeclHandler = doctype
    try:
        parser.Parse(data, True)
    except expat.ExpatError as e:
        raise ArmError(f"{name}:{e.lineno}: malformed XML: {expat.ErrorString(e.code)}") from None
    except (LookupError, ValueError) as e:  # an encoding that is unknown or lies
        raise ArmError(f"{name}: malformed XML: {e}") from None
    return root[0]


def _xacro(text: str | None, path: Path | None, arguments: Mapping[str, str] | None, name: str) -> bytes:
    try:
        import xacro
    except ImportError:
        raise MissingExtraError("xacro", f"reading the xacro file {name}") from None
    mappings = {str(k): str(v) for k, v in (arguments or {}).items()}
    try:
        if path is not None:
            document = xacro.process_file(str(path), mappings=mappings)
        else:
            document = xacro.parse(text)
            xacro.process_doc(document, mappings=mappings)
        return bytes(document.toxml(encoding="utf-8"))
    except Exception as e:  # xacro evaluates expressions of the file: anything can come out of it
        raise ArmError(f"{name}: xacro: {type(e).__name__}: {e}".replace("\n", " ")) from e


def _load(
    source: str | os.PathLike[str], xacro_args: Mapping[str, str] | None
) -> tuple[_Element, str | None]:
    """Root element, and the file's name (None for text)."""
    if isinstance(source, str) and source.lstrip("\ufeff \t\r\n").startswith("<"):
        text = source.lstrip("\ufeff \t\r\n")
        # text is already decoded: a declared encoding no longer applies
        text = re.sub(r"^(<\?xml[^>]*?)\s+encoding\s*=\s*(\"[^\"]*\"|'[^']*')", r"\1", text)
        root = _parse_xml(text.encode("utf-8", "surrogatepass"), "URDF text")
        if root.is_xacro():
            root = _parse_xml(_xacro(text, None, xacro_args, "URDF text"), "URDF text")
        return root, None
    try:
        path = Path(source)
        with path.open("rb") as file:
            root = _parse_xml(file.read(_MAX_BYTES + 1), path.name)
        if path.suffix == ".xacro" or root.is_xacro():
            root = _parse_xml(_xacro(None, path, xacro_args, path.name), path.name)
        return root, path.name
    except (OSError, TypeError, ValueError) as e:
        reason = e.strerror if isinstance(e, OSError) and e.strerror else str(e)
        raise ArmError(f"cannot read the URDF {str(source)!r:.200}: {reason}") from None


# --- geometry -----------------------------------------------------------------------------------------------


def _transform(origin: _Element | None) -> Array:
    """URDF <origin>: translation xyz [m], then fixed-axis roll, pitch, yaw [rad]."""
    T = np.eye(4)
    if origin is None:
        return T
    r, p, y = origin.numbers("rpy", 3, (0.0, 0.0, 0.0))
    cr, sr, cp, sp, cy, sy = math.cos(r), math.sin(r), math.cos(p), math.sin(p), math.cos(y), math.sin(y)
    T[:3, :3] = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    T[:3, 3] = origin.numbers("xyz", 3, (0.0, 0.0, 0.0))
    if not np.all(np.abs(T) <= HUGE):
        raise ArmError(f"{origin.where}: no <origin> is {origin.attributes['xyz']!r:.60} m away")
    return T


def _rpy(R: Array) -> tuple[float, float, float]:
    """Fixed-axis roll, pitch, yaw [rad] of a rotation matrix; roll 0 where only roll - yaw is defined."""
    level = math.hypot(R[0, 0], R[1, 0])
    pitch = math.atan2(-R[2, 0], level)
    if level < 1e-9:
        return 0.0, pitch, math.atan2(-R[0, 1], R[1, 1])
    return math.atan2(R[2, 1], R[2, 2]), pitch, math.atan2(R[1, 0], R[0, 0])


@dataclass(frozen=True, slots=True)
class _Body:
    """A rigid body in some frame: mass, centre of mass, inertia about it in that frame's axes."""

    mass: float
    com: Array
    inertia: Array

    def moved(self, T: Array) -> _Body:
        R = T[:3, :3]
        return _Body(self.mass, R @ self.com + T[:3, 3], R @ self.inertia @ R.T)


def _lump(bodies: list[_Body]) -> _Body:
    """One body out of several that move together, all given in the same frame."""
    massive = [b for b in bodies if b.mass > 0.0]
    if len(massive) == 1:
        return massive[0]
    mass = sum(b.mass for b in massive)
    if mass == 0.0:
        return _Body(0.0, np.zeros(3), np.zeros((3, 3)))
    com = sum((b.mass * b.com for b in massive), np.zeros(3)) / mass
    inertia = np.zeros((3, 3))
    for b in massive:
        d = b.com - com
        inertia += b.inertia + b.mass * (d @ d * np.eye(3) - np.outer(d, d))
    return _Body(mass, com, inertia)


def _possible(inertia: Array, mass: float) -> Array:
    """The nearest inertia a body can have.

    Its principal second moments are raised to 1e-3 of the largest, and to (1 mm)^2 times the mass at least.
    """
    second, axes = np.linalg.eigh(0.5 * np.trace(inertia) * np.eye(3) - inertia)
    raised = np.maximum(second, max(1e-3 * second[-1], 1e-6 * mass))
    matrix = axes @ np.diag(raised) @ axes.T
    return np.asarray(np.trace(matrix) * np.eye(3) - 0.5 * (matrix + matrix.T))


# --- URDF elements ------------------------------------------------------------------------------------------


def _body(link: _Element) -> _Body | None:
    """The link's body in the link frame; None without <inertial>."""
    inertial = link.one("inertial")
    if inertial is None:
        return None
    name = link.named()
    mass = inertial.need("mass").number("value")
    if mass < 0.0:
        raise ArmError(f"{inertial.where}: link {name!r} has a negative mass, {mass!r} kg")
    tensor = inertial.need("inertia")
    xx, yy, zz = (tensor.number(k) for k in ("ixx", "iyy", "izz"))
    xy, xz, yz = (tensor.number(k, 0.0) for k in ("ixy", "ixz", "iyz"))
    T = _transform(inertial.one("origin"))
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    if mass == 0.0 and np.any(inertia):
        raise ArmError(f"{inertial.where}: link {name!r} has an inertia but no mass")
    if not np.all(np.abs(inertia) <= HUGE) or mass > HUGE:
        raise ArmError(f"{inertial.where}: link {name!r} has a mass or an inertia beyond {HUGE:g}")
    R = T[:3, :3]
    rotated = inertia if np.array_equal(R, np.eye(3)) else R @ inertia @ R.T
    return _Body(mass, T[:3, 3].copy(), rotated)


def _limits(joint: _Element, kind: str) -> Limits:
    limit = joint.one("limit")
    values: dict[str, float] = {}
    if limit is not None:
        for key in ("lower", "upper", "velocity", "effort"):
            text = limit.attributes.get(key, "").strip().lower()
            if not text:
                continue
            if text.lstrip("+-") in ("inf", "infinity"):
                values[key] = -math.inf if text.startswith("-") else math.inf
            else:
                values[key] = limit.number(key)
            if abs(values[key]) >= 1e300:
                values[key] = math.copysign(math.inf, values[key])
    for key in ("velocity", "effort"):
        # exporters write 0 for "unknown"; a joint that may never move or push would not be a joint
        if values.get(key) == 0.0:
            del values[key]
    if kind == "continuous":
        values.pop("lower", None)
        values.pop("upper", None)
    elif "lower" in values or "upper" in values:
        # the URDF standard: a range with one end left out ends at 0
        values.setdefault("lower", 0.0)
        values.setdefault("upper", 0.0)
    try:
        return Limits(**values)
    except ArmError as e:
        place = limit.where if limit is not None else joint.where
        raise ArmError(f"{place}: joint {joint.named()!r}: {e}") from None


def _axis(joint: _Element) -> Array:
    element = joint.one("axis")
    axis = np.array((1.0, 0.0, 0.0) if element is None else element.numbers("xyz", 3, (1.0, 0.0, 0.0)))
    largest = float(np.max(np.abs(axis)))
    if largest == 0.0:
        raise ArmError(f"{joint.where}: joint {joint.named()!r} has the axis 0 0 0")
    length = float(np.linalg.norm(axis / largest)) * largest
    return axis if abs(length - 1.0) < 1e-12 else axis / largest / float(np.linalg.norm(axis / largest))


def _colours(robot: _Element) -> dict[str, tuple[float, ...]]:
    """rgba of every material that defines a colour, by name."""
    found: dict[str, tuple[float, ...]] = {}
    visuals = [v for link in robot.all("link") for v in link.all("visual")]
    for material in [*robot.all("material"), *(m for v in visuals for m in v.all("material"))]:
        colour = material.one("color")
        if colour is not None and "name" in material.attributes:
            found.setdefault(material.attributes["name"], colour.numbers("rgba", 4))
    return found


def _shape(visual: _Element, link: int, T: Array, colours: Mapping[str, tuple[float, ...]]) -> Shape:
    geometry = visual.need("geometry")
    if len(geometry.children) != 1:
        raise ArmError(f"{geometry.where}: <geometry> must hold one shape, got {len(geometry.children)}")
    g = geometry.children[0]
    filename = None
    kind: Any = g.tag
    if kind == "box":
        size = g.numbers("size", 3)
    elif kind == "sphere":
        size = g.numbers("radius", 1)
    elif kind in ("cylinder", "capsule"):
        size = (g.number("radius"), g.number("length"))
    elif kind == "mesh":
        size = g.numbers("scale", 3, (1.0, 1.0, 1.0))
        filename = g.named("filename")
    else:
        known = ("box", "cylinder", "sphere", "capsule", "mesh")
        raise ArmError(f"{g.where}: unknown shape <{kind}>; {suggest(kind, known, 'known')}")
    rgba: tuple[float, ...] = (0.6, 0.6, 0.6, 1.0)
    material = visual.one("material")
    if material is not None:
        colour = material.one("color")
        rgba = colour.numbers("rgba", 4) if colour else colours.get(material.attributes.get("name", ""), rgba)
    try:
        return Shape(kind, size, T @ _transform(visual.one("origin")), link, rgba, filename)  # type: ignore[arg-type]
    except ArmError as e:
        raise ArmError(f"{visual.where}: {e}") from None


@dataclass(slots=True)
class _Tree:
    """Links and joints of a URDF by name, checked to be a forest."""

    name: str
    links: dict[str, _Element] = field(default_factory=dict)
    joints: dict[str, _Element] = field(default_factory=dict)
    up: dict[str, str] = field(default_factory=dict)
    """child link -> the joint that carries it"""
    down: dict[str, list[str]] = field(default_factory=dict)
    """parent link -> its joints"""

    @classmethod
    def of(cls, robot: _Element, file: str) -> _Tree:
        tree = cls(file)
        for element in robot.all("link"):
            name = element.named()
            if name in tree.links:
                raise ArmError(f"{element.where}: link {name!r} is defined twice")
            tree.links[name] = element
            tree.down[name] = []
        if not tree.links:
            raise ArmError(f"{robot.where}: the robot has no <link>")
        for element in robot.all("joint"):
            name = element.named()
            if name in tree.joints:
                raise ArmError(f"{element.where}: joint {name!r} is defined twice")
            kind = element.named("type")
            if kind not in _KINDS:
                raise ArmError(
                    f"{element.where}: joint {name!r} has the unknown type {kind!r}; "
                    f"{suggest(kind, _KINDS, 'known')}"
                )
            ends = [element.need(end).named("link") for end in ("parent", "child")]
            for end in ends:
                if end not in tree.links:
                    raise ArmError(
                        f"{element.where}: joint {name!r}: no link {end!r}; "
                        f"{suggest(end, tree.links, 'links')}"
                    )
            parent, child = ends
            if child in tree.up:
                raise ArmError(
                    f"{element.where}: link {child!r} is the child of both {tree.up[child]!r} and {name!r}"
                )
            tree.joints[name] = element
            tree.up[child] = name
            tree.down[parent].append(name)
        return tree

    def parent(self, joint: str) -> str:
        return self.joints[joint].need("parent").named("link")

    def child(self, joint: str) -> str:
        return self.joints[joint].need("child").named("link")

    def kind(self, joint: str) -> str:
        return self.joints[joint].named("type")

    def check(self, link: str, what: str) -> str:
        if link not in self.links:
            raise ArmError(f"{self.name}: no {what} link {link!r}; {suggest(link, self.links, 'links')}")
        return link

    def root(self) -> str:
        roots = [name for name in self.links if name not in self.up]
        if len(roots) != 1:
            found = (
                f"{len(roots)} root links ({', '.join(roots[:10])})"
                if roots
                else "no root link: its joints form a loop"
            )
            raise ArmError(f"{self.name}: the robot has {found}; name one with base=")
        return roots[0]

    def path(self, base: str, tip: str) -> list[str]:
        """Joints from base to tip."""
        joints: list[str] = []
        link = tip
        while link != base:
            if link not in self.up or len(joints) > len(self.joints):
                raise ArmError(f"{self.name}: the tip {tip!r} does not hang on the base {base!r}")
            joints.append(self.up[link])
            link = self.parent(joints[-1])
        return joints[::-1]

    def tip(self, base: str) -> str:
        """The leaf below base with the most moving joints on the way."""
        leaves: list[tuple[int, str]] = []
        stack = [(base, 0)]
        seen = 0
        while stack:
            link, moving = stack.pop()
            seen += 1
            if seen > len(self.links):
                raise ArmError(f"{self.name}: the joints below {base!r} form a loop")
            if not self.down[link]:
                leaves.append((moving, link))
            stack += [(self.child(j), moving + (self.kind(j) in _MOVING)) for j in self.down[link]]
        most = max(moving for moving, _ in leaves)
        best = sorted(link for moving, link in leaves if moving == most)
        if len(best) > 1:
            raise ArmError(
                f"{self.name}: {len(best)} chains of {most} moving joints start at {base!r}; "
                "name one with tip=: " + ", ".join(best[:20]) + (", ..." if len(best) > 20 else "")
            )
        return best[0]


# --- palpate's own element ----------------------------------------------------------------------------------


@dataclass(slots=True)
class _Extra:
    """What the <palpate> element says; all empty without one."""

    base: str | None = None
    tip: str | None = None
    gravity: tuple[float, ...] | None = None
    grasp: tuple[float, ...] | None = None
    effort: Effort | None = None
    joints: dict[str, _Element] = field(default_factory=dict)
    provenance: dict[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, robot: _Element, tree: _Tree) -> _Extra:
        element = robot.one("palpate")
        extra = cls()
        if element is None:
            return extra
        element.only(("version", "base", "tip", "gravity", "grasp"), ("effort", "joint", "provenance"))
        if element.get("version").strip() != "1":
            raise ArmError(f"{element.where}: <palpate> version must be 1, got {element.get('version')!r}")
        for end in ("base", "tip"):
            if end in element.attributes:
                setattr(extra, end, tree.check(element.named(end), end))
        for vector in ("gravity", "grasp"):
            if vector in element.attributes:
                setattr(extra, vector, element.numbers(vector, 3))
        effort = element.one("effort")
        if effort is not None:
            effort.only(("kind", "k_t", "gear", "pole_pairs", "angle_offset"))
            kind: Any = effort.named("kind")
            try:
                extra.effort = Effort(
                    kind,
                    effort.numbers("k_t", None, (1.0,)),
                    effort.numbers("gear", None, (1.0,)),
                    effort.numbers("pole_pairs", None, (0.0,)),
                    effort.numbers("angle_offset", None, (0.0,)),
                )
            except ArmError as e:
                raise ArmError(f"{effort.where}: {e}") from None
        for joint in element.all("joint"):
            joint.only(("name", "rotor_inertia"), ("friction", "sensing"))
            name = joint.named()
            if name not in tree.joints:
                raise ArmError(f"{joint.where}: no joint {name!r}; {suggest(name, tree.joints, 'joints')}")
            if name in extra.joints:
                raise ArmError(f"{joint.where}: joint {name!r} is described twice")
            extra.joints[name] = joint
        for note in element.all("provenance"):
            note.only(("key",))
            extra.provenance[note.named("key")] = " ".join("".join(note.text).split())
        return extra

    def friction(self, joint: _Element) -> Friction:
        dynamics = joint.one("dynamics")
        values: dict[str, float] = {}
        if dynamics is not None:
            values = {"viscous": dynamics.number("damping", 0.0), "coulomb": dynamics.number("friction", 0.0)}
        more = self.part(joint, "friction")
        if more is not None:
            keys = ("offset", "static", "stribeck_velocity", "load", "sign_velocity", "presliding")
            more.only(keys)
            values |= {k: more.number(k) for k in keys if k in more.attributes}
        try:
            return Friction(**values)
        except ArmError as e:
            raise ArmError(f"{(dynamics or more or joint).where}: joint {joint.named()!r}: {e}") from None

    def sensing(self, joint: _Element) -> Sensing:
        element = self.part(joint, "sensing")
        if element is None:
            return Sensing()
        keys = tuple(Sensing.__dataclass_fields__)
        element.only(keys)
        try:
            return Sensing(**{k: element.number(k) for k in keys if k in element.attributes})
        except ArmError as e:
            raise ArmError(f"{element.where}: joint {joint.named()!r}: {e}") from None

    def rotor_inertia(self, joint: _Element) -> float:
        element = self.joints.get(joint.named())
        return 0.0 if element is None else element.number("rotor_inertia", 0.0)

    def part(self, joint: _Element, tag: str) -> _Element | None:
        element = self.joints.get(joint.named())
        return None if element is None else element.one(tag)


# --- in -----------------------------------------------------------------------------------------------------


def read_urdf(
    source: str | os.PathLike[str],
    *,
    base: str | None,
    tip: str | None,
    effort: Effort | None,
    gravity: Any,
    grasp: Any,
    xacro_args: Mapping[str, str] | None,
    inertials: bool,
    repair_inertia: bool,
) -> Arm:
    """See :meth:`palpate.Arm.from_urdf`."""
    robot, file = _load(source, xacro_args)
    where = file or "URDF text"
    if robot.tag != "robot":
        raise ArmError(f"{robot.where}: the root element must be <robot>, got <{robot.tag}>")
    tree = _Tree.of(robot, where)
    extra = _Extra.of(robot, tree)
    base = tree.check(base, "base") if base is not None else extra.base or tree.root()
    tip = tree.check(tip, "tip") if tip is not None else extra.tip or tree.tip(base)
    if gravity is None and extra.gravity is not None:
        if extra.base is not None and extra.base != base:
            raise ArmError(
                f"{where}: the file states gravity for the base {extra.base!r}; give gravity= for {base!r}"
            )
        gravity = extra.gravity
    if grasp is None and extra.grasp is not None and extra.tip == tip:
        grasp = extra.grasp
    chain = tree.path(base, tip)
    moving = [name for name in chain if tree.kind(name) in _MOVING]
    for name in chain:
        joint = tree.joints[name]
        if tree.kind(name) in ("floating", "planar"):
            raise ArmError(
                f"{joint.where}: joint {name!r} between base and tip is {tree.kind(name)}, "
                f"which no fixed arm has; choose a base below it, e.g. base={tree.child(name)!r}"
            )
        if joint.one("mimic") is not None:
            raise ArmError(
                f"{joint.where}: joint {name!r} between base and tip mimics another joint: it is not free; "
                f"choose a tip before it, e.g. tip={tree.parent(name)!r}"
            )
    if not moving:
        raise ArmError(f"{where}: no moving joint between the base {base!r} and the tip {tip!r}")

    folded = _fold(robot, tree, base, moving)
    joints = []
    repaired: list[str] = []
    at = np.eye(4)  # in the frame of the last moving link (or the base)
    index = -1
    for name in chain:
        joint = tree.joints[name]
        at = at @ _transform(joint.one("origin"))
        if name not in moving:
            continue
        index += 1
        body = _Body(0.0, np.zeros(3), np.zeros((3, 3)))
        if inertials:
            body = _link_body(tree, tree.child(name), folded.bodies[index], repair_inertia, repaired)
        kind = tree.kind(name)
        try:
            joints.append(
                Joint(
                    name=name,
                    link=tree.child(name),
                    kind="prismatic" if kind == "prismatic" else "revolute",
                    T_parent_joint=at,
                    axis=_axis(joint),
                    mass=body.mass,
                    com=body.com,
                    inertia=body.inertia,
                    rotor_inertia=extra.rotor_inertia(joint),
                    friction=extra.friction(joint),
                    limits=_limits(joint, kind),
                    sensing=extra.sensing(joint),
                )
            )
        except ArmError as e:
            raise e if str(e).startswith(where) else ArmError(f"{joint.where}: {e}") from None
        at = np.eye(4)

    provenance = dict(extra.provenance)
    if file is not None:
        provenance["file"] = file
    for key, names in (
        ("held at zero", folded.held),
        ("left out, not rigidly carried", folded.dropped),
        ("inertia repaired", repaired),
    ):
        if names:
            provenance[key] = ", ".join(names)
    try:
        return Arm(
            name=robot.attributes.get("name", "").strip() or "arm",
            joints=tuple(joints),
            T_last_tip=at,
            effort=effort or extra.effort or Effort.undeclared(),
            shapes=tuple(folded.shapes),
            base=base,
            tip=tip,
            frames=folded.frames,
            provenance=provenance,
            **({} if gravity is None else {"gravity": gravity}),
            **({} if grasp is None else {"grasp": grasp}),
        )
    except ArmError as e:
        raise ArmError(f"{where}: {e}") from None


@dataclass(slots=True)
class _Folded:
    """Everything below the base, by the moving link that carries it."""

    bodies: list[list[tuple[str, _Body]]]
    shapes: list[Shape] = field(default_factory=list)
    frames: dict[str, tuple[int, Array]] = field(default_factory=dict)
    held: list[str] = field(default_factory=list)
    """moving joints off the chain"""
    dropped: list[str] = field(default_factory=list)
    """floating and planar joints off the chain"""


def _fold(robot: _Element, tree: _Tree, base: str, moving: list[str]) -> _Folded:
    """Walk down from the base; what the chain's joints do not move is rigid with its carrier."""
    colours = _colours(robot)
    folded = _Folded([[] for _ in moving])
    order = {name: i for i, name in enumerate(moving)}
    stack: list[tuple[str, int, Array]] = [(base, -1, np.eye(4))]
    while stack:
        link, index, T = stack.pop()
        if link in folded.frames:
            raise ArmError(f"{tree.name}: the joints below {base!r} form a loop through {link!r}")
        folded.frames[link] = (index, T)
        element = tree.links[link]
        body = _body(element)
        if body is not None and index >= 0:
            folded.bodies[index].append((link, body if np.array_equal(T, np.eye(4)) else body.moved(T)))
        folded.shapes += [_shape(v, index, T, colours) for v in element.all("visual")]
        below: list[tuple[str, int, Array]] = []
        for name in tree.down[link]:
            kind = tree.kind(name)
            if name in order:
                below.append((tree.child(name), order[name], np.eye(4)))
            elif kind in ("floating", "planar"):
                folded.dropped.append(name)
            else:
                if kind in _MOVING:
                    folded.held.append(name)
                below.append((tree.child(name), index, T @ _transform(tree.joints[name].one("origin"))))
        stack += reversed(below)
    return folded


def _link_body(
    tree: _Tree, link: str, bodies: list[tuple[str, _Body]], repair: bool, repaired: list[str]
) -> _Body:
    """The lumped body of one moving link, every part of it checked."""
    parts = []
    for name, body in bodies:
        own = name == link
        # a fixed part may be a point mass; what moves needs a full inertia, of its own or from its parts
        complaint = (
            None if body.mass == 0.0 else inertia_complaint(body.inertia, definite=own and len(bodies) == 1)
        )
        if complaint is not None:
            if not repair:
                raise ArmError(
                    f"{tree.links[name].where}: link {name!r} with mass {body.mass:g} kg: {complaint}; "
                    "correct the file, or read it with repair_inertia=True"
                )
            body = _Body(body.mass, body.com, _possible(body.inertia, body.mass))
            repaired.append(name)
        parts.append(body)
    lumped = _lump(parts)
    if lumped.mass == 0.0:
        why = "has a mass of 0" if any(name == link for name, _ in bodies) else "has no <inertial>"
        raise ArmError(
            f"{tree.links[link].where}: link {link!r} is moved by joint {tree.up[link]!r} but {why}, "
            "nor does anything fixed to it have mass; add an <inertial>, or read the file with inertials=False "
            "(kinematics only)"
        )
    return lumped


# --- out ----------------------------------------------------------------------------------------------------

_UNPRINTABLE = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def _quoted(text: str) -> str:
    if _UNPRINTABLE.search(text):
        raise ArmError(f"{text!r} holds characters that XML cannot")
    return quoteattr(text)


def _words(values: Iterable[float]) -> str:
    return " ".join(repr(float(v)) for v in values)


def _origin(T: Array, indent: str) -> list[str]:
    if np.array_equal(T, np.eye(4)):
        return []
    return [f'{indent}<origin xyz="{_words(T[:3, 3])}" rpy="{_words(_rpy(T[:3, :3]))}"/>']


def write_urdf(arm: Arm) -> str:
    """See :meth:`palpate.Arm.to_urdf`."""
    links = [j.link for j in arm.joints]
    frames = {k: v for k, v in arm.frames.items() if k != arm.base and k not in links}
    lines = ['<?xml version="1.0"?>', f"<robot name={_quoted(arm.name)}>"]
    for index, name in enumerate([arm.base, *links], start=-1):
        lines.append(f"  <link name={_quoted(name)}>")
        if index >= 0 and arm.has_dynamics:
            lines += _inertial_lines(arm.joints[index])
        for shape in arm.shapes:
            if shape.link == index:
                lines += _visual_lines(shape)
        lines.append("  </link>")
    lines += [f"  <link name={_quoted(name)}/>" for name in frames]
    for i, joint in enumerate(arm.joints):
        lines += _joint_lines(joint, arm.base if i == 0 else links[i - 1])
    taken = set(arm.joint_names)
    for name, (index, T) in frames.items():
        label = f"{name}_fixed"
        while label in taken:
            label += "_"
        taken.add(label)
        lines += [
            f'  <joint name={_quoted(label)} type="fixed">',
            *_origin(T, "    "),
            f"    <parent link={_quoted(links[index] if index >= 0 else arm.base)}/>",
            f"    <child link={_quoted(name)}/>",
            "  </joint>",
        ]
    return "\n".join([*lines, *_extra_lines(arm), "</robot>", ""])


def _inertial_lines(joint: Joint) -> list[str]:
    inertia = joint.inertia
    pairs = (("ixx", 0, 0), ("ixy", 0, 1), ("ixz", 0, 2), ("iyy", 1, 1), ("iyz", 1, 2), ("izz", 2, 2))
    return [
        "    <inertial>",
        f'      <origin xyz="{_words(joint.com)}"/>',
        f'      <mass value="{joint.mass!r}"/>',
        "      <inertia " + " ".join(f'{k}="{float(inertia[i, j])!r}"' for k, i, j in pairs) + "/>",
        "    </inertial>",
    ]


def _visual_lines(shape: Shape) -> list[str]:
    if shape.kind == "box":
        geometry = f'<box size="{_words(shape.size)}"/>'
    elif shape.kind == "sphere":
        geometry = f'<sphere radius="{shape.size[0]!r}"/>'
    elif shape.kind == "mesh":
        geometry = f'<mesh filename={_quoted(shape.filename or "")} scale="{_words(shape.size)}"/>'
    else:
        geometry = f'<{shape.kind} radius="{shape.size[0]!r}" length="{shape.size[1]!r}"/>'
    return [
        "    <visual>",
        *_origin(shape.T, "      "),
        f"      <geometry>{geometry}</geometry>",
        f'      <material name=""><color rgba="{_words(shape.rgba)}"/></material>',
        "    </visual>",
    ]


def _joint_lines(joint: Joint, parent: str) -> list[str]:
    limits = joint.limits
    endless = joint.kind == "revolute" and limits.lower == -math.inf and limits.upper == math.inf
    values = {"effort": limits.effort, "velocity": limits.velocity}
    if not endless:
        values = {"lower": limits.lower, "upper": limits.upper, **values}
    bounded = {k: math.copysign(_UNLIMITED, v) if math.isinf(v) else v for k, v in values.items()}
    friction = joint.friction
    lines = [
        f'  <joint name={_quoted(joint.name)} type="{"continuous" if endless else joint.kind}">',
        *_origin(joint.T_parent_joint, "    "),
        f"    <parent link={_quoted(parent)}/>",
        f"    <child link={_quoted(joint.link)}/>",
        f'    <axis xyz="{_words(joint.axis)}"/>',
        "    <limit " + " ".join(f'{k}="{v!r}"' for k, v in bounded.items()) + "/>",
    ]
    if friction.viscous or friction.coulomb:
        lines.append(f'    <dynamics damping="{friction.viscous!r}" friction="{friction.coulomb!r}"/>')
    return [*lines, "  </joint>"]


def _extra_lines(arm: Arm) -> list[str]:
    lines = [
        f'  <palpate version="1" base={_quoted(arm.base)} tip={_quoted(arm.tip)} '
        f'gravity="{_words(arm.gravity)}" grasp="{_words(arm.grasp)}">'
    ]
    if arm.effort.kind == "current":
        lines.append(
            f'    <effort kind="current" k_t="{_words(arm.effort.k_t)}" gear="{_words(arm.effort.gear)}"/>'
        )
    elif arm.effort.kind == "phase_currents":
        names = ("k_t", "gear", "pole_pairs", "angle_offset")
        words = " ".join(f'{name}="{_words(getattr(arm.effort, name))}"' for name in names)
        lines.append(f'    <effort kind="phase_currents" {words}/>')
    elif arm.effort.kind == "torque":
        lines.append('    <effort kind="torque"/>')
    for joint in arm.joints:
        parts = []
        for tag, value, default, keys in (
            (
                "friction",
                joint.friction,
                Friction(),
                ("offset", "static", "stribeck_velocity", "load", "sign_velocity", "presliding"),
            ),
            ("sensing", joint.sensing, Sensing(), Sensing.__dataclass_fields__),
        ):
            set_keys = [k for k in keys if getattr(value, k) != getattr(default, k)]
            if set_keys:
                parts.append(
                    f"      <{tag} " + " ".join(f'{k}="{getattr(value, k)!r}"' for k in set_keys) + "/>"
                )
        rotor = f' rotor_inertia="{joint.rotor_inertia!r}"' if joint.rotor_inertia else ""
        if parts or rotor:
            lines += [f"    <joint name={_quoted(joint.name)}{rotor}>", *parts, "    </joint>"]
    for key, text in arm.provenance.items():
        if _UNPRINTABLE.search(text):
            raise ArmError(f"provenance {key!r} holds characters that XML cannot")
        lines.append(f"    <provenance key={_quoted(key)}>{escape(text)}</provenance>")
    return [*lines, "  </palpate>"]
