"""What touches an arm of hobby servos, from coarse encoders and motor currents: an observer whose model sticks."""

from __future__ import annotations

import math

import numpy as np

from ..arm import Arm, Array

_SWEEPS, _RELAXED = 12, 0.7
"""of the iteration for the friction of all joints together, and its relaxation [1]"""
_STUCK = 0.05
"""time constant with which a joint counts as stuck [s]"""


class _Counted:
    """Corrections of place, speed and acceleration by an encoder of whole counts.

    Critically damped fading-memory filter of second degree (N. Morrison, Introduction to Sequential Smoothing and
    Prediction, 1969), theta = exp(-w h). What lies within half a count of the model says nothing::

        e <- e - clip(e, -c/2, c/2),   x += (1 - theta^3) e,   v += 3/2 (1 - theta)^2 (1 + theta) e/h,
        a += (1 - theta)^3 e/h^2
    """

    def __init__(self, count: float, bandwidth: float, period: float) -> None:
        theta = math.exp(-bandwidth * period)
        rest = 1.0 - theta
        self._half = 0.5 * count
        self._gains = 1.0 - theta**3, 1.5 * rest**2 * (1.0 + theta) / period, rest**3 / period**2

    def __call__(self, innovation: Array) -> tuple[Array, Array, Array]:
        """Of place [rad], speed [rad/s] and acceleration [rad/s^2], for measured less predicted places (n,) [rad]."""
        told = innovation - np.clip(innovation, -self._half, self._half)
        place, speed, acceleration = self._gains
        return place * told, speed * told, acceleration * told


class CountedMotion:
    """Speed of joints by encoders of whole counts, nothing else being known: a constant acceleration that fades.

    Args:
        n: joints.
        count: of the encoders [rad].
        bandwidth: [rad/s].
        period: between samples [s].
    """

    def __init__(self, n: int, count: float, bandwidth: float, period: float) -> None:
        self._correct = _Counted(count, bandwidth, period)
        self._h, self._fades = period, math.exp(-0.5 * bandwidth * period)
        self._x: Array | None = None
        self._v, self._a = np.zeros(n), np.zeros(n)

    def __call__(self, position: Array) -> Array:
        """(n,) speed [rad/s] with the next position (n,) [rad]."""
        h = self._h
        before = position if self._x is None else self._x
        x, v = before + h * self._v + 0.5 * h * h * self._a, self._v + h * self._a
        dx, dv, da = self._correct(position - x)
        self._x, self._v, self._a = x + dx, v + dv, self._fades * self._a + da
        return self._v


class ServoForce:
    """The external torque of an arm of geared servos, sample by sample.

    The arm's model runs along, with dry friction that truly sticks; an encoder that leaves it by more than half a
    count corrects its place and speed, and its external torque in proportion to the acceleration that was missing::

        M dq+ = M dq + h (tau - C dq - g + tau_ext - F_v dq+ - f),    f in (F_c + mu |tau - f - F_v dq|) Sgn(dq+)

    Sgn is [-1, 1] at rest: whatever keeps the model at rest is friction, and tau_ext stays what it was when the joint
    moved last, but for what friction cannot bear. That is all that a joint at rest tells. A joint that moves both ways
    tells its torque whole, because friction turns over with it.

    Args:
        arm: its model; Coulomb and viscous friction are used.
        load_friction: mu, part of what a gear carries that it loses [1].
        count: of the encoders [rad].
        bandwidth: of the corrections [rad/s].
        period: between samples [s].
    """

    def __init__(
        self, arm: Arm, *, load_friction: float, count: float, bandwidth: float, period: float
    ) -> None:
        self._arm, self._h, self._mu = arm, period, load_friction
        self._coulomb = np.array([j.friction.coulomb for j in arm.joints])
        self._viscous = np.array([j.friction.viscous for j in arm.joints])
        self._correct = _Counted(count, bandwidth, period)
        self._mass = 0.0
        self._started = False
        self.q, self.dq = np.zeros(arm.n), np.zeros(arm.n)
        """(n,) place [rad], finer than the counts; speed [rad/s]"""
        self.torque = np.zeros(arm.n)
        """(n,) external torque [N m]"""
        self.friction = np.zeros(arm.n)
        """(n,) dry friction [N m]"""
        self.band = self._coulomb.copy()
        """(n,) the most it can be [N m]"""
        self.stuck = np.ones(arm.n)
        """(n,) part of the time lately in which the joint did not move [1]"""

    def hold(self, mass: float) -> None:
        """From now on this mass at the grasp point is known [kg]: its weight and inertia are not felt."""
        self._mass = mass

    def step(self, position: Array, effort: Array) -> None:
        """Take a sample.

        Args:
            position: (n,) [rad].
            effort: (n,) link-side torque of the motors over the period that ends now [N m].
        """
        arm, h = self._arm, self._h
        q = self.q if self._started else position
        self._started = True
        M = arm.mass_matrix(q)
        bias = arm.inverse_dynamics(q, self.dq, np.zeros(arm.n))
        if self._mass > 0.0:
            J = arm.jacobian(q, arm.grasp)[:3]
            M = M + self._mass * (J.T @ J)
            bias = bias - self._mass * (J.T @ arm.gravity)
        mobility = np.linalg.inv(M + h * np.diag(self._viscous))
        free = mobility @ (M @ self.dq + h * (effort - bias + self.torque))
        f, slope = self.friction, _RELAXED / (h * np.diag(mobility))
        for _ in range(_SWEEPS):
            carried = np.abs(effort - f - self._viscous * self.dq)
            band = self._coulomb + self._mu * carried
            f = np.clip(f + slope * (free - h * (mobility @ f)), -band, band)
        rests = np.abs(f) < band
        v = np.where(rests, 0.0, free - h * (mobility @ f))
        dq, dv, da = self._correct(position - q - h * v)
        self.q, self.dq = q + h * v + dq, v + dv
        self.torque = self.torque + M @ da
        self.friction, self.band = f, band
        self.stuck = self.stuck - math.expm1(-h / _STUCK) * (rests - self.stuck)
