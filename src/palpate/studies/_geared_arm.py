"""A stiffly controlled industrial arm with geared drives: truth for the sensorless-force study.

Forward dynamics of the chain with friction that sticks, slides and remembers (LuGre), at the motors, which may
turn with several joints: :mod:`palpate.simulate.drives`. What identification fits is another model (Dahl's
remembered sign times a Stribeck curve), so no fit can be exact.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ..arm import Arm, Array
from ..simulate.drives import Drives, LuGre, position_gains

RATE = 1000
"""control steps and readings per second [Hz]"""
SUBSTEPS = 2
"""integration steps per control step"""


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


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """One motion to simulate.

    Attributes:
        arm: links and gravity; its friction and rotor inertias are not used.
        drives: the motors.
        reference: times (N,) [s] to joint positions (N, n) [rad]; stays where it is after its end.
        seconds: how long.
        wrench: times (N,) [s] to the wrench on the tip (N, 6), base axes [N, N m]; None: nothing pushes.
    """

    arm: Arm
    drives: Drives
    reference: Callable[[Array], Array]
    seconds: float
    wrench: Callable[[Array], Array] | None = None


def simulate(runs: Sequence[Run], progress: Callable[[float], None] = lambda done: None) -> list[Motion]:
    """Let arms with the same transmission follow their references, all at once.

    Args:
        runs: what to simulate.
        progress: told the part that is done, now and then.
    """
    h, dt = 1.0 / RATE, 1.0 / RATE / SUBSTEPS
    count = round(max(run.seconds for run in runs) * RATE)
    time = np.arange(count + 3, dtype=np.float64) * h  # a little longer: differences at the end are one-sided
    K, n = len(runs), runs[0].arm.n
    B, inverse_B = runs[0].drives.B, np.linalg.inv(runs[0].drives.B)

    rotors = np.array([B.T @ np.diag(run.drives.inertia) @ B for run in runs])
    q_d = np.stack([run.reference(time) for run in runs], axis=1)
    dq_d = np.gradient(q_d, h, axis=0)
    ddq_d = np.gradient(dq_d, h, axis=0)
    F = np.stack(
        [np.zeros((len(time), 6)) if run.wrench is None else run.wrench(time) for run in runs], axis=1
    )
    arms = list({id(run.arm): run.arm for run in runs}.values())
    groups = [(arm, [k for k, run in enumerate(runs) if run.arm is arm]) for arm in arms]
    feedforward, seen = np.empty((len(time), K, n)), np.empty((K, n))
    for k, run in enumerate(runs):
        feedforward[:, k] = run.arm.inverse_dynamics(q_d[:, k], dq_d[:, k], ddq_d[:, k]) @ inverse_B
        # the inertia each motor sees in the middle of its motion sets its gains
        middle = round(0.5 * run.seconds * RATE)
        seen[k] = np.diag(inverse_B.T @ (run.arm.mass_matrix(q_d[middle, k]) + rotors[k]) @ inverse_B)
    motors = Drives.stacked([run.drives for run in runs])
    kp, kd, ki = position_gains(motors, seen)
    friction_of, q, dq = LuGre(motors, seen), q_d[0].copy(), np.zeros((K, n))
    integral, friction = np.zeros((K, n)), np.zeros((K, n))
    rows = np.empty((4, count, K, n))
    M, push, zero, tip = np.empty((K, n, n)), np.empty((K, n)), np.zeros((K, n)), np.zeros(3)
    BT = B.T.copy()
    for k in range(count):
        error = (q_d[k] - q) @ BT
        integral += error * h
        tau = feedforward[k] + kp * error + kd * ((dq_d[k] - dq) @ BT) + ki * integral
        for arm, at in groups:
            core, here = arm.core, q[at]
            M[at] = core.mass_matrix(here)
            J = core.jacobian(here, tip)
            push[at] = np.einsum("kij,ki->kj", J, F[k, at]) - core.inverse_dynamics(here, dq[at], zero[at])
        inverse = np.linalg.inv(M + rotors)
        uneven = friction_of.uneven(q @ BT)
        rows[0, k], rows[1, k] = q, dq
        for _ in range(SUBSTEPS):
            friction = friction_of.step(dq @ BT, uneven, dt)
            dq = dq + dt * (inverse @ ((tau - friction) @ B + push)[:, :, None])[:, :, 0]
            q = q + dt * dq
        rows[2, k], rows[3, k] = tau, friction
        if k % 1000 == 999:
            progress((k + 1) / count)
    motions = []
    for k, run in enumerate(runs):
        q_k, dq_k, tau_k, f_k = rows[:, : round(run.seconds * RATE), k]
        motions.append(Motion(time[: len(q_k)], q_k, dq_k, tau_k, f_k, F[: len(q_k), k]))
    return motions
