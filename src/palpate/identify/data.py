"""Logs to regression data: uniform time, zero-phase low-pass, derivatives, decimation (MATH.md section 6)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from palpate.arm import Array
from palpate.errors import InputError, LogError, MissingExtraError
from palpate.logs import Log
from palpate.logs.noise import white_noise

LEAST_CUTOFF = 5.0
"""the parallel filter never goes below [Hz]: reversals of friction hold more than the motion's own band"""
MOST_CUTOFF = 20.0
"""nor above [Hz]: arms are not rigid there"""
BAND_RATIO = 5.0
"""the parallel filter passes this many times the band of the motion"""
KINEMATIC_RATIO = 4.0
"""the kinematics are filtered this many times higher, so that they pass what the parallel filter passes"""
GRID_RATIO = 5.0
"""samples of the inner grid per period of the kinematic cutoff"""
ROWS_PER_CUTOFF = 4.0
"""rows kept per period of the parallel cutoff: twice what the band needs"""
VELOCITY_AGREES = 0.1
"""a measured velocity may differ from the derivative of the position by this part of its RMS"""


@dataclass(frozen=True, slots=True, eq=False)
class Segment:
    """One stretch without gaps, on a uniform grid, low-passed at the kinematic cutoff.

    Attributes:
        time: (N,) [s] since the log's first sample.
        q, dq, ddq: (N, n) [rad, rad/s, rad/s^2].
        effort: (N, n) in the driver's unit, through the same filter.
        rate: samples per second [Hz].
        log: number of the log it comes from.
    """

    time: Array
    q: Array
    dq: Array
    ddq: Array
    effort: Array
    rate: float
    log: int


@dataclass(frozen=True, slots=True)
class Origin:
    """What became of one log.

    Attributes:
        rows: samples in the log.
        used: samples inside the segments.
        rows_out: regression rows per joint.
        notes: what was left out and why, one sentence each.
        velocity: ``"measured"`` or ``"differentiated"``.
    """

    rows: int
    used: int
    rows_out: int
    notes: tuple[str, ...]
    velocity: str


@dataclass(frozen=True, slots=True, eq=False)
class RegressionData:
    """Everything a fit needs from the logs.

    ``segments`` keep the inner grid: columns are computed there and go through the same parallel filter as the
    effort (:meth:`reduce`), which leaves the parameters untouched because they enter linearly.

    Attributes:
        q, dq, ddq: (M, n) [rad, rad/s, rad/s^2] at the rows kept.
        effort: (M, n) in the driver's unit, parallel-filtered.
        time: (M,) [s] since the first sample of the row's log.
        log: (M,) number of the row's log.
        weight: (M,) weight of each row's squared residual [1], from the logs' weights.
        noise: (n,) standard deviation of what the filters took out of the effort, driver's unit.
        resolution: (n,) smallest step of the position readings [rad]; 0 where they look continuous.
        position_noise: (n,) standard deviation of the white part of the position readings, rounding included [rad].
        velocity_noise: (n,) the same of the measured velocities [rad/s]; None where they were not taken.
        cutoff: of the parallel filter [Hz].
        rate: rows per second [Hz].
        effort_unit: as the first log declares it; empty if it does not.
    """

    segments: tuple[Segment, ...]
    origins: tuple[Origin, ...]
    joint_names: tuple[str, ...]
    q: Array
    dq: Array
    ddq: Array
    effort: Array
    time: Array
    log: Any
    weight: Array
    noise: Array
    resolution: Array
    position_noise: Array
    velocity_noise: Array | None
    cutoff: float
    rate: float
    effort_unit: str = ""

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.joint_names)

    def __len__(self) -> int:
        return len(self.time)

    def reduce(self, columns: Callable[[Segment], Array]) -> Array:
        """Columns (N, ...) computed per segment, parallel-filtered and decimated to the rows kept (M, ...)."""
        return np.concatenate([_reduce(columns(s), s.rate, self.cutoff) for s in self.segments])


def _signal() -> Any:
    try:
        from scipy import signal
    except ImportError:
        raise MissingExtraError("identify", "identification") from None
    return signal


def low_pass(values: Array, rate: float, cutoff: float) -> Array:
    """Zero-phase fourth-order Butterworth low-pass along the first axis; untouched if cutoff >= 0.45 rate.

    Args:
        values: (N, ...).
        rate: [Hz].
        cutoff: -6 dB frequency of the forward-backward pass [Hz].
    """
    if cutoff >= 0.45 * rate:
        return values
    signal = _signal()
    sos = signal.butter(4, 2.0 * cutoff / rate, output="sos")
    pad = min(len(values) - 1, int(3.0 * rate / cutoff))
    filtered: Array = signal.sosfiltfilt(sos, values, axis=0, padlen=pad)
    return filtered


def _kept(count: int, rate: float, cutoff: float) -> slice:
    """Rows kept of a segment: one period trimmed at both ends (the filter's transient), then every k-th."""
    trim = int(np.ceil(rate / cutoff))
    step = max(1, int(rate / (ROWS_PER_CUTOFF * cutoff)))
    return slice(trim, max(trim, count - trim), step)


def _reduce(values: Array, rate: float, cutoff: float) -> Array:
    return low_pass(values, rate, cutoff)[_kept(len(values), rate, cutoff)]


def prepare(
    logs: Log | Sequence[Log],
    *,
    cutoff: float | None = None,
    effort: Sequence[str] | str | None = None,
    weights: Sequence[float] | None = None,
    velocity: bool | None = None,
) -> RegressionData:
    """Make regression data of logs.

    Real time stamps are used: repeated and backward ones are dropped and counted, the rest is interpolated onto
    a uniform grid at the median spacing (cubic spline for position and velocity, straight lines for the
    effort); a gap longer than a quarter of the cutoff's period splits the log. Kinematics and effort then go
    through one zero-phase low-pass at 4 times the cutoff; regressor and effort go through another at the cutoff
    (the parallel filter).

    The default cutoff is 5 times the frequency below which 99 % of the velocity's power lies, within 5 to 20
    Hz: what is above is ripple of gears and motors, noise and flexible modes, none of which the model knows.

    Args:
        logs: one or several of the same arm.
        cutoff: parallel filter [Hz]; default: from the motion.
        effort: name of a signal (M, n) to take instead of the log's effort (one for all, or one per log).
        weights: per log, of its squared residuals; default 1.
        velocity: True takes the measured velocity, False differentiates the position; None takes the measured
            one where it agrees with the derivative of the position (it is usually finer).

    Raises:
        InputError: an argument is wrong, or the logs have different joints.
        LogError: nothing usable is left; the message says why.
        MissingExtraError: without the extra ``identify``.
    """
    logs = (logs,) if isinstance(logs, Log) else tuple(logs)
    if not logs or not all(isinstance(log, Log) for log in logs):
        raise InputError("identification needs at least one palpate Log")
    if cutoff is None:
        band = max(motion_band(log) for log in logs)
        cutoff = float(np.clip(BAND_RATIO * band, LEAST_CUTOFF, MOST_CUTOFF))
    if not (np.isfinite(cutoff) and cutoff > 0.0):
        raise InputError(f"cutoff must be a positive frequency [Hz], got {cutoff!r}")
    names = logs[0].joint_names
    for k, log in enumerate(logs):
        if log.joint_names != names:
            raise InputError(f"log {k} has joints {', '.join(log.joint_names)}; log 0 has {', '.join(names)}")
    factors = [1.0] * len(logs) if weights is None else [float(w) for w in weights]
    if len(factors) != len(logs) or not all(np.isfinite(w) and w > 0.0 for w in factors):
        raise InputError(f"weights must be {len(logs)} positive numbers, one per log, got {weights!r}")
    signals = [effort] * len(logs) if effort is None or isinstance(effort, str) else list(effort)
    if len(signals) != len(logs):
        raise InputError(f"effort must name one signal or {len(logs)}, got {len(signals)}")
    segments: list[Segment] = []
    origins: list[Origin] = []
    noise: list[Array] = []
    for k, (log, signal) in enumerate(zip(logs, signals, strict=True)):
        found, origin, rest = _segments(log, k, cutoff, signal, velocity)
        segments += found
        origins.append(origin)
        noise += rest
    if not segments:
        reasons = "; ".join(f"log {k}: {', '.join(o.notes)}" for k, o in enumerate(origins))
        raise LogError(f"no log has a usable stretch of at least {_least(cutoff):g} s: {reasons}")
    parts = [_kept(len(s.time), s.rate, cutoff) for s in segments]

    def rows(name: str) -> Array:
        return np.concatenate([getattr(s, name)[p] for s, p in zip(segments, parts, strict=True)])

    used = [log for log, o in zip(logs, origins, strict=True) if o.used]
    velocities = [
        log.velocity if o.velocity == "measured" else None
        for log, o in zip(logs, origins, strict=True)
        if o.used
    ]
    counts = [len(s.time[p]) for s, p in zip(segments, parts, strict=True)]
    number = np.repeat([s.log for s in segments], counts)
    return RegressionData(
        segments=tuple(segments),
        origins=tuple(origins),
        joint_names=names,
        q=rows("q"),
        dq=rows("dq"),
        ddq=rows("ddq"),
        effort=np.concatenate([_reduce(s.effort, s.rate, cutoff) for s in segments]),
        time=rows("time"),
        log=number,
        weight=np.asarray(factors)[number],
        noise=np.sqrt(np.mean(np.square(noise), axis=0)),
        resolution=np.array(
            [_resolution(np.concatenate([log.position[:, j] for log in logs])) for j in range(len(names))]
        ),
        position_noise=_white([log.position for log in used], [log.seconds for log in used]),
        velocity_noise=_white([v for v in velocities if v is not None], [log.seconds for log in used])
        if all(v is not None for v in velocities)
        else None,
        cutoff=cutoff,
        rate=segments[0].rate / (parts[0].step or 1),
        effort_unit=logs[0].meta.get("effort_unit", ""),
    )


def _white(readings: Sequence[Array], seconds: Sequence[Array]) -> Array:
    """(n,) RMS over the logs of the white part of their readings (N, n) at their times (N,) [s]."""
    found = [
        [white_noise(column[good], time[good]) for column in values.T]
        for values, time in zip(readings, seconds, strict=True)
        if np.count_nonzero(good := np.isfinite(values).all(axis=1)) >= 100
    ]
    return np.sqrt(np.mean(np.square(found), axis=0)) if found else np.zeros(readings[0].shape[1])


def _resolution(position: Array) -> float:
    """Smallest step between different readings [rad]; 0 if they look continuous."""
    values = np.unique(position[np.isfinite(position)])
    if len(values) < 2:
        return 0.0
    step = float(np.min(np.diff(values)))
    # a count repeats: readings on a grid have far fewer values than samples
    return step if len(values) < 0.5 * len(position) or step > 1e-7 else 0.0


def motion_band(log: Log) -> float:
    """Frequency below which 99 % of the power of the joints' velocities lies [Hz]; 0 if nothing moves."""
    time = log.seconds
    forward = np.r_[True, np.diff(np.maximum.accumulate(time)) > 0.0] if len(log) else np.zeros(0, dtype=bool)
    forward &= np.isfinite(log.position).all(axis=1)
    if np.count_nonzero(forward) < 16:
        return 0.0
    raw = time[forward]
    # positions between the samples are of no matter here, only the spectrum's bulk is
    count = min(len(raw), 1 << 16)
    grid = np.linspace(raw[0], raw[-1], count)
    position = np.column_stack([np.interp(grid, raw, c) for c in log.position[forward].T])
    velocity = np.diff(position, axis=0) * np.hanning(count - 1)[:, None]
    power = np.square(np.abs(np.fft.rfft(velocity, axis=0))).sum(axis=1)
    if power.sum() == 0.0:
        return 0.0
    frequency = np.fft.rfftfreq(count - 1, grid[1] - grid[0])
    return float(frequency[np.searchsorted(np.cumsum(power), 0.99 * power.sum())])


def _least(cutoff: float) -> float:
    """Shortest usable stretch [s]: both transients and as much again."""
    return 4.0 / cutoff


def _segments(
    log: Log, number: int, cutoff: float, signal: str | None, velocity: bool | None
) -> tuple[list[Segment], Origin, list[Array]]:
    notes: list[str] = []
    if len(log) < 2:
        return [], Origin(len(log), 0, 0, (f"{len(log)} rows",), ""), []
    time = log.seconds
    effort = log.effort
    if signal is not None:
        effort = _from_signal(log, signal)
    usable = np.isfinite(effort).all(axis=1) & np.isfinite(log.position).all(axis=1)
    if log.velocity is not None:
        usable &= np.isfinite(log.velocity).all(axis=1)
    if not usable.any():
        return [], Origin(len(log), 0, 0, ("no row has finite position and effort",), ""), []
    if not usable.all():
        notes.append(f"{np.count_nonzero(~usable)} rows with NaN")
    # keep what is later than everything before it
    latest = np.maximum.accumulate(np.where(usable, time, -np.inf))
    forward = usable & (np.r_[-np.inf, latest[:-1]] < time)
    if np.count_nonzero(forward) < np.count_nonzero(usable):
        lost = np.count_nonzero(usable) - np.count_nonzero(forward)
        notes.append(f"{lost} rows with repeated or backward time")
    at = np.flatnonzero(forward)
    spacing = np.diff(time[at])
    if len(spacing) == 0:
        return [], Origin(len(log), 0, 0, (*notes, "one usable row"), ""), []
    period = float(np.median(spacing))
    longest = max(3.0 * period, 0.25 / cutoff)
    cuts = np.flatnonzero(spacing > longest) + 1
    measured = log.velocity is not None if velocity is None else velocity
    if velocity and log.velocity is None:
        raise InputError(f"log {number} has no measured velocity")
    segments: list[Segment] = []
    noise: list[Array] = []
    used = 0
    how = "measured" if measured else "differentiated"
    for part in np.split(at, cuts):
        if len(part) < 8 or time[part[-1]] - time[part[0]] < _least(cutoff):
            notes.append(f"{len(part)} rows in a stretch shorter than {_least(cutoff):g} s")
            continue
        speeds = log.velocity[part] if measured and log.velocity is not None else None
        grid = _Grid(time[part], period, cutoff)
        q, dq, ddq, differs = grid.kinematics(log.position[part], speeds, forced=velocity is True)
        if differs:
            how = "differentiated"
            notes.append(f"measured velocity differs from the derivative of the position by {differs:.0%}")
        filtered, rest = grid.effort(effort[part])
        noise.append(rest)
        used += len(part)
        segments.append(Segment(grid.time, q, dq, ddq, filtered, grid.rate, number))
    rows_out = sum(len(s.time[_kept(len(s.time), s.rate, cutoff)]) for s in segments)
    return segments, Origin(len(log), used, rows_out, tuple(notes), how), noise


def _from_signal(log: Log, name: str) -> Array:
    if name not in log.signals:
        raise InputError(f"the log has no signal {name!r}; it has {', '.join(log.signals) or 'none'}")
    found = log.signals[name]
    if found.value.shape[1:] != (log.n,):
        raise InputError(f"signal {name!r} must be (M, {log.n}) to serve as effort, got {found.value.shape}")
    return np.column_stack([np.interp(log.time_ns, found.time_ns, found.value[:, j]) for j in range(log.n)])


class _Grid:
    """Uniform time of one stretch and the way of its signals onto it."""

    def __init__(self, time: Array, period: float, cutoff: float) -> None:
        self.raw = time
        self.fine = np.arange(time[0], time[-1], period)
        self.fine_rate = 1.0 / period
        self.kinematic = KINEMATIC_RATIO * cutoff
        self.step = max(1, int(self.fine_rate / (GRID_RATIO * self.kinematic)))
        self.rate = self.fine_rate / self.step
        self.time = self.fine[:: self.step]

    def _spline(self, values: Array) -> Any:
        try:
            from scipy.interpolate import CubicSpline
        except ImportError:
            raise MissingExtraError("identify", "identification") from None
        return CubicSpline(self.raw, values)(self.fine)

    def kinematics(
        self, position: Array, velocity: Array | None, *, forced: bool
    ) -> tuple[Array, Array, Array, float]:
        """q, dq, ddq on the grid, and by how much a refused velocity differs (0: taken, or none given)."""
        q = low_pass(self._spline(position), self.fine_rate, self.kinematic)
        slope = np.gradient(q, 1.0 / self.fine_rate, axis=0)
        dq, differs = slope, 0.0
        if velocity is not None:
            given = low_pass(self._spline(velocity), self.fine_rate, self.kinematic)
            inner = slice(len(q) // 20, len(q) - len(q) // 20)
            size = np.sqrt(np.mean(np.square(slope[inner])))
            error = np.sqrt(np.mean(np.square((given - slope)[inner])))
            if forced or error <= VELOCITY_AGREES * size:
                dq = given
            else:
                differs = float(error / size) if size > 0.0 else np.inf
        ddq = np.gradient(dq, 1.0 / self.fine_rate, axis=0)
        pick = slice(None, None, self.step)
        return q[pick], dq[pick], ddq[pick], differs

    def effort(self, effort: Array) -> tuple[Array, Array]:
        """The effort on the grid, and the standard deviation of what the filter took out, (n,)."""
        fine = np.column_stack([np.interp(self.fine, self.raw, column) for column in effort.T])
        filtered = low_pass(fine, self.fine_rate, self.kinematic)
        return filtered[:: self.step], np.std(fine - filtered, axis=0)
