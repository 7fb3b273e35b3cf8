"""Identify the simulated ABB IRB 2400-16 by its own motion, as `palpate reproduce sensorless-force` does, and write
src/palpate/teleop/abb_irb2400_16.json: what its slave knows of itself. A minute or two."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from palpate.simulate.irb2400 import GEAR, POLE_PAIRS
from palpate.studies._irb2400_force import FULL, Plan, experiment
from palpate.teleop.motor_force import MotorModel

OUT = Path(__file__).parents[1] / "src" / "palpate" / "teleop" / "abb_irb2400_16.json"


def model() -> MotorModel:
    """The experiment by which the study's settings were chosen, without its records."""
    plan = Plan(FULL.excitation, FULL.moves, FULL.check, FULL.poses, 0, ())
    robot = experiment(plan, lambda done: None).robot
    return MotorModel.of(
        robot.fit,
        gain=robot.arm.effort.gain(6),
        gain_std=robot.gain_std,
        sliding_std=robot.sliding_std,
        turning_std=robot.turning_std,
        gear=GEAR,
        pole_pairs=np.full(6, float(POLE_PAIRS)),
        angle_offset=np.array([c.angle_offset for c in robot.calibration]),
        sensor_offset=np.array([c.offset for c in robot.calibration]),
        sensor_gain=np.array([c.gain for c in robot.calibration]),
        amplitude_std=np.array([1.5 * c.noise for c in robot.calibration]),
    )


if __name__ == "__main__":
    OUT.write_text(model().to_json(), encoding="utf-8")
    sys.stdout.write(f"{OUT}\n")
