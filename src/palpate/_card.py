"""Cards: an arm as a YAML file a person can read and edit (see ``Arm.from_card`` and ``Arm.save``).

Units are in the key names; for a prismatic joint read m for rad and N for N m. Numbers are written with as
many digits as it takes to read the same double back. Placements are 3x4 rows [R | p]: no angles, no loss.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterable, Mapping
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args

import numpy as np

from .arm import Arm, Array, Effort, Friction, Joint, Limits, Sensing, Shape
from .errors import ArmError, MissingExtraError, PalpateError, suggest

try:
    import yaml
    from pydantic import BaseModel, ConfigDict, Field, ValidationError
except ImportError:
    raise MissingExtraError("card", "reading or writing an arm's card") from None

_MAX_BYTES = 4 * 2**20
_MAX_DEPTH = 16
_YAML_WORDS = {"null", "true", "false", "yes", "no", "on", "off", "y", "n"}
"""other YAML readers take these for something else than text"""

_File = TypeVar("_File", bound=BaseModel)
_Finite = Annotated[float, Field(allow_inf_nan=False)]
_Vector = tuple[_Finite, _Finite, _Finite]
_Row = tuple[_Finite, _Finite, _Finite, _Finite]
_Placement = tuple[_Row, _Row, _Row]


# --- schema -------------------------------------------------------------------------------------------------


class Strict(BaseModel):
    """A mapping of a file: no key that it does not know."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class _Inertia(Strict):
    xx: _Finite
    yy: _Finite
    zz: _Finite
    xy: _Finite = 0.0
    xz: _Finite = 0.0
    yz: _Finite = 0.0


class _Friction(Strict):
    coulomb_Nm: _Finite = 0.0
    viscous_Nms_rad: _Finite = 0.0
    offset_Nm: _Finite = 0.0
    static_Nm: _Finite | None = None
    stribeck_velocity_rad_s: _Finite | None = None
    load: _Finite = 0.0
    sign_velocity_rad_s: _Finite = Friction().sign_velocity
    presliding_rad: _Finite = 0.0


class _Limits(Strict):
    lower_rad: float = -math.inf
    upper_rad: float = math.inf
    velocity_rad_s: float = math.inf
    effort_Nm: float = math.inf


class _Sensing(Strict):
    position_resolution_rad: _Finite = 0.0
    position_std_rad: _Finite = 0.0
    velocity_std_rad_s: _Finite | None = None
    torque_resolution_Nm: _Finite = 0.0
    torque_std_Nm: _Finite = 0.0
    torque_gain_std: _Finite = 0.0


class _Joint(Strict):
    name: str
    link: str
    kind: Literal["revolute", "prismatic"] = "revolute"
    T_parent_joint_m: _Placement
    axis: _Vector
    mass_kg: _Finite = 0.0
    com_m: _Vector = (0.0, 0.0, 0.0)
    inertia_kg_m2: _Inertia = _Inertia(xx=0.0, yy=0.0, zz=0.0)
    rotor_inertia_kg_m2: _Finite = 0.0
    friction: _Friction = _Friction()
    limits: _Limits = _Limits()
    sensing: _Sensing = _Sensing()


class _Effort(Strict):
    kind: Literal["torque", "current", "phase_currents", "undeclared"]
    k_t_Nm_A: tuple[_Finite, ...] = (1.0,)
    gear: tuple[_Finite, ...] = (1.0,)
    pole_pairs: tuple[_Finite, ...] = (0.0,)
    angle_offset_rad: tuple[_Finite, ...] = (0.0,)


class _Shape(Strict):
    kind: Literal["box", "cylinder", "sphere", "capsule", "mesh"]
    link: str
    size_m: tuple[_Finite, ...]
    T_link_shape_m: _Placement
    rgba: _Row
    filename: str | None = None


class _Frame(Strict):
    link: str
    T_link_frame_m: _Placement


class _Card(Strict):
    palpate_card: Literal[1]
    written: dict[str, str] = {}
    name: str
    base: str = "base"
    tip: str = "tip"
    gravity_m_s2: _Vector
    T_last_tip_m: _Placement = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0))
    grasp_m: _Vector = (0.0, 0.0, 0.0)
    effort: _Effort = _Effort(kind="undeclared")
    provenance: dict[str, str] = {}
    joints: tuple[_Joint, ...]
    frames: dict[str, _Frame] = {}
    shapes: tuple[_Shape, ...] = ()


# --- in -----------------------------------------------------------------------------------------------------


class _Loader(yaml.SafeLoader):
    """YAML without its traps: aliases, duplicate keys, bare dates, octals, base-60 numbers, yes/no."""

    depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise yaml.MarkedYAMLError(
                problem="aliases are not allowed", problem_mark=self.peek_event().start_mark
            )
        if self.depth >= _MAX_DEPTH:
            mark = self.peek_event().start_mark
            raise yaml.MarkedYAMLError(problem=f"nested deeper than {_MAX_DEPTH}", problem_mark=mark)
        self.depth += 1
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node

    def construct_mapping(self, node: Any, deep: bool = False) -> Any:
        seen = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise yaml.MarkedYAMLError(problem="a key must be plain text", problem_mark=key.start_mark)
            if key.value in seen:
                raise yaml.MarkedYAMLError(
                    problem=f"key {key.value!r} appears twice", problem_mark=key.start_mark
                )
            seen.add(key.value)
        return super().construct_mapping(node, deep=deep)


def _number(loader: _Loader, node: Any) -> int | float:
    text = str(loader.construct_scalar(node)).lower()
    if re.fullmatch(r"[-+]?[0-9]{1,18}", text):
        return int(text)
    return float(text.replace(".inf", "inf").replace(".nan", "nan"))


_Loader.yaml_implicit_resolvers = {}
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(
        r"[-+]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][-+]?[0-9]+)?$|[-+]?\.(?:inf|Inf|INF)$|\.(?:nan|NaN|NAN)$"
    ),
    list("-+.0123456789"),
)
_Loader.add_implicit_resolver("tag:yaml.org,2002:null", re.compile(r"(?:~|null|)$"), ["~", "n", ""])
_Loader.add_constructor("tag:yaml.org,2002:float", _number)


def read_card(path: str | os.PathLike[str]) -> Arm:
    """See :meth:`palpate.Arm.from_card`."""
    name, card = read_yaml(path, _Card, "card", ArmError)
    try:
        return _to_arm(card)
    except ArmError as e:
        raise ArmError(f"{name}: {e}") from None


def read_yaml(
    path: str | os.PathLike[str], schema: type[_File], what: str, error: type[PalpateError]
) -> tuple[str, _File]:
    """The name of a file and its content, checked; a ``palpate_<what>: 1`` in it says what it is.

    Raises:
        PalpateError: as `error`: it cannot be read, is no such file, or a field is wrong; the message names the place.
    """
    try:
        file = Path(path)
        name = file.name
        with file.open("rb") as stream:
            data = stream.read(_MAX_BYTES + 1)
    except (OSError, TypeError, ValueError) as e:
        reason = e.strerror if isinstance(e, OSError) and e.strerror else str(e)
        raise error(f"cannot read the {what} {str(path)!r:.200}: {reason}") from None
    if len(data) > _MAX_BYTES:
        raise error(f"{name}: larger than {_MAX_BYTES // 2**20} MiB, which no {what} is")
    try:
        content = yaml.load(data, _Loader)
    except yaml.MarkedYAMLError as e:
        place = f"{name}:{e.problem_mark.line + 1}" if e.problem_mark else name
        raise error(f"{place}: malformed YAML: {e.problem}") from None
    except (yaml.YAMLError, ValueError, RecursionError) as e:
        raise error(f"{name}: malformed YAML: {' '.join(str(e).split())}") from None
    key = f"palpate_{what}"
    if not isinstance(content, dict) or key not in content:
        raise error(f"{name}: not a palpate {what}: it must be a mapping with the key {key}: 1")
    if content[key] != 1:
        raise error(f"{name}: {key}: version must be 1, got {content[key]!r:.40}; update palpate?")
    try:
        return name, schema.model_validate(content)
    except ValidationError as e:
        raise error(f"{name}: {_explain(e, schema)}") from None


def _explain(error: ValidationError, schema: type[BaseModel]) -> str:
    """The first complaint, with its path: ``joints[2].friction.viscous: unknown key; did you mean ...?``"""
    first = error.errors(include_url=False)[0]
    path = ""
    for step in first["loc"]:
        path += f"[{step}]" if isinstance(step, int) else f"{'.' if path else ''}{step}"
    more = error.error_count() - 1
    tail = f" (and {more} more)" if more else ""
    if first["type"] == "extra_forbidden":
        known = _keys_at(first["loc"][:-1], schema)
        return f"{path}: unknown key; {suggest(str(first['loc'][-1]), known, 'known keys')}{tail}"
    got = "" if first["type"] == "missing" else f", got {first['input']!r:.60}"
    return f"{path}: {first['msg'][0].lower()}{first['msg'][1:]}{got}{tail}"


def _keys_at(location: Iterable[int | str], schema: type[BaseModel]) -> list[str]:
    """The keys the schema knows at a place in the file."""
    model = schema
    for step in location:
        if isinstance(step, str) and step in model.model_fields:
            model = _model_in(model.model_fields[step].annotation) or model
    return list(model.model_fields)


def _model_in(annotation: Any) -> type[BaseModel] | None:
    """The model a field holds: itself, or in a list or mapping."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next((m for a in get_args(annotation) if (m := _model_in(a)) is not None), None)


def _matrix(rows: _Placement) -> Array:
    return np.array([*rows, (0.0, 0.0, 0.0, 1.0)])


def _to_arm(card: _Card) -> Arm:
    index = {card.base: -1} | {j.link: i for i, j in enumerate(card.joints)}

    def link(name: str, what: str) -> int:
        if name not in index:
            raise ArmError(f"{what}: no link {name!r}; {suggest(name, index, 'links')}")
        return index[name]

    joints = []
    for i, j in enumerate(card.joints):
        t, f, x, s = j.inertia_kg_m2, j.friction, j.limits, j.sensing
        try:
            joints.append(
                Joint(
                    name=j.name,
                    link=j.link,
                    kind=j.kind,
                    T_parent_joint=_matrix(j.T_parent_joint_m),
                    axis=np.array(j.axis),
                    mass=j.mass_kg,
                    com=np.array(j.com_m),
                    inertia=np.array([[t.xx, t.xy, t.xz], [t.xy, t.yy, t.yz], [t.xz, t.yz, t.zz]]),
                    rotor_inertia=j.rotor_inertia_kg_m2,
                    friction=Friction(
                        coulomb=f.coulomb_Nm,
                        viscous=f.viscous_Nms_rad,
                        offset=f.offset_Nm,
                        static=f.static_Nm,
                        stribeck_velocity=f.stribeck_velocity_rad_s,
                        load=f.load,
                        sign_velocity=f.sign_velocity_rad_s,
                        presliding=f.presliding_rad,
                    ),
                    limits=Limits(x.lower_rad, x.upper_rad, x.velocity_rad_s, x.effort_Nm),
                    sensing=Sensing(
                        position_resolution=s.position_resolution_rad,
                        position_std=s.position_std_rad,
                        velocity_std=s.velocity_std_rad_s,
                        torque_resolution=s.torque_resolution_Nm,
                        torque_std=s.torque_std_Nm,
                        torque_gain_std=s.torque_gain_std,
                    ),
                )
            )
        except ArmError as e:
            raise ArmError(f"joints[{i}]: {e}") from None
    return Arm(
        name=card.name,
        joints=tuple(joints),
        gravity=np.array(card.gravity_m_s2),
        T_last_tip=_matrix(card.T_last_tip_m),
        grasp=np.array(card.grasp_m),
        effort=Effort(
            card.effort.kind,
            card.effort.k_t_Nm_A,
            card.effort.gear,
            card.effort.pole_pairs,
            card.effort.angle_offset_rad,
        ),
        shapes=tuple(
            Shape(
                kind=s.kind,
                size=s.size_m,
                T=_matrix(s.T_link_shape_m),
                link=link(s.link, f"shapes[{i}].link"),
                rgba=s.rgba,
                filename=s.filename,
            )
            for i, s in enumerate(card.shapes)
        ),
        base=card.base,
        tip=card.tip,
        frames={
            k: (link(f.link, f"frames.{k}.link"), _matrix(f.T_link_frame_m)) for k, f in card.frames.items()
        },
        provenance=card.provenance,
    )


# --- out ----------------------------------------------------------------------------------------------------


def _scalar(value: Any) -> str:
    if value is None:
        return "null"
    if isinstance(value, str):
        if re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", value) and value.lower() not in _YAML_WORDS:
            return value
        # a double-quoted, escaped scalar on one line reads back as it was, whatever it holds
        quoted: str = yaml.dump(value, default_style='"', width=math.inf, allow_unicode=True)
        return quoted.strip()
    if isinstance(value, float):
        text = repr(value).replace("inf", ".inf")
        # YAML 1.1 takes 1e-05 for text: other readers need the point
        return text if "." in text else text.replace("e", ".0e")
    return str(value)


def _flow(value: Any) -> str:
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_flow, value)) + "]"
    return _scalar(value)


def _rows(T: Array) -> list[list[float]]:
    return [[float(x) for x in row] for row in T[:3]]


def _lines(value: Any, indent: str) -> list[str]:
    """Block YAML of mappings; lists of mappings as items, matrices one row a line, other lists in flow style."""
    lines = []
    for key, item in value.items():
        head = f"{indent}{_scalar(key)}:"
        if isinstance(item, Mapping):
            lines += [head, *_lines(item, indent + "  ")] if item else [f"{head} {{}}"]
        elif isinstance(item, list) and item and isinstance(item[0], Mapping):
            lines.append(head)
            for entry in item:
                first, *rest = _lines(entry, indent + "    ")
                lines += [f"{indent}  - {first.lstrip()}", *rest]
        elif isinstance(item, list) and item and isinstance(item[0], list):
            lines += [head, *(f"{indent}  - {_flow(row)}" for row in item)]
        else:
            lines.append(f"{head} {_flow(item)}")
    return lines


def _differing(model: Strict) -> dict[str, Any]:
    """The fields that differ from the schema's default, as plain data."""
    return {
        k: list(v) if isinstance(v, tuple) else v
        for k in type(model).model_fields
        if not _same(v := getattr(model, k), type(model).model_fields[k].default)
    }


def _same(a: Any, b: Any) -> bool:
    # -0.0 equals 0.0 but is not the same to the bit
    return bool(a == b) and (not isinstance(a, float) or math.copysign(1.0, a) == math.copysign(1.0, b))


def _joint(joint: Joint) -> dict[str, Any]:
    f, x, s, inertia = joint.friction, joint.limits, joint.sensing, joint.inertia
    parts: dict[str, Any] = {
        "name": joint.name,
        "link": joint.link,
        "kind": joint.kind,
        "T_parent_joint_m": _rows(joint.T_parent_joint),
        "axis": joint.axis.tolist(),
    }
    if joint.mass > 0.0:
        pairs = (("xx", 0, 0), ("yy", 1, 1), ("zz", 2, 2), ("xy", 0, 1), ("xz", 0, 2), ("yz", 1, 2))
        parts["mass_kg"] = joint.mass
        parts["com_m"] = joint.com.tolist()
        parts["inertia_kg_m2"] = {k: float(inertia[i, j]) for k, i, j in pairs}
    parts["rotor_inertia_kg_m2"] = joint.rotor_inertia
    parts["friction"] = _differing(
        _Friction(
            coulomb_Nm=f.coulomb,
            viscous_Nms_rad=f.viscous,
            offset_Nm=f.offset,
            static_Nm=f.static,
            stribeck_velocity_rad_s=f.stribeck_velocity,
            load=f.load,
            sign_velocity_rad_s=f.sign_velocity,
            presliding_rad=f.presliding,
        )
    )
    parts["limits"] = _differing(
        _Limits(lower_rad=x.lower, upper_rad=x.upper, velocity_rad_s=x.velocity, effort_Nm=x.effort)
    )
    parts["sensing"] = _differing(
        _Sensing(
            position_resolution_rad=s.position_resolution,
            position_std_rad=s.position_std,
            velocity_std_rad_s=s.velocity_std,
            torque_resolution_Nm=s.torque_resolution,
            torque_std_Nm=s.torque_std,
            torque_gain_std=s.torque_gain_std,
        )
    )
    return {k: v for k, v in parts.items() if v != {}}


def _version() -> str:
    try:
        return metadata.version("palpate")
    except metadata.PackageNotFoundError:
        return "unknown"


def write_card(arm: Arm, path: str | os.PathLike[str]) -> None:
    """See :meth:`palpate.Arm.save`."""
    links = [*(j.link for j in arm.joints), arm.base]  # index -1 is the base
    content: dict[str, Any] = {
        "palpate_card": 1,
        "written": {"palpate": _version()},
        "name": arm.name,
        "base": arm.base,
        "tip": arm.tip,
        "gravity_m_s2": arm.gravity.tolist(),
        "T_last_tip_m": _rows(arm.T_last_tip),
        "grasp_m": arm.grasp.tolist(),
        "effort": _differing(
            _Effort(
                kind=arm.effort.kind,
                k_t_Nm_A=arm.effort.k_t,
                gear=arm.effort.gear,
                pole_pairs=arm.effort.pole_pairs,
                angle_offset_rad=arm.effort.angle_offset,
            )
        ),
        "provenance": dict(arm.provenance),
        "joints": [_joint(j) for j in arm.joints],
        "frames": {
            k: {"link": links[i], "T_link_frame_m": _rows(T)}
            for k, (i, T) in arm.frames.items()
            if k not in (*links, arm.tip)
        },
        "shapes": [
            {
                "kind": s.kind,
                "link": links[s.link],
                "size_m": list(s.size),
                "T_link_shape_m": _rows(s.T),
                "rgba": list(s.rgba),
                **({"filename": s.filename} if s.filename is not None else {}),
            }
            for s in arm.shapes
        ],
    }
    text = "# palpate arm card. SI units as in the keys; for a prismatic joint read m for rad, N for Nm.\n"
    text += "\n".join(_lines(content, "")) + "\n"
    try:
        Path(path).write_text(text, encoding="utf-8")
    except (OSError, TypeError, ValueError) as e:
        reason = e.strerror if isinstance(e, OSError) and e.strerror else str(e)
        raise ArmError(f"cannot write the card {str(path)!r:.200}: {reason}") from None
