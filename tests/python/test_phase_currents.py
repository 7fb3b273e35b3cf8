"""Torque from two phase currents: amplitude, sign, calibration, torque constants; through arm and pipeline."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from palpate import (
    ArmError,
    Effort,
    InputError,
    Log,
    MomentumObserver,
    PhaseCurrents,
    Pipeline,
    Status,
    robots,
)
from palpate.identify import calibrate_phases, fit_torque_constants
from palpate.logs import Sample, Signal
from palpate.weigh import weigh_log

DT = 1e-3


def phases(current, theta):
    """i_a, i_b of a q-axis current at an electrical angle."""
    a = -current * np.sin(theta)
    return a, 0.5 * (math.sqrt(3.0) * current * np.cos(theta) - a)


def there_and_back(seconds=8.0):
    """Position and speed of a motor that goes and returns, twice."""
    t = np.arange(0.0, seconds, DT)
    return t, 0.4 * (1.0 - np.cos(4.0 * np.pi * t / seconds))


def times(t):
    return np.rint(np.asarray(t) * 1e9).astype(np.int64)


def swing(turns=400.0, offset=0.7):
    """A motion whose friction changes sign at the reversals: position, true current, electrical angle."""
    t, q = there_and_back()
    dq = np.gradient(q, t)
    current = 1.0 + 0.5 * np.cos(q) + 0.8 * np.tanh(dq / 0.01)
    return t, q, current, turns * q + offset


# --- torque -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("hint", ["angle", "controller", "model"])
def test_torque_and_sign_through_reversals(hint):
    t, q, current, theta = swing()
    current = current - 1.5  # through zero, too
    a, b = phases(current, theta)
    knows = {"pole_pairs": 4, "angle_offset": 0.7} if hint == "angle" else {}
    drive = PhaseCurrents(1, k_t=0.5, gear=100.0, amplitude_std=0.01, model_std=2.0, **knows)
    told = {
        "angle": {"position": q[:, None]},
        "controller": {"controller_current": 3.0 * current[:, None]},
        "model": {"model_torque": 50.0 * current[:, None] + 1.0},
    }[hint]
    found = drive.run(times(t), a[:, None], b[:, None], **told)
    clear = np.abs(current) > 0.05
    right = np.abs(found.torque[:, 0] - 50.0 * current) < 1e-9
    assert right[clear].mean() > (0.98 if hint == "model" else 1.0 - 1e-12)
    assert np.all(found.status[clear] == Status.ok) or hint == "model"
    assert np.all(found.source[:, 0] == {"angle": 0, "controller": 1, "model": 2}[hint])


def test_a_run_in_parts_is_the_whole_run_and_reset_is_new():
    t, _q, current, theta = swing()
    a, b = (x[:, None] for x in phases(current, theta))
    drive = PhaseCurrents(1, k_t=0.5, gear=100.0, model_std=2.0)
    model = 50.0 * current[:, None]
    whole = drive.run(times(t), a, b, model_torque=model)
    drive.reset()
    parts = [
        drive.run(times(t)[s], a[s], b[s], model_torque=model[s]) for s in (slice(0, 777), slice(777, None))
    ]
    for name in ("torque", "sign_probability", "status"):
        np.testing.assert_array_equal(getattr(whole, name), np.concatenate([getattr(p, name) for p in parts]))


def test_a_wave_that_is_no_sine_is_held():
    t, q, current, theta = swing()
    a, b = phases(current, theta)
    w = np.zeros_like(t)
    w[3000:3040] = np.sin(np.pi * np.arange(40) / 40)
    a, b = a + w * (b - a), b + w * (a - b)
    told = PhaseCurrents(
        1, k_t=1.0, gear=100.0, pole_pairs=4, angle_offset=0.7, amplitude_std=0.01, current_rate=20.0
    )
    found = told.run(times(t), a[:, None], b[:, None], position=q[:, None])
    held = found.status[:, 0] == Status.held
    assert (
        20 < held.sum() < 90 and np.all(np.flatnonzero(held) > 2999) and np.all(np.flatnonzero(held) < 3070)
    )
    assert np.abs(found.current[:, 0] - current).max() < 0.25
    amplitude = PhaseCurrents(1, k_t=1.0).run(
        times(t), a[:, None], b[:, None], controller_current=current[:, None]
    )
    assert np.abs(amplitude.current[:, 0] - current).max() > 0.25


def test_bad_numbers_are_a_status_and_bad_shapes_an_error():
    drive = PhaseCurrents(2, k_t=[0.5, 0.6])
    found = drive.run(
        [0, 1], [[1.0, np.nan], [1.0, 1.0]], np.ones((2, 2)), controller_current=np.ones((2, 2))
    )
    assert found.status[0].tolist() == [Status.ok, Status.non_finite] and found.torque[0, 1] == 0.0
    for bad, message in (
        (
            lambda: drive.run([0], np.ones((1, 3)), np.ones((1, 2))),
            r"phase_a: expected shape \(1, 2\), got \(1, 3\)",
        ),
        (lambda: PhaseCurrents(2, k_t=0.0), "torque_constant"),
        (lambda: PhaseCurrents(2, k_t=[1.0, 1.0, 1.0]), "PhaseCurrents"),
        (lambda: PhaseCurrents(1, k_t=1.0, settle_time=-1.0), "settle_time"),
    ):
        with pytest.raises(InputError, match=message):
            bad()


# --- calibration ------------------------------------------------------------------------------------------------------


def test_calibration_recovers_amplitude_under_offset_and_gain_mismatch():
    t, q, current, theta = swing()
    a, b = phases(current, theta)
    scores = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        offset, gain = 0.06 * rng.uniform(-1, 1, 2), 1.0 + 0.02 * rng.uniform(-1, 1, 2)
        x = gain[0] * a + offset[0] + 0.015 * rng.standard_normal(len(a))
        y = gain[1] * b + offset[1] + 0.015 * rng.standard_normal(len(a))
        found = calibrate_phases(q, x, y, 400.0)
        ratio = gain[0] / gain[1]
        scores.append(
            [
                (found.offset[0] - offset[0]) / found.offset_std[0],
                (found.offset[1] - offset[1]) / found.offset_std[1],
                (found.gain[1] / found.gain[0] - ratio) / found.gain_ratio_std,
                math.remainder(found.angle_offset - 0.7, 2.0 * math.pi) / found.angle_std,
            ]
        )
        drive = PhaseCurrents(
            1, k_t=1.0, gear=100.0, pole_pairs=4, angle_offset=found.angle_offset, offset=[found.offset],
            gain=[found.gain], amplitude_std=0.03,
        )  # fmt: skip
        torque = drive.run(times(t), x[:, None], y[:, None], position=q[:, None]).current[:, 0]
        common = math.sqrt(gain[0] * gain[1])  # belongs to the torque constant
        assert (
            np.std(torque - common * current) < 0.018
        )  # the noise of the readings, 2/sqrt(3) of it, and nothing more
        assert found.noise == pytest.approx(0.015, rel=0.05)
    assert np.sqrt(np.mean(np.square(scores), axis=0)) == pytest.approx(np.ones(4), abs=0.35)


@pytest.mark.parametrize("offset", [-3.0, -0.1, 1.6, 3.1])
def test_energy_tells_which_half_turn(offset):
    _t, q, current, theta = swing(offset=offset)
    a, b = phases(current, theta)
    found = calibrate_phases(q, a, b, 400.0)
    assert math.remainder(found.angle_offset - offset, 2.0 * math.pi) == pytest.approx(0.0, abs=1e-6)
    assert found.agreement > 0.99


def test_calibration_refuses_what_does_not_fit():
    _t, q, current, theta = swing()
    a, b = phases(current, theta)
    with pytest.raises(InputError, match="do not follow the position at 390 electrical turns"):
        calibrate_phases(q, a, b, 390.0)
    with pytest.raises(InputError, match="do not follow"):
        calibrate_phases(q, a, b, -400.0)
    with pytest.raises(InputError, match="at least two electrical turns"):
        calibrate_phases(0.01 * q, a, b, 400.0)
    with pytest.raises(InputError, match="one shape"):
        calibrate_phases(q[1:], a, b, 400.0)


# --- torque constants -------------------------------------------------------------------------------------------------


def static_poses(seed, n_poses=8, friction=0.3, noise=0.01):
    rng = np.random.default_rng(seed)
    gain = np.array([150.0, 121.0])
    torque = np.repeat(rng.uniform(-300.0, 300.0, (n_poses, 2)), 2, axis=0)
    side = np.tile([[1.0], [-1.0]], (n_poses, 2))
    current = torque / gain + friction * side + noise * rng.standard_normal(torque.shape)
    return gain, torque, current, side


def test_torque_constants_lie_within_their_stated_deviation():
    scores = []
    for seed in range(200):
        gain, torque, current, side = static_poses(seed)
        found = fit_torque_constants(torque, current, side)
        assert found.seen.all()
        scores.append((found.gain - gain) / found.std)
        assert found.friction == pytest.approx([0.3, 0.3], abs=0.02)
    assert np.mean(scores) == pytest.approx(0.0, abs=0.2)
    assert np.std(scores) == pytest.approx(1.08, abs=0.15)  # Student's t with 13 degrees of freedom


def test_friction_does_not_reach_the_torque_constant():
    _gain, torque, current, side = static_poses(1, friction=0.0)
    without = fit_torque_constants(torque, current, side)
    with_friction = fit_torque_constants(torque, current + 5.0 * side, side)
    np.testing.assert_allclose(with_friction.gain, without.gain, rtol=1e-9)


def test_a_joint_that_bears_no_weight_is_not_seen():
    _, torque, current, side = static_poses(0)
    torque[:, 0] = 0.0
    found = fit_torque_constants(torque, current, side)
    assert found.seen.tolist() == [False, True]
    assert math.isnan(found.gain[0]) and math.isinf(found.std[0])


def test_torque_constants_refuse_one_sided_poses():
    _, torque, current, side = static_poses(0)
    with pytest.raises(InputError, match="joint 0 was approached from one side only"):
        fit_torque_constants(torque, current, np.abs(side))
    with pytest.raises(InputError, match="at least 4 poses"):
        fit_torque_constants(torque[:2], current[:2], side[:2])
    with pytest.raises(InputError, match="one shape"):
        fit_torque_constants(torque[:, :1], current, side)
    with pytest.raises(InputError, match="finite"):
        fit_torque_constants(torque * np.nan, current, side)


# --- through arm and pipeline -----------------------------------------------------------------------------------------


@pytest.fixture
def arm():
    base = robots.load("katana_450_6m90a")
    return base.replace(effort=Effort.phase_currents(0.5, 100.0, 4, [0.1 * k for k in range(base.n)]))


def recorded(arm):
    """A slow motion, its torque, and a log that holds phase currents only."""
    t = np.arange(0.0, 1.0, 4e-3)
    q = 0.3 * np.sin(2.0 * np.pi * np.outer(t, 0.3 + 0.1 * np.arange(arm.n)))
    torque = arm.gravity_torque(q) + 0.5
    a, b = phases(torque / 50.0, 400.0 * q + np.array(arm.effort.angle_offset))
    signals = {name: Signal(times(t), x, "A") for name, x in (("phase_a", a), ("phase_b", b))}
    log = Log(
        time_ns=times(t),
        position=q,
        effort=np.full_like(q, np.nan),
        joint_names=arm.joint_names,
        signals=signals,
    )
    return torque, log


def test_a_log_of_phase_currents_goes_through_the_pipeline(arm):
    torque, log = recorded(arm)
    converted = PhaseCurrents.of(arm).convert(log)
    np.testing.assert_allclose(converted.effort, torque, atol=1e-9)
    assert converted.meta["effort_unit"] == "N m"
    plain = Pipeline(arm.replace(effort=Effort.torque()), observer=MomentumObserver(), payload=None)
    expected = plain.run(dataclasses.replace(log, effort=converted.effort))
    pipeline = Pipeline(arm, observer=MomentumObserver(), payload=None)
    np.testing.assert_array_equal(pipeline.run(log).external.torque, expected.external.torque)
    pipeline.reset()
    readings = np.stack([log.signals["phase_a"].value, log.signals["phase_b"].value], axis=2)
    live = [
        pipeline.step(Sample(int(ns), q, None, i))
        for ns, q, i in zip(log.time_ns, log.position, readings, strict=True)
    ]
    np.testing.assert_array_equal([x.external.torque for x in live], expected.external.torque)


def test_weighing_takes_phase_currents(arm):
    _, log = recorded(arm)
    found = weigh_log(log, arm)
    plain = weigh_log(PhaseCurrents.of(arm).convert(log), arm.replace(effort=Effort.torque()))
    assert found.mass == plain.mass and found.mass_std == plain.mass_std
    assert any("phase currents" in remark for remark in found.remarks)


def test_the_log_and_sample_must_hold_both_phases(arm):
    _, log = recorded(arm)
    with pytest.raises(InputError, match="no signal 'phase_b'; it has phase_a"):
        Pipeline(arm).run(dataclasses.replace(log, signals={"phase_a": log.signals["phase_a"]}))
    short = Signal(log.time_ns[1:], log.signals["phase_b"].value[1:], "A")
    with pytest.raises(InputError, match="sampled with the log"):
        PhaseCurrents.of(arm).convert(dataclasses.replace(log, signals={**log.signals, "phase_b": short}))
    with pytest.raises(InputError, match="two phases per motor"):
        Pipeline(arm).step(Sample(0, log.position[0], None, np.zeros(arm.n)))
    with pytest.raises(ArmError, match="its effort is torque"):
        PhaseCurrents.of(arm.replace(effort=Effort.torque()))


def test_cards_and_urdfs_keep_the_declaration(arm, tmp_path):
    pytest.importorskip("yaml", reason="palpate[card] is not installed")
    arm.save(tmp_path / "arm.yaml")
    assert type(arm).from_card(tmp_path / "arm.yaml").effort == arm.effort
    assert type(arm).from_urdf(arm.to_urdf()).effort == arm.effort
    np.testing.assert_allclose(arm.effort.gain(arm.n), 50.0)
    for bad, message in (
        (lambda: Effort.phase_currents(0.5, pole_pairs=2.5), "whole numbers"),
        (lambda: Effort.phase_currents(0.0), "other than 0"),
        (lambda: Effort("current", (1.0,), (1.0,), (4.0,)), "has a meaning for kind phase_currents only"),
    ):
        with pytest.raises(ArmError, match=message):
            bad()
