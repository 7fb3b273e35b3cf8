"""The real-time session at 1 kHz, every processor busy: own time, lateness, lost ticks, records, allocations."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from . import Progress, Row, _timed
from ._rows import at_most, near, told

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RATE_HZ = 1000.0
OWN_US = 20.0
"""99.9 % of the ticks must need no more of the session's own time"""
_QUANTILES = (("median", "p50_ns"), ("99 %", "p99_ns"), ("99.9 %", "p999_ns"), ("worst", "worst_ns"))


def counting_allocator(folder: Path) -> Path | None:
    """The tests' counting allocator as a library to preload; None: no source tree or no compiler."""
    source = Path(__file__).parents[3] / "core" / "tests" / "no_alloc.cpp"
    compiler = shutil.which("c++")
    if compiler is None or not source.is_file():
        return None
    library = folder / "libcount.so"
    options = ["-std=c++20", "-O2", "-shared", "-fPIC", "-ftls-model=initial-exec"]
    done = subprocess.run([compiler, *options, str(source), "-o", str(library)], check=False)
    return library if done.returncode == 0 else None


def rows(found: Mapping[str, Any], seconds: float, enough: bool) -> list[Row]:
    """The figures of a run."""
    judged = enough
    note = f"{found['ticks']} ticks, {_timed.lasted(seconds)}"
    own, late = found["own"], found["late"]
    out = []
    for name, key in _QUANTILES:
        what, ours = f"own time of a tick, {name}", 1e-3 * own[key]
        if key == "p999_ns":
            out.append(at_most(what, OWN_US, ours, "us", note, judged=judged))
        else:
            out.append(told(what, ours, "us"))
    out.append(
        told(
            "the same, 99.9 %, in processor time",
            1e-3 * found["own_processor"]["p999_ns"],
            "us",
            "without the time in which the computer did something else",
        )
    )
    out += [told(f"lateness of a tick, {name}", 1e-3 * late[key], "us") for name, key in _QUANTILES]
    out.append(near("ticks lost by palpate's own doing", 0, found["lost_own"], 0, "1", note, judged=judged))
    out.append(
        told(
            "ticks lost by the computer",
            found["lost_system"] + found["lost_driver"],
            "1",
            "woken late, or the processor taken away",
        )
    )
    lost = found["records_dropped"] + found["samples"] - found["recorded"]
    note = f"{found['recorded']} samples found in the recording of {1e-6 * found['bytes']:.0f} MB"
    out.append(near("records lost", 0, lost, 0, "1", note, judged=judged))
    if found["counted"]:
        out.append(near("heap allocations in the loop", 0, found["allocations"], 0, "1", judged=judged))
    else:
        out.append(told("heap allocations in the loop", "not counted", "1", "needs the source tree and c++"))
    return out


def run(
    progress: Progress, quick: bool, minutes: float | None = None
) -> tuple[list[Row], Mapping[str, Figure], list[str]]:
    """Measure the default pipeline for so long, then for a tenth of it each: caches emptied; everything estimated."""
    seconds, enough = _timed.length(minutes, quick)
    short = max(3.0, seconds / 10.0)
    with tempfile.TemporaryDirectory() as folder:
        library = counting_allocator(Path(folder))
        env = {} if library is None else {"LD_PRELOAD": str(library)}
        task = {"rate": RATE_HZ, "everything": False, "fifo": True}

        def measured(hogs: str, duration: float, **other: Any) -> dict[str, Any]:
            with _timed.hogs(hogs):
                options = {**task, **other, "seconds": duration}
                return _timed.measured("_session_run", options, duration, progress, env=env)

        found = measured("computing", seconds)
        emptied = measured("copying memory", short)
        more = measured("computing", short, everything=True)
    out = rows(found, seconds, enough)
    for what, other in (
        ("while the other processes copy memory", emptied),
        ("with observer, wrench and contacts too", more),
    ):
        median = 1e-3 * other["own"]["p50_ns"]
        note = f"median {median:.1f} us; {other['ticks']} ticks, {other['lost_own']} lost by itself"
        out.append(told(f"own time of a tick {what}, 99.9 %", 1e-3 * other["own"]["p999_ns"], "us", note))
    granted = found["granted"]
    rights = "The thread had real-time priority (SCHED_FIFO)" if granted["fifo"] else "No real-time priority"
    rights += " and locked memory" if granted["locked"] else ", memory not locked"
    notes = [
        f"A simulated seven-joint arm at {RATE_HZ:g} Hz goes from pose to pose and lifts 0.25 kg now and then; the "
        "payload filter weighs, the controller moves, the safety limiter guards, everything is recorded to MCAP. "
        "Meanwhile a process for every processor computes without pause. Own time is that of estimating, controlling, "
        "limiting and recording, without the simulated arm.",
        rights + (f" ({granted['complaint']})." if granted["complaint"] else "."),
    ]
    return out, {}, notes
