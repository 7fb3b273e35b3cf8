"""Seven emulated Dynamixel servos at 1 Mbps behind 0.5 ms of USB: rate, mass, damaged answers, a dead servo."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from ..errors import PalpateError
from . import Progress, Row, _timed
from ._rows import at_most, near, told

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MASS = 0.25
RATE_HZ = 250.0
CORRUPT = 0.01
DEAD = 4
_CYCLES = 2


def _run(task: Mapping[str, Any], progress: Progress) -> dict[str, Any]:
    found = _timed.measured("_servos_run", task, task["seconds"], progress)
    if found["words"] and not task["dead"]:
        raise PalpateError(
            f"the arm was stopped before {task['seconds']:g} s were over, as it should be: {found['words']} (after "
            f"{found['periods']} periods, {found['late']} more skipped). This computer is too busy to serve the servos "
            "in time: measure on a quiet one"
        )
    return found


def run(
    progress: Progress, quick: bool, minutes: float | None = None
) -> tuple[list[Row], Mapping[str, Figure], list[str]]:
    """Measure for so long on a good line, as long on a bad one, then a few seconds until a servo dies."""
    seconds, enough = _timed.length(minutes, quick)
    rows: list[Row] = []
    for corrupt in (0.0, CORRUPT):
        found = _run({"seconds": seconds, "corrupt": corrupt, "dead": 0}, progress)
        where = "good line" if corrupt == 0.0 else f"{corrupt:.0%} of the answers damaged"
        note = f"{found['samples']} samples, {_timed.lasted(seconds)}; {found['late']} periods skipped"
        rate = found["rate"]
        if corrupt == 0.0:
            rows.append(
                Row(
                    f"{where}: samples per second",
                    f">= {RATE_HZ:g}",
                    rate,
                    None,
                    rate >= RATE_HZ - 0.5 if enough else None,
                    "Hz",
                    note,
                )
            )
        else:
            rows.append(told(f"{where}: samples per second", rate, "Hz", note))
            lost = 100.0 * found["lost"] / found["periods"]
            rows.append(
                at_most(
                    f"{where}: samples lost",
                    1.0,
                    lost,
                    "%",
                    f"{found['damaged']} answers damaged",
                    judged=enough,
                )
            )
        note = f"± {found['mass_std']:.4f} kg, {found['status']}"
        rows.append(near(f"{where}: mass", MASS, found["mass"], 0.02 * MASS, "kg", note, judged=enough))
        what = f"{where}: samples marked ok that are 5 standard deviations and 2 % wrong"
        rows.append(near(what, 0, found["wrong"], 0, "1", judged=enough))
    found = _run({"seconds": 10.0, "corrupt": 0.0, "dead": DEAD}, progress)
    cycles = found["off_s"] / found["period"]
    what = f"servo {DEAD} dies: cycles from its first missing answer until the others push nothing"
    rows.append(at_most(what, _CYCLES, cycles, "1", found["words"], judged=enough))
    notes = [
        "The maker's SDK over a pseudo-terminal; the emulated servos run in a process of their own, in real time, and "
        "move by the MuJoCo plant. No real servo was at hand. "
        + _timed.priority_words(found["fifo"])
        + " The kernel passes the terminal's bytes on without it, so a busy computer shows here.",
    ]
    return rows, {}, notes
