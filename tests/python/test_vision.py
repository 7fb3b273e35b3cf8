"""Whiteboards in pictures: laws on drawn boards, where the truth is known, and the annotated photographs."""

from __future__ import annotations

import json

import numpy as np
import pytest

cv2 = pytest.importorskip("cv2", reason="palpate[vision] is not installed")

from palpate import PalpateError, vision  # noqa: E402
from palpate.cli import main  # noqa: E402
from palpate.errors import InputError  # noqa: E402
from palpate.studies import _boards, board_detection  # noqa: E402
from palpate.vision import published  # noqa: E402
from recordings import recording  # noqa: E402

SIZE = (0.9, 0.6)  # of the writing surface [m]
PPM = 1000.0  # texture pixels per metre
SHADOW = np.array([[0, 300], [1280, 80], [1280, 500], [0, 650]])
VIEW = np.array([[310.0, 120.0], [1010.0, 190.0], [960.0, 610.0], [270.0, 560.0]])


def texture(strokes=True, magnet=False, frame=30):
    """A board of SIZE seen straight on, PPM pixels per metre, its frame `frame` pixels wide around it."""
    w, h = round(SIZE[0] * PPM), round(SIZE[1] * PPM)
    face = np.full((h + 2 * frame, w + 2 * frame, 3), 150, np.uint8)
    cv2.rectangle(face, (frame, frame), (frame + w - 1, frame + h - 1), (222, 226, 224), -1)
    if strokes:
        cv2.line(face, (frame + 200, frame + 150), (frame + 500, frame + 150), (40, 40, 40), 7)
        cv2.putText(
            face, "mass", (frame + 250, frame + 400), cv2.FONT_HERSHEY_SCRIPT_SIMPLEX, 4, (160, 60, 20), 7
        )
    if magnet:
        cv2.circle(face, (frame + 750, frame + 450), 26, (30, 30, 200), -1)
    return face


def picture(view=VIEW, background=95, shape=(720, 1280), onto=None, noise=2.0, frame=30, **board):
    """A camera's picture of a board whose writing surface has the corners `view`."""
    face = texture(frame=frame, **board)
    w, h = face.shape[1] - 2 * frame, face.shape[0] - 2 * frame
    inner = np.float32(
        [[frame, frame], [frame + w, frame], [frame + w, frame + h], [frame, frame + h]]
    ) - np.float32(0.5)
    H = cv2.getPerspectiveTransform(inner, np.float32(view))
    out = np.full((*shape, 3), background, np.uint8) if onto is None else onto.copy()
    # drawn twice as large and halved: edges lie where they should to a fraction of a pixel
    double = np.array([[2.0, 0, 0.5], [0, 2.0, 0.5], [0, 0, 1]]) @ H
    full = (2 * shape[1], 2 * shape[0])
    seen = cv2.warpPerspective(face, double, full, flags=cv2.INTER_LINEAR).astype(np.float32)
    mask = cv2.warpPerspective(np.full(face.shape[:2], 1.0, np.float32), double, full)[..., None]
    mixed = cv2.resize(out, full, interpolation=cv2.INTER_LINEAR) * (1 - mask) + seen * mask
    out = cv2.resize(mixed, shape[::-1], interpolation=cv2.INTER_AREA)
    out += np.random.default_rng(0).normal(0.0, noise, out.shape)
    return np.clip(np.rint(out), 0, 255).astype(np.uint8)


def error(found, true=VIEW):
    return board_detection.corner_error(found.corners, np.asarray(true, float))


@pytest.fixture(scope="module")
def plain():
    return picture()


# --- where the board is ----------------------------------------------------------------------------------------------


def test_corners_are_those_of_the_surface_inside_the_frame(plain):
    (board,) = vision.detect(plain)
    assert error(board) < 0.5 and board.complete and board.confidence > 0.9
    assert np.linalg.norm(board.corners[0] - VIEW[0]) < 1.0  # the first one is the top left
    assert (board.spread < 0.5).all()


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_a_turned_picture_shows_a_turned_board(plain, turns):
    h, w = plain.shape[:2]
    x, y = VIEW.T
    turned = {1: (y, w - 1 - x), 2: (w - 1 - x, h - 1 - y), 3: (h - 1 - y, x)}[turns]
    (board,) = vision.detect(np.rot90(plain, turns))
    assert error(board, np.stack(turned, 1)) < 1.0


@pytest.mark.parametrize(
    "change",
    [
        lambda p: cv2.cvtColor(p, cv2.COLOR_BGR2GRAY),
        lambda p: np.dstack([p, np.full(p.shape[:2], 255, np.uint8)]),
        lambda p: (p * 0.45).astype(np.uint8),
        lambda p: np.clip(p * np.array([0.75, 1.0, 1.1]), 0, 255).astype(np.uint8),
        lambda p: cv2.GaussianBlur(p, (0, 0), 1.5),
    ],
    ids=["grey", "alpha", "dark", "tinted", "blurred"],
)
def test_the_light_and_the_format_change_nothing(plain, change):
    assert error(vision.detect(change(plain))[0]) < 1.5


def test_ten_megapixels_are_mapped_back(plain):
    large = cv2.resize(plain, (3840, 2160), interpolation=cv2.INTER_CUBIC)
    (board,) = vision.detect(large)
    assert error(board, (VIEW + 0.5) * 3.0 - 0.5) < 3.0
    sight = vision.see(large)
    assert sight.dirty and sight.ink.mask.shape == (2160, 3840) and sight.picture == (3840, 2160)


@pytest.mark.parametrize("frame", [0, 6, 45])
def test_any_frame(frame):
    assert error(vision.detect(picture(frame=frame))[0]) < 1.0


@pytest.mark.parametrize("seed", range(3))
def test_rooms_hold_no_board(seed):
    assert vision.detect(_boards.scene(board_detection.EMPTY + seed, board=False).image) == ()


def test_nothing_is_seen_in_nothing():
    rng = np.random.default_rng(1)
    for image in (
        np.full((480, 640, 3), 230, np.uint8),
        np.zeros((480, 640), np.uint8),
        rng.integers(0, 256, (480, 640, 3), np.uint8),
        np.tile(np.linspace(0, 255, 640).astype(np.uint8), (480, 1)),
    ):
        sight = vision.see(image)
        assert sight.boards == () and sight.board is None and sight.dirty is None and sight.plane is None
        assert np.isnan(sight.covered) and sight.ink_polygons == () and sight.plain()["found"] is False


def test_two_boards_are_both_told():
    left = np.array([[60.0, 100], [560, 120], [550, 520], [70, 540]])
    right = np.array([[760.0, 250], [1180, 230], [1190, 540], [765, 520]])
    sight = vision.see(picture(right, onto=picture(left)))
    assert len(sight.boards) == 2
    assert {k for b in sight.boards for k, true in enumerate((left, right)) if error(b, true) < 1.5} == {0, 1}
    assert sight.boards[0].confidence >= sight.boards[1].confidence
    assert any("2 boards" in r for r in sight.remarks())


def beside(gap, frame=20):
    """Two boards on one wall, their frames `gap` pixels of the texture apart, seen askew; the corners of both."""
    one = texture(frame=frame)
    h, w = one.shape[:2]
    face = np.full((h, 2 * w + gap, 3), 95, np.uint8)
    face[:, :w], face[:, w + gap :] = one, texture(strokes=False, frame=frame)
    x = np.array([frame, w - frame, w + gap + frame, 2 * w + gap - frame]) - 0.5
    y = np.array([frame, h - frame]) - 0.5
    H = cv2.getPerspectiveTransform(
        np.float32([[0, 0], [2 * w + gap, 0], [2 * w + gap, h], [0, h]]),
        np.float32([[150, 180], [1130, 120], [1090, 560], [180, 480]]),
    )
    seen = cv2.warpPerspective(face, H, (1280, 720), flags=cv2.INTER_AREA, borderValue=(95, 95, 95))
    corners = [
        cv2.perspectiveTransform(
            np.float32([[[x[k], y[0]], [x[k + 1], y[0]], [x[k + 1], y[1]], [x[k], y[1]]]]), H
        )[0]
        for k in (0, 2)
    ]
    noise = np.random.default_rng(0).normal(0.0, 2.0, seen.shape)
    return np.clip(np.rint(cv2.GaussianBlur(seen, (0, 0), 0.8) + noise), 0, 255).astype(np.uint8), corners


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("gap", [0, 12])
def test_two_boards_side_by_side_are_not_one(gap, turned):
    image, corners = beside(gap)
    if turned:
        image, corners = np.rot90(image), [np.stack([c[:, 1], 1279 - c[:, 0]], 1) for c in corners]
    found = vision.detect(image)
    assert len(found) == 2
    assert all(min(error(b, true) for b in found) < 3.0 for true in corners)
    assert any("2 boards" in r for r in vision.see(image).remarks())


def test_a_line_across_is_a_line_or_a_seam_and_it_is_said():
    plain = texture(strokes=False)
    for reach, least, most in ((40, 0.0, 0.3), (0, 0.1, 1.0)):
        flat = plain.copy()
        cv2.line(flat, (480, 30 + reach), (480, 629 - reach), (40, 40, 40), 6)
        H = cv2.getPerspectiveTransform(
            np.float32([[30, 30], [930, 30], [930, 630], [30, 630]]) - np.float32(0.5), np.float32(VIEW)
        )
        seen = cv2.warpPerspective(flat, H, (1280, 720), flags=cv2.INTER_AREA, borderValue=(95, 95, 95))
        (board, *more) = vision.detect(cv2.GaussianBlur(seen, (0, 0), 0.8))
        two = 1.0 if more else board.divided
        assert least <= two <= most
        assert more or board.confidence <= 1.0 - two


def test_a_lamp_and_a_painted_panel_are_hardly_boards(plain):
    for surface in ((255, 255, 255), (60, 170, 60), (70, 70, 70)):
        image = np.full((720, 1280, 3), 130, np.uint8)
        cv2.rectangle(image, (0, 0), (1279, 60), (235, 235, 235), -1)  # something white in the room
        cv2.fillConvexPoly(image, np.int32(VIEW), surface, cv2.LINE_AA)
        image = cv2.GaussianBlur(image, (0, 0), 0.8)
        found = vision.detect(image)
        assert all(b.confidence < 0.9 for b in found)
    assert vision.detect(plain)[0].confidence > 0.98


@pytest.mark.parametrize("side", range(4))
def test_a_side_in_burnt_light_says_that_it_is_not_seen(plain, side):
    a, b = VIEW[side], VIEW[(side + 1) % 4]
    inward = 0.12 * (VIEW.mean(0) - 0.5 * (a + b))
    along = 0.1 * (b - a)
    light = np.zeros(plain.shape[:2], np.float32)
    band = [a - along - 2.0 * inward, b + along - 2.0 * inward, b + along + inward, a - along + inward]
    cv2.fillPoly(light, [np.int32(np.rint(band))], 300.0)
    seen = np.clip(plain + cv2.GaussianBlur(light, (0, 0), 4.0)[..., None], 0, 255).astype(np.uint8)
    sure = vision.detect(plain)[0].confidence
    for board in vision.detect(seen):
        off = board_detection.corner_errors(board.corners, VIEW)
        assert board.confidence < sure
        assert (off <= np.maximum(2.0 * board.sigma, 3.0)).all()


def test_a_white_surface_without_a_shade_is_still_seen():
    """Over-exposed all over, not in one place: its border is as sharp as ever."""
    (board,) = vision.detect(np.clip(picture(frame=40).astype(float) * 1.25, 0, 255).astype(np.uint8))
    assert error(board) < 1.5 and (board.sigma < 5.0).all()


def test_a_board_that_reaches_out_of_view_is_not_called_whole():
    outside = VIEW + np.array([420.0, 0.0])
    boards = vision.detect(picture(outside))
    assert all(not b.complete for b in boards)
    if boards:
        assert not boards[0].in_view[1] and boards[0].in_view.sum() == 3
        assert any("out of view" in r for r in vision.see(picture(outside)).remarks())


def room(kind):
    """Walls unlike those of the rendered views."""
    rng = np.random.default_rng(2)
    wall = np.full((720, 1280, 3), 190.0)
    if kind == "tiles":
        wall[:, ::90], wall[:, 1::90], wall[::90], wall[1::90] = 150.0, 150.0, 150.0, 150.0
    elif kind == "white door":
        wall[:] = (150, 165, 170)
        wall[:, 220:1120] = (228, 230, 231)
        wall[:, 214:220] = wall[:, 1120:1126] = 120.0
    elif kind == "posters":
        for x in (20, 1080):
            cv2.rectangle(wall, (x, 60), (x + 180, 330), (235, 238, 240), -1)
            cv2.rectangle(wall, (x, 60), (x + 180, 330), (60, 60, 60), 3)
    elif kind == "wood":
        grain = cv2.resize(rng.normal(0, 1, (180, 13)), (1280, 720), interpolation=cv2.INTER_CUBIC)
        wall = np.array([40.0, 70, 110]) * (1 + 0.05 * grain[..., None])
    return np.clip(wall + rng.normal(0, 1.5, wall.shape), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("kind", ["tiles", "white door", "posters", "wood"])
def test_walls_of_other_kinds(kind):
    assert error(vision.detect(picture(onto=room(kind)))[0]) < 1.5


@pytest.mark.parametrize(
    "change",
    [
        lambda p: p * np.linspace(0.35, 1.1, 1280)[None, :, None],
        lambda p: p * (1.0 - 0.65 * np.hypot(*np.mgrid[-0.7:0.7:720j, -0.7:0.7:1280j]) ** 2)[..., None],
        lambda p: cv2.imdecode(cv2.imencode(".jpg", p, [cv2.IMWRITE_JPEG_QUALITY, 20])[1], cv2.IMREAD_COLOR),
        lambda p: p + np.random.default_rng(4).normal(0.0, 14.0, p.shape),
        lambda p: p * (1.0 - 0.4 * cv2.fillPoly(np.zeros(p.shape[:2]), [SHADOW], 1.0))[..., None],
    ],
    ids=["window light", "vignette", "compressed", "noisy", "hard shadow"],
)
def test_light_and_cameras_of_other_kinds(plain, change):
    seen = np.clip(change(plain), 0, 255).astype(np.uint8)
    assert error(vision.detect(seen)[0]) < 1.5


def test_a_corner_says_how_sure_it_is(plain):
    (board,) = vision.detect(plain)
    assert board.sigma.shape == (4,) and (board.sigma > 0.0).all() and (board.sigma < 3.0).all()
    # twice the picture, twice the pixels
    (larger,) = vision.detect(cv2.resize(plain, (2560, 1440), interpolation=cv2.INTER_CUBIC))
    np.testing.assert_allclose(larger.sigma, 2.0 * board.sigma, rtol=0.5)
    # stated and true errors belong together
    views = [board_detection.measure_view(seed) for seed in (3, 4)]
    off, sigma = np.array([pair for view in views for pair in view.stated]).T
    assert len(off) == 8 and np.mean(off <= 3.0 * sigma) >= 0.75


def test_a_corner_out_of_view_is_no_board():
    for shift in ((420.0, 260.0), (-500.0, -300.0)):
        assert vision.detect(picture(VIEW + shift)) == ()


def test_most_rendered_views_are_right():
    found = [board_detection.measure_view(seed) for seed in (0, 1, 3, 4)]
    assert sum(view.error["lines"] < board_detection.WITHIN for view in found) >= 3
    assert np.nanmean([view.recall for view in found]) > 0.8


def test_a_scene_is_its_seed():
    a, b = _boards.scene(3), _boards.scene(3)
    np.testing.assert_array_equal(a.image, b.image)
    np.testing.assert_array_equal(a.ink, b.ink)
    assert not np.array_equal(a.image, _boards.scene(4).image)
    assert not _boards.scene(3, dirty=False).ink.any()


# --- the ink ---------------------------------------------------------------------------------------------------------


def test_ink_lies_where_it_was_drawn_in_metres(plain):
    sight = vision.see(plain, size=SIZE)
    assert sight.dirty is True and sight.plane.metric and sight.plane.size == SIZE
    line = min(sight.ink_polygons, key=lambda p: np.ptp(p[:, 1]))
    np.testing.assert_allclose([line[:, 0].min(), line[:, 0].max()], [0.1965, 0.5035], atol=0.004)
    np.testing.assert_allclose(line[:, 1].mean(), 0.150, atol=0.003)
    assert (sight.ink.contrast > 0.3).all() and len(sight.ink.contrast) == len(sight.ink.polygons)


def test_a_clean_board_is_clean_in_any_light():
    clean = picture(strokes=False).astype(np.float32)
    x = np.linspace(0, 1, 1280, dtype=np.float32)[None, :, None]
    shadow = np.where(x < 0.5, 1.0, 0.6)
    window = np.zeros((720, 1280), np.float32)
    cv2.rectangle(window, (500, 250), (640, 400), 1.0, -1)
    cv2.rectangle(window, (660, 250), (800, 400), 1.0, -1)
    glare = 70.0 * cv2.GaussianBlur(window, (0, 0), 2.0)[..., None]
    for light in (clean, clean * shadow, clean * (0.5 + 0.5 * x), clean * 0.7 + glare):
        sight = vision.see(np.clip(light, 0, 255).astype(np.uint8))
        assert sight.dirty is False and sight.covered < vision.DIRTY


def test_a_magnet_is_not_ink():
    sight = vision.see(picture(magnet=True), size=SIZE)
    (magnet,) = sight.object_polygons
    np.testing.assert_allclose(magnet.mean(0), [0.750, 0.450], atol=0.005)
    assert not any(np.linalg.norm(p.mean(0) - [0.75, 0.45]) < 0.05 for p in sight.ink_polygons)


def laid(drawn):
    """The board of `picture`, clean, with pixels of its texture darkened by what is drawn (BGR, part of the light)."""
    flat = texture(strokes=False).astype(np.float32)
    ink = np.zeros(flat.shape, np.float32)
    drawn(ink)
    H = cv2.getPerspectiveTransform(
        np.float32([[30, 30], [930, 30], [930, 630], [30, 630]]) - np.float32(0.5), np.float32(VIEW)
    )
    scene = picture(strokes=False).astype(np.float32)
    taken = cv2.warpPerspective(ink, H, (1280, 720), flags=cv2.INTER_LINEAR)
    return scene * (1.0 - taken)


@pytest.mark.parametrize("light", [(0.2, 0.2, 0.2), (0.18, 0.2, 0.0)])
def test_a_pale_rest_wider_than_a_stroke_is_ink_and_a_shadow_is_not(light):
    smudge = laid(lambda ink: cv2.ellipse(ink, (480, 330), (90, 40), 20, 0, 360, light, -1))
    sight = vision.see(np.rint(smudge).astype(np.uint8), size=SIZE)
    assert not sight.object_polygons
    assert max(np.ptp(p[:, 0]) for p in sight.ink_polygons) > 0.12
    soft = laid(
        lambda ink: cv2.GaussianBlur(
            cv2.ellipse(ink, (480, 330), (90, 40), 20, 0, 360, (0.2, 0.2, 0.2), -1), (0, 0), 30.0, ink
        )
    )
    assert vision.see(np.rint(soft).astype(np.uint8)).dirty is False


def test_the_mean_of_pictures_shows_what_each_of_them_hides():
    rng = np.random.default_rng(0)
    truth = laid(lambda ink: cv2.line(ink, (300, 300), (340, 300), (0.04, 0.04, 0.04), 6))

    def taken():
        light = truth * np.exp(0.1 * rng.standard_normal()) * np.exp(0.02 * rng.standard_normal(3))
        return np.clip(np.rint(light + 2.0 * rng.standard_normal(light.shape)), 0, 255).astype(np.uint8)

    frames = [taken() for _ in range(6)]
    mean, moved = vision.average(frames)
    assert not moved.any() and mean.dtype == np.uint8
    sure = {"faint": 0.012, "clear": 0.02}
    (piece,) = vision.ink(mean, VIEW, **sure).polygons
    middle = cv2.perspectiveTransform(
        np.float32([[[320, 300]]]),
        cv2.getPerspectiveTransform(
            np.float32([[30, 30], [930, 30], [930, 630], [30, 630]]) - np.float32(0.5), np.float32(VIEW)
        ),
    )[0, 0]
    np.testing.assert_allclose(0.5 * (piece.min(0) + piece.max(0)), middle, atol=3.0)
    assert vision.see(mean).dirty is False  # a lesser eye, as for a photograph
    # who walks through is told, and given as last seen
    frames[2][100:400, 200:300] = 40
    mean, moved = vision.average(frames)
    assert moved[100:400, 200:300].mean() > 0.9 and moved.mean() < 0.1
    assert np.abs(mean[moved].astype(float) - 40.0).min() > 20.0


def test_averages_and_thresholds_that_make_no_sense_are_refused(plain):
    with pytest.raises(InputError, match="at least one picture"):
        vision.average([])
    with pytest.raises(InputError, match="of one size"):
        vision.average([plain, plain[:-1]])
    with pytest.raises(InputError, match="0 < faint <= clear < 1"):
        vision.ink(plain, VIEW, faint=0.2, clear=0.1)
    with pytest.raises(InputError, match="least must be at least 1 pixel"):
        vision.ink(plain, VIEW, least=0)


def test_ink_alone_needs_corners(plain):
    with pytest.raises(InputError, match="corners must be"):
        vision.ink(plain, np.zeros((3, 2)))
    assert vision.ink(plain, VIEW).mask.sum() > 1000


# --- before and after ------------------------------------------------------------------------------------------------


def test_what_was_erased_is_told_under_other_light_and_behind_an_arm(plain):
    half = texture()
    half[:, :480] = texture(strokes=False)[:, :480]  # the left part is wiped
    H = cv2.getPerspectiveTransform(
        np.float32([[30, 30], [930, 30], [930, 630], [30, 630]]) - np.float32(0.5), np.float32(VIEW)
    )
    after = plain.copy()
    seen = cv2.warpPerspective(half, H, (1280, 720))
    mask = cv2.warpPerspective(np.ones(half.shape[:2], np.uint8), H, (1280, 720)) > 0
    after[mask] = seen[mask]
    after = (after * np.linspace(0.7, 1.0, 1280)[None, :, None]).astype(np.uint8)
    change = vision.compare(plain, after, VIEW, VIEW, size=SIZE)
    assert 0.2 < change.erased < 0.8 and not change.hidden.any()
    w = change.gone.shape[1]
    assert not change.gone[:, round(0.52 * w) :].any() and not change.left[:, : round(0.47 * w)].any()
    assert change.new.sum() < 0.05 * change.left.sum()
    arm = after.copy()
    cv2.line(arm, (1279, 500), (700, 400), (20, 90, 220), 60)
    for ignore in (None, cv2.line(np.zeros((720, 1280), np.uint8), (1279, 500), (700, 400), 1, 60)):
        change = vision.compare(plain, arm, VIEW, VIEW, size=SIZE, ignore=ignore)
        assert change.hidden.any() and not (change.hidden & (change.gone | change.left | change.new)).any()
        assert change.new.sum() < 0.1 * change.left.sum()
    same = vision.compare(plain, plain, VIEW, VIEW)
    assert same.erased == 0.0 and not same.new.any()
    clean = picture(strokes=False)
    assert np.isnan(vision.compare(clean, clean, VIEW, VIEW).erased)


def test_compare_says_what_is_wrong(plain):
    with pytest.raises(InputError, match="corners must be"):
        vision.compare(plain, plain, VIEW[:3], VIEW)
    with pytest.raises(InputError, match="ignore must be a mask"):
        vision.compare(plain, plain, VIEW, VIEW, ignore=np.zeros((3, 3)))


# --- the camera ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def camera():
    K = np.array([[1050.0, 0, 630], [0, 1045.0, 370], [0, 0, 1]])
    return vision.Camera(K, np.array([-0.08, 0.03, 0.001, -0.001, 0.0]), (1280, 720))


def placed(camera, pose):
    """Corners of a board of SIZE at `pose` (rotation vector, position) in the picture; its T_camera_board."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(np.array(pose[0], float))[0], pose[1]
    flat = np.array([[0, 0, 0], [SIZE[0], 0, 0], [*SIZE, 0], [0, SIZE[1], 0]])
    return camera.project(flat @ T[:3, :3].T + T[:3, 3]), T


def test_a_board_is_found_in_space(camera):
    corners, T = placed(camera, ([0.3, -0.4, 0.1], [-0.4, -0.3, 1.4]))
    plane = vision.plane(corners, camera.size, size=SIZE, camera=camera)
    np.testing.assert_allclose(plane.T_camera_board, T, atol=1e-4)
    assert plane.T_base_board is None
    at = np.array([[0.0, 0.0], [0.45, 0.3], [0.9, 0.6], [0.1, 0.5]])
    flat = np.column_stack([at, np.zeros(4)])
    np.testing.assert_allclose(plane.to_board(camera.project(flat @ T[:3, :3].T + T[:3, 3])), at, atol=1e-4)
    np.testing.assert_allclose(plane.to_board(plane.to_pixels(at)), at, atol=1e-6)
    T_base_camera = np.eye(4)
    T_base_camera[:3, 3] = [1.0, 2.0, 3.0]
    mounted = vision.Camera(camera.K, camera.distortion, camera.size, T_base_camera)
    base = vision.plane(corners, camera.size, size=SIZE, camera=mounted).T_base_board
    np.testing.assert_allclose(base[:3, 3], T[:3, 3] + [1.0, 2.0, 3.0], atol=1e-4)
    unknown = vision.plane(corners, camera.size, camera=mounted)
    assert not unknown.metric and unknown.T_base_board is None
    assert unknown.size[0] == pytest.approx(1.5, rel=1e-3)


def test_the_shape_of_a_board_without_a_calibration():
    ideal = vision.Camera(
        np.array([[1100.0, 0, 639.5], [0, 1100.0, 359.5], [0, 0, 1]]), np.zeros(5), (1280, 720)
    )
    corners, _ = placed(ideal, ([0.5, -0.5, 0.1], [-0.4, -0.3, 1.5]))
    assert vision.aspect(corners, ideal.size) == pytest.approx(1.5, rel=1e-6)
    straight, _ = placed(ideal, ([0, 0, 0], [-0.4, -0.3, 1.5]))
    assert vision.aspect(straight, ideal.size) == pytest.approx(1.5, rel=1e-6)
    assert vision.aspect(straight, ideal.size, ideal.K) == pytest.approx(1.5, rel=1e-6)


def test_calibration_from_charuco_pictures(camera):
    board = vision.charuco((7, 5), 0.04, 0.03)
    sheet = cv2.cvtColor(board.generateImage((1400, 1000), marginSize=0), cv2.COLOR_GRAY2BGR)
    views = []
    for k, pose in enumerate(
        [(0.4, 0, 0), (-0.4, 0.2, 0), (0, 0.5, 0.1), (0.1, -0.5, -0.2), (0.3, 0.4, 0.3), (0, 0, 1.0)]
    ):
        R = cv2.Rodrigues(np.array(pose))[0]
        shift = -R @ [0.14, 0.10, 0] + [0.02 * (k % 3 - 1), 0.02 * (k % 2), 0.42]
        flat = np.array([[0, 0, 0], [0.28, 0, 0], [0.28, 0.2, 0], [0, 0.2, 0]])
        seen = (flat @ R.T + shift) @ camera.K.T
        H = cv2.getPerspectiveTransform(
            np.float32([[0, 0], [1400, 0], [1400, 1000], [0, 1000]]) - np.float32(0.5),
            np.float32(seen[:, :2] / seen[:, 2:]),
        )
        views.append(
            cv2.warpPerspective(sheet, H, (1280, 720), borderValue=(128, 128, 128), flags=cv2.INTER_AREA)
        )
    found = vision.calibrate_charuco(views, board)
    np.testing.assert_allclose(np.diag(found.K)[:2], np.diag(camera.K)[:2], rtol=0.01)
    np.testing.assert_allclose(found.K[:2, 2], camera.K[:2, 2], atol=8.0)
    assert found.rms < 0.5 and found.size == (1280, 720)
    with pytest.raises(InputError, match="found in 1 of 2 pictures"):
        vision.calibrate_charuco([views[0], np.full((720, 1280), 90, np.uint8)], board)
    with pytest.raises(InputError, match="one size"):
        vision.calibrate_charuco([*views, views[0][:600]], board)


def test_calibration_from_known_poses(camera):
    rng = np.random.default_rng(3)
    truth = vision.Camera(camera.K, [-0.05, 0, 0, 0, 0], camera.size)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(np.array([2.0, 0.3, -0.2]))[0], [0.1, 0.2, 1.8]  # camera <- base
    points = rng.uniform([-0.5, -0.5, -0.3], [0.5, 0.5, 0.4], (40, 3))
    pixels = truth.project(points @ T[:3, :3].T + T[:3, 3])
    found = vision.calibrate_poses(points, pixels + rng.normal(0, 0.1, pixels.shape), camera.size)
    np.testing.assert_allclose(np.diag(found.K)[:2], np.diag(camera.K)[:2], rtol=0.01)
    np.testing.assert_allclose(found.T_base_camera[:3, 3], np.linalg.inv(T)[:3, 3], atol=0.02)
    assert found.rms < 0.3
    with pytest.raises(InputError, match="one plane"):
        vision.calibrate_poses(points * [1, 1, 0], pixels, camera.size)
    with pytest.raises(InputError, match="N >= 8"):
        vision.calibrate_poses(points[:5], pixels[:5], camera.size)


def test_a_camera_card_is_read_as_written(camera, tmp_path):
    T = np.eye(4)
    T[:3, 3] = [0.1, 0.2, 0.3]
    card = vision.Camera(camera.K, camera.distortion, camera.size, T, 0.31).save(tmp_path / "camera.json")
    again = vision.Camera.load(card)
    np.testing.assert_array_equal(again.K, camera.K)
    np.testing.assert_array_equal(again.distortion, camera.distortion)
    np.testing.assert_array_equal(again.T_base_camera, T)
    assert again.size == camera.size and again.rms == 0.31
    assert np.isnan(vision.Camera.load(camera.save(tmp_path / "other.json")).rms)
    for text in ("", "[]", "{}", '{"kind": "palpate camera 1"}', '{"kind": "palpate camera 1", "K": [[1]]}'):
        card.write_text(text)
        with pytest.raises(InputError, match=r"camera\.json"):
            vision.Camera.load(card)
    with pytest.raises(InputError, match="not a camera card"):
        vision.Camera.load(tmp_path / "none.json")


def test_a_camera_serves_other_resolutions_but_no_crops(camera):
    half = camera.for_picture(640, 360)
    np.testing.assert_allclose(
        half.project([0.1, 0.05, 1.0]), (camera.project([0.1, 0.05, 1.0]) + 0.5) / 2 - 0.5
    )
    assert camera.for_picture(1280, 720) is camera
    with pytest.raises(InputError, match="calibrated for 1280x720"):
        camera.for_picture(640, 480)
    for K in (np.eye(2), np.diag([-1.0, 1, 1]), np.full((3, 3), np.nan)):
        with pytest.raises(InputError, match="camera: K"):
            vision.Camera(K, np.zeros(5), (640, 480))
    with pytest.raises(InputError, match="distortion"):
        vision.Camera(np.eye(3), np.zeros(4), (640, 480))
    with pytest.raises(InputError, match="rigid"):
        vision.Camera(np.eye(3), np.zeros(5), (640, 480), 2.0 * np.eye(4))


# --- the published method --------------------------------------------------------------------------------------------


def test_the_published_method_finds_an_evenly_coloured_rectangle():
    image = np.full((480, 640, 3), (60, 160, 60), np.uint8)
    corners = np.array([[110, 100], [540, 110], [535, 380], [115, 370]])
    cv2.fillConvexPoly(image, corners, (220, 200, 180))
    cv2.circle(image, (250, 180), 12, (40, 40, 200), -1)
    grown = published.regions(image)
    assert [r.seed for r in grown] == [(160, 240), (320, 240), (480, 240)]
    region = vision.detect_published(image)
    assert board_detection.corner_error(region.corners, corners.astype(float)) < 4.0
    assert region.mask[240, 320] and not region.mask[50, 50]
    (hole,) = region.holes
    np.testing.assert_allclose(hole.mean(0), [250, 180], atol=2.0)
    assert vision.detect_published(image, aspect=(2.0, 3.0)) is None
    assert vision.detect_published(image, area=0.9) is None
    sight = vision.see(image, method="published")
    assert sight.dirty and len(sight.ink.polygons) == 1


def test_the_published_checks():
    square = np.array([[0.0, 0], [10, 0], [10, 10], [0, 10]])
    assert published.rectangular(square, (1.0, 2.0), 20.0)
    assert not published.rectangular(square * [3, 1], (1.0, 2.0), 20.0)
    assert not published.rectangular(square + np.array([[0, 0], [0, 0], [6, 0], [6, 0]]), (1.0, 2.0), 20.0)


def test_hue_is_noise_on_white(plain):
    assert vision.see(plain, method="published").board is None


# --- wrong input, and the command ------------------------------------------------------------------------------------


def test_what_is_no_picture_is_told(tmp_path):
    for array in (np.zeros((480, 640)), np.zeros((480, 640, 2), np.uint8), np.zeros((480,), np.uint8)):
        with pytest.raises(InputError, match="expected uint8"):
            vision.see(array)
    with pytest.raises(InputError, match="too few"):
        vision.see(np.zeros((20, 640), np.uint8))
    with pytest.raises(InputError, match="cannot be read"):
        vision.load(tmp_path / "none.png")
    for content in (b"", b"no picture", b"\x89PNG\r\n\x1a\n" + bytes(40)):
        (tmp_path / "bad.png").write_bytes(content)
        with pytest.raises(InputError, match=r"bad\.png: not a picture"):
            vision.load(tmp_path / "bad.png")


def test_wrong_options_are_told(plain, camera):
    with pytest.raises(InputError, match="no method 'publish'.*published"):
        vision.see(plain, method="publish")
    with pytest.raises(InputError, match="board size"):
        vision.see(plain, size=(0.0, 1.0))
    with pytest.raises(InputError, match="calibrated for"):
        vision.see(plain[:600], camera=camera)
    with pytest.raises(PalpateError, match="ChArUco"):
        vision.charuco((7, 5), 0.03, 0.04)


@pytest.fixture
def command(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PALPATE_DEBUG", raising=False)

    def run(*arguments):
        code = main([str(a) for a in arguments])
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return run


def test_palpate_see(command, plain, camera, tmp_path):
    cv2.imwrite("photo.png", plain)
    camera.save("camera.json")
    code, out, _ = command(
        "see", "photo.png", "--board-size", 0.9, 0.6, "--camera", "camera.json", "-o", "a.png", "--json"
    )
    seen = json.loads(out)
    assert (
        code == 0 and seen["found"] and seen["dirty"] and seen["unit"] == "m" and seen["size"] == [0.9, 0.6]
    )
    assert len(seen["T_camera_board"]) == 4 and seen["T_base_board"] is None and seen["remarks"] == []
    assert cv2.imread("a.png").shape == plain.shape
    assert not np.array_equal(cv2.imread("a.png"), plain)
    code, out, _ = command("see", "photo.png")
    assert (
        code == 0 and "dirty" in out and "not calibrated" in out and (tmp_path / "photo-seen.png").is_file()
    )
    assert command("see", "photo.png", "--quiet")[:2] == (0, "dirty\n")


def test_palpate_see_says_what_is_odd(command, plain):
    """Grey, 10 megapixels, half out of view, two boards, a corner out of view."""
    left = np.array([[60.0, 100], [560, 120], [550, 520], [70, 540]])
    right = np.array([[760.0, 250], [1180, 230], [1190, 540], [765, 520]])
    pictures = {
        "grey": (cv2.cvtColor(plain, cv2.COLOR_BGR2GRAY), None),
        "large": (cv2.resize(plain, (4224, 2376), interpolation=cv2.INTER_LINEAR), None),
        "half": (picture(VIEW - np.array([330.0, 0.0])), "partly out of view"),
        "two": (picture(right, onto=picture(left)), "2 boards are in view"),
    }
    for name, (image, remark) in pictures.items():
        cv2.imwrite(f"{name}.png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
        code, out, _ = command("see", f"{name}.png", "--json")
        seen = json.loads(out)
        assert code == 0 and seen["found"] and seen["height"] == image.shape[0], name
        assert len(seen["boards"][0]["corners_sigma_px"]) == 4
        assert (remark is None) or any(remark in r for r in seen["remarks"]), name
        assert any("not calibrated" in r for r in seen["remarks"]), name
    cv2.imwrite("corner.png", picture(VIEW + np.array([420.0, 260.0])))
    code, out, err = command("see", "corner.png")
    assert code == 2 and out == "" and "all of it in view but at most one side" in err


def test_palpate_see_says_why_it_cannot(command, plain):
    cv2.imwrite("photo.png", plain)
    cv2.imwrite("none.png", np.full((480, 640, 3), 200, np.uint8))
    for arguments, message in (
        (("none.png",), "no whiteboard found"),
        (("missing.png",), "cannot be read"),
        (("photo.png", "--method", "best"), "no method 'best'"),
        (("photo.png", "--camera", "none.json"), "not a camera card"),
        (("photo.png", "--board-size", 0, 1), "board size"),
        (("photo.png", "--method", "published"), "no whiteboard found (published)"),
    ):
        code, out, err = command("see", *arguments)
        assert code == 2 and out == "" and message in err and len(err.splitlines()) == 1, err
    with open("notes.png", "w") as file:
        file.write("mine")
    assert command("see", "photo.png", "-o", "notes.png")[0] == 2
    assert open("notes.png").read() == "mine"


# --- the photographs -------------------------------------------------------------------------------------------------


def photographs():
    """The names in the annotations; a placeholder where there are none, so that the test says it was skipped."""
    from palpate import data

    folder = data.local("whiteboards")
    if folder is None:
        return ["none"]
    return [note["file"] for note in json.loads((folder / "annotations.json").read_text(encoding="utf-8"))]


@pytest.mark.parametrize("name", photographs())
def test_photographs(name):
    folder = recording("whiteboards", "annotations.json").parent
    notes = {
        note["file"]: note for note in json.loads((folder / "annotations.json").read_text(encoding="utf-8"))
    }
    photo = board_detection.measure_photo((str(folder), notes[name]))
    assert photo.found == photo.expected and photo.right
    if photo.expected:
        assert photo.overlap["lines"] >= board_detection.OVERLAP
        assert photo.clean[0] == 0 and photo.glare[0] == 0
        assert photo.ink[0] >= photo.ink[1] - 1


def test_the_study_runs(monkeypatch):
    monkeypatch.setattr(board_detection, "QUICK", (1, 1, 1, 1))
    monkeypatch.setattr("os.cpu_count", lambda: 1)  # in this process
    monkeypatch.setattr(board_detection, "_photographs", list)
    from palpate.studies import STUDIES

    result = STUDIES["board-detection"].run(quick=True)
    assert result.ok and {r.ok for r in result.rows} == {None}
    assert any("none found" in r.what for r in result.rows)
