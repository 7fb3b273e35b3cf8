"""Motion to identify an arm with: Fourier series inside its limits, optimised for what they show (MATH.md section 6).

    q_j(t) = c_j + sum_k (a_jk sin(k w t) - b_jk cos(k w t)) / (k w),   w = 2 pi / T,

at rest at both ends of the period T: sum_k a_jk = 0 and sum_k k b_jk = 0. Every joint's series is scaled until it
meets the first of its limits, so that no trajectory tried ever breaks one. Maximised is the logarithm of the
determinant of the base parameters' information (the smallest volume of their confidence ellipsoid), less that of
the conditioning (no axis much longer than another). J. Swevers et al., IEEE T-RA 13(5), 1997.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from palpate.arm import Arm, Array
from palpate.errors import ArmError, InputError, MissingExtraError
from palpate.identify._threads import one_thread
from palpate.identify.friction import FrictionModel
from palpate.identify.regress import RANK, ROUNDING, parameters

VELOCITY = 1.0
"""taken where the arm states no velocity limit [rad/s or m/s]"""
RISE = 0.5
"""where no acceleration limit is given: time from rest to the velocity limit [s]"""
TURN = np.pi
"""range taken of a joint without position limits: so far to both sides [rad]"""
FINE, COARSE = 40, 10
"""samples per period of the highest harmonic: for limits, and for the information"""
PEAK = float(1.0 / np.cos(np.pi / FINE))
"""a trigonometric polynomial is nowhere larger than so many times its largest sample (Ehlich and Zeller 1964)"""
NEAR = 0.03
"""clearance that is kept [m]"""
SHRINK = (1.0, 0.8, 0.6, 0.45, 0.3)
"""parts of the limits' margin tried in turn until a motion keeps clear and within the effort limits"""

STARTS = 50
"""random motions the search chooses its start from"""
HOPELESS = 20.0
"""cost of a start from which no search gets within effort limits and clear: it is not begun"""


@dataclass(frozen=True, slots=True, eq=False)
class Excitation:
    """A motion to identify with. Immutable.

    Attributes:
        joint_names: n names.
        time: (N,) [s] from 0 to the period.
        q, dq, ddq: (N, n) [rad, rad/s, rad/s^2]; dq and ddq are 0 at both ends.
        period: T [s].
        harmonics: of the series.
        conditioning: of the regressor of the base parameters, columns in units of what random motion gives them,
            rows in units of each joint's usual torque.
        random_conditioning: median of the same over random series that fill the same limits.
        log_det: logarithm of the determinant of the information, per base parameter.
        share: (n, 3) largest part used of the range of position, of velocity and of acceleration [1].
        torque: (n,) largest torque [N m]; NaN where the arm has no masses.
        torque_share: (n,) part of the effort limit [1]; NaN where none is stated.
        clearance: least distance found by the clearance function [m]; NaN without one.
    """

    joint_names: tuple[str, ...]
    time: Array
    q: Array
    dq: Array
    ddq: Array
    period: float
    harmonics: int
    conditioning: float
    random_conditioning: float
    log_det: float
    share: Array
    torque: Array
    torque_share: Array
    clearance: float


class _Series:
    """Series from free numbers x: at rest at the ends, each joint scaled to the first of its limits.

    The range low..high is where a joint may be, its width how much of it the motion may take.
    x holds per joint 2 (H - 1) coefficients and the place of the series within the joint's range.
    """

    def __init__(
        self,
        low: Array,
        high: Array,
        width: Array,
        velocity: Array,
        acceleration: Array,
        period: float,
        harmonics: int,
    ) -> None:
        self.low, self.high, self.width = low, high, width
        self.velocity, self.acceleration = velocity, acceleration
        self.period, self.harmonics, self.n = period, harmonics, len(low)
        order = np.arange(1, harmonics + 1)
        # orthonormal bases of what keeps the ends at rest
        self.a = np.linalg.svd(np.ones((1, harmonics)))[2][1:]
        self.b = np.linalg.svd(order[None, :] / np.linalg.norm(order))[2][1:]
        self.w = 2.0 * np.pi * order / period
        self.fine = self._waves(np.linspace(0.0, period, FINE * harmonics, endpoint=False))
        self.coarse = tuple(part[:: FINE // COARSE] for part in self.fine)

    @property
    def size(self) -> int:
        """Free numbers."""
        return self.n * (2 * self.harmonics - 1)

    def _waves(self, t: Array) -> tuple[Array, Array, Array]:
        """Position, velocity, acceleration per free coefficient, (N, 2 (H - 1)) each."""
        angle = t[:, None] * self.w
        sin, cos = np.sin(angle), np.cos(angle)
        return (
            np.hstack([sin / self.w @ self.a.T, -cos / self.w @ self.b.T]),
            np.hstack([cos @ self.a.T, sin @ self.b.T]),
            np.hstack([-sin * self.w @ self.a.T, cos * self.w @ self.b.T]),
        )

    def _scaled(self, x: Array) -> tuple[Array, Array]:
        """Coefficients (2 (H - 1), n) that meet a limit, and the centres (n,)."""
        rows = x.reshape(self.n, -1)
        coefficients = rows[:, :-1].T
        s, ds, dds = (wave @ coefficients for wave in self.fine)
        used = np.max(
            [
                np.ptp(s, axis=0) / self.width,
                np.abs(ds).max(axis=0) / self.velocity,
                np.abs(dds).max(axis=0) / self.acceleration,
            ],
            axis=0,
        )
        used = np.maximum(used, 1e-12) * PEAK
        span = PEAK * np.ptp(s, axis=0) / used
        place = 0.5 + 0.5 * np.tanh(rows[:, -1])
        middle = self.low + 0.5 * span + place * (self.high - self.low - span)
        return coefficients / used, middle - 0.5 * (s.max(axis=0) + s.min(axis=0)) / used

    def sample(self, x: Array, waves: tuple[Array, Array, Array] | None = None) -> tuple[Array, Array, Array]:
        """q, dq, ddq (N, n) of the free numbers; by default at the coarse samples."""
        coefficients, centre = self._scaled(x)
        s, ds, dds = (wave @ coefficients for wave in waves or self.coarse)
        return centre + s, ds, dds

    def at(self, x: Array, t: Array) -> tuple[Array, Array, Array]:
        """q, dq, ddq (N, n) at times."""
        return self.sample(x, self._waves(t))


class _Information:
    """How well a motion shows the base parameters of an arm."""

    def __init__(self, arm: Arm) -> None:
        self.arm = arm
        self.count = len(parameters(arm, FrictionModel()))
        rng = np.random.default_rng(0)
        n, rows = arm.n, 40 * arm.n
        q = rng.uniform(-np.pi, np.pi, (rows, n))
        dq, ddq = rng.standard_normal((2, rows, n))
        self.weight = np.ones(n)
        if arm.has_dynamics:
            usual = np.sqrt(np.mean(np.square(arm.inverse_dynamics(q, dq, ddq)), axis=0))
            self.weight = 1.0 / np.maximum(usual, 1e-3 * usual.max())
        A = self._matrix(q, dq, ddq)
        self.scale = np.linalg.norm(A, axis=0) / np.sqrt(len(A))
        felt = np.flatnonzero(self.scale > ROUNDING * self.scale.max())
        try:
            from scipy.linalg import qr
        except ImportError:
            raise MissingExtraError("identify", "making an excitation") from None
        R, pivots = qr(A[:, felt] / self.scale[felt], mode="r", pivoting=True)
        diagonal = np.abs(np.diag(R))
        self.base = np.sort(felt[pivots[: np.count_nonzero(diagonal > RANK * diagonal[0])]])

    def _matrix(self, q: Array, dq: Array, ddq: Array) -> Array:
        n = self.arm.n
        A = np.zeros((len(q), n, self.count))
        A[:, :, : 10 * n] = self.arm.regressor(q, dq, ddq)
        at = np.arange(n)
        fastest = np.maximum(np.abs(dq).max(axis=0), 1e-9)
        A[:, at, 10 * n + at] = ddq
        A[:, at, 11 * n + 3 * at] = np.tanh(dq / (0.02 * fastest))
        A[:, at, 11 * n + 3 * at + 1] = dq
        A[:, at, 11 * n + 3 * at + 2] = 1.0
        return (A * self.weight[:, None]).reshape(-1, self.count)

    def _gram(self, motion: tuple[Array, Array, Array]) -> Array:
        A = self._matrix(*motion)[:, self.base] / self.scale[self.base]
        return A.T @ A / len(motion[0])

    def figures(self, motion: tuple[Array, Array, Array]) -> tuple[float, float]:
        """Logarithm of the determinant per base parameter, and the conditioning; -inf and inf: not all "
        "are shown."""
        values = np.linalg.eigvalsh(self._gram(motion))
        if values[0] <= 1e-14 * values[-1]:
            return -np.inf, np.inf
        return float(np.mean(np.log(values))), float(np.sqrt(values[-1] / values[0]))


@one_thread
def excite(
    arm: Arm,
    *,
    seconds: float = 20.0,
    harmonics: int = 6,
    seed: int = 0,
    rate: float = 100.0,
    margin: float = 0.95,
    acceleration: float | Array | None = None,
    velocity: float | Array | None = None,
    iterations: int = 40,
    clearance: Callable[[Array], Array] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Excitation:
    """Find a motion that shows as much as can be of an arm's dynamics and friction.

    Args:
        arm: kinematics and limits; where it has masses, torques stay within the effort limits. A joint without
            position limits gets half a turn to both sides, one without a velocity limit 1 rad/s.
        seconds: period T [s]; the motion may be repeated, its end is its start.
        harmonics: of the series, at least 3.
        seed: of the start of the search.
        rate: samples per second [Hz].
        margin: part of every limit that is used, 0..1.
        acceleration: limit(s) [rad/s^2]; default: twice the velocity limit over a second.
        velocity: limit(s) [rad/s] where they are to be lower than the arm's.
        iterations: of the search.
        clearance: distance [m] of poses (N, n) from whatever must not be touched, (N,); the motion keeps
            :data:`NEAR`. See palpate.simulate.Clearance.
        progress: called with iterations done and in all.

    Raises:
        InputError: an argument is out of range, or no motion keeps clear.
        ArmError: a joint has no range.
        MissingExtraError: without the extra ``identify``.
    """
    try:
        from scipy.optimize import minimize
    except ImportError:
        raise MissingExtraError("identify", "making an excitation") from None
    if not (np.isfinite(seconds) and 1.0 <= seconds <= 600.0):
        raise InputError(f"seconds must be between 1 and 600, got {seconds!r}")
    if harmonics != int(harmonics) or not 3 <= harmonics <= 30:
        raise InputError(f"harmonics must be a whole number between 3 and 30, got {harmonics!r}")
    if not 0.0 < margin <= 1.0:
        raise InputError(f"margin must be above 0 and at most 1, got {margin!r}")
    if not (np.isfinite(rate) and rate > 0.0):
        raise InputError(f"rate must be a positive frequency [Hz], got {rate!r}")
    information = _Information(arm)
    rng = np.random.default_rng(seed)
    effort = np.array([j.limits.effort for j in arm.joints])

    def cost(x: Array, series: _Series) -> float:
        motion = series.sample(x)
        determinant, conditioning = information.figures(motion)
        value = -determinant + float(np.log(conditioning))
        if arm.has_dynamics:
            used = np.abs(_torque(arm, *motion)).max(axis=0) / (margin * effort)
            value += 100.0 * float(np.sum(np.square(np.maximum(used - 0.95, 0.0))))
        if clearance is not None:
            short = np.maximum(1.5 * NEAR - clearance(motion[0][::2]), 0.0) / NEAR
            value += 20.0 * float(np.mean(np.square(short))) + 2.0 * float(short.max()) ** 2
        return value if np.isfinite(value) else 1e6

    least, best = np.nan, np.zeros(0)
    for shrink in SHRINK:
        series = _series(arm, seconds, int(harmonics), margin, shrink, velocity, acceleration)
        starts = [_random(series, rng) for _ in range(STARTS)]
        costs = [cost(x, series) for x in starts]
        if min(costs) > HOPELESS and shrink != SHRINK[-1]:
            continue
        done = 0

        def step(x: Array) -> None:
            nonlocal done
            done += 1
            if progress is not None:
                progress(min(done, iterations), iterations)

        best = minimize(
            cost,
            starts[int(np.argmin(costs))],
            args=(series,),
            method="L-BFGS-B",
            callback=step,
            options={"maxiter": iterations, "maxfun": 10**7},
        ).x
        fine = series.sample(best, series.fine)
        least = np.nan if clearance is None else float(clearance(fine[0]).min())
        torque = np.abs(_torque(arm, *fine)).max(axis=0) if arm.has_dynamics else np.full(arm.n, np.nan)
        if not least < 0.5 * NEAR and not np.any(torque > effort):
            break
    else:
        what = (
            f"comes within {1e3 * least:.0f} mm of a collision"
            if least < 0.5 * NEAR
            else f"needs {np.nanmax(torque / effort):.0%} of a joint's effort limit"
        )
        raise InputError(
            f"the smallest of {len(SHRINK)} motions tried {what}: allow less (margin, velocity, "
            "acceleration), or "
            "try another seed"
        )
    t = np.arange(round(seconds * rate) + 1) / rate
    t[-1] = seconds
    q, dq, ddq = series.at(best, t)
    # rounding leaves 1e-16 of the sums that are zero
    dq[[0, -1]], ddq[[0, -1]] = 0.0, 0.0
    determinant, conditioning = information.figures(series.sample(best))
    others = [information.figures(series.sample(_random(series, rng)))[1] for _ in range(21)]
    return Excitation(
        joint_names=arm.joint_names,
        time=t,
        q=q,
        dq=dq,
        ddq=ddq,
        period=float(seconds),
        harmonics=int(harmonics),
        conditioning=conditioning,
        random_conditioning=float(np.median(others)),
        log_det=determinant,
        share=margin
        * shrink
        * np.column_stack(
            [
                np.ptp(fine[0], axis=0) / series.width,
                np.abs(fine[1]).max(axis=0) / series.velocity,
                np.abs(fine[2]).max(axis=0) / series.acceleration,
            ]
        ),
        torque=torque,
        torque_share=np.where(np.isfinite(effort), torque / effort, np.nan),
        clearance=least,
    )


def _torque(arm: Arm, q: Array, dq: Array, ddq: Array) -> Array:
    torque: Array = arm.inverse_dynamics(q, dq, ddq) + arm.friction_torque(dq)
    return torque


def _random(series: _Series, rng: np.random.Generator) -> Array:
    rows = rng.standard_normal((series.n, series.size // series.n))
    rows[:, -1] *= 0.7
    found: Array = rows.ravel()
    return found


def _limit(value: float | Array | None, n: int, what: str) -> Array | None:
    if value is None:
        return None
    given = (
        np.broadcast_to(np.asarray(value, dtype=np.float64), (n,))
        if np.ndim(value) == 0
        else np.asarray(value)
    )
    if given.shape != (n,) or not np.all(np.isfinite(given) & (given > 0.0)):
        raise InputError(f"{what} must be one or {n} positive numbers, got {value!r}")
    return given


def _series(
    arm: Arm,
    seconds: float,
    harmonics: int,
    margin: float,
    shrink: float,
    velocity: float | Array | None,
    acceleration: float | Array | None,
) -> _Series:
    n = arm.n
    low = np.array([j.limits.lower if np.isfinite(j.limits.lower) else -TURN for j in arm.joints])
    high = np.array([j.limits.upper if np.isfinite(j.limits.upper) else TURN for j in arm.joints])
    for j, joint in enumerate(arm.joints):
        if not high[j] - low[j] > 1e-3:
            raise ArmError(f"joint {joint.name} has no range to move in: {low[j]:g} to {high[j]:g}")
        if joint.kind == "prismatic" and not np.isfinite([joint.limits.lower, joint.limits.upper]).all():
            raise ArmError(f"joint {joint.name} slides without limits: give the arm its range")
    speed = np.array([j.limits.velocity for j in arm.joints])
    speed = np.where(np.isfinite(speed), speed, VELOCITY)
    asked = _limit(velocity, n, "velocity")
    if asked is not None:
        speed = np.minimum(speed, asked)
    push = _limit(acceleration, n, "acceleration")
    if push is None:
        push = speed / RISE
    middle, half = 0.5 * (low + high), 0.5 * margin * (high - low)
    return _Series(
        middle - half,
        middle + half,
        2.0 * shrink * half,
        margin * shrink * speed,
        margin * shrink * push,
        seconds,
        harmonics,
    )


def to_csv(motion: Excitation) -> str:
    """A table with palpate's own column names: time_s, position_1, ..., velocity_1, ..., acceleration_1, ..."""
    n = motion.q.shape[1]
    names = [f"{what}_{j + 1}" for what in ("position", "velocity", "acceleration") for j in range(n)]
    rows = np.column_stack([motion.time, motion.q, motion.dq, motion.ddq])
    lines = [",".join(["time_s", *names]), *(",".join(f"{v:.9g}" for v in row) for row in rows)]
    return "\n".join(lines) + "\n"


def to_ros(motion: Excitation, *, approach: float = 5.0) -> str:
    """The motion as YAML of a trajectory_msgs/msg/JointTrajectory, as ``ros2 topic pub`` takes it.

    Ten points per period of the highest harmonic, with velocities and accelerations, between which a
    joint_trajectory_controller runs quintic splines.

    Args:
        motion: the motion.
        approach: time given to reach the first point from wherever the arm is [s], > 0; this way is not checked.

    Raises:
        InputError: the approach is not positive.
    """
    if not (np.isfinite(approach) and approach > 0.0):
        raise InputError(f"the approach must take a positive time [s], got {approach!r}")
    wanted = np.linspace(0.0, motion.period, COARSE * motion.harmonics + 1)
    rows = np.unique(np.searchsorted(motion.time, wanted - 1e-9).clip(0, len(motion.time) - 1))

    def listed(values: Array) -> str:
        return "[" + ", ".join(f"{v:.7f}" for v in values) + "]"

    names = ", ".join(f'"{name}"' for name in motion.joint_names)
    lines = ['header: {frame_id: ""}', f"joint_names: [{names}]", "points:"]
    for k in rows:
        nanoseconds = round((approach + float(motion.time[k])) * 1e9)
        lines += [
            f"- positions: {listed(motion.q[k])}",
            f"  velocities: {listed(motion.dq[k])}",
            f"  accelerations: {listed(motion.ddq[k])}",
            f"  time_from_start: {{sec: {nanoseconds // 10**9}, nanosec: {nanoseconds % 10**9}}}",
        ]
    return "\n".join(lines) + "\n"
