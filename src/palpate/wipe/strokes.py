"""Navigation: from dirty places on a board to strokes of an eraser, in the order of the shortest way.

Everything is in board coordinates [m]: origin in the writing surface's top left corner, x along the top edge, y down
the left edge (those of :mod:`palpate.vision`). The eraser is a rectangle that keeps its orientation. A place counts as
wiped when the eraser slides over it for at least a stated distance: felt that only sits on ink takes nothing off.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np
import numpy.typing as npt
import shapely
from shapely import Polygon, affinity, box

from ..arm import Array
from ..errors import InputError
from . import _tour

_HAIR = 1e-7
"""[m] what rounding may be off"""
_CRUMB = 1e-8
"""[m^2] pieces smaller than this are rounding, not dirt"""
_RIM = 1e-4
"""[m] dirt this near the topmost counts as topmost"""
_WORTH = 2e-5
"""[m^2] least gain of a strip that squeezes past something"""
_PATCH = 0.004
"""[m] so much around a place that cannot be wiped is given up at once"""

Phase: TypeAlias = Literal["approach", "touch", "slide", "lift"]


@dataclass(frozen=True, slots=True)
class Eraser:
    """A felt block and how it is to be used."""

    width: float = 0.05
    """along the tool's x axis [m]"""
    length: float = 0.11
    """along the tool's y axis [m]"""
    overlap: float = 0.01
    """of neighbouring strokes; half of it may be lost to a tool that is off to the side [m]"""
    rub: float = 0.02
    """a place is wiped when the eraser slides so far over it [m]"""

    def __post_init__(self) -> None:
        for name in ("width", "length", "rub"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise InputError(f"eraser: {name} must be a finite length > 0 m, got {value!r}")
        shorter = min(self.width, self.length)
        if not 0.0 <= self.overlap < shorter:
            raise InputError(f"eraser: overlap must be from 0 to below {shorter} m, got {self.overlap!r}")
        if self.rub > shorter:
            raise InputError(
                f"eraser: rub must be at most its shorter side {shorter} m: a stroke cannot rub a place for longer "
                f"than it covers it; got {self.rub!r}"
            )


@dataclass(frozen=True, slots=True)
class Motion:
    """How fast the tool moves; strokes begin and end at rest."""

    speed: float = 0.1
    """while sliding [m/s]"""
    travel: float = 0.15
    """through the air [m/s]"""
    acceleration: float = 0.4
    """a force of 5 N moves an arm's tool with no more than about 0.5 [m/s^2]"""
    lift: float = 0.03
    """height of the way between strokes above the board [m]"""
    approach: float = 0.03
    """speed of touching and lifting [m/s]"""

    def __post_init__(self) -> None:
        for name in ("speed", "travel", "acceleration", "lift", "approach"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise InputError(f"motion: {name} must be finite and > 0, got {value!r}")


@dataclass(frozen=True, slots=True, eq=False)
class Leg:
    """A straight way of the eraser's centre that begins and ends at rest."""

    phase: Phase
    start: Array
    """(3,) board coordinates; z is the height above the board, > 0 off it [m]"""
    end: Array
    """(3,)"""
    speed: float
    """[m/s], reached if the way is long enough"""
    acceleration: float
    """[m/s^2]"""

    @property
    def length(self) -> float:
        """[m]"""
        return float(np.linalg.norm(self.end - self.start))

    @property
    def duration(self) -> float:
        """[s]"""
        s, v, a = self.length, self.speed, self.acceleration
        return s / v + v / a if s * a >= v * v else 2.0 * math.sqrt(s / a)

    def at(self, t: float) -> tuple[Array, Array]:
        """Position (3,) [m] and velocity (3,) [m/s], `t` [s] after the start; before and after it: at rest."""
        s, a, T = self.length, self.acceleration, self.duration
        if s == 0.0:
            return self.start.copy(), np.zeros(3)
        way = (self.end - self.start) / s
        top = min(self.speed, math.sqrt(s * a))
        ramp = top / a
        t = min(max(t, 0.0), T)
        if t < ramp:
            done, v = 0.5 * a * t * t, a * t
        elif t <= T - ramp:
            done, v = top * (t - 0.5 * ramp), top
        else:
            done, v = s - 0.5 * a * (T - t) ** 2, a * (T - t)
        return self.start + done * way, v * way


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """Strokes in the order they are to be made, and what they cannot reach."""

    size: tuple[float, float]
    """width and height of the board [m]"""
    eraser: Eraser
    turned: bool
    """the eraser's width lies along the board's y instead of its x"""
    motion: Motion
    strokes: tuple[Array, ...]
    """each (K, 2): corners of the way of the eraser's centre while it is on the board"""
    left: tuple[Array, ...]
    """outlines (M, 2) of dirt that no stroke wipes: too near a corner or something to be left alone"""
    start: Array
    """(2,) where the tool was when this was planned"""

    @property
    def summary(self) -> str:
        """How many strokes, and straight pieces of them, in words."""
        pieces = sum(len(stroke) - 1 for stroke in self.strokes)
        return f"{_many(len(self.strokes), 'stroke')} of {_many(pieces, 'straight piece')}"

    @property
    def footprint(self) -> tuple[float, float]:
        """Extent of the eraser along the board's x and y [m]."""
        w, h = self.eraser.width, self.eraser.length
        return (h, w) if self.turned else (w, h)

    @property
    def angle(self) -> float:
        """The tool's x axis in the board's plane, from the board's x towards its y [rad]."""
        return 0.5 * math.pi if self.turned else 0.0

    @property
    def legs(self) -> tuple[Leg, ...]:
        """Approach, touch, slide (one for each straight piece), lift, for each stroke; the first begins in the air."""
        m, up = self.motion, self.motion.lift
        way: list[Leg] = []
        at = self.start
        for stroke in self.strokes:
            first, last = stroke[0], stroke[-1]
            if not np.array_equal(at, first):
                way.append(Leg("approach", _lifted(at, up), _lifted(first, up), m.travel, m.acceleration))
            way.append(Leg("touch", _lifted(first, up), _lifted(first, 0.0), m.approach, m.acceleration))
            way += [
                Leg("slide", _lifted(a, 0.0), _lifted(b, 0.0), m.speed, m.acceleration)
                for a, b in itertools.pairwise(stroke)
            ]
            way.append(Leg("lift", _lifted(last, 0.0), _lifted(last, up), m.approach, m.acceleration))
            at = last
        return tuple(way)

    @property
    def duration(self) -> float:
        """Of all legs [s]."""
        return sum(leg.duration for leg in self.legs)

    @property
    def travel(self) -> float:
        """Way through the air, heights left out [m]."""
        return sum(leg.length for leg in self.legs if leg.phase == "approach")


def plan(
    dirty: Iterable[npt.ArrayLike],
    size: tuple[float, float],
    *,
    keep: Iterable[npt.ArrayLike] = (),
    eraser: Eraser | None = None,
    motion: Motion | None = None,
    start: npt.ArrayLike | None = None,
    turned: bool | None = None,
    margin: float = 0.004,
    clearance: float = 0.003,
) -> Plan:
    """Strokes that wipe dirty places.

    Args:
        dirty: outlines, each (M, 2) in board coordinates [m]; points and lines (M = 1, 2) count too. What lies outside
            the board is left out.
        size: width and height of the board [m].
        keep: outlines of what the eraser must not touch: magnets, a region, other ink.
        eraser: None: felt of 50 mm by 110 mm.
        motion: None: 0.1 m/s.
        start: (2,) over which place the tool is; None: over the board's middle.
        turned: the eraser's width is to lie along the board's y (True) or x (False); None: as is better.
        margin: so much around the dirt is wiped too, for what the eye and the arm are off [m].
        clearance: the eraser keeps so far from what it must not touch [m].

    Returns:
        The quicker one of strokes along x and along y, with the eraser as it is or turned by 90 degrees, among those
        that leave the least. No strokes if nothing is dirty.

    Raises:
        InputError: an outline, a size or a length is wrong; the board is smaller than the eraser.
    """
    eraser, motion = eraser or Eraser(), motion or Motion()
    W, H = (_length(s, "size of the board") for s in size)
    margin, clearance = _length(margin, "margin", least=0.0), _length(clearance, "clearance", least=0.0)
    at = np.array([0.5 * W, 0.5 * H]) if start is None else _points(start, "start")[0]
    board = box(0.0, 0.0, W, H)
    spots = shapely.union_all([shape(p, "dirty") for p in dirty])
    soiled = spots.intersection(board)
    nogo = shapely.union_all([shape(p, "keep") for p in keep]).buffer(clearance, join_style="mitre")
    soiled = soiled.buffer(max(margin, _HAIR)).intersection(board).difference(nogo)
    choices = [
        (way, *_cover(soiled, nogo, (W, H), _footprint(eraser, way), eraser, first))
        for way in ((False, True) if turned is None else (turned,))
        if all(f <= s + _HAIR for f, s in zip(_footprint(eraser, way), (W, H), strict=True))
        for first in (0, 1)
    ]
    if not choices:
        raise InputError(
            f"an eraser of {eraser.width} m x {eraser.length} m does not fit on a board of {W} m x {H} m"
        )
    # a lift and a touch cost about as much as this way of sliding
    lift = 2.0 * (motion.lift / motion.approach + motion.approach / motion.acceleration) * motion.speed
    least = min(left.area for _, _, left in choices)
    best, lines, left = min(
        (c for c in choices if c[2].area <= least + 1e-6),
        key=lambda c: sum(float(np.linalg.norm(b - a)) + lift for a, b in c[1]),
    )
    way = _tour.order(np.array(lines).reshape(-1, 2, 2), at)
    ordered = [lines[i][::-1] if backwards else lines[i] for i, backwards in way]
    strokes = _joined(ordered, nogo, _footprint(eraser, best), motion)
    return Plan((W, H), eraser, best, motion, strokes, tuple(outlines(left)), at)


def _cover(
    soiled: Any,
    nogo: Any,
    size: tuple[float, float],
    footprint: tuple[float, float],
    eraser: Eraser,
    first: int,
) -> tuple[list[tuple[Array, Array]], Any]:
    """Straight strokes (start, end) and what they leave, by strips along axis `first`, top one first.

    Where a strip cannot reach the topmost dirt because of something in its way, one that hangs from the dirt's other
    side or runs across is taken.
    """
    lines: list[tuple[Array, Array]] = []
    remaining, left = soiled, []
    across = 1 - first
    while remaining.area > _CRUMB:
        low = remaining.bounds[across]
        rim = _box(first, (-1.0, low - 1.0), (size[first] + 1.0, low + _RIM))
        piece = max(_parts(remaining.intersection(rim)), key=lambda p: p.area)
        spot = piece.representative_point()
        whole = min(_parts(remaining), key=lambda p: p.distance(spot))
        crowded = spot.distance(nogo) < max(footprint) if not nogo.is_empty else False
        best: tuple[float, list[tuple[Array, Array]], Any] | None = None
        for axis, c in _strips(piece.bounds, whole.bounds, nogo, first, size, footprint, eraser.overlap):
            made, wiped = _strip(remaining, nogo, size, footprint, eraser, axis, c)
            if not made or wiped.distance(spot) > _HAIR:
                continue
            gain = remaining.intersection(wiped).area
            if best is None or gain > best[0]:
                best = (gain, made, wiped)
            if axis == first and not crowded:
                break
        if best is None or (crowded and best[0] < _WORTH):
            wiped = spot.buffer(_PATCH)
            left.append(remaining.intersection(wiped))
        else:
            lines += best[1]
            wiped = best[2]
        remaining = remaining.difference(wiped.buffer(_HAIR, join_style="mitre"))
    # patches that touch are one place; crumbs are too small for a stroke of their own, and told all the same
    return lines, shapely.union_all([p.buffer(2.0 * _HAIR) for p in (*left, remaining) if not p.is_empty])


def _strips(
    piece: tuple[float, float, float, float],
    whole: tuple[float, float, float, float],
    nogo: Any,
    first: int,
    size: tuple[float, float],
    footprint: tuple[float, float],
    overlap: float,
) -> Iterable[tuple[int, float]]:
    """Axis and offset of strips that wipe a piece, given by its bounds and those of the whole that it belongs to.

    They hang from a rim of the piece or stand on it, along the first axis; run across at a rim of the whole; or lie
    flush with what they must not touch.
    """
    for axis in (first, 1 - first):
        side, half = 1 - axis, 0.5 * footprint[1 - axis]
        low, high = piece[side], piece[2 + side]
        offsets = [low + half - 0.5 * overlap, high - half + 0.5 * overlap]
        if axis != first:
            offsets = [whole[side] + half - 0.5 * overlap, whole[2 + side] - half + 0.5 * overlap, *offsets]
        for wall in _parts(nogo):
            offsets += [wall.bounds[side] - half, wall.bounds[2 + side] + half]
        for c in offsets:
            inside = min(max(c, half), size[side] - half)
            if inside - half <= high and inside + half >= low:
                yield axis, inside


def _strip(
    remaining: Any,
    nogo: Any,
    size: tuple[float, float],
    footprint: tuple[float, float],
    eraser: Eraser,
    axis: int,
    c: float,
) -> tuple[list[tuple[Array, Array]], Any]:
    """Strokes along `axis` with the eraser's centre at `c` across it, and the area they wipe."""
    along, across = 0.5 * footprint[axis], 0.5 * footprint[1 - axis]
    high = size[1 - axis]
    # at the border, and beside what must not be touched, nothing lies beyond that another stroke could have left
    rims = [0.0, high, *(b for g in _parts(nogo) for b in (g.bounds[1 - axis], g.bounds[3 - axis]))]
    top, bottom = (
        c
        + s * across
        - s * (0.0 if any(abs(c + s * across - r) <= _HAIR for r in rims) else 0.5 * eraser.overlap)
        for s in (-1.0, 1.0)
    )
    lane = _box(axis, (0.0, c - across + _HAIR), (size[axis], c + across - _HAIR))
    walls = sorted(
        (g.bounds[axis] - along, g.bounds[2 + axis] + along) for g in _parts(nogo.intersection(lane))
    )
    free, at = [], along
    for a, b in [*walls, (size[axis] - along, math.inf)]:
        if a - at >= eraser.rub:
            free.append((at, a))
        at = max(at, b)
    lines, wiped = [], []
    for low, high_end in free:
        reach = _box(axis, (low - along + eraser.rub, top), (high_end + along - eraser.rub, bottom))
        spans = sorted((g.bounds[axis], g.bounds[2 + axis]) for g in _parts(remaining.intersection(reach)))
        runs: list[tuple[float, float]] = []
        for s, e in spans:
            a, b = max(low, s - along), min(high_end, e + along)
            # over a short clean gap the eraser slides on: a lift takes longer
            if runs and a <= runs[-1][1] + 2.0 * along:
                runs[-1] = (runs[-1][0], max(runs[-1][1], b))
            else:
                runs.append((a, b))
        for a, b in runs:
            ends = np.full((2, 2), c)
            ends[:, axis] = a, b
            lines.append((ends[0], ends[1]))
            low_side, high_side = (x + s * (eraser.rub - along) for x, s in ((a, 1.0), (b, -1.0)))
            wiped.append(_box(axis, (low_side, top), (high_side, bottom)))
    return lines, shapely.union_all(wiped)


def _joined(
    lines: list[tuple[Array, Array]], nogo: Any, footprint: tuple[float, float], motion: Motion
) -> tuple[Array, ...]:
    """Neighbouring strokes become one where sliding on is quicker than lifting and touches nothing it must not."""
    strokes: list[list[Array]] = []
    lift = Leg("lift", np.zeros(3), np.array([0.0, 0.0, motion.lift]), motion.approach, motion.acceleration)
    for a, b in lines:
        if strokes:
            last = strokes[-1][-1]
            slide = Leg("slide", _lifted(last, 0.0), _lifted(a, 0.0), motion.speed, motion.acceleration)
            air = Leg("approach", slide.start, slide.end, motion.travel, motion.acceleration)
            quicker = slide.duration < air.duration + 2.0 * lift.duration
            if quicker and not nogo.intersects(swept(last, a, footprint).buffer(-_HAIR)):
                strokes[-1] += [b] if np.array_equal(last, a) else [a, b]
                continue
        strokes.append([a, b])
    return tuple(np.array(s) for s in strokes)


def swept(a: Array, b: Array, footprint: tuple[float, float]) -> Any:
    """The area (shapely) that an eraser passes whose centre goes straight from `a` to `b`, both (2,) [m]."""
    w, h = 0.5 * footprint[0], 0.5 * footprint[1]
    block = box(-w, -h, w, h)
    return shapely.union(affinity.translate(block, *a), affinity.translate(block, *b)).convex_hull


def _footprint(eraser: Eraser, turned: bool) -> tuple[float, float]:
    return (eraser.length, eraser.width) if turned else (eraser.width, eraser.length)


def _box(axis: int, low: tuple[float, float], high: tuple[float, float]) -> Any:
    """A box given by its extent along `axis` and across it."""
    return box(*low, *high) if axis == 0 else box(low[1], low[0], high[1], high[0])


def _lifted(point: Array, height: float) -> Array:
    return np.array([point[0], point[1], height])


def _parts(area: Any) -> list[Any]:
    """Connected pieces that have an area."""
    return [p for p in shapely.get_parts(area) if p.area > 0.0]


def outlines(area: Any) -> Iterable[Array]:
    """Outlines (M, 2) of the pieces of an area (shapely); holes are filled."""
    for part in _parts(area):
        if isinstance(part, Polygon) and part.area > _CRUMB:
            yield np.array(part.exterior.coords)[:-1]


def _many(count: int, what: str) -> str:
    return f"{count} {what}" if count == 1 else f"{count} {what}s"


def shape(value: npt.ArrayLike, what: str) -> Any:
    """An outline (M, 2) [m] as a shape of shapely; one point or two are a point or a line.

    Raises:
        InputError: not finite or not (M, 2).
    """
    points = _points(value, f"{what}: an outline")
    if len(points) == 1:
        return shapely.Point(points[0])
    if len(points) == 2:
        return shapely.LineString(points)
    return shapely.make_valid(Polygon(points))


def _points(value: npt.ArrayLike, what: str) -> Array:
    try:
        points = np.atleast_2d(np.asarray(value, dtype=np.float64))
    except (TypeError, ValueError):
        raise InputError(f"{what} must be numbers of shape (M, 2), got {value!r:.80}") from None
    if points.ndim != 2 or points.shape[1] != 2 or not len(points) or not np.all(np.isfinite(points)):
        raise InputError(f"{what} must be finite and (M, 2) [m], got shape {points.shape}")
    return points


def _length(value: float, what: str, *, least: float | None = None) -> float:
    number = float(value)
    if not math.isfinite(number) or (number <= 0.0 if least is None else number < least):
        raise InputError(
            f"{what} must be a finite length {'> 0' if least is None else f'>= {least:g}'} m, got {value!r}"
        )
    return number
