"""Arms from URDF: chain, folding and lumping against Pinocchio; every wrong file is an ArmError with its place."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from arm_oracle import Oracle, local_forward_kinematics, random_robot
from palpate.arm import Arm, Effort, Friction, Limits, Sensing
from palpate.errors import ArmError, MissingExtraError

INERTIAL = '<inertial><mass value="1"/><inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>'
ARM = f"""<robot name="two">
  <link name="base"/>
  <link name="upper">{INERTIAL}</link>
  <link name="fore">{INERTIAL}</link>
  <link name="hand"/>
  <joint name="shoulder" type="revolute">
    <origin xyz="0 0 0.3" rpy="0 0.1 0"/><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="2" velocity="3" effort="40"/><dynamics damping="0.5" friction="1.5"/>
  </joint>
  <joint name="elbow" type="revolute">
    <origin xyz="0.4 0 0"/><parent link="upper"/><child link="fore"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" velocity="3" effort="20"/>
  </joint>
  <joint name="wrist" type="fixed"><origin xyz="0.3 0 0"/><parent link="fore"/><child link="hand"/></joint>
</robot>"""


def changed(old: str, new: str, text: str = ARM) -> str:
    assert old in text
    return text.replace(old, new, 1)


def poses(arm: Arm, count: int = 5) -> np.ndarray:
    return np.random.default_rng(7).uniform(-1.5, 1.5, (count, 3, arm.n))


def assert_same_physics(arm: Arm, urdf: str) -> None:
    oracle = Oracle(urdf, arm)
    for i, joint in enumerate(arm.joints):
        mass, com, inertia = oracle.lumped(i)
        assert joint.mass == pytest.approx(mass, rel=1e-12)
        assert np.allclose(joint.com, com, rtol=1e-11, atol=1e-12)
        assert np.allclose(joint.inertia, inertia, rtol=1e-10, atol=1e-12)
    for q, dq, ddq in poses(arm):
        assert np.allclose(arm.forward_kinematics(q), oracle.T_base_frame(q, arm.tip), atol=1e-12)
        assert np.allclose(arm.jacobian(q), oracle.jacobian(q), atol=1e-11)
        M = oracle.mass_matrix(q)
        assert np.allclose(arm.mass_matrix(q), M, rtol=1e-10, atol=1e-10 * np.max(np.abs(M)))
        tau = oracle.inverse_dynamics(q, dq, ddq)
        assert np.allclose(
            arm.inverse_dynamics(q, dq, ddq), tau, rtol=1e-10, atol=1e-10 * np.max(np.abs(tau))
        )
        links = local_forward_kinematics(arm, q)
        for name, (link, T) in arm.frames.items():
            if name in oracle.frames:
                assert np.allclose(links[link + 1] @ T, oracle.T_base_frame(q, name), atol=1e-12)


# --- what is read ---------------------------------------------------------------------------------------------------


def test_two_joints():
    arm = Arm.from_urdf(ARM)
    assert (arm.name, arm.base, arm.tip, arm.joint_names) == ("two", "base", "hand", ("shoulder", "elbow"))
    shoulder, elbow = arm.joints
    assert shoulder.limits == Limits(-1, 2, 3, 40) and shoulder.friction == Friction(coulomb=1.5, viscous=0.5)
    assert elbow.friction == Friction() and elbow.sensing == Sensing()
    assert arm.T_last_tip[0, 3] == 0.3 and arm.effort == Effort.undeclared()
    assert arm.gravity.tolist() == [0, 0, -9.81] and arm.grasp.tolist() == [0, 0, 0]
    assert_same_physics(arm, ARM)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**9))
def test_random_trees_fold_and_lump_as_in_pinocchio(seed):
    urdf, base, tip = random_robot(seed)
    arm = Arm.from_urdf(urdf, base=base, tip=tip, gravity=np.random.default_rng(seed).normal(size=3))
    assert_same_physics(arm, urdf)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**9))
def test_random_arms_survive_the_way_through_urdf(seed):
    urdf, base, tip = random_robot(seed)
    rng = np.random.default_rng(seed)
    arm = Arm.from_urdf(urdf, base=base, tip=tip, gravity=rng.normal(size=3), effort=Effort.current(0.1, -50))
    joints = [
        j.replace(
            rotor_inertia=rng.uniform(0, 1),
            friction=Friction(
                *rng.uniform(0, 1, 3),
                static=2,
                stribeck_velocity=0.1,
                load=0.2,
                sign_velocity=0.3,
                presliding=0.4,
            ),
            sensing=Sensing(*rng.uniform(0, 1, 6)),
        )
        for j in arm.joints
    ]
    arm = arm.replace(joints=joints, grasp=rng.normal(size=3), provenance={"source": "a <b> & 'c' \"d\""})
    back = Arm.from_urdf(arm.to_urdf())
    assert back.effort == arm.effort and back.provenance == arm.provenance
    assert np.array_equal(back.gravity, arm.gravity) and np.array_equal(back.grasp, arm.grasp)
    assert back.frames.keys() == arm.frames.keys()
    for name, (link, T) in arm.frames.items():
        assert back.frames[name][0] == link and np.allclose(back.frames[name][1], T, atol=1e-14)
    for a, b in zip(arm.joints, back.joints, strict=True):
        assert (a.name, a.link, a.kind, a.limits, a.friction) == (
            b.name,
            b.link,
            b.kind,
            b.limits,
            b.friction,
        )
        assert (a.sensing, a.rotor_inertia, a.mass) == (b.sensing, b.rotor_inertia, b.mass)
        assert np.array_equal(a.com, b.com) and np.array_equal(a.inertia, b.inertia)
        assert np.array_equal(a.axis, b.axis) and np.allclose(a.T_parent_joint, b.T_parent_joint, atol=1e-14)


def test_rotations_at_the_poles_of_roll_pitch_yaw_survive():
    for rpy in (
        "0 1.5707963267948966 0.3",
        "0.4 -1.5707963267948966 0",
        "3.141592653589793 0 -3.141592653589793",
    ):
        arm = Arm.from_urdf(changed("0 0.1 0", rpy))
        back = Arm.from_urdf(arm.to_urdf())
        assert np.allclose(arm.joints[0].T_parent_joint, back.joints[0].T_parent_joint, atol=1e-15)


def test_default_tip_is_the_leaf_after_the_most_moving_joints():
    camera = '<link name="camera"/><joint name="c" type="fixed"><parent link="base"/><child link="camera"/></joint>'
    assert Arm.from_urdf(changed("</robot>", camera + "</robot>")).tip == "hand"
    twin = changed("</robot>", camera.replace('parent link="base"', 'parent link="fore"') + "</robot>")
    with pytest.raises(
        ArmError, match=r"2 chains of 2 moving joints start at 'base'; name one with tip=: camera, hand"
    ):
        Arm.from_urdf(twin)
    assert Arm.from_urdf(twin, tip="camera").tip == "camera"


def test_part_of_the_chain():
    arm = Arm.from_urdf(ARM, tip="upper")
    assert arm.joint_names == ("shoulder",)
    # the forearm is held at zero and carried by the upper arm
    assert arm.joints[0].mass == 2 and np.allclose(arm.joints[0].com, (0.2, 0, 0))
    assert arm.provenance["held at zero"] == "elbow"
    assert_same_physics(arm, ARM)
    arm = Arm.from_urdf(ARM, base="upper")
    assert arm.joint_names == ("elbow",) and arm.joints[0].mass == 1
    assert set(arm.frames) == {"upper", "fore", "hand"}


def whole_robot() -> str:
    """Torso on a lift, head, and two arms of three joints with two fingers each."""

    def link(name: str, mass: float = 1.0) -> str:
        return f'<link name="{name}">{INERTIAL}</link>'.replace('mass value="1"', f'mass value="{mass}"')

    def joint(
        name: str, kind: str, parent: str, child: str, xyz: str, rpy: str = "0 0 0", axis: str = "0 1 0"
    ) -> str:
        limit = (
            '<limit lower="-2" upper="2" velocity="1" effort="10"/>'
            if kind not in ("fixed", "continuous")
            else ""
        )
        return (
            f'<joint name="{name}" type="{kind}"><origin xyz="{xyz}" rpy="{rpy}"/><parent link="{parent}"/>'
            f'<child link="{child}"/><axis xyz="{axis}"/>{limit}</joint>'
        )

    parts = [link("wheels", 20), link("torso", 10), link("head", 3)]
    parts += [joint("lift", "prismatic", "wheels", "torso", "0 0 0.5", axis="0 0 1")]
    parts += [joint("neck", "continuous", "torso", "head", "0 0 0.5", axis="0 0 1")]
    for side, y in (("left", 0.3), ("right", -0.3)):
        s = side[0]
        parts += [link(f"{s}_{k}", 2.0 - i / 3) for i, k in enumerate(("shoulder", "upper", "fore"))]
        parts += [
            f'<link name="{s}_mount"/><link name="{s}_palm"/>',
            link(f"{s}_finger1", 0.1),
            link(f"{s}_finger2", 0.1),
        ]
        parts += [
            joint(f"{s}_m", "fixed", "torso", f"{s}_mount", f"0 {y} 0.4", "0.3 1.2 -0.2"),
            joint(f"{s}_1", "revolute", f"{s}_mount", f"{s}_shoulder", "0 0 0.05", axis="0 0 1"),
            joint(f"{s}_2", "revolute", f"{s}_shoulder", f"{s}_upper", "0 0.05 0.05", "0 0 0.4"),
            joint(f"{s}_3", "continuous", f"{s}_upper", f"{s}_fore", "0.3 0 0"),
            joint(f"{s}_p", "fixed", f"{s}_fore", f"{s}_palm", "0.25 0 0", "1 0 0"),
            joint(f"{s}_f1", "prismatic", f"{s}_palm", f"{s}_finger1", "0.05 0.04 0"),
            joint(f"{s}_f2", "prismatic", f"{s}_palm", f"{s}_finger2", "0.05 -0.04 0").replace(
                "</joint>", f'<mimic joint="{s}_f1" multiplier="-1"/></joint>'
            ),
        ]
    return '<robot name="robot">' + "".join(parts) + "</robot>"


def test_one_arm_of_a_whole_robot_on_a_tilted_base():
    urdf = whole_robot()
    arm = Arm.from_urdf(urdf, base="l_mount", tip="l_palm", gravity=(1.0, -2.0, -9.0))
    assert arm.joint_names == ("l_1", "l_2", "l_3")
    assert arm.joints[2].limits.lower == -math.inf and arm.joints[2].kind == "revolute"
    assert arm.provenance["held at zero"] == "l_f1, l_f2"
    assert sum(j.mass for j in arm.joints) == pytest.approx(2 + 5 / 3 + 4 / 3 + 0.2)
    assert_same_physics(arm, urdf.replace('<mimic joint="l_f1" multiplier="-1"/>', ""))
    # the same arm from the robot's root: the lift is one more joint, everything else hangs on it
    longer = Arm.from_urdf(urdf, base="wheels", tip="r_palm")
    assert longer.joint_names == ("lift", "r_1", "r_2", "r_3")
    assert_same_physics(longer, urdf)
    assert longer.joints[0].mass == pytest.approx(10 + 3 + 2 + 5 / 3 + 4 / 3 + 0.2)


def test_gravity_belongs_to_the_base():
    # an arm on a tilted mount is the same arm with gravity turned into the mount's axes
    mount = (
        '<link name="floor"/><joint name="m" type="fixed"><origin rpy="0.4 -0.7 0.2"/>'
        '<parent link="floor"/><child link="base"/></joint>'
    )
    urdf = changed("</robot>", mount + "</robot>")
    whole = Arm.from_urdf(urdf)
    assert whole.base == "floor"
    R = whole.frames["base"][1][:3, :3]
    part = Arm.from_urdf(urdf, base="base", gravity=R.T @ whole.gravity)
    for q, dq, ddq in poses(part):
        assert np.allclose(part.inverse_dynamics(q, dq, ddq), whole.inverse_dynamics(q, dq, ddq), rtol=1e-12)


def test_visuals_become_shapes():
    visuals = """
      <visual><origin xyz="0.1 0 0"/><geometry><box size="0.1 0.2 0.3"/></geometry><material name="blue"/></visual>
      <visual><geometry><cylinder radius="0.1" length="0.4"/></geometry></visual>
      <visual><geometry><sphere radius="0.1"/></geometry><material><color rgba="1 0 0 0.5"/></material></visual>
      <visual><geometry><capsule radius="0.1" length="0.2"/></geometry></visual>
      <visual><geometry><mesh filename="package://x/hand.stl" scale="1 1 -1"/></geometry></visual>"""
    text = changed('<link name="hand"/>', f'<link name="hand">{visuals}</link>')
    text = changed("<robot", '<?xml version="1.0" encoding="utf-8"?>\n<robot', text)
    text = changed(
        '<link name="base"/>',
        '<material name="blue"><color rgba="0 0 1 1"/></material><link name="base"/>',
        text,
    )
    box, cylinder, sphere, capsule, mesh = Arm.from_urdf(text).shapes
    assert (box.kind, box.size, box.link, box.rgba) == ("box", (0.1, 0.2, 0.3), 1, (0, 0, 1, 1))
    assert box.T[:3, 3].tolist() == [0.4, 0, 0]  # the hand is 0.3 m out on the forearm
    assert cylinder.size == (0.1, 0.4) and sphere.rgba == (1, 0, 0, 0.5) and capsule.kind == "capsule"
    assert (mesh.filename, mesh.size) == ("package://x/hand.stl", (1, 1, -1))
    arm = Arm.from_urdf(text)
    back = Arm.from_urdf(arm.to_urdf())
    for a, b in zip(arm.shapes, back.shapes, strict=True):
        assert (a.kind, a.size, a.link, a.rgba, a.filename) == (b.kind, b.size, b.link, b.rgba, b.filename)
        assert np.array_equal(a.T, b.T)


def test_limits_in_all_their_dialects():
    def limits(limit: str, kind: str = "revolute") -> Limits:
        text = changed('<limit lower="-2" upper="2" velocity="3" effort="20"/>', limit)
        return (
            Arm.from_urdf(changed('"elbow" type="revolute"', f'"elbow" type="{kind}"', text)).joints[1].limits
        )

    assert limits("") == limits("<limit/>") == Limits()
    assert limits('<limit velocity="0" effort="0"/>') == Limits()
    assert limits(
        '<limit lower="-1e308" upper="inf" effort="1.7976931348623157e308" velocity="2"/>'
    ) == Limits(velocity=2)
    assert limits('<limit upper="1" velocity="2" effort="3"/>') == Limits(0, 1, 2, 3)
    assert limits('<limit lower="-1" upper="1" velocity="2" effort="3"/>', "continuous") == Limits(
        velocity=2, effort=3
    )


def test_unlimited_joints_survive_the_way_through_urdf():
    arm = Arm.from_urdf(ARM)
    for limits in (Limits(), Limits(lower=-1), Limits(upper=2.5), Limits(effort=5)):
        one = arm.replace(joints=(arm.joints[0].replace(limits=limits), arm.joints[1]))
        assert Arm.from_urdf(one.to_urdf()).joints[0].limits == limits
        assert_same_physics(one, one.to_urdf())


def test_frames_may_be_massless_and_side_branches_may_float():
    extra = """<link name="ball"/><joint name="free" type="floating"><parent link="fore"/><child link="ball"/></joint>
      <link name="tag"/>
      <joint name="t" type="fixed"><parent link="ball"/><child link="tag"/></joint>"""
    arm = Arm.from_urdf(changed("</robot>", extra + "</robot>"), tip="hand")
    assert arm.provenance["left out, not rigidly carried"] == "free"
    assert "ball" not in arm.frames and "tag" not in arm.frames


def test_mass_of_fixed_children_may_stand_in_for_the_link_s_own():
    text = changed(f'<link name="fore">{INERTIAL}</link>', '<link name="fore"/>')
    text = changed('<link name="hand"/>', f'<link name="hand">{INERTIAL}</link>', text)
    arm = Arm.from_urdf(text)
    assert arm.joints[1].mass == 1 and arm.joints[1].com.tolist() == [0.3, 0, 0]
    point = changed('ixx="0.01" iyy="0.01" izz="0.01"', 'ixx="0" iyy="0" izz="0"', INERTIAL)
    text = changed('<link name="hand"/>', f'<link name="hand">{point}</link>')
    assert Arm.from_urdf(text).joints[1].mass == 2


def test_kinematics_alone():
    text = ARM.replace(INERTIAL, "")
    arm = Arm.from_urdf(text, inertials=False)
    assert not arm.has_dynamics
    assert np.array_equal(
        arm.forward_kinematics((0.1, 0.2)), Arm.from_urdf(ARM).forward_kinematics((0.1, 0.2))
    )
    back = Arm.from_urdf(arm.to_urdf(), inertials=False)
    assert not back.has_dynamics
    assert np.allclose(back.forward_kinematics((0.1, 0.2)), arm.forward_kinematics((0.1, 0.2)), atol=1e-15)


def test_impossible_inertia_can_be_repaired_on_request():
    text = changed('ixx="0.01" iyy="0.01" izz="0.01"', 'ixx="0.01" iyy="0.01" izz="0.05"')
    with pytest.raises(
        ArmError, match=r"text:3: link 'upper' with mass 1 kg: inertia breaks the triangle .*repair_inertia"
    ):
        Arm.from_urdf(text)
    arm = Arm.from_urdf(text, repair_inertia=True)
    assert arm.provenance["inertia repaired"] == "upper"
    moments = np.linalg.eigvalsh(arm.joints[0].inertia)
    assert moments[0] + moments[1] > moments[2] > 0 and arm.joints[0].mass == 1
    assert np.allclose(arm.joints[0].inertia, np.diag(np.diag(arm.joints[0].inertia)))
    zero = changed('ixx="0.01" iyy="0.01" izz="0.01"', 'ixx="0" iyy="0" izz="0"')
    assert np.all(np.linalg.eigvalsh(Arm.from_urdf(zero, repair_inertia=True).joints[0].inertia) > 0)


# --- palpate's own element ------------------------------------------------------------------------------------------

EXTRA = """<palpate version="1" base="base" tip="hand" gravity="0 9.8 0" grasp="0 0 0.1">
    <effort kind="current" k_t="0.1 0.2" gear="100"/>
    <joint name="elbow" rotor_inertia="0.2"><friction offset="0.3"/><sensing position_std="0.01"/></joint>
    <provenance key="source">a  data
      sheet</provenance>
  </palpate></robot>"""


def test_palpate_element_is_read_and_arguments_win():
    text = changed("</robot>", EXTRA)
    arm = Arm.from_urdf(text)
    assert arm.gravity.tolist() == [0, 9.8, 0] and arm.grasp.tolist() == [0, 0, 0.1]
    assert arm.effort.gain(2).tolist() == [10, 20] and arm.provenance == {"source": "a data sheet"}
    elbow = arm.joints[1]
    assert elbow.rotor_inertia == 0.2 and elbow.friction.offset == 0.3 and elbow.sensing.position_std == 0.01
    other = Arm.from_urdf(text, gravity=(1, 2, 3), grasp=(4, 5, 6), effort=Effort.torque())
    assert (
        other.gravity.tolist() == [1, 2, 3]
        and other.grasp.tolist() == [4, 5, 6]
        and other.effort == Effort.torque()
    )
    # the file's grasp point is one of its own tip, its gravity one of its own base
    assert Arm.from_urdf(text, tip="fore").grasp.tolist() == [0, 0, 0]
    with pytest.raises(ArmError, match="states gravity for the base 'base'; give gravity= for 'upper'"):
        Arm.from_urdf(text, base="upper", effort=Effort.torque())


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('version="1"', 'version="2"', r":15: <palpate> version must be 1, got '2'"),
        ('tip="hand"', 'tip="hnad"', "no tip link 'hnad'; did you mean 'hand'"),
        ('tip="hand"', 'tipp="hand"', "<palpate> has no attribute 'tipp'; did you mean 'tip'"),
        ("<effort ", "<efort ", "<palpate> has no element 'efort'; did you mean 'effort'"),
        ('kind="current"', 'kind="voltage"', ":16: effort kind must be"),
        ('gear="100"', 'gear=""', "'gear' of <effort> must be some finite number"),
        ('k_t="0.1 0.2"', 'k_t="1 2 3"', "effort k_t must hold 1 or 2 numbers, got 3"),
        ('name="elbow" rotor', 'name="elbov" rotor', "no joint 'elbov'; did you mean 'elbow'"),
        ('offset="0.3"', 'ofset="0.3"', "<friction> has no attribute 'ofset'; did you mean 'offset'"),
        ('position_std="0.01"', 'position_std="-1"', "joint 'elbow': sensing position_std must be >= 0"),
        ('rotor_inertia="0.2"', 'rotor_inertia="-2"', "joint 'elbow': rotor_inertia must be >= 0"),
        ("<provenance key", "<provenance kez", "has no attribute 'kez'"),
    ],
)
def test_palpate_element_with_a_mistake(old, new, message):
    with pytest.raises(ArmError, match=message):
        Arm.from_urdf(changed(old, new, changed("</robot>", EXTRA)))


# --- wrong files ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("<robot", "<model", r"URDF text:\d+: malformed XML: mismatched tag"),
        ("</robot>", "", r"URDF text:\d+: malformed XML"),
        (' name="hand"', "", r"URDF text:5: <link> needs the attribute 'name'"),
        ('"hand"', '""', "URDF text:5: <link> has an empty 'name'"),
        ('link name="hand"', 'link name="fore"', "URDF text:5: link 'fore' is defined twice"),
        ('name="elbow"', 'name="shoulder"', "URDF text:10: joint 'shoulder' is defined twice"),
        (
            '"elbow" type="revolute"',
            '"elbow" type="revolut"',
            "unknown type 'revolut'; did you mean 'revolute'",
        ),
        ('"elbow" type="revolute"', '"elbow"', "<joint> needs the attribute 'type'"),
        (
            '<parent link="upper"/>',
            '<parent link="uper"/>',
            "joint 'elbow': no link 'uper'; did you mean 'upper'",
        ),
        ('<parent link="upper"/>', "", "URDF text:10: <joint> 'elbow' needs a <parent>"),
        (
            '<child link="fore"/>',
            '<child link="upper"/>',
            "link 'upper' is the child of both 'shoulder' and 'elbow'",
        ),
        ('<parent link="base"/>', '<parent link="hand"/>', "the tip 'hand' does not hang on the base 'base'"),
        ('<axis xyz="0 1 0"/>', '<axis xyz="0 0 0"/>', "joint 'shoulder' has the axis 0 0 0"),
        (
            '<axis xyz="0 1 0"/>',
            '<axis xyz="0 1"/>',
            r"'xyz' of <axis> must be 3 finite number\(s\), got '0 1'",
        ),
        ('"0 0 0.3"', '"0 0 nan"', "'xyz' of <origin> must be 3 finite"),
        ('"0 0 0.3"', '"0 0 inf"', "'xyz' of <origin> must be 3 finite"),
        ('"0 0 0.3"', '"0 0 1_0"', "'xyz' of <origin> must be 3 finite"),
        ('"0 0 0.3"', '"0 0 1e300"', "URDF text:7: no <origin> is '0 0 1e300' m away"),
        ('mass value="1"', 'mass value="0"', "link 'upper' has an inertia but no mass"),
        ('mass value="1"', 'mass value="-1"', "URDF text:3: link 'upper' has a negative mass, -1.0 kg"),
        ('mass value="1"', 'mass valu="1"', "<mass> needs the attribute 'value'"),
        ('ixx="0.01"', 'ixx="x"', "'ixx' of <inertia> must be 1 finite"),
        ('ixx="0.01"', 'ixx="1e300"', "has a mass or an inertia beyond 1e"),
        (
            'ixx="0.01"',
            'ixx="-0.01"',
            "URDF text:3: link 'upper' with mass 1 kg: inertia is not positive definite",
        ),
        ('ixx="0.01"', 'ixx="0.021"', "inertia breaks the triangle inequality: 0.01 . 0.01 < 0.021"),
        ('ixx="0.01"', 'ixx="0"', "inertia is not positive definite"),
        (INERTIAL, "", r"link 'upper' is moved by joint 'shoulder' but has no <inertial>, .*inertials=False"),
        (INERTIAL, f"{INERTIAL}{INERTIAL}", "<link> has more than one <inertial>"),
        (
            '<dynamics damping="0.5"',
            '<dynamics damping="-1"',
            "URDF text:8: joint 'shoulder': friction viscous must be >= 0",
        ),
        (
            'lower="-1" upper="2"',
            'lower="3" upper="2"',
            "URDF text:8: joint 'shoulder': limits: lower must not exceed",
        ),
        ('lower="-1"', 'lower="nan"', "'lower' of <limit> must be 1 finite"),
        ('velocity="3"', 'velocity="-3"', "joint 'shoulder': limits velocity must be > 0"),
        (
            '"elbow" type="revolute"',
            '"elbow" type="floating"',
            "joint 'elbow' between base and tip is floating, .*base='fore'",
        ),
        ('"elbow" type="revolute"', '"elbow" type="planar"', "joint 'elbow' between base and tip is planar"),
        (
            '<origin xyz="0.4',
            '<mimic joint="shoulder"/><origin xyz="0.4',
            "'elbow' between base and tip mimics .*tip='upper'",
        ),
        (
            '<link name="hand"/>',
            '<link name="hand"><visual/></link>',
            "URDF text:5: <visual> '' needs a <geometry>",
        ),
        (
            '<link name="hand"/>',
            '<link name="hand"><visual><geometry><cone/></geometry></visual></link>',
            "URDF text:5: unknown shape <cone>; ",
        ),
    ],
)
def test_wrong_files_are_refused_with_their_place(old, new, message):
    with pytest.raises(ArmError, match=message):
        Arm.from_urdf(changed(old, new), tip="hand")


def test_massless_moving_link():
    text = changed(INERTIAL, '<inertial><mass value="0"/><inertia ixx="0" iyy="0" izz="0"/></inertial>')
    with pytest.raises(ArmError, match="link 'upper' is moved by joint 'shoulder' but has a mass of 0"):
        Arm.from_urdf(text)


def test_wrong_ends():
    with pytest.raises(ArmError, match="no tip link 'hans'; did you mean 'hand'"):
        Arm.from_urdf(ARM, tip="hans")
    with pytest.raises(ArmError, match="no base link 'world'; links: base, fore, hand, upper"):
        Arm.from_urdf(ARM, base="world")
    with pytest.raises(ArmError, match="the tip 'base' does not hang on the base 'fore'"):
        Arm.from_urdf(ARM, base="fore", tip="base")
    with pytest.raises(ArmError, match="no moving joint between the base 'fore' and the tip 'hand'"):
        Arm.from_urdf(ARM, base="fore")


def test_loops_end():
    loop = '<robot name="loop"><link name="a"/><link name="b"/>' + "".join(
        f'<joint name="{p}{c}" type="fixed"><parent link="{p}"/><child link="{c}"/></joint>'
        for p, c in ("ab", "ba")
    )
    with pytest.raises(ArmError, match="no root link: its joints form a loop"):
        Arm.from_urdf(loop + "</robot>")
    for kw in ({"base": "a"}, {"base": "a", "tip": "b"}, {"base": "a", "tip": "a"}):
        with pytest.raises(ArmError, match="loop|no moving joint"):
            Arm.from_urdf(loop + "</robot>", **kw)


def test_too_many_joints():
    links = "".join(f'<link name="l{i}">{INERTIAL}</link>' for i in range(18))
    joints = "".join(
        f'<joint name="j{i}" type="continuous"><parent link="l{i}"/><child link="l{i + 1}"/></joint>'
        for i in range(17)
    )
    with pytest.raises(ArmError, match="must have 1 to 16 moving joints, got 17"):
        Arm.from_urdf(f'<robot name="snake">{links}{joints}</robot>')


def test_entities_are_refused(tmp_path):
    secret = tmp_path / "secret"
    secret.write_text("hidden")
    bomb = '<!DOCTYPE robot [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;">]><robot name="&b;"/>'
    outside = f'<!DOCTYPE robot [<!ENTITY x SYSTEM "file://{secret}">]><robot name="&x;"/>'
    for text in (bomb, outside, '<!DOCTYPE robot SYSTEM "http://localhost/x.dtd"><robot/>'):
        with pytest.raises(ArmError, match="URDF text:1: a DOCTYPE"):
            Arm.from_urdf(text)


def test_deep_and_huge_files_are_refused(tmp_path):
    with pytest.raises(ArmError, match="nested deeper than 64"):
        Arm.from_urdf("<robot>" + "<a>" * 100_000)
    huge = tmp_path / "huge.urdf"
    with huge.open("wb") as file:
        file.truncate(17 * 2**20)
    with pytest.raises(ArmError, match="huge.urdf: larger than 16 MiB"):
        Arm.from_urdf(huge)


def test_files(tmp_path):
    path = tmp_path / "two.urdf"
    path.write_text(ARM)
    arm = Arm.from_urdf(path)
    assert arm.provenance["file"] == "two.urdf" and arm == Arm.from_urdf(str(path))
    path.write_bytes(
        ('<?xml version="1.0" encoding="utf-16"?>' + changed('"two"', '"zwoölf"')).encode("utf-16")
    )
    assert Arm.from_urdf(path).name == "zwoölf"
    path.write_bytes(b'<?xml version="1.0" encoding="utf-8"?><robot name="\xff"/>')
    with pytest.raises(ArmError, match="two.urdf:1: malformed XML"):
        Arm.from_urdf(path)
    path.write_text('<?xml version="1.0" encoding="klingon"?><robot/>')
    with pytest.raises(ArmError, match="two.urdf.*malformed XML"):
        Arm.from_urdf(path)
    for wrong in (
        tmp_path,
        tmp_path / "none.urdf",
        tmp_path / "none.xacro",
        "x\0y",
        None,
        3,
        "",
        "x" * 5000,
        b"<robot/>",
    ):
        with pytest.raises(ArmError, match="cannot read the URDF"):
            Arm.from_urdf(wrong)
    with pytest.raises(ArmError, match=r"the root element must be <robot>, got <sdf>"):
        Arm.from_urdf("<sdf/>")
    with pytest.raises(ArmError, match="the robot has no <link>"):
        Arm.from_urdf("<robot/>")
    assert (
        Arm.from_urdf('\ufeff\n<?xml version="1.0" encoding="latin-1"?>' + changed('"two"', '"ö"')).name
        == "ö"
    )


def test_names_xml_cannot_hold():
    arm = Arm.from_urdf(ARM)
    assert Arm.from_urdf(arm.replace(name="a<b>&\"c'\n").to_urdf()).name == "a<b>&\"c'"
    for wrong in (arm.replace(name="a\0b"), arm.replace(provenance={"k": "\ud800"})):
        with pytest.raises(ArmError, match="characters that XML cannot"):
            wrong.to_urdf()


# --- xacro ----------------------------------------------------------------------------------------------------------

XACRO = changed(
    '<robot name="two">',
    '<robot name="two" xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:arg name="reach" default="0.4"/>',
)
XACRO = changed('xyz="0.4 0 0"', "xyz=\"${2 * float('$(arg reach)') / 2} 0 0\"", XACRO)


def test_xacro_file_and_text(tmp_path):
    pytest.importorskip("xacro", reason="palpate[xacro] is not installed")
    path = tmp_path / "two.urdf.xacro"
    path.write_text(XACRO)
    for source in (path, str(path), XACRO):
        assert Arm.from_urdf(source).joints[1].T_parent_joint[0, 3] == 0.4
        assert Arm.from_urdf(source, xacro_args={"reach": 0.7}).joints[1].T_parent_joint[0, 3] == 0.7
    path.write_text(changed("$(arg reach)", "$(arg rich)", XACRO))
    with pytest.raises(ArmError, match=r"two.urdf.xacro: xacro: .*rich"):
        Arm.from_urdf(path)
    path.write_text(changed("0.1 0", "${1 / 0} 0", XACRO))
    with pytest.raises(ArmError, match=r"two.urdf.xacro: xacro: .*division by zero"):
        Arm.from_urdf(path)
    path.write_text("<robot")
    with pytest.raises(ArmError, match=r"two.urdf.xacro:1: malformed XML"):
        Arm.from_urdf(path)
    # macros in a file that does not say so by its name are macros all the same; in a comment they are not
    path = tmp_path / "two.urdf"
    path.write_text(XACRO)
    assert Arm.from_urdf(path).joints[1].T_parent_joint[0, 3] == 0.4
    assert Arm.from_urdf(changed("</robot>", "<!-- <xacro:x/> --></robot>")).n == 2


def test_xacro_without_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "xacro", None)
    with pytest.raises(
        MissingExtraError, match=r'the xacro file URDF text needs `pip install "palpate\[xacro\]"`'
    ):
        Arm.from_urdf(XACRO)


# --- noise ----------------------------------------------------------------------------------------------------------

SEEDS = [ARM, changed("</robot>", EXTRA), whole_robot()]
JUNK = [
    "",
    "nan",
    "inf",
    "-1",
    "1e308",
    "1e-308",
    "0 0 0",
    "x",
    "<",
    ">",
    "&",
    '"',
    "revolute",
    "\0",
    "é",
    "</link>",
    "9" * 400,
]


@settings(max_examples=400, deadline=None)
@given(st.data())
def test_damaged_files_give_an_arm_or_an_arm_error(data):
    text = data.draw(st.sampled_from(SEEDS))
    for _ in range(data.draw(st.integers(1, 4))):
        start = data.draw(st.integers(0, len(text)))
        end = min(len(text), start + data.draw(st.integers(0, 12)))
        text = text[:start] + data.draw(st.sampled_from(JUNK) | st.text(max_size=4)) + text[end:]
    expect_arm_or_error("<" + text[1:])


@settings(max_examples=400, deadline=None)
@given(st.data())
def test_odd_attributes_give_an_arm_or_an_arm_error(data):
    parts = data.draw(st.sampled_from(SEEDS)).split('"')
    for _ in range(data.draw(st.integers(1, 3))):
        # odd pieces between quotes are the attribute values
        parts[2 * data.draw(st.integers(0, len(parts) // 2 - 1)) + 1] = data.draw(
            st.sampled_from(
                [
                    "",
                    "nan",
                    "inf",
                    "-inf",
                    "0",
                    "-1",
                    "1e9",
                    "1e308",
                    "5e-324",
                    "0 0 0",
                    "1 2",
                    "1e9 1e9 1e9",
                    "hand",
                ]
            )
            | st.floats(allow_nan=False).map(repr)
        )
    expect_arm_or_error('"'.join(parts))


@settings(max_examples=100, deadline=None)
@given(st.binary(max_size=300))
def test_any_bytes_give_an_arm_error(tmp_path_factory, data):
    path: Path = tmp_path_factory.mktemp("noise") / "x.urdf"
    path.write_bytes(data)
    with pytest.raises(ArmError):
        Arm.from_urdf(path)


def expect_arm_or_error(text: str) -> None:
    try:
        arm = Arm.from_urdf(text)
        assert np.all(np.isfinite(arm.gravity_torque(np.zeros(arm.n))))
    except ArmError as e:
        assert "\n" not in str(e)
