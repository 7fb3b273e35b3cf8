"""Orientation in teleoperation: what a side takes, a gimbal with and without motors, a valve in MuJoCo."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from palpate import _core
from palpate.cli import main
from palpate.errors import InputError
from palpate.teleop import Event, Hand, HapticDevice, MasterSide, SlaveSide
from palpate.teleop.coupling import LEVER
from palpate.teleop.ends import MasterEnd
from palpate.teleop.pose import pose_minus, pose_of, pose_plus

H = 1e-3


def test_rotation_vectors_are_those_of_their_matrices() -> None:
    rng = np.random.default_rng(0)
    for angle in (0.0, 1e-9, 0.3, 2.0, math.pi - 1e-9, math.pi):
        axis = rng.standard_normal(3)
        axis /= np.linalg.norm(axis)
        R = _core.rotation_matrix(angle * axis)
        K = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
        assert (
            pytest.approx(np.eye(3) + math.sin(angle) * K + (1.0 - math.cos(angle)) * K @ K, abs=1e-14) == R
        )
        again = _core.rotation_matrix(_core.rotation_vector(R.ravel()))
        assert again == pytest.approx(R, abs=1e-14)
        x, d = pose_of(R, rng.standard_normal(3)), 0.5 * rng.standard_normal(6)
        assert pose_minus(pose_plus(x, d), x) == pytest.approx(d, abs=1e-13)
    with pytest.raises(ValueError, match="expected 3 numbers"):
        _core.rotation_matrix(np.zeros(2))
    with pytest.raises(ValueError, match="expected 9 numbers"):
        _core.rotation_vector(np.zeros(3))


def test_one_number_for_a_pose_is_of_the_place_and_of_a_lever() -> None:
    """The end of the workspace is felt as the spring that one number gives: 500 N/m, and 5 N m/rad."""
    master = MasterSide(6, 1e3, pose=True, session=1)
    slave = SlaveSide(
        6,
        10.0,
        pose=True,
        lower=np.full(3, -0.1),
        upper=np.full(3, 0.1),
        turn_limit=0.2,
        force_limit=1e3,
        acceleration=1e4,
        session=1,
    )
    x = at = np.zeros(6)
    felt = None
    for k in range(4000):
        v = np.array([0.15, 0.0, 0.0, 0.0, 0.3, 0.0]) * (1500 <= k < 2500)
        x = pose_plus(x, H * v)
        felt = master.step(x, v, H, k)
        slave.receive(master.message())
        command = slave.step(at, np.zeros(6), np.zeros(6), np.zeros(6), H, k)
        master.receive(slave.message())
        at = command.position
    assert felt is not None and command.events & Event.WORKSPACE
    assert felt.felt == pytest.approx([-500.0 * 0.05, 0, 0, 0, -500.0 * LEVER**2 * 0.1, 0], abs=1e-6)
    with pytest.raises(InputError, match="pose"):
        MasterSide(5, 1.0, pose=True)
    with pytest.raises(InputError, match="turn_limit"):
        SlaveSide(6, 1.0, pose=True, lower=-1.0, upper=1.0, force_limit=1.0, turn_limit=4.0)


class Three:
    """A device that knows no orientation."""

    force_limit = 5.0

    def __init__(self) -> None:
        self.told = np.full(3, np.nan)

    def read(self) -> tuple[np.ndarray, np.ndarray]:
        return np.array([0.1, 0.2, 0.3]), np.zeros(3)

    def step(self, force: np.ndarray, dt: float) -> None:
        self.told = force


def test_a_device_of_three_axes_leaves_the_orientation() -> None:
    device = Three()
    end = MasterEnd(device, MasterSide(6, [5.0, 5.0, 5.0, 0.0, 0.0, 0.0], pose=True, session=1))
    end.step(0)
    assert end.x == pytest.approx([0.1, 0.2, 0.3, 0.0, 0.0, 0.0]) and device.told.shape == (3,)
    message = end.side.message()
    assert message.shown == 0b000111 and message.position.shape == (6,)


def test_a_wrist_turns_a_gimbal_and_its_motors_turn_it_back() -> None:
    wish = np.array([0.0, 0.6, 0.0])
    for limit, turned in ((0.0, 0.6), (0.3, 0.6 - 0.3 / 3.0)):
        device = HapticDevice(Hand(wish_turn=lambda t: wish, turn_tremor=0.0), torque_limit=limit)
        for _ in range(2000):
            device.step(np.array([0.0, 0.0, 0.0, 0.0, -5.0, 0.0]), H)
        assert device.read()[0][3:] == pytest.approx([0.0, turned, 0.0], abs=2e-4)
    with pytest.raises(InputError, match="torque_limit"):
        HapticDevice(Hand(), torque_limit=-1.0)
    with pytest.raises(InputError, match="inertia"):
        Hand(inertia=0.0)


# --- in MuJoCo --------------------------------------------------------------------------------------------------------

pytest.importorskip("mujoco", reason="palpate[sim] is not installed")
pytest.importorskip("cryptography", reason="palpate[teleop] is not installed")

from palpate.studies._teleop_turning import circle, wrist  # noqa: E402
from palpate.teleop import scenes  # noqa: E402
from palpate.teleop.channel import Faults  # noqa: E402
from palpate.teleop.figures import transparency, turning  # noqa: E402
from palpate.teleop.session import Cut  # noqa: E402
from palpate.teleop.setups import TURN_REACH, build  # noqa: E402


def test_the_tool_turns_as_the_hand_does_while_it_moves() -> None:
    run = build(None, hand=Hand(wish=circle, wish_turn=wrist)).run(seconds=4.5)
    found = turning(run)
    assert found.spin > 0.8 and found.tracking < 1e-3
    assert transparency(run).tracking < 2e-3
    assert np.all(run.felt_torque == 0.0)


def test_the_abb_turns_its_tool_too() -> None:
    run = build(None, arm="abb_irb2400_16", hand=Hand(wish_turn=wrist)).run(seconds=4.0)
    found = turning(run)
    assert found.spin > 0.5 and found.tracking < 0.01
    assert np.isinf(run.torque_std).all() and not run.estimated_torque.any()  # it tells nothing of moments


def test_a_valve_feels_like_itself() -> None:
    setup = build("turn")
    run = setup.run(seconds=6.0)
    found = turning(run, torque_scale=setup.follower.torque_scale)
    assert found.torque_held > 0.15 and found.torque_error < 0.1
    assert found.estimate_error < 0.1
    assert not run.reasons
    for tank in run.tanks.values():
        assert tank["lowest"] >= 0.0


def test_a_gimbal_without_motors_turns_the_valve_and_nothing_is_felt_of_it() -> None:
    run = build("turn", torque_limit=0.0).run(seconds=5.0)
    assert np.linalg.norm(_core.turn_between(run.tip_turn[-1], run.tip_turn[0])) > 0.38
    assert np.linalg.norm(run.true_torque[-1]) > 0.2
    assert not run.torque.any() and not run.felt_torque.any()
    assert not np.any(run.slave_events[2500:] & int(Event.ENERGY))


def test_a_bad_network_makes_no_energy_at_a_valve() -> None:
    run = build("turn").run(seconds=6.0, faults=Faults(delay=0.08, jitter=0.04, loss=0.2))
    given, taken = (sum(tank[name] for tank in run.tanks.values()) for name in ("given", "taken"))
    assert given <= taken + 2.0 * 0.05 + 1e-6
    assert min(tank["lowest"] for tank in run.tanks.values()) > -1e-3
    assert np.abs(run.torque).max() <= 0.5


def test_a_dead_link_holds_the_orientation_and_comes_back_without_a_jump() -> None:
    run = build("turn").run(seconds=6.0, cuts=(Cut(4.0, 0.8),))
    dead = (run.slave_events & int(Event.LINK)) != 0
    dead[:3000] = False
    assert dead.any() and np.ptp(run.reference_turn[dead], axis=0).max() == 0.0
    back = slice(4800, 5300)
    assert np.abs(np.diff(run.torque[back], axis=0)).max() < 0.02
    assert np.abs(np.diff(run.reference_turn[back], axis=0)).max() / H < 0.6
    assert [text for _, text in run.reasons] == ["the link is dead: both hold"]


def test_a_hand_that_turns_too_far_is_told() -> None:
    far = Hand(wish_turn=lambda t: np.array([0.0, 0.0, 1.6 * scenes.smooth((t - 1.5) / 1.5)]))
    run = build(None, hand=far, torque_limit=0.5).run(seconds=3.8)
    assert any("workspace" in text for _, text in run.reasons)
    turned = [float(np.linalg.norm(_core.turn_between(row, run.tip_turn[0]))) for row in run.reference_turn]
    assert max(turned) == pytest.approx(TURN_REACH, abs=1e-6)
    assert run.felt_torque[-1, 2] < -0.3  # the largest angle is a spring


def test_the_command_turns_a_valve_and_records_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("matplotlib", reason="palpate[report] is not installed")
    pytest.importorskip("rosbags", reason="palpate[logs] is not installed")
    options = ["--seconds", "2.8", "--torque", "0.3", "--out", str(tmp_path), "--json"]
    assert main(["teleop", "turn", *options]) == 0
    told = json.loads(capsys.readouterr().out)
    assert any("turned away" in row["what"] and row["unit"] == "mrad" for row in told["rows"])
    assert "torque about the tool" in (tmp_path / "report.html").read_text().lower()

    from palpate.logs import Log

    log = Log.open(tmp_path / "teleop.mcap")
    for name, unit in (("master_turn", "rad"), ("slave_turn", "rad"), ("true_torque", "N m")):
        assert log.signals[name].value.shape == (2800, 3) and log.signals[name].unit == unit


def test_a_singular_pose_is_held_told_felt_and_left_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """A hand that stretches the arm out and beyond: its joints stay slow, the reason is one line, the hand feels it."""
    from palpate.teleop import setups

    monkeypatch.setattr(setups, "REACH", 1.0)
    way = scenes.through(
        [(1.5, (0.0,) * 3), (3.0, (0.4, 0.0, 0.0)), (3.6, (0.4, 0.0, 0.0)), (5.0, (0.0,) * 3)]
    )
    setup = build(None, hand=Hand(wish=way))
    slave = setup.slave
    run = setup.run(seconds=7.5)
    least = [np.linalg.svd(slave._pose(q)[2])[1][-1] for q in run.q[::50]]
    assert min(least) < 0.02, "the pose is singular"
    fastest = np.array([j.limits.velocity for j in slave.model.joints])
    assert np.all(np.abs(np.diff(run.q, axis=0)) / H < 1.02 * fastest)
    told = [text for _, text in run.reasons if "singular" in text]
    assert len(told) == 1 and "gives up" in told[0]
    assert run.felt[:, 0].min() == pytest.approx(-8.5)  # as hard as the device can
    assert np.linalg.norm(run.tip[-1] - run.wanted[-1]) < 3e-3 and not run.holding


def test_four_channels_over_a_delay_come_to_rest_at_a_rigid_wall_and_make_no_energy() -> None:
    faults = Faults(delay=0.1, jitter=0.02, loss=0.1)
    run = build("rigid", coupling="four_channel").run(seconds=6.0, faults=faults)
    given, taken = (sum(tank[name] for tank in run.tanks.values()) for name in ("given", "taken"))
    assert given <= taken + 2.0 * 0.05 + 1e-6
    assert min(tank["lowest"] for tank in run.tanks.values()) > -1e-6
    late = run.time > 5.0
    pressed = np.linalg.norm(run.true[late], axis=1)
    assert pressed.min() > 3.0 and pressed.std() < 0.1 * pressed.mean()
    assert np.linalg.norm(run.tip_velocity[late], axis=1).max() < 5e-3
    assert np.abs(run.force).max() <= 8.5
