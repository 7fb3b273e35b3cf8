"""Laws of ink: it goes only under pressure that slides, never comes back by rubbing, and is never less than none."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

cv2 = pytest.importorskip("cv2", reason="palpate[vision] is not installed")
pytest.importorskip("shapely", reason="palpate[wipe] is not installed")

from palpate import vision, wipe  # noqa: E402
from palpate.errors import InputError  # noqa: E402
from palpate.wipe import ink  # noqa: E402

FELT = (0.05, 0.11)
quick = settings(max_examples=40, deadline=None, derandomize=True)


def soiled(toughness=ink.FRESH, size=(0.3, 0.2)):
    layer = wipe.InkLayer(size)
    layer.stroke([[0.0, 0.5 * size[1]], [size[0], 0.5 * size[1]]], width=0.02, toughness=toughness)
    return layer


def sweep(layer, force, *, y=0.1, passes=1, step=4e-4, pressure=None):
    """Slide the felt along x over the whole layer, `force` [N] evenly."""
    p = force / (FELT[0] * FELT[1]) if pressure is None else pressure
    for k in range(passes):
        way = np.arange(-0.03, layer.size[0] + 0.03, step)
        for x in way if k % 2 == 0 else way[::-1]:
            layer.rub((x, y), 0.0, FELT, p, (step, 0.0))
    return layer


@quick
@given(
    x=st.floats(-0.1, 0.4),
    y=st.floats(-0.1, 0.3),
    angle=st.floats(-4, 4),
    pressure=st.lists(st.floats(-100, 5000), min_size=6, max_size=6),
    slide=st.tuples(st.floats(-0.01, 0.01), st.floats(-0.01, 0.01)),
    turn=st.floats(-0.1, 0.1),
)
def test_rubbing_only_takes_and_never_below_nothing(x, y, angle, pressure, slide, turn):
    layer = soiled()
    before = layer.amount.copy()
    gone = layer.rub((x, y), angle, FELT, np.reshape(pressure, (2, 3)), slide, turn)
    assert np.all(layer.amount <= before) and layer.amount.min() >= 0.0
    lost = (before.astype(float) - layer.amount).sum() * layer.texel**2
    assert gone == pytest.approx(lost, rel=1e-4, abs=1e-12)
    # not beyond the felt
    far = np.hypot(*FELT) / 2 + layer.texel
    rows, columns = np.indices(before.shape)
    away = np.hypot((columns + 0.5) * layer.texel - x, (rows + 0.5) * layer.texel - y) > far
    np.testing.assert_array_equal(layer.amount[away], before[away])


def test_nothing_goes_without_pressure_or_without_sliding():
    layer = soiled()
    before = layer.amount.copy()
    assert layer.rub((0.15, 0.1), 0.0, FELT, 5000.0, (0.0, 0.0)) == 0.0
    assert layer.rub((0.15, 0.1), 0.0, FELT, 0.0, (0.01, 0.0)) == 0.0
    assert layer.rub((0.15, 0.1), 0.0, FELT, 0.99 * ink.LEAST_PRESSURE, (0.01, 0.0)) == 0.0
    np.testing.assert_array_equal(layer.amount, before)


@quick
@given(p=st.floats(ink.LEAST_PRESSURE, 2000), more=st.floats(1, 3), slide=st.floats(1e-4, 0.02))
def test_more_pressure_or_more_way_takes_no_less(p, more, slide):
    least, pressed, slid = (soiled() for _ in range(3))
    a = least.rub((0.15, 0.1), 0.3, FELT, p, (slide, 0.0))
    assert pressed.rub((0.15, 0.1), 0.3, FELT, more * p, (slide, 0.0)) >= a
    assert slid.rub((0.15, 0.1), 0.3, FELT, p, (more * slide, 0.0)) >= a
    assert np.all(pressed.amount <= least.amount) and np.all(slid.amount <= least.amount)


def test_the_work_is_what_counts():
    """One layer goes after toughness / pressure of way, however it is cut into steps."""
    for steps in (1, 7, 50):
        layer = soiled()
        way = 0.5 * ink.FRESH / 400.0  # half of what takes all
        for _ in range(steps):
            layer.rub((0.15, 0.1), 0.0, FELT, 400.0, (0.0, way / steps))
        assert layer.amount[100, 150] == pytest.approx(0.5, abs=1e-3)


def test_fresh_ink_goes_in_one_pass_and_dry_ink_takes_more():
    assert sweep(soiled(), 2.5).area == 0.0
    dry = soiled(ink.DRY)
    first = dry.area
    assert sweep(dry, 2.5).area > 0.9 * first
    assert sweep(dry, 2.5, passes=2).area == 0.0


def test_poor_contact_leaves_ink():
    """A tilted block presses with one half only: the ink under the other half stays."""
    layer = soiled()
    tilted = np.zeros((1, 4))
    tilted[0, :2] = 900.0  # the half towards smaller y
    sweep(layer, 0.0, y=0.1, pressure=tilted)
    assert not layer.visible[92:98].any()
    assert layer.visible[103:108].all()


def test_turning_rubs_too_but_not_in_the_middle():
    layer = wipe.InkLayer((0.3, 0.2))
    layer.amount[:] = 1.0
    for _ in range(100):
        layer.rub((0.15, 0.1), 0.0, FELT, 800.0, (0.0, 0.0), 0.01)
    assert layer.amount[100, 150] > 0.9
    assert layer.amount[140, 150] == 0.0


def test_the_angle_turns_from_x_to_y():
    layer = wipe.InkLayer((0.3, 0.2))
    layer.amount[:] = 1.0
    layer.rub((0.15, 0.1), np.pi / 4, (0.1, 0.01), 1e5, (0.01, 0.0))
    assert layer.amount[130, 180] == 0.0 and layer.amount[70, 180] == 1.0


@pytest.mark.parametrize("seed", range(3))
def test_handwriting_is_seen_where_it_is(seed):
    """What the layer calls ink is what vision finds in its picture."""
    layer = wipe.InkLayer((0.9, 0.6))
    ink.handwriting(layer, seed)
    again = wipe.InkLayer((0.9, 0.6))
    ink.handwriting(again, seed)
    np.testing.assert_array_equal(layer.rgb, again.rgb)
    assert 0.005 < layer.area / 0.54 < 0.2
    frame = 40
    scene = cv2.copyMakeBorder(
        layer.rgb[..., ::-1].copy(), frame, frame, frame, frame, cv2.BORDER_CONSTANT, value=(120, 110, 100)
    )
    scene = cv2.copyMakeBorder(scene, 60, 60, 60, 60, cv2.BORDER_CONSTANT, value=(60, 70, 80))
    corner = frame + 60 - 0.5
    corners = corner + np.array([[0, 0], [900, 0], [900, 600], [0, 600]])
    found = vision.ink(scene, corners).mask[100:700, 100:1000]
    clear = layer.amount > 0.9
    assert (found & clear).sum() > 0.9 * clear.sum()
    assert (found & ~cv2.dilate(layer.visible.astype(np.uint8), np.ones((9, 9))).astype(bool)).sum() == 0


@pytest.mark.parametrize("width", [0.002, 0.005, 0.02])
@pytest.mark.parametrize("turn", [0.0, 0.6])
def test_a_stroke_is_as_wide_as_asked(width, turn):
    layer = wipe.InkLayer((0.3, 0.2))
    layer.stroke(np.array([0.15, 0.1]) + np.outer([-0.08, 0.08], [np.cos(turn), np.sin(turn)]), width=width)
    wanted = 0.16 * width + 0.25 * np.pi * width**2  # with round ends
    assert layer.amount.sum() * layer.texel**2 == pytest.approx(wanted, rel=0.15)


def test_a_clean_layer_looks_clean():
    layer = wipe.InkLayer((0.9, 0.6))
    ink.handwriting(layer, 1)
    layer.amount[:] = 0.0
    assert layer.area == 0.0
    assert np.all(layer.rgb == ink.WHITE)


def test_any_picture():
    layer = wipe.InkLayer((0.4, 0.2))
    image = np.full((50, 50, 3), 255, np.uint8)
    image[10:40, 10:40] = (200, 0, 0)
    image[20:30, 20:30] = 0
    layer.picture(image)
    seen = layer.rgb
    assert tuple(seen[100, 200]) == (0, 0, 0)
    assert seen[60, 200, 0] > 150 and seen[60, 200, 1] < 20
    assert not layer.visible[:, :90].any() and not layer.visible[:30].any()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda a: a.stroke([[0, 0, 0]]),
            "a stroke's points must be finite and (K, 2) [m], got shape (1, 3)",
        ),
        (lambda a: a.stroke([[0, 0], [1, 1]], colour="pink"), "no marker 'pink'; there are black, red"),
        (lambda a: a.stroke([[0, 0]], toughness=0.0), "toughness must be finite and > 0, got 0.0"),
        (lambda a: a.picture(np.zeros((4, 4))), "a picture must be uint8"),
        (
            lambda a: a.rub((0, np.nan), 0.0, FELT, 1.0, (0, 0)),
            "rub: centre, slide and pressure must be finite",
        ),
        (lambda a: wipe.InkLayer((0.0, 1.0)), "ink: size and texel must be finite lengths > 0 m, got 0.0"),
    ],
)
def test_wrong_input_is_one_line(call, message):
    with pytest.raises(InputError) as caught:
        call(wipe.InkLayer((0.1, 0.1)))
    assert message in str(caught.value) and "\n" not in str(caught.value)
