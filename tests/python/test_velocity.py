"""The sender's clock and joint velocity in Python, on the real iiwa logs; their laws are proved in core/tests."""

from __future__ import annotations

import numpy as np
import pytest

import palpate as pp
from palpate.errors import InputError
from palpate.studies import _iiwa_logs
from recordings import recording


@pytest.fixture(scope="module", params=_iiwa_logs.NAMES)
def log(request):
    recording("iiwa_whiteboard_logs", "README.md")
    return _iiwa_logs.load(request.param)


def test_finds_the_senders_period_in_a_real_log(log):
    stamps = pp.SenderClock(7).run(log.time_ns, log.position)
    ok = stamps.status == int(pp.Status.ok)
    assert ok.any()
    assert stamps.period[-1] == pytest.approx(0.005, rel=0.002)
    moving = ok & (np.abs(np.gradient(log.position[:, 1]) / log.period) > _iiwa_logs.MOVING)
    assert set(stamps.cycles[moving]) <= {1, 2, 3}
    assert np.mean(stamps.cycles[moving]) == pytest.approx(log.period / 0.005, rel=0.02)


def test_the_noise_of_a_real_log_goes_without_lag(log):
    plain, _ = pp.JointVelocity(7, clock="reader").run(log.time_ns, log.position)
    mended, status = pp.JointVelocity(7).run(log.time_ns, log.position)
    first = int(np.argmax(status == int(pp.Status.ok)))
    assert _iiwa_logs.noise(plain[:, 1], first).std() > 0.04
    assert _iiwa_logs.noise(mended[:, 1], first).std() <= 0.003
    time = (log.time_ns - log.time_ns[0]) * 1e-9
    assert abs(_iiwa_logs.added_lag(time, mended[:, 1], plain[:, 1], first)) < 0.001


def test_refuses_the_garbage_of_a_real_log(log):
    plain, _ = pp.JointVelocity(7, clock="reader").run(log.time_ns, log.position)
    mended, status = pp.JointVelocity(7).run(log.time_ns, log.position)
    assert np.abs(mended).max() < 1.0
    if log.real:
        assert log.real in (134, 135, 136)
        assert np.abs(plain).max() > 100.0
        assert not mended[: log.real + 1].any()
        assert status[log.real] == int(pp.Status.gap)
        assert (status[: log.real] == int(pp.Status.warming)).all()


def test_step_is_run(log):
    clock, whole = pp.SenderClock(7), pp.SenderClock(7).run(log.time_ns, log.position)
    velocity, rows = pp.JointVelocity(7), pp.JointVelocity(7).run(log.time_ns, log.position)
    for i in range(400):
        stamp = clock.step(log.time_ns[i], log.position[i])
        assert stamp == (
            whole.time_ns[i],
            whole.cycles[i],
            whole.interval[i],
            whole.fresh[i],
            whole.status[i],
        )
        v, status = velocity.step(log.time_ns[i], log.position[i])
        assert status == rows[1][i]
        np.testing.assert_array_equal(v, rows[0][i])


def test_normality_tells_two_groups_from_noise():
    rng = np.random.default_rng(0)
    assert _iiwa_logs.normality(rng.normal(size=2000))[2] > 0.01
    groups = np.where(rng.random(2000) < 0.6, 1.0, -1.5) + 0.05 * rng.normal(size=2000)
    assert _iiwa_logs.normality(groups)[2] < 1e-6


def test_lag_is_found():
    t = np.arange(2000) * 0.008
    v = np.sin(0.9 * t) + 0.3 * np.sin(2.3 * t)
    late = np.interp(t - 0.02, t, v)
    assert _iiwa_logs.added_lag(t, late, v, 20) == pytest.approx(0.02, abs=5e-4)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: pp.SenderClock(0), "SenderClock n = 0: expected an integer from 1 to 16"),
        (lambda: pp.SenderClock(7, period=-1.0), "period [s] = -1: expected a finite number >= 0"),
        (lambda: pp.JointVelocity(7, clock="mine"), "clock 'mine'; choose from sender, reader"),
        (lambda: pp.JointVelocity(7, average=0), "window [samples] = 0: expected an integer from 1 to 64"),
        (lambda: pp.JointVelocity(7).step(0, [1.0]), "position: expected 7 numbers [rad], got shape (1,)"),
        (lambda: pp.JointVelocity(7).run([0, 1], np.zeros((3, 7))), "got shapes (2,) and (3, 7)"),
    ],
)
def test_wrong_input_is_one_line(make, message):
    with pytest.raises(InputError) as caught:
        make()
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
