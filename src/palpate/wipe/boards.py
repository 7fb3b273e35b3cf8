"""Boards by chance, for measuring: the same seed gives the same."""

from __future__ import annotations

import math

import numpy as np

from .ink import InkLayer, handwriting
from .scene import Setting

TILT = math.radians(15.0)
"""of the table at most [rad]"""


def random_board(seed: int) -> tuple[InkLayer, Setting]:
    """A board with words, drawings and smudges, lying loose on a table tilted by up to 15 degrees.

    It lies where an LBR iiwa 7 gets everywhere: nearer to the arm when the far edge is down.
    """
    rng = np.random.default_rng((2026, seed))
    layer = InkLayer((float(rng.uniform(0.40, 0.50)), float(rng.uniform(0.28, 0.34))))
    handwriting(
        layer, int(rng.integers(1 << 30)), lines=int(rng.integers(2, 5)), smudges=int(rng.integers(1, 3))
    )
    tilt = float(rng.uniform(-TILT, TILT))
    x, _, z = place(tilt)
    x += float(rng.uniform(-0.01, 0.01))
    return layer, Setting(
        centre=(x, float(rng.uniform(-0.03, 0.03)), z),
        turn=float(rng.uniform(-0.1, 0.1)),
        tilt=tilt,
        mass=float(rng.uniform(1.2, 2.0)),
        friction=float(rng.uniform(0.35, 0.5)),
        seed=seed,
    )


def place(tilt: float) -> tuple[float, float, float]:
    """Where on a table of this tilt [rad] an LBR iiwa 7 gets everywhere on a board: its middle, world [m]."""
    return 0.60 + 0.15 * tilt, 0.0, 0.15
