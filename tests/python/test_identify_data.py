"""Identification on recordings of real robots: figures that must not get worse."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from palpate import Arm, Effort
from palpate.identify import (
    Coupling,
    KnownLoad,
    estimate_load,
    fit,
    fit_bus_drive,
    fit_gains,
    fit_transmission,
    prepare,
)
from palpate.identify.load import LoadProblem
from palpate.identify.regress import Builder
from palpate.logs import ColumnMap, Log, read_bam, read_tx40
from palpate.studies.accuracy import GAIN, MASS, chosen_within, pendulum

pytest.importorskip("scipy", reason="palpate[identify] is not installed")


def data(*parts: str) -> Path:
    folder = Path(os.environ.get("PALPATE_DATA", Path(__file__).parents[2] / ".." / "shared" / "data"))
    path = folder.joinpath(*parts)
    if not path.exists():
        pytest.skip(f"no recorded data in {path} (set PALPATE_DATA)")
    return path


def ur10e_log(name: str) -> Log:
    return Log.open(data("ur10e_innopolis", f"{name}.csv"), ColumnMap.named("ur10e"))


@pytest.fixture(scope="module")
def ur10e():
    arm = Arm.from_urdf(data("ur10e_innopolis", "ur10e.urdf"), tip="tool0", effort=Effort.current(GAIN))
    names = ("31-unload", "10-30sec_12harm", "12-40sec_12harm", "19_14harm50sec")
    months = ("01", "02", "02", "02")
    free = [ur10e_log(f"identification_data/ur-20_{m}_{n}") for m, n in zip(months, names, strict=True)]
    return arm, free, fit(arm, free)


def test_ur10e_predicts_another_kind_of_motion(ur10e):
    _, _, found = ur10e
    log = ur10e_log("validation_data/ur-20_01_17-ptp_10_points")
    p = found.predict(log)
    inside = (p.time >= log.seconds[700]) & (p.time <= log.seconds[4200])
    error = (p.measured - p.predicted)[inside]
    relative = np.linalg.norm(error, axis=0) / np.linalg.norm(p.measured[inside], axis=0)
    assert np.all(relative < [0.06, 0.02, 0.02, 0.04, 0.10, 0.28])
    assert np.sqrt(np.mean(np.square(error))) < 0.8
    assert found.base.rank == found.base.structural_rank
    assert found.unseen == ()


def test_ur10e_load(ur10e):
    arm, free, found = ur10e
    for name in ("ur-20_01_31-load", "ur-20_02_19_14harm50secLoad"):
        e = estimate_load(found, ur10e_log(f"identification_data/{name}"))
        assert e.mass == pytest.approx(MASS, rel=0.01)
        assert e.interval[0] < MASS < e.interval[1]
        np.testing.assert_allclose(e.com, [0.034, 0.167, -0.17], atol=0.01)
    part = fit(arm, free[1:])
    false = estimate_load(part, free[0])
    assert abs(false.mass) < 0.03
    assert false.interval[0] < 0.0 < false.interval[1]


def test_ur10e_gains(ur10e):
    arm, free, _ = ur10e
    loaded = ur10e_log("identification_data/ur-20_02_19_14harm50secLoad")
    found = fit_gains(arm, free, loaded, KnownLoad(MASS))
    # nominal constants of the maker; the two halves of the arm weigh the same load 3 % apart with them
    np.testing.assert_allclose(found.gain, GAIN, rtol=0.08)
    np.testing.assert_allclose(found.gain[:3], GAIN[:3], rtol=0.04)


def test_tx40():
    folder = data("staubli_tx40")
    arm = Arm.from_urdf(folder / "tx40_mdh_modified.urdf", repair_inertia=True, effort=Effort.torque())
    log = read_tx40(folder / "pos_read_data.csv.gz", folder / "curr_data.csv.gz")
    coupling = [Coupling((4, 5))]
    third = len(log) * 2 // 3
    whole = fit(arm, log, couplings=coupling)
    assert whole.residuals.relative_overall < 0.05
    assert (
        fit(arm, log[:third], couplings=coupling, validate_on=log[third:]).held_out.relative_overall < 0.115
    )
    simple = fit(arm, log, couplings=coupling, friction="coulomb", method="wls")
    values = {e.name: e.value for e in simple.parameters}
    level = [values[f"{j.name}.coulomb"] for j in arm.joints[:5]]
    np.testing.assert_allclose(level, [7.14, 8.26, 6.34, 2.48, 3.03], rtol=0.05)


def test_kuka():
    folder = data("kuka_lwr4_iit")
    text = (folder / "kuka_lwr4.urdf").read_text()
    text = text.replace('<origin rpy="0 0 0" xyz="-0.25 0 1"/>\n', "", 1)
    arm = Arm.from_urdf(text, repair_inertia=True, effort=Effort.torque())
    logs = [Log.open(folder / f"measurements_{k}.npz", ColumnMap.named("kuka_lwr4")) for k in (1, 2)]
    held = fit(arm, logs[0], friction="coulomb", method="irls", validate_on=logs[1]).held_out
    assert held.relative_overall < 0.02
    # joint 7's sensor shows torque that goes with its angle: possible links cannot follow it, a spring can
    assert fit(arm, logs[0], validate_on=logs[1]).held_out.relative_overall < 0.022
    model, prior, chosen, plain = chosen_within(arm, logs[0])
    assert model.springs == (6,)
    assert chosen < plain
    held = fit(arm, logs[0], friction=model, prior=prior, validate_on=logs[1]).held_out
    assert held.relative_overall < 0.02
    assert held.rms[6] < 0.12


def test_kinova():
    folder = data("kinova_gen3_dynamapp")
    gain = [9.13] * 4 + [5.852] * 3
    arm = Arm.from_urdf(folder / "gen3.urdf", repair_inertia=True, effort=Effort.current(gain))
    first, second = (
        Log.open(folder / f"{name}.csv.gz", ColumnMap.named("kinova_gen3"))
        for name in ("opti_traj_testing1", "RunTrajectory1")
    )
    found = fit_transmission(arm, first, reference="torque_sensor", friction="load")
    np.testing.assert_array_equal(found.reverses, [True, False, True, True, False, True, True])
    assert np.all(found.residuals.rms < 0.35)
    rms = found.test(second).rms
    assert rms[5] < 0.5
    assert rms[6] < 0.5
    assert rms[2] < 0.8
    assert rms[3] < 0.9
    alike = fit_transmission(
        arm, first, reference="torque_sensor", friction="coulomb", alike=((0, 1, 2, 3), (4, 5, 6))
    )
    assert np.all(alike.test(second).rms[[3, 5, 6]] < [0.55, 0.5, 0.3])


def test_xl330():
    logs = [read_bam(path) for path in sorted(data("xl330_bam").glob("*.json"))]
    assert len(logs) == 7
    for k in (2, 4):  # the ones that stand long and that move most
        drive = fit_bus_drive(pendulum(0.49), logs[:k] + logs[k + 1 :])
        assert drive.weigh(pendulum(1.0), logs[k]) == pytest.approx(0.49, rel=0.15)


def test_ur10e_load_in_short_windows(ur10e):
    _, _, found = ur10e
    assert np.all(found.drift_std < 0.07)  # friction of four days differs by less than was assumed
    errors, held = [], []
    for name in ("ur-20_01_31-load", "ur-20_02_19_14harm50secLoad"):
        prepared = prepare(ur10e_log(f"identification_data/{name}"), cutoff=found.cutoff)
        problem = LoadProblem(found, Builder(found.start, prepared, prepared.effort * GAIN))
        for start in np.arange(4.0, prepared.time[-1] - 8.0, 2.0):
            e = problem.solve(np.flatnonzero((prepared.time >= start) & (prepared.time < start + 8.0)))
            errors.append(e.mass / MASS - 1.0)
            held.append(e.interval[0] < MASS < e.interval[1])
    assert np.abs(errors).max() < 0.04
    assert 0.85 <= np.mean(held) <= 1.0
