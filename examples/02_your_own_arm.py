"""From your own URDF to a first weight: declare the drives, look where it can weigh, keep a card, weigh a log.

The URDF here is a two-joint arm written out below; take the path of yours instead. Needs palpate[card]. Prints:

    weigh by the elbow: 2.40 N m per kg at that pose
    0.80 ± 0.04 kg, ok
"""

from __future__ import annotations

import numpy as np

import palpate as pp

URDF = """
<robot name="two_joint_arm">
  <link name="base"/>
  <joint name="shoulder" type="revolute">
    <parent link="base"/><child link="upper"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" velocity="3" effort="40"/><dynamics friction="0.3" damping="0.5"/>
  </joint>
  <link name="upper"><inertial><origin xyz="0.15 0 0"/><mass value="2"/>
    <inertia ixx="0.002" iyy="0.016" izz="0.016" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="elbow" type="revolute">
    <parent link="upper"/><child link="fore"/><origin xyz="0.3 0 0"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" velocity="3" effort="20"/><dynamics friction="0.2" damping="0.3"/>
  </joint>
  <link name="fore"><inertial><origin xyz="0.12 0 0"/><mass value="1"/>
    <inertia ixx="0.001" iyy="0.006" izz="0.006" ixy="0" ixz="0" iyz="0"/></inertial></link>
</robot>"""

# What the driver calls effort has no default: here motor current [A], by torque constant and gear ratio
arm = pp.Arm.from_urdf(URDF, tip="fore", grasp=(0.25, 0, 0), effort=pp.Effort.current(k_t=0.05, gear=100))
encoder = pp.Sensing(position_resolution=2 * np.pi / 65536, torque_resolution=0.02)
arm = arm.replace(joints=tuple(joint.replace(sensing=encoder) for joint in arm.joints))

pose = [-0.4, 0.6]
joint = arm.weighing_joint(pose)
print(f"weigh by the {joint.name}: {9.81 * joint.lever:.2f} N m per kg at that pose")

arm.save("two_joint_arm.yaml")  # the card: everything above in one file
assert pp.Arm.from_card("two_joint_arm.yaml") == arm

# Instead of pp.Log.open("yours.csv", pp.ColumnMap(...)): the arm swings about the pose with 0.8 kg in its hand
t, w = np.arange(0.0, 4.0, 0.004)[:, None], np.array([2.0, 3.0])
q, dq, ddq = pose + 0.2 * np.sin(w * t), 0.2 * w * np.cos(w * t), -0.2 * w**2 * np.sin(w * t)
load = 0.8 * np.array([1, 0.25, 0, 0, 0, 0, 0, 0.25**2, 0, 0.25**2])  # m, m c, inertia about the elbow
torque = arm.inverse_dynamics(q, dq, ddq) + arm.friction_torque(dq)
torque += arm.regressor(q, dq, ddq)[..., 10:] @ load
log = pp.Log(
    time_ns=np.rint(1e9 * t[:, 0]).astype(int),
    position=q,
    effort=torque / (0.05 * 100),  # [A]
    joint_names=arm.joint_names,
)

held = pp.Pipeline(arm).run(log).payload
print(f"{held.mass[-1]:.2f} ± {1.96 * held.mass_std[-1]:.2f} kg, {pp.Status(held.status[-1]).name}")
