"""palpate feel: contacts of a log in words and numbers, its report, and what it refuses."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import palpate as pp
from palpate.cli import main
from palpate.feel import Feeling, feel_log
from palpate.report import write_feel_report
from palpate.weigh.noise import describe_noise
from test_touch import FORCE, PUSH, arm, swing

__all__ = ["arm"]  # the fixture


@pytest.fixture(scope="module")
def felt(arm: pp.Arm) -> Feeling:
    arm = arm.replace(effort=pp.Effort.torque())
    return feel_log(swing(arm, 5.0, PUSH), arm, free=[swing(arm, 30.0, seed=8)])


def test_a_push_is_told(felt):
    (push,) = felt.pushes
    assert abs(push.start - 2.0) < 0.02 and push.start < push.alarm < push.start + 0.02
    assert 3.0 < push.stop < 3.35 and 2.0 < push.time < 3.1
    assert push.tip and push.farthest == felt.arm.joints[-1].link
    assert np.all(np.abs(push.force - FORCE) < 6.0 * push.force_std)
    assert push.direction @ FORCE / np.linalg.norm(FORCE) > 0.97
    assert not push.singular.any()


def test_the_summary_is_json_and_says_what_the_rate_rests_on(felt):
    value = json.loads(json.dumps(felt.summary(), allow_nan=False))
    (contact,) = value["contacts"]
    assert contact["tip"] is True and len(contact["force_N"]) == 3
    assert set(contact["torque_Nm"]) == set(felt.arm.joint_names)
    assert value["false_alarms_per_hour"] == 1e-3
    assert value["noise"] == "while the model errs as in 30 s of free motion"


def test_the_report_is_one_file_that_fetches_nothing(felt, tmp_path):
    page = write_feel_report(felt.report(title="<b>"), tmp_path / "report.html").read_text(encoding="utf-8")
    assert "<b>" not in page and "&lt;b&gt;" in page
    assert "http" not in page.replace("http-equiv", "").replace("http://www.w3.org", "")
    for words in ("1 <small>contact", "one in 1,000 h", "Evidence of contact", "Wrench at the hand"):
        assert words in page
    assert (
        write_feel_report(felt.report(title="<b>"), tmp_path / "again.html").read_text(encoding="utf-8")
        == page
    )


def test_nothing_felt_is_said_so(arm):
    arm = arm.replace(effort=pp.Effort.torque())
    free = swing(arm, 20.0)
    found = feel_log(free, arm, free=[free])
    assert found.pushes == () and found.remarks == ()
    assert found.summary()["contacts"] == []
    without = feel_log(free, arm)
    assert without.pushes == () and "as the arm's description says" in without.noise


def test_a_direction_that_is_not_seen_is_no_number(arm):
    short = arm.replace(joints=arm.joints[:2], shapes=(), frames={}, effort=pp.Effort.torque())
    log = swing(short, 3.0)
    held = feel_log(log, short)
    status = held.touch.wrench.status
    assert (status[500:] == int(pp.Status.singular)).all()
    assert held.touch.wrench.singular[-1].any()
    assert held.report().singular.any()


def test_known_weight_is_no_push(arm):
    arm = arm.replace(effort=pp.Effort.torque())
    log = swing(arm, 4.0, held=3.0)
    weight = feel_log(log, arm, mass=3.0).touch.wrench
    assert (weight.load_mass[-100:] == 3.0).all()
    assert np.abs(weight.force[1000:].mean(axis=0)).max() < 2.0


def test_without_masses_the_controllers_model_stands_in(arm):
    bare = arm.replace(
        joints=tuple(
            j.replace(mass=0.0, com=np.zeros(3), inertia=np.zeros((3, 3)), friction=pp.Friction())
            for j in arm.joints
        ),
        effort=pp.Effort.torque(),
    )
    log = swing(arm, 5.0, PUSH)
    with pytest.raises(pp.ArmError, match="no masses .*palpate identify"):
        feel_log(log, bare)
    smooth = swing(arm, 5.0)
    friction = arm.friction_torque(smooth.velocity)
    record = pp.Log(
        time_ns=log.time_ns,
        position=log.position,
        velocity=log.velocity,
        effort=log.effort - friction,
        model_torque=smooth.effort - friction,
        joint_names=log.joint_names,
    )
    found = feel_log(record, bare)
    (push,) = found.pushes
    assert abs(push.start - 2.0) < 0.02
    assert any("no masses" in remark for remark in found.remarks)
    with pytest.raises(pp.InputError, match="no masses: free logs"):
        feel_log(record, bare, free=[record])


def test_bad_input_is_one_clear_line(arm):
    arm = arm.replace(effort=pp.Effort.torque())
    log = swing(arm, 1.0)
    with pytest.raises(pp.InputError, match="false alarms per hour: expected a number > 0, got 0"):
        feel_log(log, arm, false_alarms_per_hour=0.0)
    with pytest.raises(pp.InputError, match="held mass"):
        feel_log(log, arm, mass=-1.0)
    with pytest.raises(pp.InputError, match="no samples"):
        feel_log(log[0:0], arm)
    with pytest.raises(pp.LogError):
        feel_log(log)
    with pytest.raises(pp.InputError, match="fewer than 500 samples"):
        feel_log(log, arm, free=[swing(arm, 0.5)])


@pytest.fixture(scope="module")
def files(arm: pp.Arm, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("feel")
    arm.replace(effort=pp.Effort.torque()).save(folder / "arm.yaml")
    for name, log in (("task", swing(arm, 4.0, PUSH)), ("free", swing(arm, 20.0, seed=8))):
        table = np.column_stack((log.seconds, log.position, log.velocity, log.effort))
        head = ["time", *(f"{k}{j}" for k in ("q", "v", "tau") for j in range(1, arm.n + 1))]
        np.savetxt(
            folder / f"{name}.csv", table, delimiter=",", header=",".join(head), comments="", fmt="%.12g"
        )
    (folder / "map.yaml").write_text(
        "time: time\ntime_unit: s\nposition: q{joint}\nvelocity: v{joint}\neffort: tau{joint}\neffort_unit: N m\n"
        "joint_names: [" + ", ".join(f"'{j}'" for j in range(1, arm.n + 1)) + "]\n"
    )
    return folder


def feel(folder: Path, *options: object) -> int:
    common = [folder / "task.csv", "--columns", folder / "map.yaml", "--arm", folder / "arm.yaml"]
    return main(["feel", *map(str, common), *map(str, options)])


def test_the_command(files, tmp_path, capsys):
    assert feel(files, "--free", files / "free.csv", "-o", tmp_path) == 0
    text = capsys.readouterr().out
    assert "contacts" in text and "the tip would explain it" in text and "one in 1,000 h" in text
    assert (tmp_path / "report.html").is_file()
    assert feel(files, "--json", "--no-report", "--false-alarms", 0.5) == 0
    value = json.loads(capsys.readouterr().out)
    assert value["false_alarms_per_hour"] == 0.5 and len(value["contacts"]) == 1 and value["files"] == {}
    assert feel(files, "--quiet", "--no-report") == 0
    begin, end, link = capsys.readouterr().out.split()
    assert abs(float(begin) - PUSH["start"]) < 0.02 and abs(float(end) - PUSH["stop"]) < 0.2 and link


def test_the_command_refuses(files, tmp_path, capsys):
    for options, words in (
        (("--false-alarms", 0), "expected a number > 0"),
        (("--mass", "nan"), "held mass"),
        (("--free", files / "gone.csv"), "gone.csv"),
        (("--arm", "gone.yaml"), "gone.yaml"),
    ):
        assert feel(files, "--no-report", *options) == 2
        error = capsys.readouterr().err
        assert words in error and len(error.strip().splitlines()) == 1
    (tmp_path / "report.html").write_text("mine")
    assert feel(files, "-o", tmp_path) == 2
    assert "not written by palpate" in capsys.readouterr().err


@pytest.mark.parametrize("late", [False, True], ids=["sampled when stamped", "sampled evenly, stamped late"])
def test_uneven_stamps_are_no_noise_of_the_position(late: bool) -> None:
    rng = np.random.default_rng(3)
    arm = pp.robots.load("kuka_lbr_iiwa14")
    arm = arm.replace(joints=tuple(j.replace(sensing=pp.Sensing()) for j in arm.joints))
    even = np.arange(3000) * 0.01
    stamps = even + rng.uniform(0.0, 0.004, len(even))
    moved = np.sin((even if late else stamps)[:, None] + np.arange(7))
    log = pp.Log(
        time_ns=np.rint(stamps * 1e9).astype(np.int64),
        position=moved + 2e-5 * rng.normal(size=moved.shape),
        effort=0.3 * rng.normal(size=moved.shape),
        joint_names=arm.joint_names,
    )
    found, said = describe_noise(arm, log)
    assert "taken from the log itself" in said
    for joint in found.joints:
        assert joint.sensing.position_std == pytest.approx(2e-5, rel=0.15)  # without the largest
        assert joint.sensing.torque_std == pytest.approx(0.3, rel=0.15)
