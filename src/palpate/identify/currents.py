"""From two phase currents per motor to torque: sensors, electrical angle, torque constants (MATH.md section 7).

Two things no data sheet tells are found from logs: what the current sensors read at zero, how their gains
differ and where the rotor's field stands (:func:`calibrate_phases`), and what an ampere is worth at the joint
(:func:`fit_torque_constants`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from palpate.arm import Array
from palpate.errors import InputError, MissingExtraError
from palpate.identify._threads import one_thread

LEAST_AGREEMENT = 0.3
"""below it the currents do not turn with the position; where they do, glitches and offsets leave more [1]"""
CLEAN = 3.5
"""readings whose d-axis current is beyond so many standard deviations are no sine [1]"""
LEAST_SPREAD = 5.0
"""a torque constant counts as seen if the known torques spread by so many standard deviations of their error [1]"""


@dataclass(frozen=True, slots=True)
class PhaseCalibration:
    """Two current sensors of one motor, true current = gain (reading - offset), and where the rotor's field stands.

    Attributes:
        offset: of phases a and b [A].
        gain: of a and b; their product is 1, for a common gain belongs to the torque constant [1].
        angle_offset: electrical angle at position 0, in (-pi, pi] [rad].
        offset_std: [A].
        gain_ratio_std: of gain b / gain a [1].
        angle_std: [rad].
        noise: standard deviation of a reading [A].
        agreement: how well the currents agree on the angle; 1 is perfect, 0 is chance [1].
    """

    offset: tuple[float, float]
    gain: tuple[float, float]
    angle_offset: float
    offset_std: tuple[float, float]
    gain_ratio_std: float
    angle_std: float
    noise: float
    agreement: float


@one_thread
def calibrate_phases(
    position: npt.ArrayLike, phase_a: npt.ArrayLike, phase_b: npt.ArrayLike, turns: float
) -> PhaseCalibration:
    """Sensors and electrical angle of one motor from a motion in both directions, whatever the torque does.

    A field-oriented drive keeps the d-axis current at zero. So for true currents and the true angle theta =
    turns q + offset

        i_d = i_a cos theta + (i_a + 2 i_b)/sqrt 3 sin theta = 0

    at every instant: offsets, the ratio of the gains and the angle are those that make it so, by least squares
    of i_d over its own noise, with Huber's loss for the instants at which the wave is no sine. That leaves the
    angle open by half a turn, and energy tells
    which half: over a motion that comes back to where it began friction takes work, so the integral of i_q dq
    is positive (for a positive torque constant and gear).

    Args:
        position: (N,) of the motor at the link side [rad]; ends near its beginning.
        phase_a, phase_b: (N,) readings [A].
        turns: electrical turns per turn at the link side: pole pairs times gear ratio [1].

    Raises:
        InputError: shapes differ, the motor turns by less than two electrical turns, or the currents do not follow
            the position at this many turns.
        MissingExtraError: without the extra ``identify``.
    """
    try:
        from scipy.optimize import least_squares
    except ImportError:
        raise MissingExtraError("identify", "identification") from None
    q, a, b = (np.asarray(x, dtype=np.float64) for x in (position, phase_a, phase_b))
    if q.ndim != 1 or q.shape != a.shape or q.shape != b.shape:
        raise InputError(
            f"position, phase_a, phase_b must have one shape (N,), got {q.shape}, {a.shape}, {b.shape}"
        )
    finite = np.isfinite(q) & np.isfinite(a) & np.isfinite(b)
    q, a, b = q[finite], a[finite], b[finite]
    if len(q) < 100 or not np.ptp(q) * abs(turns) > 4.0 * math.pi:
        seen = np.ptp(q) * abs(turns) / (2.0 * math.pi) if len(q) else 0.0
        raise InputError(
            "phase currents are calibrated by a motion of at least two electrical turns and 100 readings, "
            f"got {seen:.2g} turns, "
            f"{len(q)} readings"
        )
    # a current vector j i_q e^{j theta}: squared, the sign of i_q is gone; the offsets' mean over the turns is zero
    squared = np.square(
        (a - a.mean() + 1j * (a - a.mean() + 2.0 * (b - b.mean())) / math.sqrt(3.0)) * np.exp(-1j * turns * q)
    )
    total = squared.sum()
    agreement = float(abs(total) / np.abs(squared).sum())
    if agreement < LEAST_AGREEMENT:
        raise InputError(
            f"the phase currents do not follow the position at {turns:g} electrical turns per turn "
            f"(agreement {agreement:.2f}): "
            "check pole pairs, gear ratio and its sign, and that phase b lags phase a"
        )
    start = np.array([float(a.mean()), float(b.mean()), 0.0, 0.5 * float(np.angle(-total))])

    def scaled(p: Array) -> tuple[Array, Array]:
        """i_d, and its standard deviation per that of a reading."""
        ca, cb = math.exp(-0.5 * p[2]), math.exp(0.5 * p[2])
        theta = turns * q + p[3]
        u = ca * (np.cos(theta) + np.sin(theta) / math.sqrt(3.0))
        v = cb * 2.0 / math.sqrt(3.0) * np.sin(theta)
        return u * (a - p[0]) + v * (b - p[1]), np.hypot(u, v)

    def residual(p: Array) -> Array:
        direct, size = scaled(p)
        return direct / size

    def spread(p: Array) -> float:
        return max(1.4826 * float(np.median(np.abs(residual(p)))), 1e-12)

    for _ in range(2):
        start = least_squares(residual, start, loss="huber", f_scale=2.0 * spread(start)).x
    # what is no sine pulls to one side even where it counts little
    sine = np.abs(residual(start)) < CLEAN * spread(start)
    q, a, b = q[sine], a[sine], b[sine]
    solved = least_squares(residual, start)
    noise = spread(solved.x)
    offset_a, offset_b, log_ratio, angle = (float(x) for x in solved.x)
    std = noise * np.sqrt(np.diag(np.linalg.inv(solved.jac.T @ solved.jac)))
    x, y = math.exp(-0.5 * log_ratio) * (a - offset_a), math.exp(0.5 * log_ratio) * (b - offset_b)
    theta = turns * q + angle
    i_q = (x + 2.0 * y) / math.sqrt(3.0) * np.cos(theta) - x * np.sin(theta)
    if float(np.sum(0.5 * (i_q[1:] + i_q[:-1]) * np.diff(q))) < 0.0:
        angle += math.pi
    ratio = math.exp(log_ratio)
    return PhaseCalibration(
        offset=(offset_a, offset_b),
        gain=(1.0 / math.sqrt(ratio), math.sqrt(ratio)),
        angle_offset=-math.remainder(-angle, 2.0 * math.pi),
        offset_std=(float(std[0]), float(std[1])),
        gain_ratio_std=float(std[2]) * ratio,
        angle_std=float(std[3]),
        noise=noise,
        agreement=agreement,
    )


@dataclass(frozen=True, slots=True, eq=False)
class TorqueConstants:
    """What :func:`fit_torque_constants` found.

    Attributes:
        gain: (n,) k_t G, joint torque per ampere [N m/A]; NaN where the poses show nothing.
        std: (n,) [N m/A]; infinite there.
        friction: (n,) current that friction holds after an approach, plus or minus [A].
        rms: (n,) of the current left unexplained [A].
        seen: (n,) whether the known torques differ enough.
    """

    gain: Array
    std: Array
    friction: Array
    rms: Array
    seen: npt.NDArray[np.bool_]


@one_thread
def fit_torque_constants(
    torque: npt.ArrayLike, current: npt.ArrayLike, approach: npt.ArrayLike
) -> TorqueConstants:
    """Torque constants from static poses, each reached from both sides so that friction cancels.

        i = tau / (k_t G) + s i_f + i_0 + noise,     s = +-1 the direction the joint came from

    The current is what is noisy, so it stays on the left: regressing torque on current would shrink k_t.

    Args:
        torque: (P, n) known torque that holds the pose [N m]; of a known load, the difference it makes.
        current: (P, n) signed mean current at the pose [A]; of a known load, the difference it makes.
        approach: (P, n) +1 where the joint came from below, -1 from above.

    Returns:
        The constants. A joint that bears no weight (a vertical first axis) is not ``seen``.

    Raises:
        InputError: shapes differ, values are not finite, or a joint was approached from one side only.
    """
    tau, i, s = (np.atleast_2d(np.asarray(x, dtype=np.float64)) for x in (torque, current, approach))
    if not tau.shape == i.shape == s.shape:
        raise InputError(
            f"torque, current, approach must have one shape (P, n), got {tau.shape}, {i.shape}, {s.shape}"
        )
    if not (np.isfinite(tau).all() and np.isfinite(i).all()):
        raise InputError("torque and current of the poses must be finite")
    count, n = tau.shape
    if count < 4:
        raise InputError(f"torque constants need at least 4 poses, from both sides, got {count}")
    one_sided = [j for j in range(n) if not ((s[:, j] > 0).any() and (s[:, j] < 0).any())]
    if one_sided:
        raise InputError(
            f"joint {one_sided[0]} was approached from one side only: friction would be taken for torque; "
            "reach every pose from below and from above"
        )
    gain, std = np.full(n, np.nan), np.full(n, np.inf)
    friction, rms, seen = np.zeros(n), np.zeros(n), np.zeros(n, dtype=bool)
    for j in range(n):
        # what the torque does beyond the side it was approached from, and a constant
        others = np.column_stack([np.sign(s[:, j]), np.ones(count)])
        alone = tau[:, j] - others @ np.linalg.lstsq(others, tau[:, j], rcond=None)[0]
        size = float(alone @ alone)
        slope = float(alone @ i[:, j]) / size if size > 0.0 else 0.0
        rest = i[:, j] - slope * tau[:, j]
        side = np.linalg.lstsq(others, rest, rcond=None)[0]
        left = rest - others @ side
        rms[j] = math.sqrt(float(left @ left) / count)
        friction[j] = side[0]
        slope_std = math.sqrt(float(left @ left) / (count - 3) / size) if size > 0.0 else math.inf
        seen[j] = abs(slope) > LEAST_SPREAD * slope_std
        if seen[j]:
            gain[j] = 1.0 / slope
            std[j] = slope_std * gain[j] ** 2
    return TorqueConstants(gain, std, friction, rms, seen)
