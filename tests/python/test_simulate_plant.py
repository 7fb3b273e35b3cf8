"""The plant against Pinocchio and against itself: dynamics, loads, pushes, friction, convergence, pictures."""

from __future__ import annotations

import builtins
import os
import subprocess
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from palpate import robots
from palpate.arm import Arm, Friction, Joint, Limits
from palpate.errors import ArmError, InputError, MissingExtraError, PalpateError
from palpate.simulate import Camera, Load, Plant

PERIOD = 4_000_000
TENSOR = np.array([[3.0, 0.4, -0.2], [0.4, 2.0, 0.3], [-0.2, 0.3, 2.5]]) * 1e-3
LOAD = Load(0.8, com=(0.05, -0.02, 0.03), inertia=TENSOR)


def without_friction(arm: Arm) -> Arm:
    return arm.replace(joints=tuple(j.replace(friction=Friction()) for j in arm.joints))


def with_friction(arm: Arm, **friction: float) -> Arm:
    joints = tuple(
        j.replace(friction=Friction(**{"viscous": j.friction.viscous, **friction})) for j in arm.joints
    )
    return arm.replace(joints=joints)


def tilted_arm() -> Arm:
    """A prismatic and two revolute joints on a tilted base, with rotors, an offset tip and odd axes."""
    rng = np.random.default_rng(7)

    def placement(x: float, y: float, z: float) -> np.ndarray:
        T = np.eye(4)
        T[:3, :3] = pin.exp3(rng.normal(size=3))
        T[:3, 3] = (x, y, z)
        return T

    def axis() -> np.ndarray:
        a = rng.normal(size=3)
        return a / np.linalg.norm(a)

    tensor = TENSOR * 5.0
    kinds = ("prismatic", "revolute", "revolute")
    joints = tuple(
        Joint(f"j{i}", f"link{i}", kind, placement(0.1, 0.05, 0.3), axis(), 1.0 + i, rng.normal(size=3) * 0.1,
              tensor, rotor_inertia=0.01 * (i + 1), friction=Friction(viscous=0.5))
        for i, kind in enumerate(kinds)
    )  # fmt: skip
    T = placement(0.1, 0.0, 0.05)
    return Arm("tilted", joints, gravity=[1.0, -5.0, -8.0], T_last_tip=T, grasp=[0.02, 0.01, 0.05])


def hanging_pendulum(**friction: float) -> Arm:
    """One joint about y, a point-like mass of 2 kg at 0.5 m; q = 0 hangs straight down."""
    joint = Joint(
        "hinge", "bob", "revolute", np.eye(4), [0, 1, 0], 2.0, [0, 0, -0.5], np.eye(3) * 1e-3,
        friction=Friction(**friction),
    )  # fmt: skip
    return Arm("pendulum", (joint,), T_last_tip=pin.SE3(np.eye(3), np.array([0, 0, -0.5])).homogeneous)


def pinocchio_model(arm: Arm, load: Load | None = None) -> Any:
    """Pinocchio's model of the same figures, put together without palpate's or MuJoCo's help."""
    model = pin.Model()
    model.gravity.linear = arm.gravity.copy()
    kinds = {"revolute": pin.JointModelRevoluteUnaligned, "prismatic": pin.JointModelPrismaticUnaligned}
    last = 0
    for joint in arm.joints:
        last = model.addJoint(
            last, kinds[joint.kind](joint.axis.copy()), pin.SE3(joint.T_parent_joint.copy()), joint.name
        )
        inertia = pin.Inertia(joint.mass, joint.com.copy(), joint.inertia.copy())
        model.appendBodyToJoint(last, inertia, pin.SE3.Identity())
    if load is not None:
        inertia = pin.Inertia(load.mass, arm.grasp + np.asarray(load.com), np.array(load.inertia))
        model.appendBodyToJoint(last, inertia, pin.SE3(arm.T_last_tip.copy()))
    model.armature = np.array([j.rotor_inertia for j in arm.joints])
    return model


ARMS = [robots.load(name) for name in robots.names()] + [tilted_arm()]
ids = [arm.name for arm in ARMS]


def set_state(plant: Plant, q: np.ndarray, dq: np.ndarray, torque: np.ndarray) -> None:
    """A state with a torque acting, without moving on."""
    load = plant.load
    plant.reset(q, dq)
    if load is not None:
        plant.attach(load)
    plant.step(torque, 1)
    plant.data.qpos[: plant.arm.n], plant.data.qvel[: plant.arm.n] = q, dq


@pytest.mark.parametrize("arm", ARMS, ids=ids)
def test_acceleration_and_torques_equal_pinocchio(arm: Arm) -> None:
    rng = np.random.default_rng(0)
    plant = Plant(arm)
    bare = pinocchio_model(arm)
    for load in (None, LOAD, Load(1.7), None):
        if load is None:
            plant.release()
        else:
            plant.attach(load)
        loaded = pinocchio_model(arm, load)
        data, bare_data = loaded.createData(), bare.createData()
        for _ in range(5):
            q, dq = rng.uniform(-2, 2, arm.n), rng.normal(size=arm.n)
            tau = rng.normal(scale=5.0, size=arm.n)
            set_state(plant, q, dq, tau)
            truth = plant.truth()
            viscous = np.array([j.friction.viscous for j in arm.joints]) * dq
            dry = truth.friction - viscous
            assert np.all(dry * dq >= 0.0)
            most = [max(j.friction.coulomb, j.friction.static or 0.0) for j in arm.joints]
            assert np.all(np.abs(dry) <= np.add(most, 1e-9))
            expected = pin.aba(loaded, data, q, dq, tau - truth.friction)
            np.testing.assert_allclose(truth.ddq, expected, rtol=0, atol=1e-11 * (1 + np.abs(expected).max()))
            # the bare arm's equation of motion closes with tau_ext
            external = pin.rnea(bare, bare_data, q, dq, truth.ddq) + truth.friction - tau
            scale = 1 + np.abs(tau).max() + np.abs(external).max()
            np.testing.assert_allclose(truth.external, external, rtol=0, atol=1e-11 * scale)
            if load is None:
                assert not truth.external.any() and truth.payload_mass == 0.0
            pin.forwardKinematics(bare, bare_data, q)
            T = bare_data.oMi[arm.n].homogeneous @ arm.T_last_tip
            np.testing.assert_allclose(truth.T_base_tip, T, atol=1e-13)
            np.testing.assert_allclose(plant.pose(), T, atol=1e-13)
            # J^T of the payload's wrench at the grasp point is its joint torque
            frame = pin.Frame(
                "grasp",
                arm.n,
                0,
                pin.SE3(arm.T_last_tip) * pin.SE3(np.eye(3), arm.grasp.copy()),
                pin.OP_FRAME,
            )
            J = pin.computeFrameJacobian(*_with_frame(arm, frame), q, bare.nframes, pin.LOCAL_WORLD_ALIGNED)
            np.testing.assert_allclose(J.T @ truth.payload_wrench, truth.external, rtol=0, atol=1e-10 * scale)


def _with_frame(arm: Arm, frame: Any) -> tuple[Any, Any]:
    model = pinocchio_model(arm)
    model.addFrame(frame)
    return model, model.createData()


@pytest.mark.parametrize("arm", ARMS, ids=ids)
def test_static_hold_needs_the_gravity_torque(arm: Arm) -> None:
    """Without friction nothing but g(q), load included, keeps the arm where it is."""
    arm = without_friction(arm)
    plant = Plant(arm)
    q = np.linspace(0.4, -0.7, arm.n)
    plant.reset(q)
    plant.attach(LOAD)
    model = pinocchio_model(arm, LOAD)
    tau = pin.computeGeneralizedGravity(model, model.createData(), q)
    assert np.abs(tau).max() > 0.1
    for _ in range(10):
        plant.step(tau, PERIOD)
    np.testing.assert_allclose(plant.q, q, atol=1e-10)
    # at rest the object is felt as its weight at its centre of mass
    weight = plant.truth().payload_wrench
    np.testing.assert_allclose(weight[:3], LOAD.mass * arm.gravity, atol=1e-7)
    R = plant.truth().T_base_tip[:3, :3]
    np.testing.assert_allclose(
        weight[3:], np.cross(R @ np.asarray(LOAD.com), LOAD.mass * arm.gravity), atol=1e-7
    )


@pytest.mark.parametrize("name", robots.names())
def test_energy_grows_by_the_work_of_the_motors_alone(name: str) -> None:
    """Without friction; what is missing is the method's error, of second order in the step."""
    arm = without_friction(robots.load(name))
    torque = np.linspace(0.1, -0.1, arm.n)
    model = pinocchio_model(arm, LOAD)
    data = model.createData()
    drifts = []
    for timestep in (1e-3, 5e-4):
        plant = Plant(arm, timestep=timestep)
        plant.reset(np.linspace(-0.5, 0.5, arm.n), np.linspace(1.0, -1.0, arm.n))
        plant.attach(LOAD)
        expected = plant.energy()
        drift = kinetic = 0.0
        for _ in range(50):
            before = plant.q
            plant.step(torque, PERIOD)
            expected += torque @ (plant.q - before)
            drift = max(drift, abs(plant.energy() - expected))
            kinetic = max(kinetic, pin.computeKineticEnergy(model, data, plant.q, plant.dq))
        drifts.append(drift / kinetic)
    # links of 4e-5 kg m^2 without the damping they live with spin up in milliseconds
    assert drifts[0] < (3e-3 if name == "justina_left_arm_box" else 1e-5)
    assert drifts[1] < drifts[0] / 3.5


def test_energy_with_runge_kutta_is_conserved_to_the_last_digits() -> None:
    plant = Plant(without_friction(robots.load("justina_left_arm")), integrator="rk4")
    plant.reset(np.linspace(-0.5, 0.5, 7), np.linspace(1.0, -1.0, 7))
    start = plant.energy()
    plant.step(np.zeros(7), 1_000_000_000)
    assert plant.energy() == pytest.approx(start, abs=1e-9)


def gentle_motion(plant: Plant, seconds: float) -> np.ndarray:
    """Computed-torque motion that takes up a load half-way: positions (N, n) [rad]."""
    arm = plant.arm
    padded = arm.replace(joints=tuple(j.replace(inertia=j.inertia + 1e-3 * np.eye(3)) for j in arm.joints))
    model = pinocchio_model(padded)
    data = model.createData()
    goal = 0.5 * np.cos(np.arange(arm.n))
    damping = np.array([j.friction.viscous for j in arm.joints])
    count = round(seconds / 4e-3)
    rows = []
    for k in range(count):
        s = k / count
        desired = goal * (10 * s**3 - 15 * s**4 + 6 * s**5)
        speed = goal * (30 * s**2 - 60 * s**3 + 30 * s**4) / seconds
        q, dq = plant.q, plant.dq
        tau = (
            pin.rnea(model, data, q, np.zeros(arm.n), 25 * (desired - q) + 10 * (speed - dq))
            + damping * speed
        )
        if k == count // 2:
            plant.attach(0.25)
        plant.step(tau, PERIOD)
        rows.append(plant.q)
    return np.array(rows)


def halvings(arm: Any) -> list[float]:
    """What halving the default step changes, and halving it again, and again: largest difference of any joint [rad]."""
    runs = [gentle_motion(Plant(arm, timestep=h), 0.5) for h in (1e-3, 5e-4, 2.5e-4, 1.25e-4)]
    assert np.ptp(runs[0], axis=0).max() > 0.05
    return [float(np.abs(coarse - fine).max()) for coarse, fine in pairwise(runs)]


@pytest.mark.parametrize("name", robots.names())
def test_halving_the_step_changes_next_to_nothing(name: str) -> None:
    """Second order for every arm as long as no friction is dry; the encoder count of the bench is 1.5e-3 rad."""
    arm = robots.load(name)
    joints = tuple(j.replace(friction=Friction(viscous=j.friction.viscous)) for j in arm.joints)
    changes = halvings(arm.replace(joints=joints))
    assert changes[0] < 1e-5
    assert changes[1] < changes[0] / 3.5 and changes[2] < changes[1] / 3.5


@pytest.mark.parametrize(
    "name", [n for n in robots.names() if any(j.friction.coulomb for j in robots.load(n).joints)]
)
def test_dry_friction_leaves_first_order(name: str) -> None:
    """When a joint sticks or slides is found to within a step: the error falls with the step, not with its square.

    At 1 ms that is 2e-5 rad for the SO-101, which is small and light: 1 % of its encoder's count.
    """
    changes = halvings(robots.load(name))
    for change, step in zip(changes, (1e-3, 5e-4, 2.5e-4), strict=True):
        assert change < 0.025 * step  # [rad/s]
    assert changes[2] < changes[0] / 2.0


def test_stiff_box_arm_agrees_with_tiny_steps_of_another_method() -> None:
    """Damping of 1.5 N m s/rad on 4e-5 kg m^2 stops a motion in 27 us: compared with steps of 10 us."""
    arm = robots.load("justina_left_arm_box")
    coarse, fine = (gentle_motion(Plant(arm, integrator="implicit", timestep=h), 0.2) for h in (2e-5, 1e-5))
    # that method is of first order
    exact = 2 * fine - coarse
    errors = [np.abs(gentle_motion(Plant(arm, timestep=h), 0.2) - exact).max() for h in (1e-3, 5e-4)]
    assert errors[0] < 1e-5 and errors[1] < errors[0] / 3.5


def test_second_order() -> None:
    arm = robots.load("justina_left_arm")
    exact = gentle_motion(Plant(arm, integrator="rk4"), 0.4)
    errors = [np.abs(gentle_motion(Plant(arm, timestep=h), 0.4) - exact).max() for h in (4e-3, 2e-3, 1e-3)]
    assert errors[0] / errors[1] > 3.5 and errors[1] / errors[2] > 3.5


class TestFriction:
    @pytest.mark.parametrize("integrator", [None, "rk4", "discrete"])
    def test_sticks_below_coulomb_friction(self, integrator: Any) -> None:
        plant = Plant(hanging_pendulum(coulomb=0.5), integrator=integrator)
        for _ in range(250):
            plant.step([0.45], PERIOD)
        assert abs(plant.q[0]) < 1e-5
        truth = plant.truth()
        assert truth.friction[0] == pytest.approx(0.45, abs=1e-3)
        assert abs(truth.ddq[0]) < 1e-3

    def test_breaks_loose_above_it_and_slides_against_it(self) -> None:
        arm = hanging_pendulum(coulomb=0.5, viscous=0.2, offset=0.1).replace(gravity=np.zeros(3))
        plant = Plant(arm)
        inertia = 2.0 * 0.25 + 1e-3
        for _ in range(100):
            plant.step([1.1], PERIOD)
        # I dv/dt = tau - F_c - F_o - F_v v
        v = (1.1 - 0.6) / 0.2 * (1.0 - np.exp(-0.2 * 0.4 / inertia))
        assert plant.dq[0] == pytest.approx(v, rel=1e-4)
        assert plant.truth().friction[0] == pytest.approx(0.6 + 0.2 * v, rel=1e-4)
        # without torque it comes to rest and stays there, held by friction against the offset
        for _ in range(500):
            plant.step([0.0], PERIOD)
        rest = plant.q[0]
        for _ in range(100):
            plant.step([0.0], PERIOD)
        assert plant.q[0] == pytest.approx(rest, abs=1e-6)

    def test_stribeck_peak_holds_more_than_it_slides(self) -> None:
        arm = hanging_pendulum(coulomb=0.3, static=0.8, stribeck_velocity=0.05).replace(gravity=np.zeros(3))
        plant = Plant(arm)
        for _ in range(100):
            plant.step([0.7], PERIOD)
        assert abs(plant.q[0]) < 1e-5
        plant.step([0.9], 200_000_000)
        assert plant.dq[0] > 0.1
        plant.step([0.3], PERIOD)
        truth = plant.truth()
        expected = 0.3 + 0.5 * np.exp(-((truth.dq[0] / 0.05) ** 2))
        assert truth.friction[0] == pytest.approx(expected, rel=1e-9)

    def test_load_raises_friction(self) -> None:
        arm = hanging_pendulum(coulomb=0.1, load=0.2)
        plant = Plant(arm)
        # q = 90 deg carries 9.81 N m: friction 0.1 + 0.2 * 9.81
        bound = 0.1 + 0.2 * 2.0 * 9.81 * 0.5
        for excess, moves in ((0.9 * bound, False), (1.3 * bound, True)):
            plant.reset([np.pi / 2])
            for _ in range(50):
                plant.step([2.0 * 9.81 * 0.5 + excess], PERIOD)
            assert (abs(plant.q[0] - np.pi / 2) > 1e-3) == moves


class TestLoads:
    def test_attach_and_release_do_not_touch_the_state(self) -> None:
        plant = Plant(robots.load("kuka_lbr_iiwa7"))
        plant.reset(np.full(7, 0.3), np.linspace(-1, 1, 7))
        q, dq = plant.q, plant.dq
        plant.attach(LOAD)
        assert plant.load is LOAD
        assert np.array_equal(plant.q, q) and np.array_equal(plant.dq, dq)
        momentum = plant.energy()
        plant.release()
        assert plant.load is None
        assert np.array_equal(plant.q, q) and np.array_equal(plant.dq, dq)
        assert plant.energy() < momentum

    def test_released_plant_is_as_new(self) -> None:
        used, new = Plant(robots.load("kuka_lbr_iiwa7")), Plant(robots.load("kuka_lbr_iiwa7"))
        used.attach(3.0)
        used.step(np.ones(7), PERIOD)
        used.reset()
        for plant in (used, new):
            for _ in range(20):
                plant.step(np.linspace(-3, 3, 7), PERIOD)
        assert np.array_equal(used.q, new.q) and np.array_equal(used.dq, new.dq)

    def test_another_load_replaces_the_first(self) -> None:
        plant = Plant(robots.load("kuka_lbr_iiwa7"))
        plant.attach(3.0)
        plant.attach(1.0)
        assert plant.truth().payload_mass == 1.0

    def test_box(self) -> None:
        box = Load.box(0.25, (0.07, 0.07, 0.0051), com=(0.0, 0.0, 0.01))
        np.testing.assert_allclose(
            np.diag(np.asarray(box.inertia)), 0.25 / 12 * np.array([0.07**2 + 0.0051**2] * 2 + [2 * 0.07**2])
        )

    @pytest.mark.parametrize(
        "wrong",
        [
            lambda: Load(0.0),
            lambda: Load(-1.0),
            lambda: Load(float("nan")),
            lambda: Load("a lot"),  # type: ignore[arg-type]
            lambda: Load(1.0, com=(0, 0)),
            lambda: Load(1.0, com=(0, 0, np.inf)),
            lambda: Load(1.0, inertia=-np.eye(3)),
            lambda: Load(1.0, inertia=np.diag([1.0, 1.0, 3.0])),
            lambda: Load(1.0, inertia=np.array([[1, 0.1, 0], [0, 1, 0], [0, 0, 1]])),
            lambda: Load(1.0, size=(0.1, 0.0, 0.1)),
            lambda: Plant(robots.load("kuka_lbr_iiwa7")).attach(-1.0),
        ],
    )
    def test_impossible_loads_are_refused(self, wrong: Any) -> None:
        with pytest.raises(InputError, match="load"):
            wrong()


class TestPushes:
    @pytest.mark.parametrize(
        "arm", [robots.load("justina_left_arm"), tilted_arm()], ids=["justina", "tilted"]
    )
    def test_wrench_at_a_point_of_any_link(self, arm: Arm) -> None:
        rng = np.random.default_rng(1)
        plant = Plant(without_friction(arm))
        model = pinocchio_model(arm)
        data = model.createData()
        for link in range(arm.n):
            q, dq, tau = rng.uniform(-1, 1, arm.n), rng.normal(size=arm.n), rng.normal(size=arm.n)
            force, torque, point = rng.normal(size=(3, 3))
            set_state(plant, q, dq, tau)
            plant.push(arm.joints[link].link, force, torque, point=point)
            truth = plant.truth()
            pin.forwardKinematics(model, data, q)
            R = data.oMi[link + 1].rotation
            wrench = pin.Force(R.T @ force, R.T @ torque + np.cross(point, R.T @ force))
            forces = [pin.Force.Zero() for _ in range(arm.n + 1)]
            forces[link + 1] = wrench
            expected = pin.aba(model, data, q, dq, tau, forces)
            np.testing.assert_allclose(truth.ddq, expected, atol=1e-10 * (1 + np.abs(expected).max()))
            expected = pin.rnea(model, data, q, dq, truth.ddq) - tau
            np.testing.assert_allclose(truth.external, expected, atol=1e-10 * (1 + np.abs(expected).max()))
            plant.stop_pushing()
            assert not plant.truth().external.any()

    def test_pushes_add_up_and_end_one_by_one(self) -> None:
        plant = Plant(robots.load("kuka_lbr_iiwa7"))
        plant.reset(np.full(7, 0.4))
        plant.push(2, force=(5, 0, 0))
        first = plant.truth().external
        plant.push("grasp", force=(0, 0, -3), torque=(0, 0.2, 0))
        both = plant.truth().external
        plant.stop_pushing(2)
        np.testing.assert_allclose(plant.truth().external + first, both, atol=1e-13)
        plant.push("grasp", force=(0, 0, -6), torque=(0, 0.4, 0))
        np.testing.assert_allclose(plant.truth().external, 2 * (both - first), atol=1e-13)

    def test_the_force_stays_while_the_link_turns(self) -> None:
        """A free joint driven by a force of constant direction swings about it like a pendulum in that field."""
        arm = hanging_pendulum().replace(gravity=np.zeros(3))
        swing = Plant(hanging_pendulum())
        pushed = Plant(arm)
        swing.reset([1.0])
        pushed.reset([1.0])
        pushed.push(0, force=(0, 0, -2.0 * 9.81), point=(0, 0, -0.5))
        for _ in range(100):
            swing.step([0.0], PERIOD)
            pushed.step([0.0], PERIOD)
        assert abs(swing.q[0]) < 0.9
        assert pushed.q[0] == pytest.approx(swing.q[0], abs=1e-12)

    def test_frames(self) -> None:
        arm = robots.load("justina_left_arm")
        plant = Plant(arm)
        T = np.eye(4)
        T[:3, 3] = arm.grasp
        np.testing.assert_allclose(plant.pose("grasp"), plant.pose(arm.tip) @ T, atol=1e-15)
        np.testing.assert_allclose(plant.pose(6) @ arm.T_last_tip, plant.pose(), atol=1e-15)
        for name, (link, T) in arm.frames.items():
            expected = T if link < 0 else plant.pose(link) @ T
            np.testing.assert_allclose(plant.pose(name), expected, atol=1e-15)
        with pytest.raises(InputError, match=r"no frame 'hand'.*left_arm_link1"):
            plant.push("hand", force=(1, 0, 0))
        with pytest.raises(InputError, match="0 to 6"):
            plant.push(7, force=(1, 0, 0))
        with pytest.raises(InputError, match="base"):
            plant.push(arm.base, force=(1, 0, 0))
        with pytest.raises(InputError, match=r"force must have shape \(3,\)"):
            plant.push(1, force=(1, 0))
        assert not plant.truth().external.any()


def test_truth_does_not_change_what_happens() -> None:
    arm = with_friction(robots.load("justina_left_arm"), coulomb=0.05)
    plants = [Plant(arm), Plant(arm)]
    for k in range(60):
        for watched, plant in enumerate(plants):
            plant.step(np.sin(0.3 * k + np.arange(7)), PERIOD)
            if watched:
                plant.truth()
                plant.energy()
                plant.pose()
    assert np.array_equal(plants[0].q, plants[1].q) and np.array_equal(plants[0].dq, plants[1].dq)
    assert plants[0].q.any()


def test_truth_is_of_now_and_keeps() -> None:
    plant = Plant(robots.load("kuka_lbr_iiwa14"))
    plant.step(np.ones(7), PERIOD)
    truth = plant.truth()
    q, dq = truth.q.copy(), truth.dq.copy()
    plant.step(np.ones(7), PERIOD)
    assert truth.time_ns == PERIOD and np.array_equal(truth.q, q) and np.array_equal(truth.dq, dq)
    assert np.array_equal(truth.torque, np.ones(7))
    # q'' is the slope of q'
    eps = 1000
    before = plant.truth()
    plant.step(np.ones(7), eps)
    np.testing.assert_allclose((plant.dq - before.dq) / (eps * 1e-9), before.ddq, rtol=1e-3, atol=1e-3)


def test_any_duration_is_exact_in_time() -> None:
    plant = Plant(robots.load("justina_left_arm"))
    for duration in (1, 999_999, 1_000_000, 1_000_001, 7_777_777):
        plant.step(np.zeros(7), duration)
    assert plant.time_ns == 1 + 999_999 + 1_000_000 + 1_000_001 + 7_777_777
    assert plant.data.time == pytest.approx(plant.time_ns * 1e-9)


def test_end_stops() -> None:
    arm = robots.load("katana_300_6m180")
    stops = arm.joints[1].limits
    torque = np.zeros(5)
    torque[1] = 5.0
    for limits, inside in ((True, True), (False, False)):
        plant = Plant(arm, limits=limits)
        for _ in range(500):
            plant.step(torque, PERIOD)
        assert (plant.q[1] < stops.upper + 0.05) == inside
    plant = Plant(arm, limits=True)
    for _ in range(500):
        plant.step(torque, PERIOD)
    truth = plant.truth()
    model = pinocchio_model(arm)
    residual = (
        pin.rnea(model, model.createData(), truth.q, truth.dq, truth.ddq) + truth.friction - truth.torque
    )
    np.testing.assert_allclose(truth.external, residual, atol=1e-9)
    assert truth.external[1] < -1.0


def test_one_sided_end_stop() -> None:
    joint = hanging_pendulum(viscous=1.0).joints[0].replace(limits=Limits(upper=0.5))
    plant = Plant(hanging_pendulum().replace(joints=(joint,)), limits=True)
    plant.step([15.0], 2_000_000_000)
    assert plant.q[0] == pytest.approx(0.5, abs=0.05)
    plant.step([-15.0], 4_000_000_000)
    assert plant.q[0] < -1.0


class TestScenes:
    @staticmethod
    def table(spec: Any) -> None:
        spec.worldbody.add_geom(name="table", type=6, size=(0.5, 0.5, 0.05), pos=(0, 0, -0.95))
        spec.worldbody.add_camera(name="side", pos=(0, -2, 0), xyaxes=(1, 0, 0, 0, 0, 1))

    def test_contact_stops_the_arm_and_is_in_the_truth(self) -> None:
        """A rod hangs from a slider above a table; let go, it stands on it with its whole weight."""
        joint = Joint("slide", "rod", "prismatic", np.eye(4), [0, 0, 1], 1.5, [0, 0, -0.4], np.eye(3) * 1e-2)
        tip = np.eye(4)
        tip[2, 3] = -0.8
        arm = Arm("rod", (joint,), T_last_tip=tip)
        plant = Plant(arm, contacts=True, scene=self.table)
        assert plant.integrator == "discrete"
        for _ in range(500):
            plant.step([0.0], PERIOD)
        truth = plant.truth()
        assert -0.12 < truth.q[0] < -0.05 and abs(truth.dq[0]) < 1e-3
        assert truth.external[0] == pytest.approx(1.5 * 9.81, rel=1e-2)
        # the scene is there without contacts, too, but then it is only a picture
        plant = Plant(arm, scene=self.table)
        assert plant.integrator == "extrapolated"
        plant.step([0.0], 1_000_000_000)
        assert plant.q[0] < -4.0

    def test_loose_objects_may_be_in_it(self) -> None:
        def ball(spec: Any) -> None:
            body = spec.worldbody.add_body(name="ball", pos=(5, 0, 0))
            body.add_freejoint()
            body.add_geom(type=2, size=(0.1, 0, 0), mass=1.0)

        arm = robots.load("kuka_lbr_iiwa7")
        plant, alone = Plant(arm, scene=ball), Plant(arm, integrator="discrete")
        assert plant.integrator == "discrete"
        for p in (plant, alone):
            for _ in range(10):
                p.step(np.ones(7), PERIOD)
        np.testing.assert_allclose(plant.q, alone.q, atol=1e-12)
        assert plant.truth().external.shape == (7,)
        assert plant.data.body("ball").xpos[2] < 0.0

    def test_a_held_object_touches_with_its_whole_size(self) -> None:
        """MuJoCo looks for contacts within a box around the shape, which has to grow with the object."""
        arm = robots.load("kuka_lbr_iiwa7")
        height = float(Plant(arm).pose("grasp")[2, 3])

        def block(spec: Any) -> None:
            spec.worldbody.add_geom(name="block", type=6, size=(0.02, 0.02, 0.02), pos=(0.0, 0.19, height))

        plant = Plant(arm, contacts=True, scene=block)
        plant.attach(Load.box(0.5, (0.1, 0.4, 0.1)))
        plant.step(np.zeros(7), PERIOD)
        assert plant.data.ncon > 0

    def test_extrapolation_through_contacts_is_refused(self) -> None:
        with pytest.raises(InputError, match="contacts"):
            Plant(robots.load("kuka_lbr_iiwa7"), contacts=True, integrator="extrapolated")


class TestErrors:
    def test_arguments(self) -> None:
        arm = robots.load("justina_left_arm")
        plant = Plant(arm)
        for torque in (np.zeros(6), np.zeros((1, 7)), "one", [np.nan] * 7, [np.inf] + [0] * 6):
            with pytest.raises(InputError, match="torque must"):
                plant.step(torque, PERIOD)
        for duration in (0, -1):
            with pytest.raises(InputError, match="duration_ns"):
                plant.step(np.zeros(7), duration)
        with pytest.raises(InputError, match="dq must"):
            plant.reset(np.zeros(7), np.zeros(3))
        with pytest.raises(InputError, match="integrator must be one of extrapolated"):
            Plant(arm, integrator="ode45")  # type: ignore[arg-type]
        for timestep in (0.0, -1e-3, float("nan"), 1.0):
            with pytest.raises(InputError, match="timestep"):
                Plant(arm, timestep=timestep)
        assert plant.time_ns == 0

    def test_an_arm_without_masses_cannot_be_simulated(self) -> None:
        joint = Joint("a", "b", "revolute", np.eye(4), [0, 0, 1], 0.0, np.zeros(3), np.zeros((3, 3)))
        with pytest.raises(ArmError, match="no masses"):
            Plant(Arm("ghost", (joint,)))

    def test_divergence_is_an_error(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings to a file where it stands
        for integrator in ("rk4", "extrapolated"):
            plant = Plant(robots.load("justina_left_arm_box"), integrator=integrator)
            with pytest.raises(InputError, match=rf"'justina_left_arm_box' diverged before .*{integrator}"):
                for _ in range(100):
                    plant.step(np.full(7, 1e12), PERIOD)

    def test_missing_mujoco_names_the_extra(self, monkeypatch: pytest.MonkeyPatch) -> None:
        real = builtins.__import__

        def without(name: str, *args: Any, **kwargs: Any) -> Any:
            if name == "mujoco":
                raise ModuleNotFoundError("No module named 'mujoco'", name="mujoco")
            return real(name, *args, **kwargs)

        monkeypatch.setattr(builtins, "__import__", without)
        with pytest.raises(MissingExtraError, match=r'pip install "palpate\[sim\]"'):
            Plant(robots.load("justina_left_arm"))

    def test_importing_does_not_import_mujoco(self) -> None:
        code = "import sys, palpate.simulate, palpate.drivers.mujoco; sys.exit('mujoco' in sys.modules)"
        assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


class TestPictures:
    @staticmethod
    def plant(**options: Any) -> Plant:
        plant = Plant(robots.load("justina_left_arm"), **options)
        try:
            plant.render(64, 48)
        except PalpateError as error:
            pytest.skip(f"no OpenGL here: {error}")
        return plant

    @staticmethod
    def differ(a: np.ndarray, b: np.ndarray) -> int:
        """How many pixels differ by more than the last bits, in which software renderers are not repeatable."""
        return int(np.sum(np.abs(a.astype(int) - b).max(axis=2) > 4))

    def test_a_picture_shows_the_arm_and_what_it_holds(self) -> None:
        plant = self.plant()
        empty = plant.render(320, 240)
        assert empty.shape == (240, 320, 3) and empty.dtype == np.uint8
        assert empty.std() > 10.0
        plant.attach(Load.box(1.0, (0.1, 0.1, 0.1)))
        orange = plant.render(320, 240).astype(int)
        assert np.sum((orange[..., 0] > orange[..., 2] + 80) & (orange[..., 0] > 150)) > 30
        plant.release()
        assert self.differ(plant.render(320, 240), empty) == 0
        plant.reset(np.full(7, 0.5))
        assert self.differ(plant.render(320, 240), empty) > 100
        near = plant.render(
            320, 240, camera=Camera(azimuth=90, elevation=-5, distance=0.6, lookat=(0.2, 0.1, 0))
        )
        assert self.differ(near, plant.render(320, 240)) > 1000
        plant.close()
        plant.close()
        assert plant.render(64, 48).shape == (48, 64, 3)

    def test_cameras_of_the_scene(self) -> None:
        plant = self.plant(scene=TestScenes.table)
        assert plant.render(64, 48, camera="side").shape == (48, 64, 3)
        with pytest.raises(InputError, match=r"no camera 'top'.*side"):
            plant.render(64, 48, camera="top")

    @pytest.mark.parametrize("size", [(0, 10), (10, 0), (2561, 10), (10, 1601)])
    def test_sizes(self, size: tuple[int, int]) -> None:
        with pytest.raises(InputError, match="2560x1600"):
            Plant(robots.load("justina_left_arm")).render(*size)

    @staticmethod
    def last_words(script: str, **environment: str) -> str:
        """What a fresh Python says when it dies of a PalpateError in `script`; empty if it lives."""
        code = (
            "import sys\n"
            "from palpate.errors import PalpateError\n"
            "try:\n"
            "    from palpate import robots\n"
            "    from palpate.simulate import Plant\n"
            f"    {script}\n"
            "except PalpateError as error:\n"
            "    sys.exit(str(error))\n"
        )
        env = {**os.environ, **environment}
        run = subprocess.run(
            [sys.executable, "-c", code], env=env, capture_output=True, text=True, check=False
        )
        message = run.stderr.strip()
        assert "Traceback" not in message and "\n" not in message
        assert (run.returncode == 0) == (message == "")
        return message

    def test_missing_opengl_is_said_clearly(self) -> None:
        simulate = "plant = Plant(robots.load('justina_left_arm')); plant.step([0] * 7, 4000000)"
        assert self.last_words(simulate, MUJOCO_GL="off") == ""
        message = self.last_words(simulate + "; plant.render(64, 48)", MUJOCO_GL="off")
        assert "rendering needs OpenGL" in message and "MUJOCO_GL=egl" in message and "libegl1" in message

    def test_a_wrong_backend_is_said_clearly(self) -> None:
        message = self.last_words("Plant(robots.load('justina_left_arm'))", MUJOCO_GL="etch-a-sketch")
        assert "etch-a-sketch" in message and "MUJOCO_GL=off" in message

    def test_a_machine_without_egl_simulates(self) -> None:
        script = (
            "import os, ctypes.util; [os.environ.pop(v, 0) for v in ('MUJOCO_GL', 'DISPLAY', 'WAYLAND_DISPLAY')]; "
            "ctypes.util.find_library = lambda name: None; plant = Plant(robots.load('justina_left_arm')); "
            "plant.step([0] * 7, 4000000)"
        )
        assert self.last_words(script) == ""
        if sys.platform.startswith("linux"):
            assert "MUJOCO_GL=off" in self.last_words(script + "; plant.render(64, 48)")
