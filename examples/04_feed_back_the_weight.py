"""Closed loop: what the pipeline weighs goes back to the controller, so that the arm arrives where it should.

The loop talks to a Driver; a real arm's driver takes the place of the simulated one. Needs palpate[sim]. Prints:

    without feedback: 0.250 kg, 0.181 rad from the goal
    with feedback: 0.250 kg, 0.001 rad from the goal
"""

from __future__ import annotations

import numpy as np

import palpate as pp
from palpate.drivers import Driver
from palpate.drivers.mujoco import MujocoDriver

KP = [5.0, 2.5, 2.5, 2.5, 2.5, 2.5, 2.5]  # [N m/rad]
KD = [3.5, 1.0, 1.0, 1.5, 1.0, 1.0, 1.0]  # [N m s/rad]
GOAL = np.array([-1.0, 0.0, 0.0, 1.5, 0.0, 0.9, 0.0])  # [rad]


def reach(driver: Driver, arm: pp.Arm, *, feed_back: bool, seconds: float = 8.0) -> float:
    """Move to the goal in 3 s and hold; returns the mass that was weighed [kg]."""
    pipeline = pp.Pipeline(arm)
    motion = pp.Quintic(np.zeros(arm.n), GOAL, duration=3.0)
    controller = pp.Controller(arm, KP, KD)  # the bare arm's dynamics as feed-forward, and PD
    limiter = pp.SafetyLimiter(arm)  # the last thing a command passes: torque, soft position and speed limits
    mass = 0.0
    with driver:  # connects; closes at the end, also after an error
        driver.enable()
        for k in range(round(seconds * 1e9 / driver.period_ns)):
            sample = driver.read()
            if sample is None:  # a lost sample: the last command stays in force
                continue
            touch = pipeline.step(sample)
            load = (
                pipeline.load if feed_back else None
            )  # a body on the last link; zero until the status is ok
            setpoint = motion.sample(k * driver.period_ns * 1e-9)
            torque, _ = controller.step(setpoint, touch.q, touch.dq, load)
            safe, _ = limiter.step(torque, touch.q, touch.dq, driver.period_ns * 1e-9)
            driver.write(safe)  # returns what was really sent
            mass = touch.payload.mass
    return mass


arm = pp.robots.load("justina_left_arm")
for feed_back in (False, True):
    driver = MujocoDriver(arm, payload=0.25, seed=0)
    mass = reach(driver, arm, feed_back=feed_back)
    error = np.abs(driver.plant.q - GOAL).max()
    print(f"{'with' if feed_back else 'without'} feedback: {mass:.3f} kg, {error:.3f} rad from the goal")
