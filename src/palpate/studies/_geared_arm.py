"""A stiffly controlled industrial arm with geared drives: truth for the sensorless-force study.

Forward dynamics of the chain with friction that sticks, slides and remembers (LuGre), at the motors, which may turn with
several joints:

    M q'' + C q' + g + B^T (I_m B q'' + f) = B^T tau_m + J^T F,        motor speeds w = B q'
    dz/dt = w - |w| z / x(w),   x = x_0 g(w)/F_c,   g = F_c + (F_s - F_c) exp(-(w/v_s)^2)
    f = (F_c/x_0) z + s_1 dz/dt + F_v w

C. Canudas de Wit, H. Olsson, K. Astrom, P. Lischinsky, IEEE TAC 40(3), 1995. What identification fits is another model
(Dahl's remembered sign times a Stribeck curve), so no fit can be exact.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..arm import Arm, Array

RATE = 1000
"""control steps and readings per second [Hz]"""
SUBSTEPS = 2
"""integration steps per control step"""
BANDWIDTH = 60.0
"""of the position control [rad/s]"""


@dataclass(frozen=True, slots=True, eq=False)
class Drives:
    """The motors of an arm, all seen at the link side.

    Attributes:
        B: (n, n) motor speeds = B dq.
        inertia: (n,) of the rotors [kg m^2].
        coulomb, static, viscous, stribeck_velocity: (n,) F_c, F_s [N m], F_v [N m s/rad], v_s [rad/s].
        presliding: (n,) x_0 [rad].
        ripple: (n,) part of the Coulomb friction that varies with the motor's position [1].
        ripple_period: (n,) of that variation [rad].
    """

    B: Array
    inertia: Array
    coulomb: Array
    static: Array
    viscous: Array
    stribeck_velocity: Array
    presliding: Array
    ripple: Array
    ripple_period: Array


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """What really happened, RATE rows per second.

    Attributes:
        time: (N,) [s].
        q, dq: (N, n) of the joints [rad, rad/s].
        torque: (N, n) of the motors at the link side [N m].
        friction: (N, n) of the motors [N m].
        wrench: (N, 6) on the tip, force then moment, base axes [N, N m].
    """

    time: Array
    q: Array
    dq: Array
    torque: Array
    friction: Array
    wrench: Array

    def __len__(self) -> int:
        return len(self.time)


def simulate(arm: Arm, drives: Drives, reference: Callable[[Array], Array], seconds: float, wrench: Array | None = None) -> Motion:
    """Let the arm follow a reference.

    Args:
        arm: links and gravity; its friction and rotor inertias are not used.
        drives: the motors.
        reference: times (N,) [s] to joint positions (N, n) [rad].
        seconds: how long.
        wrench: (N, 6) on the tip, base axes [N, N m]; None: nothing pushes.
    """
    count = round(seconds * RATE)
    h = 1.0 / RATE
    time = np.arange(count + 1) * h
    q_d = reference(time)
    dq_d = np.gradient(q_d, h, axis=0)
    ddq_d = np.gradient(dq_d, h, axis=0)
    F = np.zeros((count + 1, 6)) if wrench is None else wrench
    core, n, tip = arm.core, arm.n, np.zeros(3)
    B, BT = drives.B, drives.B.T.copy()
    rotors = BT @ np.diag(drives.inertia) @ B
    feedforward = arm.inverse_dynamics(q_d, dq_d, ddq_d) @ np.linalg.inv(B)
    # inertia each motor sees in the middle of the motion sets its gains
    M = arm.mass_matrix(q_d[count // 2]) + rotors
    seen = np.diag(np.linalg.inv(B).T @ M @ np.linalg.inv(B))
    # the speed loop must outdo the falling branch of the Stribeck curve, or the joint creeps by jerks
    falling = (drives.static - drives.coulomb) / drives.stribeck_velocity
    kp, kd = seen * BANDWIDTH**2, 2.0 * seen * BANDWIDTH + 1.5 * falling
    ki = kp * BANDWIDTH / 4.0
    stiffness = drives.coulomb / drives.presliding
    micro = 0.2 * np.sqrt(stiffness * seen)
    q, dq = q_d[0].copy(), np.zeros(n)
    z = np.zeros(n)
    integral = np.zeros(n)
    friction = np.zeros(n)
    rows_q, rows_dq = np.empty((count, n)), np.empty((count, n))
    rows_tau, rows_f = np.empty((count, n)), np.empty((count, n))
    zero = np.zeros((1, n))
    dt = h / SUBSTEPS
    for k in range(count):
        error = B @ (q_d[k] - q)
        integral += error * h
        tau = feedforward[k] + kp * error + kd * (B @ (dq_d[k] - dq)) + ki * integral
        here = q[None]
        inverse = np.linalg.inv(core.mass_matrix(here)[0] + rotors)
        push = core.jacobian(here, tip)[0].T @ F[k] - core.inverse_dynamics(here, dq[None], zero)[0]
        ripple = 1.0 + drives.ripple * np.sin(2.0 * np.pi * (B @ q) / drives.ripple_period)
        rows_q[k], rows_dq[k] = q, dq
        for _ in range(SUBSTEPS):
            w = B @ dq
            g = drives.coulomb + (drives.static - drives.coulomb) * np.exp(-np.square(w / drives.stribeck_velocity))
            reach = drives.presliding * g / drives.coulomb
            end = np.sign(w) * reach
            moved = end + (z - end) * np.exp(-np.abs(w) * dt / reach)
            friction = ripple * (stiffness * moved + micro * (moved - z) / dt) + drives.viscous * w
            z = moved
            dq = dq + dt * (inverse @ (BT @ (tau - friction) + push))
            q = q + dt * dq
        rows_tau[k], rows_f[k] = tau, friction
    return Motion(time[:count], rows_q, rows_dq, rows_tau, rows_f, F[:count])
