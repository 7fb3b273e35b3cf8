"""What was wrong with a log file: counted, located, never hidden.

The readers share one rule for a row of numbers: a row is *invalid* when a joint value is NaN, infinite or
absurd (position beyond 1e6, anything else beyond 1e9: such numbers come from flipped bits and uninitialised
memory, not from robots). Invalid rows are dropped and counted, or kept on request so that the live pipeline
can be shown them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from palpate.errors import LogError

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

POSITION_LIMIT = 1e6  #: a larger |position| [rad or m] is no measurement
VALUE_LIMIT = 1e9  #: a larger |value| of any other quantity is no measurement
TIME_LIMIT_NS = (
    2**62
)  #: a time stamp beyond +-146 years [ns] is no time stamp; differences of the rest fit an int64
GAP_FACTOR = 3.0  #: a spacing beyond this many medians is a gap
_LINES_KEPT = 5

WRONG_COLUMNS = "wrong number of columns"
NOT_A_NUMBER = "cell that is not a number"
CUT_LINE = "line cut short by the damage"
BAD_TIME = "unreadable time"
NON_FINITE = "NaN or infinite value"
ABSURD = "absurd value (position beyond 1e6 or other beyond 1e9)"


@dataclass(frozen=True, slots=True)
class Clock:
    """Spacing of a log's time stamps, in file order.

    Attributes:
        median_ns: median spacing [ns]; 0 with fewer than two rows.
        min_ns: smallest spacing [ns]; negative if time ran backwards.
        max_ns: largest spacing [ns].
        gaps: spacings beyond three medians.
        repeated: rows with the same time stamp as the row before.
        backwards: rows with an earlier time stamp than the row before.
    """

    median_ns: int = 0
    min_ns: int = 0
    max_ns: int = 0
    gaps: int = 0
    repeated: int = 0
    backwards: int = 0

    @classmethod
    def of(cls, time_ns: IntArray) -> Clock:
        """Measure the spacing of ``time_ns`` (N,) [ns]."""
        if len(time_ns) < 2:
            return cls()
        dt = np.diff(time_ns)
        median = float(np.median(dt))
        return cls(
            median_ns=round(median),
            min_ns=int(dt.min()),
            max_ns=int(dt.max()),
            gaps=int(np.count_nonzero(dt > GAP_FACTOR * median)) if median > 0 else 0,
            repeated=int(np.count_nonzero(dt == 0)),
            backwards=int(np.count_nonzero(dt < 0)),
        )

    def __str__(self) -> str:
        text = f"spacing {self.median_ns / 1e6:g} ms (min {self.min_ns / 1e6:g}, max {self.max_ns / 1e6:g})"
        for count, what in (
            (self.gaps, "gaps"),
            (self.repeated, "repeated times"),
            (self.backwards, "steps backwards"),
        ):
            if count:
                text += f", {count} {what}"
        return text


@dataclass(frozen=True, slots=True)
class RepairReport:
    """What a reader found wrong with a file and what it did about it.

    Attributes:
        rows_read: rows (CSV), samples (NPZ) or joint messages (bag) seen, good and bad.
        dropped: number of rows, signal values or messages left out, by reason.
        lines: first few places for each reason: line number of the file, from 1 (CSV); sample number, from 0
            (NPZ); message number, from 1 (bag).
        clock: spacing of the time stamps that remain. Repeated or backward times are counted here and kept in
            order.
        notes: everything else worth knowing, one sentence each (file cut short, field missing, topic not
            read, ...).
    """

    rows_read: int
    dropped: Mapping[str, int] = field(default_factory=dict)
    lines: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    clock: Clock = field(default_factory=Clock)
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "dropped", MappingProxyType(dict(self.dropped)))
        object.__setattr__(self, "lines", MappingProxyType({k: tuple(v) for k, v in self.lines.items()}))
        object.__setattr__(self, "notes", tuple(self.notes))

    def __reduce__(self) -> tuple[type[RepairReport], tuple[object, ...]]:
        # a mappingproxy cannot be pickled
        return (RepairReport, (self.rows_read, dict(self.dropped), dict(self.lines), self.clock, self.notes))

    @property
    def clean(self) -> bool:
        """True if nothing was dropped, nothing is worth a note and time always ran forwards."""
        return not (self.dropped or self.notes or self.clock.repeated or self.clock.backwards)

    def __str__(self) -> str:
        parts = [f"{self.rows_read} rows read"]
        for reason, count in self.dropped.items():
            places = ", ".join(map(str, self.lines.get(reason, ())))
            parts.append(f"dropped {count}: {reason}" + (f" (first at {places})" if places else ""))
        parts.append(str(self.clock))
        parts.extend(self.notes)
        return "\n".join(parts)


class Tally:
    """Counts reasons and remembers their first places while a file is read."""

    def __init__(self) -> None:
        self.counts: dict[str, int] = {}
        self.lines: dict[str, list[int]] = {}
        self.notes: list[str] = []
        self.cut = False  #: the input is known to end before its end

    def add(self, reason: str, places: Iterable[int], count: int | None = None) -> None:
        """Count ``places`` (or ``count`` of them) under ``reason``."""
        places = list(places)
        n = len(places) if count is None else count
        if n:
            self.counts[reason] = self.counts.get(reason, 0) + n
            kept = self.lines.setdefault(reason, [])
            kept.extend(places[: _LINES_KEPT - len(kept)])

    def note(self, text: str) -> None:
        """Add a sentence to the notes, once."""
        if text not in self.notes:
            self.notes.append(text)

    def report(self, rows_read: int, time_ns: IntArray) -> RepairReport:
        """Freeze into a report for the rows that remain."""
        lines = {reason: tuple(places) for reason, places in self.lines.items()}
        return RepairReport(rows_read, self.counts, lines, Clock.of(time_ns), tuple(self.notes))


def screen(
    fields: dict[str, FloatArray],
    places: IntArray,
    tally: Tally,
    *,
    keep_invalid: bool,
    garbage: Any = None,
) -> BoolArray:
    """Rows to keep.

    A quantity other than the position that is NaN in every row was not recorded: it is taken out of
    ``fields``, with a note, instead of condemning all rows.

    Args:
        fields: joint quantities (N,n) by name; ``"position"`` has the tighter limit. Changed in place.
        places: (N,) where each row was found, for the report.
        tally: counts the invalid rows, once each, by the first reason that applies.
        keep_invalid: change and drop nothing; a note says how many rows are invalid.
        garbage: (N,) rows with text where a number should be.

    Returns:
        (N,) mask.
    """
    n = len(places)
    text = np.zeros(n, dtype=bool) if garbage is None else np.asarray(garbage, dtype=bool)
    if not keep_invalid and not text.any():
        for name in [name for name in fields if name != "position"]:
            if n and np.isnan(fields[name]).all():
                del fields[name]
                tally.note(f"{name} is empty in every row")
    bad = np.zeros(n, dtype=bool)
    absurd = np.zeros(n, dtype=bool)
    for name, value in fields.items():
        limit = POSITION_LIMIT if name == "position" else VALUE_LIMIT
        bad |= ~np.isfinite(value).all(axis=1)
        absurd |= (np.abs(value) > limit).any(axis=1)
    bad &= ~text
    absurd &= ~(text | bad)
    for reason, mask in ((NOT_A_NUMBER, text), (NON_FINITE, bad), (ABSURD, absurd)):
        if keep_invalid and mask.any():
            first = ", ".join(map(str, places[mask][:_LINES_KEPT]))
            tally.note(f"kept, as asked: {int(mask.sum())} rows with {reason} (first at {first})")
        elif not keep_invalid:
            tally.add(reason, places[mask].tolist())
    return np.ones(n, dtype=bool) if keep_invalid else ~(text | bad | absurd)


def screen_signal(name: str, value: FloatArray, places: IntArray, tally: Tally) -> BoolArray:
    """Which values (M,) or (M,k) of a signal to keep, as a mask (M,); the others are counted under its name."""
    within = np.abs(value) <= VALUE_LIMIT  # False for NaN, too
    good: BoolArray = within if value.ndim == 1 else np.asarray(within.all(axis=1))
    tally.add(f"signal {name}: NaN, infinite or beyond 1e9", places[~good].tolist())
    return good


def require_rows(where: str, rows_read: int, rows_left: int, tally: Tally) -> None:
    """Raise if nothing is left.

    Raises:
        LogError: with the reasons.
    """
    if rows_left:
        return
    reasons = [
        f"{count} with {reason} (first at {', '.join(map(str, tally.lines[reason]))})"
        for reason, count in tally.counts.items()
    ]
    raise LogError(f"{where}: none of {rows_read} rows is usable: " + "; ".join(reasons + tally.notes))
