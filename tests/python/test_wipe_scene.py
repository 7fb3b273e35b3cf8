"""The board's scene against mechanics, optics and the ink's law."""

from __future__ import annotations

import numpy as np
import pytest

cv2 = pytest.importorskip("cv2", reason="palpate[vision] is not installed")
mujoco = pytest.importorskip("mujoco", reason="palpate[sim] is not installed")
pytest.importorskip("shapely", reason="palpate[wipe] is not installed")

import palpate as pp  # noqa: E402
from palpate import vision, wipe  # noqa: E402
from palpate.errors import InputError, PalpateError  # noqa: E402
from palpate.wipe import scene as module  # noqa: E402

STEP = 2_000_000  # [ns]
STIFF = {"stiffness": (800.0,) * 3, "turning_stiffness": (20.0,) * 3}
UP = np.zeros(7)  # both arms upright: the camera sees the whole board


def make(**setting):
    layer = wipe.InkLayer((0.5, 0.35))
    layer.stroke([[0.1, 0.17], [0.4, 0.17]], width=0.012)
    layer.stroke([[0.1, 0.30], [0.4, 0.30]], width=0.005, colour="red")
    return wipe.BoardScene(layer, wipe.Setting(**setting))


def still(scene, which, wanted):
    """Torque that holds an arm in a pose."""
    q, dq = scene.state[which]
    arm = scene.arms[which]
    return arm.gravity_torque(q) + arm.mass_matrix(q) @ (100.0 * (wanted - q) - 20.0 * dq)


def wait(scene, seconds, q=(UP, UP)):
    for _ in range(round(seconds * 1e9 / STEP)):
        scene.step(still(scene, 0, q[0]), still(scene, 1, q[1]), STEP)


def test_the_arms_given_are_the_arms_simulated():
    scene = make()
    rng = np.random.default_rng(0)
    q = [np.array([0.3, -0.5, 0.4, -1.4, 0.5, 0.8, 0.2]) + 0.2 * rng.standard_normal(7) for _ in range(2)]
    scene.reset(*q)
    model, data = scene.plant.model, scene.plant.data
    M = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, M)
    for arm, pose, prefix in zip(scene.arms, q, ("arm:", "holder:"), strict=True):
        at = model.joint(f"{prefix}{arm.joints[0].name}").dofadr[0]
        part = slice(at, at + 7)
        np.testing.assert_allclose(data.qfrc_bias[part], arm.gravity_torque(pose), atol=1e-10)
        np.testing.assert_allclose(M[part, part], arm.mass_matrix(pose), atol=1e-10)


@pytest.mark.parametrize(("tilt", "turn"), [(0.0, 0.0), (0.2, 0.1)])
def test_a_loose_board_lies_still_until_it_is_pushed_harder_than_its_friction(tilt, turn):
    scene = make(tilt=tilt, turn=turn, friction=0.5)
    wait(scene, 0.5)
    before = scene.T_world_board
    inward = before[:3, 2]
    assert inward[2] == pytest.approx(-np.cos(tilt), abs=1e-3)
    across = np.cross(inward, [1.0, 0.0, 0.0])  # level, so that weight does not help
    across[2] = 0.0
    across /= np.linalg.norm(across)
    grip = np.sqrt((0.5 * np.cos(tilt)) ** 2 - np.sin(tilt) ** 2) * 1.5 * 9.81
    scene.shove(0.8 * grip * across)
    wait(scene, 0.5)
    assert np.linalg.norm(scene.T_world_board[:3, 3] - before[:3, 3]) < 5e-4
    scene.shove(1.5 * grip * across)
    wait(scene, 0.5)
    assert (scene.T_world_board[:3, 3] - before[:3, 3]) @ across > 0.05


def guide(scene, controller, pose, out, force):
    """One step of a stiff virtual spring to a pose of the eraser; along the normal it only pushes with `force` [N]."""
    (q, dq), _ = scene.state
    T = scene.arms[0].forward_kinematics(q)
    at = T[:3, 3] + T[:3, :3] @ scene.arms[0].grasp
    goal = pose[:3, 3] if not force else pose[:3, 3] + out * (out @ (at - pose[:3, 3]))
    torque = controller.step(goal, pose[:3, :3], q, dq, force=-force * out)[0]
    scene.step(torque, still(scene, 1, UP), STEP)


def press(scene, force, seconds):
    """Press the eraser onto the board's middle with so much [N]."""
    T = scene.T_base_board(0)
    pose = wipe.tool_poses(np.array([[0.25, 0.175, 0.0005]]), T, 0.0)[0]
    q = wipe.inverse_kinematics(scene.arms[0], pose)
    assert q is not None
    scene.reset(q, UP)
    controller = pp.CartesianImpedance(scene.arms[0], **STIFF)
    for _ in range(round(seconds / 0.002)):
        guide(scene, controller, pose, -T[:3, 2], force)


def test_pressing_is_felt_by_the_pads_and_takes_nothing_off():
    scene = make()
    ink = scene.ink.amount.copy()
    press(scene, 3.0, 2.5)
    out = -scene.T_world_board[:3, 2]
    assert scene.contact_force @ out == pytest.approx(3.0, abs=0.1)
    assert scene.pad_forces.sum() == pytest.approx(3.0, abs=0.1)
    assert scene.pad_forces.min() > 0.2  # flat on the board
    # the touch itself slides by less than a millimetre
    assert np.abs(ink - scene.ink.amount).max() < 0.1


def follow(scene, plan, force):
    """Wipe along a plan; rows of (normal force, board's place, whether the leg is a slide)."""
    T = scene.T_base_board(0)
    out = -T[:3, 2]
    reach = wipe.reachable(scene.arms[0], plan, T)
    assert reach.ok, reach.reason
    scene.reset(reach.q[0], UP)
    controller = pp.CartesianImpedance(scene.arms[0], **STIFF)
    rows = []
    for leg in plan.legs:
        t = 0.0
        while t < leg.duration:
            pose = wipe.tool_poses(leg.at(t)[0][None], T, plan.angle + reach.turn)[0]
            guide(scene, controller, pose, out, force if leg.phase == "slide" else 0.0)
            rows.append((scene.contact_force @ out, *scene.T_world_board[:3, 3], leg.phase == "slide"))
            t += 0.002
    return np.array(rows)


def test_a_stroke_cleans_its_track_and_nothing_else_and_every_run_is_the_same():
    ends = []
    for _ in range(2):
        scene = make()
        before, drawn = scene.ink.area, scene.ink.amount.copy()
        plan = wipe.plan([[[0.1, 0.17], [0.4, 0.17]]], scene.ink.size, margin=0.012, start=(0.1, 0.17))
        rows = follow(scene, plan, 2.5)
        slide = rows[rows[:, 4] > 0, 0]
        assert slide[len(slide) // 3 :].mean() == pytest.approx(2.5, abs=0.2)
        left = scene.ink.visible
        assert left[:200].sum() < 0.005 * before / scene.ink.texel**2
        np.testing.assert_array_equal(scene.ink.amount[280:], drawn[280:])
        assert np.linalg.norm(rows[-1, 1:4] - rows[0, 1:4]) < 0.003
        ends.append((scene.state, scene.ink.amount.copy()))
    np.testing.assert_array_equal(ends[0][1], ends[1][1])
    np.testing.assert_array_equal(ends[0][0][0], ends[1][0][0])


def test_the_gripper_holds_only_what_is_between_its_fingers():
    scene = make(friction=0.1)
    T = scene.T_base_board(1)
    W = scene.ink.size[0]
    pose = np.eye(4)
    # across the board with its fingers, towards the board's middle along y
    pose[:3, :3] = T[:3, :3] @ np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    rim = np.array([0.5 * W, -module.FRAME, 0.5 * module.THICK, 1.0])
    pose[:3, 3] = (T @ rim)[:3]
    q = wipe.inverse_kinematics(scene.arms[1], pose)
    assert q is not None
    scene.reset(UP, UP)
    assert scene.grip_distance > 0.1 and not scene.close_grip() and not scene.held
    scene.reset(UP, q)
    assert scene.grip_distance < 1e-3
    assert scene.close_grip() and scene.held
    spring = pp.CartesianImpedance(scene.arms[1], **STIFF)

    home = scene.T_world_board[:3, 3]

    def moved(push):
        scene.shove(push)
        for _ in range(500):
            _, (now, dq) = scene.state
            torque = spring.step(pose[:3, 3], pose[:3, :3], now, dq)[0]
            scene.step(still(scene, 0, UP), torque, STEP)
        return np.linalg.norm(scene.T_world_board[:3, 3] - home)

    # the arm gives way by its spring, the board does not slip in the gripper
    assert moved([-5.0, 0.0, 0.0]) < 0.02
    assert scene.grip_distance < 5e-4
    assert moved([0.0, 0.0, 0.0]) < 0.01
    scene.open_grip()
    assert not scene.held
    assert moved([-5.0, 0.0, 0.0]) > 0.1


@pytest.fixture
def seen():
    def look(scene):
        try:
            return scene.look()
        except PalpateError as error:
            if "OpenGL" in str(error):
                pytest.skip(f"no OpenGL here: {error}")
            raise

    return look


@pytest.mark.parametrize("tilt", [0.0, 0.26])
def test_vision_sees_the_board_where_it_is(seen, tilt):
    scene = make(tilt=tilt, turn=0.1)
    picture = seen(scene)
    assert picture.shape == (720, 1280, 3)
    sight = vision.see(picture, size=scene.ink.size, camera=scene.camera)
    W, H = scene.ink.size
    corners = np.array([[0, 0, 0, 1], [W, 0, 0, 1], [W, H, 0, 1], [0, H, 0, 1]]) @ scene.T_world_board.T
    lens = np.linalg.inv(scene.camera.T_base_camera)
    pixels = scene.camera.project((corners @ lens.T)[:, :3])
    assert np.linalg.norm(sight.board.corners - pixels, axis=1).max() < 3.0
    assert sight.dirty
    offset = np.linalg.inv(scene.T_world_board) @ sight.plane.T_base_board
    assert np.linalg.norm(offset[:3, 3]) < 0.008
    # the thin red line is where it was drawn
    red = [p for p in sight.ink_polygons if abs(p[:, 1].mean() - 0.30) < 0.01]
    assert len(red) == 1 and np.ptp(red[0][:, 0]) == pytest.approx(0.3, abs=0.02)
    scene.close()


def test_magnets_are_seen_and_gone_around(seen):
    scene = make(magnets=((0.25, 0.21),))
    sight = vision.see(seen(scene), size=scene.ink.size, camera=scene.camera)
    assert len(sight.object_polygons) == 1
    assert (
        np.linalg.norm(sight.object_polygons[0].mean(0) - [0.25, 0.21]) < 0.012
    )  # it stands up from the board
    chosen = wipe.choose(sight.ink_polygons, objects=sight.object_polygons)
    plan = wipe.plan(chosen.wipe, scene.ink.size, keep=chosen.keep)
    for leg in plan.legs:
        if leg.phase == "slide":
            for s in np.linspace(0.0, 1.0, 20):
                off = np.abs(leg.start[:2] + s * (leg.end - leg.start)[:2] - [0.25, 0.21])
                gap = np.maximum(off - 0.5 * np.array(plan.footprint), 0.0)
                assert np.linalg.norm(gap) > 0.5 * module.MAGNET[0]
    scene.close()


def test_pictures_show_the_ink_as_it_is_now(seen):
    scene = make()
    first = seen(scene)
    assert not np.array_equal(first, seen(scene))  # noise and light are new each time
    scene.ink.amount[:] = 0.0
    sight = vision.see(seen(scene), size=scene.ink.size, camera=scene.camera)
    assert sight.board is not None and not sight.dirty
    again = make()
    np.testing.assert_array_equal(first, seen(again))  # the same seed sees the same
    again.close()
    scene.close()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: wipe.Setting(friction=0.0), "setting: friction must be finite and > 0, got 0.0"),
        (lambda: wipe.Setting(magnets=((0.1,),)), "setting: magnets must be places (x, y) [m]"),
        (lambda: wipe.Setting(tilt=1.0), "setting: tilt must be at most 45 degrees"),
        (lambda: make().reset(UP, np.zeros(6)), "q of the holder must be (7,) and finite, got (6,)"),
        (
            lambda: make().step(UP, np.zeros(6), STEP),
            "torque of the holder must be (7,) and finite, got (6,)",
        ),
        (lambda: make().shove([1.0, 2.0]), "a shove must be a finite force (3,) [N], got (2,)"),
    ],
)
def test_wrong_input_is_one_line(call, message):
    with pytest.raises(InputError) as caught:
        call()
    assert message in str(caught.value) and "\n" not in str(caught.value)
