"""The real-time session from Python: what it finds, records and leaves behind; in simulated time where time matters."""

from __future__ import annotations

import ctypes
import json
import subprocess
import sys
import time

import numpy as np
import pytest

import palpate as pp
from palpate import robots
from palpate.drivers import Driver, Sample
from palpate.session import Realtime, Session, SimulatedArm
from palpate.weigh import arm_of, scene

SCENE = scene(robots.load("justina_left_arm"))
ARM = SCENE.arm
GOAL = SCENE.poses["Take3"]
MASS = 0.25
PLAIN = Realtime(priority=0, lock_memory=False)


def controller() -> pp.Controller:
    return pp.Controller(ARM, *SCENE.gains)


def weigh(**options) -> tuple[Session, SimulatedArm]:
    """A session in simulated time that has lifted 0.25 kg."""
    simulated = SimulatedArm(ARM, seed=3)
    simulated.hold(MASS)
    session = Session(ARM, simulated, controller=controller(), simulated_time=True, **options)
    with session:
        session.run(0.1)
        session.enable()
        session.move_to(GOAL, 1.0)
        session.run(3.9)
    return session, simulated


class StillArm(Driver):
    """An arm in Python that stands still, and does what a test tells it."""

    def __init__(self, period: float = 0.004) -> None:
        super().__init__(ARM.joint_names, round(1e9 * period), ARM.effort)
        self.reads = self.writes = 0
        self.stops: list[str] = []
        self.on_read = lambda k: None
        self.on_write = lambda k: None

    def _connect(self) -> None:
        self.reads = 0

    def _read(self) -> Sample | None:
        self.reads += 1
        self.on_read(self.reads)
        return Sample(self.reads * self.period_ns, np.zeros(7), None, ARM.gravity_torque(np.zeros(7)))

    def _write(self, torque):
        self.writes += 1
        self.on_write(self.writes)
        return torque.copy()

    def _enable(self) -> None:
        pass

    def _disable(self) -> None:
        self.stops.append(self.state)

    def _close(self) -> None:
        self.stops.append("closed")


def stepped(driver: Driver, **options) -> Session:
    return Session(ARM, driver, controller=controller(), simulated_time=True, **options)


def test_it_lifts_weighs_and_says_how_sure_it_is():
    session, simulated = weigh()
    state = session.state
    assert state.touch.payload.status == pp.Status.ok
    assert abs(state.touch.payload.mass - MASS) < 0.02 * MASS
    assert np.allclose(simulated.truth[0], GOAL, atol=0.1)
    assert np.allclose(state.setpoint.q, GOAL)
    assert session.mode == "stopped"
    statistics = session.statistics
    assert statistics.ticks == statistics.samples == 4001  # one of them switched the drives on
    assert statistics.lost_own == statistics.lost_driver == statistics.lost_system == 0
    assert sum(count for _, count in statistics.own.bins) == statistics.own.count == statistics.ticks


def test_everything_is_recorded_and_the_recording_gives_the_same_estimates(tmp_path):
    pipeline = pp.Pipeline(
        ARM,
        observer=pp.MomentumObserver(),
        wrench=pp.WrenchEstimator(),
        contact=pp.ContactDetector(),
    )
    session, _ = weigh(record=tmp_path / "run.mcap", pipeline=pipeline)
    log = pp.Log.open(tmp_path / "run.mcap")
    assert len(log) == session.statistics.samples
    assert session.statistics.records_dropped == 0
    again = pp.Pipeline.from_options(ARM, json.loads(log.meta["pipeline"])).run(log)
    assert np.array_equal(again.payload.mass, log.signals["payload_mass"].value)
    assert np.array_equal(again.external.torque, log.signals["external_torque"].value)
    assert np.array_equal(again.wrench.force, log.signals["wrench_force"].value)
    assert arm_of(log).joint_names == ARM.joint_names


def test_the_same_run_gives_the_same_bits():
    a, b = weigh()[0].state, weigh()[0].state
    assert np.array_equal(a.sent, b.sent)
    assert a.touch.payload.mass == b.touch.payload.mass


def test_a_pushed_hand_is_felt():
    simulated = SimulatedArm(ARM, q=GOAL, noise=False)
    pipeline = pp.Pipeline(ARM, observer=pp.MomentumObserver(), payload=None, wrench=pp.WrenchEstimator())
    with Session(ARM, simulated, pipeline=pipeline, controller=controller(), simulated_time=True) as session:
        session.enable()
        session.run(1.0)
        before = session.state.touch.wrench.force
        simulated.push([0.0, 0.0, -3.0])
        session.run(1.0)
        wrench = session.state.touch.wrench
    assert np.allclose(wrench.force - before, [0.0, 0.0, -3.0], atol=3.0 * np.max(wrench.force_std))
    assert (wrench.force - before)[2] < -1.0


def test_tare_calls_the_present_mass_zero():
    simulated = SimulatedArm(ARM)
    simulated.hold(MASS)
    with Session(ARM, simulated, controller=controller(), simulated_time=True) as session:
        session.enable()
        session.move_to(GOAL, 1.0)
        session.run(2.5)
        number = session.tare()
        session.run(0.01)
        state = session.state
        assert state.tares == number == 1
        assert abs(state.net_mass) < 0.01
        assert state.net_mass_std > state.touch.payload.mass_std
        assert abs(state.touch.payload.mass - MASS) < 0.01


def test_other_gains_act_at_once():
    simulated = SimulatedArm(ARM, noise=False)
    with Session(ARM, simulated, controller=controller(), simulated_time=True) as session:
        session.enable()
        session.set_gains(0.0, 0.0)
        session.move_to(GOAL, 4.0)
        session.run(0.5)
        # without feedback the command is the planned motion's own torque
        state = session.state
        q, dq, ddq = state.setpoint
        planned = ARM.inverse_dynamics(q, dq, ddq) + ARM.friction_torque(dq)
        assert np.allclose(state.sent, planned, atol=1e-9)


def test_a_driver_in_python_serves_by_the_same_contract():
    mujoco = pytest.importorskip("palpate.drivers.mujoco", reason="palpate[sim] is not installed")
    pytest.importorskip("mujoco", reason="palpate[sim] is not installed")
    driver = mujoco.MujocoDriver(ARM, payload=MASS, seed=1)
    with Session(ARM, driver, controller=controller(), simulated_time=True) as session:
        assert driver.state == "connected"
        session.enable()
        assert driver.state == "enabled"
        session.move_to(GOAL, 1.0)
        session.run(3.0)
        payload = session.state.touch.payload
    assert payload.status == pp.Status.ok and abs(payload.mass - MASS) < 0.02 * MASS
    assert driver.state == "closed"


def test_a_driver_that_was_connected_before_stays_connected():
    driver = StillArm()
    with driver:
        with stepped(driver) as session:
            session.enable()
        assert driver.state == "connected"
        assert driver.stops[0] == "connected"  # stopped, though


@pytest.mark.parametrize("verb", ["read", "write"])
def test_what_a_driver_complains_of_is_the_fault(verb, tmp_path):
    driver = StillArm()

    def fail(k: int) -> None:
        if k == 50:
            raise pp.DriverError("servo 3 does not answer")

    with pytest.raises(pp.DriverError, match="servo 3 does not answer.*last seconds are in .*box.mcap"):
        with stepped(driver, fault_log=tmp_path / "box.mcap", keep=0.1) as session:
            setattr(driver, f"on_{verb}", fail)
            session.enable()
            session.run(1.0)
    assert session.mode == "fault" and session.fault == "servo 3 does not answer"
    assert driver.state == "closed"
    log = pp.Log.open(tmp_path / "box.mcap")
    assert len(log) == 25
    assert [e.kind for e in log.events] == ["fault"]


def test_a_fault_without_a_file_name_leaves_one_that_the_error_names():
    driver = StillArm()
    with pytest.raises(pp.DriverError, match="palpate-fault-"):
        with stepped(driver) as session:
            driver.on_read = lambda k: 1 / 0 if k > 9 else None
            session.run(1.0)
    assert session.fault == "division by zero"
    assert len(pp.Log.open(session.fault_log)) == 9
    session.fault_log.unlink()


def test_a_recording_that_ends_in_a_fault_says_so(tmp_path):
    driver = StillArm()
    with pytest.raises(pp.DriverError, match="gone$"):
        with stepped(driver, record=tmp_path / "run.mcap") as session:

            def gone(k: int) -> None:
                if k > 30:
                    raise pp.DriverError("the connection is gone")

            driver.on_read = gone
            session.run(1.0)
    log = pp.Log.open(tmp_path / "run.mcap")
    assert len(log) == 30
    assert [(e.kind, e.text) for e in log.events] == [("fault", "the connection is gone")]
    assert session.fault_log is None


def test_answers_that_are_no_samples_are_a_fault():
    driver = StillArm()
    driver._read = lambda: Sample(1, np.zeros(3), None, np.zeros(7))
    session = stepped(driver, fault_log="/nonexistent/box.mcap")
    with pytest.raises(pp.DriverError, match="position: expected 7 numbers, got 3"), session:
        session.run(0.1)


def test_a_disk_that_fails_does_not_stop_the_arm(tmp_path):
    class Full(pp.Recorder):
        def sample(self, time_ns, *rest):
            if time_ns > 100_000_000:
                raise pp.LogError("the disk is full")

    recorder = Full(tmp_path / "run.mcap", ARM.joint_names)
    session = Session(ARM, SimulatedArm(ARM), controller=controller(), record=recorder, simulated_time=True)
    with pytest.raises(pp.LogError, match="the disk is full"), session:
        session.enable()
        session.run(1.0)
        assert session.mode == "enabled"
    assert session.statistics.samples > 1000


def test_missing_samples_end_it_when_patience_is_over():
    driver = StillArm()
    real = driver._read
    driver._read = lambda: None if driver.reads > 50 and (driver.reads + 1) else real()
    with pytest.raises(pp.DriverError, match="no usable sample for.*could not be kept: /nonexistent"):
        with stepped(driver, patience=0.1, fault_log="/nonexistent/x.mcap") as session:
            session.enable()
            session.run(1.0)
            driver.reads = 100
            session.run(1.0)


# --- with a thread: waits for conditions, judges no time -----------------------------------------------------------


def test_a_thread_records_all_it_did(tmp_path):
    simulated = SimulatedArm(ARM, rate=500)
    simulated.hold(MASS)
    with Session(
        ARM,
        simulated,
        controller=controller(),
        record=tmp_path / "run.mcap",
        realtime=PLAIN,
        patience=100.0,
        lease=0.0,
        buffer=60.0,
    ) as session:
        assert session.realtime.complaint == ""
        session.enable()
        session.move_to(GOAL, 0.5)
        while session.statistics.samples < 600:
            session.run(0.02)
    statistics = session.statistics
    assert statistics.records_dropped == 0
    assert len(pp.Log.open(tmp_path / "run.mcap")) == statistics.samples
    assert session.mode == "stopped"


def test_a_python_driver_is_waited_for_without_the_lock():
    driver = StillArm()
    driver.on_read = lambda k: time.sleep(0.002)
    with Session(ARM, driver, controller=controller(), realtime=PLAIN, patience=100.0, lease=0.0) as session:
        session.enable()
        while driver.writes < 20:
            session.run(0.01)
        session.disable()
        assert driver.state == "connected"
    assert driver.state == "closed"


def test_an_interpreter_that_hangs_loses_the_arm():
    session = Session(
        ARM, SimulatedArm(ARM), controller=controller(), realtime=PLAIN, patience=1e4, lease=0.05
    )
    session.start()
    try:
        session.enable()
    except pp.DriverError:  # this computer is so slow that it happened before
        assert "shown no life" in session.fault
    held = ctypes.PyDLL(None)  # calls by it keep the interpreter's lock
    while session.mode == "enabled":
        held.usleep(200_000)
    assert session.mode == "fault" and "shown no life" in session.fault
    session.close()
    session.fault_log.unlink()


def test_a_program_that_ends_without_closing_stops_the_arm():
    script = f"""
import sys, time
sys.path[:0] = {sys.path!r}
import test_session as t
class Told(t.StillArm):
    def _disable(self):
        print("stopped", flush=True)
driver = Told()
driver.on_read = lambda k: time.sleep(0.002)
session = t.Session(t.ARM, driver, controller=t.controller(), realtime=t.PLAIN, patience=1e4, lease=0.0)
session.start()
session.enable()
while driver.writes < 5:
    time.sleep(0.001)
raise SystemExit(3)
"""
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=200, check=False
    )
    assert done.returncode == 3, done.stderr
    assert done.stdout.split()[0] == "stopped"


def test_a_forgotten_session_stops_the_arm():
    driver = StillArm()
    driver.on_read = lambda k: time.sleep(0.002)
    session = Session(ARM, driver, controller=controller(), realtime=PLAIN, patience=1e4, lease=0.0)
    session.start()
    session.enable()
    del session
    while not driver.stops:
        time.sleep(0.001)


def test_what_the_system_refuses_is_said_and_it_runs_without():
    refused = Realtime(priority=1000, lock_memory=False, processor=100_000)
    with Session(ARM, SimulatedArm(ARM), realtime=refused, lease=0.0) as session:
        granted = session.realtime
        assert not granted.fifo and not granted.pinned
        assert "SCHED_FIFO" in granted.complaint and "processor" in granted.complaint
        while session.state is None:
            session.run(0.001)


# --- bad input -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"patience": 0.0}, "patience"),
        ({"grace": -1.0}, "grace"),
        ({"keep": 0.0}, "keep"),
        ({"buffer": float("nan")}, "buffer"),
        ({"limiter": pp.SafetyLimiter(ARM)}, "limiter without a controller"),
        ({"pipeline": pp.Pipeline(robots.load("kuka_lbr_iiwa7"))}, "another arm"),
    ],
)
def test_options_out_of_range(options, words):
    with pytest.raises(pp.InputError, match=words):
        Session(ARM, SimulatedArm(ARM), **options)


@pytest.mark.parametrize("rate", [0.0, -1.0, float("inf"), float("nan")])
def test_a_simulated_arm_needs_a_rate(rate):
    with pytest.raises(pp.InputError, match="rate"):
        SimulatedArm(ARM, rate=rate)


def test_a_simulated_arm_refuses_what_is_no_load_or_push():
    simulated = SimulatedArm(ARM)
    for mass in (-1.0, float("nan"), float("inf")):
        with pytest.raises(pp.InputError, match="mass"):
            simulated.hold(mass)
    for force in ([1.0, 2.0], [1.0, 2.0, float("nan")]):
        with pytest.raises(pp.InputError, match="force"):
            simulated.push(force)
    with pytest.raises(pp.InputError, match="position: expected 7"):
        SimulatedArm(ARM, q=[0.0])


def test_a_driver_of_another_arm_is_refused():
    with pytest.raises(pp.InputError, match="joints"):
        Session(ARM, SimulatedArm(robots.load("kuka_lbr_iiwa7")))
    with pytest.raises(pp.InputError, match="effort"):
        Session(ARM.replace(effort=pp.Effort.current(1.0, 100.0)), StillArm())


def test_verbs_that_do_not_fit_the_moment():
    watching = Session(ARM, SimulatedArm(ARM), simulated_time=True)
    with watching:
        with pytest.raises(pp.InputError, match="only watches"):
            watching.enable()
        with pytest.raises(pp.DriverError, match="started once"):
            watching.start()
    session = stepped(StillArm())
    with session:
        with pytest.raises(pp.DriverError, match="enable\\(\\) first"):
            session.move_to(GOAL)
        session.enable()
        for bad in ([1.0], [float("nan")] * 7, "here"):
            with pytest.raises((pp.InputError, ValueError)):
                session.move_to(bad)
        with pytest.raises(pp.InputError, match="outside its limits"):
            session.move_to([9.0] * 7)
        for duration in (0.0, -1.0, float("nan")):
            with pytest.raises(pp.InputError, match="duration"):
                session.move_to(GOAL, duration)
        with pytest.raises(pp.InputError, match="speed"):
            session.move_to(GOAL, speed=0.0)
        with pytest.raises(pp.InputError, match="kp"):
            session.set_gains(-1.0, 1.0)
        with pytest.raises(pp.InputError, match="run"):
            session.run(-1.0)
        session.stop()
        with pytest.raises(pp.DriverError, match="stopped"):
            session.tare()
    session.close()
    with pytest.raises(pp.DriverError):
        session.start()
