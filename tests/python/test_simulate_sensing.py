"""The sensor model's statistics, its faults, its seed; and the scenarios."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from palpate import robots
from palpate.arm import Arm, Effort, Sensing
from palpate.errors import InputError
from palpate.simulate import (
    Attach,
    Fault,
    Load,
    Plant,
    Push,
    Release,
    Schedule,
    SensorModel,
    StopPushing,
    pick_and_place,
)

ARM = robots.load("justina_left_arm")
COUNT = 2.0 * np.pi / 4096
N = 4000


def sensed(**sensing: float) -> Arm:
    return ARM.replace(joints=tuple(j.replace(sensing=Sensing(**sensing)) for j in ARM.joints))


def readings(sensor: SensorModel, q: Any, count: int = N, dq: Any = None, torque: Any = None) -> list[Any]:
    dq = np.zeros(7) if dq is None else dq
    torque = np.zeros(7) if torque is None else torque
    return [sensor.read(k * sensor.period_ns, q, dq, torque) for k in range(count)]


def positions(sensor: SensorModel, q: Any, count: int = N) -> np.ndarray:
    return np.array([s.position for s in readings(sensor, q, count)])


class TestPosition:
    def test_the_encoder_has_twelve_bits(self) -> None:
        assert ARM.joints[0].sensing.position_resolution == pytest.approx(COUNT, rel=1e-12)

    def test_rounding_alone(self) -> None:
        sensor = SensorModel(ARM, noise_counts=0)
        q = np.random.default_rng(0).uniform(-3, 3, (500, 7))
        read = np.array([sensor.read(0, row, row, row).position for row in q])  # type: ignore[union-attr]
        error = (read - q) / COUNT
        assert np.abs(error).max() <= 0.5 + 1e-9
        # uniform within half a count
        assert error.std() == pytest.approx(np.sqrt(1 / 12), rel=0.03)
        np.testing.assert_allclose(read / COUNT, np.rint(read / COUNT), atol=1e-9)

    def test_bench_noise_is_whole_counts_after_the_rounding(self) -> None:
        read = positions(SensorModel(ARM, noise_counts=2, seed=1), np.full(7, 0.3))
        counts = read / COUNT - np.rint(0.3 / COUNT)
        np.testing.assert_allclose(counts, np.rint(counts), atol=1e-9)
        values, how_often = np.unique(np.rint(counts), return_counts=True)
        assert values.tolist() == [-2, -1, 0, 1, 2]
        np.testing.assert_allclose(how_often / counts.size, 0.2, atol=0.01)
        # samples and joints are independent
        r = np.corrcoef(counts.T)
        assert np.abs(r - np.eye(7)).max() < 0.06
        assert abs(np.corrcoef(counts[1:, 0], counts[:-1, 0])[0, 1]) < 0.06

    def test_noise_before_the_rounding(self) -> None:
        q = (100 + 0.25) * COUNT
        sensor = SensorModel(ARM, noise_counts=2, noise_before_rounding=True, seed=1)
        counts = positions(sensor, np.full(7, q)) / COUNT - 100
        values, how_often = np.unique(np.rint(counts), return_counts=True)
        np.testing.assert_allclose(counts, np.rint(counts), atol=1e-9)
        # 0.25 + U(-2, 2): the outermost counts get what lies beyond +-1.5
        assert values.tolist() == [-2, -1, 0, 1, 2]
        np.testing.assert_allclose(how_often / counts.size, [0.0625, 0.25, 0.25, 0.25, 0.1875], atol=0.01)
        assert counts.mean() == pytest.approx(0.25, abs=0.02)

    def test_gaussian_noise_of_the_card_by_default(self) -> None:
        arm = sensed(position_std=0.01)
        read = positions(SensorModel(arm, seed=2), np.zeros(7))
        assert read.std() == pytest.approx(0.01, rel=0.02) and abs(read.mean()) < 3e-4
        assert not positions(SensorModel(ARM.replace(joints=sensed().joints)), np.full(7, 0.123)).std() > 0
        # counts replace it
        assert not positions(SensorModel(ARM, noise_counts=0), np.zeros(7)).any()

    def test_joints_with_and_without_resolution(self) -> None:
        joints = list(sensed().joints)
        joints[2] = joints[2].replace(sensing=Sensing(position_resolution=0.5))
        q = np.full(7, 0.3)
        read = positions(SensorModel(ARM.replace(joints=tuple(joints))), q, 1)[0]
        assert read.tolist() == [0.3, 0.3, 0.5, 0.3, 0.3, 0.3, 0.3]
        with pytest.raises(InputError, match="'la_1_joint' has none"):
            SensorModel(ARM.replace(joints=tuple(joints)), noise_counts=2)

    def test_the_truth_is_not_touched(self) -> None:
        q, dq, torque = np.full(7, 0.3), np.full(7, 0.1), np.full(7, 0.2)
        faults = [Fault("nan", 0.0)]
        sample = SensorModel(ARM, noise_counts=2, velocity=True, faults=faults).read(0, q, dq, torque)
        assert sample is not None and np.isnan(sample.position).all()
        assert np.all(q == 0.3) and np.all(dq == 0.1) and np.all(torque == 0.2)


class TestVelocity:
    def test_only_if_measured(self) -> None:
        assert readings(SensorModel(ARM), np.zeros(7), 1)[0].velocity is None
        exact = readings(SensorModel(ARM, velocity=True), np.zeros(7), 1, dq=np.full(7, 0.7))[0]
        assert exact.velocity.tolist() == [0.7] * 7

    def test_noise_of_the_card(self) -> None:
        arm = sensed(velocity_std=0.05)
        speeds = np.array([s.velocity for s in readings(SensorModel(arm), np.zeros(7), dq=np.ones(7))])
        assert speeds.mean() == pytest.approx(1.0, abs=2e-3) and speeds.std() == pytest.approx(0.05, rel=0.02)
        assert readings(SensorModel(arm, velocity=False), np.zeros(7), 1)[0].velocity is None

    def test_one_joint_without_is_none_measured(self) -> None:
        joints = (*sensed(velocity_std=0.05).joints[:6], ARM.joints[6])
        assert readings(SensorModel(ARM.replace(joints=joints)), np.zeros(7), 1)[0].velocity is None


class TestTorque:
    def test_steps_and_limits(self) -> None:
        sensor = SensorModel(ARM)
        step = np.array([j.sensing.torque_resolution for j in ARM.joints])
        asked = np.random.default_rng(0).uniform(-4, 4, (1000, 7))
        sent = np.array([sensor.drive(row) for row in asked])
        np.testing.assert_allclose(sent / step, np.rint(sent / step), atol=1e-9)
        inside = np.abs(asked) < 2.49
        assert np.abs(sent - asked)[inside].max() <= 0.5 * step.max() + 1e-12
        error = ((sent - asked) / step)[inside]
        assert error.std() == pytest.approx(np.sqrt(1 / 12), rel=0.03) and abs(error.mean()) < 0.02
        assert np.all(np.abs(sent) <= 2.5) and np.all(np.abs(sent) <= sensor.torque_limit)
        assert np.all(sensor.torque_limit > 2.5 - step)

    def test_a_limit_that_is_a_whole_number_of_steps_is_reached(self) -> None:
        joints = tuple(
            j.replace(sensing=Sensing(torque_resolution=0.1)) for j in ARM.joints
        )  # 2.5 N m is 25 steps
        sensor = SensorModel(ARM.replace(joints=joints))
        np.testing.assert_allclose(sensor.drive(np.full(7, 9.0)), 2.5)

    def test_without_steps_the_torque_is_left_alone(self) -> None:
        asked = np.linspace(-2, 2, 7)
        assert np.array_equal(SensorModel(sensed()).drive(asked), asked)

    def test_absurd_commands_stay_finite(self) -> None:
        arm = robots.load("abb_irb2400_16")
        assert np.isinf(arm.joints[0].limits.effort)
        joints = tuple(j.replace(sensing=Sensing(torque_resolution=1e-3)) for j in arm.joints)
        for some in (arm, arm.replace(joints=joints)):
            sent = SensorModel(some).drive(np.full(6, 1.7e308))
            np.testing.assert_allclose(sent, 1e9)

    def test_reported_noise_and_unit(self) -> None:
        torque = np.full(7, 1.5)
        told = np.array(
            [s.effort for s in readings(SensorModel(sensed(torque_std=0.2)), np.zeros(7), torque=torque)]
        )
        assert told.mean() == pytest.approx(1.5, abs=0.01) and told.std() == pytest.approx(0.2, rel=0.02)
        ampere = sensed().replace(effort=Effort.current(k_t=0.05, gear=100.0))
        current = readings(SensorModel(ampere), np.zeros(7), 1, torque=torque)[0].effort
        np.testing.assert_allclose(current, 0.3, rtol=1e-15)


class TestClock:
    def test_rate(self) -> None:
        assert SensorModel(ARM).period_ns == 4_000_000
        assert SensorModel(ARM, rate=1000).period_ns == 1_000_000
        assert SensorModel(ARM, rate=30).period_ns == 33_333_333

    def test_jitter(self) -> None:
        sensor = SensorModel(ARM, jitter=1.9e-3, seed=4)
        stamps = np.array([s.time_ns for s in readings(sensor, np.zeros(7))])
        off = (stamps - np.arange(N) * 4_000_000) * 1e-9
        assert np.abs(off).max() <= 1.9e-3
        assert off.std() == pytest.approx(1.9e-3 / np.sqrt(3), rel=0.03) and abs(off.mean()) < 1e-4
        assert np.all(np.diff(stamps) > 0)

    def test_loss(self) -> None:
        lost = [s is None for s in readings(SensorModel(ARM, loss=0.1, seed=5), np.zeros(7))]
        # 4000 draws: standard deviation 0.0047
        assert np.mean(lost) == pytest.approx(0.1, abs=0.02)
        assert all(s is None for s in readings(SensorModel(ARM, loss=1.0), np.zeros(7), 50))
        assert not any(s is None for s in readings(SensorModel(ARM, loss=0.0), np.zeros(7), 50))

    def test_latency(self) -> None:
        sensor = SensorModel(sensed(), latency=3)
        got = [sensor.read(k, np.full(7, float(k)), np.zeros(7), np.full(7, 10.0 * k)) for k in range(6)]
        assert got[:3] == [None, None, None]
        assert [s.time_ns for s in got[3:]] == [0, 1, 2]  # type: ignore[union-attr]
        assert [s.position[0] for s in got[3:]] == [0.0, 1.0, 2.0]  # type: ignore[union-attr]
        assert [s.effort[0] for s in got[3:]] == [0.0, 10.0, 20.0]  # type: ignore[union-attr]

    def test_same_seed_same_run(self) -> None:
        options: dict[str, Any] = {
            "noise_counts": 2,
            "jitter": 1e-3,
            "loss": 0.05,
            "velocity": True,
            "latency": 1,
        }

        def run(sensor: SensorModel) -> list[Any]:
            return [
                None if s is None else (s.time_ns, s.position.tolist(), s.velocity.tolist())
                for s in readings(sensor, np.full(7, 0.3), 200)
            ]

        sensor = SensorModel(ARM, seed=9, **options)
        first = run(sensor)
        sensor.reset()
        assert run(sensor) == first
        assert run(SensorModel(ARM, seed=9, **options)) == first
        assert run(SensorModel(ARM, seed=10, **options)) != first


class TestFaults:
    @staticmethod
    def run(*faults: Fault, **options: Any) -> list[Any]:
        sensor = SensorModel(sensed(), faults=faults, **options)
        return [
            sensor.read(k * 4_000_000, np.full(7, float(k)), np.zeros(7), np.full(7, 1.0)) for k in range(6)
        ]

    def test_nan_and_huge(self) -> None:
        for kind, value in (("nan", np.nan), ("huge", 1e300)):
            run = self.run(Fault(kind, 0.008, 0.016, joint=2))  # type: ignore[arg-type]
            for k, sample in enumerate(run):
                expected = np.full(7, float(k))
                effort = np.ones(7)
                if k in (2, 3):
                    expected[2] = effort[2] = value
                assert np.array_equal(sample.position, expected, equal_nan=True)
                assert np.array_equal(sample.effort, effort, equal_nan=True)

    def test_stuck(self) -> None:
        run = self.run(Fault("stuck", 0.008, 0.016, joint=2))
        assert [s.position[2] for s in run] == [0, 1, 2, 2, 4, 5]
        assert [s.position[3] for s in run] == [0, 1, 2, 3, 4, 5]
        assert [s.position[0] for s in self.run(Fault("stuck", 0.004))] == [0, 1, 1, 1, 1, 1]

    def test_backwards_and_lost(self) -> None:
        run = self.run(Fault("backwards", 0.008, 0.012), Fault("lost", 0.016, 0.02))
        assert [None if s is None else s.time_ns for s in run] == [
            0,
            4_000_000,
            -2_000_000,
            12_000_000,
            None,
            20_000_000,
        ]

    def test_nothing_sticks_after_reset(self) -> None:
        sensor = SensorModel(sensed(), faults=[Fault("stuck", 0.0)])
        sensor.read(0, np.full(7, 5.0), np.zeros(7), np.zeros(7))
        sensor.reset()
        sample = sensor.read(0, np.full(7, 6.0), np.zeros(7), np.zeros(7))
        assert sample is not None and sample.position[0] == 6.0


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"rate": 0}, "rate"),
        ({"rate": np.nan}, "rate"),
        ({"noise_counts": -1}, "noise_counts"),
        ({"noise_counts": 1.5}, "noise_counts"),
        ({"noise_before_rounding": True}, "noise_counts"),
        ({"jitter": -1e-3}, "jitter"),
        ({"jitter": 2e-3}, "jitter"),
        ({"loss": 1.1}, "loss"),
        ({"loss": np.nan}, "loss"),
        ({"latency": -1}, "latency"),
        ({"faults": [Fault("nan", 0.0, joint=7)]}, "joint"),
    ],
)
def test_wrong_options_are_refused(options: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        SensorModel(ARM, **options)


def test_wrong_faults_are_refused() -> None:
    with pytest.raises(InputError, match="one of nan, huge"):
        Fault("explode", 0.0)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="start before"):
        Fault("nan", 2.0, 1.0)


class TestScenarios:
    def test_events_come_in_order(self) -> None:
        schedule = Schedule([Release(2.0), Attach(1.0, 0.3), Push(1.0, 3, force=(1, 0, 0)), StopPushing(3.0)])
        assert [type(e).__name__ for e in schedule] == ["Attach", "Push", "Release", "StopPushing"]
        assert len(schedule) == 4
        assert [t for t, _ in schedule.between(0, 2_000_000_000)] == [1_000_000_000] * 2 + [2_000_000_000]
        assert schedule.between(2_000_000_000, 2_999_999_999) == []
        assert [schedule.mass_at(t) for t in (0.0, 0.999, 1.0, 1.999, 2.0, 9.0)] == [0, 0, 0.3, 0.3, 0, 0]

    def test_they_act_on_the_plant(self) -> None:
        plant = Plant(ARM)
        plant.reset(np.full(7, 0.3))
        load = Load(0.5, com=(0.0, 0.0, 0.01))
        for event in Schedule([Attach(0.0, load), Push(1.0, 2, force=(0, 3, 0), point=(0.1, 0, 0))]):
            event.apply(plant)
        assert plant.load is load
        with_push = plant.truth().external
        StopPushing(0.0, 2).apply(plant)
        assert not np.allclose(plant.truth().external, with_push)
        Release(0.0).apply(plant)
        assert plant.load is None and not plant.truth().external.any()

    def test_pick_and_place(self) -> None:
        schedule = pick_and_place(0.25, pick=1.0, place=3.0, repeat=3, pause=0.5)
        assert [e.time for e in schedule] == [1.0, 3.0, 3.5, 5.5, 6.0, 8.0]
        assert [schedule.mass_at(t) for t in (0.5, 2.0, 3.2, 4.0, 5.7, 7.0, 8.5)] == [
            0,
            0.25,
            0,
            0.25,
            0,
            0.25,
            0,
        ]

    @pytest.mark.parametrize(
        "wrong",
        [
            lambda: Schedule([Release(-1.0)]),
            lambda: Schedule([Release(float("nan")), Release(0.0)]),
            lambda: Attach(1.0, 0.0),
            lambda: pick_and_place(0.1, pick=2.0, place=1.0),
            lambda: pick_and_place(0.1, pick=-1.0, place=1.0),
            lambda: pick_and_place(0.1, pick=1.0, place=2.0, repeat=0),
            lambda: pick_and_place(0.1, pick=1.0, place=2.0, repeat=2, pause=0.0),
        ],
    )
    def test_nonsense_is_refused(self, wrong: Any) -> None:
        with pytest.raises(InputError):
            wrong()
