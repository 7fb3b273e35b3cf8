"""Recordings of real robots: the named maps and readers find what each data set's README states."""

from __future__ import annotations

import gzip
import json
import os
from pathlib import Path

import numpy as np
import pytest

from palpate.errors import InputError, LogError
from palpate.logs import ColumnMap, Log, read_bam, read_motor_pair, read_tx40


def data(*parts: str) -> Path:
    folder = Path(os.environ.get("PALPATE_DATA", Path(__file__).parents[2] / ".." / "shared" / "data"))
    path = folder.joinpath(*parts)
    if not path.exists():
        pytest.skip(f"no recorded data in {path} (set PALPATE_DATA)")
    return path


def test_ur10e():
    log = Log.open(
        data("ur10e_innopolis", "identification_data", "ur-20_01_31-unload.csv"), ColumnMap.named("ur10e")
    )
    assert len(log) == 2623
    assert log.joint_names[0] == "shoulder_pan_joint"
    assert log.meta["effort_unit"] == "A"
    assert log.model_torque is not None

    np.testing.assert_allclose(
        log.model_torque[0, 1] / log.signals["target_current"].value[0, 1], 11.976, rtol=1e-3
    )


def test_ur10e_with_wrench_skips_the_empty_last_line():
    path = data("ur10e_innopolis", "collision_detection_data", "collision_free.csv")
    log = Log.open(path, ColumnMap.named("ur10e_wrench"))
    assert len(log) == 1731
    assert log.signals["wrench"].value.shape == (1731, 6)
    assert log.model_torque is None


def test_ur10e_broken_rows_are_counted(tmp_path):
    lines = [",".join(f"{(k if c == 0 else 0.1 * c):g}" for c in range(31)) for k in range(50)]
    lines[7] = lines[7].replace(",0.3,", ",1e250,")
    lines[20] = lines[20][:40]
    lines[21] += ",5"
    path = tmp_path / "broken.csv"
    path.write_text("\n".join(lines) + "\n")
    log = Log.open(path, ColumnMap.named("ur10e"))
    assert len(log) == 47
    assert sum(log.repair.dropped.values()) == 3
    assert np.abs(log.position).max() < 10


def test_an_index_map_is_not_proposed_for_a_table_with_a_header(tmp_path):
    path = tmp_path / "wide.csv"
    path.write_text(",".join(f"c{k}" for k in range(40)) + "\n" + ",".join("1" for _ in range(40)) + "\n")
    with pytest.raises(LogError) as error:
        Log.open(path)
    assert "ur10e" not in str(error.value)


def test_kinova():
    log = Log.open(data("kinova_gen3_dynamapp", "opti_traj_testing1.csv.gz"), ColumnMap.named("kinova_gen3"))
    assert log.n == 7
    assert log.duration == pytest.approx(4.74, abs=0.02)
    current = np.interp(
        log.seconds,
        (log.signals["torque_current"].time_ns - log.time_ns[0]) * 1e-9,
        log.signals["torque_current"].value[:, 1],
    )
    np.testing.assert_allclose(current, 9.13 * log.effort[:, 1], atol=0.02)


def test_kuka():
    log = Log.open(data("kuka_lwr4_iit", "measurements_1.npz"), ColumnMap.named("kuka_lwr4"))
    assert log.position.shape == (5027, 7)
    assert log.velocity is not None
    assert log.duration == pytest.approx(25.13, abs=0.01)


def test_tx40():
    log = read_tx40(data("staubli_tx40", "pos_read_data.csv.gz"), data("staubli_tx40", "curr_data.csv.gz"))
    assert log.position.shape == (45000, 6)
    assert log.rate == pytest.approx(5000.0)
    assert log.repair.clean


def test_xl330():
    log = read_bam(data("xl330_bam", "2026-01-15_10h28m42.json"))
    assert float(log.meta["mass"]) == 0.49
    assert np.abs(log.effort).max() < 5.0
    assert log.signals["voltage"].value.mean() == pytest.approx(7.3, abs=0.3)


def write_pair(folder: Path, rows: int = 8) -> tuple[Path, Path]:
    paths = folder / "pos.csv.gz", folder / "curr.csv.gz"
    for k, path in enumerate(paths):
        text = "Joint_1,Joint_2\n" + "".join(f"{i + k},{2 * i - k}\n" for i in range(rows))
        path.write_bytes(gzip.compress(text.encode()))
    return paths


def test_a_motor_pair_keeps_the_power(tmp_path):
    R = np.array([[50.0, 0.0], [30.0, -40.0]])
    log = read_motor_pair(*write_pair(tmp_path), ratio=R, period=1e-3, offset=[0.5, 0.0])
    i = np.arange(8)
    motor = np.column_stack([i, 2 * i])
    torque = np.column_stack([i + 1, 2 * i - 1])
    np.testing.assert_allclose((log.position - [0.5, 0.0]) @ R.T, motor)
    np.testing.assert_allclose(
        np.sum(log.effort * np.linalg.solve(R, motor.T).T, 1), np.sum(torque * motor, 1)
    )


def test_a_motor_pair_complains(tmp_path):
    a, b = write_pair(tmp_path)
    with pytest.raises(InputError, match="regular"):
        read_motor_pair(a, b, ratio=np.zeros((2, 2)), period=1e-3)
    short = tmp_path / "short.csv"
    short.write_text("Joint_1,Joint_2\n1,2\n")
    with pytest.raises(LogError, match="same rows"):
        read_motor_pair(a, short, ratio=np.eye(2), period=1e-3)
    broken = tmp_path / "broken.csv"
    broken.write_text(gzip.decompress(b.read_bytes()).decode().replace("3,3", "1e250,3"))
    log = read_motor_pair(a, broken, ratio=np.eye(2), period=1e-3)
    assert len(log) == 7
    assert sum(log.repair.dropped.values()) == 1


def test_bam_complains(tmp_path):
    path = tmp_path / "x.json"
    for text in ("", "[1]", '{"entries": []}', "{", '{"entries": [1, 2]}'):
        path.write_text(text)
        with pytest.raises(LogError):
            read_bam(path)
    entry = {
        "timestamp": 0.0,
        "position": 0.1,
        "speed": 0.0,
        "load": 65535,
        "input_volts": 7.0,
        "goal_position": 0.0,
        "torque_enable": True,
        "temp": 30,
    }
    path.write_text(json.dumps({"mass": 0.1, "entries": [entry, entry | {"position": 1e250}, {"x": 1}]}))
    log = read_bam(path)
    assert len(log) == 1
    assert log.effort[0, 0] == pytest.approx(-1e-3)
    assert sum(log.repair.dropped.values()) == 2
