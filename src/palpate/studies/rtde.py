"""A UR by RTDE at 500 Hz: rate, age of the samples, a connection cut in motion; against the emulated controller."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from . import Progress, Row, _timed
from ._rows import at_most, near, told

if TYPE_CHECKING:
    from matplotlib.figure import Figure

AGE_MS = 4.0


def run(
    progress: Progress, quick: bool, minutes: float | None = None
) -> tuple[list[Row], Mapping[str, Figure], list[str]]:
    """Measure for so long, then cut."""
    seconds, enough = _timed.length(minutes, quick)
    found = _timed.measured("_rtde_run", {"seconds": seconds}, seconds, progress)
    note = f"{found['samples']} samples, {_timed.lasted(seconds)}; median {1e3 * found['age_p50']:.2f} ms"
    rows = [
        at_most("age of a sample, 99 %", AGE_MS, 1e3 * found["age_p99"], "ms", note, judged=enough),
        told("samples per second", found["rate"], "Hz", beside=500.0),
        told("samples lost", 100.0 * found["lost"] / (found["lost"] + found["samples"]), "%"),
        told("connection cut in motion: the driver says so after", found["noticed"], "s", found["words"]),
        near(
            "the arm stands, held by its controller, 1 s later", 1, int(found["held"]), 0, "1", judged=enough
        ),
        told(
            "connected again and 200 periods read within",
            found["reconnect"],
            "s",
            f"{found['again']} samples",
        ),
        near(
            "samples missing in the recording",
            0,
            found["samples"] - found["recorded"],
            0,
            "1",
            judged=enough,
        ),
    ]
    notes = [
        "The real ur_rtde client against an emulated controller in a process of its own, whose stamps are of this "
        "computer's clock. Joint speeds are commanded meanwhile. No real controller was at hand. "
        + _timed.priority_words(found["fifo"]),
    ]
    return rows, {}, notes
