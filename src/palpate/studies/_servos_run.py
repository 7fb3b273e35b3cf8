"""One measured servo bus, run as a module: ``python -m palpate.studies._servos_run JSON``; prints JSON."""

from __future__ import annotations

import json
import subprocess
import sys
from typing import Any

import numpy as np

from .. import robots, weigh
from .._core import Status
from ..drivers.bus import Bus, Servo
from ..drivers.dynamixel import DynamixelDriver
from ..errors import DriverError
from ._peers import peer
from ._timed import priority

MASS = 0.25
_CONSTANT = 1.78
"""of the emulated servos [N m/A]"""


def measure(seconds: float, corrupt: float, dead: int) -> dict[str, Any]:
    """Seven emulated Dynamixels at 1 Mbps with 0.5 ms USB delay lift 0.25 kg; servo `dead` dies 1 s later (0: none)."""
    fifo = priority()
    emulator = peer("servo_bus")
    arm = robots.load("justina_left_arm")
    spec = {
        "make": "dynamixel",
        "arm": arm.name,
        "mass": MASS,
        "servos": [{"id": i + 1, "joint": i, "constant": _CONSTANT} for i in range(arm.n)],
        "bus": {"baud": 1e6, "usb": 5e-4, "noise_counts": 2, "corrupt": corrupt},
        **({"die": dead, "die_after": 1.0} if dead else {}),
    }
    servos = tuple(Servo(id=i + 1, joint=j, torque_constant=_CONSTANT) for i, j in enumerate(arm.joint_names))
    command = [sys.executable, emulator.__file__, json.dumps(spec)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None  # a pipe was asked for
        port = process.stdout.readline().strip()
        driver = DynamixelDriver(arm, port, bus=Bus(servos=servos))
        found: dict[str, Any] = {"words": ""}
        with driver:
            place = weigh.scene(weigh.driven_arm(arm, driver))
            task = weigh.Task(
                scene=place,
                start=weigh.present_pose(place.arm, driver),
                poses=(place.poses["Take3"],),
                loads=None,
                duration=seconds,
                rate=1e9 / driver.period_ns,
            )
            pipeline, _ = weigh.make_pipeline(place.arm)
            try:
                trial = weigh.run(task, pipeline, driver=driver)
                log, payload = trial.log, trial.touch.payload
                ok = payload.status == int(Status.ok)
                error = np.abs(payload.mass - MASS)
                found |= {
                    "rate": (len(log) - 1) / log.duration,
                    "mass": float(payload.mass[-1]),
                    "mass_std": float(payload.mass_std[-1]),
                    "status": Status(int(payload.status[-1])).name,
                    "wrong": int(np.sum(ok & (error > 5.0 * payload.mass_std) & (error > 0.02 * MASS))),
                    "samples": len(log),
                }
            except DriverError as fault:
                found["words"] = str(fault)
            statistics = driver.statistics
        out, _ = process.communicate(timeout=30)
    return {
        **found,
        "fifo": fifo,
        **json.loads(out),
        "periods": statistics.periods,
        "lost": statistics.lost,
        "corrupt": statistics.corrupt,
        "late": statistics.late,
        "period": 1e-9 * driver.period_ns,
    }


if __name__ == "__main__":
    sys.stdout.write(json.dumps(measure(**json.loads(sys.argv[1]))))
