"""What a run shows: tracking, force felt against true, stiffness felt, how soon a touch is felt, jumps after a
dead link."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from .._core import turn_between
from .coupling import Event
from .ends import PERIOD
from .session import Cut, Run

SETTLED = 2.0
"""the coupling is whole and the tare taken from here on [s]"""
_TOUCH = 0.3
"""a true force above it is a touch [N]"""
_TWIST = 0.05
"""and a true torque [N m]"""


@dataclass(frozen=True, slots=True)
class Transparency:
    """How like touching the thing itself it is. NaN: the run does not tell."""

    tracking: float
    """largest distance of the tool from where the device points, with nothing touched [m]"""
    free_force: float
    """largest force of the device with nothing touched [N]"""
    force_error: float
    """mean of felt against true force where it is held, part of the true force [1]"""
    force_held: float
    """the true force there [N]"""
    stiffness: float
    """felt per way of the device, part of the true force per way of the tool [1]"""
    met: float
    """true force per way of the tool, part of the spring's stiffness [1]: the contact itself gives a little"""
    onset: float
    """from the touch until something is felt [s]"""
    speed: float
    """of the tool, largest [m/s]"""


def transparency(run: Run, *, force_scale: float = 1.0, stiffness: float | None = None) -> Transparency:
    """Figures of a run.

    Args:
        run: the run.
        force_scale: force felt per force of the environment [1].
        stiffness: of what is touched [N/m]; None: not known.
    """
    true = np.linalg.norm(run.true, axis=1)
    touched = true > _TOUCH
    begin = round(SETTLED / PERIOD)
    near = np.convolve(touched, np.ones(601), mode="same") > 0.0
    free = ~near
    free[:begin] = False
    away = np.linalg.norm(run.tip - run.wanted, axis=1)
    tracking = float(away[free].max()) if free.any() else math.nan
    free_force = float(np.linalg.norm(run.force, axis=1)[free].max()) if free.any() else math.nan

    speed = np.linalg.norm(run.tip_velocity, axis=1)
    force_error = held = onset = felt_stiffness = met = math.nan
    rows = np.flatnonzero(touched[begin:]) + begin
    if len(rows):
        still = rows[(speed[rows] < 3e-3) & (true[rows] > 0.7 * true.max())]
        if len(still) > 100:
            # felt along the direction of the true force, over tenths of a second: a hand feels no single sample
            count = len(still) // 100 * 100
            direction = run.true[still].mean(axis=0)
            held = float(np.linalg.norm(direction))
            direction /= held
            felt = (run.felt[still] @ direction)[:count].reshape(-1, 100).mean(axis=1) / force_scale
            really = (run.true[still] @ direction)[:count].reshape(-1, 100).mean(axis=1)
            force_error = float(np.abs(felt / really - 1.0).mean())
            if stiffness is not None:
                start = run.tip[rows[0]]
                felt_per_way, true_per_way = (
                    float((force[still] @ direction).mean() / ((place[still] - start) @ -direction).mean())
                    for force, place in ((run.felt / force_scale, run.wanted), (run.true, run.tip))
                )
                felt_stiffness, met = felt_per_way / true_per_way, true_per_way / stiffness
        first = rows[0]
        later = np.flatnonzero(np.abs(run.felt[first : first + 500]).max(axis=1) > 0.0)
        onset = float(later[0] * PERIOD) if len(later) else math.inf
    return Transparency(
        tracking, free_force, force_error, held, felt_stiffness, met, onset, float(speed.max())
    )


@dataclass(frozen=True, slots=True)
class Contact:
    """How steadily something is touched. NaN: it is not touched."""

    bounces: int
    """times the touch is lost while the hand presses"""
    peak: float
    """largest true force [N]"""
    held: float
    """mean true force where it is held [N]"""
    unsteady: float
    """standard deviation of it there [N]"""


def contact(run: Run, until: float) -> Contact:
    """Of a hand that presses until a time [s]; it is held over the last second before."""
    size = np.linalg.norm(run.true, axis=1)
    inside = run.time < until
    touched = size[inside] > _TOUCH
    if not touched.any():
        return Contact(0, math.nan, math.nan, math.nan)
    late = size[inside & (run.time >= until - 1.0)]
    bounces = int(np.count_nonzero(touched[:-1] & ~touched[1:]))
    return Contact(bounces, float(size[inside].max()), float(late.mean()), float(late.std()))


def jumps(run: Run, cuts: tuple[Cut, ...]) -> tuple[float, float, float]:
    """After dead links, over half a second from each return: the largest change within 10 ms of the force of the
    device [N] and of the
    tool's velocity [m/s]; and how far the reference went while the link was dead [m]."""
    force = speed = moved = 0.0
    dead = (run.slave_events & int(Event.LINK)) != 0
    for cut in cuts:
        inside = dead & (run.time > cut.at) & (run.time < cut.at + cut.seconds)
        if not inside.any():
            continue
        held = run.reference[inside]
        moved = max(moved, float(np.ptp(held, axis=0).max()))
        begin = round((cut.at + cut.seconds) / PERIOD)
        for lag in (1, 5, 10):
            later = slice(begin + lag, begin + 500)
            before = slice(begin, begin + 500 - lag)
            force = max(force, float(np.abs(run.force[later] - run.force[before]).max(initial=0.0)))
            speed = max(
                speed, float(np.abs(run.tip_velocity[later] - run.tip_velocity[before]).max(initial=0.0))
            )
    return force, speed, moved


@dataclass(frozen=True, slots=True)
class Turning:
    """The same of orientation and torque. NaN: the run does not tell."""

    tracking: float
    """largest angle of the tool from where the device turns it, with nothing touched [rad]"""
    spin: float
    """of the tool there, largest angular velocity [rad/s]"""
    torque: float
    """largest true torque about the tool's tip [N m]"""
    estimate_error: float
    """mean of the estimated less the true torque, while it is touched [N m]"""
    torque_error: float
    """mean of felt against true torque where it is held, part of the true torque [1]; NaN: the device shows none"""
    torque_held: float
    """the true torque there [N m]"""


def turning(run: Run, *, torque_scale: float = 1.0) -> Turning:
    """Figures of a run whose pose is coupled.

    Args:
        run: the run.
        torque_scale: torque felt per torque of the environment [1].
    """
    begin = round(SETTLED / PERIOD)
    touched = np.linalg.norm(run.true, axis=1) > _TOUCH
    torque, spin = np.linalg.norm(run.true_torque, axis=1), np.linalg.norm(run.tip_spin, axis=1)
    touched |= torque > _TWIST
    free = ~(np.convolve(touched, np.ones(601), mode="same") > 0.0)
    free[:begin] = False
    alone = np.flatnonzero(free)
    away = [float(np.linalg.norm(turn_between(run.wanted_turn[k], run.tip_turn[k]))) for k in alone]
    error = np.linalg.norm(run.estimated_torque - run.true_torque, axis=1)
    torque_error = held = math.nan
    late = touched.copy()
    late[:begin] = False
    still = np.flatnonzero(late & (spin < 0.03) & (torque > 0.7 * torque.max()))
    if len(still) > 100 and np.any(run.felt_torque):
        direction = run.true_torque[still].mean(axis=0)
        held = float(np.linalg.norm(direction))
        direction /= held
        count = len(still) // 100 * 100
        felt, really = (
            (part[still] @ direction)[:count].reshape(-1, 100).mean(axis=1)
            for part in (run.felt_torque / torque_scale, run.true_torque)
        )
        torque_error = float(np.abs(felt / really - 1.0).mean())
    return Turning(
        max(away, default=math.nan),
        float(spin[alone].max(initial=0.0)),
        float(torque.max(initial=0.0)),
        float(error[late].mean()) if late.any() else math.nan,
        torque_error,
        held,
    )
