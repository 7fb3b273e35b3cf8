"""The Cramér-Rao bound of the mass: no unbiased estimator's standard deviation can be smaller."""

from __future__ import annotations

import math

import numpy as np

from ..arm import Arm, Array
from ..simulate import Load

FIRST_EXIT_MEDIAN = 0.757497
"""median of the time at which a Brownian motion first leaves [-1, 1]"""


def holding(arm: Arm, load: Load, mass: float | None = None) -> Arm:
    """The arm with the object as a part of its last link; `mass` [kg] instead of the object's, its inertia kept."""
    m = load.mass if mass is None else mass
    R, p = arm.T_last_tip[:3, :3], arm.T_last_tip[:3, 3]
    c = R @ (arm.grasp + np.asarray(load.com)) + p
    last = arm.joints[-1]
    total = last.mass + m
    com = (last.mass * last.com + m * c) / total
    inertia = last.inertia + R @ np.asarray(load.inertia) @ R.T
    for body, at in ((last.mass, last.com - com), (m, c - com)):
        inertia = inertia + body * (at @ at * np.eye(3) - np.outer(at, at))
    inertia = 0.5 * (inertia + inertia.T)
    return arm.replace(joints=(*arm.joints[:-1], last.replace(mass=total, com=com, inertia=inertia)))


def transitions(
    arm: Arm, load: Load, q: Array, dq: Array, torque: Array, period: float, *, substeps: int = 1
) -> Array:
    """How small changes of (q, q', m) at one sample change (q, q', m) at the next, along a motion.

    Args:
        arm: without the object.
        load: what it holds.
        q: (N, n) true [rad].
        dq: (N, n) true [rad/s].
        torque: (N, n) applied in the period that ended at the sample [N m].
        period: [s].
        substeps: parts of a period in which the Jacobian is taken to be constant.

    Returns:
        (N-1, 2n+1, 2n+1). Within a period the motion is followed by exponential steps, which friction that settles in a
        fraction of them does not disturb; the Jacobian is taken by central differences at the middle of each.
    """
    tau = torque[1:]
    n, step = arm.n, 1e-3 * load.mass
    full = holding(arm, load)
    lighter, heavier = holding(arm, load, load.mass - step), holding(arm, load, load.mass + step)

    def acceleration(model: Arm, x: Array) -> Array:
        v = np.ascontiguousarray(x[:, n : 2 * n])
        return model.forward_dynamics(np.ascontiguousarray(x[:, :n]), v, tau - model.friction_torque(v))

    def rate(x: Array) -> Array:
        """(N-1, 2n+1) time derivative of (q, q', m)."""
        return np.concatenate((x[:, n : 2 * n], acceleration(full, x), np.zeros((len(x), 1))), axis=1)

    def jacobian(x: Array) -> Array:
        F = np.zeros((len(x), 2 * n + 1, 2 * n + 1))
        F[:, :n, n : 2 * n] = np.eye(n)
        for j in range(2 * n):
            d = np.zeros(2 * n + 1)
            d[j] = 1e-5
            F[:, n : 2 * n, j] = (acceleration(full, x + d) - acceleration(full, x - d)) / 2e-5
        F[:, n : 2 * n, 2 * n] = (acceleration(heavier, x) - acceleration(lighter, x)) / (2.0 * step)
        return F

    h = period / substeps
    x = np.concatenate((q[:-1], dq[:-1], np.full((len(tau), 1), load.mass)), axis=1)
    F = jacobian(x)
    total = np.broadcast_to(np.eye(2 * n + 1), F.shape)
    for _ in range(substeps):
        _, half = _exponential_step(F, rate(x), 0.5 * h)
        F = jacobian(x + half)
        Phi, whole = _exponential_step(F, rate(x), h)
        x = x + whole
        total = Phi @ total
    return np.ascontiguousarray(total)


def _exponential_step(F: Array, f: Array, h: float) -> tuple[Array, Array]:
    """exp(h F) and the increment of x over h of x' = f + F (x - x_0)."""
    k = F.shape[1]
    A = np.zeros((len(F), k + 1, k + 1))
    A[:, :k, :k] = h * F
    A[:, :k, k] = h * f
    E = _exponential(A)
    return E[:, :k, :k], E[:, :k, k]


def _exponential(A: Array) -> Array:
    """exp of each (k, k) matrix of A (N, k, k): scaled, Taylor's series of order 8, squared."""
    norm = float(np.abs(A).sum(axis=2).max())
    squarings = max(0, math.ceil(math.log2(max(norm, 1e-300) / 0.1)))
    B = A / 2.0**squarings
    term = np.broadcast_to(np.eye(A.shape[1]), A.shape)
    result = term.copy()
    for k in range(1, 9):
        term = term @ B / k
        result += term
    for _ in range(squarings):
        result = result @ result
    return result


def mass_std(
    transition: Array,
    position_std: Array,
    mass_prior_std: float,
    velocity_prior_std: float,
    *,
    count: Array | None = None,
    q: Array | None = None,
) -> Array:
    """Bound of the mass's standard deviation after each sample, (N,) [kg].

    For white Gaussian noise of the positions, torques known, nothing disturbed, and the stated knowledge of mass and
    velocity before the first sample; the start position is not known.

    Args:
        transition: (N-1, 2n+1, 2n+1) of :func:`transitions`.
        position_std: (n,) noise of a position [rad].
        mass_prior_std: [kg].
        velocity_prior_std: [rad/s].
        count: (n,) of the encoders [rad]: rounding to it as an error of its own, of standard deviation
            count/sqrt(12), that stays while the joint stands and is another after 0.2 counts of motion. None:
            rounding is in position_std.
        q: (N, n) true positions [rad], needed with `count`.
    """
    n = len(position_std)
    errors = 0 if count is None else n
    size = 2 * n + 1 + errors
    H = np.eye(n, size)
    H[:, 2 * n + 1 :] = np.eye(n, errors)
    R = np.diag(np.square(position_std))
    rounding = np.zeros(0) if count is None else np.square(count) / 12.0
    P = np.diag(
        np.concatenate((np.full(n, 1.0), np.full(n, velocity_prior_std**2), [mass_prior_std**2], rounding))
    )
    out = np.empty(len(transition) + 1)
    F, eye, old = np.eye(size), np.eye(size), slice(2 * n + 1, size)
    for k in range(len(out)):
        if k:
            F[: 2 * n + 1, : 2 * n + 1] = transition[k - 1]
            if count is not None and q is not None:
                F[old, old] = np.diag(np.exp(-np.abs(q[k] - q[k - 1]) / (0.2 * count)))
            P = F @ P @ F.T
            P[old, old] += np.diag((1.0 - np.square(np.diag(F)[old])) * rounding)
        K = np.linalg.solve(H @ P @ H.T + R, H @ P).T
        left = eye - K @ H
        P = left @ P @ left.T + K @ R @ K.T  # Joseph's form: stays symmetric and positive
        out[k] = math.sqrt(P[2 * n, 2 * n])
    return out


def settling_time(time: Array, std: Array, bound: float) -> float:
    """Median time after which an efficient estimator's error stays within +-bound for good [s]; infinite if never.

    The error of an estimator that reaches the bound at every moment is a Brownian motion in its own variance:
    e(t) = W(P(t)), P falling. Looked at from P = 0 it leaves +-bound for the first time at P = 0.7575 bound^2 in
    the median.
    """
    return crossing(time, np.square(std), FIRST_EXIT_MEDIAN * bound * bound)


def crossing(time: Array, falling: Array, level: float) -> float:
    """When `falling` (N,) first is at or below `level`, between samples by interpolation of its logarithm [s]."""
    below = np.flatnonzero(falling <= level)
    if not below.size:
        return math.inf
    k = int(below[0])
    if k == 0:
        return float(time[0])
    a, b = math.log(falling[k - 1]), math.log(falling[k])
    return float(time[k - 1] + (time[k] - time[k - 1]) * (a - math.log(level)) / (a - b))


def still_inside(variance: Array, bound: float) -> Array:
    """Probability that a Brownian motion has not left +-bound until `variance`, (N,)."""
    s = np.square(np.pi / bound) * np.maximum(variance, 1e-12 * bound * bound) / 8.0
    k = np.arange(40)[:, None]
    total = 4.0 / np.pi * ((-1.0) ** k / (2 * k + 1) * np.exp(-np.square(2 * k + 1) * s)).sum(axis=0)
    return np.where(variance > 0.05 * bound * bound, np.clip(total, 0.0, 1.0), 1.0)
