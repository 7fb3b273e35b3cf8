"""The live page without a browser: what is shown, how it moves, what it remembers."""

from __future__ import annotations

import math
import socket
import time
from dataclasses import replace

import numpy as np
import pytest

from palpate import DriverError, InputError, Pipeline, robots, weigh
from palpate._core import Status
from palpate.cli import main
from palpate.cli.view import address
from palpate.drivers import Driver
from palpate.logs import Log
from palpate.view import (
    Channels,
    ForceView,
    History,
    Holds,
    Motion,
    Moves,
    Plays,
    Powers,
    Pushable,
    RealArm,
    Recording,
    Records,
    Scale,
    ShownArm,
    SimulatedArm,
    Tunes,
    check_address,
)
from palpate.view.history import thinned
from palpate.view.live import BRAKING_S
from palpate.view.scene import contact_badge, drawn_force, link_frames, lit_links, mass_badge, mass_range

RATE = 250.0


@pytest.fixture(scope="module")
def scene():
    return weigh.scene(weigh.load_arm("justina_left_arm"))


def task(scene, rate=RATE, **options):
    return weigh.Task(
        scene=scene, start=scene.poses["Zero"], poses=(scene.poses["Take3"],), rate=rate, **options
    )


@pytest.fixture
def arm(scene, tmp_path):
    """A simulated arm whose clock is the test."""
    source = SimulatedArm(weigh.simulated_driver(task(scene)), scene, out=tmp_path, mass=0.25)
    source.connect()
    yield source
    source.stop()


def run(source, seconds, rate=RATE):
    for _ in range(round(seconds * rate)):
        reading = source.tick()
    return reading


@pytest.fixture(scope="module")
def lifted(scene):
    """A reading of an arm that has lifted 250 g."""
    source = SimulatedArm(weigh.simulated_driver(task(scene)), scene, mass=0.25)
    source.send("Take3")
    source.connect()
    reading = run(source, 5.0)
    source.stop()
    return reading


def with_payload(reading, **changes):
    return replace(reading, touch=replace(reading.touch, payload=replace(reading.touch.payload, **changes)))


# --- curves ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("chunk", [1, 7, 33, 5000])
def test_a_history_keeps_every_spike_however_it_is_fed(chunk):
    rng = np.random.default_rng(1)
    t = np.cumsum(rng.uniform(0.5e-3, 1.5e-3, 20_000))
    v = rng.normal(size=(len(t), 3))
    v[12_345, 1], v[19_990, 0] = 50.0, -50.0
    history = History(3, spans=(10.0, 60.0), points=100)
    for i in range(0, len(t), chunk):
        history.add(t[i : i + chunk], v[i : i + chunk])
    for span, points in ((10.0, 100), (60.0, 100)):
        time_s, values = history.curves(span)
        assert len(time_s) <= 2 * (points + 1) and np.all(np.diff(time_s) > 0.0)
        inside = t >= time_s[0]
        assert np.array_equal(values.max(axis=0), v[inside].max(axis=0))
        assert np.array_equal(values.min(axis=0), v[inside].min(axis=0))
        whole = History(3, spans=(10.0, 60.0), points=100)
        whole.add(t, v)
        assert np.array_equal(np.nan_to_num(whole.curves(span)[1]), np.nan_to_num(values))


def test_a_history_does_not_grow():
    history = History(4)
    rings = [
        a.nbytes for level in history._levels.values() for a in vars(level).values() if hasattr(a, "nbytes")
    ]
    for hour in range(3):
        t = hour * 3600.0 + np.arange(0.0, 3600.0, 0.1)
        history.add(t, np.random.default_rng(hour).normal(size=(len(t), 4)))
    assert rings == [
        a.nbytes for level in history._levels.values() for a in vars(level).values() if hasattr(a, "nbytes")
    ]
    time_s, _ = history.curves(3600.0)
    assert 3590.0 < time_s[-1] - time_s[0] <= 3640.0


def test_a_history_begins_anew_where_time_steps_back_and_takes_nothing_for_nothing():
    history = History(1)
    history.add([], np.empty((0, 1)))
    assert len(history.curves(10.0)[0]) == 0
    history.add([5.0, 6.0, 7.0], [[1.0], [np.nan], [3.0]])
    assert np.nanmax(history.curves(10.0)[1]) == 3.0
    history.add([1.0, 2.0], [[8.0], [9.0]])
    time_s, values = history.curves(10.0)
    assert time_s[-1] < 2.1 and values.min() == 8.0
    history.add([3.0, 1.5, 1.6], [[1.0], [2.0], [3.0]])
    assert history.curves(10.0)[1].min() == 2.0


def test_thinning_keeps_the_extremes_and_short_curves():
    t = np.linspace(0.0, 100.0, 50_000)
    v = np.column_stack((np.sin(t), np.cos(t)))
    v[777, 0] = 9.0
    time_s, values = thinned(t, v, 100)
    assert len(time_s) <= 202 and values[:, 0].max() == 9.0 and np.all(np.diff(time_s) > 0.0)
    assert thinned(t[:50], v[:50], 100)[0] is not None and len(thinned(t[:50], v[:50], 100)[0]) == 50
    still = thinned(np.zeros(1000), v[:1000], 100)
    assert np.isfinite(still[0]).all()


# --- geometry -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", robots.names())
def test_links_are_drawn_where_the_core_has_them_and_none_is_left_out(name):
    arm = robots.load(name)
    rng = np.random.default_rng(2)
    for q in rng.uniform(-1.0, 1.0, (5, arm.n)):
        frames = link_frames(arm, q)
        assert np.allclose(frames[-1] @ arm.T_last_tip, arm.forward_kinematics(q), atol=1e-12)
    for model in (arm, arm.replace(shapes=())):
        assert {s.link for s in model.solid_shapes()} >= set(range(arm.n))
    straight = sum(np.linalg.norm(j.T_parent_joint[:3, 3]) for j in arm.joints)
    assert arm.reach >= straight > 0.0


@pytest.mark.parametrize("gravity", [(0, 0, -9.81), (0, 0, 9.81), (0, 9.81, 0), (3.0, -4.0, 5.0)])
def test_down_is_down_however_an_arm_is_mounted(gravity):
    arm = robots.load("kuka_lbr_iiwa7").replace(gravity=np.array(gravity, dtype=float))
    T = ShownArm("a", arm).placement
    assert np.allclose(T[:3, :3] @ arm.gravity / np.linalg.norm(gravity), [0, 0, -1], atol=1e-12)
    assert np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)


def test_a_cone_holds_the_direction_with_95_percent(scene, lifted):
    shown = ShownArm("a", scene.arm, usual_mass=0.25)
    rng = np.random.default_rng(3)
    for _ in range(5):
        F = rng.normal(size=3) * 10.0
        A = rng.normal(size=(3, 3)) * 0.3
        force = drawn_force(shown, lifted, F, A @ A.T)
        R_world_base = shown.placement[:3, :3]
        e = (force.tip - force.tail) / np.linalg.norm(force.tip - force.tail)
        assert np.allclose(e, R_world_base @ F / np.linalg.norm(F), atol=1e-9)
        assert np.allclose(force.R.T @ force.R, np.eye(3), atol=1e-9) and np.linalg.det(force.R) > 0.0
        length = np.linalg.norm(force.tip - force.tail)
        draws = (F + rng.normal(size=(20_000, 3)) @ A.T) @ R_world_base.T @ force.R
        slope = draws[:, :2] / draws[:, 2:] * length / np.array(force.half_axes)
        inside = np.mean((np.sum(slope**2, axis=1) <= 1.0) & (draws[:, 2] > 0.0))
        assert 0.93 < inside < 0.97


def test_a_force_is_shown_only_beyond_its_uncertainty_and_with_hysteresis(scene, lifted):
    shown, view = ShownArm("a", scene.arm), ForceView()

    def pushed(size, status=Status.ok):
        wrench = replace(
            lifted.touch.wrench, force=np.array([0.0, size, 0.0]), covariance=np.eye(6), status=status
        )
        return replace(lifted, touch=replace(lifted.touch, wrench=wrench))

    assert view.force(shown, pushed(3.5)) is None
    assert view.force(shown, pushed(5.0)) is not None
    assert view.force(shown, pushed(3.5)) is not None
    assert view.force(shown, pushed(2.0)) is None
    assert view.force(shown, pushed(3.5)) is None
    assert view.force(shown, pushed(50.0, Status.singular)) is not None
    for dead in (pushed(50.0, Status.warming), pushed(math.nan), replace(pushed(50.0), powered=False)):
        assert view.force(shown, dead) is None


# --- words ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("status", list(Status.__members__.values()))
def test_only_a_good_mass_is_green(lifted, status):
    reading = with_payload(lifted, status=status)
    badge = mass_badge(reading)
    assert (badge.tone == "green") == (status == Status.ok)
    assert badge.text and badge.detail
    assert mass_badge(reading, pushed=True).tone != "green"
    assert mass_badge(replace(reading, powered=False)).text == "drives off"
    row = Channels(7).row(reading)
    assert math.isnan(row[-2]) == (status != Status.ok) and len(row) == Channels(7).count


def test_a_tare_is_taken_off_and_its_uncertainty_added(lifted):
    scale = Scale()
    assert scale.weight(lifted).value.startswith(("249", "250"))
    assert "Only a good mass" in scale.tare(with_payload(lifted, status=Status.warming)) and not scale.tared
    assert scale.tare(None) and scale.tare(replace(lifted, powered=False))
    assert scale.tare(lifted) == ""
    more = with_payload(lifted, mass=float(lifted.touch.payload.mass) + 0.1, mass_std=3e-3)
    weight = scale.weight(more)
    assert weight.value == "100" and weight.unit == "g" and weight.tared.endswith("g")
    half = 1.96e3 * math.hypot(3e-3, float(lifted.touch.payload.mass_std))
    assert float(weight.half) == pytest.approx(half, abs=0.6)
    scale.clear()
    assert scale.weight(lifted).tared == ""


def test_what_nobody_knows_is_no_number(lifted):
    assert Scale().weight(replace(lifted, powered=False)).value == "–"
    vague = with_payload(lifted, mass=0.1, mass_std=1.0, status=Status.warming)
    assert Scale().weight(vague).value == "–"


def test_the_mass_curve_is_scaled_by_what_is_sure():
    mass = np.array([0.25, 0.25, -80.0, 0.25])
    good = np.array([0.25, 0.25, np.nan, 0.25])
    low, high, true = mass - 0.01, mass + 0.01, np.full(4, np.nan)
    bottom, top = mass_range(mass, low, high, good, true)
    assert 0.2 < bottom < 0.25 < top < 0.3
    nothing = np.full(4, np.nan)
    assert mass_range(nothing, nothing, nothing, nothing, nothing) == (0.0, 1.0)


# --- motion ---------------------------------------------------------------------------------------------------------


def test_a_motion_arrives_slows_down_and_never_leaps(scene):
    start, goal = scene.poses["Zero"], scene.poses["Take3"]
    motion, dt = Motion(scene, RATE, start), 1.0 / RATE
    assert motion.resting
    motion.go(goal)
    points = [motion.step(dt) for _ in range(500)]
    motion.halt()
    points += [motion.step(dt) for _ in range(round(BRAKING_S * RATE) + 2)]
    assert motion.resting and np.all(points[-1].dq == 0.0) and np.linalg.norm(points[-1].q - goal) > 0.05
    motion.go(scene.poses["Zero"])
    points += [motion.step(dt) for _ in range(200)]
    motion.go(goal)  # under way: it slows down, then turns round
    points += [motion.step(dt) for _ in range(1500)]
    assert np.allclose(points[-1].q, goal) and motion.resting
    q, dq, ddq = (np.array([p[k] for p in points]) for k in range(3))
    assert np.max(np.abs(np.diff(q, axis=0))) < 2.0 * dt
    assert np.max(np.abs(np.diff(dq, axis=0))) < 5.0 * dt
    assert np.allclose(np.diff(q, axis=0), 0.5 * dt * (dq[1:] + dq[:-1]), atol=2e-5)
    assert np.isfinite(ddq).all()


# --- the live arm, its clock being the test -------------------------------------------------------------------------


def test_an_arm_lifts_and_weighs(arm):
    assert isinstance(arm, Moves) and isinstance(arm, Holds) and isinstance(arm, Pushable)
    assert isinstance(arm, Records) and isinstance(arm, Tunes)
    assert not isinstance(arm, Plays) and not isinstance(arm, Powers)
    arm.go(0, "take3")
    reading = run(arm, 5.0)
    assert np.allclose(reading.touch.q, arm.arms[0].poses["Take3"], atol=0.05)
    weight = Scale().weight(reading)
    assert weight.badge.tone == "green" and reading.true_mass == 0.25
    assert abs(reading.touch.payload.mass - 0.25) < 0.005
    time_s, rows = arm.curves(0, 10.0)
    assert 4.9 < time_s[-1] < 5.1 and rows.shape[1] == Channels(7).count
    assert arm.state.text.startswith("simulated")
    with pytest.raises(InputError, match="no pose"):
        arm.go(0, "nowhere")
    with pytest.raises(InputError, match="outside its limits"):
        arm.go(0, "9,0,0,0,0,0,0")


def test_a_push_is_told_from_the_load(arm):
    arm.go(0, "Take3")
    run(arm, 5.0)
    arm.push(0, "left_arm_link7", (0.0, 6.0, 0.0))
    view, shown = ForceView(), arm.arms[0]
    run(arm, 1.0)
    reading = run(arm, 0.2)
    force = view.force(shown, reading)
    assert force is not None
    e = (force.tip - force.tail) / np.linalg.norm(force.tip - force.tail)
    assert e[1] > 0.8
    assert mass_badge(reading, pushed=True).tone != "green"
    arm.push(0, "left_arm_link7", (0.0, 0.0, 0.0))
    with pytest.raises(InputError, match="no frame"):
        arm.push(0, "elbow", (1.0, 0.0, 0.0))
        arm.tick()


def test_a_grasped_object_becomes_a_load_and_is_no_contact_for_ever():
    scene = weigh.scene(weigh.load_arm("kuka_lbr_iiwa7"))
    plan = weigh.Task(
        scene=scene, start=scene.poses[scene.start], poses=(scene.poses[scene.pose],), rate=RATE
    )
    source = SimulatedArm(weigh.simulated_driver(plan), scene, mass=2.0)
    source.send(scene.pose)
    source.connect()
    states = [source.tick() for _ in range(round(6.0 * RATE))]
    source.stop()
    felt = [lit_links(r)[0] >= 0 for r in states]
    assert any(felt[: round(2.0 * RATE)]), "2 kg that nobody knows of are a contact at first"
    assert not any(felt[-round(2.0 * RATE) :])
    assert contact_badge(source.arms[0], states[-1]).text == "free"


def test_a_recording_replays_bit_for_bit(arm):
    arm.go(0, "Take3")
    run(arm, 2.0)
    path = arm.record()
    assert arm.recording == path == arm.record()
    with pytest.raises(InputError, match="end the recording first"):
        arm.tune(0, arm.options(0))
    run(arm, 3.0)
    assert arm.end_recording() == path and arm.recording is None and arm.end_recording() is None
    again = arm.record()
    assert again != path and again.parent == path.parent
    run(arm, 0.1)
    arm.stop()
    found = weigh.replay(Log.open(path, keep_invalid=True))
    assert found.same and found.compared == round(3.0 * RATE)
    assert len(Log.open(again)) == round(0.1 * RATE)


def test_parameters_change_live_and_wrong_ones_are_refused(arm):
    options = arm.options(0)
    options["observer"] = {"name": "momentum", "bandwidth": 12.0}
    arm.tune(0, options)
    run(arm, 0.2)
    assert arm.options(0)["observer"]["bandwidth"] == 12.0
    options["observer"] = {"name": "momentum", "bandwidth": -1.0}
    with pytest.raises(InputError):
        arm.tune(0, options)
    with pytest.raises(InputError, match="mass must be"):
        arm.hold(0, -1.0)
    arm.hold(0, 0.5)
    assert arm.held(0) == 0.5 and run(arm, 0.1).true_mass == 0.5


def test_a_real_arm_rests_until_its_drives_are_on(scene):
    driver = weigh.simulated_driver(task(scene))
    source = RealArm(driver, scene)
    source.connect()
    assert isinstance(source, Powers) and not source.powered
    reading = run(source, 0.2)
    assert not reading.powered and mass_badge(reading).text == "drives off" and lit_links(reading) == (-1, -1)
    with pytest.raises(DriverError, match="drives are off"):
        source.go(0, "Take3")
    source.halt(0)
    source.power(True)
    reading = run(source, 1.0)
    assert source.powered and reading.powered
    assert np.allclose(reading.touch.q, scene.poses["Zero"], atol=0.1)
    source.go(0, "Take3")
    run(source, 1.0)
    source.power(False)
    assert not run(source, 0.1).powered
    source.stop()
    assert driver.state == "closed"


class Broken(Driver):
    """An arm that is lost after some samples, until it is connected again."""

    def __init__(self, inner, samples):
        super().__init__(inner.joint_names, inner.period_ns, inner.effort)
        self._inner, self._samples, self.left = inner, samples, 0

    def _connect(self):
        self.left = self._samples
        self._inner.connect()

    def _read(self):
        self.left -= 1
        if self.left < 0:
            raise DriverError("the cable is out")
        return self._inner.read()

    def _write(self, torque):
        return self._inner.write(torque)

    def _enable(self):
        self._inner.enable()

    def _disable(self):
        self._inner.disable()

    def _close(self):
        self._inner.close()


def wait_for(condition, what, seconds=120.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, what
        time.sleep(0.01)


def test_a_lost_arm_is_said_and_found_again(scene):
    driver = Broken(weigh.simulated_driver(task(scene)), 50)
    source = RealArm(driver, scene)
    source.start()
    wait_for(lambda: source.state.tone == "red", "the loss is seen")
    assert "the cable is out" in source.state.detail and driver.state == "closed"
    assert any("the cable is out" in text for text in source.messages()) and not source.messages()
    driver._samples = 10**9
    source.power(True)
    wait_for(lambda: source.powered, "the arm is back")
    wait_for(lambda: source.state.tone == "green", "it says so")
    source.stop()
    source.stop()
    assert driver.state == "closed"


def test_the_loop_runs_by_itself_and_does_what_is_wished(scene, tmp_path):
    source = SimulatedArm(weigh.simulated_driver(task(scene, 1000.0)), scene, out=tmp_path, speed=None)
    source.start()
    source.start()
    source.hold(0, 0.1)
    wait_for(
        lambda: source.reading(0) is not None and source.reading(0).true_mass == 0.1, "the object is held"
    )
    source.record()
    wait_for(lambda: source.reading(0).time > 1.0, "time goes on")
    path = source.recording
    source.stop()
    assert len(Log.open(path)) > 10 and source.recording is None


# --- recordings -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def log(scene, tmp_path_factory):
    path = tmp_path_factory.mktemp("view") / "run.mcap"
    plan = weigh.Task(
        scene=scene,
        start=scene.poses["Zero"],
        poses=(scene.poses["Take3"],),
        loads=((0.0, 0.25),),
        duration=6.0,
    )
    weigh.run(plan, weigh.make_pipeline(scene.arm)[0], record=path)
    return Log.open(path, keep_invalid=True)


def test_a_recording_is_gone_through_by_its_clock(log):
    now = [0.0]
    source = Recording(log, clock=lambda: now[0])
    assert isinstance(source, Plays) and isinstance(source, Tunes)
    assert not isinstance(source, Moves) and not isinstance(source, Records) and not isinstance(source, Holds)
    source.start()
    now[0] = 2.0
    assert source.position == 2.0 and source.playing and "2.0 of 6.0" in source.state.text
    source.pace(2.0)
    now[0] = 3.0
    assert source.position == 4.0
    source.play(False)
    now[0] = 50.0
    assert source.position == 4.0 and not source.playing
    source.seek(99.0)
    assert source.position == source.duration
    source.play(True)
    assert source.position == 0.0
    now[0] = 99.0
    assert not source.playing and source.position == source.duration
    with pytest.raises(InputError, match="speed"):
        source.pace(0.0)


def test_a_recording_shows_what_the_pipeline_says(log):
    source = Recording(log)
    source.play(False)
    whole = Pipeline.from_options(source.arms[0].arm, source.options(0)).run(log)
    for position in (0.0, 1.0, 3.3, 6.0):
        source.seek(position)
        reading = source.reading(0)
        row = int(np.searchsorted(log.seconds, position, side="right")) - 1
        assert reading.time == log.seconds[row]
        assert reading.touch.payload.mass == whole.payload.mass[row]
        assert np.array_equal(reading.touch.q, whole.q[row]) and reading.true_mass == 0.25
    assert source.spans == (math.inf,)
    time_s, rows = source.curves(0, math.inf)
    assert len(time_s) <= 482 and rows.shape[1] == Channels(7).count
    assert not any(
        lit_links(r)[0] >= 0 for r in map(lambda p: (source.seek(p), source.reading(0))[1], range(6))
    )
    options = source.options(0)
    options["observer"] = {"name": "momentum", "bandwidth": 12.0}
    source.tune(0, options)
    assert source.options(0)["observer"]["name"] == "momentum"


def test_an_empty_log_is_refused(log):
    with pytest.raises(InputError, match="no samples"):
        Recording(log[0:0])


# --- the command ----------------------------------------------------------------------------------------------------


def test_addresses():
    assert address("8081") == ("127.0.0.1", 8081)
    assert address("0.0.0.0:80") == ("0.0.0.0", 80) and address("[::1]:8080") == ("::1", 8080)
    for wrong in ("", "host", "host:", "1.2.3.4:99999", "-1"):
        with pytest.raises(InputError, match="--listen"):
            address(wrong)


def test_a_taken_port_is_said_with_what_to_do(capsys):
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        with pytest.raises(InputError, match=f"127.0.0.1:{port}.*--listen"):
            check_address("127.0.0.1", port)
        pytest.importorskip("viser", reason="the page needs the extra view")
        assert main(["view", "--listen", str(port)]) == 2
    assert f"--listen {8081}" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--listen", "nowhere:x"], "--listen"),
        (["--port", "/dev/null"], "--port is for a real arm"),
        (["--columns", "c.yaml"], "--columns is for a LOG"),
        (["run.mcap", "--mass", "1"], "--mass is for a simulation"),
        (["--driver", "dynamixel"], "--driver needs --arm"),
        (["--arm", "justina_left_arm", "--driver", "dynamixel"], "--port"),
        (["--pose", "nowhere"], "no pose"),
        (["--mass", "-1"], "mass must be"),
        (["missing.mcap"], "missing.mcap"),
        (["--arm", "no_such_arm"], "no arm"),
    ],
)
def test_wrong_input_is_one_line(arguments, expected, capsys):
    assert main(["view", *arguments]) == 2
    error = capsys.readouterr().err
    assert expected in error and error.count("\n") == 1
