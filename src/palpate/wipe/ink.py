"""Ink on a board as a texture: how it gets there, and how it goes where felt slides over it under pressure.

Law. Felt that slides by ds under the pressure p does the work p ds on each square metre (N/m^2 m = J/m^2). One layer of
ink needs `toughness` of it to come off: amount -= p ds / toughness, not below zero, and nothing at all below the least
pressure, at which the felt's hairs only touch. This is Archard's law of wear (1953) with a threshold. Dry ink is
tougher, so it takes more passes; felt that is pressed down without sliding, or slides without pressure, takes nothing.
Ink that has come off stays in the felt.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from ..arm import Array
from ..errors import InputError

Texture: TypeAlias = npt.NDArray[np.float32]

FRESH = 12.0
"""work that takes one layer of fresh ink off [J/m^2]: half a pass of a 50 mm block at 450 Pa"""
DRY = 45.0
"""of ink that has dried for days [J/m^2]: two passes"""
LEAST_PRESSURE = 60.0
"""[Pa]; a 50 mm x 110 mm block of felt of 30 g has 50 Pa by its weight alone"""
VISIBLE = 0.05
"""part of a layer that can be told from the bare board"""

WHITE = (242, 244, 243)
"""of the bare board, red green blue"""
MARKERS: dict[str, tuple[int, int, int]] = {
    "black": (32, 32, 36),
    "red": (196, 36, 44),
    "green": (24, 128, 72),
    "blue": (30, 62, 176),
}

_FONTS = (cv2.FONT_HERSHEY_SCRIPT_SIMPLEX, cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_SCRIPT_COMPLEX)
_WORDS = (
    "torque = inertia", "ask Ana", "call 4711", "milk, eggs", "Tuesday 9:30", "F = m a", "done?", "see page 12",
    "v = dx/dt", "new batch", "do not erase", "plan B", "x + y < 3", "thanks!",
)  # fmt: skip
_FINER = 4  # lines are drawn so many times finer


@dataclass(slots=True, eq=False)
class InkLayer:
    """The writing surface of a board, in board coordinates (x along the top edge, y down the left edge) [m]."""

    size: tuple[float, float] = (0.9, 0.6)
    """width and height [m]"""
    texel: float = 1e-3
    """[m]"""
    amount: Texture = field(init=False)
    """(H, W) layers of ink, >= 0"""
    toughness: Texture = field(init=False)
    """(H, W) work that takes one layer off [J/m^2]"""
    colour: npt.NDArray[np.uint8] = field(init=False)
    """(H, W, 3) of the ink, red green blue"""
    work: Texture = field(init=False)
    """(H, W) that felt has done on the surface so far [J/m^2]"""

    def __post_init__(self) -> None:
        for value in (*self.size, self.texel):
            if not (math.isfinite(value) and value > 0.0):
                raise InputError(f"ink: size and texel must be finite lengths > 0 m, got {value!r}")
        w, h = (round(s / self.texel) for s in self.size)
        if not (8 <= w <= 8192 and 8 <= h <= 8192):
            raise InputError(f"ink: a board must be 8 to 8192 texels wide and high, got {w} x {h}")
        self.amount = np.zeros((h, w), np.float32)
        self.toughness = np.full((h, w), FRESH, np.float32)
        self.colour = np.full((h, w, 3), WHITE, np.uint8)
        self.work = np.zeros((h, w), np.float32)

    # -- putting ink on --------------------------------------------------------

    def stroke(
        self,
        points: npt.ArrayLike,
        *,
        width: float = 0.004,
        colour: str = "black",
        amount: float = 1.0,
        toughness: float = FRESH,
    ) -> None:
        """A line of a marker through points (K, 2) [m], `width` [m] wide; what lies beside the board is lost.

        Raises:
            InputError: wrong shape, no such colour, or a number that is not positive.
        """
        line = np.atleast_2d(np.asarray(points, dtype=np.float64))
        if line.ndim != 2 or line.shape[1] != 2 or not np.all(np.isfinite(line)):
            raise InputError(f"a stroke's points must be finite and (K, 2) [m], got shape {line.shape}")
        # OpenCV's smooth lines are two pixels too wide: a fine plain one, made small, is not
        rows, columns = self.amount.shape
        fine = np.zeros((_FINER * rows, _FINER * columns), np.uint8)
        at = np.rint(line / self.texel * _FINER - 0.5).astype(np.int32)
        pen = max(1, round(_positive(width, "width of a stroke") / self.texel * _FINER))
        cv2.polylines(fine, [at], False, 255, pen, cv2.LINE_8)
        mask = cv2.resize(fine, (columns, rows), interpolation=cv2.INTER_AREA)
        self._add(mask.astype(np.float32) / 255.0, colour, amount, toughness)

    def text(
        self,
        words: str,
        at: tuple[float, float],
        *,
        height: float = 0.05,
        slant: float = 0.0,
        turn: float = 0.0,
        width: float = 0.004,
        colour: str = "black",
        amount: float = 1.0,
        toughness: float = FRESH,
        font: int = cv2.FONT_HERSHEY_SCRIPT_SIMPLEX,
    ) -> None:
        """Words of a pen, printed (any Hershey font of OpenCV) or, with slant and turn, by hand.

        Args:
            words: ASCII.
            at: (2,) lower left end [m].
            height: of a capital letter [m].
            slant: of upright lines [rad].
            turn: of the line of writing [rad].
            width: of the pen [m].
            colour: one of MARKERS.
            amount: layers.
            toughness: [J/m^2].
            font: of OpenCV.

        Raises:
            InputError: no such colour, or a number that is not positive.
        """
        tall = 60
        pen = max(
            1, round(_positive(width, "width of a stroke") / _positive(height, "height of words") * tall)
        )
        scale = cv2.getFontScaleFromHeight(font, tall, pen)
        (w, h), base = cv2.getTextSize(words, font, scale, pen)
        ink = np.zeros((h + base + 4 * pen, w + 4 * pen), np.uint8)
        cv2.putText(ink, words, (2 * pen, h + 2 * pen), font, scale, 255, pen, cv2.LINE_AA)
        s = height / tall / self.texel
        c, k = math.cos(turn), math.sin(turn)
        M = s * np.array([[c, -k - slant * c], [k, c - slant * k]])
        shift = np.array(at) / self.texel - M @ [2 * pen, h + 2 * pen]
        rows, columns = self.amount.shape
        flags = cv2.INTER_AREA if s < 1.0 else cv2.INTER_LINEAR
        laid = cv2.warpAffine(ink, np.column_stack((M, shift)), (columns, rows), flags=flags)
        self._add(laid / np.float32(255.0), colour, amount, toughness)

    def smudge(
        self,
        centre: tuple[float, float],
        radii: tuple[float, float],
        *,
        turn: float = 0.0,
        colour: str = "black",
        amount: float = 0.35,
        toughness: float = FRESH,
        seed: int = 0,
    ) -> None:
        """Wiped-about ink: an ellipse (half axes `radii` [m], turned by `turn` [rad]) of short streaks along it.

        Raises:
            InputError: no such colour, or a number that is not positive.
        """
        rng = np.random.default_rng(seed)
        a, b = (_positive(r, "half axis of a smudge") for r in radii)
        rows, columns = self.amount.shape
        x, y = np.meshgrid((np.arange(columns) + 0.5) * self.texel, (np.arange(rows) + 0.5) * self.texel)
        c, s = math.cos(turn), math.sin(turn)
        u = ((x - centre[0]) * c + (y - centre[1]) * s) / a
        v = ((y - centre[1]) * c - (x - centre[0]) * s) / b
        streaks = rng.random(64)[np.clip(np.floor((v + 1.0) * 32), 0, 63).astype(int)]
        body = np.clip(1.0 - u * u - v * v, 0.0, 1.0) ** 0.5 * (0.4 + 0.6 * streaks)
        self._add(body.astype(np.float32), colour, amount, toughness)

    def picture(self, image: npt.ArrayLike, *, amount: float = 1.0, toughness: float = FRESH) -> None:
        """Any picture (h, w, 3) or (h, w), uint8, red green blue, as large as the board allows, in its middle.

        What is white stays bare; the darker or the more coloured, the more ink.

        Raises:
            InputError: not a picture, or a number that is not positive.
        """
        given = np.asarray(image)
        if given.dtype != np.uint8 or given.ndim not in (2, 3) or given.size == 0:
            raise InputError(
                f"a picture must be uint8 and (h, w, 3) or (h, w), got {given.dtype} {given.shape}"
            )
        if given.ndim == 3 and given.shape[2] != 3:
            raise InputError(f"a picture must have 3 channels, red green blue, got {given.shape[2]}")
        rgb = given if given.ndim == 3 else np.repeat(given[..., None], 3, axis=2)
        rows, columns = self.amount.shape
        scale = min(rows / rgb.shape[0], columns / rgb.shape[1])
        h, w = max(1, int(scale * rgb.shape[0])), max(1, int(scale * rgb.shape[1]))
        rgb = cv2.resize(rgb, (w, h), interpolation=cv2.INTER_AREA if scale < 1.0 else cv2.INTER_LINEAR)
        top, left = (rows - h) // 2, (columns - w) // 2
        taken = 1.0 - rgb.min(2) / np.float32(255.0)
        taken[taken < 2.0 * VISIBLE] = 0.0  # paper is never quite white
        part = np.s_[top : top + h, left : left + w]
        new = _positive(amount, "amount of ink") * taken
        # what shines through a thin layer is the board: the ink itself is as dark as the layer is thin
        pure = 255.0 - (255.0 - rgb) / np.maximum(taken, 1e-3)[..., None]
        self._lay(part, new, np.clip(pure, 0, 255), _positive(toughness, "toughness"))

    def _add(self, shape: Texture, colour: str, amount: float, toughness: float) -> None:
        if colour not in MARKERS:
            raise InputError(f"no marker {colour!r}; there are {', '.join(MARKERS)}")
        whole = np.s_[:, :]
        self._lay(
            whole,
            _positive(amount, "amount of ink") * shape,
            np.broadcast_to(np.array(MARKERS[colour], np.float64), self.colour.shape),
            _positive(toughness, "toughness"),
        )

    def _lay(self, part: tuple[slice, slice], new: Texture, colour: Array, toughness: float) -> None:
        """Ink on ink: amounts add up, colour and toughness mix by amount."""
        old = self.amount[part]
        share = new / np.maximum(old + new, 1e-9)
        self.colour[part] = np.rint(
            self.colour[part] + share[..., None] * (colour - self.colour[part])
        ).astype(np.uint8)
        self.toughness[part] += share * (toughness - self.toughness[part])
        self.amount[part] = old + new

    # -- taking it off ---------------------------------------------------------

    def rub(
        self,
        centre: npt.ArrayLike,
        angle: float,
        footprint: tuple[float, float],
        pressure: npt.ArrayLike,
        slide: npt.ArrayLike,
        turn: float = 0.0,
    ) -> float:
        """Felt moves a little; ink goes by the law above.

        Args:
            centre: (2,) of the felt, board coordinates [m].
            angle: of its x axis, from the board's x towards its y [rad].
            footprint: extent along its own x and y [m].
            pressure: on the felt, (nx, ny) evenly over the footprint, or one number [Pa]; below zero counts as zero.
            slide: (2,) way of the centre over the board [m]; small against the footprint.
            turn: about the board's normal, from its x towards its y [rad].

        Returns:
            Ink that went [layers m^2].

        Raises:
            InputError: a wrong shape or a number that is not finite.
        """
        c, d = (np.asarray(v, dtype=np.float64) for v in (centre, slide))
        p = np.atleast_2d(np.asarray(pressure, dtype=np.float64))
        w, h = (_positive(f, "footprint") for f in footprint)
        if c.shape != (2,) or d.shape != (2,) or p.ndim != 2:
            raise InputError(
                f"rub: centre and slide must be (2,) and pressure (nx, ny), got {c.shape}, {d.shape}, {p.shape}"
            )
        if not (np.all(np.isfinite(c)) and np.all(np.isfinite(d)) and np.all(np.isfinite(p))):
            raise InputError("rub: centre, slide and pressure must be finite")
        if not (math.isfinite(angle) and math.isfinite(turn)):
            raise InputError(f"rub: angle and turn must be finite, got {angle!r} and {turn!r}")
        rows, columns = self.amount.shape
        ca, sa = math.cos(angle), math.sin(angle)
        reach = 0.5 * np.array([abs(w * ca) + abs(h * sa), abs(w * sa) + abs(h * ca)])
        low = np.maximum(np.floor((c - reach) / self.texel).astype(int), 0)
        high = np.minimum(np.ceil((c + reach) / self.texel).astype(int), [columns, rows])
        if np.any(low >= high) or not np.any(p >= LEAST_PRESSURE):
            return 0.0
        dx = ((np.arange(low[0], high[0]) + 0.5) * self.texel - c[0])[None]
        dy = ((np.arange(low[1], high[1]) + 0.5) * self.texel - c[1])[:, None]
        u, v = (dx * ca + dy * sa) / w + 0.5, (dy * ca - dx * sa) / h + 0.5
        inside = (u >= 0.0) & (u < 1.0) & (v >= 0.0) & (v < 1.0)
        nx, ny = p.shape
        i, j = (np.clip((s * n).astype(int), 0, n - 1) for s, n in ((u, nx), (v, ny)))
        here = np.where(inside, p[i, j], 0.0)
        here[here < LEAST_PRESSURE] = 0.0
        way = np.hypot(d[0] - turn * dy, d[1] + turn * dx)
        part = np.s_[low[1] : high[1], low[0] : high[0]]
        old = self.amount[part]
        done = (here * way).astype(np.float32)
        self.work[part] += done
        gone = np.minimum(old, done / self.toughness[part])
        self.amount[part] = old - gone
        return float(gone.sum(dtype=np.float64)) * self.texel**2

    # -- looking ---------------------------------------------------------------

    @property
    def visible(self) -> npt.NDArray[np.bool_]:
        """(H, W) where ink can be told from the bare board."""
        return self.amount > VISIBLE

    @property
    def area(self) -> float:
        """Under visible ink [m^2]."""
        return float(self.visible.sum()) * self.texel**2

    @property
    def rgb(self) -> npt.NDArray[np.uint8]:
        """(H, W, 3) as it looks, red green blue."""
        cover = np.minimum(self.amount, 1.0)[..., None]
        bare = np.array(WHITE, np.float32)
        return np.rint(bare + cover * (self.colour - bare)).astype(np.uint8)


def handwriting(layer: InkLayer, seed: int, *, lines: int = 5, smudges: int = 2) -> None:
    """Cover a layer with words, drawings and smudges by chance; the same seed gives the same."""
    rng = np.random.default_rng(seed)
    W, H = layer.size
    names = tuple(MARKERS)

    def toughness() -> float:
        return float(rng.uniform(0.7 * FRESH, 1.3 * FRESH))

    for k in range(lines):
        height = float(rng.uniform(0.05, 0.09)) * H
        layer.text(
            str(rng.choice(_WORDS)),
            (
                float(rng.uniform(0.06, 0.45)) * W,
                (0.18 + 0.74 * (k + float(rng.uniform(0.1, 0.9))) / lines) * H,
            ),
            height=height,
            slant=float(rng.uniform(-0.1, 0.35)),
            turn=float(rng.uniform(-0.08, 0.08)),
            width=float(rng.uniform(0.003, 0.005)),
            colour=str(rng.choice(names)),
            toughness=toughness(),
            font=int(rng.choice(_FONTS)),
        )
    for _ in range(2):
        phase = np.linspace(0.0, 2.0 * math.pi, 40)
        radius = float(rng.uniform(0.04, 0.1)) * H * (1.0 + 0.15 * np.sin(3.0 * phase + rng.uniform(0, 6)))
        centre = rng.uniform(0.2, 0.8, 2) * [W, H]
        layer.stroke(
            centre + radius[:, None] * np.stack((np.cos(phase), np.sin(phase)), 1),
            colour=str(rng.choice(names)),
            toughness=toughness(),
        )
    for _ in range(smudges):
        layer.smudge(
            (float(rng.uniform(0.2, 0.8)) * W, float(rng.uniform(0.2, 0.8)) * H),
            (float(rng.uniform(0.04, 0.08)) * W, float(rng.uniform(0.02, 0.05)) * H),
            turn=float(rng.uniform(0.0, math.pi)),
            colour=str(rng.choice(names)),
            seed=int(rng.integers(1 << 30)),
        )


def _positive(value: float, what: str) -> float:
    number = float(value)
    if not (math.isfinite(number) and number > 0.0):
        raise InputError(f"{what} must be finite and > 0, got {value!r}")
    return number
