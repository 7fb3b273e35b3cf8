"""The reference arms: kinematics and dynamics against Pinocchio, published figures, and the joint each weighs with."""

from __future__ import annotations

import math
from importlib import resources

import numpy as np
import pytest

from arm_oracle import Oracle
from palpate import robots
from palpate.arm import Arm, Effort, inertia_complaint
from palpate.errors import ArmError

JUSTINA_GOAL = (0.5, -0.1, 1.0, 1.1, 0.0, 0.7, -0.4)


def source(name: str) -> str:
    return resources.files("palpate.robots").joinpath(f"{name}.urdf").read_text(encoding="utf-8")


def test_names():
    files = {
        f.name.removesuffix(".urdf")
        for f in resources.files("palpate.robots").iterdir()
        if f.name.endswith(".urdf")
    }
    assert files == set(robots.names()) and len(robots.names()) == 8
    assert robots.load("kuka_lbr_iiwa7") is robots.load("kuka_lbr_iiwa7")
    with pytest.raises(ArmError, match="no reference arm 'kuka_iiwa7'; did you mean 'kuka_lbr_iiwa7'"):
        robots.load("kuka_iiwa7")


@pytest.mark.parametrize("name", robots.names())
def test_kinematics_and_dynamics_against_pinocchio(name):
    arm = robots.load(name)
    oracle = Oracle(source(name), arm)
    rng = np.random.default_rng(5)
    for _ in range(20):
        q, dq, ddq = rng.uniform(-2, 2, (3, arm.n))
        assert np.allclose(arm.forward_kinematics(q), oracle.T_base_frame(q, arm.tip), atol=1e-13)
        assert np.allclose(arm.jacobian(q), oracle.jacobian(q), atol=1e-12)
        tau = oracle.inverse_dynamics(q, dq, ddq)
        assert np.allclose(
            arm.inverse_dynamics(q, dq, ddq), tau, rtol=1e-10, atol=1e-11 * np.max(np.abs(tau))
        )
        assert np.allclose(arm.forward_dynamics(q, dq, tau), ddq, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("name", robots.names())
def test_each_arm_is_complete(name):
    arm = robots.load(name)
    assert arm.name == name and arm.has_dynamics and arm.effort == Effort.torque()
    assert {"source", "licence", "sensing"} <= set(arm.provenance)
    assert 9.8 < np.linalg.norm(arm.gravity) < 9.82
    assert all(inertia_complaint(j.inertia) is None for j in arm.joints)
    assert all(-math.inf < j.limits.lower < j.limits.upper < math.inf for j in arm.joints)
    assert {s.link for s in arm.shapes} == set(range(-1, arm.n))
    assert all(s.kind in ("box", "cylinder", "sphere") for s in arm.shapes)


@pytest.mark.parametrize("name", robots.names())
def test_urdf_round_trip(name):
    arm = robots.load(name)
    back = Arm.from_urdf(arm.to_urdf())
    q = np.linspace(-1, 1, arm.n)
    assert np.allclose(back.forward_kinematics(q), arm.forward_kinematics(q), atol=1e-14)
    assert np.allclose(back.gravity_torque(q), arm.gravity_torque(q), atol=1e-12)
    assert [j.sensing for j in back.joints] == [j.sensing for j in arm.joints]
    assert back.provenance == arm.provenance and back.effort == arm.effort


def test_justina_figures():
    arm = robots.load("justina_left_arm")
    assert arm.gravity.tolist() == [9.80665, 0, 0] and arm.grasp.tolist() == [0.075, 0, 0]
    assert arm.tip == "left_arm_grip_center"
    assert all(np.array_equal(j.inertia, 0.3 * np.eye(3)) for j in arm.joints)
    count = 2 * math.pi / 4096
    assert all(j.sensing.position_resolution == pytest.approx(count, rel=1e-15) for j in arm.joints)
    # integer noise of -2..2 counts, all alike, has the variance (5^2 - 1) / 12 = 2 counts^2
    assert all(j.sensing.position_std == pytest.approx(math.sqrt(2) * count, rel=1e-15) for j in arm.joints)
    steps = [j.sensing.torque_resolution * 1023 for j in arm.joints]
    assert steps == pytest.approx([7.3656, 7.3656, 6.4626, 7.3656, 6.4626, 6.4626, 6.4626])
    assert all(j.limits.effort == 2.5 for j in arm.joints)


def test_justina_box_differs_in_inertia_alone():
    published, box = robots.load("justina_left_arm"), robots.load("justina_left_arm_box")
    same = [b.replace(inertia=a.inertia) for a, b in zip(published.joints, box.joints, strict=True)]
    assert tuple(same) == published.joints and box.shapes == published.shapes
    link = box.joints[1]  # 0.2 kg, 0.21 x 0.04 x 0.04 m
    x, y, z = 0.21, 0.04, 0.04
    solid = 0.2 / 12 * np.diag([y * y + z * z, x * x + z * z, x * x + y * y])
    assert np.allclose(link.inertia, solid, rtol=1e-4)


def test_justina_weighs_with_its_sixth_joint():
    arm = robots.load("justina_left_arm")
    hanging = np.zeros(7)
    for theta in (0.3, 0.9, 1.5):
        hanging[5] = theta
        weighing = arm.weighing_joint(hanging)
        assert weighing.name == "la_6_joint" and weighing.index == 5
        assert weighing.lever == pytest.approx(0.205 * math.sin(theta), rel=1e-12)
        assert weighing.sin_angle == pytest.approx(math.sin(theta), rel=1e-12)
        assert weighing.perpendicularity == pytest.approx(1) and weighing.radius == pytest.approx(0.205)
    assert arm.weighing_joint(np.zeros(7)).name == "la_6_joint"
    along = np.linspace(0, 1, 50)[:, None] * JUSTINA_GOAL
    assert arm.weighing_joint(along).name == arm.weighing_joint(JUSTINA_GOAL).name == "la_6_joint"
    assert arm.weighing_joint((np.minimum(JUSTINA_GOAL, 0), np.maximum(JUSTINA_GOAL, 0))).name == "la_6_joint"


def test_a_held_mass_is_the_torque_over_gravity_along_the_jacobian():
    # payload of 0.25 kg at the grasp point: what the observer would report at joint 6, by MATH.md section 4
    arm = robots.load("justina_left_arm")
    q = np.array(JUSTINA_GOAL)
    force = 0.25 * arm.gravity
    tau_ext = arm.jacobian(q, arm.grasp)[:3].T @ force
    i = arm.weighing_joint(q).index
    assert tau_ext[i] / (arm.jacobian(q, arm.grasp)[:3, i] @ arm.gravity) == pytest.approx(0.25)
    assert abs(tau_ext[i]) == pytest.approx(0.25 * 9.80665 * arm.weighing_joint(q).lever)


def test_katana_weighs_with_its_fourth_joint():
    arm = robots.load("katana_300_6m180")
    stretched = arm.weighing_joint(np.zeros(5))
    assert stretched.name == "katana_motor4_lift_joint"
    assert stretched.lever == pytest.approx(0.2596, rel=1e-12) and stretched.sin_angle == pytest.approx(1)
    assert stretched.lever == pytest.approx(0.1523 + 0.0323 + 0.075)
    for q in ((0, 0.5, -0.5, 0, 0), (0, 0.435, -0.56, 0.057, 0)):
        weighing = arm.weighing_joint(q)
        assert weighing.name == "katana_motor4_lift_joint"
        # motor 4 turns the other way
        assert weighing.lever == pytest.approx(0.2596 * abs(math.cos(q[1] + q[2] - q[3])), rel=1e-12)


def test_katana_fingers_are_held_and_carried():
    for name in ("katana_300_6m180", "katana_450_6m90a"):
        arm = robots.load(name)
        assert arm.provenance["held at zero"] == "katana_r_finger_joint, katana_l_finger_joint"
        assert "katana_l_finger_link" in arm.frames
    wrist = 0.25622555625 + 0.0552136183596 + 2 * 0.0251722230462
    assert robots.load("katana_300_6m180").joints[4].mass == pytest.approx(wrist, rel=1e-14)
    assert robots.load("katana_450_6m90a").joints[4].mass == pytest.approx(wrist + 0.0012, rel=1e-14)


def test_katana_gravity_is_beyond_the_effort_limits_of_the_source():
    # why these are left out: 0.6 and 0.25 N m could not hold the arm up
    torque = np.abs(robots.load("katana_300_6m180").gravity_torque(np.zeros(5)))
    assert torque[1] > 6 and torque[2] > 2
    assert all(j.limits.effort == math.inf for j in robots.load("katana_300_6m180").joints)


def test_kuka_figures():
    for name, height, total in (("kuka_lbr_iiwa7", 1.306 - 0.04, 23.9), ("kuka_lbr_iiwa14", 1.306, 29.9)):
        arm = robots.load(name)
        tip = arm.forward_kinematics(np.zeros(7))[:3, 3]
        assert np.allclose(tip[:2], 0, atol=1e-15) and tip[2] == pytest.approx(height, abs=1e-12)
        base = {"kuka_lbr_iiwa7": 4.855658, "kuka_lbr_iiwa14": 7.050378}[name]
        assert sum(j.mass for j in arm.joints) + base == pytest.approx(total, abs=1e-5)
    assert [j.limits.effort for j in robots.load("kuka_lbr_iiwa14").joints] == [
        320,
        320,
        176,
        176,
        110,
        40,
        40,
    ]
    assert all(j.friction.viscous == 0 for j in robots.load("kuka_lbr_iiwa7").joints)
    assert robots.load("kuka_lbr_iiwa14").joints[0].friction.viscous == 0.2415


def test_abb_figures():
    arm = robots.load("abb_irb2400_16")
    tip = arm.forward_kinematics(np.zeros(6))
    assert np.allclose(tip[:3, 3], (0.1 + 0.755 + 0.085, 0, 0.615 + 0.705 + 0.135), atol=1e-15)
    assert np.allclose(tip[:3, 2], (1, 0, 0), atol=1e-15)
    assert arm.joints[0].friction.static == 36.3 and arm.joints[0].friction.stribeck_velocity == 0.0085
    assert sum(j.mass for j in arm.joints) + 125.585 == pytest.approx(381.36, abs=0.01)
    assert arm.joints[0].limits.effort == math.inf
