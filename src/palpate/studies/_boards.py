"""Whiteboards drawn with OpenCV: a random board, its ink, its room, its light and its camera, with the truth beside.

Everything is drawn from a seed. The board is a flat texture (frame, surface, handwriting, smudges) that a pinhole
camera sees through a homography; room, shadows, reflections, lens distortion, blur, noise and JPEG come on top.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from ..arm import Array

Image = npt.NDArray[np.uint8]
Float = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

WIDTH, HEIGHT = 1280, 720
MARGIN = 40
"""around a board's texture [pixels]"""
_WORDS = (
    "force torque mass board erase plan clean arm tau = J F m g sin(q) + b t 0.25 kg 9.81 Monday note call lab"
    " budget 42 % todo x^2 -> robot meeting 14:30 room B.12 error? yes no item (a) (b) f(x) = ax + b"
).split()
_FONTS = (
    cv2.FONT_HERSHEY_SIMPLEX,
    cv2.FONT_HERSHEY_SCRIPT_SIMPLEX,
    cv2.FONT_HERSHEY_SCRIPT_COMPLEX,
    cv2.FONT_HERSHEY_COMPLEX_SMALL,
)
_PENS = ((35, 30, 30), (150, 60, 25), (40, 35, 190), (60, 120, 30), (30, 25, 25), (160, 70, 30))
"""colours of markers, BGR"""


@dataclass(frozen=True, slots=True)
class Scene:
    """A picture and what is true of it."""

    image: Image
    """(H, W, 3) BGR"""
    corners: Array | None
    """(4, 2) of the writing surface [pixels], clockwise from the top-left one of the board; None: no board"""
    beside: Array | None
    """(4, 2) of a second board's, to the right of it; None: there is none"""
    ink: Mask
    """(H, W) where ink is, at least half opaque"""
    clean: Mask
    """(H, W) writing surface without ink, smudge, magnet or anything else that is not the bare surface nearby"""
    dirty: bool
    """there is writing"""
    frame: str
    """kind of frame"""


def scene(
    seed: int, *, board: bool = True, dirty: bool | None = None, two: bool = False, dazzled: bool = False
) -> Scene:
    """One random picture.

    Args:
        seed: the same seed, the same picture.
        board: False: the room alone.
        dirty: with writing or without; None: four of five have some.
        two: two boards of one height beside each other, often of one make, their frames up to 20 mm apart.
        dazzled: light so strong that the picture is white lies over a whole side of the board, frame and wall.
    """
    rng = np.random.default_rng(seed)
    written = bool(rng.random() < 0.8) if dirty is None else dirty
    surface = _white(rng)
    room = _room(rng, surface)
    truth = None
    ink = np.zeros((2 * HEIGHT, 2 * WIDTH), np.uint8)
    bare = np.zeros_like(ink)
    kind = ""
    if board:
        texture, alpha, marks, spoiled, inner, kind = (
            _pair(rng, surface, written) if two else _board(rng, _size(rng), surface, written)
        )
        H = _view(rng, texture.shape[1], texture.shape[0])
        full = (2 * WIDTH, 2 * HEIGHT)
        seen = cv2.warpPerspective(texture, H, full, flags=cv2.INTER_LINEAR)
        opaque = cv2.warpPerspective(alpha, H, full, flags=cv2.INTER_LINEAR)[..., None]
        room = _drop_shadow(rng, room, opaque[..., 0])
        room = room * (1.0 - opaque) + seen * opaque
        ink = cv2.warpPerspective(marks, H, full, flags=cv2.INTER_LINEAR)
        surface_mask = np.zeros(alpha.shape, np.uint8)
        for corners in inner.reshape(-1, 4, 2):
            cv2.fillConvexPoly(surface_mask, np.int32(np.rint(corners)), 255)
        surface_mask[cv2.dilate(spoiled, np.ones((25, 25), np.uint8)) > 0] = 0
        bare = cv2.erode(
            cv2.warpPerspective(surface_mask, H, full, flags=cv2.INTER_NEAREST), np.ones((25, 25), np.uint8)
        )
        truth = cv2.perspectiveTransform(inner[None].astype(np.float64), H)[0]
        room, covered = _in_front(rng, room, truth[:4])
        bare[covered > 0] = 0
        ink[covered > 0] = 0
        room = _glare(rng, room, truth[:4])
        if dazzled:
            room = _dazzle(rng, room, truth[:4])
    room = _light(rng, room)
    image, (ink, bare), truth = _camera(rng, room, (ink, bare), truth)
    first, beside = (None, None) if truth is None else (truth[:4], truth[4:] if two else None)
    return Scene(image, first, beside, ink > 127, bare > 127, bool(written and board), kind)


def _white(rng: np.random.Generator) -> Array:
    """A board's white, BGR: light, of little colour."""
    return rng.uniform(175, 235) * (1.0 + rng.normal(0.0, 0.02, 3))


def _size(rng: np.random.Generator) -> tuple[int, int]:
    ratio = rng.uniform(1.1, 2.1)
    long = 1500
    wide = (long, round(long / ratio))
    return wide if rng.random() < 0.75 else (wide[1], wide[0])


def _smooth(rng: np.random.Generator, shape: tuple[int, int], cells: int) -> Float:
    """Smooth noise, mean 0, deviation near 1."""
    h, w = shape
    coarse = rng.normal(0.0, 1.0, (max(2, cells * h // max(h, w) + 2), cells + 2)).astype(np.float32)
    return cv2.resize(coarse, (w, h), interpolation=cv2.INTER_CUBIC)


def _blurred(layer: Float, sigma: float) -> Float:
    """Gaussian blur; a wide one on a small copy."""
    if sigma < 10.0:
        return cv2.GaussianBlur(layer, (0, 0), sigma)
    h, w = layer.shape
    small = cv2.resize(layer, (w // 4, h // 4), interpolation=cv2.INTER_AREA)
    return cv2.resize(cv2.GaussianBlur(small, (0, 0), sigma / 4.0), (w, h), interpolation=cv2.INTER_LINEAR)


def _room(rng: np.random.Generator, surface: Array) -> Float:
    """What is behind the board, twice the final size."""
    h, w = 2 * HEIGHT, 2 * WIDTH
    kind = rng.integers(0, 5)
    if kind == 0:  # a wall or table of nearly the board's colour
        base = surface * rng.uniform(0.9, 1.08)
    elif kind == 1:
        base = rng.uniform(140, 235) * (1.0 + rng.normal(0.0, 0.04, 3))
    elif kind == 2:  # wood or carpet
        base = np.array([rng.uniform(30, 110), rng.uniform(70, 140), rng.uniform(100, 190)])
    else:
        base = rng.uniform(30, 200, 3)
    room = np.ones((h, w, 3), np.float32) * base.astype(np.float32)
    room *= 1.0 + 0.05 * _smooth(rng, (h, w), 4)[..., None]
    if kind == 2:
        grain = cv2.resize(
            rng.normal(0, 1, (h // 4, w // 100)).astype(np.float32), (w, h), interpolation=cv2.INTER_CUBIC
        )
        room *= 1.0 + rng.uniform(0.01, 0.06) * grain[..., None]
    else:
        room *= 1.0 + rng.uniform(0.0, 0.02) * _smooth(rng, (h, w), 300)[..., None]
    for _ in range(rng.integers(0, 12)):
        colour = rng.uniform(10, 245, 3) if rng.random() < 0.6 else rng.uniform(0.5, 1.0) * base
        _object(rng, room, tuple(float(c) for c in colour))
    if rng.random() < 0.4:  # floor, table edge, corner of the room
        x = rng.uniform(0, w, 2)
        y = rng.uniform(0.1 * h, 0.9 * h, 2)
        upright = rng.random() < 0.3
        line = [[x[0], 0], [x[1], h], [w, h], [w, 0]] if upright else [[0, y[0]], [w, y[1]], [w, h], [0, h]]
        mask = np.zeros((h, w), np.uint8)
        cv2.fillPoly(mask, [np.array(line, np.int32)], 255)
        room[mask > 0] *= np.float32(rng.uniform(0.45, 0.95))
    return np.clip(room, 0, 255)


def _object(rng: np.random.Generator, room: Float, colour: tuple[float, ...]) -> None:
    """A thing in the room: box, poster, window, disc, cable."""
    h, w = room.shape[:2]
    centre = rng.uniform([0, 0], [w, h])
    size = rng.uniform(30, 500, 2)
    angle = rng.normal(0, 8) if rng.random() < 0.7 else rng.uniform(0, 90)
    box = np.int32(cv2.boxPoints((tuple(centre), tuple(size), angle)))
    kind = rng.integers(0, 5)
    if kind <= 1:
        cv2.fillPoly(room, [box], colour, cv2.LINE_AA)
        if rng.random() < 0.5:
            cv2.polylines(
                room, [box], True, tuple(rng.uniform(0, 255, 3)), int(rng.integers(2, 20)), cv2.LINE_AA
            )
    elif kind == 2:  # a picture: texture in a box
        mask = np.zeros((h, w), np.uint8)
        cv2.fillPoly(mask, [box], 255)
        x, y, bw, bh = cv2.boundingRect(np.clip(box, 0, [w - 1, h - 1]))
        if bw > 4 and bh > 4:
            part = mask[y : y + bh, x : x + bw] > 0
            noise = np.stack([_smooth(rng, (bh, bw), int(rng.integers(4, 30))) for _ in range(3)], -1)
            room[y : y + bh, x : x + bw][part] = (120 + 50 * noise)[part]
    elif kind == 3:
        cv2.ellipse(room, (tuple(centre), tuple(size), angle), colour, -1, cv2.LINE_AA)
    else:
        points = np.cumsum(rng.normal(0, 120, (8, 2)), 0) + centre
        cv2.polylines(room, [np.int32(points)], False, colour, int(rng.integers(2, 14)), cv2.LINE_AA)


def _pair(
    rng: np.random.Generator, surface: Array, written: bool
) -> tuple[Float, Float, Image, Image, Array, str]:
    """Two boards beside each other on one wall, as `_board`; (8, 2) corners."""
    width, high = rng.uniform(600, 1300, 2), round(rng.uniform(700, 1000))
    if rng.random() < 0.5:
        width[1] = width[0]
    make = int(rng.integers(1 << 30))
    makes = (make, make + (rng.random() < 0.3))
    gap = round(rng.uniform(0, 20)) if rng.random() < 0.7 else 0
    left, right = (
        _board(rng, (round(w), high), surface, written, np.random.default_rng(m))
        for w, m in zip(width, makes, strict=True)
    )
    rows = max(left[0].shape[0], right[0].shape[0])
    begin = 0, left[0].shape[1] - 2 * MARGIN + gap  # the margins overlap
    columns = begin[1] + right[0].shape[1]
    texture = np.zeros((rows, columns, 3), np.float32)
    alpha = np.zeros((rows, columns), np.float32)
    marks, spoiled = np.zeros((2, rows, columns), np.uint8)
    layers: tuple[npt.NDArray[Any], ...] = texture, alpha, marks, spoiled
    inner = []
    for board, x in zip((left, right), begin, strict=True):
        y = (rows - board[0].shape[0]) // 2
        solid = board[1] > 0.0
        part = np.s_[y : y + solid.shape[0], x : x + solid.shape[1]]
        for layer, own in zip(layers, board, strict=False):
            layer[part][solid] = np.asarray(own)[solid]
        inner.append(board[4] + [x, y])
    return texture, alpha, marks, spoiled, np.concatenate(inner), left[5]


def _board(
    rng: np.random.Generator,
    size: tuple[int, int],
    surface: Array,
    written: bool,
    make: np.random.Generator | None = None,
) -> tuple[Float, Float, Image, Image, Array, str]:
    """Texture with frame, its opacity, ink, everything on the surface, corners of the surface, kind of frame.

    `make` draws the frame; None: `rng` does.
    """
    w, h = size
    make = make or rng
    kind = str(make.choice(["aluminium", "thin", "wood", "white", "none"], p=[0.5, 0.15, 0.12, 0.13, 0.1]))
    width = {
        "aluminium": make.uniform(15, 75),
        "thin": make.uniform(7, 16),
        "wood": make.uniform(25, 80),
        "white": make.uniform(20, 60),
        "none": 4.0,
    }[kind]
    f = round(min(width, 0.07 * min(w, h)))
    o = f + MARGIN
    texture = np.ones((h + 2 * o, w + 2 * o, 3), np.float32) * surface.astype(np.float32)
    alpha = np.zeros(texture.shape[:2], np.float32)
    outer = (slice(MARGIN, h + 2 * f + MARGIN), slice(MARGIN, w + 2 * f + MARGIN))
    alpha[outer] = 1.0
    inside = (slice(o, o + h), slice(o, o + w))
    _frame(make, texture, kind, f, MARGIN, surface)
    face = texture[inside]
    face[:] = surface * (1.0 + 0.01 * _smooth(rng, (h, w), 5)[..., None])
    marks = np.zeros((h, w), np.uint8)
    spoiled = np.zeros((h, w), np.uint8)
    _smudges(rng, face, spoiled)
    if written:
        _write(rng, face, marks)
    spoiled |= marks
    _magnets(rng, face, marks, spoiled)
    if kind != "none" and rng.random() < 0.4:  # the frame throws a soft shadow on the surface
        depth = rng.uniform(4, 18)
        y = np.arange(h, dtype=np.float32)[:, None, None] / depth
        face *= 1.0 - rng.uniform(0.05, 0.25) * np.exp(-(y**2))
    if kind != "none" and rng.random() < 0.5:
        _caps(rng, texture, alpha, f, MARGIN)
    whole = np.zeros(alpha.shape, np.uint8)
    dirt = np.zeros(alpha.shape, np.uint8)
    whole[inside], dirt[inside] = marks, spoiled
    # the surface fills pixels o .. o+w-1, so its edges lie half a pixel outside their centres
    inner = np.array([[o, o], [o + w, o], [o + w, o + h], [o, o + h]]) - 0.5
    return np.clip(texture, 0, 255), alpha, whole, dirt, inner, kind


def _frame(rng: np.random.Generator, texture: Float, kind: str, f: int, margin: int, surface: Array) -> None:
    """Four bars, each with a profile across; opposite bars catch other light."""
    h, w = texture.shape[:2]
    base = {
        "aluminium": np.full(3, rng.uniform(120, 190)),
        "thin": rng.choice(np.array([30.0, 90.0, 150.0])) * np.ones(3),
        "wood": np.array([rng.uniform(40, 90), rng.uniform(80, 130), rng.uniform(120, 180)]),
        "white": surface * rng.uniform(0.93, 1.1),
        "none": surface * rng.choice([0.6, 0.75, 1.15]),  # a panel shows its own thickness
    }[kind]
    s = np.linspace(0.0, 1.0, f, dtype=np.float32)
    grooved = kind != "none" and rng.random() < 0.95
    for side in range(4):
        profile = 1.0 + rng.uniform(0.0, 0.25) * np.sin(math.pi * s) * rng.choice([-1, 1])
        if kind == "aluminium":
            profile += 0.25 * np.exp(-(((s - rng.uniform(0.2, 0.8)) / 0.12) ** 2)).astype(np.float32)
        if grooved:  # where frame and surface meet
            profile[-max(1, f // 8) :] *= rng.uniform(0.5, 0.9)
        if rng.random() < 0.8:
            profile[: max(1, f // 10)] *= rng.uniform(0.5, 0.95)
        bar = profile[:, None] * base * rng.uniform(0.8, 1.15)
        if side in (0, 2):
            strip = np.repeat(bar[:, None], w, 1) * (1.0 + 0.03 * _smooth(rng, (1, w), 6)[..., None])
        else:
            strip = np.repeat(bar[None], h, 0) * (1.0 + 0.03 * _smooth(rng, (h, 1), 6)[..., None])
        if side == 0:
            texture[margin : margin + f] = strip
        elif side == 2:
            texture[h - margin - f : h - margin] = strip[::-1]
        elif side == 1:
            texture[margin : h - margin, w - margin - f : w - margin] = strip[margin : h - margin, ::-1]
        else:
            texture[margin : h - margin, margin : margin + f] = strip[margin : h - margin]


def _caps(rng: np.random.Generator, texture: Float, alpha: Float, f: int, margin: int) -> None:
    """Plastic corners."""
    h, w = alpha.shape
    colour = tuple(float(rng.uniform(60, 200)) * np.ones(3))
    r = round(f * rng.uniform(1.0, 1.4))
    for x in (margin, w - margin - r):
        for y in (margin, h - margin - r):
            cv2.rectangle(texture, (x, y), (x + r - 1, y + r - 1), colour, -1)


def _smudges(rng: np.random.Generator, face: Float, spoiled: Image) -> None:
    """Badly wiped places: wide, soft, faint."""
    h, w = face.shape[:2]
    for _ in range(rng.integers(0, 5)):
        layer = np.zeros((h // 4, w // 4), np.float32)
        points = np.cumsum(rng.normal(0, w / 80, (12, 2)), 0) + rng.uniform([0, 0], [w / 4, h / 4])
        cv2.polylines(layer, [np.int32(points)], False, 1.0, int(rng.integers(8, 30)), cv2.LINE_AA)
        layer = cv2.GaussianBlur(layer, (0, 0), rng.uniform(3, 8)) * np.float32(rng.uniform(0.02, 0.12))
        layer = cv2.resize(layer, (w, h))
        face *= 1.0 - layer[..., None] * rng.uniform(0.5, 1.0, 3).astype(np.float32)
        spoiled[layer > 0.01] = 255


def _write(rng: np.random.Generator, face: Float, marks: Image) -> None:
    """Handwriting, drawings and printed strokes in a few pens."""
    h, w = face.shape[:2]
    pens = [_PENS[i] for i in rng.integers(0, len(_PENS), 3)]
    for _ in range(rng.integers(3, 25)):
        layer = np.zeros((h, w), np.uint8)
        at = rng.uniform([0.04 * w, 0.08 * h], [0.85 * w, 0.93 * h])
        thick = int(rng.integers(3, 10))
        if rng.random() < 0.6:
            scale = rng.uniform(1.0, 3.5)
            text = " ".join(rng.choice(_WORDS, rng.integers(1, 4)))
            cv2.putText(
                layer, text, (int(at[0]), int(at[1])), int(rng.choice(_FONTS)), scale, 255, thick, cv2.LINE_AA
            )
        elif rng.random() < 0.6:  # scribbles
            n = int(rng.integers(4, 10))
            knots = np.cumsum(rng.normal(0, rng.uniform(10, 50), (n, 2)), 0) + at
            t = np.linspace(0, n - 1, 12 * n)
            curve = np.stack([np.interp(t, np.arange(n), knots[:, k]) for k in range(2)], 1)
            curve = cv2.GaussianBlur(
                curve.astype(np.float32), (1, 0), sigmaX=1e-3, sigmaY=4.0, borderType=cv2.BORDER_REPLICATE
            )
            cv2.polylines(layer, [np.int32(curve)], False, 255, thick, cv2.LINE_AA)
        else:  # boxes, arrows, circles
            to = at + rng.uniform(-350, 350, 2)
            a, b = tuple(map(int, at)), tuple(map(int, to))
            shape = rng.integers(0, 3)
            if shape == 0:
                cv2.rectangle(layer, a, b, 255, thick, cv2.LINE_AA)
            elif shape == 1:
                cv2.arrowedLine(layer, a, b, 255, thick, cv2.LINE_AA, tipLength=0.1)
            else:
                cv2.ellipse(
                    layer,
                    a,
                    (int(rng.integers(15, 120)), int(rng.integers(15, 120))),
                    0,
                    0,
                    360,
                    255,
                    thick,
                    cv2.LINE_AA,
                )
        edge = 12
        layer[:edge] = layer[-edge:] = 0
        layer[:, :edge] = layer[:, -edge:] = 0
        x, y, bw, bh = cv2.boundingRect(layer)
        if bw < 2 or bh < 2:
            continue
        part = (slice(y, y + bh), slice(x, x + bw))
        opacity = layer[part].astype(np.float32) / 255.0 * np.float32(rng.uniform(0.55, 1.0))
        opacity *= np.clip(1.0 - 0.15 * _smooth(rng, (bh, bw), max(2, max(bh, bw) // 25)), 0.4, 1.0)
        pen = np.array(pens[rng.integers(0, len(pens))], np.float32)
        face[part] = face[part] * (1.0 - opacity[..., None]) + pen * opacity[..., None]
        marks[part][layer[part] > 127] = 255


def _magnets(rng: np.random.Generator, face: Float, marks: Image, spoiled: Image) -> None:
    h, w = face.shape[:2]
    for _ in range(rng.integers(0, 5) if rng.random() < 0.5 else 0):
        x, y = rng.uniform([60, 60], [w - 60, h - 60])
        colour = tuple(float(c) for c in rng.uniform(0, 255, 3))
        layer = np.zeros((h, w), np.uint8)
        if rng.random() < 0.6:
            cv2.circle(layer, (int(x), int(y)), int(rng.integers(22, 45)), 255, -1, cv2.LINE_AA)
        else:
            box = cv2.boxPoints(((x, y), (rng.uniform(80, 180), rng.uniform(45, 90)), rng.uniform(0, 180)))
            cv2.fillPoly(layer, [np.int32(box)], 255, cv2.LINE_AA)
        a = layer.astype(np.float32)[..., None] / 255.0
        face[:] = face * (1 - a) + np.array(colour, np.float32) * a
        marks[layer > 0] = 0
        spoiled[layer > 0] = 255


def _view(rng: np.random.Generator, w: int, h: int) -> Array:
    """Homography from texture pixels to the picture (twice its size): a tilted pinhole camera, all corners in view."""
    while True:
        yaw, pitch, roll = (
            np.radians(rng.uniform(-50, 50)),
            np.radians(rng.uniform(-40, 40)),
            np.radians(rng.normal(0, 8)),
        )
        R = (
            cv2.Rodrigues(np.array([0, 0, roll]))[0]
            @ cv2.Rodrigues(np.array([pitch, 0, 0]))[0]
            @ cv2.Rodrigues(np.array([0, yaw, 0]))[0]
        )
        focal = rng.uniform(0.8, 1.6) * 2 * WIDTH
        plane = (
            np.array([[-w / 2, -h / 2, 0], [w / 2, -h / 2, 0], [w / 2, h / 2, 0], [-w / 2, h / 2, 0]])
            / 1000.0
        )
        seen = plane @ R.T
        depth = rng.uniform(1.2, 6.0)
        seen[:, 2] += depth
        if seen[:, 2].min() < 0.3:
            continue
        p = focal * seen[:, :2] / seen[:, 2:]
        low, high = p.min(0), p.max(0)
        room = np.array([2 * WIDTH, 2 * HEIGHT]) - 40.0
        if np.any(high - low > room) or np.max((high - low) / room) < 0.45:
            continue
        shift = rng.uniform(20 - low, 20 + room - high)
        to = (p + shift).astype(np.float32)
        corners = np.array([[0, 0], [w, 0], [w, h], [0, h]], np.float32) - np.float32(0.5)
        if cv2.contourArea(to) < 0.06 * 4 * WIDTH * HEIGHT:
            continue
        return cv2.getPerspectiveTransform(corners, to)


def _drop_shadow(rng: np.random.Generator, room: Float, opaque: Float) -> Float:
    """The board darkens the wall beside it."""
    if rng.random() < 0.5:
        return room
    dx, dy = rng.uniform(-25, 25, 2)
    moved = cv2.warpAffine(
        opaque, np.array([[1, 0, dx], [0, 1, dy]], np.float32), (opaque.shape[1], opaque.shape[0])
    )
    moved = _blurred(moved, rng.uniform(2, 15))
    return room * (1.0 - np.float32(rng.uniform(0.1, 0.5)) * moved[..., None])


def _in_front(rng: np.random.Generator, room: Float, corners: Array) -> tuple[Float, Image]:
    """Something covers a little of the board's edge: a person, an arm, a plant."""
    covered = np.zeros(room.shape[:2], np.uint8)
    if rng.random() < 0.75:
        return room, covered
    side = rng.integers(0, 4)
    a, b = corners[side], corners[(side + 1) % 4]
    at = a + (b - a) * rng.uniform(0.2, 0.8)
    out = at - corners.mean(0)
    reach = np.linalg.norm(b - a)
    tip = at - out * rng.uniform(0.0, 0.3)
    far = at + out * 3.0
    cv2.line(covered, tuple(map(int, tip)), tuple(map(int, far)), 255, int(rng.uniform(0.05, 0.2) * reach))
    colour = rng.uniform(10, 200, 3).astype(np.float32)
    room = room.copy()
    room[covered > 0] = colour
    return room, covered


def _glare(rng: np.random.Generator, room: Float, corners: Array) -> Float:
    """Lamps and windows mirrored in the surface."""
    mask = np.zeros(room.shape[:2], np.uint8)
    cv2.fillConvexPoly(mask, np.int32(corners), 1)
    for _ in range(rng.integers(0, 3)):
        layer = np.zeros(room.shape[:2], np.float32)
        inside = rng.dirichlet(np.ones(4)) @ corners
        size = rng.uniform(30, 400, 2)
        box = (tuple(map(float, inside)), tuple(map(float, size)), float(rng.normal(0, 20)))
        if rng.random() < 0.5:
            cv2.ellipse(layer, box, 1.0, -1)
        else:
            cv2.fillPoly(layer, [np.int32(cv2.boxPoints(box))], 1.0)
        layer = _blurred(layer, float(np.exp(rng.uniform(np.log(3), np.log(50)))))
        room = room + np.float32(rng.uniform(20, 130)) * (layer * mask)[..., None]
    return room


def _dazzle(rng: np.random.Generator, room: Float, corners: Array) -> Float:
    """The sun over a whole side."""
    k = int(rng.integers(0, 4))
    a, b = corners[k], corners[(k + 1) % 4]
    middle = corners.mean(0)
    along, inward = b - a, middle - 0.5 * (a + b)
    out, deep = rng.uniform(0.03, 0.4, 2)
    ends = np.array([a - 0.1 * along, b + 0.1 * along])
    band = np.concatenate([ends - out * inward, ends[::-1] + deep * inward])
    layer = np.zeros(room.shape[:2], np.float32)
    cv2.fillPoly(layer, [np.int32(np.rint(band + rng.normal(0.0, 15.0, (4, 2))))], 1.0)
    layer = _blurred(layer, float(np.exp(rng.uniform(np.log(5), np.log(50)))))
    return room + np.float32(rng.uniform(120, 400)) * layer[..., None]


def _light(rng: np.random.Generator, room: Float) -> Float:
    """Lamps far and near, shadows of things out of view, white balance, exposure."""
    h, w = room.shape[:2]
    x, y = np.meshgrid(np.linspace(-1, 1, w, dtype=np.float32), np.linspace(-1, 1, h, dtype=np.float32))
    gain = 1.0 + np.float32(rng.uniform(-0.2, 0.2)) * x + np.float32(rng.uniform(-0.2, 0.2)) * y
    for _ in range(rng.integers(0, 3)):
        shade = np.zeros((h, w), np.float32)
        centre = rng.uniform([0, 0], [w, h])
        points = centre + rng.normal(0, 0.35 * w, (rng.integers(3, 7), 2))
        cv2.fillConvexPoly(shade, cv2.convexHull(np.int32(points)), 1.0)
        shade = _blurred(shade, float(np.exp(rng.uniform(np.log(4), np.log(80)))))
        gain *= 1.0 - np.float32(rng.uniform(0.05, 0.35)) * shade
    gain *= 1.0 - np.float32(rng.uniform(0, 0.2)) * (x**2 + y**2)
    balance = (1.0 + rng.normal(0, 0.05, 3)).astype(np.float32) * np.float32(rng.uniform(0.55, 1.08))
    return room * gain[..., None] * balance


def _camera(
    rng: np.random.Generator, room: Float, masks: tuple[Image, ...], corners: Array | None
) -> tuple[Image, tuple[Image, ...], Array | None]:
    """Lens distortion, halving, blur, noise, JPEG, now and then grey."""
    h, w = room.shape[:2]
    K = np.array([[1.2 * w, 0, w / 2], [0, 1.2 * w, h / 2], [0, 0, 1]])
    k = np.array([rng.normal(0, 0.012), 0, 0, 0, 0])
    grid = (
        np.stack(np.meshgrid(np.arange(0, w, 20), np.arange(0, h, 20)), -1)
        .reshape(-1, 1, 2)
        .astype(np.float64)
    )
    straight = cv2.undistortPoints(grid, K, k, P=K).reshape(len(range(0, h, 20)), len(range(0, w, 20)), 2)
    # bilinear between nodes 20 pixels apart: the field is smooth
    nodes = np.stack(np.meshgrid(np.arange(w) / 20.0, np.arange(h) / 20.0), -1).astype(np.float32)
    maps = cv2.remap(
        straight.astype(np.float32),
        nodes[..., 0],
        nodes[..., 1],
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    room = cv2.remap(room, maps, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    masks = tuple(cv2.remap(m, maps, None, cv2.INTER_LINEAR) for m in masks)
    if corners is not None:
        rays = np.column_stack([(corners - K[:2, 2]) / K[0, 0], np.ones(len(corners))])
        corners = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K, k)[0].reshape(-1, 2)
        corners = (corners + 0.5) / 2.0 - 0.5
    small = cv2.resize(room, (w // 2, h // 2), interpolation=cv2.INTER_AREA)
    masks = tuple(cv2.resize(m, (w // 2, h // 2), interpolation=cv2.INTER_AREA) for m in masks)
    small = cv2.GaussianBlur(small, (0, 0), rng.uniform(0.3, 1.4))
    small = small + rng.normal(0.0, rng.uniform(0.5, 6.0), small.shape)
    image = np.clip(np.rint(small), 0, 255).astype(np.uint8)
    if rng.random() < 0.1:
        image = cv2.cvtColor(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), cv2.COLOR_GRAY2BGR)
    if rng.random() < 0.6:
        ok, code = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(45, 96))])
        assert ok
        image = cv2.imdecode(code, cv2.IMREAD_COLOR)
    return image, masks, corners
