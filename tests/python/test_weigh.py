"""The application that weighs: simulated arms, logs, replay, and what it says when it cannot."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import palpate as pp
from palpate import weigh as W
from palpate.arm import Sensing
from palpate.logs import Signal
from palpate.weigh import weighing

MASS = 0.25


def trial(
    name: str = "justina_left_arm",
    *,
    pose: str | None = None,
    start: str | None = None,
    mass: float | None = None,
    record: Path | None = None,
    estimator: str | None = None,
    observer: str | None = None,
    **task: object,
) -> W.Trial:
    scene = W.scene(W.load_arm(name), mass=mass)
    held = scene.mass if mass is None else mass
    plan = W.Task(
        scene=scene,
        start=W.find_pose(scene, start or scene.start)[1],
        poses=(W.find_pose(scene, pose or scene.pose)[1],),
        **{"loads": ((0.0, held),), "duration": 5.0, **task},
    )
    pipeline, _ = W.make_pipeline(scene.arm, estimator, observer)
    return W.run(plan, pipeline, record=record)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[W.Trial, Path]:
    path = tmp_path_factory.mktemp("weigh") / "run.mcap"
    return trial(record=path), path


@pytest.fixture(scope="module")
def log(recorded: tuple[W.Trial, Path]) -> pp.Log:
    return pp.Log.open(recorded[1], keep_invalid=True)


# --- simulated ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("pose", ["StandBy", "StandBy2", "Take", "Take2", "Take3", "Take4", "goal"])
def test_weighs_a_quarter_kilogram_in_every_pose(pose: str) -> None:
    result = W.weigh_trial(trial(pose=pose, seed=3), pose=pose)
    assert result.status == result.estimator_status == pp.Status.ok
    assert abs(result.error_percent) < 0.5
    assert abs(result.mass - MASS) < 4.0 * result.mass_std
    assert result.time_to_2_percent < W.arrival(result.task)
    assert result.pose == pose and not result.interrupted


@pytest.mark.parametrize("name", pp.robots.names())
def test_every_reference_arm_weighs(name: str) -> None:
    result = W.weigh_trial(trial(name))
    assert result.status == pp.Status.ok
    assert abs(result.error_percent) < 2.0
    assert result.time_to_2_percent < 3.0
    assert result.goal_error < (
        0.1 if name == "abb_irb2400_16" else 0.02
    )  # dry friction holds that one short of it


def test_the_goal_is_reached_with_what_was_weighed() -> None:
    assert W.weigh_trial(trial(pose="Take3", duration=6.0)).goal_error < 0.01


def test_the_same_seed_gives_the_same_run_and_another_does_not() -> None:
    one, two, other = (trial(seed=s, duration=1.0) for s in (4, 4, 5))
    assert one.log == two.log
    assert np.array_equal(one.touch.payload.mass, two.touch.payload.mass)
    assert not np.array_equal(one.log.position, other.log.position)


def test_without_noise_positions_are_exact() -> None:
    ideal = trial(noise=False, duration=1.0)
    assert np.array_equal(ideal.log.position, ideal.log.signals["true_position"].value)
    noisy = trial(duration=1.0)
    off = np.abs(noisy.log.position - noisy.log.signals["true_position"].value)
    count = 2.0 * np.pi / 4096.0
    assert 2.0 * count < off.max() <= 2.5 * count + 1e-12


def test_nothing_in_the_hand_weighs_nothing() -> None:
    result = W.weigh_trial(trial(mass=0.0))
    assert result.status == pp.Status.ok
    assert abs(result.mass) < 2e-3
    assert np.isnan(result.error_percent) and np.isnan(result.time_to_2_percent)
    assert result.summary()["time_to_2_percent_s"] is None


@pytest.mark.parametrize(
    "name, mass",
    [
        ("kuka_lbr_iiwa14", 0.0),
        ("kuka_lbr_iiwa14", 1.0),
        ("kuka_lbr_iiwa14", 5.0),
        ("kuka_lbr_iiwa7", 5.0),
        ("abb_irb2400_16", 10.0),
        ("abb_irb2400_16", 20.0),
        ("justina_left_arm", 1.0),
    ],
)
def test_a_load_held_from_the_start_is_never_ok_with_a_wrong_number(name: str, mass: float) -> None:
    for seed in (0, 1):
        payload = trial(name, mass=mass, loads=((0.0, mass),), duration=3.0, seed=seed).touch.payload
        ok = payload.status == int(pp.Status.ok)
        error = np.abs(payload.mass - mass)[ok] / payload.mass_std[ok]
        assert np.count_nonzero(ok) > 400  # of 751
        assert np.max(error) < 5.0
        assert np.mean(error < W.weighing.TWO_SIDED_95) > 0.9
        assert payload.changes[-1] == 0


@pytest.mark.parametrize("pose", ["Take", "Take3", "goal"])
def test_what_the_arm_cannot_lift_is_not_ok(pose: str) -> None:
    result = W.weigh_trial(trial(mass=5.0, pose=pose, duration=8.0))
    assert result.status == pp.Status.saturated
    assert "cannot lift" in result.remarks[0] and "la_1_joint, which has 2.5 N m" in result.remarks[0]
    if result.estimator_status == pp.Status.ok:
        assert abs(result.error_percent) < 2.0


def test_an_arm_that_stops_short_still_weighs() -> None:
    result = W.weigh_trial(trial(pose="goal"))
    assert result.status == pp.Status.ok
    assert result.goal_error > 0.1
    assert "stops 0." in result.remarks[0] and "short of the pose: it takes" in result.remarks[0]


def test_a_hanging_arm_says_where_to_weigh() -> None:
    result = W.weigh_trial(trial(pose="Zero"))
    assert result.status in (pp.Status.warming, pp.Status.singular)
    assert "hides the weight" in result.remarks[0] and "--pose Take3" in result.remarks[0]


def test_goal_equal_to_start() -> None:
    result = W.weigh_trial(trial(start="Take3", pose="Take3", duration=3.0))
    assert result.status == pp.Status.ok and abs(result.error_percent) < 0.5
    assert result.time_to_2_percent < 1.0
    assert W.arrival(result.task) == 0.0


def test_taken_and_dropped() -> None:
    result = W.weigh_trial(trial(loads=((2.0, MASS), (6.0, 0.0)), start="Take3", duration=9.0))
    assert result.change_times == pytest.approx([2.0, 6.0], abs=0.15)
    assert [h.mass for h in result.holds] == pytest.approx([0.0, MASS, 0.0], abs=0.003)
    assert [h.status for h in result.holds] == [pp.Status.ok] * 3
    assert result.truth[1].tolist() == [0.0, MASS, 0.0]
    assert result.true_mass == 0.0
    first = result.holds[1]
    assert first.start == pytest.approx(2.0, abs=0.15) and first.stop == pytest.approx(6.0, abs=0.15)


def test_other_estimators_see_the_same_motion() -> None:
    filtered = trial(duration=2.0)
    formula = trial(duration=2.0, estimator="joint-formula", observer="sliding-mode")
    assert np.array_equal(filtered.log.position, formula.log.position)
    regression = W.weigh_trial(trial(estimator="regression"))
    assert regression.status == pp.Status.ok and abs(regression.error_percent) < 6.0


def test_stopping_early_keeps_what_there_is(tmp_path: Path) -> None:
    scene = W.scene(W.load_arm("justina_left_arm"))
    task = W.Task(scene=scene, start=scene.poses["Zero"], poses=(scene.poses["Take3"],), loads=((0.0, MASS),))
    asked = 0

    def stop() -> bool:
        nonlocal asked
        asked += 1
        return asked > 500

    found = W.run(task, W.make_pipeline(scene.arm)[0], record=tmp_path / "run.mcap", stop=stop)
    assert found.interrupted and len(found.log) == 500
    result = W.weigh_trial(found)
    assert result.remarks[0] == "Stopped after 2.00 of 10 s."
    log = pp.Log.open(tmp_path / "run.mcap", keep_invalid=True)
    assert len(log) == 500 and log.events[-1].kind == "stop"
    assert W.replay(log).same
    none = W.run(task, W.make_pipeline(scene.arm)[0], stop=lambda: True)
    empty = W.weigh_trial(none)
    assert len(none.log) == 0 and empty.status == pp.Status.warming
    json.dumps(empty.summary(), allow_nan=False)
    empty.report()


def test_progress_comes_ten_times_a_second() -> None:
    scene = W.scene(W.load_arm("justina_left_arm"))
    task = W.Task(scene=scene, start=scene.poses["Zero"], poses=(scene.poses["Take3"],), duration=1.0)
    seen: list[W.Moment] = []
    W.run(task, W.make_pipeline(scene.arm)[0], progress=seen.append)
    assert len(seen) == 11
    assert seen[5].time == pytest.approx(0.5, abs=0.005)
    assert seen[-1].touch.q.shape == (7,)


def test_a_route_of_several_poses() -> None:
    scene = W.scene(W.load_arm("justina_left_arm"))
    task = W.Task(
        scene=scene,
        start=scene.poses["Zero"],
        poses=(scene.poses["Take3"], scene.poses["StandBy"]),
        duration=6.5,
        move=2.0,
        hold=1.0,
    )
    assert W.arrival(task) == pytest.approx(5.0)
    found = W.run(task, W.make_pipeline(scene.arm)[0])
    assert np.array_equal(found.desired_q[round(2.5 * 250)], scene.poses["Take3"])
    assert np.array_equal(found.desired_q[-1], scene.poses["StandBy"])
    assert W.weigh_trial(found).goal_error < 0.02


# --- recorded -----------------------------------------------------------------------------------------------


def test_a_recording_holds_everything(recorded: tuple[W.Trial, Path], log: pp.Log) -> None:
    found, _ = recorded
    assert np.array_equal(log.time_ns, found.log.time_ns) and log.time_ns[0] == 0
    assert np.array_equal(log.position, found.log.position)
    assert np.array_equal(log.effort, found.log.effort)
    assert np.array_equal(log.signals["setpoint_position"].value, found.desired_q)
    assert np.array_equal(log.signals["command"].value, found.command)
    assert np.array_equal(log.signals["payload_mass"].value, found.touch.payload.mass)
    assert np.array_equal(log.signals["estimated_velocity"].value, found.touch.dq)
    assert np.array_equal(log.signals["touch_status"].value[:, 2], found.touch.payload.status)
    assert (log.signals["true_mass"].value == MASS).all()
    assert log.meta["seed"] == "0" and log.meta["palpate_version"] == pp.__version__
    assert json.loads(log.meta["pipeline"]) == json.loads(json.dumps(found.pipeline))
    assert json.loads(log.meta["task"])["loads_s_kg"] == [[0.0, MASS]]
    assert W.arm_of(log) == found.task.scene.arm
    # what was sent is what moved the arm: the next sample's effort
    assert np.allclose(log.effort[1:], found.command[:-1])


def test_replay_is_bit_for_bit(log: pp.Log) -> None:
    found = W.replay(log)
    assert found.same and found.same_version
    assert found.samples == found.compared == len(log)
    assert len(found.quantities) == 10


@pytest.mark.parametrize("estimator, observer", [("regression", None), ("joint-formula", "sliding-mode")])
def test_replay_of_other_estimators(estimator: str, observer: str | None, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    trial(record=path, estimator=estimator, observer=observer, duration=1.0)
    assert W.replay(pp.Log.open(path, keep_invalid=True)).same


def test_replay_notices_one_flipped_bit(log: pp.Log, tmp_path: Path) -> None:
    position = np.array(log.position)
    position.view(np.int64)[700, 3] ^= 1
    replace(log, position=position).save(tmp_path / "input.mcap")
    found = W.replay(pp.Log.open(tmp_path / "input.mcap", keep_invalid=True))
    assert not found.same
    assert "estimated_position" in {d.quantity.split("[")[0] for d in found.differences}
    assert min(d.first for d in found.differences) == 700

    mass = log.signals["payload_mass"]
    value = np.array(mass.value)
    value.view(np.int64)[900] ^= 1
    signals = {**log.signals, "payload_mass": Signal(mass.time_ns, value, mass.unit)}
    found = W.replay(replace(log, signals=signals))
    (difference,) = found.differences
    assert (difference.quantity, difference.rows, difference.first) == ("payload_mass", 1, 900)
    assert difference.time_s == pytest.approx(3.6)
    assert difference.recorded != difference.replayed


def test_replay_of_a_recording_that_was_cut_short(log: pp.Log) -> None:
    signals = {k: Signal(s.time_ns[:-3], s.value[:-3], s.unit) for k, s in log.signals.items()}
    found = W.replay(replace(log, signals=signals))
    assert found.same and found.compared == len(log) - 3


def test_replay_wants_a_recording_of_palpate(log: pp.Log) -> None:
    meta = dict(log.meta)
    for key, match in (("arm_card", "no arm card"), ("pipeline", "which pipeline")):
        with pytest.raises(pp.LogError, match=match):
            W.replay(replace(log, meta={k: v for k, v in meta.items() if k != key}))
    with pytest.raises(pp.LogError, match="damaged"):
        W.replay(replace(log, meta={**meta, "pipeline": "{"}))
    with pytest.raises(pp.LogError, match="no recorded outputs"):
        W.replay(replace(log, signals={}))


# --- from a log ---------------------------------------------------------------------------------------------


def test_a_log_weighs_what_the_live_run_weighed(recorded: tuple[W.Trial, Path], log: pp.Log) -> None:
    found, _ = recorded
    result = W.weigh_log(log)
    assert np.array_equal(result.touch.payload.mass, found.touch.payload.mass)
    assert result.status == pp.Status.ok and result.true_mass == MASS
    assert result.time_to_2_percent == W.weigh_trial(found).time_to_2_percent
    assert "recorded with" in result.remarks[0]
    summary = json.loads(json.dumps(result.summary(), allow_nan=False))
    assert summary["status"] == "ok" and summary["seed"] is None


def test_joints_are_found_by_name(log: pp.Log) -> None:
    arm = W.arm_of(log)
    shuffled = log.select([*reversed(log.joint_names)])
    result = W.weigh_log(shuffled, arm)
    assert np.array_equal(result.log.position, log.position)
    assert abs(result.error_percent) < 0.5
    other = replace(log, joint_names=tuple(f"j{i}" for i in range(7)))
    renamed = W.weigh_log(other, arm)
    assert "named otherwise" in renamed.remarks[0] and abs(renamed.error_percent) < 0.5
    with pytest.raises(pp.InputError, match="3 joints .* has 7"):
        W.weigh_log(replace(log.select(log.joint_names[:3]), joint_names=("a", "b", "c")), arm)


@pytest.mark.parametrize("estimator", [None, "regression"])
def test_an_arm_without_noise_figures_takes_them_from_the_log(log: pp.Log, estimator: str | None) -> None:
    arm = W.arm_of(log)
    bare = arm.replace(joints=tuple(j.replace(sensing=Sensing()) for j in arm.joints))
    result = W.weigh_log(log, bare, estimator=estimator)
    assert result.status == pp.Status.ok
    assert abs(result.mass - MASS) < max(4.0 * result.mass_std, 0.005 * MASS)
    (remark,) = result.remarks
    assert "does not say how noisy" in remark
    sensing = result.arm.joints[3].sensing
    truth = arm.joints[3].sensing
    assert sensing.position_resolution == pytest.approx(truth.position_resolution)
    assert sensing.position_std == pytest.approx(truth.position_std, rel=0.3)


def test_an_arm_without_masses_takes_the_controllers_model(log: pp.Log) -> None:
    arm = W.arm_of(log)
    bare = arm.replace(
        joints=tuple(
            j.replace(
                mass=0.0,
                com=np.zeros(3),
                inertia=np.zeros((3, 3)),
                sensing=replace(j.sensing, torque_std=0.02),
            )
            for j in arm.joints
        )
    )
    with pytest.raises(pp.ArmError, match="controller's own model torque"):
        W.weigh_log(log, bare)
    q, dq = log.signals["setpoint_position"].value, log.signals["setpoint_velocity"].value
    ddq = np.gradient(dq, 0.004, axis=0)
    model = arm.inverse_dynamics(q, dq, ddq) + arm.friction_torque(dq)
    result = W.weigh_log(replace(log, model_torque=model), bare)
    assert result.method() == "regression on model-residual"
    assert "no masses" in result.remarks[0]
    assert abs(result.mass - MASS) < 0.1


def test_effort_must_mean_the_same(log: pp.Log) -> None:
    arm = W.arm_of(log)
    with pytest.raises(pp.InputError, match="in A, but arm .* declares torque"):
        W.weigh_log(replace(log, meta={**log.meta, "effort_unit": "A"}), arm)
    gain = np.linspace(0.5, 2.0, 7)
    amperes = replace(log, effort=log.effort / gain, meta={**log.meta, "effort_unit": "A"})
    result = W.weigh_log(amperes, arm.replace(effort=pp.Effort.current(gain)))
    assert abs(result.error_percent) < 0.5
    with pytest.raises(pp.ArmError, match="does not say what its driver's effort is"):
        W.weigh_log(log, arm.replace(effort=pp.Effort.undeclared()))


def test_bad_samples_are_counted(log: pp.Log) -> None:
    position = np.array(log.position)
    position[[300, 301], 2] = np.nan
    position[302] = 1e300
    result = W.weigh_log(replace(log, position=position), W.arm_of(log))
    assert result.status == pp.Status.ok and abs(result.error_percent) < 0.5
    assert any(remark.startswith("3 of 1251 samples were not used") for remark in result.remarks)
    result.report()


# --- names, poses, pipelines --------------------------------------------------------------------------------


def test_arms_by_name_and_by_file(tmp_path: Path) -> None:
    arm = W.load_arm("kuka_lbr_iiwa7")
    assert arm is pp.robots.load("kuka_lbr_iiwa7")
    arm.save(tmp_path / "arm.yaml")
    assert W.load_arm(str(tmp_path / "arm.yaml")) == arm
    (tmp_path / "arm.urdf").write_text(arm.to_urdf(), encoding="utf-8")
    assert W.load_arm(str(tmp_path / "arm.urdf"), tip="link_ee").n == 7
    (tmp_path / "arm.txt").write_text("")
    for source, match in (
        ("kuka_lbr_iiwa", "did you mean 'kuka_lbr_iiwa7'"),
        ("nothing", "reference arms: abb_irb2400_16"),
        (str(tmp_path / "arm.txt"), "a card .* or a URDF"),
        (str(tmp_path / "gone.urdf"), "no such file"),
        (str(tmp_path / "gone.yaml"), "gone.yaml"),
    ):
        with pytest.raises(pp.ArmError, match=match):
            W.load_arm(source)
    for source in ("kuka_lbr_iiwa7", str(tmp_path / "arm.yaml")):
        with pytest.raises(pp.ArmError, match="for URDF files"):
            W.load_arm(source, tip="link_ee")


def test_poses() -> None:
    scene = W.scene(W.load_arm("justina_left_arm"))
    assert W.find_pose(scene, "standby2")[0] == "StandBy2"
    name, q = W.find_pose(scene, " 0.1,0,0,0.2,0,0,0")
    assert name == "0.1,0,0,0.2,0,0,0" and q[3] == 0.2
    for text, match in (
        ("Tkae3", "did you mean 'Take3'"),
        ("nowhere", "there are: StandBy, .* 7 angles in rad"),
        ("1,2", "has 7 joints, got 2"),
        ("nan,0,0,0,0,0,0", "finite"),
        ("9,0,0,0,0,0,0", "la_1_joint = 9 rad is outside its limits -3 to 3"),
    ):
        with pytest.raises(pp.InputError, match=match):
            W.find_pose(scene, text)


def test_a_telling_pose_shows_the_weight_and_can_be_held() -> None:
    for name in pp.robots.names():
        scene = W.scene(W.load_arm(name))
        arm = scene.arm
        q = W.telling_pose(arm, scene.mass)
        assert np.array_equal(q, W.telling_pose(arm, scene.mass))
        assert W.weight_torque(arm, q).max() > 5.0 * W.weight_torque(arm, np.zeros(arm.n)).min()
        effort = np.array([j.limits.effort for j in arm.joints])
        assert np.all(np.abs(arm.gravity_torque(q)) + scene.mass * W.weight_torque(arm, q) < effort)
        assert W.find_pose(scene, ",".join(map(str, q)))[1] == pytest.approx(q)


def test_what_a_scene_assumes_is_said() -> None:
    plain = pp.robots.load("kuka_lbr_iiwa7").replace(effort=pp.Effort.undeclared())
    scene = W.scene(plain)
    assert len(scene.assumed) == 3 and "effort" in scene.assumed[0]
    assert all(j.sensing.position_resolution > 0.0 and j.rotor_inertia > 0.0 for j in scene.arm.joints)
    published = W.scene(pp.robots.load("justina_left_arm"))
    assert published.assumed == () and published.arm == pp.robots.load("justina_left_arm")
    kinematics = pp.Arm.from_dh([0.0, 1.0], [0.0, 0.0], [0.5, 0.0])
    with pytest.raises(pp.ArmError, match="no masses"):
        W.scene(kinematics)


def test_pipelines_by_name() -> None:
    arm = pp.robots.load("justina_left_arm")
    assert W.make_pipeline(arm)[0].options()["observer"]["name"] == "extended-kalman"
    assert W.make_pipeline(arm, observer="none")[0].observer is None
    for estimator, observer, match in (
        ("payload", None, "did you mean 'payload-filter'"),
        (None, "momentun", "did you mean 'momentum'"),
        ("regression", "none", "choose an observer"),
        (None, "model-residual", "model torque"),
    ):
        with pytest.raises(pp.InputError, match=match):
            W.make_pipeline(arm, estimator, observer)
    kinematics = pp.Arm.from_dh([0.0, 1.0], [0.0, 0.0], [0.5, 0.0], effort=pp.Effort.torque())
    with pytest.raises(pp.ArmError, match="--observer model-residual"):
        W.make_pipeline(kinematics, "payload-filter", model_torque=True)


@pytest.mark.parametrize(
    "change, match",
    [
        ({"duration": 0.0}, "duration must be above 0"),
        ({"duration": np.nan}, "duration"),
        ({"move": -1.0}, "move"),
        ({"hold": np.inf}, "hold"),
        ({"seed": -1}, "seed"),
        ({"seed": 1.5}, "seed"),
        ({"speed": 0.0}, "speed"),
        ({"loads": ((0.0, -1.0),)}, "mass must be a number from 0 to 1000 kg, got -1.0"),
        ({"loads": ((0.0, np.nan),)}, "mass .* nan"),
        ({"loads": ((-1.0, 1.0),)}, "time of a load"),
        ({"loads": ((2.0, 1.0), (1.0, 0.0))}, "ascend"),
        ({"poses": ()}, "at least one pose"),
        ({"start": np.zeros(3)}, "start"),
        ({"poses": (np.full(7, np.nan),)}, "pose"),
    ],
)
def test_tasks_are_checked(change: dict, match: str) -> None:
    scene = W.scene(W.load_arm("justina_left_arm"))
    given = {"scene": scene, "start": scene.poses["Zero"], "poses": (scene.poses["Take3"],), **change}
    with pytest.raises(pp.InputError, match=match):
        W.Task(**given)


def test_a_pipeline_of_another_arm_is_refused() -> None:
    scene = W.scene(W.load_arm("justina_left_arm"))
    task = W.Task(scene=scene, start=scene.poses["Zero"], poses=(scene.poses["Take3"],))
    with pytest.raises(pp.InputError, match="made for the task's arm"):
        W.run(task, pp.Pipeline(pp.robots.load("justina_left_arm_box")))


def resting(arm: pp.Arm, seconds: float, rate: float, mass: float) -> pp.Log:
    """Nothing moves; the drives hold a mass and, within stiction, less or more."""
    rows = int(seconds * rate)
    q = np.tile([0.0, 0.6, 0.0, -1.2, 0.0, 0.7, 0.0], (rows, 1))
    weight = arm.jacobian(q[0], point=arm.grasp)[:3].T @ np.array([0.0, 0.0, -9.81 * mass])
    rng = np.random.default_rng(1)
    return pp.Log(
        time_ns=(np.arange(rows) * (1e9 / rate)).round().astype(np.int64),
        position=q,
        velocity=rng.normal(0.0, 1e-4, q.shape),
        effort=arm.gravity_torque(q) - weight + rng.normal(0.0, 0.1, q.shape),
        joint_names=arm.joint_names,
    )


def test_where_stiction_hides_the_weight_a_two_way_motion_is_proposed():
    arm = pp.robots.load("kuka_lbr_iiwa14")
    friction = pp.Friction(coulomb=6.0, viscous=1.0, presliding=2e-3)
    sensing = pp.Sensing(position_std=1e-5, velocity_std=1e-4, torque_std=0.1)
    joints = tuple(j.replace(friction=friction, sensing=sensing) for j in arm.joints)
    arm = arm.replace(joints=joints, effort=pp.Effort.torque())
    for rate in (100.0, 500.0):
        log = resting(arm, 4.0, rate, 1.0)
        found = W.weigh_log(log, arm)
        motion = found.proposal
        assert motion is not None
        j = arm.joint_names.index(motion.joint)
        assert motion.start == log.position[-1, j] and abs(motion.stop - motion.start) >= 0.05
        assert arm.joints[j].limits.lower <= motion.stop <= arm.joints[j].limits.upper
        assert motion.hidden == pytest.approx(6.0 / W.weight_torque(arm, log.position[-1])[j])
        assert motion.hidden < 2.0 * 1.96 * found.mass_std * 7**0.5
        assert any(motion.joint in r and "and back, twice" in r for r in found.remarks)
        assert found.summary()["proposal"] == motion.summary()
    # however wide: nothing but motion tells a load from what stiction holds
    for wider in (1.0, 10.0, 1000.0):
        payload = replace(found.touch.payload, mass_std=wider * found.touch.payload.mass_std)
        doubtful = replace(found, touch=replace(found.touch, payload=payload))
        assert weighing._two_way(doubtful) == motion
    smooth = tuple(j.replace(friction=pp.Friction(viscous=1.0)) for j in arm.joints)
    assert W.weigh_log(resting(arm, 4.0, 500.0, 1.0), arm.replace(joints=smooth)).proposal is None


def test_a_proposal_keeps_to_the_limits():
    arm = pp.robots.load("kuka_lbr_iiwa14")
    joints = tuple(j.replace(friction=pp.Friction(coulomb=6.0)) for j in arm.joints)
    arm = arm.replace(joints=joints)
    q = np.array([0.0, 0.6, 0.0, -1.2, 0.0, 0.7, 0.0])
    first = W.two_way_motion(arm, q)
    assert first is not None
    j = arm.joint_names.index(first.joint)
    tight = arm.joints[j].replace(limits=pp.Limits(q[j] - 0.01, q[j] + 0.01, 1.0, 100.0))
    other = W.two_way_motion(arm.replace(joints=(*joints[:j], tight, *joints[j + 1 :])), q)
    assert other is not None and other.joint != first.joint
    edge = arm.joints[j].replace(limits=pp.Limits(q[j] - 1.0, q[j] + 0.01, 1.0, 100.0))
    back = W.two_way_motion(arm.replace(joints=(*joints[:j], edge, *joints[j + 1 :])), q)
    assert back is not None and back.joint == first.joint and back.stop < back.start


def test_a_slow_log_is_weighed_by_regression_and_no_filter():
    arm = pp.robots.load("kuka_lbr_iiwa14").replace(effort=pp.Effort.torque())
    log = resting(arm, 4.0, 100.0, 1.0)
    found = W.weigh_log(log, arm)
    assert found.pipeline["payload"]["name"] == "regression" and found.pipeline["payload"]["first_moment"]
    assert any("below 200 Hz" in r for r in found.remarks)
    with pytest.raises(pp.InputError, match="at least 200 samples per second, the log has 100"):
        W.weigh_log(log, arm, estimator="payload-filter")
