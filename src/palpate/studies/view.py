"""The live page at 1 kHz: its first picture, its updates, and its memory for as long as one likes to watch."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from .. import weigh
from ..view import FPS, Page, SimulatedArm
from . import Progress, Row
from ._browser import DESKTOP, browser, find_browser, first_picture, opened, pictures
from ._figures import curves, drawn
from ._rows import at_most, told

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MINUTES = 60.0
"""watched, unless told otherwise [min]"""
RATE = 1000.0
"""of the arm [Hz]"""
ARM = "justina_left_arm"
_WARM_UP_S = 20.0
"""before the rates are counted [s]"""
_SAMPLE_S = 5.0
"""between two looks at the memory [s]"""
_GROWTH_MB = 8.0
"""of memory within the time that is watched; Python keeps some for later"""


def resident_mb() -> float:
    """Memory of this process that is in use [MB]."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def run(
    progress: Progress, quick: bool, minutes: float | None = None
) -> tuple[list[Row], Mapping[str, Figure], list[str]]:
    """See :meth:`palpate.studies.Study.run`."""
    seconds = 10.0 if quick else 60.0 * (MINUTES if minutes is None else minutes)
    scene = weigh.scene(weigh.load_arm(ARM))
    task = weigh.Task(scene=scene, start=scene.poses["Zero"], poses=(scene.poses["Take3"],), rate=RATE)
    source = SimulatedArm(weigh.simulated_driver(task), scene, mass=scene.mass)
    page = Page(source, port=0)
    names = [name for name in scene.poses if name != "Zero"]
    memory: list[tuple[float, float]] = []
    try:
        source.start()
        with _Looker(page, len(scene.arm.solid_shapes())) as looker:
            begin = time.monotonic()
            # counted from here on
            counted, frames, ticks, drawn_before = begin, page.frames, 0.0, 0
            warm = min(_WARM_UP_S, 0.25 * seconds)
            next_look, next_pose, pose = begin, begin, 0

            def over() -> bool:
                nonlocal counted, frames, ticks, drawn_before, next_look, next_pose, pose
                now = time.monotonic()
                if ticks == 0.0 and now - begin >= warm:
                    reading = source.reading(0)
                    counted, frames = now, page.frames
                    ticks = max(reading.time if reading is not None else 0.0, 1e-9)
                    drawn_before = looker.pictures()
                if now >= next_look:
                    next_look += _SAMPLE_S
                    memory.append((now - begin, resident_mb()))
                    progress(int(now - begin), int(seconds) + 1, seconds - (now - begin))
                if now >= next_pose:  # the arm goes about: every number on the page changes
                    next_pose += 6.0
                    source.go(0, names[pose % len(names)])
                    pose += 1
                return now - begin >= seconds

            page.run(over)
            past = time.monotonic() - counted
            last = source.reading(0)
            assert last is not None
            input_hz = RATE * (last.time - ticks) / past
            updates = (page.frames - frames) / past
            browser_hz = (looker.pictures() - drawn_before) / past
            first = looker.first
    finally:
        source.stop()
        page.close()
    progress(int(seconds) + 1, int(seconds) + 1, 0.0)
    time_s, mb = np.array(memory).T
    settled = time_s >= 0.1 * seconds
    growth = (
        float(np.polyfit(time_s[settled], mb[settled], 1)[0] * 0.9 * seconds) if settled.sum() > 2 else 0.0
    )
    rows = [
        Row(
            f"updates of the page per second, arm at {RATE:g} Hz",
            ">= 30",
            updates,
            None,
            bool(updates >= 30.0),
            "Hz",
        ),
        at_most(
            "first picture after opening the page",
            2.0,
            first,
            "s",
            "drawn by the processor, no graphics card",
        )
        if first is not None
        else told("first picture after opening the page", "no browser here", "", "install chromium"),
        at_most(
            f"memory: trend over the last 90 % of {seconds / 60.0:.3g} min",
            _GROWTH_MB,
            growth,
            "MB",
            f"{mb[settled].min():.0f} to {mb[settled].max():.0f} MB",
        ),
        told("samples of the simulated arm per second", input_hz, "Hz", beside=RATE),
        told(
            "pictures in the browser per second",
            browser_hz,
            "Hz",
            "drawn by the processor, on the same cores",
        ),
    ]
    busy = os.getloadavg()[0]
    notes = [
        f"Processor: {os.cpu_count()} cores, which also run the browser and draw its pictures; mean load at the end "
        f"{busy:.1f}. The page is asked for {FPS:g} updates per second. "
        f"Watched for {seconds / 60.0:.3g} min; the arm moved all the time."
    ]
    figures = drawn(
        lambda: {
            "memory": curves({"resident memory": (time_s / 60.0, mb)}, "memory [MB]", across="time [min]")
        }
    )
    return rows, figures, notes


class _Looker:
    """A browser that looks at the page from a thread of its own; nobody, where there is no browser."""

    def __init__(self, page: Page, things: int) -> None:
        import threading

        self._url, self._things = page.url, things
        self.first: float | None = None
        self._pictures = 0
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._look, name="palpate: browser", daemon=True)

    def __enter__(self) -> _Looker:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()

    def pictures(self) -> int:
        """Drawn so far."""
        return self._pictures

    def _look(self) -> None:
        if find_browser() is None:
            return
        with browser() as found:
            page = opened(found, self._url, DESKTOP, self._things)
            self.first = first_picture(page)
            while not self._over.is_set():
                self._pictures = pictures(page)
                page.wait_for_timeout(500.0)
