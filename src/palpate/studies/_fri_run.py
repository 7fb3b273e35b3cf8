"""One measured FRI session, run as a module: ``python -m palpate.studies._fri_run JSON``; prints JSON."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from typing import Any

import numpy as np

from ..drivers.fri import FriDriver
from ..errors import DriverError
from ._peers import peer
from ._timed import priority

_PORT = 30207


def measure(seconds: float, loss: float) -> dict[str, Any]:
    """A wrench overlay every 2 ms against the emulated controller in a process of its own."""
    fifo = priority()
    emulator = peer("fri_emulator")
    command = [sys.executable, emulator.__file__, str(_PORT), str(seconds), str(loss)]
    answers: list[float] = []
    ended = 0
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        driver = FriDriver(emulator.ARM, mode="wrench", port=_PORT, address="127.0.0.1", patience=5.0)
        with driver:
            driver.enable()
            try:
                while True:
                    sample = driver.read()
                    begin = time.monotonic()
                    if driver.state != "enabled":
                        ended += 1
                        driver.enable()
                    elif sample is not None:
                        driver.wrench([0, 0, emulator.wave(sample.time_ns), 0, 0, 0])
                        answers.append(time.monotonic() - begin)
            except DriverError as error:
                if "no monitoring message" not in str(error):
                    raise
            late, lost = driver.late, driver.lost
        assert process.stdout is not None  # a pipe was asked for
        seen = json.loads(process.stdout.read())
    p50, p999 = np.percentile(answers, [50, 99.9])
    return {
        "fifo": fifo,
        **seen,
        "ended": ended,
        "late": late,
        "lost": lost,
        "answer_p50": p50,
        "answer_p999": p999,
    }


if __name__ == "__main__":
    sys.stdout.write(json.dumps(measure(**json.loads(sys.argv[1]))))
