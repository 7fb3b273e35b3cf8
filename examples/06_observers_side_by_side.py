"""Every observer on one and the same log: external torque at the weighing joint, and the mass by the joint formula.

Needs palpate[sim] for the log; any log of an arm with masses does. Prints:

    la_6_joint, lever 0.182 m; truth -0.446 N m, 250 g
    inverse dynamics  -0.449 N m, noise 0.130; 251.0 g, noise 73.0
    sliding mode      -0.415 N m, noise 0.009; 231.9 g, noise 5.2
    momentum          -0.448 N m, noise 0.211; 250.9 g, noise 118.1
    super-twisting    -0.443 N m, noise 0.196; 247.9 g, noise 109.5
    extended Kalman   -0.445 N m, noise 0.452; 249.0 g, noise 252.9
    payload filter                               249.9 g, noise 0.01
"""

from __future__ import annotations

import numpy as np

import palpate as pp
from palpate.drivers.mujoco import MujocoDriver

POSE = np.array([0.0, -0.5, 0.5, 1.0, 0.0, 1.0, -0.3])  # [rad]
OBSERVERS = {
    "inverse dynamics": pp.InverseDynamicsObserver(),
    "sliding mode": pp.SlidingModeObserver(),
    "momentum": pp.MomentumObserver(bandwidth=10.0),
    "super-twisting": pp.MomentumSuperTwisting(),
    "extended Kalman": pp.ExtendedKalman(),
}

arm = pp.robots.load("justina_left_arm")
controller = pp.Controller(arm, [5, 2.5, 2.5, 2.5, 2.5, 2.5, 2.5], [3.5, 1, 1, 1.5, 1, 1, 1])
motion = pp.Quintic(np.zeros(7), POSE, duration=3.0)
rows = []
with MujocoDriver(arm, payload=0.25, seed=0) as driver:
    driver.enable()
    for k in range(10 * 250):
        rows.append(driver.read())
        torque, _ = controller.step(motion.sample(k / 250), driver.plant.q, driver.plant.dq)
        driver.write(torque)
time_ns, position, _, effort, _ = zip(*rows, strict=True)
log = pp.Log(time_ns=time_ns, position=position, effort=effort, joint_names=arm.joint_names)

joint = arm.weighing_joint(log.position[-1])
weight = (
    0.25 * arm.jacobian(log.position[-1], arm.grasp)[:3].T @ arm.gravity
)  # J^T m g, > 0 where it pushes forward
print(f"{joint.name}, lever {joint.lever:.3f} m; truth {weight[joint.index]:.3f} N m, 250 g")
formula = pp.JointFormula(joint=joint.index)
smooth = pp.Conditioner(time_constant=0.1)  # 12-bit encoders: their plain differences are off by 0.8 rad/s
last = slice(-500, None)  # the last 2 s
for name, observer in OBSERVERS.items():
    touch = pp.Pipeline(arm, observer=observer, payload=formula, conditioner=smooth).run(log)
    seen, mass = touch.external.torque[last, joint.index], touch.payload.mass[last]
    torque = f"{seen.mean():6.3f} N m, noise {seen.std():.3f}"
    print(f"{name:17s} {torque}; {1e3 * mass.mean():5.1f} g, noise {1e3 * mass.std():.1f}")
held = pp.Pipeline(arm).run(log).payload  # weighs by itself, without an observer before it
print(
    f"{'payload filter':17s} {'':27s}{1e3 * held.mass[last].mean():5.1f} g, noise {1e3 * held.mass[last].std():.2f}"
)
