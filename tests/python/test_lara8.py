"""A real LARA 8 weighs: its kinematics against the controller's, its torques against the wrist sensor."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.studies import STUDIES
from palpate.studies.lara8 import (
    FREE,
    LOADED,
    lara8_arm,
    open_log,
    per_kilogram,
    residual,
    torsion,
    wrist_sensor,
)
from palpate.weigh import weigh_log
from recordings import recording


@pytest.fixture(scope="module")
def arm():
    return lara8_arm()


@pytest.fixture
def logs(monkeypatch):
    folder = recording("lara8_neura_ft", LOADED).parent
    recording("lara8_neura_ft", FREE)
    monkeypatch.setenv("PALPATE_DATA", str(folder.parent))
    return open_log(LOADED), open_log(FREE)


def test_arm_is_kinematics_with_the_worth_of_its_readings(arm, tmp_path):
    assert arm.n == 6 and not arm.has_dynamics and arm.effort.kind == "torque"
    assert {j.sensing.torque_gain_std for j in arm.joints} == {0.1}
    np.testing.assert_array_equal(arm.gravity, [0.0, 0.0, -9.81])
    arm.save(tmp_path / "lara8.yaml")
    assert type(arm).from_card(tmp_path / "lara8.yaml") == arm


def test_kinematics_agree_with_the_controllers_pose(arm, logs):
    for log in logs:
        pose = log.signals["pose"].value[:, :3]
        np.testing.assert_allclose(arm.forward_kinematics(log.position)[:, :3, 3], pose, atol=1e-5)


def test_the_sensor_sees_a_hanging_load(arm, logs):
    loaded, free = (wrist_sensor(arm, log) for log in logs)
    assert loaded.mass == pytest.approx(5.262, abs=0.002)
    np.testing.assert_allclose(loaded.force.mean(axis=0), [0.6, -0.2, -51.6], atol=0.1)
    assert np.linalg.norm(free.force, axis=1).max() < 2.0


def test_residual_torque_against_the_sensor(arm, logs):
    log = logs[0]
    expected, found = wrist_sensor(arm, log).torque.mean(axis=0), residual(log).mean(axis=0)
    np.testing.assert_allclose(expected[1:3], [36.5, 36.1], atol=0.2)
    np.testing.assert_allclose(found[1:3], [36.16, 48.65], atol=0.02)  # joint 3 is off by a third


def test_weighed_through_the_pipeline_the_interval_contains_the_truth(arm, logs):
    loaded, free = (weigh_log(log, arm) for log in logs)
    assert loaded.method() == "regression on model-residual"
    assert loaded.status.name == "ok"
    assert abs(loaded.mass - 5.262) < 1.96 * loaded.mass_std
    assert loaded.mass_std < 0.8  # and says something
    assert abs(loaded.mass / 5.262 - 1.0) < 0.25
    assert abs(free.mass) < 1.96 * free.mass_std
    assert free.status.name != "ok"  # nothing is held, and nothing is claimed


def test_torsion_has_a_common_zero(logs):
    # the constants of both logs agree to what a load can twist: without the gears' turns they would differ by radians
    ends = [torsion(log)[0] for log in logs]
    assert np.abs(ends[0] - ends[1]).max() < 2e-3


def test_study_reports_the_miss(logs):
    result = STUDIES["lara8"].run()
    rows = {row.what: row for row in result.rows}
    mass = rows["mass by regression over all joints, 5 s"]
    assert mass.ok == (abs(mass.ours - 5.26) <= 0.06 * 5.26)
    assert rows["its 95 % interval contains the wrist sensor's mass"].ok
    assert rows["nothing held: false mass"].ok
    assert rows["joint that weighing_joint picks"].ours == "joint_3"
    assert rows["published joint formula (nearest joint that feels the load), mean over time"].ours > 6.5
    assert result.notes
    assert len(result.figures) == 3


def test_levers_are_those_of_joints_2_and_3(arm, logs):
    levers = np.abs(per_kilogram(arm, logs[0])).mean(axis=0)
    np.testing.assert_allclose(levers[1:3], [6.92, 6.86], atol=0.01)
    assert np.delete(levers, [1, 2]).max() < 0.1


def test_without_the_data_the_study_says_how_to_get_it(monkeypatch, tmp_path):
    from palpate import data
    from palpate.errors import LogError

    monkeypatch.setattr(data, "_above", lambda folder: ())
    monkeypatch.setattr(data, "_cache", lambda pooch, found: tmp_path / found.folder)
    monkeypatch.delenv("PALPATE_DATA", raising=False)
    with pytest.raises(LogError, match="palpate data get lara8"):
        STUDIES["lara8"].run()
