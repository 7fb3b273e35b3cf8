"""What happens to a simulated arm, and when: objects taken and released, pushes."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TypeAlias

import numpy.typing as npt

from ..errors import InputError
from .plant import Load, Plant


@dataclass(frozen=True, slots=True)
class Attach:
    """The arm holds an object from `time` [s] on; a number is a point mass [kg] at the grasp point."""

    time: float
    load: Load | float

    def __post_init__(self) -> None:
        if not isinstance(self.load, Load):
            object.__setattr__(self, "load", Load(self.load))

    def apply(self, plant: Plant) -> None:
        """Do it now."""
        plant.attach(self.load)


@dataclass(frozen=True, slots=True)
class Release:
    """The arm lets go at `time` [s]."""

    time: float

    def apply(self, plant: Plant) -> None:
        """Do it now."""
        plant.release()


@dataclass(frozen=True, slots=True, eq=False)
class Push:
    """A constant push on a link begins at `time` [s]; arguments as in :meth:`Plant.push`."""

    time: float
    frame: str | int
    force: npt.ArrayLike = (0.0, 0.0, 0.0)
    torque: npt.ArrayLike = (0.0, 0.0, 0.0)
    point: npt.ArrayLike = (0.0, 0.0, 0.0)

    def apply(self, plant: Plant) -> None:
        """Do it now."""
        plant.push(self.frame, self.force, self.torque, point=self.point)


@dataclass(frozen=True, slots=True)
class StopPushing:
    """The push on the link of `frame` ends at `time` [s]; None: every push."""

    time: float
    frame: str | int | None = None

    def apply(self, plant: Plant) -> None:
        """Do it now."""
        plant.stop_pushing(self.frame)


ScenarioEvent: TypeAlias = Attach | Release | Push | StopPushing


class Schedule:
    """Events in the order of their times; those of equal time in the order given.

    Raises:
        InputError: a time is negative or not finite.
    """

    def __init__(self, events: Iterable[ScenarioEvent] = ()) -> None:
        given = tuple(events)
        for event in given:
            if not (math.isfinite(event.time) and event.time >= 0.0):
                raise InputError(
                    f"an event's time must be >= 0 s and finite, got {event.time!r} of {event!r:.80}"
                )
        self._events = tuple(sorted(given, key=lambda e: e.time))
        self._times_ns = tuple(round(e.time * 1e9) for e in self._events)

    def __iter__(self) -> Iterator[ScenarioEvent]:
        return iter(self._events)

    def __len__(self) -> int:
        return len(self._events)

    def between(self, after_ns: int, until_ns: int) -> list[tuple[int, ScenarioEvent]]:
        """(time [ns], event) of all events with after < time <= until."""
        return [(t, e) for t, e in zip(self._times_ns, self._events, strict=True) if after_ns < t <= until_ns]

    def mass_at(self, time: float) -> float:
        """Mass held at `time` [s], by this schedule alone [kg]; an event counts from its own instant on."""
        mass = 0.0
        for event in self._events:
            if event.time > time:
                break
            if isinstance(event, Attach):
                assert isinstance(event.load, Load)
                mass = event.load.mass
            elif isinstance(event, Release):
                mass = 0.0
        return mass


def pick_and_place(
    load: Load | float, *, pick: float, place: float, repeat: int = 1, pause: float = 1.0
) -> Schedule:
    """An object is picked up and put down, again and again.

    Args:
        load: the object; a number is a point mass [kg].
        pick: time of the first grasp [s].
        place: time of the first release [s].
        repeat: how many times.
        pause: from a release to the next grasp [s].

    Raises:
        InputError: times out of order, or repeat below 1.
    """
    if not 0.0 <= pick < place:
        raise InputError(f"pick must be >= 0 s and before place, got {pick!r} and {place!r}")
    if repeat < 1:
        raise InputError(f"repeat must be at least 1, got {repeat!r}")
    if repeat > 1 and not pause > 0.0:
        raise InputError(f"pause must be > 0 s, got {pause!r}")
    cycle = place - pick + pause
    events: list[ScenarioEvent] = []
    for k in range(repeat):
        events += [Attach(pick + k * cycle, load), Release(place + k * cycle)]
    return Schedule(events)
