"""Fit the weights that tell the border of a writing surface from other edges (palpate.vision._edges.WEIGHTS).

    PYTHONPATH=src python scripts/fit_border_weights.py [VIEWS [DRAWN]]

Along every side of VIEWS rendered views, and of DRAWN others whose boards may bear a printed grid, a box along the
border or rows of text, all candidate edges are fitted. One is the border if it is within 1.5 pixels of the true side,
or is the nearest to it. The weights are those of a logistic regression for "this is the border" over the edges from the
inside up to the border. The even views are fitted and the odd ones judged, and the other way round, before all are
fitted. No photograph takes part. Takes about a second a view; needs palpate[vision,identify].
"""

from __future__ import annotations

import sys
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import minimize

from palpate.studies import _boards
from palpate.studies.board_detection import FITTED
from palpate.vision import _edges, _lines, _quads, board
from palpate.vision._image import rescaled, shrunk

DRAWN = 200_000  # first seed of the views with grids, boxes and rows of text
RIGHT, LOST = 1.5, 3.0  # pixels: an edge is the border; no candidate is
FAR = 100.0  # pixels: the quadrangle is another thing
KEEP = 1e-4  # cost of a weight's square, features scaled to deviation 1
PLAIN = _boards._write


@dataclass(frozen=True)
class Side:
    """Candidates of one side, from inside to outside."""

    seed: int
    features: np.ndarray
    off: np.ndarray
    """largest distance of the true side's ends from each candidate [pixels]"""

    def cases(self) -> list[tuple[np.ndarray, bool]]:
        if not len(self.off) or self.off.min() > LOST:
            return []
        right = self.off < max(RIGHT, float(self.off.min()) + 0.3)
        last = int(right.argmax())
        return list(zip(self.features[: last + 1], right[: last + 1].tolist(), strict=True))


def written(rng: np.random.Generator, face: np.ndarray, marks: np.ndarray) -> None:
    """Writing as usual; over it a printed grid, or a box or a line along the border; or rows of text instead."""
    h, w = face.shape[:2]
    kind = int(rng.integers(0, 4))
    if kind != 2:
        PLAIN(rng, face, marks)
    if kind == 3:
        return
    pen = np.array(_boards._PENS[rng.integers(0, len(_boards._PENS))], np.float32)
    layer = np.zeros((h, w), np.uint8)
    if kind == 0:
        pitch, thick = int(rng.uniform(35, 140)), int(rng.integers(1, 4))
        for at in range(int(rng.integers(5, pitch)), max(h, w), pitch):
            layer[:, at : at + thick] = layer[at : at + thick] = 255
        opacity = rng.uniform(0.03, 0.18)
        pen *= 0.0
    elif kind == 1:
        thick, (left, top, right, bottom) = int(rng.integers(3, 10)), rng.uniform(14, 110, 4)
        if rng.random() < 0.6:
            cv2.rectangle(
                layer, (int(left), int(top)), (int(w - right), int(h - bottom)), 255, thick, cv2.LINE_AA
            )
        else:
            y, lean = (top if rng.random() < 0.5 else h - top), rng.normal(0, 6)
            cv2.line(layer, (int(left), int(y)), (int(w - right), int(y + lean)), 255, thick, cv2.LINE_AA)
        opacity = rng.uniform(0.5, 1.0)
    else:
        size, thick, font = rng.uniform(0.8, 2.2), int(rng.integers(2, 6)), int(rng.choice(_boards._FONTS))
        margin = int(rng.uniform(8, 60))
        for y in range(int(rng.uniform(20, 60) + 20 * size), h - 10, int(38 * size)):
            text = " ".join(rng.choice(_boards._WORDS, 40))
            cv2.putText(layer, text, (margin, y), font, size, 255, thick, cv2.LINE_AA)
        layer[:, w - int(rng.uniform(6, 40)) :] = 0
        opacity = rng.uniform(0.6, 1.0)
    cover = layer.astype(np.float32)[..., None] / 255.0 * np.float32(opacity)
    face[:] = face * (1.0 - cover) + pen * cover


def sides(seed: int) -> list[Side]:
    _boards._write = written if seed >= DRAWN else PLAIN
    scene = _boards.scene(seed)
    fine, _ = shrunk(scene.image, board.FINE)
    rough, scale = shrunk(fine, board.ROUGH)
    grey = cv2.cvtColor(rough, cv2.COLOR_BGR2GRAY)
    quads = _quads.find(_lines.find(grey, board.LINES), _lines.gradient(grey), rough, grey)
    for i in range(min(3, len(quads.score))):
        corners = rescaled(quads.corners[i], 1.0 / scale)
        turned = (np.roll(scene.corners, k, 0) for k in range(4))
        true = min(turned, key=lambda t, c=corners: float(np.linalg.norm(t - c, axis=1).max()))
        if quads.border[i].any() or np.linalg.norm(true - corners, axis=1).max() > FAR:
            continue
        strips = _edges._strips(cv2.cvtColor(fine, cv2.COLOR_BGR2GRAY), corners)
        return [_side(seed, strips, k, true[[k, (k + 1) % 4]]) for k in range(4)]
    return []


def _side(seed: int, strips: _edges._Strips, k: int, ends: np.ndarray) -> Side:
    found = _edges._candidates(strips, k)
    off = []
    for row, shear in zip(found.row, found.shear, strict=True):
        curve, _, _ = _edges._refined(strips, k, float(row), int(shear))
        unit = np.array([[0.0, curve[0]], [1.0, curve.sum()]]) / [1.0, strips.extent[k]]
        p, q = _quads.mapped(strips.H[k][None], unit)[0]
        off.append(float(np.abs((ends - p) @ _edges._normal(p, q)).max()))
    return Side(seed, found.features, np.array(off))


def fit(data: list[Side]) -> tuple[np.ndarray, float]:
    cases = [case for side in data for case in side.cases()]
    x, y = np.array([c[0] for c in cases]), np.array([c[1] for c in cases], float)
    middle, spread = x.mean(0), x.std(0) + 1e-9
    x = np.column_stack([(x - middle) / spread, np.ones(len(x))])

    def loss(w: np.ndarray) -> tuple[float, np.ndarray]:
        z = x @ w
        free = np.append(w[:-1], 0.0)
        slope = x.T @ (1.0 / (1.0 + np.exp(-z)) - y) / len(y) + 2.0 * KEEP * free
        return float(np.mean(np.logaddexp(0.0, z) - y * z) + KEEP * free @ free), slope

    w = minimize(loss, np.zeros(x.shape[1]), jac=True, method="L-BFGS-B", options={"maxiter": 2000}).x
    return w[:-1] / spread, float(w[-1] - (w[:-1] / spread) @ middle)


def share(data: list[Side], weights: np.ndarray, bias: float) -> float:
    """Part of the sides whose likeliest edge comes within LOST pixels."""
    _edges.WEIGHTS, _edges.BIAS = weights, bias
    return float(np.mean([len(s.off) and s.off[_edges._chances(s.features).argmax()] < LOST for s in data]))


def main() -> None:
    views = int(sys.argv[1]) if len(sys.argv) > 1 else 800
    drawn = int(sys.argv[2]) if len(sys.argv) > 2 else views // 8
    cv2.setNumThreads(1)
    seeds = [*range(FITTED, FITTED + views), *range(DRAWN, DRAWN + drawn)]
    data = [side for seed in seeds for side in sides(seed)]
    print(f"in use: {100 * share(data, _edges.WEIGHTS, _edges.BIAS):.1f} % of {len(data)} sides")
    halves = [[s for s in data if s.seed % 2 == k] for k in (0, 1)]
    for fitted, judged in (halves, halves[::-1]):
        w = fit(fitted)
        print(f"fitted {100 * share(fitted, *w):.1f} %, judged {100 * share(judged, *w):.1f} %")
    weights, bias = fit(data)
    print(f"all: {100 * share(data, weights, bias):.1f} %")
    print("WEIGHTS =", np.round(weights, 3).tolist(), "BIAS =", round(bias, 3))


if __name__ == "__main__":
    main()
