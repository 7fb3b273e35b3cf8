"""One measured RTDE connection, run as a module: ``python -m palpate.studies._rtde_run JSON``; prints JSON."""

from __future__ import annotations

import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from ..drivers.ur_rtde import UrDriver
from ..errors import DriverError
from ..logs import Log, Recorder
from ._peers import peer
from ._timed import priority

_HOST = "127.0.5.7"
_AFTER = 200
"""samples read after the connection is mended"""


def measure(seconds: float) -> dict[str, Any]:
    """Read and command at 500 Hz, then cut the connection in motion, then connect again."""
    fifo = priority()
    emulator = peer("ur_emulator")
    arm = emulator.ur5e()
    ages: list[float] = []
    with tempfile.TemporaryDirectory() as folder, emulator.UrController(_HOST) as controller:
        file = Path(folder) / "run.mcap"
        with UrDriver(arm, _HOST, mode="speed", watchdog=0.5) as driver:
            recorder = Recorder(file, arm.joint_names)
            driver.enable()
            begin = time.monotonic()
            cut = 0.0
            stamps: list[int] = []
            try:
                while True:
                    now = time.monotonic()
                    if now - begin > seconds and not cut:
                        controller.tell("cut")
                        cut = time.monotonic()
                    sample = driver.read()
                    if sample is None:
                        continue
                    if not cut:  # the emulated controller's stamps are of this computer's clock
                        ages.append(time.monotonic() - sample.time_ns * 1e-9)
                    stamps.append(sample.time_ns)
                    recorder.sample(*sample)
                    driver.speed([0.02 * np.sin(sample.time_ns * 1e-9), 0, 0, 0, 0, 0])
            except DriverError as error:
                if not cut:
                    raise
                noticed, words = time.monotonic() - cut, str(error)
            recorder.close()
            lost = driver.lost
            time.sleep(1.0)
            state = controller.tell("mend")
            driver.close()
            mended = time.monotonic()
            driver.connect()
            again = [driver.read() for _ in range(_AFTER)]
            reconnect = time.monotonic() - mended
        recorded = len(Log.open(file))
    return {
        "fifo": fifo,
        "samples": len(stamps),
        "lost": lost,
        "rate": (len(ages) - 1) / max(1e-9 * (stamps[len(ages) - 1] - stamps[0]), 1e-9),
        "age_p50": float(np.percentile(ages, 50)),
        "age_p99": float(np.percentile(ages, 99)),
        "noticed": noticed,
        "words": words,
        "held": state["mode"] == "hold" and not state["program"] and max(map(abs, state["dq"])) < 1e-3,
        "reconnect": reconnect,
        "again": sum(s is not None for s in again),
        "recorded": recorded,
    }


if __name__ == "__main__":
    sys.stdout.write(json.dumps(measure(**json.loads(sys.argv[1]))))
