"""One measured session, run as a module: ``python -m palpate.studies._session_run JSON``; prints JSON.

A simulated arm goes from pose to pose, an object comes and goes, everything is recorded.
"""

from __future__ import annotations

import ctypes
import json
import sys
import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import Any

from .. import robots
from .._core import ContactDetector, MomentumObserver, WrenchEstimator
from ..control import Controller
from ..logs import Log
from ..pipeline import Pipeline
from ..session import Realtime, Session, SimulatedArm
from ..weigh.scenes import scene

_STAY_S = 3.0
_COUNTER = "_ZN7palpate4test11allocationsEv"
"""palpate::test::allocations(), of the preloaded counting allocator"""


def _counter() -> int:
    """Address of the function that counts allocations; 0: none is loaded."""
    try:
        function = getattr(ctypes.CDLL(None), _COUNTER)
    except AttributeError:
        return 0
    return ctypes.cast(function, ctypes.c_void_p).value or 0


def measure(seconds: float, rate: float, everything: bool, fifo: bool) -> dict[str, Any]:
    """Run, and say what happened."""
    place = scene(robots.load("justina_left_arm"))
    arm = place.arm
    assert place.gains is not None  # the published ones
    pipeline = Pipeline(arm)
    if everything:
        pipeline = Pipeline(
            arm, observer=MomentumObserver(), wrench=WrenchEstimator(), contact=ContactDetector()
        )
    simulated = SimulatedArm(arm, rate=rate)
    goals = [place.poses[name] for name in ("Take3", "StandBy", "Take", "Zero")]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "run.mcap"
        counter = _counter()
        with Session(
            arm,
            simulated,
            pipeline=pipeline,
            controller=Controller(arm, *place.gains),
            record=file,
            realtime=Realtime() if fifo else Realtime(priority=0),
            patience=10.0,  # a stall is to be counted, not to end the measurement
            lease=60.0,
            buffer=20.0,
            allocation_counter=counter,
        ) as session:
            session.enable()
            for k in range(max(1, round(seconds / _STAY_S))):
                simulated.hold(0.25 * (k % 2))
                session.move_to(goals[k % len(goals)], 2.0)
                session.run(min(_STAY_S, seconds))
            granted = session.realtime
        recorded = len(Log.open(file))
        size = file.stat().st_size
    found = asdict(session.statistics)
    return {
        **found,
        "counted": counter != 0,
        "recorded": recorded,
        "bytes": size,
        "granted": None if granted is None else asdict(granted),
    }


if __name__ == "__main__":
    sys.stdout.write(json.dumps(measure(**json.loads(sys.argv[1]))))
