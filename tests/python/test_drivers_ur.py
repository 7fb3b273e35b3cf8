"""The UR driver with the real ur_rtde client, against an emulated controller in a process of its own."""

from __future__ import annotations

import socket
import sys
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest

import palpate as pp
from palpate.arm import Arm, Array, Effort
from palpate.drivers import Driver
from palpate.drivers.laws import DriverLaws
from palpate.drivers.ur_rtde import UrDriver
from palpate.errors import DriverError, MissingExtraError
from ur_emulator import HOME, RTDE_PORT, UrController, ur5e
from waiting import following, until

pytest.importorskip("rtde_receive", reason="needs the extra ur; ur_rtde has no wheel for Python 3.13")

ARM = ur5e()
HOST, CB3_HOST = "127.0.5.1", "127.0.5.2"


@pytest.fixture(scope="module")
def controller() -> Iterator[UrController]:
    with UrController(HOST) as ur:
        yield ur


@pytest.fixture
def ur(controller: UrController) -> Iterator[UrController]:
    yield controller
    for order in ("normal", "power on", "silent off", "payload 0", "release", "home"):
        controller.tell(order)


@pytest.mark.usefixtures("ur")
class TestUrLaws(DriverLaws):
    # the command acts up to two periods after write(), while gravity changes a little
    effort_tolerance = 0.5

    def make(self) -> Driver:
        return UrDriver(ARM, HOST, mode="torque", watchdog=0.5)

    def _command(self, driver: Driver, k: int) -> Array:
        return ARM.gravity_torque(HOME) + super()._command(driver, k)


@pytest.mark.usefixtures("ur")
class TestWatching:
    def test_samples_are_the_arms(self) -> None:
        with UrDriver(ARM, HOST) as driver:
            sample = following(driver)
            np.testing.assert_allclose(sample.position, HOME, atol=1e-3)
            assert sample.velocity is not None and np.abs(sample.velocity).max() < 1e-3
            np.testing.assert_allclose(
                sample.effort * driver.effort.gain(6), ARM.gravity_torque(sample.position), atol=0.05
            )
            assert driver.version == (5, 26) and driver.safety == "normal" and driver.lost >= 0

    def test_every_package_once(self) -> None:
        with UrDriver(ARM, HOST) as driver:
            stamps = [following(driver).time_ns]
            before = driver.lost
            # however few of them a busy computer takes up in time
            stamps += [following(driver).time_ns for _ in range(100)]
            steps = np.diff(stamps)
            assert len(stamps) > 100 and np.all(steps > 0)
            np.testing.assert_allclose(steps / 2e6, np.rint(steps / 2e6), atol=1e-3)
            assert driver.lost - before == np.rint(steps / 2e6).sum() - len(steps)

    def test_slower_where_asked(self) -> None:
        with UrDriver(ARM, HOST, frequency=125.0) as driver:
            assert driver.period_ns == 8_000_000
            stamps = [following(driver).time_ns for _ in range(10)]
            assert np.diff(stamps).min() >= 7_990_000

    def test_model_torque_only_without_a_payload(self, ur: UrController) -> None:
        """target_moment holds the payload that was set: then it is not the bare arm's."""
        with UrDriver(ARM, HOST) as driver:
            model = following(driver).model_torque
            assert model is not None
            np.testing.assert_allclose(model, ARM.gravity_torque(HOME), atol=0.05)
            ur.tell("payload 1.5")
            until(lambda: following(driver).model_torque is None)

    def test_enable_is_refused_and_names_the_modes(self) -> None:
        with UrDriver(ARM, HOST) as driver:
            with pytest.raises(DriverError, match="watches.*'torque'.*'speed'.*'servo'.*'force'"):
                driver.enable()
            assert driver.state == "connected"
            following(driver)

    def test_a_held_object_is_felt(self, ur: UrController) -> None:
        """2 kg at the tool: the external torque is that object's weight, within 2 %."""
        ur.tell("hold 2.0")
        pipeline = pp.Pipeline(ARM, observer=pp.InverseDynamicsObserver())
        with UrDriver(ARM, HOST) as driver:
            until(lambda: np.abs(following(driver).velocity).max() < 1e-4)
            external = None
            for _ in range(300):
                touch = pipeline.step(following(driver))
                external = touch.external.torque
        q = np.array(ur.tell("state")["q"])
        weight = ARM.jacobian(q).T @ np.array([0, 0, -2.0 * 9.81, 0, 0, 0])
        assert external is not None
        assert np.linalg.norm(external - weight) < 0.02 * np.linalg.norm(weight)


class TestCommanding:
    def test_torque_moves_as_the_arm_would(self, ur: UrController) -> None:
        """Gravity plus 5 N m at the base joint turns it, and the other joints stay."""
        with UrDriver(ARM, HOST, mode="torque") as driver:
            driver.enable()
            assert ur.tell("state")["watchdog_ns"] == 100_000_000
            push = np.array([5.0, 0, 0, 0, 0, 0])
            for _ in range(100):
                torque = ARM.gravity_torque(following(driver).position) + push
                assert np.array_equal(driver.write(torque), torque)
            moved = following(driver)
            assert moved.velocity is not None and moved.velocity[0] > 0.05
            assert moved.position[0] > HOME[0]
            driver.disable()
            state = ur.tell("state")
            assert state["mode"] == "hold" and not state["program"]

    def test_torque_is_clamped_to_the_arms_limits(self, ur: UrController) -> None:
        limited = ARM.replace(joints=tuple(j.replace(limits=pp.Limits(effort=40.0)) for j in ARM.joints))
        with UrDriver(limited, HOST, mode="torque") as driver:
            driver.enable()
            following(driver)
            assert np.array_equal(driver.write([1e9, 0, 0, 0, 0, -1e9])[[0, 5]], [40.0, -40.0])

    def test_speed(self, ur: UrController) -> None:
        with UrDriver(ARM, HOST, mode="speed") as driver:
            driver.enable()
            for _ in range(150):
                following(driver)
                sent = driver.speed([0.2, 0, 0, 0, 0, -0.1])
            velocity = following(driver).velocity
            assert np.array_equal(sent, [0.2, 0, 0, 0, 0, -0.1])
            np.testing.assert_allclose(velocity, sent, atol=0.01)
            driver.stop()
            assert ur.tell("state")["mode"] == "hold"

    def test_servo(self, ur: UrController) -> None:
        goal = HOME + np.array([0.05, 0, 0, 0, 0, 0.05])
        with UrDriver(ARM, HOST, mode="servo") as driver:
            driver.enable()
            for _ in range(200):
                following(driver)
                driver.servo(goal)
            np.testing.assert_allclose(following(driver).position, goal, atol=2e-3)

    def test_force(self, ur: UrController) -> None:
        """10 N along x of the base move the tool that way."""
        start = ARM.forward_kinematics(HOME)[0, 3]
        with UrDriver(ARM, HOST, mode="force") as driver:
            driver.enable()
            for _ in range(100):
                following(driver)
                driver.force([10.0, 0, 0, 0, 0, 0], axes=(True, False, False, False, False, False))
            assert ARM.forward_kinematics(following(driver).position)[0, 3] > start + 1e-3
            with pytest.raises(DriverError, match="limits must be 6 finite numbers"):
                driver.force(np.zeros(6), limits=[np.nan] * 6)
            assert driver.state == "connected"

    def test_write_needs_the_torque_mode(self, ur: UrController) -> None:
        with UrDriver(ARM, HOST, mode="speed") as driver:
            driver.enable()
            with pytest.raises(DriverError, match=r"'speed' takes no torque; call speed\(\)"):
                driver.write(np.zeros(6))
            assert driver.state == "connected"
            with pytest.raises(DriverError, match="takes no torque"):
                driver.speed(np.zeros(6))

    def test_commands_of_another_mode_are_refused(self, ur: UrController) -> None:
        with UrDriver(ARM, HOST, mode="servo") as driver:
            driver.enable()
            with pytest.raises(DriverError, match="made with mode='servo'"):
                driver.speed(np.zeros(6))

    def test_the_watchdog_ends_the_program_of_a_client_that_fell_asleep(self, ur: UrController) -> None:
        with UrDriver(ARM, HOST, mode="speed") as driver:
            driver.enable()
            following(driver)
            driver.speed([0.3, 0, 0, 0, 0, 0])
            until(lambda: not ur.tell("state")["program"])
            assert ur.tell("state")["mode"] == "hold"

            # a package may be older than the end of the program
            until(lambda: following(driver) is not None and driver.state == "connected")
            with pytest.raises(DriverError, match="control program on the robot has ended"):
                driver.speed([0.3, 0, 0, 0, 0, 0])
            driver.enable()
            following(driver)
            driver.speed([0.0] * 6)

    def test_an_old_sample_is_no_ground_for_a_command(self, ur: UrController) -> None:
        with UrDriver(ARM, HOST, mode="speed") as driver:
            driver.enable()
            following(driver)
            time.sleep(0.15)
            with pytest.raises(DriverError, match=r"0\.\d+ s old; read\(\) comes before"):
                driver.speed(np.zeros(6))


class TestSafety:
    @pytest.mark.parametrize(
        ("order", "said"), [("protective", "protective stop"), ("emergency", "emergency stop")]
    )
    def test_a_stop_ends_control_and_is_named(self, ur: UrController, order: str, said: str) -> None:
        with UrDriver(ARM, HOST, mode="speed") as driver:
            driver.enable()
            following(driver)
            driver.speed(np.zeros(6))
            ur.tell(order)
            until(lambda: following(driver) is not None and driver.state == "connected")
            assert driver.safety == said
            with pytest.raises(DriverError, match=f"enable.*stopped.*{said}"):
                driver.speed(np.zeros(6))
            with pytest.raises(DriverError, match=f"{said}; clear that on the pendant"):
                driver.enable()
            following(driver)
            ur.tell("normal")
            until(lambda: driver.safety == "normal")
            driver.enable()

    def test_a_robot_that_is_off_is_named(self, ur: UrController) -> None:
        ur.tell("power off")
        with UrDriver(ARM, HOST, mode="speed") as driver:
            until(lambda: following(driver) is not None)
            with pytest.raises(DriverError, match="not running"):
                driver.enable()


class TestLoss:
    @pytest.mark.parametrize("how", ["cut", "silent on"])
    def test_lost_in_motion_stops_and_connects_again(self, ur: UrController, how: str) -> None:
        """The arm is stopped by its controller, read() says what happened, and the log of before and after is whole."""
        mend = {"cut": "mend", "silent on": "silent off"}[how]
        driver = UrDriver(ARM, HOST, mode="speed")
        driver.connect()
        try:
            driver.enable()
            log = []
            for _ in range(50):
                log.append(following(driver))
                driver.speed([0.3, 0, 0, 0, 0, 0])
            ur.tell(how)
            with pytest.raises(DriverError, match=r"no package.*close\(\) and connect\(\)"):
                while True:
                    sample = driver.read()
                    if sample is not None:
                        log.append(sample)
                        driver.speed([0.3, 0, 0, 0, 0, 0])
            assert driver.state == "connected"
            until(lambda: ur.tell("state")["mode"] == "hold")
            assert not ur.tell("state")["program"]
            with pytest.raises(DriverError, match=r"enable\(\) first"):
                driver.speed([0.3, 0, 0, 0, 0, 0])
            driver.close()
            if how == "cut":
                with pytest.raises(DriverError, match="no UR controller answers"):
                    driver.connect()
            ur.tell(mend)
            driver.connect()
            assert driver.state == "connected" and not ur.tell("state")["program"]
            log.append(following(driver))
            assert np.all(np.diff([s.time_ns for s in log]) > 0)
            driver.enable()
            following(driver)
            driver.speed(np.zeros(6))
        finally:
            ur.tell(mend)
            driver.close()

    def test_when_ur_rtde_ends_the_watchdog_stops_the_arm(self, ur: UrController) -> None:
        with UrDriver(ARM, HOST, mode="speed") as driver:
            driver.enable()
            following(driver)
            driver.speed([0.3, 0, 0, 0, 0, 0])
            driver._control.end()
            following(driver)
            with pytest.raises(DriverError, match="no answer by way of ur_rtde"):
                driver.speed([0.3, 0, 0, 0, 0, 0])
            assert driver.state == "connected"
            until(lambda: not ur.tell("state")["program"])
            assert ur.tell("state")["mode"] == "hold"
            driver.enable()
            following(driver)
            driver.speed(np.zeros(6))

    def test_a_short_gap_is_none_and_counted(self, ur: UrController) -> None:
        with UrDriver(ARM, HOST) as driver:
            following(driver)
            ur.tell("silent on")
            time.sleep(0.05)
            seen = [driver.read() for _ in range(5)]
            ur.tell("silent off")
            assert None in seen
            before = driver.lost
            following(driver)
            assert driver.lost > before + 10


class TestRefusals:
    def test_without_the_extra(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setitem(sys.modules, "rtde_receive", None)
        with pytest.raises(MissingExtraError, match=r"palpate\[ur\]"):
            UrDriver(ARM, "127.0.5.9").connect()

    def test_nobody_there(self) -> None:
        with pytest.raises(DriverError, match="connect.*127.0.5.9:30004.*no UR controller"):
            UrDriver(ARM, "127.0.5.9").connect()

    @pytest.mark.parametrize("answer", [b"SSH-2.0-OpenSSH_9.2\r\n", b"", b"\x00\x04V\x00\x00\x03v\x00\x03O"])
    def test_somebody_else_there(self, answer: bytes) -> None:
        """What is no controller is told; ur_rtde would end the process."""
        with socket.create_server(("127.0.5.8", RTDE_PORT)) as listener:

            def serve() -> None:
                client, _ = listener.accept()
                with client:
                    client.recv(100)
                    client.sendall(answer)

            thread = threading.Thread(target=serve)
            thread.start()
            with pytest.raises(DriverError, match="127.0.5.8:30004"):
                UrDriver(ARM, "127.0.5.8").connect()
            thread.join()

    def test_a_cb3_sends_125(self) -> None:
        with UrController(CB3_HOST, rate=125.0, version="3.15.0.1"):
            with pytest.raises(DriverError, match="frequency=125"):
                UrDriver(ARM, CB3_HOST).connect()
            with UrDriver(ARM, CB3_HOST, mode="torque", frequency=125.0) as driver:
                following(driver)
                with pytest.raises(DriverError, match="5.26.*has 3.15"):
                    driver.enable()

    @pytest.mark.parametrize(
        ("arm", "options", "message"),
        [
            (Arm.from_dh([0.4, 0.3], [0, 0], [0, 0]), {}, "6 joints"),
            (ARM.replace(effort=Effort.torque()), {}, "motor current"),
            (ARM, {"mode": "position"}, "mode must be None, 'torque'"),
            (ARM, {"frequency": 1000.0}, "between 1 and 500"),
            (ARM, {"watchdog": 2.0}, "watchdog"),
            (ARM, {"frequency": float("nan")}, "between 1 and 500"),
            (Arm.from_dh([0] * 6, [0] * 6, [0] * 6), {"mode": "torque"}, "masses"),
        ],
    )
    def test_nonsense(self, arm: Arm, options: dict[str, object], message: str) -> None:
        with pytest.raises(DriverError, match=message):
            UrDriver(arm, HOST, **options)  # type: ignore[arg-type]


@pytest.mark.slow
def test_500_hz_for_half_a_minute(ur: UrController) -> None:
    """Rate, losses and age of the samples while commanding; the figures are printed."""
    ages: list[float] = []
    with UrDriver(ARM, HOST, mode="speed", watchdog=0.5) as driver:
        driver.enable()
        stamps = [following(driver).time_ns]
        before = driver.lost
        while stamps[-1] - stamps[0] <= 30e9:
            stamps.append(following(driver).time_ns)
            ages.append(time.monotonic() - stamps[-1] * 1e-9)  # the emulated controller shows this clock
            driver.speed([0.02 * np.sin(stamps[-1] * 1e-9), 0, 0, 0, 0, 0])
        lost = driver.lost - before
    p50, p99 = np.percentile(ages, [50, 99]) * 1e3
    print(f"RTDE 500 Hz: {len(ages)} samples, {lost} lost, age p50 {p50:.2f} ms, p99 {p99:.2f} ms")
    # how many is the machine's matter: printed, not judged; but each is counted
    assert lost == np.rint(np.diff(stamps) / 2e6 - 1.0).sum()
