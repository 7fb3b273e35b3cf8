"""Fit the weights of the evidence for a board (palpate.vision._quads.WEIGHTS) on rendered views.

    PYTHONPATH=src python scripts/fit_board_weights.py [VIEWS]

Every candidate of a view is fitted to the board's edges; it is right if all corners come within 4 pixels. The weights
rank a right candidate before all wrong ones (softmax), and the bias separates views with a right best candidate from
rooms without a board (logistic). They are kept near those in use. Every tenth picture is a room without a board; the
even pictures are fitted and the odd ones judged, and the other way round, before all are fitted. No
photograph takes part. Takes about a second a view; needs palpate[vision,identify].
"""

from __future__ import annotations

import sys

import cv2
import numpy as np
from scipy.optimize import minimize

from palpate.studies import _boards
from palpate.studies.board_detection import FITTED, corner_error
from palpate.vision import _edges, _lines, _quads, board
from palpate.vision._image import rescaled, shrunk

RIGHT = 4.0  # pixels
BEST, OTHERS = 40, 30  # candidates of a view
KEEP = 0.02  # how much a change of the weights costs


def view(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Features (K, F) of candidates, and which of them are right (K,)."""
    scene = _boards.scene(seed, board=seed % 10 != 9)
    rough, scale = shrunk(scene.image, board.ROUGH)
    grey = cv2.cvtColor(rough, cv2.COLOR_BGR2GRAY)
    quads = _quads.find(_lines.find(grey, board.LINES), _lines.gradient(grey), rough, grey)
    count = len(quads.score)
    if not count:
        return quads.features, np.zeros(0, bool)
    other = np.random.default_rng(seed).integers(0, count, OTHERS)
    pick = np.unique(np.concatenate([np.arange(min(BEST, count)), other]))
    right = np.zeros(len(pick), bool)
    if scene.corners is not None:
        sharp = cv2.cvtColor(scene.image, cv2.COLOR_BGR2GRAY)
        for k, i in enumerate(pick):
            found = _edges.fit(sharp, rescaled(quads.corners[i], 1.0 / scale), quads.border[i])
            right[k] = corner_error(found.corners, scene.corners) <= RIGHT
    return quads.features[pick], right


def fit(views: list[tuple[np.ndarray, np.ndarray]], start: np.ndarray, spread: np.ndarray) -> np.ndarray:
    def loss(p: np.ndarray) -> float:
        total = 0.0
        for features, right in views:
            z = features @ p[:-1]
            if right.any():
                total += np.logaddexp.reduce(z) - np.logaddexp.reduce(z[right])
            margin = z.max() + p[-1]
            total += 0.3 * np.logaddexp(0.0, -margin if right[z.argmax()] else margin)
        return total / len(views) + KEEP * float((((p - start)[:-1] * spread) ** 2).sum())

    return minimize(loss, start, method="Powell", options={"maxiter": 8}).x


def share(views: list[tuple[np.ndarray, np.ndarray]], p: np.ndarray) -> float:
    """Part of the views with a board whose best candidate is right."""
    return float(np.mean([right[(f @ p[:-1]).argmax()] for f, right in views if right.any()]))


def main() -> None:
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 200
    cv2.setNumThreads(1)
    views = [v for v in map(view, range(FITTED, FITTED + count)) if len(v[0])]
    start = np.append(_quads.WEIGHTS, _quads.BIAS)
    spread = np.concatenate([f for f, _ in views]).std(0)
    print(f"in use: {100 * share(views, start):.1f} % of the views that have a right candidate")
    for fitted, judged in ((views[::2], views[1::2]), (views[1::2], views[::2])):
        p = fit(fitted, start, spread)
        print(f"fitted {100 * share(fitted, p):.1f} %, judged {100 * share(judged, p):.1f} %")
    p = fit(views, start, spread)
    print(f"all: {100 * share(views, p):.1f} %")
    print("WEIGHTS =", np.round(p[:-1], 1).tolist(), "BIAS =", round(float(p[-1]), 1))


if __name__ == "__main__":
    main()
