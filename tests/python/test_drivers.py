"""The driver contract: both drivers obey the laws, and what each adds to them."""

from __future__ import annotations

import logging
import time

import numpy as np
import pytest

from palpate import robots
from palpate.arm import Effort
from palpate.drivers import Driver, Pace, Sample
from palpate.drivers.laws import DriverLaws
from palpate.drivers.mujoco import MujocoDriver
from palpate.drivers.replay import ReplayDriver
from palpate.errors import DriverError, InputError
from palpate.logs import Log
from palpate.simulate import Attach, Fault, Load, Plant, Push, Release, Schedule, SensorModel, StopPushing

ARM = robots.load("justina_left_arm")


def make_log(rows: int = 50, n: int = 3, seed: int = 0, effort_nan: bool = False) -> Log:
    rng = np.random.default_rng(seed)
    return Log(
        time_ns=np.arange(rows) * 4_000_000 + 7,
        position=rng.normal(size=(rows, n)),
        velocity=rng.normal(size=(rows, n)),
        effort=np.full((rows, n), np.nan) if effort_nan else rng.normal(size=(rows, n)),
        model_torque=rng.normal(size=(rows, n)),
        joint_names=tuple(f"j{i}" for i in range(n)),
    )


class TestMujocoLaws(DriverLaws):
    def make(self) -> Driver:
        return MujocoDriver(ARM, payload=0.25)


class TestMujocoLawsUnderEveryNuisance(DriverLaws):
    periods = 60

    def make(self) -> Driver:
        return MujocoDriver(
            ARM,
            sensor=SensorModel(ARM, noise_counts=2, velocity=True, jitter=1e-3, seed=3),
            schedule=Schedule([Attach(0.013, 0.2), Push(0.02, "grasp", force=(0, 0, -1)), Release(0.05)]),
            q=np.full(7, 0.2),
        )


class TestMujocoLawsInAmperes(DriverLaws):
    def make(self) -> Driver:
        return MujocoDriver(ARM.replace(effort=Effort.current(k_t=[0.05] * 7, gear=[-100.0] * 7)))


class TestReplayLaws(DriverLaws):
    def make(self) -> Driver:
        return ReplayDriver(make_log(), effort=Effort.current(0.1, 50.0))


class TestShortReplayLaws(DriverLaws):
    periods = 12

    def make(self) -> Driver:
        return ReplayDriver(make_log(rows=10), effort=Effort.torque())


class Broken(Driver):
    """Fails where it is told to."""

    def __init__(self, where: str) -> None:
        super().__init__(("a", "b"), 1_000_000, Effort.torque())
        self.where, self.safe = where, 0

    def _fail(self, where: str) -> None:
        if self.where == where:
            raise DriverError(f"{where}: the cable is out")

    def _connect(self) -> None:
        self._fail("connect")

    def _read(self) -> Sample | None:
        self._fail("read")
        return None

    def _write(self, torque: np.ndarray) -> np.ndarray:
        self._fail("write")
        return torque

    def _enable(self) -> None:
        self._fail("enable")

    def _disable(self) -> None:
        self._fail("stop")
        self.safe += 1

    def _close(self) -> None:
        self._fail("close")


class TestWhenTheArmFails:
    def test_failed_connect_stays_closed(self) -> None:
        driver = Broken("connect")
        with pytest.raises(DriverError, match="cable"):
            driver.connect()
        assert driver.state == "closed"

    @pytest.mark.parametrize("where", ["read", "write", "enable"])
    def test_a_failing_verb_stops_the_drives(self, where: str) -> None:
        driver = Broken(where)
        driver.connect()
        with pytest.raises(DriverError, match="cable"):
            driver.enable()
            driver.write([0, 0])
            driver.read()
        assert driver.state == "connected" and driver.safe == 1

    def test_the_next_write_says_why(self) -> None:
        driver = Broken("write")
        driver.connect()
        driver.enable()
        with pytest.raises(DriverError, match="cable"):
            driver.write([0, 0])
        with pytest.raises(DriverError, match=r"stopped.*cable is out"):
            driver.write([0, 0])

    def test_stop_never_raises_but_logs(self, caplog: pytest.LogCaptureFixture) -> None:
        driver = Broken("stop")
        driver.connect()
        driver.enable()
        with caplog.at_level(logging.ERROR, logger="palpate.drivers.driver"):
            driver.stop()
        assert driver.state == "connected"
        assert "cable is out" in caplog.text

    def test_failing_close_is_reported_and_closed(self) -> None:
        driver = Broken("close")
        driver.connect()
        with pytest.raises(DriverError, match="cable"):
            driver.close()
        assert driver.state == "closed"

    @pytest.mark.parametrize(("names", "period"), [((), 1), (("a",), 0), (("a",), -1)])
    def test_nonsense_is_refused(self, names: tuple[str, ...], period: int) -> None:
        class Odd(Broken):
            def __init__(self) -> None:
                Driver.__init__(self, names, period, Effort.torque())

        with pytest.raises(DriverError):
            Odd()


class TestMujocoDriver:
    def test_first_sample_is_the_start(self) -> None:
        q = np.linspace(-0.3, 0.3, 7)
        with MujocoDriver(ARM, q=q, sensor=SensorModel(ARM, noise_counts=0)) as driver:
            sample = driver.read()
            assert sample is not None and sample.time_ns == 0
            assert (
                np.max(np.abs(sample.position - q)) <= 0.5 * ARM.joints[0].sensing.position_resolution * 1.001
            )
            assert not sample.effort.any()
            second = driver.read()
            assert second is not None and second.time_ns == driver.period_ns == 4_000_000

    def test_effort_is_what_moved_the_arm(self) -> None:
        """A second plant, fed with the samples' effort alone, goes exactly the same way."""
        twin = Plant(ARM)
        rng = np.random.default_rng(0)
        with MujocoDriver(ARM) as driver:
            driver.enable()
            driver.read()
            for _ in range(50):
                driver.write(rng.normal(scale=0.5, size=7))
                sample = driver.read()
                assert sample is not None
                twin.step(sample.effort, driver.period_ns)
                assert np.array_equal(twin.q, driver.plant.q) and np.array_equal(twin.dq, driver.plant.dq)

    def test_commands_are_clamped_and_in_steps(self) -> None:
        with MujocoDriver(ARM) as driver:
            driver.enable()
            step = np.array([j.sensing.torque_resolution for j in ARM.joints])
            sent = driver.write(np.full(7, 1e300))
            assert np.all(sent <= 2.5) and np.all(sent > 2.5 - step)
            np.testing.assert_allclose(driver.write(np.full(7, -1e300)), -sent)
            sent = driver.write(np.linspace(-1, 1, 7))
            np.testing.assert_allclose(sent / step, np.rint(sent / step), atol=1e-9)
            assert np.max(np.abs(sent - np.linspace(-1, 1, 7))) <= 0.5 * step.max() * 1.0001

    def test_refused_command_leaves_zero_torque(self) -> None:
        with MujocoDriver(ARM) as driver:
            driver.enable()
            driver.write(np.ones(7))
            driver.read()
            driver.read()
            assert driver.plant.torque.all()
            with pytest.raises(DriverError, match=r"la_3_joint.*nan"):
                driver.write([0, 0, np.nan, 0, 0, 0, 0])
            driver.read()
            assert not driver.plant.torque.any()

    def test_a_command_holds_until_the_next(self) -> None:
        with MujocoDriver(ARM) as driver:
            driver.enable()
            driver.read()
            sent = driver.write(np.full(7, 0.3))
            for _ in range(3):
                sample = driver.read()
                assert sample is not None and np.array_equal(sample.effort, sent)

    def test_schedule_acts_within_a_period(self) -> None:
        """Grasp at 5 ms, between two samples: as if the plant had been stepped and told by hand."""
        load = Load(0.4, com=(0.02, 0.0, 0.0))
        hand = Plant(ARM)
        tau = np.full(7, 0.2)
        with MujocoDriver(ARM, schedule=Schedule([Attach(0.005, load), Release(0.012)])) as driver:
            driver.enable()
            sent = driver.write(tau)
            for _ in range(5):
                driver.read()
            hand.step(sent, 4_000_000)
            hand.step(sent, 1_000_000)
            hand.attach(load)
            hand.step(sent, 3_000_000)
            hand.step(sent, 4_000_000)
            hand.release()
            hand.step(sent, 4_000_000)
            assert np.array_equal(hand.q, driver.plant.q) and np.array_equal(hand.dq, driver.plant.dq)
            assert driver.plant.time_ns == hand.time_ns == 16_000_000

    def test_payload_and_events_at_zero_hold_from_the_start(self) -> None:
        with MujocoDriver(ARM, payload=0.3) as driver:
            assert driver.plant.truth().payload_mass == 0.3
        schedule = Schedule([Attach(0.0, 0.7), Push(0.0, ARM.tip, force=(1, 0, 0))])
        with MujocoDriver(ARM, payload=0.3, schedule=schedule) as driver:
            assert driver.plant.truth().payload_mass == 0.7
            assert driver.plant.data.xfrc_applied.any()

    def test_a_plant_of_ones_own_is_reset(self) -> None:
        plant = Plant(ARM, timestep=2e-3)
        plant.attach(1.0)
        plant.push(3, force=(5, 0, 0))
        plant.step(np.ones(7), 4_000_000)
        with MujocoDriver(plant, schedule=Schedule([StopPushing(0.0)])) as driver:
            assert driver.plant is plant and plant.time_ns == 0
            assert not plant.truth().external.any() and not plant.q.any() and plant.load is None

    def test_connecting_again_repeats_the_run_to_the_bit(self) -> None:
        driver = MujocoDriver(
            ARM, seed=5, schedule=Schedule([Attach(0.03, 0.2), Push(0.05, 3, force=(0, 2, 0))])
        )
        runs = []
        for _ in range(2):
            with driver:
                driver.enable()
                rows = []
                for k in range(40):
                    sample = driver.read()
                    assert sample is not None
                    rows.append(np.concatenate(([sample.time_ns], sample.position, sample.effort)))
                    driver.write(np.sin(0.1 * k + np.arange(7)))
                runs.append(np.array(rows))
        assert np.array_equal(runs[0], runs[1])
        assert np.ptp(runs[0][:, 1]) > 0.0

    def test_lost_samples_are_none_and_time_goes_on(self) -> None:
        sensor = SensorModel(ARM, faults=[Fault("lost", 0.008, 0.016)])
        with MujocoDriver(ARM, sensor=sensor) as driver:
            times = [None if s is None else s.time_ns // 1_000_000 for s in (driver.read() for _ in range(6))]
        assert times == [0, 4, None, None, 16, 20]

    def test_pace_waits_for_the_wall_clock(self) -> None:
        with MujocoDriver(ARM, pace=1.0) as driver:
            start = time.monotonic()
            for _ in range(26):
                driver.read()
            assert time.monotonic() - start >= 0.099

    def test_current_unit(self) -> None:
        arm = ARM.replace(effort=Effort.current(k_t=0.1, gear=[50, 50, 50, 50, 50, -50, 50]))
        with MujocoDriver(arm) as driver:
            driver.enable()
            driver.read()
            sent = driver.write(np.ones(7))
            sample = driver.read()
            assert sample is not None
            np.testing.assert_allclose(sample.effort, sent / (0.1 * np.array([50, 50, 50, 50, 50, -50, 50])))
            assert driver.effort.kind == "current"

    def test_undeclared_effort_is_told_in_newton_metres(self) -> None:
        assert MujocoDriver(ARM.replace(effort=Effort.undeclared())).effort == Effort.torque()

    def test_seed_and_sensor_exclude_each_other(self) -> None:
        with pytest.raises(DriverError, match="seed"):
            MujocoDriver(ARM, sensor=SensorModel(ARM), seed=1)

    def test_the_sensor_must_fit(self) -> None:
        with pytest.raises(DriverError, match="5 joints"):
            MujocoDriver(ARM, sensor=SensorModel(robots.load("katana_300_6m180")))

    def test_wrong_start_is_an_error(self) -> None:
        with pytest.raises(InputError, match=r"q must have shape \(7,\)"):
            MujocoDriver(ARM, q=[0, 0]).connect()


class TestReplayDriver:
    def test_gives_the_log_back(self) -> None:
        log = make_log()
        with ReplayDriver(log) as driver:
            samples = []
            while not driver.finished:
                samples.append(driver.read())
            for sample, kept in zip(samples, log, strict=True):
                assert sample is not None and sample.time_ns == kept.time_ns
                for name in ("position", "velocity", "effort", "model_torque"):
                    assert np.array_equal(getattr(sample, name), getattr(kept, name))
            with pytest.raises(DriverError, match="ended after 50 samples"):
                driver.read()
        driver.connect()
        assert not driver.finished

    def test_period_is_the_middle_spacing(self) -> None:
        assert ReplayDriver(make_log()).period_ns == 4_000_000
        assert ReplayDriver(make_log(rows=1)).period_ns == 1_000_000

    def test_an_empty_log_is_refused(self) -> None:
        with pytest.raises(DriverError, match="no samples"):
            ReplayDriver(make_log()[:0])

    def test_commanding_needs_to_know_what_effort_is(self) -> None:
        with ReplayDriver(make_log()) as driver:
            driver.enable()
            with pytest.raises(DriverError, match="effort="):
                driver.write([0, 0, 0])

    def test_write_after_the_last_sample_repeats_the_last_torque(self) -> None:
        log = make_log(rows=3)
        with ReplayDriver(log, effort=Effort.torque()) as driver:
            driver.enable()
            sent = [driver.write([0, 0, 0])]
            while not driver.finished:
                driver.read()
                sent.append(driver.write([0, 0, 0]))
        assert np.array_equal(sent, log.effort[[0, 1, 2, 2]])

    def test_pace(self) -> None:
        start = time.monotonic()
        with ReplayDriver(make_log(rows=21), pace=2.0) as driver:
            while not driver.finished:
                driver.read()
        assert time.monotonic() - start >= 0.039


@pytest.mark.parametrize("speed", [0.0, -1.0, float("nan"), float("inf")])
def test_pace_refuses_nonsense(speed: float) -> None:
    with pytest.raises(DriverError, match="pace"):
        Pace(speed)
