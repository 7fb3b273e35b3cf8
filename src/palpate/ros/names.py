"""Names of the ROS graph: what is allowed, what a relative name means, remapping, and the DDS topic behind it.

The rules are those of the ROS 2 design article "Topic and service names".
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from ..errors import InputError

_TOKEN = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_TOPIC = re.compile(r"(~(?=/|$)|/)?/?([A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*)?")


def node_name(name: str) -> str:
    """The name, if a node may have it.

    Raises:
        InputError: it may not.
    """
    if not _TOKEN.fullmatch(name):
        raise InputError(f"node name {name!r}: expected letters, digits and _, not beginning with a digit")
    return name


def namespace(text: str) -> str:
    """A namespace with its leading slash and no trailing one but for the root ``/``.

    Raises:
        InputError: it is none.
    """
    parts = [part for part in text.split("/") if part]
    if text and not all(_TOKEN.fullmatch(part) for part in parts):
        raise InputError(f"namespace {text!r}: expected /name/name of letters, digits and _")
    return "/" + "/".join(parts)


def expand(name: str, space: str, node: str) -> str:
    """The absolute name: ``/x`` as it is, ``~/x`` below the node, ``x`` below the namespace.

    Raises:
        InputError: no name.
    """
    if not name or name == "/" or name.endswith("/") or "//" in name or not _TOPIC.fullmatch(name):
        raise InputError(f"name {name!r}: expected e.g. joint_states, /arm/joint_states or ~/mass")
    if name.startswith("/"):
        return name
    below = "" if space == "/" else space
    if name.startswith("~"):
        return f"{below}/{node}{name[1:]}"
    return f"{below}/{name}"


@dataclass(frozen=True, slots=True)
class Remap:
    """``[node:]old:=new``; old is a topic or service, or ``__node`` or ``__ns``."""

    old: str
    new: str
    node: str = ""
    """of this node only; empty: of every node"""

    @classmethod
    def parse(cls, text: str) -> Remap:
        """A rule as on the command line of ROS.

        Raises:
            InputError: it is none.
        """
        old, arrow, new = text.partition(":=")
        node, colon, rest = old.rpartition(":")
        old = rest if colon else old
        if not (arrow and old and new):
            raise InputError(f"remapping {text!r}: expected old:=new, e.g. joint_states:=/arm/joint_states")
        if node:
            node_name(node)
        if old in ("__node", "__name"):
            return cls("__node", node_name(new), node)
        if old == "__ns":
            return cls(old, namespace(new), node)
        for name in (old, new):
            expand(name, "/", "node")
        return cls(old, new, node)


def remapped(name: str, space: str, node: str, rules: Sequence[Remap]) -> str:
    """The absolute name after the first rule that speaks of it."""
    full = expand(name, space, node)
    for rule in rules:
        if (
            rule.node in ("", node)
            and not rule.old.startswith("__")
            and expand(rule.old, space, node) == full
        ):
            return expand(rule.new, space, node)
    return full


def renamed(space: str, node: str, rules: Sequence[Remap]) -> tuple[str, str]:
    """Namespace and name of a node after the rules ``__ns`` and ``__node``."""
    mine = [rule for rule in rules if rule.node in ("", node)]
    new_space = next((r.new for r in mine if r.old == "__ns"), namespace(space))
    new_name = next((r.new for r in mine if r.old == "__node"), node_name(node))
    return new_space, new_name


def plain_type(dds_type: str) -> str:
    """``sensor_msgs/msg/JointState`` of ``sensor_msgs::msg::dds_::JointState_``; other names stay."""
    parts = dds_type.split("::")
    if len(parts) == 4 and parts[2] == "dds_" and parts[3].endswith("_"):
        return f"{parts[0]}/{parts[1]}/{parts[3][:-1]}"
    return dds_type
