"""Motion and control of the arm that weighs: quintic trajectories, PD with feed-forward, the safety limiter."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from ._core import FeedforwardPd as CoreController
from ._core import Load, Status
from ._core import Quintic as CoreQuintic
from ._core import SafetyLimiter as CoreLimiter
from .arm import Arm, Array
from .errors import InputError

FeedforwardName = Literal["reference_gravity", "gravity", "inverse_dynamics"]


def _joints(value: npt.ArrayLike, n: int, what: str) -> Array:
    """One number for all joints or one per joint, as (n,) float64."""
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"{what}: expected a number or {n} numbers, got {value!r:.60}") from None
    if array.shape not in ((), (n,)):
        raise InputError(f"{what}: expected a number or {n} numbers, got shape {array.shape}")
    return np.ascontiguousarray(np.broadcast_to(array, (n,)))


class Setpoint(NamedTuple):
    """Where the joints should be."""

    q: Array
    """(n,) [rad]"""
    dq: Array
    """(n,) [rad/s]"""
    ddq: Array
    """(n,) [rad/s^2]"""


class Quintic:
    """Joint motion from rest to rest by a fifth-degree polynomial; goal = start is a motion of no duration.

    Args:
        start: (n,) [rad].
        goal: (n,) [rad].
        duration: [s]; None: so that no joint is faster than `speed`.
        speed: peak joint speed [rad/s] when no duration is given.

    Raises:
        InputError: shapes differ, numbers are not finite, no time for a motion.
    """

    def __init__(
        self, start: npt.ArrayLike, goal: npt.ArrayLike, duration: float | None = None, *, speed: float = 0.5
    ) -> None:
        q0 = np.atleast_1d(np.asarray(start, dtype=np.float64))
        q1 = _joints(goal, len(q0), "goal")
        if duration is None:
            if not speed > 0.0:
                raise InputError(f"speed: expected a number > 0 [rad/s], got {speed!r}")
            duration = float(1.875 * np.max(np.abs(q1 - q0)) / speed)
        if np.array_equal(q0, q1):
            duration = 0.0
        try:
            self._core = CoreQuintic(np.ascontiguousarray(q0), q1, float(duration))
        except ValueError as e:
            raise InputError(str(e)) from None
        self.duration = float(duration)
        """[s]"""

    def sample(self, t: float) -> Setpoint:
        """The setpoint at `t` [s]; the ends before and after the motion."""
        return Setpoint(*self._core.sample(t))


class Controller:
    """PD control about the torque the arm needs: u = sat(u_ff + Kp (q_d - q) + Kd (dq_d - dq)) (MATH.md section 8).

    Args:
        arm: the arm.
        kp: [N m/rad], one number or one per joint.
        kd: [N m s/rad], one number or one per joint.
        limit: largest torque [N m]; None: the joints' effort limits.
        feedforward: "reference_gravity" (the published g(q_d)), "gravity" (g(q) with the load) or
            "inverse_dynamics" (the whole motion with the load).

    Raises:
        InputError: a gain or limit is out of range.
    """

    def __init__(
        self,
        arm: Arm,
        kp: npt.ArrayLike,
        kd: npt.ArrayLike,
        *,
        limit: npt.ArrayLike | None = None,
        feedforward: FeedforwardName = "inverse_dynamics",
    ) -> None:
        n = arm.n
        bound = [j.limits.effort for j in arm.joints] if limit is None else limit
        try:
            self._core = CoreController(
                arm.core, _joints(kp, n, "kp"), _joints(kd, n, "kd"), _joints(bound, n, "limit"), feedforward
            )
        except ValueError as e:
            raise InputError(str(e)) from None
        self._nothing = Load()

    def step(self, setpoint: Setpoint, q: Array, dq: Array, load: Load | None = None) -> tuple[Array, Status]:
        """Torque [N m] and status (saturated, non_finite) for the estimated state q, dq and what is held."""
        torque, status = self._core.step(
            setpoint.q, setpoint.dq, setpoint.ddq, q, dq, self._nothing if load is None else load
        )
        return torque, status


class SafetyLimiter:
    """The last thing a command passes before the driver: torque, rate, soft position and velocity limits, faults.

    Limits come from the arm's card. Outside them pushing fades out and turns into braking; torque and rate bounds
    hold for any input, NaN included.

    Args:
        arm: the arm; every joint needs a finite effort limit, or give `torque`.
        torque: largest torque [N m]; None: the joints' effort limits.
        torque_rate: largest change of torque [N m/s].
        approach: speed allowed per distance to a position limit [1/s].
        damping: torque per excess of speed [N m s/rad]; None: effort limit over velocity limit.

    Raises:
        InputError: no finite torque limit, or a value out of range.
    """

    def __init__(
        self,
        arm: Arm,
        *,
        torque: npt.ArrayLike | None = None,
        torque_rate: npt.ArrayLike = np.inf,
        approach: npt.ArrayLike = 5.0,
        damping: npt.ArrayLike | None = None,
    ) -> None:
        n = arm.n
        self._arm = arm
        limits = [j.limits for j in arm.joints]
        bound = _joints([x.effort for x in limits] if torque is None else torque, n, "torque")
        speed = np.array([x.velocity for x in limits])
        if damping is None:
            damping = np.where(np.isfinite(speed), bound / np.where(np.isfinite(speed), speed, 1.0), bound)
        try:
            self._core = CoreLimiter(
                bound,
                _joints(torque_rate, n, "torque_rate"),
                np.array([x.lower for x in limits]),
                np.array([x.upper for x in limits]),
                speed,
                _joints(approach, n, "approach"),
                _joints(damping, n, "damping"),
            )
        except ValueError as e:
            raise InputError(str(e)) from None

    def step(self, torque: Array, q: Array, dq: Array, dt: float) -> tuple[Array, Status]:
        """The torque [N m] that may be sent, and ok, saturated, non_finite or time_error."""
        gravity = self._arm.core.momentum_terms(q[None], np.zeros((1, self._arm.n)))[2][0]
        sent, status, _ = self._core.step(torque, q, dq, gravity, dt)
        return sent, status

    def reset(self, torque: Array) -> None:
        """Start from the torque in force now, so that the rate limit counts from it."""
        self._core.reset(torque)
