"""Wrench and contact through the Python pipeline: values, shapes, options, one by one against in one go, bad input."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

import palpate as pp
from palpate.logs import Sample

RATE = 500.0


def swing(
    arm: pp.Arm, seconds: float, push: dict[str, object] | None = None, held: float = 0.0, seed: int = 5
) -> pp.Log:
    """A slow swing by the core's own inverse dynamics; `push`: force (3,) [N] at the grasp point from start to stop."""
    t = np.arange(int(seconds * RATE)) / RATE
    w = 0.8 + 0.1 * np.arange(arm.n)
    centre = np.array([0.1, 0.6, 0.0, -1.3, 0.2, 0.7, 0.0])[: arm.n]
    q = centre + 0.3 * np.sin(np.outer(t, w) + np.arange(arm.n))
    dq = 0.3 * w * np.cos(np.outer(t, w) + np.arange(arm.n))
    ddq = -0.3 * w**2 * np.sin(np.outer(t, w) + np.arange(arm.n))
    tau = arm.inverse_dynamics(q, dq, ddq) + arm.friction_torque(dq)
    grasp = arm.grasp
    jacobian = np.stack([arm.jacobian(x, point=grasp) for x in q])
    if held:
        tau -= np.einsum("kij,i->kj", jacobian[:, :3], np.array([0.0, 0.0, -9.81]) * held)
    if push is not None:
        on = (t >= push["start"]) & (t < push["stop"])
        tau[on] -= np.einsum("kij,i->kj", jacobian[on, :3], np.asarray(push["force"]))
    rng = np.random.default_rng(seed)
    return pp.Log(
        time_ns=(t * 1e9).round().astype(np.int64),
        position=q,
        velocity=dq + rng.normal(0.0, 2e-4, q.shape),
        effort=tau + rng.normal(0.0, 0.05, q.shape),
        joint_names=arm.joint_names,
    )


@pytest.fixture(scope="module")
def arm() -> pp.Arm:
    arm = pp.robots.load("kuka_lbr_iiwa14")
    sensing = pp.Sensing(position_std=1e-6, velocity_std=2e-4, torque_std=0.05)
    return arm.replace(
        joints=tuple(
            j.replace(sensing=sensing, friction=pp.Friction(coulomb=0.5, viscous=0.3)) for j in arm.joints
        )
    )


def feeling(arm: pp.Arm, **options: object) -> pp.Pipeline:
    return pp.Pipeline(
        arm,
        observer=pp.DisturbanceKalman(),
        payload=None,
        wrench=pp.WrenchEstimator(),
        contact=pp.ContactDetector(friction_fraction=0.1),
        **options,
    )


FORCE = np.array([15.0, -20.0, 25.0])
PUSH = {"start": 2.0, "stop": 3.0, "force": FORCE}


def test_a_push_is_felt_with_its_force_time_and_place(arm):
    touch = feeling(arm).run(swing(arm, 5.0, PUSH))
    pushed = slice(int(2.3 * RATE), int(2.9 * RATE))
    error = touch.wrench.force[pushed] - FORCE
    assert np.abs(error).max() < 6.0 * touch.wrench.force_std[pushed].max()
    assert np.abs(error.mean(axis=0)).max() < 1.5
    assert np.abs(touch.wrench.force[int(1.0 * RATE) : int(1.9 * RATE)]).max() < 10.0
    covariance = touch.wrench.covariance[pushed][0]
    assert covariance.shape == (6, 6)
    assert np.allclose(np.sqrt(np.diag(covariance))[:3], touch.wrench.force_std[pushed][0], rtol=1e-12)
    assert np.linalg.eigvalsh(covariance).min() > 0.0
    assert not touch.wrench.singular[pushed].any()

    (event,) = touch.contact.events()
    assert abs(event.onset_time_ns * 1e-9 - 2.0) < 0.02
    assert 0.0 < event.alarm_time_ns * 1e-9 - 2.0 < 0.02
    assert event.release_time_ns is not None and abs(event.release_time_ns * 1e-9 - 3.0) < 0.15
    assert event.link >= 3
    assert event.farthest == 6
    assert event.tip
    assert touch.contact.active[int(2.5 * RATE)] and not touch.contact.active[-1]
    assert touch.contact.count[-1] == 1


def test_nothing_is_felt_where_nothing_is(arm):
    touch = feeling(arm).run(swing(arm, 20.0))
    assert touch.contact.count[-1] == 0
    assert touch.contact.events() == []
    assert touch.contact.link.max() == -1
    assert touch.contact.level.max() < 1.0


def test_a_contact_that_lasts_has_no_release(arm):
    touch = feeling(arm).run(swing(arm, 3.0, {"start": 2.0, "stop": 9.0, "force": FORCE}))
    (event,) = touch.contact.events()
    assert event.release_time_ns is None


def test_one_by_one_and_in_one_go_are_the_same_bits(arm):
    log = swing(arm, 3.0, PUSH)
    whole = feeling(arm).run(log)
    live, pieces = feeling(arm), feeling(arm)
    rows = [
        pieces.run(log[0:700]),
        pieces.run(log[700:701]),
        pieces.run(log[701 : len(log)]),
    ]
    for part in ("wrench", "contact"):
        for name in getattr(whole, part).__slots__:
            expected = getattr(getattr(whole, part), name)
            got = np.concatenate([getattr(getattr(r, part), name) for r in rows])
            assert np.array_equal(expected, got, equal_nan=expected.dtype.kind == "f"), name
    for k in range(len(log)):
        touch = live.step(Sample(int(log.time_ns[k]), log.position[k], log.velocity[k], log.effort[k]))
        for part in ("wrench", "contact"):
            for name in getattr(whole, part).__slots__:
                value = getattr(getattr(touch, part), name)
                expected = getattr(getattr(whole, part), name)[k]
                if name == "status":
                    value = int(value.value)
                assert np.array_equal(expected, value), (k, part, name)


def test_off_by_default(arm):
    log = swing(arm, 0.5)
    pipeline = pp.Pipeline(arm, observer=pp.MomentumObserver(), payload=None)
    touch = pipeline.run(log)
    assert touch.wrench is None and touch.contact is None
    touch = pipeline.step(Sample(10**10, log.position[0], log.velocity[0], log.effort[0]))
    assert touch.wrench is None and touch.contact is None


def test_a_known_load_is_taken_away(arm):
    log = swing(arm, 4.0, held=3.0)
    weight = feeling(arm).run(log)
    taken = feeling(arm, load=pp.HeldLoad(mass=3.0)).run(log)
    last = slice(int(2.0 * RATE), None)
    assert abs(weight.wrench.force[last, 2].mean() + 3.0 * 9.81) < 1.5
    # weight alone was simulated: what is left is the inertia of a load that has none, 3 kg at up to 0.5 m/s^2
    assert np.abs(taken.wrench.force[last].mean(axis=0)).max() < 2.0
    assert (taken.wrench.load_mass[last] == 3.0).all()


def test_axes_and_point(arm):
    log = swing(arm, 3.0, PUSH)
    k = int(2.8 * RATE)
    base = feeling(arm).run(log).wrench.force[k]
    pipeline = pp.Pipeline(
        arm, observer=pp.DisturbanceKalman(), payload=None, wrench=pp.WrenchEstimator(axes="tip", point="tip")
    )
    tip = pipeline.run(log).wrench.force[k]
    rotation = arm.forward_kinematics(log.position[k])[:3, :3]
    assert np.allclose(rotation @ tip, base, atol=0.5)


def test_options_make_the_same_pipeline(arm):
    log = swing(arm, 3.0, PUSH)
    first = pp.Pipeline(
        arm,
        observer=pp.DisturbanceKalman(disturbance_rate=30.0),
        payload=None,
        wrench=pp.WrenchEstimator(axes="tip", moment_prior_std=0.0),
        contact=pp.ContactDetector(noise_std=[0.1, 0.2], false_alarms_per_hour=0.1),
        load=pp.HeldLoad(mass=0.5, com=(0.0, 0.0, 0.1)),
    )
    second = pp.Pipeline.from_options(arm, json.loads(json.dumps(first.options())))
    assert second.options() == first.options()
    assert second.contact.noise_std == (0.1, 0.2)
    a, b = first.run(log), second.run(log)
    assert np.array_equal(a.wrench.force, b.wrench.force)
    assert np.array_equal(a.contact.level, b.contact.level)
    assert math.isnan(pp.Pipeline.from_options(arm, pp.Pipeline(arm).options()).load_config.mass)


def test_the_observer_covariance_weighs(arm):
    log = swing(arm, 3.0, PUSH)
    for observer in (pp.MomentumObserver(), pp.DisturbanceKalman(), pp.ExtendedKalman()):
        touch = pp.Pipeline(arm, observer=observer, payload=None, wrench=pp.WrenchEstimator()).run(log)
        k = int(2.8 * RATE)
        assert np.abs(touch.wrench.force[k] - FORCE).max() < 8.0
        assert (touch.wrench.force_std[k] > 0.0).all()


def test_bad_options_are_one_clear_line(arm):
    with pytest.raises(pp.InputError, match="choose an observer"):
        pp.Pipeline(arm, observer=None, wrench=pp.WrenchEstimator())
    with pytest.raises(pp.InputError, match="wrench: expected None or WrenchEstimator"):
        pp.Pipeline(arm, observer=pp.MomentumObserver(), wrench=pp.ContactDetector())
    with pytest.raises(pp.InputError, match="false_alarms_per_hour"):
        pp.Pipeline(arm, contact=pp.ContactDetector(false_alarms_per_hour=0.0))
    with pytest.raises(pp.InputError, match="8 numbers, arm 'kuka_lbr_iiwa14' has 7 joints"):
        pp.Pipeline(arm, contact=pp.ContactDetector(noise_std=[0.1] * 8))
    with pytest.raises(ValueError, match="axes 'hand'; choose from base, tip"):
        pp.WrenchEstimator(axes="hand")
    with pytest.raises(ValueError, match="expected 3 numbers, got 2"):
        pp.HeldLoad(com=(0.0, 1.0))
    with pytest.raises(ValueError, match="unknown option 'rate'"):
        pp.ContactDetector(rate=1.0)


def test_the_noise_of_a_model_is_measured(arm):
    rng = np.random.default_rng(3)
    log = swing(arm, 120.0)
    phi = np.exp(-1.0 / (RATE * 0.4))
    slow = np.zeros((len(log), arm.n))
    for k in range(1, len(log)):
        slow[k] = phi * slow[k - 1] + math.sqrt(1.0 - phi * phi) * 0.8 * rng.normal(size=arm.n)
    noisy = pp.Log(
        time_ns=log.time_ns,
        position=log.position,
        velocity=log.velocity,
        effort=log.effort + slow + rng.normal(0.0, 0.3, slow.shape),
        joint_names=log.joint_names,
    )
    noise = pp.contact_noise(arm, [noisy[0:30000], noisy[30000 : len(log)]])
    assert np.allclose(noise.torque_std, 0.3, rtol=0.2)
    assert np.allclose(noise.model_std, 0.8, rtol=0.35)
    assert 0.2 < noise.model_time < 0.8
    assert noise.velocity_std is not None
    heavy = [0, 1, 3]  # of the light ones the momentum hardly shows the velocity
    assert np.allclose(noise.velocity_std[heavy], 2e-4, rtol=0.5)
    pipeline = pp.Pipeline(
        noise.arm(arm), observer=pp.MomentumObserver(), payload=None, contact=noise.detector()
    )
    assert pipeline.run(noisy).contact.count[-1] == 0


def test_noise_needs_motion(arm):
    with pytest.raises(pp.InputError, match="A1, A2.*fewer than 500 samples"):
        pp.contact_noise(arm, [swing(arm, 0.5)])


def test_friction_that_remembers_and_grows_with_load_is_no_push(arm):
    friction = pp.Friction(coulomb=2.0, viscous=0.3, load=0.05, presliding=1e-3)
    arm = arm.replace(joints=tuple(j.replace(friction=friction) for j in arm.joints))
    log = swing(arm, 20.0)
    # what the log's friction lacks beside the smooth sign and Coulomb's part: memory and load, as the gear feels them
    smooth = arm.friction_torque(log.velocity)
    gear = log.effort - smooth
    z = np.zeros(arm.n)
    extra = np.zeros_like(gear)
    for k in range(1, len(log)):
        step = log.position[k] - log.position[k - 1]
        s = np.sign(step)
        z = s + (z - s) * np.exp(-np.abs(step) / friction.presliding)
        level = friction.coulomb + friction.load * np.abs(gear[k])
        extra[k] = level * z + friction.viscous * log.velocity[k] - smooth[k]
    log = pp.Log(
        time_ns=log.time_ns,
        position=log.position,
        velocity=log.velocity,
        effort=log.effort + extra,
        joint_names=log.joint_names,
    )
    forgetful = arm.replace(
        joints=tuple(j.replace(friction=pp.Friction(coulomb=2.0, viscous=0.3)) for j in arm.joints)
    )
    rms = [
        np.sqrt(np.mean(np.square(feeling(a).run(log).external.torque[500:]), axis=0))
        for a in (arm, forgetful)
    ]
    assert (rms[0] < 0.4).all()  # of noise
    assert rms[1].max() > 1.5
