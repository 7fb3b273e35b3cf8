"""What curves show: bounded in memory for ever, every spike kept."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from ..arm import Array

POINTS = 240
"""buckets a curve is drawn with, two points each"""
SPANS = (10.0, 60.0, 600.0, 3600.0)
"""how far back one can look [s]"""


class History:
    """Least and largest value of every channel in buckets of time, for several spans; its size never changes.

    Args:
        channels: numbers per sample.
        spans: how far back to look [s]; a bucket lasts span / points.
        points: buckets per span.
    """

    def __init__(self, channels: int, spans: Sequence[float] = SPANS, points: int = POINTS) -> None:
        self._levels = {float(span): _Level(channels, float(span) / points, points + 1) for span in spans}
        self._newest = -np.inf

    @property
    def spans(self) -> tuple[float, ...]:
        """How far back one can look [s]."""
        return tuple(self._levels)

    def add(self, time: npt.ArrayLike, values: npt.ArrayLike) -> None:
        """Take samples in order of time; where the time steps back, what was there is forgotten.

        Args:
            time: (N,) [s].
            values: (N, channels); NaN is nothing.
        """
        t = np.asarray(time, dtype=np.float64)
        v = np.asarray(values, dtype=np.float64)
        if not len(t):
            return
        back = np.flatnonzero(np.diff(t) < 0.0)
        if len(back):
            t, v = t[back[-1] + 1 :], v[back[-1] + 1 :]
        if len(back) or t[0] < self._newest:
            self.clear()
        self._newest = float(t[-1])
        for level in self._levels.values():
            level.add(t, v)

    def curves(self, span: float) -> tuple[Array, Array]:
        """Times (K,) [s] and values (K, channels) of the last `span` seconds, K <= 2 (points + 1)."""
        level = self._levels[float(span)]
        time, values = level.curves()
        late = time >= self._newest - span - level.width
        return time[late], values[late]

    def clear(self) -> None:
        """Forget everything."""
        self._newest = -np.inf
        for level in self._levels.values():
            level.count = 0


class _Level:
    """A ring of buckets of one width."""

    def __init__(self, channels: int, width: float, size: int) -> None:
        self.width, self.count = width, 0
        self._size = size
        self._bucket = np.zeros(size, dtype=np.int64)
        self._low, self._high, self._first, self._last = np.full((4, size, channels), np.nan)

    def add(self, time: Array, values: Array) -> None:
        buckets, starts, low, high, first, last = grouped(time, values, self.width)
        skip = 0
        newest = (self.count - 1) % self._size
        if self.count and buckets[0] == self._bucket[newest]:
            self._low[newest] = np.fmin(self._low[newest], low[0])
            self._high[newest] = np.fmax(self._high[newest], high[0])
            self._last[newest] = last[0]
            skip = 1
        new = len(starts) - skip
        keep = min(new, self._size)
        rows = slice(len(starts) - keep, len(starts))
        slots = (self.count + np.arange(new - keep, new)) % self._size
        self._bucket[slots] = buckets[rows]
        self._low[slots], self._high[slots] = low[rows], high[rows]
        self._first[slots], self._last[slots] = first[rows], last[rows]
        self.count += new

    def curves(self) -> tuple[Array, Array]:
        n = min(self.count, self._size)
        slots = np.arange(self.count - n, self.count) % self._size
        return interleaved(
            self._bucket[slots],
            self.width,
            self._low[slots],
            self._high[slots],
            self._first[slots] <= self._last[slots],
        )


def grouped(
    time: Array, values: Array, width: float
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.intp], Array, Array, Array, Array]:
    """Buckets of samples: number (B,), first row (B,), least, largest, first and last values (B, channels)."""
    number = np.floor(time / width).astype(np.int64)
    starts = np.flatnonzero(np.diff(number, prepend=number[0] - 1))
    ends = np.append(starts[1:], len(number)) - 1
    low = np.fmin.reduceat(values, starts, axis=0)
    high = np.fmax.reduceat(values, starts, axis=0)
    return number[starts], starts, low, high, values[starts], values[ends]


def interleaved(
    bucket: npt.NDArray[np.int64], width: float, low: Array, high: Array, rising: npt.NDArray[np.bool_]
) -> tuple[Array, Array]:
    """Two points per bucket: its extremes, in the order in which the curve goes through them."""
    time = (np.repeat(bucket, 2) + np.tile([0.25, 0.75], len(bucket))) * width
    values = np.empty((2 * len(bucket), low.shape[1]))
    values[0::2], values[1::2] = np.where(rising, low, high), np.where(rising, high, low)
    return time, values


def thinned(time: Array, values: Array, points: int = POINTS) -> tuple[Array, Array]:
    """Curves (time (N,), values (N, channels)) by at most 2 (points + 1) points, their extremes kept."""
    if len(time) <= 2 * points:
        return time, values
    width = max((float(time[-1]) - float(time[0])) / points, 1e-9)
    bucket, _, low, high, first, last = grouped(time, values, width)
    return interleaved(bucket, width, low, high, first <= last)
