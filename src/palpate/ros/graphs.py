"""Every node by name, and which are launched together."""

from __future__ import annotations

from collections.abc import Mapping

from .board import Camera, Wipe
from .tasks import (
    ArmSimulation,
    Control,
    ExtendedKalmanFilter,
    Mass,
    SlidingModeObserver,
    TaskNode,
    Trajectory,
)

_MASS_ESTIMATION = (ArmSimulation, Trajectory, Control, SlidingModeObserver, ExtendedKalmanFilter, Mass)
_WIPING = (Wipe, Camera)

TASKS: Mapping[str, type[TaskNode]] = {node.task: node for node in (*_MASS_ESTIMATION, *_WIPING)}
"""every node by name"""
GRAPHS: Mapping[str, tuple[str, ...]] = {
    "mass-estimation": tuple(node.task for node in _MASS_ESTIMATION),
    "wiping": tuple(node.task for node in _WIPING),
}
"""nodes that are launched together, by name"""
