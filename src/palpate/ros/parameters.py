"""A node's parameters: declared with a type and a meaning, set by files, by the command line and by services."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ..errors import InputError, suggest
from .arguments import Override, Value
from .messages import (
    DescribeParametersReply,
    DescribeParametersRequest,
    GetParametersReply,
    GetParametersRequest,
    GetParameterTypesReply,
    GetParameterTypesRequest,
    ListParametersReply,
    ListParametersRequest,
    ListParametersResult,
    Parameter,
    ParameterDescriptor,
    ParameterValue,
    SetParametersAtomicallyReply,
    SetParametersAtomicallyRequest,
    SetParametersReply,
    SetParametersRequest,
    SetParametersResult,
)

# number in ParameterValue.type: name in ROS, field
_KINDS = {
    1: ("bool", "bool_value"),
    2: ("integer", "integer_value"),
    3: ("double", "double_value"),
    4: ("string", "string_value"),
    5: ("byte_array", "byte_array_value"),
    6: ("bool_array", "bool_array_value"),
    7: ("integer_array", "integer_array_value"),
    8: ("double_array", "double_array_value"),
    9: ("string_array", "string_array_value"),
}
_SCALARS: dict[type, int] = {bool: 1, int: 2, float: 3, str: 4}
_ARRAYS: dict[type, int] = {bool: 6, int: 7, float: 8, str: 9}
_WHOLE = {2: 3, 7: 8}
"""whole numbers where real ones are declared are taken as such"""
_LEAST, _MOST = -(2**63), 2**63 - 1
_MANY = 1000
"""names or values in one request"""


@dataclass(slots=True)
class _Declared:
    value: Value
    kind: int
    meaning: str
    read_only: bool


class Parameters:
    """Parameters of one node.

    Args:
        node: its full name.
        overrides: what files and the command line say.
    """

    def __init__(self, node: str, overrides: Sequence[Override] = ()) -> None:
        self._node = node
        self._overrides = [o for o in overrides if o.about(node)]
        self._declared: dict[str, _Declared] = {}
        self._checks: list[Callable[[Mapping[str, Value]], None]] = []
        self.changed: Callable[[list[Parameter]], None] = lambda _: None
        """called with what was set, after it was"""

    def declare(self, name: str, default: Value, meaning: str, *, read_only: bool = False) -> Any:
        """Declare a parameter; its type is its default's, an empty list is one of real numbers.

        Returns:
            its value: the last override's, or the default.

        Raises:
            InputError: declared already, or an override has another type.
        """
        if name in self._declared:
            raise InputError(f"{self._node}: parameter {name!r} is declared already")
        declared = _Declared(default, _kind_of(default), meaning, read_only)
        for override in self._overrides:
            if override.name == name:
                try:
                    declared.value = _fit(override.value, declared.kind)
                except InputError as error:
                    raise InputError(f"{override.place}: {self._node}: parameter {name}: {error}") from None
        self._declared[name] = declared
        return declared.value

    def check_overrides(self) -> list[str]:
        """After all were declared: what was said of parameters that there are not, by a pattern; one line each.

        Raises:
            InputError: it was said of this very node.
        """
        remarks = []
        for o in self._overrides:
            if o.name in self._declared:
                continue
            text = f"{o.place}: {self._node} has no parameter {o.name!r}; {suggest(o.name, self._declared)}"
            if o.exact:
                raise InputError(text)
            remarks.append(text)
        return remarks

    def on_set(self, check: Callable[[Mapping[str, Value]], None]) -> None:
        """Ask `check` before values change, with all values as they would be; it raises InputError to refuse."""
        self._checks.append(check)

    def __getitem__(self, name: str) -> Any:
        """The value.

        Raises:
            InputError: not declared.
        """
        if name not in self._declared:
            raise InputError(f"{self._node} has no parameter {name!r}; {suggest(name, self._declared)}")
        return self._declared[name].value

    def values(self) -> dict[str, Value]:
        """All of them."""
        return {name: declared.value for name, declared in self._declared.items()}

    def set(self, values: Mapping[str, Value]) -> None:
        """Set some, all or none.

        Raises:
            InputError: one is not declared, read-only, of another type, or refused by the node.
        """
        fitted: dict[str, Value] = {}
        for name, value in values.items():
            self[name]
            declared = self._declared[name]
            if declared.read_only:
                raise InputError(f"parameter {name} cannot be changed while the node runs")
            try:
                fitted[name] = _fit(value, declared.kind)
            except InputError as error:
                raise InputError(f"parameter {name}: {error}") from None
        for check in self._checks:
            check({**self.values(), **fitted})
        for name, value in fitted.items():
            self._declared[name].value = value
        self.changed([Parameter(name, _message(value)) for name, value in fitted.items()])

    # --- the six services ----------------------------------------------------------------------------------------

    def services(self) -> dict[str, tuple[type[Any], type[Any], Callable[[Any], Any]]]:
        """Request, reply and handler of each service, by its name below the node."""
        return {
            "get_parameters": (GetParametersRequest, GetParametersReply, self._get),
            "get_parameter_types": (GetParameterTypesRequest, GetParameterTypesReply, self._types),
            "set_parameters": (SetParametersRequest, SetParametersReply, self._set),
            "set_parameters_atomically": (
                SetParametersAtomicallyRequest,
                SetParametersAtomicallyReply,
                self._set_atomically,
            ),
            "list_parameters": (ListParametersRequest, ListParametersReply, self._list),
            "describe_parameters": (DescribeParametersRequest, DescribeParametersReply, self._describe),
        }

    def _get(self, request: GetParametersRequest) -> GetParametersReply:
        # an unknown name spoils the whole answer: so rclcpp has it
        names = request.names[:_MANY]
        if not all(name in self._declared for name in names):
            return GetParametersReply()
        return GetParametersReply(values=[_message(self._declared[name].value) for name in names])

    def _types(self, request: GetParameterTypesRequest) -> GetParameterTypesReply:
        names = request.names[:_MANY]
        if not all(name in self._declared for name in names):
            return GetParameterTypesReply()
        return GetParameterTypesReply(types=[self._declared[name].kind for name in names])

    def _describe(self, request: DescribeParametersRequest) -> DescribeParametersReply:
        found = []
        for name in request.names[:_MANY]:
            known = self._declared.get(name)
            found.append(
                ParameterDescriptor(name=name)
                if known is None
                else ParameterDescriptor(name, known.kind, known.meaning, "", known.read_only)
            )
        return DescribeParametersReply(descriptors=found)

    def _list(self, request: ListParametersRequest) -> ListParametersReply:
        names = []
        for name in sorted(self._declared):
            if not request.prefixes:
                deep = name.count(".") + 1
            else:
                below = [p for p in request.prefixes[:_MANY] if name == p or name.startswith(f"{p}.")]
                if not below:
                    continue
                deep = min(name[len(p) :].count(".") for p in below)
            if not request.depth or deep <= request.depth:
                names.append(name)
        prefixes = sorted({name.rpartition(".")[0] for name in names if "." in name})
        return ListParametersReply(result=ListParametersResult(names, prefixes))

    def _set(self, request: SetParametersRequest) -> SetParametersReply:
        return SetParametersReply(results=[self._try([p]) for p in request.parameters[:_MANY]])

    def _set_atomically(self, request: SetParametersAtomicallyRequest) -> SetParametersAtomicallyReply:
        return SetParametersAtomicallyReply(result=self._try(request.parameters[:_MANY]))

    def _try(self, parameters: Sequence[Parameter]) -> SetParametersResult:
        try:
            self.set({p.name: _plain(p.value) for p in parameters})
        except InputError as error:
            return SetParametersResult(False, str(error))
        return SetParametersResult(True)


def _kind_of(value: Value) -> int:
    if isinstance(value, list):
        return _ARRAYS[type(value[0])] if value else 8
    return _SCALARS[type(value)]


def _fit(value: Value, kind: int) -> Value:
    given = _kind_of(value)
    if value == [] and kind in _ARRAYS.values():
        return []
    if _WHOLE.get(given) == kind:
        return [float(x) for x in value] if isinstance(value, list) else float(value)
    if given != kind:
        raise InputError(f"expected {_KINDS[kind][0]}, got {_KINDS[given][0]} {value!r:.60}")
    numbers = value if isinstance(value, list) else [value]
    if kind in (2, 7) and not all(_LEAST <= int(x) <= _MOST for x in numbers):
        raise InputError("expected whole numbers of 64 bit")
    if kind in (3, 8) and any(math.isnan(float(x)) for x in numbers):
        raise InputError("expected numbers, got NaN")
    return list(value) if isinstance(value, list) else value  # type: ignore[return-value]


def _message(value: Value) -> ParameterValue:
    kind = _kind_of(value)
    return ParameterValue(type=kind, **{_KINDS[kind][1]: value})  # type: ignore[arg-type]


def _plain(value: ParameterValue) -> Value:
    if value.type not in _KINDS or value.type == 5:
        raise InputError(f"a parameter cannot be undeclared or a byte array (type {value.type})")
    found = getattr(value, _KINDS[value.type][1])
    return found if isinstance(found, bool | int | float | str) else list(found)
