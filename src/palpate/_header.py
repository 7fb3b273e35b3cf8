"""An arm as a C++ header (used by :mod:`palpate.arm`; call ``Arm.to_header``)."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable

from .arm import Arm, Array, Joint
from .errors import ArmError

_KEYWORDS = frozenset(
    """
    alignas alignof and and_eq asm auto bitand bitor bool break case catch char char8_t char16_t
    char32_t class compl concept const consteval constexpr constinit const_cast continue co_await
    co_return co_yield decltype default delete do double dynamic_cast else enum explicit export extern
    false float for friend goto if inline int long mutable namespace new noexcept not not_eq nullptr
    operator or or_eq palpate private protected public register reinterpret_cast requires return short
    signed sizeof static static_assert static_cast std struct switch template this thread_local throw
    true try typedef typeid typename union unsigned using virtual void volatile wchar_t while xor xor_eq
    """.split()
)


def _number(value: float | None) -> str:
    """A double literal that reads back to the bit; None is NaN, the core's "not given"."""
    if value is None:
        return "std::numeric_limits<double>::quiet_NaN()"
    if math.isinf(value):
        return ("-" if value < 0.0 else "") + "std::numeric_limits<double>::infinity()"
    return repr(float(value))


def _list(values: Iterable[float]) -> str:
    return "{" + ", ".join(map(_number, values)) + "}"


def _placement(T: Array) -> str:
    return f"{{.R = {_list(T[:3, :3].ravel())}, .p = {_list(T[:3, 3])}}}"


def _joint(joint: Joint, gain: float) -> list[str]:
    f, x, s, inertia = joint.friction, joint.limits, joint.sensing, joint.inertia
    six = (inertia[0, 0], inertia[0, 1], inertia[0, 2], inertia[1, 1], inertia[1, 2], inertia[2, 2])
    friction = (
        ("coulomb", f.coulomb),
        ("viscous", f.viscous),
        ("offset", f.offset),
        ("static_", f.static),
        ("stribeck_velocity", f.stribeck_velocity),
        ("load", f.load),
        ("sign_velocity", f.sign_velocity),
        ("presliding", f.presliding),
    )
    fields = {
        "prismatic": "true" if joint.kind == "prismatic" else "false",
        "T_parent_joint": _placement(joint.T_parent_joint),
        "axis": _list(joint.axis),
        "mass": _number(joint.mass),
        "com": _list(joint.com),
        "inertia": _list(six),
        "rotor_inertia": _number(joint.rotor_inertia),
        "friction": "{" + ", ".join(f".{k} = {_number(v)}" for k, v in friction) + "}",
        "lower": _number(x.lower),
        "upper": _number(x.upper),
        "max_velocity": _number(x.velocity),
        "max_effort": _number(x.effort),
        "position_resolution": _number(s.position_resolution),
        "position_std": _number(s.position_std),
        "velocity_std": _number(s.velocity_std),
        "torque_resolution": _number(s.torque_resolution),
        "torque_std": _number(s.torque_std),
        "torque_gain_std": _number(s.torque_gain_std),
        "effort_gain": _number(gain),
    }
    # names go into comments, where a line break or a trailing backslash would end or extend the comment
    label = re.sub(r"[^\w .:/-]", "?", f"{joint.name} moves {joint.link}", flags=re.ASCII)
    return [f"        {{  // {label}", *(f"            .{k} = {v}," for k, v in fields.items()), "        },"]


def write_header(arm: Arm, name: str) -> str:
    """See :meth:`palpate.Arm.to_header`."""
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name) or "__" in name or name in _KEYWORDS:
        raise ArmError(f"{name!r} cannot name a C++ constant; give another, e.g. to_header(name='my_arm')")
    gains = arm.effort.gain(arm.n)
    lines = [
        "// Written by palpate (Arm.to_header). SI units; see palpate/arm.hpp for the fields.",
        "#pragma once",
        "#include <limits>",
        "",
        '#include "palpate/arm.hpp"',
        "",
        f"inline constexpr palpate::ArmDescription {name}{{",
        f"    .n = {arm.n},",
        "    .joints = {{",
    ]
    for joint, gain in zip(arm.joints, gains, strict=True):
        lines += _joint(joint, float(gain))
    return "\n".join(
        [
            *lines,
            "    }},",
            f"    .gravity = {_list(arm.gravity)},",
            f"    .T_last_tip = {_placement(arm.T_last_tip)},",
            f"    .grasp = {_list(arm.grasp)},",
            "};",
            "",
        ]
    )
