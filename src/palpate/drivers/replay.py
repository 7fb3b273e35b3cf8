"""A recording behind the driver contract: what worked live works on a log, sample for sample."""

from __future__ import annotations

from ..arm import Array, Effort
from ..errors import DriverError
from ..logs import Clock, Log, Sample
from .driver import Driver, Pace


class ReplayDriver(Driver):
    """Reads a log as if it were the arm. Commands change nothing; write() returns what was sent back then.

    That is the torque which brought about the sample that read() returns next (after the last sample: the last
    torque), so that the law of every driver holds here too: the next sample's effort is what write() returned.

    Args:
        log: the recording; connect() goes back to its start.
        effort: what the log's effort numbers are. Only commanding needs it: None makes write() fail, and the
            pipeline that reads the samples uses its own arm's.
        pace: recorded seconds per wall second; None: as fast as it goes.

    Raises:
        DriverError: the log has no samples; the pace is not positive.
        ArmError: `effort` has the wrong number of gains.
    """

    def __init__(self, log: Log, *, effort: Effort | None = None, pace: float | None = None) -> None:
        if len(log) == 0:
            raise DriverError("nothing to replay: the log has no samples")
        median_ns = Clock.of(log.time_ns).median_ns
        # a single sample has no period, nor has a clock that runs backwards: any will do
        period_ns = median_ns if median_ns > 0 else 1_000_000
        super().__init__(log.joint_names, period_ns, effort or Effort.undeclared())
        self._gain = None if self._effort.kind == "undeclared" else self._effort.gain(self.n)
        self._log = log
        self._pace = Pace(pace)
        self._next = 0

    @property
    def finished(self) -> bool:
        """True after the last sample was read."""
        return self._next >= len(self._log)

    def _connect(self) -> None:
        self._next = 0
        self._pace.start(int(self._log.time_ns[0]))

    def _read(self) -> Sample:
        i, log = self._next, self._log
        if i >= len(log):
            raise DriverError(
                f"read(): the recording ended after {len(log)} samples; close() and connect() start again"
            )
        self._next = i + 1
        sample = log[i]
        self._pace.wait(sample.time_ns)
        return sample

    def _write(self, torque: Array) -> Array:
        if self._gain is None:
            raise DriverError(
                "write(): give the replay effort=..., so that the recorded effort can be told in N m"
            )
        sent: Array = self._log.effort[min(self._next, len(self._log) - 1)] * self._gain
        return sent

    def _enable(self) -> None:
        """A recording has no drives."""

    def _disable(self) -> None:
        """A recording has no drives."""

    def _close(self) -> None:
        """A recording has no connection."""
