"""The FRI driver against an emulated controller: lost, late, doubled, hostile packets. No real one was at hand."""

from __future__ import annotations

import json
import math
import socket
import subprocess
import sys
import time
from collections.abc import Callable

import numpy as np
import pytest

import fri_emulator
import palpate as pp
from fri_emulator import ACTIVE, ARM, HOME, FriController, Network, block, doubles, fields, number
from fri_messages import protobuf_classes
from palpate import _core
from palpate.arm import Arm
from palpate.drivers import Driver
from palpate.drivers.fri import FriDriver
from palpate.drivers.laws import DriverLaws
from palpate.errors import DriverError
from palpate.simulate import Plant
from waiting import following, until

PORT = 30207
LOCAL = "127.0.0.1"


def make(**options: object) -> FriDriver:
    """A driver that never answers by itself: the emulator's cycle waits for the test, however slow the computer is."""
    return FriDriver(ARM, **{"port": PORT, "address": LOCAL, "deadline": math.inf} | options)  # type: ignore[arg-type]


class TestFriLaws(DriverLaws):
    @pytest.fixture(autouse=True)
    def controller(self) -> object:
        with FriController(PORT) as controller:
            yield controller

    def make(self) -> Driver:
        return make(mode="torque")


class TestFriLawsOnABadNetwork(TestFriLaws):
    """The same where messages are late, doubled and lost; what was sent need not be what acts."""

    periods = 60
    effort_tolerance = 1e3

    @pytest.fixture(autouse=True)
    def controller(self) -> object:
        with FriController(PORT, network=Network(loss=0.02, delay=0.02, double=0.05, seed=4)) as controller:
            yield controller


@pytest.mark.parametrize("layout", ["1.15", "2.5"])
@pytest.mark.parametrize("packed", [False, True])
def test_samples_are_the_arms(layout: str, packed: bool) -> None:
    with FriController(PORT, layout=layout, packed=packed, commanding=False) as controller, make() as driver:
        samples = [following(driver) for _ in range(30)]
        assert np.array_equal(np.diff([s.time_ns for s in samples]), np.full(29, 2_000_000))
        np.testing.assert_allclose(samples[-1].position, HOME, atol=1e-3)
        np.testing.assert_allclose(samples[-1].effort, ARM.gravity_torque(samples[-1].position), atol=0.5)
        assert samples[-1].velocity is None and driver.effort.kind == "torque"
        assert driver.external.shape == (7,) and driver.session.endswith("NORMAL")
        assert controller.missed <= 1 and controller.stale == 0


def test_every_message_is_answered_and_reflected() -> None:
    with FriController(PORT, commanding=False) as controller, make() as driver:
        for _ in range(50):
            following(driver)
        commands = controller.commands[:40]
        assert np.all(np.diff([c.reflected for c in commands]) == 1)
        assert np.all(np.diff([c.sequence for c in commands]) == 1)
        assert all(c.position is None for c in commands), "monitoring answers command nothing"


def test_every_third_message_where_the_program_says_so() -> None:
    with FriController(PORT, multiplier=3, commanding=False) as controller, make(mode="torque") as driver:
        for _ in range(60):
            following(driver)
        assert controller.missed <= 1
        assert np.all(np.diff([c.reflected for c in controller.commands[1:15]]) == 3)
        with pytest.raises(DriverError, match="receive multiplier to 3"):
            driver.enable()


def test_the_sign_of_torque() -> None:
    with FriController(PORT, commanding=False), make(torque_sign=-1) as driver:
        sample = following(driver)
        np.testing.assert_allclose(sample.effort, -ARM.gravity_torque(sample.position), atol=0.5)


class TestTorque:
    def test_what_was_sent_moves_the_arm(self) -> None:
        """A second plant, fed with the samples' effort alone, goes the same way; 3 N m more than gravity move it."""
        twin = Plant(ARM, integrator="discrete", timestep=2e-3)
        with FriController(PORT) as controller, make(mode="torque") as driver:
            driver.enable()
            sample = following(driver)
            twin.reset(sample.position)
            push = np.array([0, 3.0, 0, 0, 0, 0, 0])
            rows = []
            for _ in range(50):
                driver.write(ARM.gravity_torque(sample.position) + push)
                sample = following(driver)
                rows.append(sample)
            for row in rows:
                twin.step(row.effort, 2_000_000)
            np.testing.assert_allclose(twin.q, rows[-1].position, atol=1e-5)
            assert rows[-1].position[1] > rows[0].position[1] + 5e-3
            assert controller.stale == 0

    def test_a_held_object_is_felt(self) -> None:
        """1.5 kg at the tip, the arm held by its controller: the external torque is its weight, within 1 %."""
        controller = FriController(PORT, commanding=False)
        controller.plant.attach(1.5)
        pipeline = pp.Pipeline(ARM, observer=pp.InverseDynamicsObserver())
        with controller, make() as driver:
            for _ in range(500):
                touch = pipeline.step(sample := following(driver))
        weight = ARM.jacobian(sample.position).T @ np.array([0, 0, -1.5 * 9.81, 0, 0, 0])
        assert np.linalg.norm(touch.external.torque - weight) < 0.01 * np.linalg.norm(weight)

    def test_clamped_to_the_arms_limits(self) -> None:
        with FriController(PORT), make(mode="torque") as driver:
            driver.enable()
            limit = [j.limits.effort for j in ARM.joints]
            assert np.array_equal(driver.write(np.full(7, 1e9)), limit)

    def test_one_answer_per_message(self) -> None:
        """A second command in the same period is not sent, and write() says what is."""
        with FriController(PORT) as controller, make(mode="torque") as driver:
            driver.enable()
            following(driver)
            sent = driver.write(np.full(7, 0.5))
            assert np.array_equal(driver.write(np.full(7, -0.5)), sent)
            following(driver)
            reflected = [c.reflected for c in controller.commands]
            assert len(set(reflected)) == len(reflected)

    def test_a_message_that_nobody_commanded_is_answered_without_torque(self) -> None:
        with FriController(PORT) as controller, make(mode="torque") as driver:
            driver.enable()
            for _ in range(5):
                following(driver)
                driver.write(np.zeros(7))
            for _ in range(5):
                following(driver)
            assert all(c.torque is not None and not c.torque.any() for c in controller.commands[-4:])
            assert controller.state == ACTIVE

    def test_stop_answers_at_once_and_the_session_stays(self) -> None:
        with FriController(PORT) as controller, make(mode="torque") as driver:
            driver.enable()
            following(driver)
            driver.stop()
            for _ in range(60):
                following(driver)
            assert controller.state == ACTIVE and controller.fell_back == 0
            driver.enable()


def test_position() -> None:
    goal = HOME + 0.02
    with (
        FriController(PORT, mode="position", period=0.01) as controller,
        make(mode="position", period=0.01) as driver,
    ):
        driver.enable()
        for _ in range(60):
            following(driver)
            assert np.array_equal(driver.position(goal), goal)
        np.testing.assert_allclose(following(driver).position, goal, atol=2e-3)
        with pytest.raises(DriverError, match=r"takes no torque; call position\(\)"):
            driver.write(np.zeros(7))
        assert driver.state == "connected" and controller.stale == 0


def test_wrench() -> None:
    """20 N along the tool's z move the tool that way."""
    with FriController(PORT, mode="wrench"), make(mode="wrench") as driver:
        driver.enable()
        start = ARM.forward_kinematics(following(driver).position)
        for _ in range(50):
            driver.wrench([0, 0, 20.0, 0, 0, 0])
            sample = following(driver)
        moved = start[:3, :3].T @ (ARM.forward_kinematics(sample.position)[:3, 3] - start[:3, 3])
        assert moved[2] > 2e-3
        with pytest.raises(DriverError, match="wrench of 'Fy' is nan"):
            driver.wrench([0, np.nan, 0, 0, 0, 0])


class TestSession:
    def test_the_robot_program_must_fit(self) -> None:
        with FriController(PORT, mode="wrench"), make(mode="torque") as driver:
            with pytest.raises(DriverError, match="expects WRENCH, this driver commands TORQUE"):
                driver.enable()
            assert driver.state == "connected"

    def test_the_control_mode_must_fit(self) -> None:
        controller = FriController(PORT, mode="torque")
        controller.control_mode = 0
        with controller, make(mode="torque") as driver:
            with pytest.raises(
                DriverError, match="needs the control mode JOINT_IMPEDANCE, the robot is in POSITION"
            ):
                driver.enable()

    def test_monitoring_only(self) -> None:
        with FriController(PORT), make() as driver:
            with pytest.raises(DriverError, match="monitors.*'torque', 'position', 'wrench'"):
                driver.enable()

    def test_a_safety_stop_ends_control_and_is_named(self) -> None:
        with FriController(PORT) as controller, make(mode="torque") as driver:
            driver.enable()
            following(driver)
            driver.write(np.zeros(7))
            controller.safety = 2
            until(lambda: following(driver) is not None and driver.state == "connected")
            with pytest.raises(DriverError, match="stopped.*STOP_1"):
                driver.write(np.zeros(7))
            with pytest.raises(DriverError, match="STOP_1"):
                driver.enable()
            controller.safety = 0
            until(lambda: following(driver) is not None and "NORMAL" in driver.session)
            driver.enable()

    def test_drives_that_are_off_are_named(self) -> None:
        controller = FriController(PORT)
        controller.drive = 0
        with controller, make(mode="torque") as driver:
            with pytest.raises(DriverError, match="the drive of 'A1' is OFF"):
                driver.enable()

    def test_the_program_ends_its_motion(self) -> None:
        with FriController(PORT) as controller, make(mode="torque") as driver:
            driver.enable()
            controller.commanding = False
            until(lambda: following(driver) is not None and driver.state == "connected")
            with pytest.raises(DriverError, match="fell back: MONITORING_READY"):
                driver.write(np.zeros(7))

    def test_a_client_that_sleeps_loses_the_session(self) -> None:
        with FriController(PORT, realtime=True) as controller, make(mode="torque", patience=5.0) as driver:
            driver.enable()
            time.sleep(0.3)
            assert controller.fell_back == 1
            until(lambda: following(driver) is not None and driver.state == "connected")
            assert driver.lost > 50
            driver.enable()

    def test_another_period_is_named(self) -> None:
        with FriController(PORT, period=0.005):
            with pytest.raises(DriverError, match="every 5 ms.*made for 2 ms: give period=0.005"):
                make().connect()


class TestNetwork:
    @pytest.mark.parametrize("seed", range(3))
    def test_one_percent_lost_the_session_stays_and_nothing_is_stale(self, seed: int) -> None:
        """Lost, late and doubled packets: times rise, losses are counted, no answer is for an old message."""
        network = Network(loss=0.01, delay=0.01, double=0.02, seed=seed)
        with FriController(PORT, network=network) as controller, make(mode="torque") as driver:
            driver.enable()
            stamps = []
            while len(stamps) < 1000:
                sample = following(driver)
                stamps.append(sample.time_ns)
                driver.write(ARM.gravity_torque(sample.position))
            steps = np.diff(stamps) // 2_000_000
            assert np.all(steps >= 1)
            assert driver.lost >= steps.sum() - len(steps) > 0
            assert driver.refused > 0
            assert controller.stale == 0
            assert driver.state == "enabled" and controller.fell_back == 0

    def test_a_bad_network_ends_control_by_the_rules(self) -> None:
        controller = FriController(PORT)
        with controller, make(mode="torque") as driver:
            driver.enable()
            controller.network = Network(loss=0.3, seed=1)
            until(lambda: driver.read() is None or driver.state == "connected")
            until(lambda: driver.read() is not None and driver.state == "connected")
            assert controller.fell_back >= 1
            with pytest.raises(DriverError, match="fell back"):
                driver.write(np.zeros(7))

    def test_the_same_seed_gives_the_same_run(self) -> None:
        runs = []
        for _ in range(2):
            network = Network(loss=0.01, delay=0.01, double=0.02, seed=7)
            controller = FriController(PORT, network=network, wait=20.0)
            with controller, make(mode="torque", patience=30.0) as driver:
                driver.enable()
                rows: list[np.ndarray] = []
                while len(rows) < 200:
                    rows.append(following(driver).position)
                    driver.write(ARM.gravity_torque(rows[-1]) + np.sin(0.1 * len(rows)))
                runs.append(np.array(rows))
        assert np.array_equal(*runs) and np.all(np.ptp(runs[0], axis=0) > 1e-3)

    def test_silence_is_none_then_an_error(self) -> None:
        with FriController(PORT) as controller, make(mode="torque", patience=0.2) as driver:
            driver.enable()
            following(driver)
            controller.paused = True
            until(lambda: driver.read() is None)
            with pytest.raises(DriverError, match="no monitoring message for"):
                while True:
                    driver.read()
            assert driver.state == "connected"
            with pytest.raises(DriverError, match=r"enable\(\) first"):
                driver.write(np.zeros(7))
            driver.close()
            controller.paused = False
            driver.connect()
            driver.enable()

    def test_a_new_session_counts_from_zero(self) -> None:
        with FriController(PORT, commanding=False) as controller, make() as driver:
            for _ in range(30):
                following(driver)
            controller.sequence = 0
            for _ in range(10):
                following(driver)
            assert driver.lost == 0 and driver.refused == 0


class TestHostile:
    def refuse(self, change: Callable[[bytes], bytes]) -> None:
        """Changed messages are passed over and counted, and the session goes on when they end."""
        with FriController(PORT, commanding=False) as controller, make(patience=5.0) as driver:
            following(driver)
            before = driver.refused
            controller.before_send = change
            until(lambda: driver.read() is None and driver.refused > before + 1)
            controller.before_send = lambda data: data
            following(driver)

    def test_noise(self) -> None:
        rng = np.random.default_rng(0)
        self.refuse(lambda data: rng.bytes(rng.integers(0, 1400)))

    def test_cut_short(self) -> None:
        self.refuse(lambda data: data[: len(data) // 2])

    def test_too_long(self) -> None:
        self.refuse(lambda data: data + block(14, bytes(2000)))

    def test_another_message(self) -> None:
        self.refuse(lambda data: data.replace(b"\x42\x51\x24\x00", b"\x43\x51\x24\x00"))

    @pytest.mark.parametrize("values", [np.full(7, np.nan), np.zeros(6), np.zeros(0), np.full(7, np.inf)])
    def test_positions_that_are_none(self, values: np.ndarray) -> None:
        def change(data: bytes) -> bytes:
            parts = fields(data)
            monitor = fields(parts[3][0])
            rest = b"".join(block(t, v) for t in (2, 5, 15) for v in monitor[t])
            return b"".join(
                block(t, doubles(1, values) + rest if t == 3 else v) for t, (v, *_) in parts.items()
            )

        self.refuse(change)

    def test_an_old_message_again_and_again(self) -> None:
        kept: list[bytes] = []

        def change(data: bytes) -> bytes:
            kept.append(data)
            return kept[0]

        self.refuse(change)

    def test_another_sender_is_not_heard(self) -> None:
        with FriController(PORT, commanding=False) as controller, make() as driver:
            following(driver)
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
                other.bind(("127.0.0.7", 0))
                future = controller.monitoring().replace(block(15, number(1, 1)), block(15, number(1, 2**31)))
                for _ in range(20):
                    other.sendto(future, controller.client)
            stamps = [following(driver).time_ns for _ in range(30)]
            assert driver.refused == 20 and np.all(np.diff(stamps) == 2_000_000)


class TestRefusals:
    def test_nobody_sends(self) -> None:
        with pytest.raises(DriverError, match=f"no monitoring message came to {LOCAL}:{PORT} within 0.1 s"):
            make(patience=0.1).connect()

    def test_only_the_named_controller_is_heard(self) -> None:
        with FriController(PORT, commanding=False):
            with pytest.raises(DriverError, match="datagrams of another kind"):
                make(controller="127.0.0.9", patience=0.3).connect()
            with make(controller=LOCAL) as driver:
                following(driver)

    def test_the_port_is_taken(self) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
            other.bind((LOCAL, PORT))
            with pytest.raises(DriverError, match=f"cannot listen at {LOCAL}:{PORT}"):
                make().connect()

    def test_an_arm_of_other_joints(self) -> None:
        six = Arm.from_dh([0] * 6, [0] * 6, [0] * 6)
        with FriController(PORT, commanding=False):
            with pytest.raises(DriverError, match="of another kind"):
                FriDriver(six, port=PORT, address=LOCAL, patience=0.3).connect()

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"mode": "force"}, "mode must be None, 'torque'"),
            ({"period": 0.5}, "period"),
            ({"port": 80}, "30200 to 30209"),
            ({"torque_sign": 0}, "torque_sign"),
            ({"patience": float("nan")}, "patience"),
            ({"deadline": 0.0}, "deadline"),
            ({"deadline": float("nan")}, "deadline"),
            ({"address": "nowhere.invalid"}, "cannot listen"),
        ],
    )
    def test_nonsense(self, options: dict[str, object], message: str) -> None:
        with pytest.raises(DriverError, match=message):
            make(**options).connect()


class TestDeadline:
    """A thread answers where the program is not in time: the safe answer, once, and no command after it."""

    def test_a_program_that_sleeps_keeps_the_session_and_pushes_nothing(self) -> None:
        with FriController(PORT) as controller, make(mode="torque", deadline=0.6) as driver:
            driver.enable()
            begun = len(controller.commands)
            until(lambda: len(controller.commands) > begun + 200)  # the program does nothing
            asleep = controller.commands[begun : begun + 200]
            assert all(c.torque is not None and not c.torque.any() for c in asleep)
            assert len({c.reflected for c in asleep}) == len(asleep), "a message was answered twice"
            assert driver.late >= 200

    def test_a_command_that_comes_too_late_is_not_sent(self) -> None:
        with FriController(PORT) as controller, make(mode="torque", deadline=0.6) as driver:
            driver.enable()
            sample = following(driver)
            answered = len(controller.commands)
            until(lambda: len(controller.commands) > answered + 3)
            sent = driver.write(ARM.gravity_torque(sample.position) + 5.0)
            np.testing.assert_allclose(sent, ARM.gravity_torque(sample.position))
            until(lambda: len(controller.commands) > answered + 10)
            assert not any(c.torque is not None and c.torque.any() for c in controller.commands[answered:])

    def test_while_nothing_is_commanded_every_message_is_answered_at_once(self) -> None:
        with FriController(PORT, commanding=False) as controller, make(deadline=0.6):
            until(lambda: len(controller.commands) > 100)
            assert all(c.position is None for c in controller.commands[:100])
            assert controller.stale == 0


@pytest.fixture(scope="module")
def classes() -> dict[str, type]:
    return protobuf_classes()


class TestMessages:
    """palpate's own reading and writing of the wire format, beside the protobuf package's."""

    def message(self, rng: np.random.Generator, classes: dict[str, type]):
        """A message with whatever in its fields."""
        m = classes["Monitoring"]()
        m.header.message_id = int(rng.choice([0x245142, 7, 2**32 - 1]))
        m.header.sequence = int(rng.integers(0, 2**32))
        m.robot.safety_state = int(rng.integers(-(2**31), 2**31))
        m.robot.control_mode = int(rng.integers(0, 5))
        m.robot.drive_state.extend(int(x) for x in rng.integers(-2, 4, rng.integers(0, 9)))
        for name in ("measured_position", "measured_torque", "external_torque"):
            numbers = rng.normal(size=rng.integers(0, 9)) * 10.0 ** rng.integers(-300, 300)
            getattr(m.monitor, name).value.extend(numbers.tolist())
        m.monitor.timestamp.sec, m.monitor.timestamp.nanosec = (int(x) for x in rng.integers(0, 2**32, 2))
        m.connection.session_state = int(rng.integers(0, 6))
        m.connection.quality = int(rng.integers(0, 4))
        m.connection.send_period = int(rng.integers(0, 2**32))
        m.connection.receive_multiplier = int(rng.integers(0, 9))
        m.ipo.joint_position.value.extend(rng.normal(size=7).tolist())
        m.ipo.command_mode = int(rng.integers(0, 4))
        return m

    @staticmethod
    def same(own, m) -> None:
        assert own.sequence == m.header.sequence
        stamp = m.monitor.timestamp
        assert own.time_ns == stamp.sec * 10**9 + stamp.nanosec
        pairs = [
            (own.position, m.monitor.measured_position.value),
            (own.torque, m.monitor.measured_torque.value),
            (own.external, m.monitor.external_torque.value),
            (own.interpolated, m.ipo.joint_position.value),
            (own.drive_state, m.robot.drive_state),
        ]
        for ours, theirs in pairs:
            assert np.array_equal(ours, list(theirs)[:16], equal_nan=True)
        assert own.safety_state == m.robot.safety_state and own.control_mode == m.robot.control_mode
        c = m.connection
        assert (own.session_state, own.quality) == (c.session_state, c.quality)
        assert (own.send_period, own.receive_multiplier) == (c.send_period, c.receive_multiplier)
        assert own.command_mode == m.ipo.command_mode

    def test_what_is_read_is_what_protobuf_reads(self, classes: dict[str, type]) -> None:
        rng = np.random.default_rng(1)
        for _ in range(300):
            m = self.message(rng, classes)
            own = _core.fri_decode(m.SerializeToString())
            assert own is not None
            self.same(own, m)

    def test_damaged_bytes_are_read_as_protobuf_reads_them_or_refused(self, classes: dict[str, type]) -> None:
        from google.protobuf.message import DecodeError

        rng = np.random.default_rng(2)
        accepted = 0
        for _ in range(4000):
            data = bytearray(self.message(rng, classes).SerializeToString())
            for _ in range(rng.integers(1, 4)):
                kind, at = rng.integers(4), int(rng.integers(len(data)))
                if kind == 0:
                    data[at] = int(rng.integers(256))
                elif kind == 1:
                    del data[at:]
                    data += b"\0"
                elif kind == 2:
                    data[at:at] = rng.bytes(rng.integers(1, 12))
                else:
                    data += data[at:]
            own = _core.fri_decode(bytes(data))
            if own is None:
                continue
            try:
                m = classes["Monitoring"].FromString(bytes(data))
            except DecodeError:
                raise AssertionError(f"read what is no message: {data.hex()}") from None
            self.same(own, m)
            accepted += 1
        assert accepted > 200

    def test_noise_is_no_message(self) -> None:
        rng = np.random.default_rng(3)
        for _ in range(20_000):
            _core.fri_decode(rng.bytes(rng.integers(0, 200)))

    def test_what_is_written_is_read_by_protobuf(self, classes: dict[str, type]) -> None:
        rng = np.random.default_rng(4)
        for _ in range(200):
            q, tau, w = rng.normal(size=7), rng.normal(size=7), rng.normal(size=6)
            given = [v if rng.random() < 0.5 else None for v in (q, tau, w)]
            sequence, reflected = (int(x) for x in rng.integers(0, 2**32, 2))
            m = classes["Command"].FromString(_core.fri_encode(sequence, reflected, *given))
            assert m.header.message_id == 0x34001
            assert (m.header.sequence, m.header.reflected) == (sequence, reflected)
            for part, value in zip(
                (m.data.joint_position.value, m.data.joint_torque.value, m.data.wrench.element),
                given,
                strict=True,
            ):
                assert list(part) == ([] if value is None else value.tolist())
            assert m.HasField("data") == any(v is not None for v in given)


@pytest.mark.slow
@pytest.mark.parametrize("loss", [0.0, 0.01])
def test_two_milliseconds_for_a_minute(loss: float) -> None:
    """A wrench overlay in real time, the controller in a process of its own; the figures are printed."""
    run = [sys.executable, fri_emulator.__file__, str(PORT), "60", str(loss)]
    answers, ended = [], 0
    with subprocess.Popen(run, stdout=subprocess.PIPE, text=True) as process:
        with make(mode="wrench", patience=3.0) as driver:
            driver.enable()
            with pytest.raises(DriverError, match="the session is over"):
                while True:
                    sample = driver.read()
                    begin = time.monotonic()
                    if driver.state != "enabled":
                        ended += 1
                        driver.enable()
                    elif sample is not None:
                        driver.wrench([0, 0, fri_emulator.wave(sample.time_ns), 0, 0, 0])
                        answers.append(time.monotonic() - begin)
            late, lost = driver.late, driver.lost
        assert process.stdout is not None
        seen = json.loads(process.stdout.read())
    p50, p999 = np.percentile(answers, [50, 99.9]) * 1e6
    print(
        f"FRI 2 ms, {loss:.0%} lost each way: {seen['cycles']} cycles, {seen['missed']} without an answer in time, "
        f"{lost} not seen, {late} late, session ended {ended} times; a command takes {p50:.0f} us, p99.9 {p999:.0f} us"
    )
    assert seen["foreign"] == 0, "a command acted that was made for another message"
    assert 0 <= seen["fell_back"] - ended <= 1  # the last one may come after the last sample
    assert len(answers) > 0  # how many is the machine's matter: printed, not judged
