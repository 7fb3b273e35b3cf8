"""What the drives report instead of the truth: quantised, noisy, late, lost, and broken on purpose."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from ..arm import Arm, Array
from ..errors import InputError
from ..logs import Sample

FaultKind: TypeAlias = Literal["nan", "huge", "stuck", "backwards", "lost"]

_FAULTS = ("nan", "huge", "stuck", "backwards", "lost")
_HUGE = 1e300
# [N m]; no drive comes near, and rounding an absurd command must not overflow
_UNLIMITED = 1e9
_BACK_NS = 10_000_000


@dataclass(frozen=True, slots=True)
class Fault:
    """Something breaks for a while, by the true time of measurement: start <= t < stop."""

    kind: FaultKind
    """"nan" and "huge" (1e300): position and effort read that; "stuck": position repeats the first one read
    in the interval; "backwards": stamps lie 10 ms in the past; "lost": no reading arrives"""
    start: float
    """[s]"""
    stop: float = math.inf
    """[s]"""
    joint: int | None = None
    """index of the joint concerned; None: all. Without meaning for "backwards" and "lost"."""

    def __post_init__(self) -> None:
        if self.kind not in _FAULTS:
            raise InputError(f"fault kind must be one of {', '.join(_FAULTS)}, got {self.kind!r}")
        if not self.start < self.stop:
            raise InputError(f"a fault must start before it stops, got {self.start!r} and {self.stop!r} s")


class SensorModel:
    """Encoders, torque steps and clock of an arm's drives. The same seed gives the same run.

    Position: Gaussian noise (Sensing.position_std), then rounding to the encoder count (position_resolution).
    With `noise_counts` = n no Gaussian noise, but after the rounding a whole number of counts drawn uniformly
    from -n to n: the noise of the mass-estimation bench (MATH.md, reference R; 12 bit per turn, n = 2). With
    ``noise_before_rounding`` too, a real number from that interval, added before the rounding as the noise of
    an analogue encoder is.

    Torque: what is sent is a multiple of Sensing.torque_resolution within the effort limits, see
    :meth:`drive`. What is reported is what was applied, plus Gaussian noise (Sensing.torque_std).

    Args:
        arm: resolutions, deviations, effort limits and effort unit are its.
        rate: readings per second [Hz].
        noise_counts: n, whole counts >= 0 (0: rounding alone); None: Gaussian noise.
        noise_before_rounding: add the noise of n counts before the rounding instead of after it.
        velocity: whether velocity is measured; None: if every joint's Sensing.velocity_std is given.
        jitter: stamps are off the true time by up to this, uniformly [s]; below half a period: they still rise.
        loss: probability that a reading does not arrive, 0 to 1.
        latency: readings arrive this many periods late; their stamp is the time of measurement.
        faults: what breaks, and when.
        seed: of the generator.

    Raises:
        InputError: a value is out of range, or counts are asked of an encoder without resolution.
    """

    def __init__(
        self,
        arm: Arm,
        *,
        rate: float = 250.0,
        noise_counts: int | None = None,
        noise_before_rounding: bool = False,
        velocity: bool | None = None,
        jitter: float = 0.0,
        loss: float = 0.0,
        latency: int = 0,
        faults: Iterable[Fault] = (),
        seed: int = 0,
    ) -> None:
        if not (math.isfinite(rate) and 0.1 <= rate <= 1e5):
            raise InputError(f"rate must be between 0.1 and 100000 Hz, got {rate!r}")
        self.period_ns = round(1e9 / rate)
        """time between readings [ns]"""
        if noise_counts is not None and (noise_counts < 0 or noise_counts != int(noise_counts)):
            raise InputError(f"noise_counts must be a whole number >= 0 or None, got {noise_counts!r}")
        if noise_before_rounding and noise_counts is None:
            raise InputError("noise_before_rounding is about noise_counts; give those")
        if not 0.0 <= jitter < 0.5e-9 * self.period_ns:
            raise InputError(
                f"jitter must be >= 0 and below half a period of {self.period_ns * 1e-9:g} s, got {jitter!r}"
            )
        if not 0.0 <= loss <= 1.0:
            raise InputError(f"loss must be between 0 and 1, got {loss!r}")
        if latency < 0 or latency != int(latency):
            raise InputError(f"latency must be a whole number of periods >= 0, got {latency!r}")
        sensing = [j.sensing for j in arm.joints]
        self._n = arm.n
        self._count = np.array([s.position_resolution for s in sensing])
        self._position_std = np.array([s.position_std if noise_counts is None else 0.0 for s in sensing])
        self._torque_step = np.array([s.torque_resolution for s in sensing])
        self._torque_std = np.array([s.torque_std for s in sensing])
        deviations = [s.velocity_std for s in sensing]
        self._measures_velocity = (
            all(d is not None for d in deviations) if velocity is None else bool(velocity)
        )
        self._velocity_std = np.array([d or 0.0 for d in deviations])
        blind = [j.name for j in arm.joints if j.sensing.position_resolution == 0.0]
        if noise_counts and blind:
            raise InputError(
                f"noise_counts needs a position_resolution for every joint; {blind[0]!r} has none"
            )
        self._noise_counts = int(noise_counts or 0)
        self._before = bool(noise_before_rounding)
        self._jitter_ns = int(jitter * 1e9)
        self._loss = float(loss)
        self._latency = int(latency)
        self._faults = tuple(faults)
        for fault in self._faults:
            if fault.joint is not None and not 0 <= fault.joint < self._n:
                raise InputError(f"a fault's joint must be 0 to {self._n - 1}, got {fault.joint!r}")
        self._seed = seed
        # a rounded position is count * round(q / count); joints without resolution are left as they are
        self._coarse = self._count > 0.0
        self._all_coarse, self._any_coarse = bool(self._coarse.all()), bool(self._coarse.any())
        self._divisor = np.where(self._coarse, self._count, 1.0)
        steps = self._torque_step > 0.0
        self._torque_divisor = np.where(steps, self._torque_step, 1.0)
        self._has_steps, self._steps = bool(steps.any()), steps
        limit = np.minimum([j.limits.effort for j in arm.joints], _UNLIMITED)
        # the largest multiple of the step that does not exceed the limit
        whole = np.floor(limit / self._torque_divisor * (1.0 + 1e-12)) * self._torque_divisor
        self._limit = np.where(steps, whole, limit)
        gain = np.ones(arm.n) if arm.effort.kind == "undeclared" else arm.effort.gain(arm.n)
        self._per_torque = 1.0 / gain
        self._scales = bool(np.any(gain != 1.0))
        self.reset()

    @property
    def n(self) -> int:
        """Number of joints."""
        return self._n

    @property
    def seed(self) -> int:
        """Seed of the generator."""
        return self._seed

    @property
    def torque_limit(self) -> Array:
        """(n,) largest torque that :meth:`drive` lets through [N m]; 1e9 without a limit."""
        return self._limit.copy()

    def reset(self) -> None:
        """Start again with the same seed and nothing under way."""
        self._rng = np.random.default_rng(self._seed)
        self._under_way: list[Sample | None] = []
        self._held: list[Array | None] = [None] * len(self._faults)

    def drive(self, torque: Array) -> Array:
        """What the drives apply when told `torque` (n,) [N m]: within the effort limits, in whole steps."""
        sent: Array = np.clip(torque, -self._limit, self._limit)
        if self._has_steps:
            np.copyto(sent, np.rint(sent / self._torque_divisor) * self._torque_divisor, where=self._steps)
        return sent

    def read(self, time_ns: int, q: npt.ArrayLike, dq: npt.ArrayLike, torque: npt.ArrayLike) -> Sample | None:
        """What arrives when the truth is this.

        Args:
            time_ns: true time [ns].
            q: (n,) [rad].
            dq: (n,) [rad/s].
            torque: (n,) link-side torque that was applied in the period that ends now [N m].

        Returns:
            The reading that arrives now, taken `latency` periods ago; None if it is lost or none is due yet.
        """
        reading = self._measure(int(time_ns), np.asarray(q), np.asarray(dq), np.asarray(torque))
        if self._latency == 0:
            return reading
        self._under_way.append(reading)
        return self._under_way.pop(0) if len(self._under_way) > self._latency else None

    def _measure(self, time_ns: int, q: Array, dq: Array, torque: Array) -> Sample | None:
        rng, n = self._rng, self._n
        position = q + self._position_std * rng.standard_normal(n) if self._position_std.any() else q.copy()
        if self._noise_counts and self._before:
            position += self._count * rng.uniform(-self._noise_counts, self._noise_counts, n)
        if self._any_coarse:
            counts = np.rint(position / self._divisor)
            if self._noise_counts and not self._before:
                counts += rng.integers(-self._noise_counts, self._noise_counts, n, endpoint=True)
            counts *= self._divisor
            if self._all_coarse:
                position = counts
            else:
                np.copyto(position, counts, where=self._coarse)
        velocity = dq + self._velocity_std * rng.standard_normal(n) if self._measures_velocity else None
        effort = (
            torque + self._torque_std * rng.standard_normal(n) if self._torque_std.any() else torque.copy()
        )
        if self._scales:
            effort *= self._per_torque
        stamp = time_ns
        if self._jitter_ns:
            shift = int(rng.integers(-self._jitter_ns, self._jitter_ns, endpoint=True))
            stamp = max(stamp + shift, 0)  # a clock that starts at 0 shows nothing below; bags cannot hold it
        arrives = self._loss == 0.0 or rng.random() >= self._loss
        if self._faults:
            stamp, arrives = self._break(time_ns, stamp, position, effort, arrives)
        return Sample(stamp, position, velocity, effort) if arrives else None

    def _break(
        self, time_ns: int, stamp: int, position: Array, effort: Array, arrives: bool
    ) -> tuple[int, bool]:
        """Apply this moment's faults to position and effort in place; return stamp [ns], whether it arrives."""
        now = time_ns * 1e-9
        for i, fault in enumerate(self._faults):
            if not fault.start <= now < fault.stop:
                continue
            where = slice(None) if fault.joint is None else fault.joint
            if fault.kind == "nan" or fault.kind == "huge":
                position[where] = effort[where] = math.nan if fault.kind == "nan" else _HUGE
            elif fault.kind == "stuck":
                held = self._held[i]
                if held is None:
                    self._held[i] = position.copy()
                else:
                    position[where] = held[where]
            elif fault.kind == "backwards":
                stamp -= _BACK_NS
            else:
                arrives = False
        return stamp, arrives
