"""Tare: the model's link masses are wrong by up to 20 %; 20 s of motion with an empty hand put them right.

Needs palpate[sim]. Prints:

    as modelled: 0.228 ± 0.009 kg
    tared: 0.250 ± 0.000 kg
"""

from __future__ import annotations

import numpy as np

import palpate as pp
from palpate.drivers.mujoco import MujocoDriver

KP = [5.0, 2.5, 2.5, 2.5, 2.5, 2.5, 2.5]  # [N m/rad]
KD = [3.5, 1.0, 1.0, 1.5, 1.0, 1.0, 1.0]  # [N m s/rad]
POSES = (
    [-0.5, 0.3, 0.4, 1.2, 0.5, 0.8, 0.4],
    [0.4, -0.4, -0.6, 0.6, -0.5, -0.6, -0.5],
    [-0.9, 0, 0, 1.5, 0, 0.9, 0],
)


def drive(true_arm: pp.Arm, model: pp.Arm, poses: tuple, mass: float) -> pp.Log:
    """Let the true arm move through poses, 5 s each, by a controller that knows the model; what was read."""
    controller, start, rows = pp.Controller(model, KP, KD), np.zeros(model.n), []
    with MujocoDriver(true_arm, payload=mass or None, seed=1) as driver:
        driver.enable()
        for pose in poses:
            motion = pp.Quintic(start, pose, duration=4.0)
            for k in range(5 * 250):
                rows.append(driver.read())
                torque, _ = controller.step(motion.sample(k / 250), driver.plant.q, driver.plant.dq)
                driver.write(torque)
            start = pose
    time_ns, position, _, effort, _ = zip(*rows, strict=True)
    return pp.Log(time_ns=time_ns, position=position, effort=effort, joint_names=model.joint_names)


model = pp.robots.load("justina_left_arm")
wrong = np.random.default_rng(2).uniform(0.8, 1.2, model.n)  # nobody knows these
joints = [j.replace(mass=j.mass * f, inertia=j.inertia * f) for j, f in zip(model.joints, wrong, strict=True)]
true_arm = model.replace(joints=tuple(joints))

tare = pp.tare(model, drive(true_arm, model, (*POSES, POSES[0]), mass=0.0))  # 20 s, nothing in the hand
task = drive(true_arm, model, POSES[:1], mass=0.25)
for name, arm in (("as modelled", model), ("tared", tare.arm)):
    held = pp.Pipeline(arm).run(task).payload
    print(f"{name}: {held.mass[-1]:.3f} ± {1.96 * held.mass_std[-1]:.3f} kg")
