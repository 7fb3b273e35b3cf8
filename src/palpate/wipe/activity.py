"""Activities: each with a period of its own and an explicit life cycle, data handed over without locks."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, Generic, TypeVar

import numpy as np
from statemachine import State, StateMachine

from .result import Timing

T = TypeVar("T")


class LifeCycle(StateMachine):
    """Creating, configuring, pausing, running, cleaning, done.

    An activity that is pausing still has cycles, in which it keeps things safe and makes no progress.
    """

    creating = State(initial=True)
    configuring = State()
    pausing = State()
    running = State()
    cleaning = State()
    done = State(final=True)

    configure = creating.to(configuring) | pausing.to(configuring)
    ready = configuring.to(pausing)
    start = pausing.to(running)
    pause = running.to(pausing)
    clean = creating.to(cleaning) | configuring.to(cleaning) | pausing.to(cleaning) | running.to(cleaning)
    end = cleaning.to(done)


class Slot(Generic[T]):
    """The newest value from one writer to one reader.

    Writing and reading are one assignment each, which Python does at once: nobody waits for anybody.
    """

    __slots__ = ("_box", "_taken")

    def __init__(self) -> None:
        self._box: tuple[T] | None = None
        self._taken: tuple[T] | None = None

    def put(self, value: T) -> None:
        """Replace what was there."""
        self._box = (value,)

    @property
    def newest(self) -> T | None:
        """The newest value, again and again."""
        box = self._box
        return None if box is None else box[0]

    def take(self) -> T | None:
        """The newest value if it was not taken before."""
        box = self._box
        if box is None or box is self._taken:
            return None
        self._taken = box
        return box[0]


class Activity(ABC):
    """Something that is done every period.

    Args:
        name: of the activity.
        period_ns: of its cycles [ns].
    """

    def __init__(self, name: str, period_ns: int) -> None:
        self.name = name
        self.period_ns = int(period_ns)
        """[ns]"""
        self.told: Callable[[str, str], None] | None = None
        """called with its name and the life cycle's new state"""
        self.life = LifeCycle()
        self.state = "creating"
        self.cycles: list[float] = []
        """wall time of each [s]"""

    def send(self, step: str) -> None:
        """Take a step of the life cycle: configure, ready, start, pause, clean or end."""
        self.life.send(step)
        state = next(iter(self.life.configuration_values))
        if state != self.state:
            self.state = str(state)
            if self.told is not None:
                self.told(self.name, self.state)

    def begin(self) -> None:
        """From creating to running."""
        self.send("configure")
        self.configure()
        self.send("ready")
        self.send("start")

    def finish(self) -> None:
        """From wherever it is to done."""
        if self.state != "done":
            self.send("clean")
            self.clean()
            self.send("end")

    def configure(self) -> None:  # noqa: B027  most have nothing to do
        """Get ready to run, again after a fault."""

    def clean(self) -> None:  # noqa: B027
        """Give back what was taken."""

    def cycle(self, time_ns: int) -> None:
        """One cycle, if it is running or pausing; measures its wall time."""
        if self.state in ("running", "pausing"):
            begin = time.perf_counter()
            self.step(time_ns)
            self.cycles.append(time.perf_counter() - begin)

    @abstractmethod
    def step(self, time_ns: int) -> None:
        """What it does; `self.state` tells whether it pauses."""


def timing(period: float, cycles: Any) -> Timing:
    """Of cycles [s]."""
    seconds = np.asarray(cycles, dtype=np.float64)
    if not len(seconds):
        return Timing(period, 0, 0.0, 0.0, 0.0)
    median, p99 = np.quantile(seconds, (0.5, 0.99))
    return Timing(period, len(seconds), float(median), float(p99), float(seconds.max()))
