"""palpate: a sense of touch for robot arms without a force sensor."""

from __future__ import annotations

from . import robots
from ._core import (
    Conditioner,
    ExtendedKalman,
    InverseDynamicsObserver,
    JointFormula,
    ModelResidualObserver,
    MomentumObserver,
    MomentumSuperTwisting,
    PayloadFilter,
    Regression,
    SlidingModeObserver,
    Status,
    __version__,
)
from .arm import Arm, Effort, Friction, Joint, Limits, Sensing, Shape
from .control import Controller, Quintic, SafetyLimiter, Setpoint
from .errors import ArmError, DriverError, InputError, LogError, MissingExtraError, PalpateError
from .logs import ColumnMap, Log, Recorder
from .pipeline import ExternalTorque, Payload, Pipeline, Tare, Touch, status_names, tare

__all__ = [
    "Arm",
    "ArmError",
    "ColumnMap",
    "Conditioner",
    "Controller",
    "DriverError",
    "Effort",
    "ExtendedKalman",
    "ExternalTorque",
    "Friction",
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
    "__version__",
    "robots",
    "status_names",
    "tare",
]
