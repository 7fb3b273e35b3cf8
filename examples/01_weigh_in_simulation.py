"""A simulated seven-joint servo arm lifts 0.25 kg; its encoders and motor torques tell the mass.

Needs palpate[sim]. Prints:

    1 s  warming  0.235 ± 0.046 kg
    2 s  ok       0.249 ± 0.003 kg
    3 s  ok       0.250 ± 0.001 kg
    4 s  ok       0.250 ± 0.000 kg
    5 s  ok       0.250 ± 0.000 kg
"""

from __future__ import annotations

import palpate as pp
from palpate.drivers.mujoco import MujocoDriver

KP = [5.0, 2.5, 2.5, 2.5, 2.5, 2.5, 2.5]  # [N m/rad]
KD = [3.5, 1.0, 1.0, 1.5, 1.0, 1.0, 1.0]  # [N m s/rad]

arm = pp.robots.load("justina_left_arm")  # Arm.from_urdf("your.urdf", ...) for yours: example 02
pipeline = pp.Pipeline(arm)  # the default weighs by a Kalman filter, while the arm moves
motion = pp.Quintic(start=[0.0] * 7, goal=[0.0, -0.5, 0.5, 1.0, 0.0, 1.0, -0.3], duration=3.0)
controller = pp.Controller(arm, KP, KD)

# 12-bit encoders, torque in steps, 250 Hz: as the arm's description says; nobody tells the pipeline about the 0.25 kg
with MujocoDriver(arm, payload=0.25, seed=0) as driver:
    driver.enable()
    for k in range(5 * 250 + 1):
        sample = driver.read()
        touch = pipeline.step(sample)
        torque, _ = controller.step(motion.sample(k / 250), touch.q, touch.dq, pipeline.load)
        driver.write(torque)
        if k > 0 and k % 250 == 0:
            held = touch.payload
            print(f"{k // 250} s  {held.status.name:7s} {held.mass:6.3f} ± {1.96 * held.mass_std:.3f} kg")
