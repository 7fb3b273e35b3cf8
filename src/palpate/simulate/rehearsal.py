"""A planned motion tried in the simulator before it runs on a robot."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..arm import Arm, Array
from ..errors import InputError
from ..logs import Log
from .clearance import Clearance
from .plant import Plant

BANDWIDTH = 20.0
"""of the feedback about the planned motion [rad/s]"""


@dataclass(frozen=True, slots=True, eq=False)
class Rehearsal:
    """What happened.

    Attributes:
        log: positions [rad], velocities [rad/s] and motor torques [N m] at the planned times.
        tracking: (n,) largest distance from the planned position [rad].
        torque: (n,) largest motor torque [N m].
        broken: sentences on limits broken and links that touch; empty: none.
        clearance: least distance of links from each other and the floor, at most 0.1 m.
        nearest: names of the two that come nearest; empty if none comes nearer than 0.1 m.
    """

    log: Log
    tracking: Array
    torque: Array
    broken: tuple[str, ...]
    clearance: float
    nearest: tuple[str, ...]


def rehearse(
    arm: Arm, time: Array, q: Array, dq: Array, ddq: Array, *, floor: float | None = None
) -> Rehearsal:
    """Let a simulated arm follow a motion by its own inverse dynamics and a stiff feedback.

    Args:
        arm: with masses.
        time: (N,) [s], evenly spaced.
        q, dq, ddq: (N, n) planned [rad, rad/s, rad/s^2].
        floor: height of the floor in the base frame [m]; None: no floor.

    Raises:
        ArmError: the arm has no masses.
        InputError: shapes do not fit, or the simulation leaves the finite numbers.
        MissingExtraError: without the extra ``sim``.
    """
    if np.ndim(time) != 1 or any(np.shape(v) != (len(time), arm.n) for v in (q, dq, ddq)) or len(time) < 2:
        raise InputError(f"q, dq, ddq must be (N, {arm.n}) for times (N,) with N of 2 and more")
    plant = Plant(arm)
    plant.reset(q[0], dq[0])
    time_ns = np.rint(np.asarray(time) * 1e9).astype(np.int64)
    planned = arm.inverse_dynamics(q, dq, ddq) + arm.friction_torque(dq)
    seen, speed, torque = np.zeros_like(q), np.zeros_like(q), np.zeros_like(q)
    for k in range(len(time)):
        seen[k], speed[k] = plant.q, plant.dq
        wanted = BANDWIDTH**2 * (q[k] - seen[k]) + 2.0 * BANDWIDTH * (dq[k] - speed[k])
        torque[k] = planned[k] + arm.mass_matrix(seen[k]) @ wanted
        if k + 1 < len(time):
            plant.step(torque[k], int(time_ns[k + 1] - time_ns[k]))
    # each torque holds for the period that follows; a drive reads the mean about the instant
    effort = np.vstack([torque[:1], 0.5 * (torque[1:] + torque[:-1])])
    broken = []
    peak = np.abs(torque).max(axis=0)
    for j, joint in enumerate(arm.joints):
        limits = joint.limits
        if seen[:, j].min() < limits.lower or seen[:, j].max() > limits.upper:
            broken.append(f"{joint.name} leaves its range")
        if np.abs(speed[:, j]).max() > limits.velocity:
            broken.append(
                f"{joint.name} reaches {np.abs(speed[:, j]).max():.3g} of {limits.velocity:.3g} rad/s"
            )
        if peak[j] > limits.effort:
            broken.append(f"{joint.name} needs {peak[j]:.3g} of {limits.effort:.3g} N m")
    clearance = Clearance(arm, floor=floor)
    distance = clearance(seen)
    worst = int(np.argmin(distance))
    least, *names = clearance.closest(seen[worst])
    if least <= 0.0:
        broken.append(f"{names[0]} and {names[1]} touch at {time[worst]:.2f} s")
    return Rehearsal(
        log=Log(
            time_ns=time_ns,
            position=seen,
            velocity=speed,
            effort=effort,
            joint_names=arm.joint_names,
            meta={"effort_unit": "N m"},
        ),
        tracking=np.abs(seen - q).max(axis=0),
        torque=peak,
        broken=tuple(broken),
        clearance=float(least),
        nearest=tuple(n for n in names if n),
    )
