"""The application that weighs: an arm, simulated or real, or a log; and the replay of what was recorded."""

from __future__ import annotations

from .hardware import driven_arm, present_pose
from .proposal import TwoWayMotion, two_way_motion
from .replay import Difference, Replay, replay
from .scenes import Scene, find_pose, load_arm, parse_effort, scene, telling_pose, weight_torque
from .trial import (
    Moment,
    Route,
    RouteControl,
    Task,
    Trial,
    arm_of,
    arrival,
    brick,
    check_mass,
    describe_arm,
    record_moment,
    run,
    simulated_driver,
    truth_of,
)
from .weighing import Hold, Weighing, fit_joints, fit_log, make_pipeline, refused, weigh_log, weigh_trial

__all__ = [
    "Difference",
    "Hold",
    "Moment",
    "Replay",
    "Route",
    "RouteControl",
    "Scene",
    "Task",
    "Trial",
    "TwoWayMotion",
    "Weighing",
    "arm_of",
    "arrival",
    "brick",
    "check_mass",
    "describe_arm",
    "driven_arm",
    "find_pose",
    "fit_joints",
    "fit_log",
    "load_arm",
    "make_pipeline",
    "parse_effort",
    "present_pose",
    "record_moment",
    "refused",
    "replay",
    "run",
    "scene",
    "simulated_driver",
    "telling_pose",
    "truth_of",
    "two_way_motion",
    "weigh_log",
    "weigh_trial",
    "weight_torque",
]
