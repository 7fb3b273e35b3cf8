"""What studies by the wall's clock share: how long, hogs on every processor, a process that is measured."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import Any

from ..errors import PalpateError
from . import Progress

ASKED_MIN = 10.0
"""for so long a figure must hold [min]"""
_QUICK_MIN = 0.1
_GRACE_S = 120.0
_TELL = "import sys; sys.stdout.write('on\\n'); sys.stdout.flush()\n"
_HOGS = {
    "computing": _TELL + "x = 1\nwhile True: x = (x * 6364136223846793005 + 1442695040888963407) % (1 << 64)",
    # more than a core's own caches hold, so that the measured loop's memory is pushed out
    "copying memory": _TELL + "b = bytearray(8 << 20)\nwhile True: c = bytes(b)",
}


def length(minutes: float | None, quick: bool) -> tuple[float, bool]:
    """Seconds to run, and whether that is as long as the figures ask for."""
    chosen = _QUICK_MIN if quick else ASKED_MIN if minutes is None else minutes
    return 60.0 * chosen, chosen >= ASKED_MIN


def lasted(seconds: float) -> str:
    """For a row's note."""
    return f"{seconds / 60.0:.3g} min" + (
        "" if seconds >= 60.0 * ASKED_MIN else f" of the {ASKED_MIN:g} asked for"
    )


def priority() -> bool:
    """Real-time priority for this process and what it starts, where that is allowed; whether it is."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(10))
    except OSError:
        return False
    return True


def priority_words(granted: bool) -> str:
    """The same as a sentence."""
    return "All processes had real-time priority." if granted else "No process had real-time priority."


@contextmanager
def hogs(kind: str = "computing") -> Iterator[int]:
    """A process for every processor that does nothing but computing, or copying memory; how many."""
    count = os.cpu_count() or 1
    with ExitStack() as stack:
        for _ in range(count):
            hog = stack.enter_context(
                subprocess.Popen([sys.executable, "-c", _HOGS[kind]], stdout=subprocess.PIPE)
            )
            stack.callback(hog.kill)
            assert hog.stdout is not None  # a pipe was asked for
            hog.stdout.readline()
        yield count


def measured(
    module: str, task: Mapping[str, Any], seconds: float, progress: Progress, *, env: Mapping[str, str] = {}
) -> dict[str, Any]:
    """What a module of this package prints as JSON, run in a process of its own with `task` as JSON for its argument.

    Raises:
        PalpateError: it fails; the message is the end of what it says.
    """
    command = [sys.executable, "-m", f"{__package__}.{module}", json.dumps(task)]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env={**os.environ, **env}
    ) as process:
        begin = time.monotonic()
        while True:
            try:
                out, words = process.communicate(timeout=1.0)
                break
            except subprocess.TimeoutExpired:
                gone = time.monotonic() - begin
                progress(min(int(gone), int(seconds) - 1), int(seconds), max(seconds - gone, 0.0))
                if gone > 3.0 * seconds + _GRACE_S:
                    process.kill()
                    raise PalpateError(f"{module} does not come to an end") from None
    progress(int(seconds), int(seconds), 0.0)
    if process.returncode:
        raise PalpateError(f"{module} failed: {' '.join(words.split())[-500:]}")
    found = json.loads(out)
    assert isinstance(found, dict)
    return found
