"""The whole job of wiping: seeing, holding, wiping, checking, and what it does when something goes wrong."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("cv2", reason="palpate[vision] is not installed")
pytest.importorskip("mujoco", reason="palpate[sim] is not installed")
pytest.importorskip("shapely", reason="palpate[wipe] is not installed")
pytest.importorskip("statemachine", reason="palpate[wipe] is not installed")

from palpate import vision, wipe
from palpate.errors import InputError, PalpateError
from palpate.wipe import activity, boards, fast, job, mediator, motion, slow

UP = np.zeros(7)


def made(*, seed=0, **setting):
    """A small board with two short strokes of a pen."""
    ink = wipe.InkLayer((0.42, 0.30))
    ink.stroke([[0.18, 0.14], [0.22, 0.14]], width=0.006)
    ink.stroke([[0.19, 0.16], [0.23, 0.16]], width=0.006, colour="red")
    scene = wipe.BoardScene(ink, wipe.Setting(centre=(0.60, 0.0, 0.15), seed=seed, **setting))
    try:
        scene.look()
    except PalpateError as error:
        if "OpenGL" in str(error):
            pytest.skip(f"no OpenGL here: {error}")
        raise
    return scene


class Script(wipe.Observer):
    """Does things so many seconds after the eraser first slides."""

    def __init__(self, *steps):
        self.steps = sorted(steps, key=lambda s: s[0])
        self.first = None
        self.ticks = []

    def tick(self, tick):
        self.ticks.append(tick)
        if self.first is None and tick.phase == "slide":
            self.first = tick.time_ns
        while self.first is not None and self.steps and tick.time_ns >= self.first + 1e9 * self.steps[0][0]:
            self.steps.pop(0)[1]()

    def since(self, seconds, until=np.inf):
        return [t for t in self.ticks if seconds <= (t.time_ns - self.first) * 1e-9 < until]


def run(scene, *steps, **options):
    work = wipe.WipeJob(scene, wipe.JobOptions(**{"hold": "never", "look_every": 0.0, **options}))
    script = Script(*((at, lambda do=do: do(scene, work)) for at, do in steps))
    return work, script, work.run(observer=script)


def told(result, words):
    return [e.text for e in result.events if words in e.text]


# -- pieces ----


class Counter(activity.Activity):
    steps = 0

    def step(self, time_ns):
        self.steps += 1


def test_an_activity_goes_through_its_life_in_order_and_works_only_when_it_may():
    a, states = Counter("counter", 1000), []
    a.told = lambda name, state: states.append(state)
    a.cycle(0)
    assert a.steps == 0 and a.state == "creating"
    a.begin()
    a.cycle(0)
    a.send("pause")
    a.cycle(1)  # keeps things safe
    assert a.steps == 2
    a.finish()
    a.finish()
    a.cycle(2)
    assert a.steps == 2
    assert states == ["configuring", "pausing", "running", "pausing", "cleaning", "done"]
    with pytest.raises(Exception, match="[Cc]an't"):
        a.send("start")


def test_a_slot_gives_each_value_once_to_who_takes_and_again_to_who_looks():
    slot = activity.Slot()
    assert slot.take() is None and slot.newest is None
    for value in ("a", "a", "b"):
        slot.put(value)
        assert slot.newest == value
        assert slot.take() == value and slot.take() is None
        assert slot.newest == value
    slot.put("c")
    slot.put("d")
    assert slot.take() == "d"


def test_a_way_keeps_clear_and_is_told_when_there_is_none():
    start, goal, via = np.array([-1.0, 0.0]), np.array([1.0, 0.0]), np.array([0.0, 1.0])

    def around(q):
        return float(np.linalg.norm(q)) - 0.4

    path = motion.find(start, goal, [via], around)
    assert path is not None and len(path.poses) == 3
    for t in np.linspace(0.0, path.duration, 200):
        assert around(path.sample(t).q) > 0.0
    assert motion.find(start, goal, [], around) is None
    straight = motion.find(start, goal, [via], lambda q: 1.0)
    assert straight is not None and len(straight.poses) == 2
    end = straight.sample(straight.duration + 1.0)
    np.testing.assert_array_equal(end.q, goal)
    np.testing.assert_array_equal(end.dq, 0.0)


def test_the_same_seed_is_the_same_board():
    (a, s), (b, t), (c, _) = boards.random_board(3), boards.random_board(3), boards.random_board(4)
    assert s == t and np.array_equal(a.amount, b.amount) and a.area > 0.0
    assert a.amount.shape != c.amount.shape or not np.array_equal(a.amount, c.amount)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"speed": 0.0}, "speed"),
        ({"speed": 100.0}, "at most 0.25 m/s"),
        ({"normal_force": 5.0}, "normal_force"),
        ({"passes": 0}, "passes"),
        ({"hold": "perhaps"}, "always, needed, never"),
        ({"max_force": float("nan")}, "max_force"),
        ({"look_every": -1.0}, "look_every"),
    ],
)
def test_options_out_of_range_are_refused(wrong, words):
    with pytest.raises(InputError, match=words):
        wipe.JobOptions(**wrong)


def test_the_robot_floats_and_brakes_without_a_fresh_command():
    scene = wipe.BoardScene(wipe.InkLayer((0.42, 0.30)))
    q = np.array([0.0, 0.6, 0.0, -1.5, 0.0, 1.0, 0.0])
    scene.reset(q, UP)
    robot = fast.Robot(scene, 4_000_000, activity.Slot(), 24_000_000, 0)
    robot.begin()
    for _ in range(125):
        robot.cycle(scene.time_ns)
        scene.step(*robot.sent, 4_000_000)
        robot.read()
    assert robot.orphaned
    (now, dq), (other, _) = scene.state
    assert np.abs(now - q).max() < 0.01 and np.abs(dq).max() < 0.05 and np.abs(other).max() < 0.01


def test_a_pale_speck_is_a_rest_where_ink_was_and_dust_elsewhere():
    scene = made()
    eye = slow.Perception(scene, 100_000_000, False)
    eye.begin()

    def look(why):
        eye.question.put(why)
        for k in range(slow.FRAMES):
            eye.step(k * 100_000_000)
        return eye.answer.take().sight

    assert len(look("before").ink_polygons) == 2
    scene.ink.amount[:] = 0.0
    assert not look("after").ink_polygons
    for x, y in ((0.20, 0.14), (0.20, 0.24)):  # on the black stroke, and where no ink was
        j, i = round(x / scene.ink.texel), round(y / scene.ink.texel)
        scene.ink.amount[i - 1 : i + 2, j - 1 : j + 2] = 0.07
        scene.ink.colour[i - 1 : i + 2, j - 1 : j + 2] = 32.0
    (rest,) = look("after").ink_polygons
    np.testing.assert_allclose(rest.mean(0), [0.20, 0.14], atol=0.004)


# -- jobs ----


def test_a_short_job_from_pixels_to_a_clean_board_with_a_pause_in_it():
    scene = made()
    work, script, result = run(
        scene,
        (0.3, lambda s, w: w.pause()),
        (1.3, lambda s, w: w.resume()),
    )
    assert result.verdict == "clean" and not result.resumable and result.reason == ""
    assert result.ink_left == 0.0 and result.ink_after == scene.ink.area == 0.0
    assert result.before.sight.dirty and not result.after.sight.ink_polygons
    (only,) = result.passes
    assert told(result, f"pass 1: {only.plan.summary}, about")
    assert only.plan.summary.startswith("1 stroke of ")
    # the bounds hold, felt by nothing but the joints
    track = result.track
    assert track.force.max() <= 5.0 and track.moment.max() <= 2.0
    assert track.contact.max() <= 6.0
    assert track.within(0.5) >= 0.95
    # in the pause the eraser rests where it is and still presses gently
    paused = script.since(0.9, 1.25)
    assert np.ptp([t.T_world_tool[:3, 3] for t in paused], axis=0).max() < 2e-3
    assert max(abs(t.true_normal - t.wanted_force) for t in paused) < 1.0
    assert {t.activities["control"] for t in script.since(0.5, 1.2)} == {"pausing"}
    assert {t.activities["robot"] for t in script.since(0.5, 1.2)} == {"running"}
    # every activity lived its life
    for name, period in job.PERIODS_NS.items():
        mine = [e.text.rsplit(" ", 1)[1] for e in result.events if e.text.startswith(f"{name} is ")]
        assert mine[:3] == ["configuring", "pausing", "running"] and mine[-2:] == ["cleaning", "done"]
        assert result.timing[name].period == pytest.approx(period * 1e-9)
        cycles = result.simulated / (period * 1e-9)
        assert result.timing[name].cycles == pytest.approx(cycles, abs=2)
    assert result.coverage[135:165, 180:230].min() > 0.0 and result.coverage[:40].max() == 0.0
    with pytest.raises(InputError, match="ended"):
        work.run()
    scene.close()


def test_a_lost_torque_channel_stops_the_arm_in_one_cycle_and_it_says_so():
    scene = made()

    def lose(s, w):
        s.torque_lost = True

    _, script, result = run(scene, (0.3, lose))
    assert result.verdict == "stopped" and result.resumable
    assert "torque channel" in result.reason
    after = script.since(0.3)
    # what was read without torque is answered with no force by the next cycle of control
    deaf = next(k for k, t in enumerate(after) if np.isnan(t.tau).any())
    assert all(np.linalg.norm(t.commanded) == 0.0 for t in after[deaf + 3 :])
    assert result.track.contact.max() <= 6.0
    scene.close()


def test_corners_tell_how_far_a_board_went_behind_an_arm():
    scene = made()
    T = scene.T_base_board(0)
    pose = wipe.tool_poses(np.array([[0.17, 0.15, 0.0]]), T, 0.0)[0]
    q = wipe.inverse_kinematics(scene.arms[0], pose)

    def look():
        image = scene.look()
        sight = vision.see(image, size=scene.ink.size, camera=scene.camera)
        return wipe.Look(0, image, sight, "check")

    reference = look()
    for far in (0.0, 0.05):
        scene.reset(q, UP)
        scene.carry_board([0.0, -far, 0.0])
        assert mediator.displacement(reference, look()) == pytest.approx(far, abs=0.004)
    scene.close()


@pytest.mark.slow
def test_the_same_seed_gives_the_same_run():
    ends = []
    for _ in range(2):
        scene = made()
        result = run(scene)[2]
        ends.append((result.track.normal, result.track.tool, result.events, scene.state[0][0]))
        scene.close()
    for a, b in zip(*ends, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.slow
def test_a_torque_channel_that_comes_back_lets_it_go_on_where_it_was():
    scene = made()
    result = run(
        scene,
        (0.3, lambda s, w: setattr(s, "torque_lost", True)),
        (0.8, lambda s, w: setattr(s, "torque_lost", False)),
    )[2]
    assert result.verdict == "clean" and result.ink_left == 0.0
    assert len(result.passes) == 1 and told(result, "goes on where it was")
    scene.close()


@pytest.mark.slow
def test_a_lost_eraser_is_named_and_the_job_goes_on_when_it_is_back():
    scene = made()
    work, _, result = run(scene, (0.3, lambda s, w: s.lose_eraser()))
    assert result.verdict == "stopped" and result.resumable and "eraser is lost" in result.reason
    scene.find_eraser()
    again = work.run()
    assert again.verdict == "clean" and again.ink_left == 0.0
    assert again.before is result.before and again.after.time_ns > result.after.time_ns
    assert len(again.track.time) > len(result.track.time)  # nothing of the log is lost
    scene.close()


@pytest.mark.slow
def test_a_board_that_was_taken_away_is_told_from_a_lost_eraser():
    scene = made()
    _, _, result = run(scene, (0.3, lambda s, w: s.carry_board([2.0, 0.0, -0.1])))
    assert result.verdict == "stopped" and result.resumable and "removed" in result.reason
    scene.close()


@pytest.mark.slow
def test_a_board_put_elsewhere_is_found_again():
    scene = made()
    result = run(scene, (0.3, lambda s, w: s.carry_board([0.0, 0.04, 0.0], 0.05)), look_every=0.5)[2]
    assert result.verdict == "clean" and result.ink_left == 0.0 and told(result, "found again")
    scene.close()


@pytest.mark.slow
def test_a_person_who_pushes_meets_no_force():
    scene = made()
    push = 30.0 * np.array([0.0, 0.8, 0.6])
    _, script, result = run(scene, (0.2, lambda s, w: s.push(push)), (0.7, lambda s, w: s.push(np.zeros(3))))
    during = script.since(0.25, 0.7)
    assert all(t.yielding and np.linalg.norm(t.commanded[:3]) == 0.0 for t in during)
    assert max(np.linalg.norm(t.true_force) for t in during) < 6.0
    assert result.verdict == "clean" and result.ink_left == 0.0
    scene.close()


@pytest.mark.slow
def test_a_board_that_slides_is_noticed_and_held():
    scene = made(friction=0.02)
    result = run(scene, hold="needed", look_every=0.5)[2]
    assert result.verdict == "clean" and result.ink_left == 0.0
    assert told(result, "the other arm holds the board")
    track = result.track
    moved = track.moved[track.held & np.isfinite(track.moved)]
    assert len(moved) and moved.max() < 3e-3
    scene.close()


@pytest.mark.slow
def test_a_stop_is_safe_and_what_is_left_is_wiped_later():
    scene = made()
    impatient = [(0.3 + 0.1 * k, lambda s, w: w.stop()) for k in range(20)]
    work, _, result = run(scene, *impatient)
    assert result.verdict == "stopped" and result.resumable and "person" in result.reason
    assert scene.contact_force @ scene.contact_force == 0.0  # lifted
    assert np.abs(scene.state[0][1]).max() < 0.02
    assert work.run().verdict == "clean"
    scene.close()


@pytest.mark.slow
def test_a_board_out_of_reach_is_told():
    ink = wipe.InkLayer((0.42, 0.30))
    ink.stroke([[0.15, 0.05], [0.25, 0.12]], width=0.006)
    scene = wipe.BoardScene(ink, wipe.Setting(centre=(0.80, 0.0, 0.15)))
    made().close()  # skips where there is no OpenGL
    result = run(scene)[2]
    assert result.verdict == "stopped" and not result.resumable and "out of reach" in result.reason
    scene.close()


@pytest.mark.slow
def test_a_board_out_of_reach_is_brought_nearer_by_the_arm_that_holds_it():
    made().close()  # skips where there is no OpenGL
    ink = wipe.InkLayer((0.50, 0.36))
    ink.stroke([[0.05, 0.03], [0.09, 0.04]], width=0.006)
    ink.stroke([[0.42, 0.04], [0.45, 0.04]], width=0.006)
    setting = wipe.Setting(centre=(0.68, 0.05, 0.15))
    scene = wipe.BoardScene(ink, setting)
    before = scene.T_world_board
    result = run(scene, hold="always")[2]
    assert result.verdict == "clean" and result.ink_left == 0.0 and result.track.contact.max() <= 6.0
    (text,) = told(result, "brings the board")
    assert "out of reach" in text and "nearer to the eraser's arm" in text
    moved = scene.T_world_board[:3, 3] - before[:3, 3]
    assert -0.14 < moved[0] < -0.02 and abs(moved[2]) < 2e-3 and scene.stands(scene.T_world_board)
    scene.close()
    # where nobody may take the board it says why not
    ink.stroke([[0.05, 0.03], [0.09, 0.04]], width=0.006)
    ink.stroke([[0.42, 0.04], [0.45, 0.04]], width=0.006)
    scene = wipe.BoardScene(ink, setting)
    result = run(scene)[2]
    assert (
        result.verdict == "stopped" and "out of reach" in result.reason and "no arm may take" in result.reason
    )
    scene.close()


@pytest.mark.slow
def test_dry_ink_takes_more_passes():
    scene = made()
    scene.ink.toughness[:] = 5.0 * wipe.ink.FRESH
    result = run(scene)[2]
    assert result.verdict == "clean" and result.ink_left == 0.0 and len(result.passes) == 3
    scene.close()


@pytest.mark.slow
def test_a_faint_mark_that_does_not_come_off_is_told_from_ink():
    scene = made()
    scene.ink.stroke([[0.30, 0.08], [0.34, 0.08]], width=0.006, amount=0.045, toughness=1e9)
    scene.ink.stroke([[0.30, 0.10], [0.34, 0.10]], width=0.006)
    result = run(scene)[2]
    assert result.verdict == "clean" and result.ink_left == 0.0
    assert "a faint mark that does not come off" in result.reason and len(result.passes) <= 2
    scene.close()


@pytest.mark.slow
def test_wall_time_gives_a_clean_board_too():
    scene = made()
    work = wipe.WipeJob(scene, wipe.JobOptions(hold="never", look_every=0.0))
    result = work.run(clock="wall")
    assert result.verdict == "clean" and result.ink_left == 0.0
    assert result.wall >= 0.99 * result.simulated
    scene.close()
