"""A recorded log on a page: weighed and felt at once, then looked at any moment of it."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from itertools import pairwise
from typing import Any

import numpy as np

from .._core import HeldLoad, Status, WrenchEstimator
from ..arm import Arm, Array
from ..errors import InputError, PalpateError
from ..logs import Log
from ..pipeline import Contact, ExternalTorque, Payload, Pipeline, Touch
from ..report._text import TWO_SIDED_95
from ..weigh import scene, weigh_log
from .history import thinned
from .live import contact_pipeline
from .scene import Badge, Reading, ShownArm
from .source import Source

SPANS = (10.0, 60.0, 600.0, math.inf)
"""how far back one can look [s]"""


class Recording(Source):
    """A log, gone through by a slider or at a pace of choice.

    Args:
        log: opened with ``keep_invalid=True``, so that bad rows get a status.
        arm: None: the one in a recording of palpate.
        clock: seconds that pass, for tests.

    Raises:
        LogError: no arm is given and none is in the log.
        InputError: log and arm do not fit, or the log is empty.
        ArmError: the arm lacks masses or a declared effort.
    """

    def __init__(
        self, log: Log, arm: Arm | None = None, *, clock: Callable[[], float] = time.monotonic
    ) -> None:
        if not len(log):
            raise InputError("the log has no samples: there is nothing to see")
        weighed = weigh_log(log, arm)
        self._weighed = weighed
        self._model, self._log = weighed.arm, weighed.log
        self._messages = list(weighed.remarks)
        self._arms = (_shown(weighed.arm),)
        # a damaged clock must not turn the curves round
        self._time = np.maximum.accumulate(self._log.seconds)
        self._truth_time, self._truth = weighed.truth
        gain = weighed.arm.effort.gain(weighed.arm.n)
        self._torque = self._log.effort * gain
        self._run(self._felt(weighed.pipeline))
        self._clock = clock
        self._speed, self._playing = 1.0, True
        self._from, self._since = 0.0, clock()

    def _felt(self, options: Mapping[str, Any]) -> Pipeline:
        """The pipeline that weighs, with the wrench where it can be had."""
        load = HeldLoad(acceleration_time=0.2).options()
        try:
            return Pipeline.from_options(
                self._model, {**options, "wrench": WrenchEstimator().options(), "load": load}
            )
        except PalpateError as error:
            self._messages.append(f"No push at the hand can be told from this log: {error}")
            return Pipeline.from_options(self._model, options)

    def _contacts(self, touch: Touch) -> Contact | None:
        """Contacts beside what was held: of a whole log it is known afterwards. None: the arm has no masses."""
        if not self._model.has_dynamics:
            return None
        holds = replace(self._weighed, touch=touch).holds
        edges = [0, *(int(np.searchsorted(self._time, hold.start)) for hold in holds[1:]), len(self._time)]
        parts = []
        for hold, (begin, end) in zip(holds, pairwise(edges), strict=True):
            if begin == end:
                continue
            known = hold.status == Status.ok
            mass, std = (max(hold.mass, 0.0), hold.mass_std) if known else (0.0, 0.0)
            load = HeldLoad(mass=mass, mass_std=std, acceleration_time=0.05)
            part = contact_pipeline(self._model, load).run(self._log[begin:end]).contact
            assert part is not None
            if not known:  # what is held might be anything: nothing can be told from a push
                held = np.full(end - begin, int(Status.held), dtype=np.uint8)
                part = replace(part, active=np.zeros(end - begin, dtype=bool), status=held)
            parts.append(part)
        return Contact(
            **{f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Contact)}
        )

    def _run(self, pipeline: Pipeline) -> None:
        touch = pipeline.run(self._log)
        self._pipeline, self._touch = pipeline, replace(touch, contact=self._contacts(touch))
        n = self._model.n
        rows = np.full((len(self._log), 4 * n + 5), np.nan)
        rows[:, :n], rows[:, n : 2 * n], rows[:, 2 * n : 3 * n] = touch.q, touch.dq, self._torque
        known = np.isin(touch.external.status, (int(Status.ok), int(Status.saturated)))
        rows[known, 3 * n : 4 * n] = touch.external.torque[known]
        mass, half = touch.payload.mass, TWO_SIDED_95 * touch.payload.mass_std
        rows[:, 4 * n], rows[:, 4 * n + 1], rows[:, 4 * n + 2] = mass, mass - half, mass + half
        contact = self._touch.contact
        good = touch.payload.status == int(Status.ok)
        if contact is not None:
            good &= ~np.asarray(contact.active)
        rows[good, 4 * n + 3] = mass[good]
        if len(self._truth):
            at = np.searchsorted(self._truth_time, self._time, side="right") - 1
            rows[at >= 0, 4 * n + 4] = self._truth[at[at >= 0]]
        self._rows = rows

    # --- the page ------------------------------------------------------------------------------------------------

    @property
    def arms(self) -> tuple[ShownArm, ...]:
        """The one arm."""
        return self._arms

    @property
    def spans(self) -> tuple[float, ...]:
        """The longest one is the whole log."""
        return tuple(s for s in SPANS if s < self.duration or math.isinf(s))

    def start(self) -> None:
        """Play from the beginning."""
        self.seek(0.0)
        self.play(True)

    def stop(self) -> None:
        """Nothing has to be ended."""

    def reading(self, arm: int) -> Reading | None:
        """At the present position."""
        row = self._row()
        touch = _at(self._touch, row)
        return Reading(
            time=float(self._time[row]),
            sample=self._log[row],
            touch=touch,
            torque=self._torque[row],
            true_mass=float(self._rows[row, -1]),
        )

    def _row(self) -> int:
        return max(int(np.searchsorted(self._time, self.position, side="right")) - 1, 0)

    def curves(self, arm: int, span: float) -> tuple[Array, Array]:
        """Up to the present position; of the whole log everything."""
        if math.isinf(span):
            return thinned(self._time, self._rows)
        end = self._row() + 1
        begin = int(np.searchsorted(self._time, self._time[end - 1] - span))
        return thinned(self._time[begin:end], self._rows[begin:end])

    @property
    def state(self) -> Badge:
        """Whether it plays."""
        at = f"{self.position:.1f} of {self.duration:.1f} s"
        return Badge(
            f"playing, {at}" if self.playing else f"paused, {at}", "green" if self.playing else "grey"
        )

    def messages(self) -> list[str]:
        """What the weighing had to say."""
        found, self._messages = self._messages, []
        return found

    # --- what a person wants -------------------------------------------------------------------------------------

    @property
    def duration(self) -> float:
        """[s]"""
        return float(self._time[-1])

    @property
    def position(self) -> float:
        """[s] from the beginning."""
        if not self._playing:
            return self._from
        return min(self._from + self._speed * (self._clock() - self._since), self.duration)

    @property
    def playing(self) -> bool:
        """Time goes on, and the end is not reached."""
        return self._playing and self.position < self.duration

    def play(self, on: bool) -> None:
        """See :class:`Plays`; at the end it begins anew."""
        self.seek(0.0 if on and self.position >= self.duration else self.position)
        self._playing = on

    def seek(self, position: float) -> None:
        """See :class:`Plays`."""
        self._from, self._since = min(max(position, 0.0), self.duration), self._clock()

    def pace(self, speed: float) -> None:
        """See :class:`Plays`.

        Raises:
            InputError: not positive.
        """
        if not (math.isfinite(speed) and speed > 0.0):
            raise InputError(f"speed must be a number > 0, got {speed!r}")
        self.seek(self.position)
        self._speed = speed

    def options(self, arm: int) -> dict[str, Any]:
        """See :class:`Tunes`."""
        return self._pipeline.options()

    def tune(self, arm: int, options: Mapping[str, Any]) -> None:
        """See :class:`Tunes`; the whole log goes through the new pipeline."""
        self._run(Pipeline.from_options(self._model, options))


def _shown(arm: Arm) -> ShownArm:
    usual = scene(arm).mass if arm.has_dynamics else 1.0
    return ShownArm(arm.name, arm, usual_mass=usual)


def _at(touch: Touch, row: int) -> Touch:
    """One row of a run."""
    external, payload = touch.external, touch.payload
    return Touch(
        int(touch.time_ns[row]),
        touch.q[row],
        touch.dq[row],
        Status(int(touch.status[row])),
        ExternalTorque(external.torque[row], external.std[row], Status(int(external.status[row]))),
        Payload(
            float(payload.mass[row]),
            float(payload.mass_std[row]),
            payload.first_moment[row],
            int(payload.changes[row]),
            int(payload.change_time_ns[row]),
            Status(int(payload.status[row])),
        ),
        None if touch.wrench is None else _picked(touch.wrench, row),
        None if touch.contact is None else _picked(touch.contact, row),
    )


def _picked(part: Any, row: int) -> Any:
    """A wrench or a contact of one row."""
    return type(part)(**{f.name: getattr(part, f.name)[row] for f in fields(part)})
