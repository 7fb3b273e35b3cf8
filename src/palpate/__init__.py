"""palpate: a sense of touch for robot arms without a force sensor."""

from __future__ import annotations

from types import ModuleType

from . import robots
from ._core import (
    Conditioner,
    ContactDetector,
    DisturbanceKalman,
    ExtendedKalman,
    HeldLoad,
    InverseDynamicsObserver,
    JointFormula,
    ModelResidualObserver,
    MomentumObserver,
    MomentumSuperTwisting,
    PayloadFilter,
    Regression,
    SlidingModeObserver,
    Status,
    WrenchEstimator,
    __version__,
)
from .arm import Arm, Effort, Friction, Joint, Limits, Sensing, Shape
from .control import Controller, Quintic, SafetyLimiter, Setpoint
from .errors import ArmError, DriverError, InputError, LogError, MissingExtraError, PalpateError
from .logs import ColumnMap, Log, Recorder
from .phase import PhaseCurrents, PhaseTorque
from .pipeline import (
    Contact,
    ContactEvent,
    ContactNoise,
    ExternalTorque,
    Payload,
    Pipeline,
    Tare,
    Touch,
    Wrench,
    contact_noise,
    status_names,
    tare,
)

__all__ = [
    "Arm",
    "ArmError",
    "ColumnMap",
    "Conditioner",
    "Contact",
    "ContactDetector",
    "ContactEvent",
    "ContactNoise",
    "Controller",
    "DisturbanceKalman",
    "DriverError",
    "Effort",
    "ExtendedKalman",
    "ExternalTorque",
    "Friction",
    "HeldLoad",
    "InputError",
    "InverseDynamicsObserver",
    "Joint",
    "JointFormula",
    "Limits",
    "Log",
    "LogError",
    "MissingExtraError",
    "ModelResidualObserver",
    "MomentumObserver",
    "MomentumSuperTwisting",
    "PalpateError",
    "Payload",
    "PayloadFilter",
    "PhaseCurrents",
    "PhaseTorque",
    "Pipeline",
    "Quintic",
    "Recorder",
    "Regression",
    "SafetyLimiter",
    "Sensing",
    "Setpoint",
    "Shape",
    "SlidingModeObserver",
    "Status",
    "Tare",
    "Touch",
    "Wrench",
    "WrenchEstimator",
    "__version__",
    "contact_noise",
    "robots",
    "status_names",
    "tare",
]


def __getattr__(name: str) -> ModuleType:
    """``palpate.identify`` is loaded when it is first asked for: it is not needed to sense."""
    if name == "identify":
        from importlib import import_module

        return import_module("palpate.identify")
    raise AttributeError(f"module 'palpate' has no attribute {name!r}")
