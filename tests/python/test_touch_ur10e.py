"""Contacts on a real UR10e: noise measured on four free logs, judged on logs that had no part in it."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

import numpy as np
import pytest

import palpate as pp
from palpate.logs import ColumnMap, Log

TRAINED = (
    "identification_data/ur-20_01_31-unload.csv",
    "identification_data/ur-20_02_10-30sec_12harm.csv",
    "identification_data/ur-20_02_12-40sec_12harm.csv",
    "identification_data/ur-20_02_19_14harm50sec.csv",
)
COLUMNS = ColumnMap(
    time=0,
    time_unit="s",
    position=range(1, 7),
    velocity=range(7, 13),
    effort=range(13, 19),
    effort_unit="A",
)


@pytest.fixture(scope="module")
def folder() -> Path:
    data = Path(os.environ.get("PALPATE_DATA", Path(__file__).parents[2] / ".." / "shared" / "data"))
    if not (data / "ur10e_innopolis").is_dir():
        pytest.skip(f"no recorded data in {data} (set PALPATE_DATA)")
    return data / "ur10e_innopolis"


@pytest.fixture(scope="module")
def published(folder: Path) -> pp.Arm:
    """The arm with the parameters and gains its authors identified; nothing of it comes from the contact logs."""
    text = (folder / "UR10E_parameters.txt").read_text(encoding="utf-8")

    def numbers(name: str) -> np.ndarray:
        found = re.search(rf"{name}\s*=\s*\[([^\]]*)\]", text)
        assert found is not None
        return np.array([float(x) for x in found[1].split()])

    gains, rotors = numbers("drvGains"), numbers("pi_drvs")
    friction, rigid = numbers("pi_frcn").reshape(6, 3), numbers("pi_rgd").reshape(6, 10)
    arm = pp.Arm.from_urdf(folder / "ur10e.urdf", base="base_link", tip="tool0")
    joints = []
    for j, joint in enumerate(arm.joints):
        xx, xy, xz, yy, yz, zz, *first, mass = rigid[j]
        com = np.array(first) / mass
        inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        inertia -= mass * (com @ com * np.eye(3) - np.outer(com, com))
        # on the border of the possible, rounded to 15 digits: the density-weighted second moments must be positive
        moments, axes = np.linalg.eigh(inertia)
        second = np.maximum(0.5 * moments.sum() - moments, 1e-6)
        inertia = axes @ np.diag(second.sum() - second) @ axes.T
        viscous, coulomb, offset = friction[j]
        joints.append(
            joint.replace(
                mass=float(mass),
                com=com,
                inertia=0.5 * (inertia + inertia.T),
                rotor_inertia=float(rotors[j]),
                friction=pp.Friction(
                    coulomb=float(coulomb), viscous=float(viscous), offset=float(offset), sign_velocity=0.02
                ),
            )
        )
    return arm.replace(joints=tuple(joints), effort=pp.Effort.current(gains.tolist(), [1.0] * 6))


@pytest.fixture(scope="module")
def feeling(folder: Path, published: pp.Arm) -> pp.Pipeline:
    noise = pp.contact_noise(published, [Log.open(folder / f, columns=COLUMNS) for f in TRAINED])
    return pp.Pipeline(
        noise.arm(published), observer=pp.MomentumObserver(), payload=None, contact=noise.detector()
    )


def contacts(pipeline: pp.Pipeline, path: Path) -> tuple[list[pp.ContactEvent], float]:
    log = Log.open(path, columns=COLUMNS)
    pipeline.reset()
    touch = pipeline.run(log)
    assert touch.contact is not None
    return touch.contact.events(), float(log.time_ns[0]) * 1e-9


@pytest.mark.parametrize(
    "name",
    [
        *TRAINED,
        "validation_data/ur-20_01_17-ptp_10_points.csv",
        "collision_detection_data/collision_free.csv",
    ],
)
def test_no_contact_in_free_motion(folder, feeling, name):
    assert contacts(feeling, folder / name)[0] == []


def test_seven_of_eight_contacts_and_nothing_else(folder, feeling):
    # The one that is missed leans on slowly: 4 and 7 N m beyond what the published model errs by anyway.
    labels = json.loads((folder / "collision_detection_data" / "contact_labels.json").read_text())
    truth = labels["files"]["collision_2link.csv"]
    events, _ = contacts(feeling, folder / "collision_detection_data" / "collision_2link.csv")
    near = [min(abs(e.onset_time_ns * 1e-9 - c["t_on"]) for c in truth) for e in events]
    assert max(near) <= 0.15
    assert len(events) == 7
    assert all(e.link <= 1 <= e.farthest for e in events)  # link 2 is number 1
    # four are felt by joint 1 alone, pushed along the axis of joint 2; the others name the link
    assert sum(e.link == 1 for e in events) == 3


def test_four_pushes(folder, feeling):
    events, start = contacts(feeling, folder / "collision" / "ur-20_01_22-push_pose_1.csv")
    assert len(events) == 4
    for event, (on, off) in zip(events, ((1.8, 2.6), (4.6, 5.7), (8.2, 9.3), (11.9, 13.0)), strict=True):
        # at rest a push shows once it outdoes stiction
        assert on - 0.1 < event.onset_time_ns * 1e-9 - start < off
        assert event.release_time_ns is not None
        assert abs(event.release_time_ns * 1e-9 - start - off) < 0.15
