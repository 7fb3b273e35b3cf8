"""Teleoperation: laws of the coupling from Python, masters, a whole run in MuJoCo, the command."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate import _core
from palpate.cli import main
from palpate.errors import DriverError, InputError
from palpate.teleop import (
    Event,
    Hand,
    HapticDevice,
    MasterSide,
    Message,
    SlaveSide,
    event_words,
    felt_force,
)

H = 1e-3


def sides(**options: Any) -> tuple[MasterSide, SlaveSide]:
    slave: dict[str, Any] = {"lower": -0.5, "upper": 0.5, "force_limit": 50.0, "task_space": False}
    return MasterSide(1, 20.0, session=1), SlaveSide(1, 0.5, session=1, **{**slave, **options})


def exchange(
    master: MasterSide, slave: SlaveSide, x: float, v: float, at: float, force: float, k: int
) -> tuple[Any, Any]:
    felt = master.step(np.array([x]), np.array([v]), H, k)
    slave.receive(master.message())
    command = slave.step(np.array([at]), np.zeros(1), np.array([force]), np.zeros(1), H, k)
    master.receive(slave.message())
    return felt, command


def test_motion_goes_there_and_force_comes_back() -> None:
    master, slave = sides()
    x = at = 0.0
    felt = None
    for k in range(4000):
        v = 0.02 if 1500 <= k < 3000 else 0.0
        x += v * H
        felt, command = exchange(master, slave, x, v, at, -3.0 if at > 0.02 else 0.0, k)
        at = float(command.position[0])
    assert felt is not None
    assert at == pytest.approx(x, abs=5e-4)
    assert felt.felt[0] == pytest.approx(-3.0)
    assert master.alive and slave.gain == 1.0
    tanks = master.tank(), slave.tank()
    assert sum(t["given"] for t in tanks) <= sum(t["taken"] for t in tanks) + 2 * _core.TankOptions().initial


def test_nothing_is_felt_where_there_may_be_nothing() -> None:
    rng = np.random.default_rng(0)
    noise = 0.2 * rng.standard_normal(100_000)
    assert np.mean(felt_force(noise, 0.2, 5.0) != 0.0) < 1e-5
    force = np.array([4.0, -40.0])
    assert np.array_equal(felt_force(force, 0.2, 5.0), force)
    with pytest.raises(InputError, match="threshold"):
        felt_force(force, 0.2, -1.0)


def test_options_say_what_they_expect() -> None:
    with pytest.raises(InputError, match="force_limit"):
        MasterSide(3, -1.0)
    with pytest.raises(InputError, match=r"expected one number or 3"):
        MasterSide(3, [1.0, 2.0])
    with pytest.raises(InputError, match="choose from force_position"):
        MasterSide(3, 5.0, coupling="springs")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="lower"):
        SlaveSide(3, 0.5, lower=1.0, upper=0.0, force_limit=5.0)
    with pytest.raises(InputError, match="rotation matrix"):
        SlaveSide(3, 0.5, lower=-1.0, upper=1.0, force_limit=5.0, rotation=2.0 * np.eye(3))
    with pytest.raises(InputError, match="SlaveSide n"):
        SlaveSide(2, 0.5, lower=-1.0, upper=1.0, force_limit=5.0)


def test_events_are_those_of_the_core() -> None:
    assert {name.lower(): int(bit) for name, bit in Event.__members__.items()} == _core.teleop_events()
    assert event_words(0) == ""
    assert "link is dead" in event_words(Event.LINK | Event.FORCE) and "limit" in event_words(Event.FORCE)


def test_a_restarted_side_gives_no_energy_twice_and_old_messages_are_left() -> None:
    master, slave = sides()
    for k in range(100):
        exchange(master, slave, 0.0, 0.0, 0.0, 0.0, k)
    late = master.message()
    rich = Message(2, 1, 0, np.zeros(1), np.zeros(1), np.zeros(1), 5.0, 0.0, 1.0, True)
    assert slave.receive(rich)
    slave.step(np.zeros(1), np.zeros(1), np.zeros(1), np.zeros(1), H, 0)
    assert slave.tank()["level"] <= _core.TankOptions().initial + 1e-9
    assert not slave.receive(late)


def test_episodes_make_no_energy_and_are_the_same_every_time() -> None:
    for seed in range(8):
        was, happened = _core.teleop_episode(seed, "tanks")
        assert happened["generated"] <= was["initial"]
        assert happened["force"] <= was["force_limit"] * (1 + 1e-9)
    assert _core.teleop_episode(3, "tanks") == _core.teleop_episode(3, "tanks")
    with pytest.raises(ValueError, match="choose from none, tanks, waves"):
        _core.teleop_episode(0, "magic")


def test_a_hand_on_a_device_goes_where_it_wishes() -> None:
    device = HapticDevice(Hand(wish=lambda t: np.array([0.05, 0.0, 0.0]), tremor=0.0, turn_tremor=0.0))
    for _ in range(3000):
        device.step(np.zeros(3), H)
    x, v = device.read()
    assert x[:3] == pytest.approx([0.05, 0.0, 0.0], abs=5e-5) and np.abs(v).max() < 1e-3
    for _ in range(3000):
        device.step(np.array([-100.0, 0.0, 0.0]), H)  # no device is that strong
    assert device.read()[0][0] == pytest.approx(0.05 - 8.5 / 400.0, abs=1e-4)
    with pytest.raises(InputError, match="mass > 0"):
        Hand(mass=0.0)


# --- in MuJoCo --------------------------------------------------------------------------------------------------------

pytest.importorskip("mujoco", reason="palpate[sim] is not installed")
pytest.importorskip("cryptography", reason="palpate[teleop] is not installed")

from palpate.teleop import scenes  # noqa: E402
from palpate.teleop.channel import Faults  # noqa: E402
from palpate.teleop.figures import contact, transparency  # noqa: E402
from palpate.teleop.session import Cut  # noqa: E402
from palpate.teleop.setups import build  # noqa: E402


def test_a_wall_feels_like_itself() -> None:
    found = build("wall", stiffness=2000.0).run(seconds=6.0)
    t = transparency(found, stiffness=2000.0)
    assert t.tracking < 2e-3 and t.free_force < 0.3
    assert t.force_error < 0.05 and t.stiffness > 0.9 and t.onset <= 0.02
    assert t.force_held > 5.0
    assert not found.refused and not found.reasons
    assert found.round_trip == pytest.approx(1e-3) and 1e5 < found.bandwidth[0] < 1e7
    for tank in found.tanks.values():
        assert tank["lowest"] >= 0.0


def test_contact_with_a_rigid_wall_is_steady() -> None:
    found = contact(build("rigid", seed=1).run(seconds=5.0), 5.0)
    assert found.held > 3.0 and found.unsteady < 0.1 * found.held and found.bounces <= 5
    stiff = contact(build("rigid", stiffest=math.inf, seed=1).run(seconds=5.0), 5.0)
    assert stiff.unsteady > 2.0 * found.unsteady
    with pytest.raises(InputError, match="stiffest"):
        build("rigid", stiffest=0.0)


def test_four_channels_feel_a_wall_like_itself() -> None:
    found = build("wall", stiffness=2000.0, coupling="four_channel").run(seconds=6.0)
    t = transparency(found, stiffness=2000.0)
    assert t.force_error < 0.05 and t.stiffness > 0.9


def test_a_dead_link_holds_and_comes_back_without_a_jump() -> None:
    from palpate.teleop.figures import jumps

    cut = (Cut(4.5, 0.6),)
    found = build("wall").run(seconds=6.0, cuts=cut)
    force, speed, moved = jumps(found, cut)
    assert force <= 2.0 and speed <= 5e-3 and moved <= 1e-9
    assert [text for _, text in found.reasons] == ["the link is dead: both hold"]


def test_delay_shakes_it_without_the_layer_and_not_with_it() -> None:
    shaking = {}
    for passive in (True, False):
        found = build("wall", stiffness=5000.0, passive=passive).run(
            seconds=6.0, faults=Faults(delay=0.06, loss=0.1)
        )
        late = found.time > 4.0
        shaking[passive] = float(found.device_velocity[late].std())
        if passive:
            assert min(tank["lowest"] for tank in found.tanks.values()) > -1e-3
    assert shaking[True] < 0.5 * shaking[False]


def test_what_is_lifted_is_weighed_and_then_not_felt() -> None:
    found = build("lift", masses=(0.8,)).run(seconds=5.0)
    ((_, true, mass, std),) = found.held
    assert mass == pytest.approx(true, abs=max(0.05, 3.0 * std))
    assert np.linalg.norm(found.felt[-500:], axis=1).max() < 2.0


def test_a_device_that_is_unplugged_is_said_and_the_slave_held() -> None:
    setup = build(None)
    driver = setup.slave.driver
    reads, unplugged = driver.read, [False]

    def read() -> Any:
        if unplugged[0]:
            driver.stop()
            raise DriverError("the cable is out")
        return reads()

    driver.read = read  # type: ignore[method-assign]

    def pull_out(done: float, whole: float) -> None:
        unplugged[0] = done >= 1.0

    found = setup.run(seconds=1.6, progress=pull_out)
    assert any("the cable is out" in text for _, text in found.reasons)
    assert np.ptp(found.reference[-300:], axis=0).max() == 0.0


def test_a_master_that_points_out_of_reach_is_told() -> None:
    away = Hand(wish=lambda t: np.array([0.0, 0.0, 0.4 * scenes.smooth((t - 1.5) / 2.0)]))
    found = build(None, hand=away).run(seconds=4.5)
    assert any("workspace" in text for _, text in found.reasons)
    assert found.felt[-1, 2] < -2.0  # the wall at the end of the workspace
    assert found.reference[:, 2].max() <= found.tip[0, 2] + 0.3 + 1e-4
    assert found.tip[:, 2].max() <= found.tip[0, 2] + 0.34  # the arm comes to rest behind its reference


@pytest.mark.parametrize("arm", ["kuka_lbr_iiwa14", "abb_irb2400_16"])
def test_a_slaves_velocity_is_that_of_its_tools_tip(arm: str) -> None:
    """Against finite differences of the tip's place: the tip, not the flange, where the tool is held."""
    slave = build(None, arm=arm).slave
    q = np.array(slave.seen.q) + 0.1
    _, _, J = slave._pose(q)
    h = 1e-6
    for k in range(slave.model.n):
        step = h * np.eye(slave.model.n)[k]
        (R1, x1, _), (R0, x0, _) = slave._pose(q + step), slave._pose(q - step)
        assert J[:3, k] == pytest.approx((x1 - x0) / (2.0 * h), abs=1e-8)
        spin = (R1 - R0) @ slave._pose(q)[0].T / (2.0 * h)
        assert J[3:, k] == pytest.approx([spin[2, 1], spin[0, 2], spin[1, 0]], abs=1e-8)


def test_scenes_and_arms_by_name() -> None:
    with pytest.raises(InputError, match="no scene 'wal'; did you mean 'wall'"):
        build("wal")
    with pytest.raises(InputError, match="no slave"):
        build("wall", arm="r2d2")
    with pytest.raises(InputError, match="stiffness"):
        build("wall", stiffness=1.0)
    with pytest.raises(InputError, match="masses"):
        build("lift", masses=(0.0,))


def test_the_command_writes_a_report_and_one_log_of_both_sides(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("matplotlib", reason="palpate[report] is not installed")
    pytest.importorskip("rosbags", reason="palpate[logs] is not installed")
    assert main(["teleop", "free", "--seconds", "1.5", "--out", str(tmp_path), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert any("bandwidth" in row["what"] for row in told["rows"])
    page = (tmp_path / "report.html").read_text()
    assert page.startswith("<!DOCTYPE html>") and "http" not in page.split("<body>")[1]

    from palpate.logs import Log

    log = Log.open(tmp_path / "teleop.mcap")
    assert len(log) == 1500 and log.n == 7
    assert {"master_position", "master_force", "slave_tip", "slave_force", "true_force"} <= set(log.signals)
    assert log.signals["master_position"].value.shape == (1500, 3)
    assert np.array_equal(log.signals["master_position"].time_ns, log.time_ns)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere"], "no scene"),
        (["wall", "--coupling", "x"], "--coupling"),
        (["wall", "--cut", "soon"], "--cut"),
        (["wall", "--loss", "2"], "loss"),
        (["wall", "--seconds", "-1"], "seconds"),
        (["turn", "--arm", "so101"], "led joint by joint"),
    ],
)
def test_wrong_input_is_one_line(
    arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["teleop", *arguments, "--out", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
