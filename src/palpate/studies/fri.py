"""A KUKA LBR by FRI at 2 ms with a wrench overlay, on a clean and on a bad network, against the emulated controller."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from . import Progress, Row, _timed
from ._rows import near, told

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LOSS = 0.01
"""of datagrams, each way"""


def run(
    progress: Progress, quick: bool, minutes: float | None = None
) -> tuple[list[Row], Mapping[str, Figure], list[str]]:
    """Measure for so long without loss, and as long with it."""
    seconds, enough = _timed.length(minutes, quick)
    rows: list[Row] = []
    for loss in (0.0, LOSS):
        task = {"seconds": seconds, "loss": loss}
        found = _timed.measured("_fri_run", task, seconds, progress)
        where = "no loss" if loss == 0.0 else f"{loss:.0%} lost each way"
        note = f"{found['cycles']} cycles of 2 ms, {_timed.lasted(seconds)}"
        foreign = f"{where}: commands that acted for another message than theirs"
        rows.append(near(foreign, 0, found["foreign"], 0, "1", note, judged=enough))
        what = f"{where}: times that the session ended by the controller's rules"
        if loss == 0.0:
            rows.append(near(what, 0, found["fell_back"], 0, "1", judged=enough))
        else:
            rows.append(told(what, found["fell_back"], "1", "each was named, and commanding began again"))
        missed = 100.0 * found["missed"] / max(found["cycles"], 1)
        rows.append(told(f"{where}: cycles without an answer in time", missed, "%"))
        late = 100.0 * found["late"] / max(found["cycles"], 1)
        note = "answered by the driver's own thread, without the command"
        rows.append(told(f"{where}: cycles whose command came too late", late, "%", note))
        rows.append(told(f"{where}: time for a command, 99.9 %", 1e6 * found["answer_p999"], "us"))
    notes = [
        "The emulated controller runs in a process of its own, in real time and in Python: cycles without an answer "
        "include those in which it was late itself. Each command's value tells for which message it was made, and the "
        "controller checks it. No real controller was at hand. " + _timed.priority_words(found["fifo"]),
    ]
    return rows, {}, notes
