"""What ``--ros-args`` and parameter files say: remappings and values of parameters."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

from ..errors import InputError, MissingExtraError
from .names import Remap

_EXPONENT = re.compile(r"[-+]?\d+(\.\d*)?[eE][-+]?\d+")  # 1e-3 is a number to ROS, a text to PyYAML

Value: TypeAlias = bool | int | float | str | list[bool] | list[int] | list[float] | list[str]


@dataclass(frozen=True, slots=True)
class Override:
    """A value that a parameter of some nodes begins with."""

    nodes: str
    """full name of a node, its bare name, or a pattern with ``*`` (one part) and ``**`` (any parts)"""
    name: str
    value: Value
    place: str
    """where it was said, for messages"""

    def about(self, full_name: str) -> bool:
        """Whether it is about the node of this full name."""
        if "/" not in self.nodes and "*" not in self.nodes:
            return self.nodes == full_name.rpartition("/")[2]
        return _matches(self.nodes.strip("/").split("/"), full_name.strip("/").split("/"))

    @property
    def exact(self) -> bool:
        """Whether it names a node, so that the parameter must be known there."""
        return "*" not in self.nodes


def _matches(pattern: list[str], parts: list[str]) -> bool:
    if not pattern:
        return not parts
    if pattern[0] == "**":
        return any(_matches(pattern[1:], parts[i:]) for i in range(len(parts) + 1))
    return bool(parts) and pattern[0] in ("*", parts[0]) and _matches(pattern[1:], parts[1:])


@dataclass(frozen=True, slots=True)
class RosArguments:
    """Remappings, and values of parameters in the order they were given; later ones win."""

    remaps: tuple[Remap, ...] = ()
    overrides: tuple[Override, ...] = ()
    texts: tuple[str, ...] = field(default=(), compare=False)
    """as they stood on the command line, to be handed to another process"""

    @classmethod
    def parse(cls, texts: Sequence[str]) -> RosArguments:
        """Arguments as after a ROS node's name: ``--ros-args -r old:=new -p name:=value --params-file FILE --``.

        Raises:
            InputError: something else, or a file that cannot be read.
            MissingExtraError: values need PyYAML.
        """
        remaps: list[Remap] = []
        overrides: list[Override] = []
        rest = list(texts)
        ros = False
        while rest:
            option = rest.pop(0)
            if option == "--ros-args":
                ros = True
                continue
            if option == "--" and ros:
                ros = False
                continue
            if not ros:
                raise InputError(f"{option!r}: ROS arguments begin with --ros-args, e.g. --ros-args -r a:=b")
            if option in ("--disable-rosout-logs", "--enable-rosout-logs"):
                continue
            if option not in (
                *("-r", "--remap", "-p", "--param", "--params-file"),
                *("--log-level", "-e", "--enclave"),
            ):
                raise InputError(f"ROS argument {option!r}: expected -r, -p, --params-file or --log-level")
            if not rest:
                raise InputError(f"ROS argument {option}: a value must follow")
            value = rest.pop(0)
            if option in ("-r", "--remap"):
                remaps.append(Remap.parse(value))
            elif option in ("-p", "--param"):
                overrides.append(_parameter(value))
            elif option == "--params-file":
                overrides += params_file(Path(value))
        return cls(tuple(remaps), tuple(overrides), tuple(texts))


def _parameter(text: str) -> Override:
    old, arrow, value = text.partition(":=")
    node, _, name = old.rpartition(":")
    if not (arrow and name):
        raise InputError(f"parameter {text!r}: expected name:=value, e.g. payload_mass:=0.4")
    return Override(node or "/**", name, _value(_yaml().safe_load(value), f"parameter {name}"), "-p")


def params_file(path: Path) -> list[Override]:
    """The values of a ROS parameter file.

    Raises:
        InputError: it cannot be read, or is not such a file; the message says where.
        MissingExtraError: PyYAML is not installed.
    """
    yaml = _yaml()
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise InputError(f"{path}: cannot be read: {' '.join(str(error).split())[:300]}") from None
    found: list[Override] = []
    if not isinstance(content, Mapping):
        raise InputError(f"{path}: expected node names with ros__parameters below them")
    _nodes(content, "", path, found)
    return found


def _nodes(content: Mapping[Any, Any], prefix: str, path: Path, found: list[Override]) -> None:
    for key, below in content.items():
        if not isinstance(key, str) or not isinstance(below, Mapping):
            raise InputError(
                f"{path}: {prefix or '/'}{key!s:.60}: expected a node's name with ros__parameters below it"
            )
        if key == "ros__parameters":
            if not prefix:
                raise InputError(f"{path}: ros__parameters must stand below a node's name, or below /**")
            _parameters(below, "", prefix, path, found)
        else:
            _nodes(below, f"{prefix}/{key.strip('/')}" if prefix or key.startswith("/") else key, path, found)


def _parameters(values: Mapping[Any, Any], prefix: str, node: str, path: Path, found: list[Override]) -> None:
    for key, value in values.items():
        if not isinstance(key, str):
            raise InputError(f"{path}: {node}: a parameter's name must be a text, got {key!r:.60}")
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            _parameters(value, f"{name}.", node, path, found)
        else:
            found.append(Override(node, name, _value(value, f"{path}: {name}"), str(path)))


def _value(value: Any, where: str) -> Value:
    if isinstance(value, str) and _EXPONENT.fullmatch(value):
        return float(value)
    if isinstance(value, list):
        value = [float(x) if isinstance(x, str) and _EXPONENT.fullmatch(x) else x for x in value]
        if all(isinstance(x, bool) for x in value) and value:
            return list(value)
        if all(isinstance(x, int | float) and not isinstance(x, bool) for x in value):
            return [float(x) for x in value] if any(isinstance(x, float) for x in value) else list(value)
        if all(isinstance(x, str) for x in value):
            return list(value)
    elif isinstance(value, bool | int | float | str):
        return value
    raise InputError(
        f"{where}: a parameter is a bool, a number, a text or a list of one of these, got {value!r:.60}"
    )


def _yaml() -> Any:
    try:
        import yaml
    except ImportError:
        raise MissingExtraError("ros", "reading ROS parameters") from None
    return yaml
