"""What a run shows: tracking, force felt against true, stiffness felt, how soon a touch is felt, jumps after a
dead link."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from .coupling import Event
from .ends import PERIOD
from .session import Cut, Run

SETTLED = 2.0
"""the coupling is whole and the tare taken from here on [s]"""
_TOUCH = 0.3
"""a true force above it is a touch [N]"""


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
