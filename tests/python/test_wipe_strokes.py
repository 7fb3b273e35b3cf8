"""Laws of the eraser's way: all dirt is rubbed, nothing else is touched, the way is short and can be followed."""

from __future__ import annotations

import itertools
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

shapely = pytest.importorskip("shapely", reason="palpate[wipe] is not installed")
cv2 = pytest.importorskip("cv2", reason="palpate[vision] is not installed")

from palpate import robots, vision, wipe  # noqa: E402
from palpate.errors import InputError  # noqa: E402
from palpate.wipe import _tour  # noqa: E402

SIZE = (0.9, 0.6)
quick = settings(max_examples=25, deadline=None, derandomize=True)


def rubbed(plan, points):
    """(N,) how far the eraser slides over each point [m], from the legs alone."""
    w, h = plan.footprint
    total = np.zeros(len(points))
    for leg in plan.legs:
        if leg.phase != "slide" or leg.length == 0.0:
            continue
        s = np.linspace(0.0, 1.0, max(2, round(leg.length / 2e-4)))
        at = leg.start[:2] + s[:, None] * (leg.end - leg.start)[:2]
        off = np.abs(points[:, None] - at)
        on = (off[..., 0] <= 0.5 * w + 1e-6) & (off[..., 1] <= 0.5 * h + 1e-6)
        total = np.maximum(total, on.mean(1) * leg.length)
    return total


def blots(seed, count, spread=0.02):
    rng = np.random.default_rng(seed)
    return [
        rng.random(2) * SIZE + spread * rng.standard_normal((rng.integers(1, 9), 2)) for _ in range(count)
    ]


def inside(polygons, seed, count=300):
    """Points in the polygons and on the board."""
    area = shapely.union_all([wipe.strokes.shape(p, "p") for p in polygons]).intersection(
        shapely.box(0, 0, *SIZE)
    )
    points = np.random.default_rng(seed).random((4000, 2)) * SIZE
    corners = shapely.get_coordinates(area)
    points = np.concatenate((corners, points[shapely.contains_xy(area, points)]))
    return points[:: max(1, len(points) // count)]


@quick
@given(seed=st.integers(0, 10_000), count=st.integers(1, 12), block=st.booleans())
@example(seed=433, count=8, block=False)  # a crumb in a corner
def test_all_dirt_is_rubbed_and_nothing_else_is_touched(seed, count, block):
    dirty = blots(seed, count)
    rng = np.random.default_rng(seed + 1)
    c = rng.random(2) * SIZE
    keep = [c + 0.015 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])] if block else []
    plan = wipe.plan(dirty, SIZE, keep=keep)
    points = inside(dirty, seed)
    given_up = shapely.union_all([shapely.Polygon(p) for p in plan.left])
    taboo = shapely.union_all([shapely.Polygon(p) for p in keep])
    told = given_up.union(taboo.buffer(0.0031, join_style="mitre")).buffer(1e-5)
    points = points[~shapely.intersects_xy(told, points)]
    if len(points):
        assert rubbed(plan, points).min() >= plan.eraser.rub - 1e-3  # the sampling of rubbed()
    for stroke in plan.strokes:
        for a, b in itertools.pairwise(stroke):
            way = wipe.swept(a, b, plan.footprint)
            low, high = np.array(way.bounds[:2]), np.array(way.bounds[2:])
            assert low.min() >= -1e-9 and np.all(high <= np.array(SIZE) + 1e-9)
            if keep:
                assert way.distance(taboo) >= 0.003 - 1e-6


def test_only_corners_are_given_up_where_nothing_is_in_the_way():
    whole = np.array([[0, 0], [0.9, 0], [0.9, 0.6], [0, 0.6]])
    plan = wipe.plan([whole], SIZE)
    assert sum(shapely.Polygon(p).area for p in plan.left) < 4 * 0.02**2 * 1.2
    for patch in plan.left:
        assert np.all(np.minimum(patch.mean(0), SIZE - patch.mean(0)) < 0.02)


def test_a_clean_board_needs_nothing():
    plan = wipe.plan([], SIZE)
    assert plan.strokes == () and plan.legs == () and plan.left == ()
    assert wipe.plan([[[1.2, 0.3], [1.3, 0.3], [1.3, 0.4]]], SIZE).strokes == ()  # beside the board


def test_legs_hang_together():
    plan = wipe.plan(blots(3, 8), SIZE, start=(0.1, 0.1))
    legs = plan.legs
    for a, b in itertools.pairwise(legs):
        np.testing.assert_array_equal(a.end, b.start)
    assert [leg.phase for leg in legs[:3]] == ["approach", "touch", "slide"]
    assert legs[-1].phase == "lift"
    for a, b in itertools.pairwise(legs):
        assert (
            b.phase
            in {"approach": "touch", "touch": "slide", "slide": ("slide", "lift"), "lift": "approach"}[
                a.phase
            ]
        )


@quick
@given(
    length=st.floats(0.0, 2.0),
    speed=st.floats(0.01, 0.5),
    acceleration=st.floats(0.1, 2.0),
    t=st.floats(0, 1),
)
def test_a_leg_starts_and_ends_at_rest_within_its_bounds(length, speed, acceleration, t):
    leg = wipe.Leg("slide", np.zeros(3), np.array([0.6 * length, 0.8 * length, 0.0]), speed, acceleration)
    for end, when in ((leg.start, 0.0), (leg.end, leg.duration)):
        x, v = leg.at(when)
        np.testing.assert_allclose(x, end, atol=1e-12)
        np.testing.assert_allclose(v, 0.0, atol=1e-9)
    h = 1e-6
    (x0, v0), (x1, v1) = leg.at(t * leg.duration), leg.at(t * leg.duration + h)
    assert np.linalg.norm(v0) <= speed + 1e-12
    assert np.linalg.norm(v1 - v0) <= acceleration * h + 1e-12
    np.testing.assert_allclose(x1 - x0, v0 * h, atol=acceleration * h * h + 1e-12)


def cost(ends, start, way):
    at, total = start, 0.0
    for i, backwards in way:
        a, b = ends[i][::-1] if backwards else ends[i]
        total, at = total + np.linalg.norm(a - at), b
    return total


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_the_order_is_the_shortest(n):
    for seed in range(5):
        ends = np.random.default_rng(seed).random((n, 2, 2))
        start = np.array([0.5, 0.5])
        best = min(
            cost(ends, start, list(zip(order, ways, strict=True)))
            for order in itertools.permutations(range(n))
            for ways in itertools.product([False, True], repeat=n)
        )
        assert cost(ends, start, _tour.order(ends, start)) <= best * 1.002


def test_a_long_order_visits_all_and_beats_the_nearest_next():
    ends = np.random.default_rng(0).random((50, 2, 2))
    way = _tour.order(ends, np.zeros(2))
    assert sorted(i for i, _ in way) == list(range(50))
    at, left, greedy = np.zeros(2), set(range(50)), []
    while left:
        i, b = min(
            ((i, b) for i in left for b in (False, True)),
            key=lambda c: np.linalg.norm(ends[c[0]][int(c[1])] - at),
        )
        greedy.append((i, b))
        left.remove(i)
        at = ends[i][int(not b)]
    assert cost(ends, np.zeros(2), way) < cost(ends, np.zeros(2), greedy)


# -- what goes and what stays ----------------------------------------------


def square(x, y, s=0.02):
    return np.array([[x, y], [x + s, y], [x + s, y + s], [x, y + s]])


def test_choices():
    ink = [square(0.1, 0.1), square(0.5, 0.3)]
    region = square(0.05, 0.05, 0.2)
    all_ = wipe.choose(ink)
    assert len(all_.wipe) == 2 and not all_.keep
    only = wipe.choose(ink, within=region)
    assert len(only.wipe) == 1 and only.wipe[0].max() < 0.2 and only.keep[0].min() > 0.2
    but = wipe.choose(ink, without=region)
    assert but.wipe[0].min() > 0.2 and len(but.keep) == 2
    red = wipe.choose(ink, colours=("red", "black"), colour="red")
    assert len(red.wipe) == 1 and red.wipe[0].max() < 0.2
    for bad, message in (
        ({"colour": "rad", "colours": ("red", "red")}, "no colour 'rad'; did you mean 'red'?"),
        ({"colour": "red"}, "the colour of each of 2 pieces of ink is needed, got none"),
    ):
        with pytest.raises(InputError, match=message):
            wipe.choose(ink, **bad)


def test_kept_ink_is_not_touched():
    ink = [square(0.2, 0.3), square(0.4, 0.3)]
    chosen = wipe.choose(ink, colours=("red", "black"), colour="red")
    plan = wipe.plan(chosen.wipe, SIZE, keep=chosen.keep)
    assert plan.strokes and not plan.left
    kept = shapely.Polygon(ink[1])
    for stroke in plan.strokes:
        for a, b in itertools.pairwise(stroke):
            assert wipe.swept(a, b, plan.footprint).distance(kept) > 0.002


def test_the_colour_of_ink():
    markers = {
        "black": (40, 40, 40),
        "red": (45, 40, 200),
        "blue": (190, 70, 30),
        "green": (70, 150, 30),
        "purple": (160, 40, 110),
    }
    picture = np.full((500, 700, 3), 60, np.uint8)
    cv2.rectangle(picture, (50, 50), (650, 450), (225, 228, 226), -1)
    for k, bgr in enumerate(markers.values()):
        cv2.line(picture, (100, 100 + 60 * k), (300, 120 + 60 * k), bgr, 6)
    picture = (picture * np.array([0.8, 1.0, 1.0])).astype(np.uint8)  # a warm lamp
    sight = vision.see(picture, size=(0.6, 0.4))
    found = dict(
        zip(wipe.ink_colours(picture, sight), [p[:, 1].mean() for p in sight.ink.polygons], strict=True)
    )
    assert set(found) == set(markers)
    assert [name for name, _ in sorted(found.items(), key=lambda c: c[1])] == list(markers)


# -- the arm ---------------------------------------------------------------


@pytest.fixture(scope="module")
def arm():
    return robots.load("kuka_lbr_iiwa7")


def table(x, y, z):
    """A board lying on a table with its corner 0 at (x, y, z): x to the left, y towards the base, z down."""
    T = np.eye(4)
    T[:3, :3] = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]).T
    T[:3, 3] = x, y, z
    return T


def test_a_near_board_is_reached(arm):
    T = table(0.35, -0.2, 0.2)
    plan = wipe.plan([square(0.05, 0.05), square(0.3, 0.15)], (0.4, 0.25))
    reach = wipe.reachable(arm, plan, T)
    assert reach.ok and reach.reason == ""
    poses = wipe.tool_poses(reach.points, T, plan.angle + reach.turn)
    for q, pose in zip(reach.q, poses, strict=True):
        found = arm.forward_kinematics(q)
        assert np.linalg.norm(found[:3, 3] + found[:3, :3] @ arm.grasp - pose[:3, 3]) < 1e-3
        assert np.linalg.norm(found[:3, :3] - pose[:3, :3]) < 5e-3
        assert all(j.limits.lower < x < j.limits.upper for j, x in zip(arm.joints, q, strict=True))
    assert np.abs(np.diff(reach.q, axis=0)).max() < 0.6
    assert reach.manipulability > 0.01


def test_no_leg_asks_for_more_than_the_bounds_give_the_arm(arm):
    T = table(0.35, -0.2, 0.2)
    bounds = {"max_force": 5.0, "max_torque": 2.0, "normal_force": 2.5}
    free = {"slide": np.sqrt(5.0**2 - 2.5**2) - 0.5 * 2.5}  # what the bound and friction leave
    for asked in (5.0, 0.01):
        plan = wipe.plan([square(0.05, 0.05)], (0.4, 0.25), motion=wipe.Motion(acceleration=asked))
        reach = wipe.reachable(arm, plan, T)
        legs = wipe.paced(arm, plan, reach, T, **bounds)
        assert [(a.phase, *a.start, *a.end) for a in legs] == [(a.phase, *a.start, *a.end) for a in plan.legs]
        for leg in legs:
            assert 0.0 < leg.acceleration <= asked
            way = T[:3, :3] @ ((leg.end - leg.start) * [1.0, 1.0, -1.0] / leg.length)
            for end in (leg.start, leg.end):
                q = reach.q[np.linalg.norm(reach.points - end, axis=1).argmin()]
                J = arm.jacobian(q, arm.grasp)
                inertia = np.linalg.inv(J @ np.linalg.solve(arm.mass_matrix(q), J.T))
                needed = inertia[:, :3] @ way * leg.acceleration
                assert np.linalg.norm(needed[:3]) < free.get(leg.phase, 5.0)
                assert np.linalg.norm(needed[3:]) < 2.0
    assert {leg.acceleration for leg in legs} == {0.01}
    far = wipe.reachable(arm, plan, table(2.0, -0.2, 0.2))
    with pytest.raises(InputError, match="does not get everywhere"):
        wipe.paced(arm, plan, far, table(2.0, -0.2, 0.2), **bounds)


def test_a_far_board_is_not_and_it_says_why(arm):
    plan = wipe.plan([square(0.05, 0.05)], (0.4, 0.25))
    far = wipe.reachable(arm, plan, table(2.0, 0.0, 0.2))
    assert not far.ok and "no pose of the arm puts the eraser at" in far.reason
    half = wipe.reachable(
        arm, wipe.plan([np.array([[0.0, 0.1], [1.0, 0.1]])], (1.2, 0.25)), table(0.5, -0.2, 0.2)
    )
    assert not half.ok and "on the board" in half.reason and len(half.q)


def test_without_the_extra_it_is_named():
    code = (
        "import sys; sys.modules['shapely'] = None\n"
        "from palpate.errors import MissingExtraError\n"
        "try: import palpate.wipe\n"
        "except MissingExtraError as e: assert 'palpate[wipe]' in str(e)\n"
        "else: raise AssertionError"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: wipe.plan([[[0.0, np.nan]]], SIZE), "dirty: an outline must be finite and (M, 2) [m]"),
        (lambda: wipe.plan([], (0.9, -1)), "size of the board must be a finite length > 0 m, got -1"),
        (lambda: wipe.plan([], (0.04, 0.04)), "does not fit on a board of 0.04 m x 0.04 m"),
        (lambda: wipe.Eraser(overlap=0.06), "eraser: overlap must be from 0 to below 0.05 m, got 0.06"),
        (lambda: wipe.Eraser(rub=0.06), "eraser: rub must be at most its shorter side 0.05 m"),
        (lambda: wipe.Motion(speed=0.0), "motion: speed must be finite and > 0, got 0.0"),
    ],
)
def test_wrong_input_is_one_line(call, message):
    with pytest.raises(InputError) as caught:
        call()
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
