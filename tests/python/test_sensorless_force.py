"""The sensorless-force study: its simulator, its instruments, and identification through a parallelogram."""

from __future__ import annotations

import numpy as np
import pytest

from palpate import Effort, InputError
from palpate.identify import FrictionModel, fit, prepare
from palpate.identify.friction import remembered_sign
from palpate.logs import Log
from palpate.simulate import irb2400
from palpate.simulate.irb2400 import B
from palpate.studies import _irb2400, _irb2400_force, _pulley_rig
from palpate.studies._geared_arm import RATE, Run, simulate

pytest.importorskip("scipy", reason="palpate[identify] is not installed")


@pytest.fixture(scope="module")
def arm():
    return irb2400.truth_arm()


@pytest.fixture(scope="module")
def drives(arm):
    return irb2400.truth_drives(arm)


@pytest.fixture(scope="module")
def motions(arm, drives):
    """A Fourier motion, and a pushed one."""
    return simulate(
        [
            Run(arm, drives, _irb2400.excitation(1, 16.0, 0.3), 16.0),
            Run(arm, drives, _irb2400.there_and_back, 8.0, _irb2400.pushes(0)),
        ]
    )


def as_log(arm, motion):
    """Its true positions and motor torques."""
    return Log(
        time_ns=np.rint(motion.time * 1e9).astype(np.int64),
        position=motion.q,
        effort=motion.torque,
        joint_names=arm.joint_names,
    )


# --- the simulator ----------------------------------------------------------------------------------------------------


def test_the_simulation_keeps_the_equation_of_motion(arm, drives, motions):
    """M ddq + C dq + g + B'(I B ddq + f) = B' tau + J' F, with the acceleration that the velocities show."""
    for motion in motions:
        ddq = np.gradient(motion.dq, 1.0 / RATE, axis=0)
        rigid = arm.inverse_dynamics(motion.q, motion.dq, ddq)
        needed = rigid + (ddq @ B.T * drives.inertia + motion.friction - motion.torque) @ B
        external = np.einsum("nij,ni->nj", arm.jacobian(motion.q, np.zeros(3)), motion.wrench)
        error = (needed - external)[100:-10]
        assert np.sqrt(np.mean(np.square(error))) < 1.0 and np.abs(external).max() < 400.0


def test_the_robot_follows_and_friction_stays_within_its_bounds(drives, motions):
    reference = _irb2400.excitation(1, 16.0, 0.3)(motions[0].time)
    assert np.abs(motions[0].q - reference).max() < 5e-3
    w = motions[0].dq @ B.T
    bound = (1.0 + irb2400.RIPPLE) * drives.static + drives.viscous * np.abs(w)
    assert np.all(np.abs(motions[0].friction) < 1.1 * bound + 1.0)
    fast = np.abs(w) > 0.1
    assert np.all((motions[0].friction * w)[fast] > 0.0)


def test_several_runs_at_once_are_the_runs_alone(arm, drives):
    held = _irb2400.with_load(arm, 20.0, _irb2400.STATIC_PLACE)
    runs = [Run(arm, drives, _irb2400.there_and_back, 0.3), Run(held, drives, _irb2400.there_and_back, 0.2)]
    for together, run in zip(simulate(runs), runs, strict=True):
        (alone,) = simulate([run])
        np.testing.assert_allclose(together.torque, alone.torque, rtol=1e-9, atol=1e-9)


def test_a_load_is_a_point_mass(arm):
    q = np.array([[0.3, 0.4, -0.2, 0.5, 0.7, 0.1]])
    place = np.array([0.1, 0.2, 0.3])
    more = _irb2400.with_load(arm, 5.0, place).gravity_torque(q) - arm.gravity_torque(q)
    np.testing.assert_allclose(more[0], -5.0 * arm.jacobian(q, place)[0, :3].T @ arm.gravity, atol=1e-9)


# --- identification at the motors -------------------------------------------------------------------------------------


def test_friction_of_coupled_motors_is_found_at_the_motors(arm, drives, motions):
    log = as_log(arm, motions[0])
    prior = _irb2400.prior_arm(arm, 7)
    options = {"friction": FrictionModel(stribeck=True, memory=True), "cutoff": 6.0, "cross_validate": False}
    found = fit(prior, log, transmission=B, **options)
    motion = motions[0]
    coulomb = np.array([j.friction.coulomb for j in found.arm.joints])
    assert coulomb[:3] == pytest.approx(drives.coulomb[:3], rel=0.08)
    blind = fit(prior, log, **options)
    assert found.residuals.rms[1:3].sum() < 0.7 * blind.residuals.rms[1:3].sum()
    # the same torque, sample by sample and without a filter
    ddq = np.gradient(motion.dq, 1.0 / RATE, axis=0)
    torque, z = found.torque(motion.q, motion.dq, ddq, 1.0 / RATE)
    settled = slice(3000, -1000)
    assert np.sqrt(np.mean(np.square(torque - motion.torque)[settled])) < 4.0
    assert np.abs(z).max() <= 1.0


def test_torque_is_what_the_prediction_filters(arm, motions):
    log = as_log(arm, motions[0])
    found = fit(
        arm.replace(effort=Effort.torque()), log, friction="stribeck", cutoff=6.0, cross_validate=False
    )
    data = prepare(log, cutoff=6.0)
    (s,) = data.segments
    raw = found.torque(s.q, s.dq, s.ddq, 1.0 / s.rate)[0]
    np.testing.assert_allclose(data.reduce(lambda _: raw), found.predict(log).predicted, atol=1e-6)


def test_a_transmission_must_be_one(arm, motions):
    log = as_log(arm, motions[0])
    for bad in (np.eye(5), np.zeros((6, 6)), B * np.nan):
        with pytest.raises(InputError, match=r"invertible \(6, 6\) matrix"):
            fit(arm, log, transmission=bad)
    with pytest.raises(InputError, match="lower triangular"):
        fit(arm, log, transmission=B.T)
    with pytest.raises(InputError, match="stiction must be between 0 and 1"):
        FrictionModel(stiction=2.0)


def test_a_level_is_followed_over_the_same_distance():
    dq = np.r_[np.full(300, 0.1), np.full(300, -0.1), np.zeros(50)][:, None]
    reach = np.array([1e-3])
    z = remembered_sign(dq, 1e-3, reach)
    np.testing.assert_array_equal(remembered_sign(dq, 1e-3, reach, np.ones_like(dq)), z)
    half = remembered_sign(dq, 1e-3, reach, np.full_like(dq, 0.5))
    np.testing.assert_allclose(half[0, 299], 0.5, atol=1e-9)
    np.testing.assert_allclose(half[0, -1], -0.5, atol=1e-9)
    assert half[0, 599, 0] == half[0, -1, 0]  # at rest it stays


# --- the study --------------------------------------------------------------------------------------------------------


def test_glitches_follow_reversals_only():
    speed = np.r_[np.full(100, 0.1), np.zeros(50), np.full(100, 0.1), np.full(100, -0.1)][:, None]
    w = _irb2400.glitches(speed)[:, 0]
    assert np.flatnonzero(w).min() == 250 and np.flatnonzero(w).max() < 250 + round(irb2400.GLITCH * RATE)
    assert 0.0 <= w.min() and w.max() <= 1.0


def test_the_rig_weighs():
    rig = _pulley_rig.Rig(40)
    x = rig.lift(2.0)
    assert x.mass == pytest.approx(2.0, rel=0.01)
    error = {
        name: np.sqrt(np.nanmean((getattr(x, name) - x.true) ** 2))
        for name in ("ours", "amplitude", "printed")
    }
    assert error["ours"] < 0.6 * error["amplitude"] and error["printed"] > 10.0 * error["amplitude"]


def test_the_published_error_is_that_of_friction(arm, drives, motions):
    """30 % of Coulomb and viscous friction through J^-T make what the paper reports, 24.2 N."""
    (motion,) = simulate([Run(arm, drives, _irb2400.there_and_back, _irb2400.SECONDS)])
    error = np.abs(
        _irb2400_force.friction_alone(arm, drives, motion)[round(_irb2400.BEGIN * RATE) :, 2]
    ).mean()
    assert error == pytest.approx(24.2, rel=0.15)
