"""What is to be wiped and what is to stay: by colour, within a region, or everything but a region."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import shapely

from ..arm import Array
from ..errors import InputError, suggest
from ..vision import Sight
from .strokes import outlines, shape

GREY = 0.25
"""least chroma of ink that is not black: by what its channels take away light differently, relative to the most"""
HUES: Mapping[str, float] = {"red": 0.0, "yellow": 60.0, "green": 120.0, "blue": 225.0, "purple": 285.0}
"""hue of the usual markers [deg]"""
COLOURS = ("black", *HUES)


@dataclass(frozen=True, slots=True, eq=False)
class Choice:
    """Outlines in board coordinates, each (M, 2) [m]."""

    wipe: tuple[Array, ...]
    keep: tuple[Array, ...]
    """ink to stay and whatever else is not to be touched"""


def choose(
    ink: Iterable[npt.ArrayLike],
    *,
    colours: Iterable[str] | None = None,
    colour: Iterable[str] | None = None,
    within: npt.ArrayLike | None = None,
    without: npt.ArrayLike | None = None,
    objects: Iterable[npt.ArrayLike] = (),
) -> Choice:
    """Divide ink into what goes and what stays.

    Args:
        ink: outlines in board coordinates, each (M, 2) [m].
        colours: the colour of each, see :func:`ink_colours`; needed with `colour`.
        colour: wipe these only, of COLOURS; None: all.
        within: (M, 2) outline of a region: wipe only there.
        without: (M, 2) outline of a region in which nothing is touched, not even by the eraser's rim.
        objects: outlines of things on the board; nothing touches them.

    Raises:
        InputError: no such colour, colours missing or of another number, an outline of the wrong shape.
    """
    pieces = [shape(p, "ink") for p in ink]
    wanted = [True] * len(pieces)
    if colour is not None:
        names = [colour] if isinstance(colour, str) else list(colour)
        for name in names:
            if name not in COLOURS:
                raise InputError(f"no colour {name!r}; {suggest(name, COLOURS, 'there are')}")
        given = None if colours is None else list(colours)
        if given is None or len(given) != len(pieces):
            raise InputError(
                f"to wipe by colour, the colour of each of {len(pieces)} pieces of ink is needed, got "
                f"{'none' if given is None else len(given)}"
            )
        wanted = [c in names for c in given]
    region = None if within is None else shape(within, "within")
    taboo = None if without is None else shape(without, "without")
    wipe: list[Any] = []
    keep: list[Any] = [shape(p, "objects") for p in objects]
    for piece, yes in zip(pieces, wanted, strict=True):
        goes = piece if yes else shapely.Polygon()
        if region is not None:
            goes = goes.intersection(region)
        if taboo is not None:
            goes = goes.difference(taboo)
        wipe.append(goes)
        keep.append(piece.difference(goes))
    if taboo is not None:
        keep.append(taboo)
    return Choice(
        tuple(o for g in wipe for o in outlines(g)),
        tuple(o for g in keep for o in outlines(g)),
    )


def ink_colours(image: npt.ArrayLike, sight: Sight) -> tuple[str, ...]:
    """The marker's colour, of COLOURS, of each piece of ink that was seen in a picture (H, W, 3) BGR.

    By the light that the ink takes away from the surface around it, so that the lamp's colour does not matter; the
    darkest quarter of a piece counts, because a stroke's rim is mixed with the surface.

    Raises:
        InputError: the picture is not the one that was seen.
    """
    if sight.ink is None:
        return ()
    picture = np.asarray(image)
    if picture.shape != (*sight.ink.mask.shape, 3):
        raise InputError(
            f"the picture must be that which was seen, {(*sight.ink.mask.shape, 3)} BGR, got {picture.shape}"
        )
    names = []
    for outline in sight.ink.polygons:
        low = np.maximum(np.floor(outline.min(0)).astype(int) - 8, 0)
        high = np.ceil(outline.max(0)).astype(int) + 9
        part = picture[low[1] : high[1], low[0] : high[0]].astype(np.float64)
        inside = np.zeros(part.shape[:2], np.uint8)
        cv2.fillPoly(inside, [np.rint(outline - low).astype(np.int32)], 1)
        mine = (inside > 0) & sight.ink.mask[low[1] : high[1], low[0] : high[0]]
        mine = mine if mine.any() else inside > 0
        white = np.median(part[~mine], axis=0) if (~mine).any() else np.full(3, 255.0)
        left = 255.0 * np.clip(part[mine] / np.maximum(white, 1.0), 0.0, 1.0)
        core = left[left.sum(1) <= np.quantile(left.sum(1), 0.25)].mean(0)
        names.append(_name(core))
    return tuple(names)


def _name(bgr: Array) -> str:
    b, g, r = bgr
    if bgr.max() - bgr.min() < GREY * (255.0 - bgr.min()):  # of thin ink as of thick
        return "black"
    hue = math.degrees(math.atan2(math.sqrt(3.0) * (g - b), 2.0 * r - g - b)) % 360.0
    return min(HUES, key=lambda n: abs((hue - HUES[n] + 180.0) % 360.0 - 180.0))
