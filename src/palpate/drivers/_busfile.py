"""The bus file: YAML, checked field by field."""

from __future__ import annotations

import os
from typing import Annotated, Literal

from pydantic import Field

from .._card import Strict, read_yaml
from ..errors import InputError
from .bus import BAUD, MAX_ID, MIDDLE, Bus, Servo

_Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]


class _Servo(Strict):
    id: Annotated[int, Field(ge=0, le=MAX_ID)]
    joint: str
    model: str | None = None
    direction: Literal[1, -1] = 1
    zero: int = MIDDLE
    gear: _Positive = 1.0
    torque_constant_Nm_A: _Positive | None = None
    current_limit_A: _Positive | None = None


class _Bus(Strict):
    palpate_bus: Literal[1]
    baud: Annotated[int, Field(gt=0)] = BAUD
    servos: Annotated[tuple[_Servo, ...], Field(min_length=1)]


def read(path: str | os.PathLike[str]) -> Bus:
    """See :meth:`palpate.drivers.bus.Bus.from_yaml`."""
    _, bus = read_yaml(path, _Bus, "bus", InputError)
    return Bus(
        baud=bus.baud,
        servos=tuple(
            Servo(
                id=s.id,
                joint=s.joint,
                model=s.model,
                direction=s.direction,
                zero=s.zero,
                gear=s.gear,
                torque_constant=s.torque_constant_Nm_A,
                current_limit=s.current_limit_A,
            )
            for s in bus.servos
        ),
    )
