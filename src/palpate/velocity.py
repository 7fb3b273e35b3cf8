"""Joint velocity from positions: on the reader's clock, or on the recovered clock of who sends them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from ._core import JointVelocity as CoreVelocity
from ._core import JointVelocityOptions, SenderClockOptions, Status
from ._core import SenderClock as CoreClock
from .arm import Array
from .errors import InputError

__all__ = ["JointVelocity", "SenderClock", "SenderStamp", "SenderStamps"]


class SenderStamp(NamedTuple):
    """When the newest position was measured."""

    time_ns: int
    """of the measurement by the sender's clock, on the reader's time line [ns]; the read stamp until locked"""
    cycles: int
    """sender cycles since the measurement before; 0 until locked"""
    interval: float
    """since the measurement before [s]; 0.0: nothing to compare with"""
    fresh: bool
    """a new measurement; False: the one before was read again, or none has come yet"""
    status: Status
    """ok: locked to the sender; gap: started anew, difference nothing across it"""


@dataclass(frozen=True, slots=True, eq=False)
class SenderStamps:
    """The same of every row of a log; see :class:`SenderStamp`."""

    time_ns: npt.NDArray[np.int64]
    """(N,) [ns]"""
    cycles: npt.NDArray[np.int32]
    """(N,)"""
    interval: Array
    """(N,) [s]"""
    fresh: npt.NDArray[np.bool_]
    """(N,)"""
    status: npt.NDArray[np.uint8]
    """(N,)"""
    period: Array
    """(N,) of the sender, as known then [s]; 0.0 until locked"""


class SenderClock:
    """When positions were measured, if their sender gives no time stamp and runs at another pace than the reader.

    A sender with period T overwrites a variable; a reader looks at it at its own pace h. Between two looks there are
    now one, now two new measurements: who divides by h each time makes noise as large as the speed. Two witnesses
    tell how many there were: the clock, a straight line through the reader's stamps, and the motion, whose step per
    cycle hardly changes. Causal, for use in a loop: each answer uses what came before only. Source: the "encoder
    noise" of the whiteboard project (MATH.md section 8); the method is palpate's own.

    Args:
        n: number of joints.
        period: of the sender [s], more than twice stamp_std; None: found in the first stretch of motion (48 looks).
        stamp_std: jitter of the reader's time stamps [s].
        position_std: of a position [rad].
        max_speed: no joint is faster [rad/s]; a position further away ends what came before (status gap).

    Raises:
        InputError: a value is out of range.
    """

    def __init__(
        self,
        n: int,
        *,
        period: float | None = None,
        stamp_std: float = 5e-4,
        position_std: float = 2e-5,
        max_speed: float = 10.0,
    ) -> None:
        self.n = n
        try:
            options = SenderClockOptions(
                period=period or 0.0, stamp_std=stamp_std, position_std=position_std, max_speed=max_speed
            )
            self._core = CoreClock(n, options)
        except (ValueError, TypeError) as e:
            raise InputError(str(e).splitlines()[0]) from None

    @property
    def period(self) -> float | None:
        """Of the sender [s]; None until locked, and where sender and reader are in step."""
        return self._core.period or None

    def step(self, time_ns: int, position: npt.ArrayLike) -> SenderStamp:
        """A position was read.

        Args:
            time_ns: when it was read [ns].
            position: (n,) [rad].

        Raises:
            InputError: wrong shape. A bad number is no error: the status says so.
        """
        return SenderStamp(*self._core.step(int(time_ns), _row(position, self.n)))

    def run(self, time_ns: npt.ArrayLike, position: npt.ArrayLike) -> SenderStamps:
        """The same for a whole log, (N,) [ns] and (N, n) [rad].

        Raises:
            InputError: wrong shapes.
        """
        return SenderStamps(*self._core.run(*_table(time_ns, position, self.n)))

    def reset(self) -> None:
        """Forget everything."""
        self._core.reset()


class JointVelocity:
    """Joint velocity from positions: a plain difference, then a moving average or a first-order low-pass, or neither.

    v = (q_k - q_(k-1)) / (t_k - t_(k-1));  mean of the last `average`;  v <- (1 - a) v + a v_raw, a = h/(h + tau).
    The first position has no velocity. Source: the whiteboard project (MATH.md section 8).

    Args:
        n: number of joints.
        clock: "sender": divide by the time between the measurements (:class:`SenderClock`), refuse memory that
            nobody has written to, difference nothing across a jump; "reader": by the time between the looks.
        average: mean of so many velocities, 1 to 64.
        time_constant: of the low-pass [s]; 0.0: none.
        sender: what is known of the sender; None: nothing.

    Raises:
        InputError: a value is out of range.
    """

    def __init__(
        self,
        n: int,
        *,
        clock: Literal["sender", "reader"] = "sender",
        average: int = 1,
        time_constant: float = 0.0,
        sender: SenderClockOptions | None = None,
    ) -> None:
        if clock not in ("sender", "reader"):
            raise InputError(f"clock {clock!r}; choose from sender, reader")
        self.n = n
        try:
            self._core = CoreVelocity(
                n,
                JointVelocityOptions(
                    recover_clock=clock == "sender",
                    average=average,
                    time_constant=float(time_constant),
                    sender=sender or SenderClockOptions(),
                ),
            )
        except (ValueError, TypeError) as e:
            raise InputError(str(e).splitlines()[0]) from None

    def step(self, time_ns: int, position: npt.ArrayLike) -> tuple[Array, Status]:
        """Velocity (n,) [rad/s] and its status from the position (n,) [rad] that was read at `time_ns` [ns].

        Raises:
            InputError: wrong shape. A bad number is no error: the velocity stays and the status says so.
        """
        velocity, status = self._core.step(int(time_ns), _row(position, self.n))
        return velocity, status

    def run(self, time_ns: npt.ArrayLike, position: npt.ArrayLike) -> tuple[Array, npt.NDArray[np.uint8]]:
        """The same for a whole log: (N,) [ns] and (N, n) [rad] to (N, n) [rad/s] and (N,).

        Raises:
            InputError: wrong shapes.
        """
        velocity, status = self._core.run(*_table(time_ns, position, self.n))
        return velocity, status

    def reset(self) -> None:
        """Forget everything."""
        self._core.reset()


def _row(position: npt.ArrayLike, n: int) -> Array:
    q = np.ascontiguousarray(position, dtype=np.float64)
    if q.shape != (n,):
        raise InputError(f"position: expected {n} numbers [rad], got shape {q.shape}")
    return q


def _table(time_ns: npt.ArrayLike, position: npt.ArrayLike, n: int) -> tuple[npt.NDArray[np.int64], Array]:
    t = np.ascontiguousarray(time_ns, dtype=np.int64)
    q = np.ascontiguousarray(position, dtype=np.float64)
    if t.ndim != 1 or q.shape != (len(t), n):
        raise InputError(f"expected time_ns (N,) and position (N, {n}), got shapes {t.shape} and {q.shape}")
    return t, q
