"""The arm's data model: checks, immutability, equality, and the model functions' arguments."""

from __future__ import annotations

import copy
import math
import pickle
import subprocess
import sys

import numpy as np
import pytest

from palpate.arm import Arm, Effort, Friction, Joint, Limits, Sensing, Shape, inertia_complaint
from palpate.errors import ArmError, MissingExtraError, PalpateError, suggest


def joint(name: str = "j", **changes: object) -> Joint:
    fields: dict[str, object] = {
        "name": name,
        "link": f"{name}_link",
        "kind": "revolute",
        "T_parent_joint": np.eye(4),
        "axis": (0, 0, 1),
        "mass": 2,
        "com": (0.1, 0, 0),
        "inertia": np.diag([0.02, 0.03, 0.04]),
    }
    return Joint(**(fields | changes))  # type: ignore[arg-type]


def pendulum(**changes: object) -> Arm:
    """Two links in a vertical plane, 0.5 m each, turning about the base's y axis."""
    T = np.eye(4)
    T[0, 3] = 0.5
    joints = (joint("a", axis=(0, 1, 0)), joint("b", axis=(0, 1, 0), T_parent_joint=T))
    return Arm(**({"name": "pendulum", "joints": joints, "T_last_tip": T} | changes))  # type: ignore[arg-type]


# --- fields ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Friction(coulomb=-1), "friction coulomb must be >= 0, got -1"),
        (lambda: Friction(viscous=math.nan), "friction viscous must be finite"),
        (lambda: Friction(offset="much"), "friction offset must be a number, got 'much'"),
        (lambda: Friction(static=1), "static and stribeck_velocity together"),
        (lambda: Friction(static=1, stribeck_velocity=0), "stribeck_velocity must be > 0"),
        (lambda: Friction(sign_velocity=0), "sign_velocity must be > 0"),
        (lambda: Friction(presliding=-1e-3), "presliding must be >= 0"),
        (lambda: Sensing(position_std=-1e-3), "sensing position_std must be >= 0"),
        (lambda: Sensing(velocity_std=math.inf), "sensing velocity_std must be finite"),
        (lambda: Limits(lower=1, upper=0), r"lower must not exceed upper, got \[1.0, 0.0\]"),
        (lambda: Limits(upper=math.nan), "limits upper must not be NaN"),
        (lambda: Limits(velocity=0), "limits velocity must be > 0"),
        (lambda: Limits(effort=None), "limits effort must be a number, got None"),
        (
            lambda: Effort("volts"),
            "effort kind must be torque, current, phase_currents or undeclared, got 'volts'",
        ),
        (lambda: Effort.current(0.0), "effort k_t must be numbers other than 0"),
        (lambda: Effort.current([]), "effort k_t must be numbers other than 0"),
        (lambda: Effort.current("0.1 0.2"), "effort k_t must be a number, got '0.1 0.2'"),
        (lambda: Effort("torque", (2.0,)), "k_t has a meaning for kinds current and phase_currents only"),
        (lambda: Shape("cone", (1,), np.eye(4), 0), "shape kind must be one of box, cylinder"),
        (lambda: Shape("box", (1, 2), np.eye(4), 0), "a box has 3 sizes, got 2"),
        (lambda: Shape("sphere", (-1,), np.eye(4), 0), "sizes of a sphere must be >= 0"),
        (lambda: Shape("mesh", (1, 1, 1), np.eye(4), 0), "a mesh, and nothing else, has a file name"),
        (lambda: Shape("box", (1, 1, 1), np.eye(4), 0, (1, 1, 1)), "rgba has 4 numbers"),
        (lambda: joint(kind="ball"), "joint 'j': kind must be revolute or prismatic, got 'ball'"),
        (lambda: joint(name=""), "joint name must be a non-empty text"),
        (lambda: joint(axis=(0, 0, 2)), "axis must be a unit vector"),
        (lambda: joint(axis=(0, 0)), r"axis must have shape \(3,\), got \(2,\)"),
        (lambda: joint(T_parent_joint=np.diag([1, 1, -1, 1])), "must be a rotation"),
        (lambda: joint(T_parent_joint=np.ones((4, 4))), "the last row must be 0 0 0 1"),
        (lambda: joint(mass=-1), "joint 'j': mass must be >= 0"),
        (lambda: joint(mass=0), "has no mass but a centre of mass or an inertia"),
        (lambda: joint(inertia=np.zeros((3, 3))), "not positive definite"),
        (lambda: joint(inertia=np.diag([1, 1, -1])), "not positive definite"),
        (lambda: joint(inertia=np.diag([1, 1, 3])), r"triangle inequality: 1 \+ 1 < 3"),
        (lambda: joint(inertia=[[1, 1, 0], [0, 1, 0], [0, 0, 1]]), "inertia must be symmetric"),
        (lambda: joint(rotor_inertia=-1), "rotor_inertia must be >= 0"),
        (lambda: joint(limits=(0, 1)), r"limits must be a palpate Limits, got \(0, 1\)"),
        (lambda: pendulum(name=""), "name must be a non-empty text"),
        (lambda: pendulum(joints=()), "must have 1 to 16 moving joints, got 0"),
        (
            lambda: pendulum(joints=[joint(str(i)) for i in range(17)]),
            "must have 1 to 16 moving joints, got 17",
        ),
        (lambda: pendulum(joints=(joint(), joint())), "joint name 'j' is used twice"),
        (lambda: pendulum(joints=("a",)), "joints must be palpate Joints"),
        (lambda: pendulum(joints=(joint("a"), massless("b"))), "link 'b_link' has no mass"),
        (lambda: pendulum(gravity=(0, 0, math.inf)), "gravity must be finite"),
        (lambda: pendulum(grasp=(0, 0)), r"grasp must have shape \(3,\)"),
        (lambda: pendulum(effort="torque"), "effort must be Effort.torque"),
        (lambda: pendulum(effort=Effort.current([1, 2, 3])), "effort k_t must hold 1 or 2 numbers, got 3"),
        (lambda: pendulum(shapes=(Shape("sphere", (1,), np.eye(4), 2),)), "shapes must be palpate Shapes"),
        (lambda: pendulum(frames={"camera": (5, np.eye(4))}), "frame 'camera' must be on a link from -1"),
        (lambda: pendulum(frames={"a_link": (1, np.eye(4))}), "frame 'a_link' is a link of the chain"),
        (lambda: pendulum(base="a_link"), "the base and a link are both named 'a_link'"),
        (lambda: pendulum(tip="a_link"), "the tip's name 'a_link' belongs to another frame"),
    ],
)
def test_what_is_wrong_is_refused_and_named(build, message):
    with pytest.raises(ArmError, match=message):
        build()


def massless(name: str) -> Joint:
    return joint(name, mass=0, com=(0, 0, 0), inertia=np.zeros((3, 3)))


def test_integers_lists_and_arrays_are_alike():
    a = joint(mass=2, com=[0.1, 0, 0], axis=np.array([0, 0, 1]))
    assert a == joint(mass=2.0, com=(0.1, 0.0, 0.0), axis=(0.0, 0.0, 1.0))
    assert type(a.mass) is float and a.com.dtype == np.float64


def test_coarse_rotation_becomes_the_nearest_exact_one():
    T = np.eye(4)
    T[:3, :3] = [[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1]]
    T[:3, :3] += 1e-8
    R = joint(T_parent_joint=T).T_parent_joint[:3, :3]
    assert np.max(np.abs(R.T @ R - np.eye(3))) < 1e-15
    assert np.max(np.abs(R - T[:3, :3])) < 2e-8
    again = joint(T_parent_joint=T)
    assert joint(T_parent_joint=again.T_parent_joint) == again


def test_inertia_of_a_thin_plate_with_rounding_passes():
    assert inertia_complaint(np.diag([1.0, 1.0, 2.0 + 1e-7])) is None
    assert "triangle" in inertia_complaint(np.diag([1.0, 1.0, 2.01]))
    assert inertia_complaint(np.zeros((3, 3)), definite=False) is None


def test_published_inertias_far_too_large_are_still_possible():
    assert joint(mass=0.15, inertia=0.3 * np.eye(3)).inertia[0, 0] == 0.3


def test_nothing_can_be_changed():
    arm = pendulum(frames={"camera": (0, np.eye(4))}, provenance={"source": "test"})
    arrays = [arm.gravity, arm.T_last_tip, arm.grasp, arm.frames["camera"][1], arm.frames[arm.tip][1]]
    arrays += [a for j in arm.joints for a in (j.T_parent_joint, j.axis, j.com, j.inertia)]
    for array in arrays:
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0
    with pytest.raises(AttributeError):
        arm.name = "other"
    with pytest.raises(TypeError):
        arm.frames["new"] = (0, np.eye(4))
    with pytest.raises(TypeError):
        arm.provenance["source"] = "other"


def test_input_arrays_are_copied():
    gravity = np.array([0, 0, -9.81])
    arm = pendulum(gravity=gravity)
    gravity[:] = 1
    assert arm.gravity.tolist() == [0, 0, -9.81]


def test_equality_is_to_the_bit():
    arm = pendulum()
    assert arm == pendulum() and hash(arm) == hash(pendulum())
    assert arm != pendulum(gravity=(0, 0, np.nextafter(-9.81, 0)))
    assert arm != pendulum(effort=Effort.torque())
    assert arm != "pendulum"


@pytest.mark.parametrize("remake", [lambda a: pickle.loads(pickle.dumps(a)), copy.deepcopy, copy.copy])
def test_copies_and_pickles_are_equal_and_read_only(remake):
    arm = pendulum(frames={"camera": (0, np.eye(4))}, shapes=(Shape("sphere", (0.1,), np.eye(4), -1),))
    other = remake(arm)
    assert other == arm
    assert not other.joints[0].inertia.flags.writeable and not other.shapes[0].T.flags.writeable


def test_replace_checks_and_leaves_the_original():
    arm = pendulum()
    assert arm.core is arm.core  # built once, and not for the copy
    other = arm.replace(gravity=(0, 0, 0))
    assert np.all(other.gravity_torque((1, 1)) == 0) and np.any(arm.gravity_torque((1, 1)) != 0)
    assert arm.joints[0].replace(mass=3).mass == 3
    with pytest.raises(ArmError, match="gravity"):
        arm.replace(gravity=(1,))


def test_every_arm_knows_its_own_frames():
    arm = pendulum(base="floor", tip="hand")
    assert set(arm.frames) == {"floor", "a_link", "b_link", "hand"}
    assert arm.frames["floor"][0] == -1 and arm.frames["hand"][0] == 1
    moved = arm.replace(T_last_tip=np.eye(4))
    assert np.array_equal(moved.frames["hand"][1], np.eye(4))


def test_properties_and_repr():
    arm = pendulum()
    assert (arm.n, arm.joint_names, arm.has_dynamics) == (2, ("a", "b"), True)
    assert repr(arm) == "Arm('pendulum': 2 joints from 'base' to 'tip')"


# --- effort ---------------------------------------------------------------------------------------------------------


def test_effort_gains():
    assert Effort.torque().gain(3).tolist() == [1, 1, 1]
    assert Effort.current(0.1, 50).gain(2).tolist() == [5, 5]
    assert Effort.current([0.1, 0.2], -100).gain(2).tolist() == [-10, -20]
    assert Effort.current(np.array([0.5, 0.25]), [2, 4]).gain(2).tolist() == [1, 1]
    with pytest.raises(ArmError, match=r"effort k_t must hold 1 or 3 numbers, got 2"):
        Effort.current([1, 2]).gain(3)


def test_undeclared_effort_has_no_gain_but_models_work():
    arm = pendulum()
    assert arm.effort.kind == "undeclared"
    assert arm.gravity_torque((0, 0)).shape == (2,)
    with pytest.raises(ArmError, match=r"not declared: give the arm effort=Effort.torque\(\)"):
        arm.effort.gain(arm.n)


# --- model functions ------------------------------------------------------------------------------------------------


def test_gravity_of_the_pendulum_by_hand():
    # both links lie along x, gravity along -z, axis y: holding up needs negative torque
    arm = pendulum()
    near, far = 2 * 9.81 * 0.1, 2 * 9.81 * (0.5 + 0.1)
    assert np.allclose(arm.gravity_torque((0, 0)), [-(near + far), -near], rtol=1e-13)


def test_one_pose_and_rows_of_poses_agree():
    arm = pendulum()
    rng = np.random.default_rng(1)
    q, dq, x = rng.normal(size=(3, 5, 2))
    for method, args, tail in (
        (arm.inverse_dynamics, (q, dq, x), (2,)),
        (arm.forward_dynamics, (q, dq, x), (2,)),
        (arm.mass_matrix, (q,), (2, 2)),
        (arm.gravity_torque, (q,), (2,)),
        (arm.regressor, (q, dq, x), (2, 20)),
        (arm.forward_kinematics, (q,), (4, 4)),
        (arm.jacobian, (q,), (6, 2)),
        (arm.friction_torque, (dq,), (2,)),
    ):
        rows = method(*args)
        assert rows.shape == (5, *tail)
        for i in range(5):
            assert np.array_equal(method(*(a[i] for a in args)), rows[i])
    for rows, row in zip(arm.momentum_terms(q, dq), arm.momentum_terms(q[0], dq[0]), strict=True):
        assert np.array_equal(rows[0], row)


def test_any_array_like_is_taken():
    arm = pendulum()
    expected = arm.gravity_torque((1.0, 0.0))
    strided = np.zeros((2, 4))
    strided[:, 0] = (1, 0)
    for q in ([1, 0], np.array([1, 0], dtype=np.int8), strided[:, 0], np.float32([1, 0])):
        assert np.array_equal(arm.gravity_torque(q), expected)


def test_models_hang_together():
    arm = pendulum(joints=(joint("a", rotor_inertia=0.3), joint("b", axis=(0, 1, 0))))
    rng = np.random.default_rng(2)
    q, dq, ddq = rng.normal(size=(3, 2))
    tau = arm.inverse_dynamics(q, dq, ddq)
    assert np.allclose(arm.forward_dynamics(q, dq, tau), ddq, rtol=1e-11)
    p, ct_dq, g = arm.momentum_terms(q, dq)
    M = arm.mass_matrix(q)
    assert np.allclose(p, M @ dq) and np.allclose(g, arm.gravity_torque(q))
    step = 1e-6
    dM = (arm.mass_matrix(q + step * dq) - arm.mass_matrix(q - step * dq)) / (2 * step)
    c_dq = arm.inverse_dynamics(q, dq, (0, 0)) - g
    assert np.allclose(dM @ dq, ct_dq + c_dq, atol=1e-8)


def test_regressor_times_parameters_is_the_torque():
    arm = pendulum()
    rng = np.random.default_rng(3)
    q, dq, ddq = rng.normal(size=(3, 4, 2))
    pi = []
    for j in arm.joints:
        inertia = j.inertia + j.mass * (j.com @ j.com * np.eye(3) - np.outer(j.com, j.com))
        pi += [j.mass, *(j.mass * j.com), *inertia[np.triu_indices(3)]]
    assert np.allclose(arm.regressor(q, dq, ddq) @ pi, arm.inverse_dynamics(q, dq, ddq), rtol=1e-12)


def test_friction_torque():
    friction = Friction(coulomb=2, viscous=0.5, offset=0.1, static=3, stribeck_velocity=0.1)
    arm = pendulum(joints=(joint("a", friction=friction), joint("b")))
    dq = 0.2
    expected = (2 + (3 - 2) * math.exp(-4)) * math.tanh(20) + 0.5 * dq + 0.1
    assert np.allclose(arm.friction_torque((dq, dq)), [expected, 0], rtol=1e-14)


def test_jacobian_against_finite_differences():
    arm = pendulum(joints=(joint("a"), joint("b", kind="prismatic", axis=(0, 0.6, 0.8))))
    q, point, step = np.array([0.4, 0.3]), np.array([0.1, -0.2, 0.3]), 1e-6

    def position(q):
        T = arm.forward_kinematics(q)
        return T[:3, :3] @ point + T[:3, 3]

    J = arm.jacobian(q, point)
    for i in range(2):
        d = np.eye(2)[i] * step
        assert np.allclose(J[:3, i], (position(q + d) - position(q - d)) / (2 * step), atol=1e-9)
    assert np.allclose(J[3:], [[0, 0], [0, 0], [1, 0]])


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda a: a.gravity_torque((1, 2, 3)), r"q must have shape \(2,\) or \(N, 2\), got \(3,\)"),
        (lambda a: a.gravity_torque(1.0), r"q must have shape \(2,\) or \(N, 2\), got \(\)"),
        (lambda a: a.gravity_torque(np.zeros((1, 1, 2))), r"q must have shape"),
        (lambda a: a.gravity_torque(("x", 0)), "q must be numbers of shape"),
        (lambda a: a.gravity_torque(None), "q must"),
        (lambda a: a.gravity_torque((0, np.nan)), r"q must be finite; entry \[1\] is not"),
        (lambda a: a.gravity_torque([[0, 0], [np.inf, 0]]), r"q must be finite; entry \[1, 0\] is not"),
        (
            lambda a: a.momentum_terms((0, 0), np.zeros((3, 2))),
            r"dq must have the same shape as q, \(2,\), got \(3, 2\)",
        ),
        (
            lambda a: a.inverse_dynamics(np.zeros((3, 2)), np.zeros((3, 2)), np.zeros((4, 2))),
            "ddq must have the same shape",
        ),
        (lambda a: a.jacobian((0, 0), (0, 0)), r"point must have shape \(3,\)"),
        (lambda a: a.weighing_joint(np.zeros((0, 2))), "at least one pose"),
        (lambda a: a.weighing_joint(((1, 1), (0, 0))), "lowest must not exceed highest"),
        (lambda a: a.weighing_joint(((1,), (2,))), r"end of the range must have shape \(2,\)"),
    ],
)
def test_wrong_arguments_are_refused_and_named(call, message):
    with pytest.raises(ArmError, match=message):
        call(pendulum())


def test_without_masses_only_kinematics_work():
    arm = pendulum(joints=(massless("a"), massless("b")))
    assert not arm.has_dynamics and "kinematics only" in repr(arm)
    assert arm.forward_kinematics((0, 0)).shape == (4, 4)
    assert arm.jacobian((0, 0)).shape == (6, 2)
    assert arm.regressor((0, 0), (0, 0), (0, 0)).shape == (2, 20)
    for call in (
        lambda: arm.inverse_dynamics((0, 0), (0, 0), (0, 0)),
        lambda: arm.forward_dynamics((0, 0), (0, 0), (0, 0)),
        lambda: arm.mass_matrix((0, 0)),
        lambda: arm.momentum_terms((0, 0), (0, 0)),
        lambda: arm.gravity_torque((0, 0)),
    ):
        with pytest.raises(ArmError, match="'pendulum' has no masses .kinematics only."):
            call()


# --- the joint to weigh with ----------------------------------------------------------------------------------------


def test_weighing_joint_lever_is_the_torque_a_newton_makes():
    arm = pendulum(grasp=(0.1, 0, 0))
    for q in ((0, 0), (0.3, 0.4), (-1.0, 0.2)):
        weighing = arm.weighing_joint(q)
        assert weighing.name == "b" and weighing.index == 1
        J = arm.jacobian(q, arm.grasp)
        assert weighing.lever == weighing.lever_max == pytest.approx(abs(J[:3, 1] @ (0, 0, -1)), rel=1e-14)
        assert weighing.radius == pytest.approx(0.6)
        assert weighing.lever == pytest.approx(0.6 * abs(math.cos(sum(q))))
        assert weighing.sin_angle == pytest.approx(abs(math.cos(sum(q))))


def test_weighing_joint_takes_the_worst_of_a_range():
    weighing = pendulum().weighing_joint(((0, 0), (0.5, 0.5)))
    assert weighing.lever == pytest.approx(0.5 * math.cos(1.0))
    assert weighing.lever_max == pytest.approx(0.5)
    along = np.linspace((0, 0), (0.5, 0.5), 7)
    assert pendulum().weighing_joint(along).lever == pytest.approx(0.5 * math.cos(1.0))


def test_weighing_joint_passes_over_axes_along_gravity_and_through_the_load():
    roll = joint("roll", axis=(1, 0, 0), T_parent_joint=pendulum().T_last_tip)
    swivel = joint("swivel", axis=(0, 0, 1))
    arm = pendulum(joints=(swivel, *pendulum().joints, roll))
    assert arm.weighing_joint((0, 0, 0, 0)).name == "b"


def test_a_joint_whose_load_hangs_straight_below_is_the_last_choice():
    T = np.eye(4)
    T[2, 3] = -0.3
    arm = pendulum(T_last_tip=T)
    assert arm.weighing_joint((0, 0)).name == "a"
    hanging = arm.weighing_joint((math.pi / 2, -math.pi / 2))
    assert hanging.name == "b" and hanging.lever == pytest.approx(0, abs=1e-15) and hanging.sin_angle < 1e-15


def test_a_sliding_joint_along_gravity_weighs():
    lift = joint("lift", kind="prismatic", axis=(0, 0, 1))
    weighing = pendulum(joints=(lift,)).weighing_joint((0.2,))
    assert (weighing.name, weighing.lever, weighing.radius) == ("lift", 1.0, 1.0)


def test_no_joint_to_weigh_with_lists_them_all():
    with pytest.raises(ArmError, match=r"no joint weighs here: .* b 0.00, 0.500 m; a 0.00, 1.000 m"):
        pendulum(gravity=(0, 9.81, 0)).weighing_joint((0, 0))
    with pytest.raises(ArmError, match="nothing can be weighed without gravity"):
        pendulum(gravity=(0, 0, 0)).weighing_joint((0, 0))


# --- errors ---------------------------------------------------------------------------------------------------------


def test_missing_extra_says_how_to_get_it():
    error = MissingExtraError("sim", "rendering a scene")
    assert isinstance(error, PalpateError) and error.extra == "sim"
    assert str(error) == 'rendering a scene needs `pip install "palpate[sim]"`'
    assert str(pickle.loads(pickle.dumps(error))) == str(error)


def test_suggest():
    assert suggest("tol0", ["tool0", "base"]) == "did you mean 'tool0'?"
    assert suggest("xyz", ["tool0", "base"], "links") == "links: base, tool0"
    assert suggest("xyz", [], "links") == "links: none"
    assert suggest("?", map(str, range(30))).endswith(", ...")


def test_arms_need_numpy_alone():
    code = (
        "import sys, palpate.robots as r; r.load('justina_left_arm').to_urdf();"
        "print(sorted({'yaml', 'pydantic', 'xacro', 'scipy', 'matplotlib', 'rosbags'} & set(sys.modules)))"
    )
    path = [p for p in sys.path if p]
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        env={"PYTHONPATH": ":".join(path)},
    )
    assert done.stdout.strip() == "[]"
