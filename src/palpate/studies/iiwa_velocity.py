"""The velocity noise of a real iiwa: two clocks, not the encoder. The sender's is recovered from the data."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from .. import robots
from .._core import ExtendedKalman, Status
from ..arm import Array, Sensing
from ..logs import Log
from ..pipeline import Pipeline
from ..velocity import JointVelocity, SenderClock
from . import Progress, Row, _figures, _iiwa_logs
from ._iiwa_logs import IiwaLog
from ._rows import at_most, near, told

if TYPE_CHECKING:
    from matplotlib.figure import Figure

JOINT = 1
"""joint 2 moves most"""
REQUIRED = 0.003
"""noise of joint 2 [rad/s]"""
ENCODER = 2e-5
"""standard deviation of a position given to the Kalman filter [rad]"""
DISTURBANCE = 50.0
"""growth of the torque that the Kalman filter is not told [N m/sqrt(s)]"""
SAME_LAG = 1.0
"""two lags that differ by less are the same [ms]"""
GARBAGE = 1.1
"""what two of the logs begin with [s]"""
PUBLISHED_NOISE: Mapping[str, float] = {"log 1": 0.042, "no_avg": 0.056}
"""[rad/s]"""


class Method(NamedTuple):
    """A way to estimate velocity."""

    clock: Literal["reader", "sender"] = "reader"
    average: int = 1
    cycles: float = 0.0
    """time constant of the low-pass, in loop periods"""
    kalman: bool = False


PLAIN, RECOVERED = "plain difference", "sender's clock"
METHODS: Mapping[str, Method] = {
    PLAIN: Method(),
    "moving average of 5": Method(average=5),
    "low-pass, tau = 2 h": Method(cycles=2.0),
    "low-pass, tau = 5 h": Method(cycles=5.0),
    "low-pass, tau = 10 h": Method(cycles=10.0),
    "Kalman state": Method(kalman=True),
    RECOVERED: Method(clock="sender"),
    "Kalman state on the sender's clock": Method(clock="sender", kalman=True),
}


class Found(NamedTuple):
    """One log by all methods."""

    log: IiwaLog
    velocity: dict[str, Array]
    """(N,) of joint 2, by method [rad/s]; 0 where there is none"""
    first: int
    """row from which noise and lag are measured: real measurements, and the sender's clock is locked"""
    period: float
    """of the sender [s]"""
    locked_after: float
    """the first motion [s]"""
    largest: dict[str, float]
    """|velocity| of any joint, by method [rad/s]"""
    refused: int
    """rows at the start that gave no velocity on the sender's clock"""


def measure(name: str) -> Found:
    """One log by all methods."""
    log = _iiwa_logs.load(name)
    clock = SenderClock(_iiwa_logs.JOINTS)
    stamps = clock.run(log.time_ns, log.position)
    velocity, largest = {}, {}
    for what, method in METHODS.items():
        found = (
            _kalman(log, method, stamps.time_ns, stamps.fresh) if method.kalman else _filtered(log, method)
        )
        velocity[what] = found[:, JOINT].copy()
        largest[what] = float(np.abs(found).max())
    locked = int(np.argmax(stamps.status == int(Status.ok)))
    moving = log.real + int(
        np.argmax(np.abs(_iiwa_logs.centred(velocity[PLAIN])[log.real + _iiwa_logs.WINDOW :]) > 0.01)
    )
    return Found(
        log,
        velocity,
        locked,
        float(stamps.period[-1]),
        float(log.time_ns[locked] - log.time_ns[moving]) * 1e-9,
        largest,
        int(np.argmax(stamps.interval > 0.0)),
    )


def _filtered(log: IiwaLog, method: Method) -> Array:
    estimator = JointVelocity(
        _iiwa_logs.JOINTS,
        clock=method.clock,
        average=method.average,
        time_constant=method.cycles * log.period,
    )
    return estimator.run(log.time_ns, log.position)[0]


def _kalman(
    log: IiwaLog, method: Method, stamps: npt.NDArray[np.int64], fresh: npt.NDArray[np.bool_]
) -> Array:
    """State of the extended Kalman filter. No torque was logged: gravity is given, the rest is the disturbance's."""
    arm = robots.load("kuka_lbr_iiwa7")
    arm = arm.replace(joints=tuple(j.replace(sensing=Sensing(position_std=ENCODER)) for j in arm.joints))
    read = method.clock == "reader"
    rows = np.arange(log.real, len(log.time_ns))
    time = (log.time_ns if read else stamps)[rows]
    # where the clock locks, a recovered stamp may lie before the read stamp of the row above
    rising = time > np.concatenate(([time[0] - 1], np.maximum.accumulate(time)[:-1]))
    keep = rising if read else rising & fresh[rows]
    rows, time = rows[keep], time[keep]
    q = np.ascontiguousarray(log.position[rows])
    gravity = arm.core.momentum_terms(q, np.zeros_like(q))[2]
    pipeline = Pipeline(arm, observer=ExtendedKalman(disturbance_rate=DISTURBANCE), payload=None)
    touch = pipeline.run(Log(time_ns=time, position=q, effort=gravity, joint_names=arm.joint_names))
    out = np.zeros_like(log.position)
    at = np.searchsorted(rows, np.arange(len(out)), side="right") - 1
    out[at >= 0] = touch.dq[at[at >= 0]]
    return out


def run(progress: Progress, quick: bool) -> tuple[list[Row], Mapping[str, Figure], list[str]]:
    """Measure; three logs of 6 to 15 s leave nothing to shorten for `quick`."""
    found = []
    for i, name in enumerate(_iiwa_logs.NAMES):
        found.append(measure(name))
        progress(i + 1, len(_iiwa_logs.NAMES), 0.0)
    rows = [row for f in found for row in (*_noise_rows(f), *_lag_rows(f))]
    rows += [row for f in found for row in (*_clock_rows(f), *_normality_rows(f))]
    rows += _garbage_rows(found) + _gain_rows(found)
    notes = [
        f"Noise: standard deviation about the centred mean of {_iiwa_logs.WINDOW} rows, while joint 2 is faster than "
        f"{_iiwa_logs.MOVING} rad/s, from where the sender's clock is locked. Lag: the shift against the plain "
        "difference that leaves the least difference between the two, both smoothed by that mean.",
        "All methods are causal and see whole milliseconds of wall clock as the time of reading; none is told the "
        "sender's period. Kalman state: extended Kalman filter with gravity as the only known torque.",
    ]
    return rows, _figures.drawn(lambda: _draw(found)), notes


def _noise_rows(f: Found) -> list[Row]:
    rows = []
    for what, velocity in f.velocity.items():
        value = float(_iiwa_logs.noise(velocity, f.first).std())
        text = f"{f.log.name}: noise of joint 2, {what}"
        if what == RECOVERED:
            rows.append(at_most(text, REQUIRED, value, "rad/s"))
        else:
            rows.append(
                told(text, value, "rad/s", beside=PUBLISHED_NOISE.get(f.log.name) if what == PLAIN else None)
            )
    return rows


def _lag_rows(f: Found) -> list[Row]:
    time = (f.log.time_ns - f.log.time_ns[0]) * 1e-9
    rows = []
    for what, velocity in f.velocity.items():
        if what == PLAIN:
            continue
        value = 1e3 * _iiwa_logs.added_lag(time, velocity, f.velocity[PLAIN], f.first)
        text = f"{f.log.name}: lag added to that of the plain difference, {what}"
        rows.append(at_most(text, SAME_LAG, value, "ms") if what == RECOVERED else told(text, value, "ms"))
    return rows


def _clock_rows(f: Found) -> list[Row]:
    return [
        near(
            f"{f.log.name}: period of the sender",
            5.0,
            1e3 * f.period,
            0.02,
            "ms",
            "5 ms inferred, not documented",
        ),
        told(f"{f.log.name}: clock locked after the first motion", f.locked_after, "s"),
    ]


def _normality_rows(f: Found) -> list[Row]:
    rows = []
    for what in (PLAIN, RECOVERED):
        skewness, kurtosis, p = _iiwa_logs.normality(_iiwa_logs.noise(f.velocity[what], f.first))
        note = f"skewness {skewness:.2f}, excess kurtosis {kurtosis:.2f}; Jarque-Bera p = {p:.2g}"
        note += "; two narrow groups, no noise of an encoder" if what == PLAIN else ""
        rows.append(
            Row(
                f"{f.log.name}: noise normal? {what}", None, "no" if p < 0.01 else "yes", None, None, "", note
            )
        )
    return rows


def _garbage_rows(found: list[Found]) -> list[Row]:
    rows = []
    for f in found:
        if f.log.real == 0:
            continue
        seconds = float(f.log.time_ns[f.refused] - f.log.time_ns[0]) * 1e-9
        rows.append(
            Row(
                f"{f.log.name}: rows at the start that gave no velocity",
                f">= {f.log.real}",
                f.refused,
                None,
                f.refused >= f.log.real,
                "",
                f"{seconds:.2f} s, of which {GARBAGE} s are memory that nobody had written to",
            )
        )
        rows.append(
            at_most(
                f"{f.log.name}: largest velocity of any joint, {RECOVERED}",
                1.0,
                f.largest[RECOVERED],
                "rad/s",
                f"plain difference {f.largest[PLAIN]:.0f} rad/s",
            )
        )
    return rows


def _gain_rows(found: list[Found]) -> list[Row]:
    gain = found[0].log.gain
    share = 100.0 * float(np.mean(gain < 0.0))
    return [
        near(
            "log 1: share of the time with a negative ABAG gain",
            69.0,
            share,
            0.5,
            "%",
            "as published, saturated to [-1, 1]",
        )
    ]


def _draw(found: list[Found]) -> dict[str, Figure]:
    f = found[0]
    time = (f.log.time_ns - f.log.time_ns[0]) * 1e-9
    shown = [PLAIN, "low-pass, tau = 10 h", RECOVERED]
    figures = {
        f"Velocity of joint 2, {f.log.name}": _figures.curves(
            {what: (time, f.velocity[what]) for what in shown},
            "velocity [rad/s]",
            limits=(1.0, 3.0, 0.0, 0.3),
        )
    }
    edges = np.linspace(-0.12, 0.12, 121)
    lines = {}
    for what in shown:
        count, _ = np.histogram(_iiwa_logs.noise(f.velocity[what], f.first), edges, density=True)
        lines[what] = (0.5 * (edges[1:] + edges[:-1]), np.maximum(count, 1e-2))
    figures[f"Histogram of the noise of joint 2, {f.log.name}"] = _figures.curves(
        lines, "density [s/rad]", across="noise [rad/s]", log=True
    )
    return figures
