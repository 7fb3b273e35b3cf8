"""Fit the weights that tell the gap between two boards from a line across one (palpate.vision._seams.WEIGHTS).

    PYTHONPATH=src python scripts/fit_seam_weights.py [VIEWS]

Of VIEWS rendered views each: two boards beside each other that are taken for one, boards, and boards with a line drawn
across that ends at the border or short of it. Of the pairs the band whose halves are nearest to the true boards is a
seam; every band on a single board is none, and all of these weigh as much as all seams. No photograph takes part. Takes
about a second a view; needs palpate[vision,identify].
"""

from __future__ import annotations

import sys

import cv2
import numpy as np
from scipy.optimize import minimize

from palpate.studies import _boards
from palpate.studies.board_detection import FITTED, corner_error
from palpate.vision import _edges, _lines, _quads, _seams, board
from palpate.vision._image import rescaled, shrunk

PAIRS, RULED = FITTED + 10_000, FITTED + 40_000  # first seeds of two boards, and of boards with a line across
KEEP = 1e-5  # cost of a weight's square, features scaled to deviation 1
PLAIN = _boards._write


def ruled(rng: np.random.Generator, face: np.ndarray, marks: np.ndarray) -> None:
    """Writing as usual, and one or two lines across."""
    PLAIN(rng, face, marks)
    h, w = face.shape[:2]
    pen = np.array(_boards._PENS[rng.integers(0, len(_boards._PENS))], np.float32)
    layer = np.zeros((h, w), np.uint8)
    for _ in range(rng.integers(1, 3)):
        thick, end, lean = int(rng.integers(3, 10)), int(rng.choice([0, 12, 30, 60])), rng.normal(0, 4)
        if rng.random() < 0.7:
            x = rng.uniform(0.2, 0.8) * w
            cv2.line(layer, (int(x), end), (int(x + lean), h - end), 255, thick, cv2.LINE_AA)
        else:
            y = rng.uniform(0.25, 0.75) * h
            cv2.line(layer, (end, int(y)), (w - end, int(y + lean)), 255, thick, cv2.LINE_AA)
    cover = layer.astype(np.float32)[..., None] / 255.0 * np.float32(rng.uniform(0.5, 1.0))
    face[:] = face * (1.0 - cover) + pen * cover


def bands(scene: _boards.Scene) -> tuple[list[_seams.Seam], np.ndarray]:
    """Of the best quadrangle of a view: what runs across it, and its corners."""
    fine, _ = shrunk(scene.image, board.FINE)
    rough, scale = shrunk(fine, board.ROUGH)
    grey = cv2.cvtColor(rough, cv2.COLOR_BGR2GRAY)
    quads = _quads.find(_lines.find(grey, board.LINES), _lines.gradient(grey), rough, grey)
    if not len(quads.score) or quads.border[0].any():
        return [], np.zeros((4, 2))
    sharp = cv2.cvtColor(fine, cv2.COLOR_BGR2GRAY)
    corners = _edges.fit(sharp, rescaled(quads.corners[0], 1.0 / scale), quads.border[0]).corners
    return [seam for first in (0, 1) for seam in _seams.bands(sharp, corners, first)], corners


def off(seam: _seams.Seam, corners: np.ndarray, scene: _boards.Scene) -> float:
    """The largest distance of the halves' corners from the true ones [pixels]."""
    a, b = seam.halves(corners)
    pair = scene.corners, scene.beside
    return min(max(corner_error(x, pair[0]), corner_error(y, pair[1])) for x, y in ((a, b), (b, a)))


def main() -> None:
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 90
    cv2.setNumThreads(1)
    cases: list[tuple[np.ndarray, bool]] = []
    for seed in range(PAIRS, PAIRS + count):
        scene = _boards.scene(seed, two=True)
        found, corners = bands(scene)
        middle = [tuple(map(float, c.mean(0))) for c in (scene.corners, scene.beside)]
        if found and all(cv2.pointPolygonTest(np.float32(corners), m, False) > 0 for m in middle):
            best = min(found, key=lambda s: off(s, corners, scene))
            cases.append((best.features, True))
    for write, first in ((PLAIN, FITTED), (ruled, RULED)):
        _boards._write = write
        for seed in range(first, first + count):
            cases += [(s.features, False) for s in bands(_boards.scene(seed))[0]]
    x, y = np.array([c[0] for c in cases]), np.array([c[1] for c in cases], float)
    middle, spread = x.mean(0), x.std(0)
    scaled = np.column_stack([(x - middle) / spread, np.ones(len(x))])
    weight = np.where(y > 0.0, 1.0, y.sum() / (len(y) - y.sum()))

    def loss(w: np.ndarray) -> float:
        z = scaled @ w
        return float(np.mean(weight * (np.logaddexp(0.0, z) - y * z)) + KEEP * w[:-1] @ w[:-1])

    w = minimize(loss, np.zeros(scaled.shape[1])).x
    print(f"{int(y.sum())} seams, {int((y == 0).sum())} other bands")
    for name, odds in (("these weights", scaled @ w), ("those of _seams", x @ _seams.WEIGHTS + _seams.BIAS)):
        right = (odds > 0.0) == (y > 0.0)
        print(f"{name}: {100 * right[y > 0].mean():.0f} % of the seams told, {100 * right[y == 0].mean():.0f} % of the "
              f"others; loss {np.mean(weight * (np.logaddexp(0.0, odds) - y * odds)):.4f}")  # fmt: skip
    weights = w[:-1] / spread
    print("WEIGHTS =", np.round(weights, 1).tolist(), "BIAS =", round(float(w[-1] - weights @ middle), 1))


if __name__ == "__main__":
    main()
