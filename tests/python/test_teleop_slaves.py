"""Slaves of other kinds: the industrial arm by its phase currents, a leader arm and its twin, a peg in a hole."""

from __future__ import annotations

import json
import runpy
from pathlib import Path

import numpy as np
import pytest

from palpate import robots
from palpate.cli import main
from palpate.errors import InputError
from palpate.logs import Sample

pytest.importorskip("mujoco")
pytest.importorskip("cryptography")
pytest.importorskip("scipy")

from palpate.simulate._model import mujoco
from palpate.simulate.drives import Drives, GearedPlant, LuGre
from palpate.simulate.irb2400 import GLITCH, B, CurrentSensors, PhaseSensors, truth_arm, truth_drives
from palpate.studies import _irb2400
from palpate.studies._geared_arm import Run, simulate
from palpate.studies._irb2400_force import late
from palpate.studies._teleop_hands import free, pressing
from palpate.studies._teleop_slaves import contact, held_torque, led
from palpate.teleop.channel import Faults
from palpate.teleop.figures import transparency
from palpate.teleop.industrial import SENSORS
from palpate.teleop.motor_force import LowPass, MotorForce, MotorModel, _Split, identified
from palpate.teleop.scenes import slave_arm
from palpate.teleop.servo_arms import LeaderArm, joint_path
from palpate.teleop.servo_force import ServoForce
from palpate.teleop.setups import build

ABB = "abb_irb2400_16"
POSE = np.array([0.0, 0.3, 0.1, 0.0, 0.9, 0.0])

# --- geared drives ----------------------------------------------------------------------------------------------------


def test_rotors_turn_with_the_joints_that_the_transmission_names() -> None:
    """MuJoCo's mass matrix with its tendons is M + B' I B."""
    arm = truth_arm()
    drives = truth_drives(arm)
    plant = GearedPlant(arm, drives, POSE)
    plant.reset(POSE)
    mj, found = mujoco(), np.zeros((6, 6))
    mj.mj_forward(plant.model, plant.data)
    mj.mj_fullM(plant.model, plant.data, found)
    np.testing.assert_allclose(found, arm.mass_matrix(POSE) + B.T @ np.diag(drives.inertia) @ B, atol=1e-10)


def test_a_geared_joint_sticks_below_its_coulomb_friction_and_slides_above_the_static_one() -> None:
    arm = truth_arm()
    drives = truth_drives(arm)
    for share, moves in ((0.5, False), (1.5, True)):
        plant = GearedPlant(arm, drives, POSE)
        plant.reset(POSE)
        torque = arm.gravity_torque(POSE)
        torque[0] += share * drives.static[0]
        for _ in range(300):
            plant.step(torque, 1_000_000)
        assert (plant.q[0] > 0.01) == moves
        assert np.abs(plant.q[1:] - POSE[1:]).max() < 5e-3
        np.testing.assert_allclose(plant.motor_torque() @ B, torque)


def test_friction_takes_work_once_it_slides() -> None:
    drives = truth_drives(truth_arm())
    friction = LuGre(drives, np.full(6, 10.0))
    w = 0.1 * np.array([1.0, -1.0, 1.0, -1.0, 1.0, -1.0])
    for _ in range(200):
        f = friction.step(w, 1.0, 1e-3)
    assert np.all(f * w > 0.0)
    np.testing.assert_allclose(np.abs(f), drives.coulomb + drives.viscous * 0.1, rtol=1e-3)
    both = LuGre(Drives.stacked([drives, drives]), np.full((2, 6), 10.0))
    for _ in range(200):
        g = both.step(np.stack([w, w]), 1.0, 1e-3)
    np.testing.assert_array_equal(g, np.stack([f, f]))


def test_live_phases_glitch_after_reversals_only() -> None:
    sensors = CurrentSensors(np.zeros((6, 2)), np.ones((6, 2)), np.zeros(6))
    live = PhaseSensors(truth_arm(), sensors)
    torque = B.T @ np.full(6, 50.0)
    for k in range(300):
        speed = 0.1 if k < 100 else 0.0 if k < 150 else 0.1 if k < 200 else -0.1
        sample = live.read(k * 1_000_000, POSE, np.full(6, speed), torque)
        assert sample.effort is not None and sample.effort.shape == (6, 2)
        mixed = live._pulse[live._age]
        assert np.all(mixed > 0.0) == (200 <= k < 200 + round(GLITCH * 1e3))


# --- what touches, by phase currents ----------------------------------------------------------------------------------


def test_a_low_pass_step_by_step_is_scipys() -> None:
    from scipy import signal

    x = np.cumsum(np.random.default_rng(0).standard_normal((400, 3)), axis=0)
    sos = signal.butter(2, 100.0 / (np.pi * 1e3), output="sos")
    start = signal.sosfilt_zi(sos)[:, :, None] * x[0]
    mine = LowPass(100.0, 1e-3)
    np.testing.assert_allclose(
        [mine(row) for row in x], signal.sosfilt(sos, x, axis=0, zi=start)[0], atol=1e-9
    )
    mine.settle(np.full(3, 7.0), np.array([True, False, True]))
    assert mine(np.full(3, 7.0))[[0, 2]] == pytest.approx(7.0)


def test_live_it_is_as_good_as_in_the_study() -> None:
    """The way A - B of the sensorless-force study with its pushes, sample by sample."""
    arm = truth_arm()
    (motion,) = simulate([Run(arm, truth_drives(arm), _irb2400.there_and_back, 8.0, _irb2400.pushes(20))])
    readings = _irb2400.Sensors(SENSORS).read(motion)
    force = MotorForce(arm, identified(), moment_std=5.0)
    rows = []
    for k in range(len(motion)):
        phases = np.column_stack((readings.phase_a[k], readings.phase_b[k]))
        rows.append(force.step(Sample(int(readings.time_ns[k]), readings.position[k], None, phases)))
    begin = round(_irb2400.BEGIN * 1e3)
    error = np.array([r.force for r in rows])[begin:] - late(motion.wrench)[begin:, :3]
    std = np.array([r.std for r in rows])[begin:]
    assert np.abs(motion.wrench[:, 2]).max() > 50.0
    assert np.abs(error).mean(axis=0).max() < 2.4
    assert np.mean(np.abs(error) < 1.96 * std) > 0.85
    again = MotorForce(arm, identified(), moment_std=5.0)
    first = Sample(0, readings.position[0], None, np.zeros((6, 2)))
    again.step(first)
    again.reset()
    assert np.array_equal(
        again.step(first).force, MotorForce(arm, identified(), moment_std=5.0).step(first).force
    )


def test_a_motor_model_is_a_file_and_says_what_is_wrong_with_it() -> None:
    model = identified()
    again = MotorModel.from_json(model.to_json())
    assert np.array_equal(again.phi, model.phi) and again.sensor_gain.shape == (6, 2)
    gone = json.loads(model.to_json())
    del gone["gain"]
    for text, match in ((json.dumps(gone), "gain"), ("[1]", "motor model"), ("{", "motor model")):
        with pytest.raises(InputError, match=match):
            MotorModel.from_json(text)
    with pytest.raises(InputError, match="no motor model of 'kuka_lbr_iiwa7'"):
        identified("kuka_lbr_iiwa7")
    with pytest.raises(InputError, match=r"expected effort of shape \(6, 2\)"):
        MotorForce(truth_arm(), model).step(Sample(0, POSE, None, np.zeros(6)))


@pytest.mark.slow
def test_the_stored_model_is_what_identification_finds() -> None:
    script = Path(__file__).parents[2] / "scripts" / "identify_irb2400.py"
    found, stored = runpy.run_path(str(script))["model"](), identified()
    for name in ("coulomb", "viscous", "rotor", "gain", "angle_offset", "sensor_gain"):
        np.testing.assert_allclose(getattr(found, name), getattr(stored, name), rtol=0.02, atol=0.02)
    arm = truth_arm()
    Y = arm.regressor(POSE[None], np.zeros((1, 6)), np.ones((1, 6)))[0]
    np.testing.assert_allclose(Y @ found.phi, Y @ stored.phi, atol=2.0)


def test_the_abb_follows_and_nothing_false_is_felt() -> None:
    draw = free(slave_arm(ABB), 1, 0.1, 4.0)
    run = build(None, arm=ABB, hand=draw.hand, seed=draw.seed).run(seconds=draw.seconds)
    t = transparency(run, force_scale=slave_arm(ABB).force_scale)
    assert t.tracking < 2e-3 and t.speed > 0.4
    assert np.abs(run.felt).max() / slave_arm(ABB).force_scale < 1.57
    assert not run.reasons


def test_the_abb_feels_a_wall() -> None:
    """A tenth of the published error is judged by the study; here, that it is not far from it."""
    setup = build("wall", arm=ABB, stiffness=2000.0, press=0.03)
    run = setup.run(seconds=5.0)
    found = contact(run, setup.follower.force_scale)
    assert found.force > 25.0 and found.held < 5.0 and found.whole < 6.0
    assert np.abs(run.felt[:2500]).max() == 0.0


def test_the_abb_weighs_while_it_moves() -> None:
    run = build("lift", arm=ABB, masses=(8.0,)).run(seconds=5.5)
    ((time, true, mass, std),) = run.held
    assert time > 3.5 and mass == pytest.approx(true, abs=max(0.4, 3.0 * std))


# --- joint to joint ---------------------------------------------------------------------------------------------------


def test_the_path_of_the_joints_takes_the_tip_along_the_path_of_the_hand() -> None:
    chosen = slave_arm("so101")

    def way(time: float) -> np.ndarray:
        return 0.05 * np.array([np.sin(time), 0.0, np.cos(time) - 1.0])

    wish = joint_path(chosen.arm, chosen.q, way, 4.0)

    def tip(q: np.ndarray) -> np.ndarray:
        T = chosen.arm.forward_kinematics(q)
        return T[:3, :3] @ chosen.arm.grasp + T[:3, 3]

    for time in (0.0, 2.5, 3.3, 4.0):
        np.testing.assert_allclose(tip(wish(time)) - tip(chosen.q), way(time), atol=2e-4)


def test_the_so101_follows_its_twin_and_the_hand_feels_a_touch() -> None:
    chosen = slave_arm("so101")
    moved = led(free(chosen, 1, 0.06, 3.5))
    assert moved.tracking < 2e-3 and moved.free_force < 0.1
    draw = pressing(chosen, 1, 500.0, 0.03)
    pressed = build("wall", arm="so101", stiffness=draw.stiffness, hand=draw.hand, seed=1).run(seconds=5.5)
    felt, estimated, true = held_torque(pressed)
    assert true > 0.5 and felt < 0.1 and estimated < 0.1


@pytest.mark.slow
def test_whole_counts_over_a_delay_do_not_empty_a_tank_beyond_its_bottom() -> None:
    run = build("wall", arm="so101").run(seconds=8.0, faults=Faults(delay=0.02))
    assert min(tank["lowest"] for tank in run.tanks.values()) >= 0.0


def test_a_servo_at_rest_keeps_its_touch_and_one_that_turns_back_and_forth_tells_it() -> None:
    """One joint about the vertical, its friction a quarter of the touch."""
    arm = robots.load("so101")
    count, h, touch = 1.5e-3, 4e-3, 0.5
    force = ServoForce(arm, load_friction=0.2, count=count, bandwidth=60.0, period=h)
    q, gravity = np.zeros(arm.n), arm.gravity_torque(np.zeros(arm.n))
    # at rest whatever the motor bears within friction's band leaves the estimate as it is
    for k in range(200):
        force.step(q, gravity + 0.05 * np.sin(0.1 * k))
    np.testing.assert_allclose(force.torque, 0.0, atol=1e-9)
    assert force.stuck.min() > 0.99
    # a joint that stands although its motor pushes harder than friction is pushed back
    for _ in range(500):
        push = gravity.copy()
        push[0] -= touch
        force.step(q, push)
    band = force.band[0]
    assert touch - 1.2 * band < force.torque[0] < touch


def test_a_resting_motor_changes_its_friction_and_not_the_touch() -> None:
    """The residual that comes with a motor's way at rest is friction's; what comes without any is a touch."""
    model = identified()
    z, lever, seen = np.full(6, 0.9), np.ones(6), np.ones(6, dtype=bool)
    split = _Split(model)
    for k in range(400):
        # it comes to rest from sliding: friction turns over, and the residual with it
        split.step(
            np.full(6, 2.0 * k / 400),
            z * (1.0 - k / 400),
            0.5 * model.presliding / 400,
            lever,
            0.0,
            1e-3,
            seen,
        )
    settling = split.touch
    split = _Split(model)
    for k in range(400):
        split.step(np.full(6, 2.0 * k / 400), np.ones(6), np.zeros(6), lever, 0.0, 1e-3, seen)
    # a motor that never moved kept its friction: the same residual presses more than where friction turned over
    assert np.all(0.0 <= settling) and np.all(settling[[0, 1, 2, 4]] < 0.9 * split.touch[[0, 1, 2, 4]])
    assert np.all(split.variance > 0.0)


def test_a_real_leader_arm_is_read_and_pushes_back_over_its_bus() -> None:
    """The maker's SDK against emulated servos on a pseudo-terminal."""
    pytest.importorskip("scservo_sdk")
    pytest.importorskip("serial")
    from palpate.drivers.bus import Bus, Servo
    from palpate.drivers.feetech import FeetechDriver
    from servo_bus import Emulated, FeetechBus

    arm = robots.load("so101")
    constant = 1.09
    servos = tuple(
        Servo(id=i + 1, joint=name, model="STS3215-C018", torque_constant=constant)
        for i, name in enumerate(arm.joint_names)
    )
    emulated = [Emulated(id=i + 1, joint=i, constant=constant, model=777) for i in range(arm.n)]
    place = np.array([0.1, -0.2, 0.3, 0.4, -0.5])
    with FeetechBus(emulated) as bus:
        bus.world.q = place.copy()
        leader = LeaderArm(FeetechDriver(arm, bus.port, bus=Bus(servos=servos)), arm)
        try:
            felt = np.array([0.8, -0.8, 0.8, -0.8, 0.8])
            for _ in range(20):
                leader.step(felt, 4e-3)
            q, dq = leader.read()
            assert q == pytest.approx(place, abs=2e-3) and np.abs(dq).max() < 1e-6
            wanted = felt + arm.gravity_torque(place)
            assert np.all(bus.world.torque * wanted > 0.0)
        finally:
            leader.close()


# --- scenes -----------------------------------------------------------------------------------------------------------


def test_a_peg_goes_into_its_hole_gently() -> None:
    run = build("peg").run(seconds=9.2)
    depth = run.tip[0, 2] - 0.03 - run.tip[-1, 2]
    assert depth > 0.025
    assert 0.3 < np.linalg.norm(run.true, axis=1).max() < 8.5


def test_a_surface_is_traced() -> None:
    run = build("surface", press=0.01).run(seconds=5.5)
    traced = slice(4200, 5500)
    pressed = run.true[traced]
    assert np.ptp(run.tip[traced, 0]) > 0.03 and np.mean(pressed[:, 2] > 1.0) > 0.95
    assert np.linalg.norm(run.felt[traced] - pressed, axis=1).mean() < 0.15 * pressed[:, 2].mean() + 0.5


@pytest.mark.parametrize("arm", [ABB, "so101"])
def test_the_command_knows_them(arm: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("matplotlib")
    pytest.importorskip("rosbags")
    assert main(["teleop", "free", "--arm", arm, "--seconds", "0.6", "--out", str(tmp_path), "--quiet"]) == 0
    capsys.readouterr()
    assert (tmp_path / "report.html").is_file() and (tmp_path / "teleop.mcap").exists()
