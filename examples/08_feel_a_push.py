"""What pushes the arm, and where: a simulated iiwa moves, and is pushed at its elbow and then at its hand.

No joint beyond the second feels the first push, 30 and -25 N on link 4: hence link_2, and push.farthest says up to
where it may have been. The second is 20 and -15 N at the hand.

Needs palpate[sim]. Prints:

    free motion: 0 contacts
    2.00 s to 2.57 s: link_2, (14 ± 5, -12 ± 4, -8 ± 3) N at the hand
    4.00 s to 4.69 s: link_6 or the tip, (-0 ± 4, 21 ± 5, -15 ± 3) N at the hand
"""

from __future__ import annotations

import numpy as np

import palpate as pp
from palpate.drivers.mujoco import MujocoDriver
from palpate.feel import feel_log
from palpate.simulate import Push, Schedule, SensorModel, StopPushing

RATE = 500.0
KP = [800.0, 800.0, 600.0, 600.0, 200.0, 200.0, 100.0]  # [N m/rad]
KD = [80.0, 80.0, 60.0, 60.0, 20.0, 20.0, 10.0]  # [N m s/rad]
START = np.array([0.1, 0.6, 0.0, -1.3, 0.2, 0.7, 0.0])

model = pp.robots.load("kuka_lbr_iiwa14")
sensing = pp.Sensing(position_std=2e-6, velocity_std=2e-4, torque_std=0.05)
friction, true = pp.Friction(coulomb=0.4, viscous=0.3), pp.Friction(coulomb=0.48, viscous=0.36)
joints = [j.replace(rotor_inertia=0.1, sensing=sensing, friction=friction) for j in model.joints]
arm = model.replace(joints=tuple(joints))
# no model is the robot: this one's links weigh up to 3 % more or less, and its friction is a fifth higher
off = np.random.default_rng(2).uniform(0.97, 1.03, arm.n)
joints = [j.replace(mass=j.mass * f, friction=true) for j, f in zip(joints, off, strict=True)]
robot = model.replace(joints=tuple(joints))


def drive(seconds: float, *events: Push | StopPushing) -> pp.Log:
    """Swing all joints for some seconds while things happen; what was read."""
    controller, rows, w = pp.Controller(arm, KP, KD), [], 0.8 + 0.1 * np.arange(arm.n)
    sensor = SensorModel(robot, rate=RATE, seed=3)
    with MujocoDriver(robot, sensor=sensor, q=START, schedule=Schedule(events)) as driver:
        driver.enable()
        for t in np.arange(int(seconds * RATE)) / RATE:
            rows.append(driver.read())
            a = 0.3 * min(t, 1.0)
            wanted = pp.Setpoint(START + a * np.sin(w * t), a * w * np.cos(w * t), np.zeros(arm.n))
            driver.write(controller.step(wanted, driver.plant.q, driver.plant.dq)[0])
    time_ns, q, dq, effort, _ = zip(*rows, strict=True)
    return pp.Log(time_ns=time_ns, position=q, velocity=dq, effort=effort, joint_names=arm.joint_names)


elbow, hand = Push(2.0, 3, (30.0, -25.0, 0.0)), Push(4.0, "grasp", (0.0, 20.0, -15.0))
free, touched = drive(20.0), drive(6.0, elbow, StopPushing(2.5), hand, StopPushing(4.6))
print(f"free motion: {len(feel_log(free, arm, free=[free]).pushes)} contacts")
for push in feel_log(touched, arm, free=[free]).pushes:
    force = ", ".join(f"{f:.0f} ± {1.96 * s:.0f}" for f, s in zip(push.force, push.force_std, strict=True))
    where = push.link + " or the tip" * push.tip
    print(f"{push.start:.2f} s to {push.stop:.2f} s: {where}, ({force}) N at the hand")
