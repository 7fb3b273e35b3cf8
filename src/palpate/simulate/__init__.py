"""Simulated arms: dynamics in MuJoCo, sensing with its faults, scenarios. Needs ``palpate[sim]``."""

from __future__ import annotations

from ._render import Camera
from .clearance import Clearance
from .plant import Integrator, Load, Plant, Truth
from .rehearsal import Rehearsal, rehearse
from .scenarios import Attach, Push, Release, ScenarioEvent, Schedule, StopPushing, pick_and_place
from .sensing import Fault, FaultKind, SensorModel

__all__ = [
    "Attach",
    "Camera",
    "Clearance",
    "Fault",
    "FaultKind",
    "Integrator",
    "Load",
    "Plant",
    "Push",
    "Rehearsal",
    "Release",
    "ScenarioEvent",
    "Schedule",
    "SensorModel",
    "StopPushing",
    "Truth",
    "pick_and_place",
    "rehearse",
]
