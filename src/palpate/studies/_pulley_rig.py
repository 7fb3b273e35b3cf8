"""The rig of the sensorless-force paper: a motor lifts weights on a pulley, its torque told from two phase
currents."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ..arm import Array
from ..identify import calibrate_phases
from ..phase import PhaseCurrents
from ..simulate.irb2400 import GAIN_MISMATCH, NOISE, OFFSET, POLE_PAIRS, phase_waves
from ._geared_arm import RATE
from ._irb2400 import CURRENT_RATE, glitches, smooth

PULLEY = 0.032
"""radius of the paper's pulley [m]"""
WEIGHTS = (0.5, 1.0, 2.0, 3.0)
"""[kg]; the paper says: several"""
RIG_K_T, RIG_INERTIA, RIG_COULOMB, RIG_VISCOUS = 0.35, 2e-4, 0.02, 5e-4
"""of the motor: [N m/A], [kg m^2], [N m], [N m s/rad]; assumed"""
RIG_SECONDS, RIG_NOMINAL, RIG_ENCODER = 6.0, 3.0, 1e-3
"""length of a lift [s]; sensor TH3A [A]; encoder count [rad]"""
RIG_KNOWN = 1.5
"""the weight that tells the torque constant [kg]"""


@dataclass(frozen=True, slots=True)
class Lift:
    """A weight lifted and lowered on the pulley.

    Attributes:
        weight: [kg].
        time: (N,) [s].
        true, printed, amplitude, ours: (N,) motor torque: what it is; by the paper's formula as printed, by
            its amplitude with the right sign; by palpate [N m].
        mass: by palpate, from lifting and lowering: friction cancels [kg].
    """

    weight: float
    time: Array
    true: Array
    printed: Array
    amplitude: Array
    ours: Array
    mass: float


class Rig:
    """The motor with its sensors, which lifts and lowers weights. One known weight tells what an ampere is worth."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self._rng = rng
        self._scale = 1.0 + GAIN_MISMATCH * rng.uniform(-1.0, 1.0, 2)
        self._zero = OFFSET * RIG_NOMINAL * rng.uniform(-1.0, 1.0, 2)
        self._angle = rng.uniform(-math.pi, math.pi)
        self.k_t = RIG_K_T
        known = self.lift(RIG_KNOWN)
        self.k_t = RIG_K_T * RIG_KNOWN / known.mass

    def lift(self, weight: float) -> Lift:
        """Two turns up, two turns down; the cable is slack at first."""
        time = np.arange(round(RIG_SECONDS * RATE)) / RATE
        turn = 4.0 * math.pi * (smooth((time - 0.5) / 2.0) - smooth((time - 3.5) / 2.0))
        speed = np.gradient(turn, time)
        acceleration = np.gradient(speed, time)
        taut = smooth((time - 0.2) / 0.3)
        true = weight * PULLEY * (9.81 + PULLEY * acceleration) * taut
        true += RIG_INERTIA * acceleration + RIG_COULOMB * np.tanh(speed / 0.05) + RIG_VISCOUS * speed
        theta = POLE_PAIRS * turn + self._angle
        i_q = true / RIG_K_T
        waves = phase_waves(i_q[:, None], theta[:, None], glitches(speed[:, None]))
        noise = NOISE * RIG_NOMINAL * self._rng.standard_normal((2, len(time), 1))
        phase_a, phase_b = (self._scale[k] * waves[k] + self._zero[k] + noise[k] for k in range(2))
        position = np.round(turn / RIG_ENCODER) * RIG_ENCODER
        sensors = calibrate_phases(position, phase_a[:, 0], phase_b[:, 0], POLE_PAIRS)
        readings = np.round(time * 1e9).astype(np.int64), phase_a, phase_b
        found = PhaseCurrents(
            1,
            k_t=self.k_t,
            pole_pairs=POLE_PAIRS,
            angle_offset=sensors.angle_offset,
            offset=[sensors.offset],
            gain=[sensors.gain],
            amplitude_std=1.5 * sensors.noise,
            current_rate=CURRENT_RATE,
        ).run(*readings, position=position[:, None])
        printed = PhaseCurrents(1, k_t=RIG_K_T, published=True).run(*readings)
        amplitude = PhaseCurrents(1, k_t=RIG_K_T).run(*readings, controller_current=true[:, None])
        ours = found.torque[:, 0]
        up, down = (ours[way * speed > 1.0].mean() for way in (1.0, -1.0))
        mass = 0.5 * float(up + down) / (9.81 * PULLEY)
        return Lift(weight, time, true, printed.torque[:, 0], amplitude.torque[:, 0], ours, mass)
