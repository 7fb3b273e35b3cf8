"""palpate: a sense of touch for robot arms without a force sensor."""

from __future__ import annotations

from types import ModuleType

from . import robots
from ._core import (
    AbagParameters,
    CartesianImpedanceOptions,
    CartesianVelocityOptions,
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
    Posture,
    Regression,
    SenderClockOptions,
    SlidingModeObserver,
    Status,
    VelocityErrata,
    WrenchEstimator,
    __version__,
)
from .arm import Arm, Effort, Friction, Joint, Limits, Sensing, Shape
from .control import (
    Abag,
    AbagState,
    CartesianCommand,
    CartesianImpedance,
    CartesianTarget,
    CartesianVelocity,
    Controller,
    Quintic,
    SafetyLimiter,
    Setpoint,
)
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
from .session import Realtime, Session, SimulatedArm
from .velocity import JointVelocity, SenderClock, SenderStamp, SenderStamps

__all__ = [
    "Abag",
    "AbagParameters",
    "AbagState",
    "Arm",
    "ArmError",
    "CartesianCommand",
    "CartesianImpedance",
    "CartesianImpedanceOptions",
    "CartesianTarget",
    "CartesianVelocity",
    "CartesianVelocityOptions",
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
    "JointVelocity",
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
    "Posture",
    "Quintic",
    "Realtime",
    "Recorder",
    "Regression",
    "SafetyLimiter",
    "SenderClock",
    "SenderClockOptions",
    "SenderStamp",
    "SenderStamps",
    "Sensing",
    "Session",
    "Setpoint",
    "Shape",
    "SimulatedArm",
    "SlidingModeObserver",
    "Status",
    "Tare",
    "Touch",
    "VelocityErrata",
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
