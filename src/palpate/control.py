"""Motion and control: quintic trajectories, PD with feed-forward, ABAG, Cartesian velocity by force, the limiter."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from ._core import Abag as CoreAbag
from ._core import AbagParameters, CartesianImpedanceOptions, CartesianVelocityOptions, Load, Status
from ._core import CartesianImpedance as CoreImpedance
from ._core import CartesianVelocity as CoreVelocity
from ._core import FeedforwardPd as CoreController
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

    @property
    def core(self) -> CoreController:
        """The C++ controller."""
        return self._core

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

    @property
    def core(self) -> CoreLimiter:
        """The C++ limiter."""
        return self._core

    def step(self, torque: Array, q: Array, dq: Array, dt: float) -> tuple[Array, Status]:
        """The torque [N m] that may be sent, and ok, saturated, non_finite or time_error."""
        gravity = self._arm.core.momentum_terms(q[None], np.zeros((1, self._arm.n)))[2][0]
        sent, status, _ = self._core.step(torque, q, dq, gravity, dt)
        return sent, status

    def reset(self, torque: Array) -> None:
        """Start from the torque in force now, so that the rate limit counts from it."""
        self._core.reset(torque)


class AbagState(NamedTuple):
    """Inside of an :class:`Abag`."""

    e_bar: float
    """mean sign of the error, -1 to 1"""
    b: float
    """bias: what it takes on average, -1 to 1"""
    g: float
    """gain, 0 to 1"""
    u: float
    """control, -1 to 1"""


class Abag:
    """Adaptive bias, adaptive gain: a bounded controller that needs the sign of the error alone.

    With e = desired - measured::

        e_bar <- alpha e_bar + (1 - alpha) sgn e
        b     <- sat[-1,1](b + delta_b [|e_bar| > theta_b] sgn e_bar)
        g     <- sat[0,1](g + delta_g sgn(|e_bar| - theta_g))
        u     =  sat[-1,1](b + g sgn e)

    Source: A. Franchi, A. Mallet, "Adaptive closed-loop speed control of BLDC motors with applications to multi-rotor
    aerial vehicles", ICRA 2017, in the form of the whiteboard project (MATH.md section 8).

    Args:
        parameters: rates and thresholds, ``AbagParameters.whiteboard()`` (8 ms), ``AbagParameters.kinova()``
            (1 kHz), their ``.at(period)``, or one's own; None: the whiteboard project's.
        negative_gain: let the gain fall to -1, as the whiteboard project's program does: below zero it pushes away
            from the goal. For reproducing it.

    Raises:
        InputError: a parameter is out of range.
    """

    def __init__(self, parameters: AbagParameters | None = None, *, negative_gain: bool = False) -> None:
        try:
            self._core = CoreAbag(
                AbagParameters.whiteboard() if parameters is None else parameters, bool(negative_gain)
            )
        except ValueError as e:
            raise InputError(str(e)) from None

    def step(self, error: float) -> float:
        """u for the error desired - measured, in any unit; 0 where it is not a number."""
        return self._core.step(float(error))

    def run(self, error: npt.ArrayLike) -> Array:
        """(N, 4) e_bar, b, g, u after each of the errors (N,)."""
        return self._core.run(np.ascontiguousarray(error, dtype=np.float64))

    @property
    def state(self) -> AbagState:
        """After the last step."""
        return AbagState(*self._core.state)

    def reset(self) -> None:
        """Forget everything."""
        self._core.reset()


def _still() -> Array:
    return np.zeros(3)


def _axes() -> Array:
    return np.eye(3)


@dataclass(slots=True, eq=False)
class CartesianTarget:
    """Where the tool should go, how fast, and what it should press on. Tool: grasp point, axes of the tip frame."""

    position: npt.ArrayLike
    """(3,) of the tool, base frame [m]"""
    orientation: npt.ArrayLike
    """(3, 3) R_base_tool"""
    speed: float = 0.05
    """towards the position [m/s], >= 0"""
    velocity: npt.ArrayLike = field(default_factory=_still)
    """(3,) of a position that moves along a path, base axes [m/s]; zero: a goal to stop at"""
    axes: npt.ArrayLike = field(default_factory=_axes)
    """(3, 3) R_base_task: each axis has an ABAG of its own; z is the outward normal of a surface"""
    normal_force: float = 0.0
    """press along -z of `axes` with this force [N]; 0: free motion along all axes"""


class CartesianCommand(NamedTuple):
    """What a :class:`CartesianVelocity` commands, and why. Base axes."""

    torque: Array
    """(n,) of the drives [N m]"""
    status: Status
    """ok; held: the force that is pressed with is not known, so nothing is pressed; non_finite: the arm floats"""
    force: Array
    """(3,) F at the tool [N]; its norm never exceeds max_force"""
    moment: Array
    """(3,) T [N m]; its norm never exceeds max_torque"""
    brake: Array
    """(3,) beside F, against motion that the task never makes [N]"""
    velocity: Array
    """(3,) of the tool [m/s]"""
    wanted: Array
    """(3,) [m/s]"""
    distance: float
    """to the position, in the plane of the surface while pressing [m]"""
    contact_force: float
    """along the normal, > 0 when the surface pushes the tool [N]; 0.0 if not known"""
    arrived: bool
    """within `arrived` of the position"""
    yielding: bool
    """somebody pushes: the task waits"""


class CartesianVelocity:
    """The tool moves at a wanted velocity by forces that never exceed a bound; on a surface it also presses.

    tau = J^T ((F; T) + D) + C dq + g + friction + posture, ||F|| <= max_force, ||T|| <= max_torque. F by one ABAG along
    the heading or one per task axis, T by three more on the rotation vector of the orientation error. A redundant arm
    keeps away from singularities and position limits without moving its tool. With ``normal_force`` the force
    along the normal is regulated by the sensorless estimate and the plane gets what the bound leaves. A push beyond
    ``yield_force`` makes the arm yield: F = 0 until it has gone. D brakes motion the task never makes, such as that
    of a pushed arm; it is no part of F and only takes energy out.

    Source: the whiteboard project with the errata of MATH.md section 1; orientation, posture, pressing, yielding and
    the stop at the goal are palpate's own.

    Args:
        arm: the arm; it needs masses.
        period: one :meth:`step` each [s].
        options: everything together, such as ``CartesianVelocityOptions.published("per_axis")``.
        **kwargs: or single options of :class:`CartesianVelocityOptions`; a wrong name lists them all.

    Raises:
        InputError: an option is unknown or out of range, or both forms are given; the arm has no masses.
    """

    def __init__(
        self,
        arm: Arm,
        period: float,
        options: CartesianVelocityOptions | None = None,
        **kwargs: Any,
    ) -> None:
        if options is not None and kwargs:
            raise InputError(f"give options, or {', '.join(kwargs)}, not both")
        self.arm = arm
        self.period = float(period)
        """[s]"""
        try:
            self.options = CartesianVelocityOptions(**kwargs) if options is None else options
            self._core = CoreVelocity(arm.core, self.period, self.options)
        except ValueError as e:
            raise InputError(str(e)) from None
        self._nothing = Load()

    def step(
        self,
        target: CartesianTarget,
        q: npt.ArrayLike,
        dq: npt.ArrayLike,
        *,
        force: npt.ArrayLike | None = None,
        load: Load | None = None,
    ) -> CartesianCommand:
        """One step of the loop.

        Args:
            target: where to.
            q: (n,) [rad].
            dq: (n,) [rad/s].
            force: (3,) of the environment on the grasp point, base axes [N], such as ``touch.wrench.force`` where
                that is to be believed; None: not known. Without it nothing is pressed and no push is noticed.
            load: what is held.

        Raises:
            InputError: wrong shapes. Bad numbers are no error: the arm floats and the status says so.
        """
        try:
            return CartesianCommand(
                *self._core.step(
                    _flat(target.position),
                    _flat(target.orientation),
                    float(target.speed),
                    _flat(target.velocity),
                    _flat(target.axes),
                    float(target.normal_force),
                    _flat(q),
                    _flat(dq),
                    None if force is None else _flat(force),
                    self._nothing if load is None else load,
                )
            )
        except ValueError as e:
            raise InputError(str(e)) from None

    def run(
        self, target: CartesianTarget, q: npt.ArrayLike, dq: npt.ArrayLike, force: npt.ArrayLike
    ) -> tuple[Array, Array]:
        """One step for each row of q and dq (N, n) and force (N, 3): joint torque (N, n), force and moment (N, 6).

        The target stands still and its axes are those of the base.

        Raises:
            InputError: wrong shapes.
        """
        rows = (np.ascontiguousarray(x, dtype=np.float64) for x in (q, dq, force))
        try:
            torque, wrench = self._core.run(
                _flat(target.position), _flat(target.orientation), target.speed, target.normal_force, *rows
            )
        except (ValueError, TypeError) as e:
            raise InputError(str(e).splitlines()[0]) from None
        return torque, wrench

    @property
    def abag(self) -> tuple[AbagState, AbagState, AbagState]:
        """State of the ABAGs of the task axes; with axes="heading" the first is the one in use."""
        x, y, z = self._core.abag()
        return AbagState(*x), AbagState(*y), AbagState(*z)

    def reset(self) -> None:
        """Forget everything."""
        self._core.reset()


class CartesianImpedance:
    """A virtual spring and damper at the tool, for comparison: its force grows with the distance and has no bound.

    tau = J^T [k_c (x_ref - x) + F] + D(d_c) + C dq + g + friction + posture (whiteboard project; MATH.md section 8).

    Args:
        arm: the arm; it needs masses.
        **kwargs: options of :class:`CartesianImpedanceOptions`: stiffness (3,) [N/m], turning_stiffness (3,)
            [N m/rad], damping_ratio, mass [kg] and inertia [kg m^2] that the damping is made for, posture.

    Raises:
        InputError: an option is unknown or out of range, or the arm has no masses.
    """

    def __init__(self, arm: Arm, **kwargs: Any) -> None:
        self.arm = arm
        try:
            self._core = CoreImpedance(arm.core, CartesianImpedanceOptions(**kwargs))
        except ValueError as e:
            raise InputError(str(e)) from None
        self._nothing = Load()

    def step(
        self,
        position: npt.ArrayLike,
        orientation: npt.ArrayLike,
        q: npt.ArrayLike,
        dq: npt.ArrayLike,
        *,
        force: npt.ArrayLike = (0.0, 0.0, 0.0),
        load: Load | None = None,
    ) -> tuple[Array, Status, Array, Array]:
        """Joint torque (n,) [N m], status, and the spring's and damper's force [N] and torque [N m], base axes.

        Args:
            position: (3,) of the spring's other end [m].
            orientation: (3, 3) R_base_tool there.
            q: (n,) [rad].
            dq: (n,) [rad/s].
            force: (3,) F beside the spring [N].
            load: what is held.

        Raises:
            InputError: wrong shapes.
        """
        try:
            torque, status, pull, moment = self._core.step(
                _flat(position),
                _flat(orientation),
                _flat(force),
                _flat(q),
                _flat(dq),
                self._nothing if load is None else load,
            )
        except ValueError as e:
            raise InputError(str(e)) from None
        return torque, status, pull, moment

    def reset(self) -> None:
        """Forget everything."""
        self._core.reset()


def _flat(value: npt.ArrayLike) -> Array:
    """Row by row, as the core takes it."""
    return np.ascontiguousarray(value, dtype=np.float64).ravel()
