"""Long series made fit to draw: extremes survive, gaps and NaN stay visible as gaps."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ._text import status_text

Array = npt.NDArray[np.float64]

GAP_FACTOR = 3.0
"""a spacing beyond this many medians is a gap, as in palpate.logs"""
_ABSURD = 1e100
_VISIBLE = 0.003
"""a gap shorter than this share of the whole time cannot be seen"""


def finite(values: npt.ArrayLike) -> Array:
    """A float64 copy with NaN for what is not finite, or so large that drawing it would overflow."""
    array = np.array(values, dtype=np.float64)
    array[~(np.abs(array) < _ABSURD)] = np.nan
    return array


def envelope(x: Array, y: Array, limit: int) -> tuple[Array, Array]:
    """At most about `limit` points of the line y(x) that look the same: each bucket's extremes, in their order.

    A bucket with NaN keeps one, so that the line breaks there. x, y: (N,); see :func:`finite`.
    """
    n = len(y)
    if n <= limit:
        return x, y
    known = np.isfinite(y)
    buckets = max((limit - 2) // (2 if known.all() else 3), 1)
    width = -(-n // buckets)
    buckets = -(-n // width)
    start = np.arange(buckets) * width
    good = _fold(known, width, False)
    bad = _fold(~known, width, False)
    low = start + np.where(good, _fold(y, width, 0.0), np.inf).argmin(axis=1)
    high = start + np.where(good, _fold(y, width, 0.0), -np.inf).argmax(axis=1)
    some = good.any(axis=1)
    keep = np.unique(
        np.concatenate(([0, n - 1], low[some], high[some], (start + bad.argmax(axis=1))[bad.any(axis=1)]))
    )
    return x[keep], y[keep]


def band(x: Array, low: Array, high: Array, limit: int) -> tuple[Array, Array, Array]:
    """At most `limit` columns of the band low..high over x, none narrower than the band was. All (N,)."""
    n = len(x)
    if n <= limit:
        return x, low, high
    width = -(-n // max(limit - 1, 1))
    start = np.arange(0, n, width)
    bottom = np.fmin.reduceat(low, start)
    top = np.fmax.reduceat(high, start)
    # a column holds from its first sample on; the last one is repeated to reach the end
    return np.append(x[start], x[-1]), np.append(bottom, bottom[-1]), np.append(top, top[-1])


def break_at_gaps(x: Array, *columns: Array) -> tuple[Array, ...]:
    """The same rows with one row of NaN inserted in every visible gap of the times x (N,)."""
    if len(x) < 3:
        return (x, *columns)
    dt = np.diff(x)
    least = max(GAP_FACTOR * float(np.median(dt)), _VISIBLE * float(np.ptp(x)))
    after = np.flatnonzero(dt > least) + 1
    if least <= 0.0 or not after.size:
        return (x, *columns)
    middle = 0.5 * (x[after - 1] + x[after])
    return (np.insert(x, after, middle), *(np.insert(c, after, np.nan) for c in columns))


def alone(y: Array) -> npt.NDArray[np.intp]:
    """Indices of finite values without a finite neighbour: a line would not show them."""
    known = np.isfinite(y)
    return np.flatnonzero(known & ~beside(known))


def beside(chosen: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """(N,) True where a neighbour is chosen."""
    result = np.zeros_like(chosen)
    result[1:] |= chosen[:-1]
    result[:-1] |= chosen[1:]
    return result


def limits(values: list[Array]) -> tuple[float, float]:
    """Range [low, high] to show of several curves; extremes that would flatten the rest are left off the scale."""
    pool = np.concatenate([np.ravel(v) for v in values]) if values else np.empty(0)
    pool = pool[np.isfinite(pool)]
    if not pool.size:
        return -1.0, 1.0
    low, high = float(pool.min()), float(pool.max())
    core_low, core_high = (float(p) for p in np.percentile(pool, (1.0, 99.0)))
    core = core_high - core_low
    if core > 0.0 and high - low > 3.0 * core:
        low, high = max(low, core_low - 0.5 * core), min(high, core_high + 0.5 * core)
    margin = 0.06 * (high - low) or 0.05 * max(abs(high), 1e-3)
    return low - margin, high + margin


def spans(time: Array, status: npt.NDArray[np.uint8], cells: int = 400) -> list[tuple[float, float, int]]:
    """(begin, end, status) of every stretch of one status; in each of `cells` pieces the most severe one counts.

    A stretch lasts until the next begins. time, status: (N,).
    """
    n = len(status)
    if not n:
        return []
    width = max(-(-n // cells), 1)
    severity = np.array([status_text(s).severity for s in range(256)], dtype=np.uint8)
    level = _fold(severity[status], width, 0)
    worst = _fold(status, width, 0)[np.arange(len(level)), level.argmax(axis=1)]
    first = np.concatenate(([0], np.flatnonzero(np.diff(worst)) + 1))
    begin = time[first * width]
    end = np.append(begin[1:], time[-1])
    return [(float(b), float(e), int(s)) for b, e, s in zip(begin, end, worst[first], strict=True)]


def _fold(a: npt.NDArray, width: int, fill: object) -> npt.NDArray:
    """(N,) as rows of `width`, the last one filled up."""
    rows = -(-len(a) // width)
    folded = np.full(rows * width, fill, dtype=a.dtype)
    folded[: len(a)] = a
    return folded.reshape(rows, width)
