"""Whiteboards in 500 rendered views and in annotated photographs: corners, ink, time; the published method too.

The thresholds of the detector were set on other rendered views (seeds from FITTED on); the photographs were only looked
at. Photographs: every file that ``annotations.json`` of the folder ``whiteboards`` names, in ``PALPATE_DATA`` or beside
the checkout; they are not palpate's to pass on.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from .. import data
from ..arm import Array
from ..errors import LogError
from ..vision import METHODS, Board, Method, Sight, detect, load, see
from . import Progress, Row, _boards, _figures
from ._bench import Work
from ._boards import Image, Mask
from ._rows import at_most, told

if TYPE_CHECKING:
    from matplotlib.figure import Figure

VIEWS, ROOMS, HARD, TIMED = 500, 100, 100, 40
"""rendered views with a board, rooms without one, views of each hard kind, frames for the time"""
QUICK = (8, 4, 4, 4)
FITTED = 100_000
"""first seed of the views that thresholds and weights were set on; none of them is measured here"""
EMPTY = 50_000
"""first seed of the rooms without a board"""
PAIRS, DAZZLED = 60_000, 70_000
"""first seeds of the views of two boards beside each other, and of boards with light as white as the picture gets over
a side"""
BELIEVED = 0.8
"""confidence of a board from which a job believes in it"""
WITHIN = 3.0
"""[pixels] at 1280x720"""
SHARE = 97.0
"""[%] of the views"""
OVERLAP, PUBLISHED_OVERLAP = 0.95, 0.9
"""intersection over union with the annotated surface"""
BOXES = 0.97
"""share of the boxes with ink in which some is found"""
NEARBY = 20.0
"""[pixels] a corner this near is one of the board; farther off it is another thing"""
FRAME_LIMIT = 25.0
"""[ms] on one core"""


@dataclass(frozen=True, slots=True)
class View:
    """One rendered view, measured."""

    error: dict[Method, float]
    """largest distance of a corner [pixels] by method; infinite: no board"""
    clean: bool
    verdict: bool | None
    recall: float
    """part of the ink's pixels that were found; NaN: no ink or no board"""
    alarm: float
    """part of the clean surface taken for ink; NaN: no board"""
    stated: tuple[tuple[float, float], ...]
    """of every corner the error and its stated standard deviation [pixels]; empty: no board or another thing"""


@dataclass(frozen=True, slots=True)
class Photo:
    """One photograph, measured."""

    name: str
    expected: bool
    overlap: dict[Method, float]
    """intersection over union by method; NaN: no board, rightly or wrongly"""
    found: bool
    right: bool
    """clean or dirty as annotated"""
    ink: tuple[int, int] = (0, 0)
    """boxes with ink: found, all"""
    clean: tuple[int, int] = (0, 0)
    """boxes of clean surface: alarms, all"""
    glare: tuple[int, int] = (0, 0)
    threshold: tuple[int, int] = (0, 0)
    """the same of both kinds of boxes for an adaptive threshold"""
    missed: list[list[int]] = field(default_factory=list)
    """boxes with ink in which none was found"""


def corner_errors(found: Array, true: Array) -> Array:
    """(4,) distances of the corners found from the true ones, whichever corner is the first [pixels]."""
    turned = (np.linalg.norm(found - np.roll(true, k, 0), axis=1) for k in range(4))
    return min(turned, key=lambda off: float(off.max()))


def corner_error(found: Array, true: Array) -> float:
    """The largest of them [pixels]."""
    return float(corner_errors(found, true).max())


def overlap(a: Array, b: Array) -> float:
    """Intersection over union of two convex quadrangles, counted on a grid of some 2000 cells across."""
    both = np.concatenate([a, b])
    low, extent = both.min(0), np.ptp(both, axis=0)
    scale = 2000.0 / float(extent.max())
    masks = []
    for corners in (a, b):
        mask = np.zeros(np.ceil(extent[::-1] * scale).astype(int) + 1, np.uint8)
        cv2.fillConvexPoly(mask, np.rint((corners - low) * scale).astype(np.int32), 1)
        masks.append(mask > 0)
    return float(np.sum(masks[0] & masks[1]) / np.sum(masks[0] | masks[1]))


def measure_view(seed: int) -> View:
    """Draw a view and look at it."""
    cv2.setNumThreads(1)
    scene = _boards.scene(seed)
    error: dict[Method, float] = {}
    sights = {method: see(scene.image, method=method) for method in METHODS}
    for method, sight in sights.items():
        ok = sight.board is not None and scene.corners is not None
        error[method] = corner_error(sight.board.corners, scene.corners) if ok else float("inf")  # type: ignore[union-attr, arg-type]
    best = sights["lines"]
    recall = alarm = float("nan")
    if best.ink is not None:
        if scene.ink.any():
            recall = float(best.ink.mask[scene.ink].mean())
        if scene.clean.any():
            alarm = float(best.ink.mask[scene.clean].mean())
    stated: tuple[tuple[float, float], ...] = ()
    if best.board is not None and scene.corners is not None and error["lines"] <= NEARBY:
        off = corner_errors(best.board.corners, scene.corners)
        stated = tuple((float(e), float(s)) for e, s in zip(off, best.board.sigma, strict=True))
    return View(error, not scene.dirty, best.dirty, recall, alarm, stated)


def measure_room(seed: int) -> float:
    """Confidence of a board seen in a room without one; 0: none."""
    cv2.setNumThreads(1)
    sight = see(_boards.scene(seed, board=False).image)
    return 0.0 if sight.board is None else sight.board.confidence


def measure_pair(seed: int) -> tuple[bool, float]:
    """Of two boards beside each other: whether both are found, and the confidence of one that spans both, 0: none."""
    cv2.setNumThreads(1)
    scene = _boards.scene(seed, two=True)
    pair = scene.corners, scene.beside
    found = detect(scene.image)
    both = all(
        any(corner_error(b.corners, true) <= NEARBY for b in found) for true in pair if true is not None
    )
    spans = [b.confidence for b in found if all(_holds(b.corners, true) for true in pair if true is not None)]
    return both, max(spans, default=0.0)


def _holds(corners: Array, other: Array) -> bool:
    """The middle of the other lies in it."""
    x, y = other.mean(0)
    return cv2.pointPolygonTest(corners.astype(np.float32), (float(x), float(y)), False) >= 0.0


def measure_dazzled(seed: int) -> tuple[float, Array, Array]:
    """Of a board with a side in burnt light: its confidence, 0 if none is found, its corners' errors and deviations."""
    cv2.setNumThreads(1)
    scene = _boards.scene(seed, dazzled=True)
    found = detect(scene.image)
    if not found or scene.corners is None:
        return 0.0, np.zeros(0), np.zeros(0)
    return found[0].confidence, corner_errors(found[0].corners, scene.corners), found[0].sigma


def measure_photo(job: tuple[str, dict[str, Any]]) -> Photo:
    """Look at an annotated photograph."""
    folder, note = job
    cv2.setNumThreads(1)
    picture = load(Path(folder) / note["file"])
    sights = {method: see(picture, method=method) for method in METHODS}
    best = sights["lines"]
    if not note["expect_board"]:
        return Photo(note["file"], False, {}, best.board is not None, best.board is None)
    true = [np.array(note["corners"], np.float64)]
    others = [
        np.array(o.get("corners", o) if isinstance(o, dict) else o, np.float64)
        for o in note.get("other_boards") or []
    ]
    surfaces = true + [o for o in others if o.shape == (4, 2)]

    def shares(found: Board | None) -> float:
        return float("nan") if found is None else max(overlap(found.corners, t) for t in surfaces)

    overlaps = {method: shares(sight.board) for method, sight in sights.items()}
    right = best.dirty is not None and best.dirty == note["dirty"]
    marked = _marked(best, (picture.shape[0], picture.shape[1]))
    inked = [b for b in note["ink_boxes"] if _hit(marked, b)]
    free, glare = note["clean_boxes"] or [], note["clean_glare_boxes"] or []
    grey = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
    rival = cv2.adaptiveThreshold(grey, 1, cv2.ADAPTIVE_THRESH_GAUSSIAN_C, cv2.THRESH_BINARY_INV, 31, 7) > 0
    return Photo(
        note["file"],
        True,
        overlaps,
        best.board is not None,
        right,
        (len(inked), len(note["ink_boxes"])),
        (sum(_hit(marked, b) for b in free), len(free)),
        (sum(_hit(marked, b) for b in glare), len(glare)),
        (sum(_hit(rival, b) for b in free + glare), len(free) + len(glare)),
        [b for b in note["ink_boxes"] if b not in inked],
    )


def _marked(sight: Sight, shape: tuple[int, int]) -> Mask:
    return np.zeros(shape, bool) if sight.ink is None else sight.ink.mask


def _hit(mask: Mask, box: list[float]) -> bool:
    x0, y0, x1, y1 = (round(v) for v in box)
    return bool(mask[max(y0, 0) : y1, max(x0, 0) : x1].any())


def _photographs() -> list[tuple[str, dict[str, Any]]]:
    folder = data.local("whiteboards")
    if folder is None or not (folder / "annotations.json").is_file():
        return []
    try:
        notes = json.loads((folder / "annotations.json").read_text(encoding="utf-8"))
    except ValueError as error:
        raise LogError(f"{folder / 'annotations.json'}: not JSON: {error}") from None
    return [(str(folder), note) for note in (notes["images"] if isinstance(notes, dict) else notes)]


def _times(count: int) -> tuple[Array, Array]:
    """CPU time to find the board, and to find board and ink, in each of so many frames [ms]."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    spans: tuple[list[float], list[float]] = ([], [])
    frames = [_boards.scene(seed).image for seed in range(count)]
    works: tuple[Callable[[Image], object], ...] = (detect, see)
    for frame in [frames[0], *frames]:
        for span, work in zip(spans, works, strict=True):
            begin = time.process_time()
            work(frame)
            span.append(1e3 * (time.process_time() - begin))
    cv2.setNumThreads(threads)
    return np.array(spans[0][1:]), np.array(spans[1][1:])  # the first one warms up


def run(progress: Progress, quick: bool) -> tuple[list[Row], Mapping[str, Figure], list[str]]:
    """Measure."""
    views, rooms, hard, timed = QUICK if quick else (VIEWS, ROOMS, HARD, TIMED)
    photographs = _photographs()
    with Work(progress, views + rooms + 2 * hard + len(photographs)) as work:
        seen = work.map(measure_view, range(views))
        empty = np.array(work.map(measure_room, range(EMPTY, EMPTY + rooms)))
        pairs = work.map(measure_pair, range(PAIRS, PAIRS + hard))
        dazzled = work.map(measure_dazzled, range(DAZZLED, DAZZLED + hard))
        photos = work.map(measure_photo, photographs)
    rows = [*_rendered(seen, empty), *_hard(pairs, dazzled), *_photos(photos)]
    board, whole = _times(timed)
    rows.append(
        at_most(
            "time per 720p frame, board and ink, one core",
            FRAME_LIMIT,
            float(np.median(whole)),
            "ms",
            f"median CPU time; 90th percentile {np.percentile(whole, 90):.1f} ms; the board alone "
            f"{np.median(board):.1f} ms",
        )
    )
    notes = [
        f"Rendered views: seeds 0 to {views - 1}, 1280x720; weights and thresholds were set on seeds from "
        f"{FITTED} on.",
        "A board is right in a photograph if it overlaps the annotated surface by 0.95 or more.",
    ]
    notes += [f"{p.name}: ink not found in {p.missed}" for p in photos if p.missed]
    figures = _figures.drawn(
        lambda: {
            "Part of the rendered views with every corner this near": _figures.curves(
                {name: _distribution(seen, name) for name in METHODS},
                "views [%]",
                level=(SHARE, "required"),
                limits=(0.0, 20.0, 0.0, 101.0),
                across="largest corner error [pixels]",
            )
        }
    )
    return rows, figures, notes


def _distribution(seen: list[View], method: Method) -> tuple[Array, Array]:
    at = np.linspace(0.0, 20.0, 401)
    errors = np.array([v.error[method] for v in seen])
    return at, np.array([100.0 * np.mean(errors <= x) for x in at])


def _at_least(what: str, limit: float, ours: float, unit: str, note: str = "") -> Row:
    return Row(what, f">= {limit:g}", ours, None, bool(ours >= limit), unit, note)


def _rendered(seen: list[View], empty: Array) -> list[Row]:
    errors = {method: np.array([v.error[method] for v in seen]) for method in METHODS}
    ours = errors["lines"]
    got = ours[np.isfinite(ours)]
    share = {method: 100.0 * float(np.mean(e <= WITHIN)) for method, e in errors.items()}
    verdicts = [v.verdict is not None and v.verdict != v.clean for v in seen]
    off, sigma = np.array([pair for v in seen for pair in v.stated]).reshape(-1, 2).T
    recall = np.array([v.recall for v in seen])
    alarm = np.array([v.alarm for v in seen])
    return [
        _at_least(
            f"rendered: every corner within {WITHIN:g} px",
            SHARE,
            share["lines"],
            "%",
            f"{len(seen)} views; median {np.median(got):.2f} px, no board in {len(ours) - len(got)}, "
            f"within 5 px {100.0 * np.mean(ours <= 5.0):.1f} %",
        ),
        told(
            "rendered: corners off by at most twice their stated deviation",
            100.0 * float(np.mean(off <= 2.0 * sigma)) if len(off) else float("nan"),
            "%",
            beside="98.2",
            note=f"expected of Gaussian errors; boards within {NEARBY:g} px; error over deviation, root mean square "
            f"{np.sqrt(np.mean((off / sigma) ** 2)) if len(off) else np.nan:.2f} (1)",
        ),
        told("rendered: the published growing by hue", share["published"], "%"),
        told("rendered: growing by saturation", share["saturation"], "%"),
        told("rendered: growing by value", share["value"], "%"),
        told(
            "rendered: rooms without a board in which one is seen",
            int((empty > 0).sum()),
            "",
            beside=f"0 of {len(empty)}",
            note=f"panels and posters; with a confidence of {BELIEVED:g} or more {int((empty >= BELIEVED).sum())}",
        ),
        told("rendered: clean or dirty right", 100.0 * float(np.mean(verdicts)), "%"),
        told(
            "rendered: ink found, by pixels",
            100.0 * float(np.nanmean(recall)),
            "%",
            "mean over the views with ink",
        ),
        told("rendered: clean surface taken for ink, by pixels", 100.0 * float(np.nanmean(alarm)), "%"),
    ]


def _hard(pairs: list[tuple[bool, float]], dazzled: list[tuple[float, Array, Array]]) -> list[Row]:
    """Two boards beside each other; a side in burnt light."""
    spans = np.array([confidence for _, confidence in pairs])
    found = [d for d in dazzled if d[0] > 0.0]
    off, sigma = (np.concatenate([d[k] for d in found]) if found else np.zeros(0) for k in (1, 2))
    wrong = [d for d in found if d[1].max() > NEARBY]
    blind = sum(d[0] >= BELIEVED and bool(np.any(d[1] > np.maximum(2.0 * d[2], WITHIN))) for d in found)
    return [
        told(
            "rendered: two boards beside each other, both found",
            100.0 * float(np.mean([both for both, _ in pairs])),
            "%",
            f"{len(pairs)} views",
        ),
        told(
            "rendered: two boards beside each other taken for one",
            int((spans > 0.0).sum()),
            "",
            beside=f"0 of {len(pairs)}",
            note=f"with a confidence of {BELIEVED:g} or more {int((spans >= BELIEVED).sum())}",
        ),
        told(
            "rendered: a side in burnt light, corners off by at most twice their stated deviation",
            100.0 * float(np.mean(off <= 2.0 * sigma)) if len(off) else float("nan"),
            "%",
            beside="98.2",
            note=f"{len(dazzled)} views, no board in {len(dazzled) - len(found)}; corners more than {NEARBY:g} px "
            f"off in {len(wrong)}",
        ),
        told(
            "rendered: a side in burnt light, a wrong corner stated as right",
            blind,
            "",
            beside=f"0 of {len(dazzled)}",
            note=f"confidence {BELIEVED:g} or more, off by more than {WITHIN:g} px and twice the stated deviation",
        ),
    ]


def _photos(photos: list[Photo]) -> list[Row]:
    if not photos:
        return [
            told(
                "photographs: none found",
                float("nan"),
                "",
                f"set {data.VARIABLE} to the folder of whiteboards/",
            )
        ]
    boards, none = [p for p in photos if p.expected], [p for p in photos if not p.expected]
    overlaps = {m: np.array([p.overlap[m] for p in boards]) for m in METHODS}
    ours = overlaps["lines"]

    def total(name: str) -> tuple[int, int]:
        pairs = np.array([getattr(p, name) for p in boards]).reshape(-1, 2).sum(0)
        return int(pairs[0]), int(pairs[1])

    (ink, inks), (clean, cleans), (glare, glares), (rival, rivals) = (
        total(name) for name in ("ink", "clean", "glare", "threshold")
    )
    rows = [
        _at_least(
            f"photographs: boards found at IoU {OVERLAP:g}",
            len(boards),
            int(np.sum(ours >= OVERLAP)),
            "",
            f"of {len(boards)}; least IoU {np.nanmin(ours):.3f}" if np.isfinite(ours).any() else "",
        ),
        at_most(
            f"photographs: boards seen where there is none, of {len(none)}", 0, sum(p.found for p in none), ""
        ),
        _at_least(
            "photographs: clean or dirty right",
            len(boards),
            sum(p.right for p in boards),
            "",
            f"of {len(boards)}",
        ),
        _at_least("photographs: boxes with ink found", BOXES, ink / max(inks, 1), "", f"{ink} of {inks}"),
        at_most(f"photographs: alarms in clean boxes, of {cleans}", 0, clean, ""),
        at_most(f"photographs: alarms in boxes of glare, of {glares}", 0, glare, ""),
        told("photographs: alarms of an adaptive threshold in those boxes", rival, "", f"of {rivals}"),
    ]
    names = {
        "published": "the published growing by hue",
        "saturation": "growing by saturation",
        "value": "growing by value",
    }
    for method in METHODS[1:]:
        got = int(np.nansum(overlaps[method] >= PUBLISHED_OVERLAP))
        rows.append(
            told(
                f"photographs: {names[method]}, boards at IoU {PUBLISHED_OVERLAP:g}",
                got,
                "",
                f"of {len(boards)}",
            )
        )
    return rows
