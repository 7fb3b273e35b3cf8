"""Excitation: inside the limits, at rest at its ends, clear of the arm, and better than chance."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from palpate import Arm, Limits, robots
from palpate.cli import main
from palpate.errors import ArmError, InputError
from palpate.identify import Excitation, excite, to_csv, to_ros
from palpate.simulate import Clearance, rehearse

pytest.importorskip("scipy", reason="palpate[identify] is not installed")


@pytest.fixture(scope="module")
def arm() -> Arm:
    return robots.load("katana_300_6m180")


@pytest.fixture(scope="module")
def found(arm: Arm) -> Excitation:
    return excite(arm, seconds=10.0, harmonics=4, iterations=8, clearance=Clearance(arm))


def test_limits_hold_and_the_ends_are_at_rest(arm: Arm, found: Excitation) -> None:
    for j, joint in enumerate(arm.joints):
        x = joint.limits
        assert x.lower <= found.q[:, j].min() and found.q[:, j].max() <= x.upper
        assert np.abs(found.dq[:, j]).max() <= min(x.velocity, 1e9)
    assert np.all(found.share <= 0.951) and np.all(found.share.max(axis=1) > 0.25)
    for end in (0, -1):
        assert not found.dq[end].any() and not found.ddq[end].any()
    np.testing.assert_allclose(found.q[0], found.q[-1], atol=1e-9)
    # it is what it says: the derivatives belong to the position
    step = found.time[1] - found.time[0]
    np.testing.assert_allclose(np.gradient(found.q, step, axis=0)[5:-5], found.dq[5:-5], atol=2e-2)
    np.testing.assert_allclose(np.gradient(found.dq, step, axis=0)[5:-5], found.ddq[5:-5], atol=1e-1)


def test_it_shows_more_than_random_motion(found: Excitation) -> None:
    assert found.conditioning < 0.8 * found.random_conditioning
    assert found.clearance > 0.0


def test_the_same_seed_gives_the_same_motion(arm: Arm, found: Excitation) -> None:
    again = excite(arm, seconds=10.0, harmonics=4, iterations=8, clearance=Clearance(arm))
    np.testing.assert_array_equal(again.q, found.q)


def test_a_simulated_arm_follows(arm: Arm, found: Excitation) -> None:
    tried = rehearse(arm, found.time, found.q, found.dq, found.ddq)
    assert tried.broken == () and tried.tracking.max() < 0.05
    assert tried.log.n == arm.n and len(tried.log) == len(found.time)


def test_a_motion_that_breaks_limits_is_told(arm: Arm, found: Excitation) -> None:
    tight = [j.replace(limits=Limits(j.limits.lower, j.limits.upper, 0.1, 1e-3)) for j in arm.joints]
    broken = rehearse(arm.replace(joints=tuple(tight)), found.time, found.q, found.dq, found.ddq).broken
    assert any("rad/s" in text for text in broken) and any("N m" in text for text in broken)


def test_limits_asked_for_hold(arm: Arm) -> None:
    slow = excite(arm, seconds=10.0, harmonics=3, iterations=2, velocity=0.2, acceleration=0.3, margin=0.5)
    assert np.abs(slow.dq).max() <= 0.1 and np.abs(slow.ddq).max() <= 0.15


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"seconds": 0.0}, "seconds must be"),
        ({"harmonics": 2}, "harmonics must be"),
        ({"margin": 1.5}, "margin must be"),
        ({"velocity": -1.0}, "velocity must be one or 5 positive numbers"),
        ({"acceleration": [1.0, 2.0]}, "acceleration must be one or 5"),
        ({"rate": np.nan}, "rate must be"),
    ],
)
def test_wrong_arguments(arm: Arm, options: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        excite(arm, **options)


def test_no_range_and_no_room(arm: Arm) -> None:
    stuck = arm.joints[1].replace(limits=Limits(0.1, 0.1))
    with pytest.raises(ArmError, match="has no range"):
        excite(arm.replace(joints=(arm.joints[0], stuck, *arm.joints[2:])))
    with pytest.raises(InputError, match="of a collision"):
        excite(arm, harmonics=3, iterations=1, clearance=lambda q: np.full(len(q), -0.1))


# -- clearance --------------------------------------------------------------------------------------------------------


def test_clearance_finds_a_folded_arm_and_the_floor() -> None:
    """Two links of 0.5 m; the third lies back on the base."""
    arm = Arm.from_dh(
        (0.5, 0.5, 0.5), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0),
        inertials=[(1.0, (0.0, 0.0, 0.0), 0.01 * np.eye(3))] * 3,
        gravity=(0.0, -9.81, 0.0),
    )  # fmt: skip
    clearance = Clearance(arm, reach=0.2)
    straight, triangle = np.zeros(3), np.array([0.0, 2 * np.pi / 3, 2 * np.pi / 3])
    assert clearance(straight) == pytest.approx(0.2)
    assert clearance(triangle)[0] < 0.0  # link 3 ends where link 1 begins
    assert clearance.closest(triangle)[0] == clearance(triangle)[0]
    floor = Clearance(arm, floor=-0.3)
    assert floor(straight)[0] > 0.0
    assert floor(np.array([-np.pi / 2, 0.0, 0.0]))[0] < 0.0
    assert "floor" in floor.closest(np.array([-np.pi / 2, 0.0, 0.0]))
    with pytest.raises(InputError, match="q must be"):
        clearance(np.zeros(4))


# -- files ------------------------------------------------------------------------------------------------------------


def test_the_ros_message_has_the_fields_of_the_type(found: Excitation) -> None:
    from rosbags.typesys import Stores, get_typestore

    message = yaml.safe_load(to_ros(found, approach=2.5))
    store = get_typestore(Stores.LATEST)
    known = {name for name, _ in store.fielddefs["trajectory_msgs/msg/JointTrajectory"][1]}
    assert set(message) == known
    of_point = {name for name, _ in store.fielddefs["trajectory_msgs/msg/JointTrajectoryPoint"][1]}
    first, *_, last = message["points"]
    assert set(first) <= of_point
    assert message["joint_names"] == list(found.joint_names)
    np.testing.assert_allclose(first["positions"], found.q[0], atol=1e-6)
    assert first["time_from_start"] == {"sec": 2, "nanosec": 500_000_000}
    assert last["time_from_start"] == {"sec": 12, "nanosec": 500_000_000}
    assert not any(first["velocities"]) and not any(last["accelerations"])
    times = [p["time_from_start"]["sec"] + 1e-9 * p["time_from_start"]["nanosec"] for p in message["points"]]
    assert np.all(np.diff(times) > 0.0)
    with pytest.raises(InputError, match="approach"):
        to_ros(found, approach=0.0)


def test_the_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], found: Excitation
) -> None:
    monkeypatch.chdir(tmp_path)
    arguments = [
        "excite",
        "--arm",
        "katana_300_6m180",
        "--seconds",
        "10",
        "--harmonics",
        "4",
        "--iterations",
        "8",
    ]
    assert main([*arguments, "--ros", "traj.yaml", "--plot", "traj.png", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["conditioning"] == found.conditioning and result["files"]["picture"] == "traj.png"
    assert (tmp_path / "traj.csv").read_text(encoding="utf-8") == to_csv(found)
    table = np.loadtxt(tmp_path / "traj.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(table[:, 1:6], found.q, atol=1e-8)
    assert (tmp_path / "traj.png").read_bytes().startswith(b"\x89PNG")
    assert main([*arguments, "--velocity", "0"]) == 2
    assert "velocity must be" in capsys.readouterr().err
